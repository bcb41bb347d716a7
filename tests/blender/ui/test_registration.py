"""Enabling and disabling the add-on: what it adds, and that it takes all of it back."""

import importlib
import sys

import bpy
import pytest
from blender_state import counted_draw_handlers, difference, state

import ltsh_addon
from ltsh_addon.blender import registration


def test_the_state_shows_whatever_an_add_on_adds():
    """The oracle itself: one thing of each kind, added and taken back."""

    class LTSH_PT_probe(bpy.types.Panel):
        bl_label, bl_space_type, bl_region_type = "Probe", "VIEW_3D", "UI"
        COMPAT_ENGINES = set()

        def draw(self, context):
            pass

    def entry(self, context):
        pass

    before = state()
    with counted_draw_handlers() as left:
        bpy.utils.register_class(LTSH_PT_probe)
        bpy.types.Scene.ltsh_probe = bpy.props.IntProperty()
        bpy.app.handlers.load_post.append(entry)
        bpy.types.VIEW3D_MT_object.append(entry)
        LTSH_PT_probe.COMPAT_ENGINES.add("LTSH_PROBE")
        bpy.app.timers.register(entry, first_interval=1e6)
        handle = bpy.types.SpaceView3D.draw_handler_add(entry, (None, None), "WINDOW", "POST_PIXEL")
        found = difference(before, state())
        assert {"classes", "types", "properties", "handlers", "entries", "engines"} == set(found)
        assert not any(gone for gone, _ in found.values()) and len(left) == 2
        bpy.types.SpaceView3D.draw_handler_remove(handle, "WINDOW")
        bpy.app.timers.unregister(entry)
        LTSH_PT_probe.COMPAT_ENGINES.clear()
        bpy.types.VIEW3D_MT_object.remove(entry)
        bpy.app.handlers.load_post.remove(entry)
        del bpy.types.Scene.ltsh_probe
        bpy.utils.unregister_class(LTSH_PT_probe)
        assert left == []
    assert difference(before, state()) == {}


def test_disabling_takes_everything_back_also_the_second_time():
    before = state()
    with counted_draw_handlers() as left:
        for _ in range(2):
            ltsh_addon.register()
            assert difference(before, state()).keys() >= {"classes"}
            ltsh_addon.unregister()
            assert difference(before, state()) == {}
        assert left == []
    # What is not enabled can be disabled too.
    ltsh_addon.unregister()
    assert difference(before, state()) == {}


def test_a_new_version_can_replace_the_one_that_is_loaded():
    """Blender loads the modules of an updated add-on anew, beside old classes that nobody may use any more."""
    before = state()
    ltsh_addon.register()
    ltsh_addon.unregister()
    kept = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "ltsh_addon"}
    try:
        for name in kept:
            del sys.modules[name]
        fresh = importlib.import_module("ltsh_addon")
        assert fresh is not ltsh_addon
        fresh.register()
        fresh.unregister()
    finally:
        for name in [name for name in sys.modules if name.split(".")[0] == "ltsh_addon"]:
            del sys.modules[name]
        sys.modules.update(kept)
    assert difference(before, state()) == {}


def test_where_a_part_fails_nothing_stays(monkeypatch):
    """The error reaches Blender, which shows it and leaves the box unchecked."""
    before = state()
    monkeypatch.setattr(registration, "PARTS", (*registration.PARTS, "no_such_part"))
    with pytest.raises(ModuleNotFoundError, match="no_such_part"):
        ltsh_addon.register()
    assert difference(before, state()) == {}


def test_the_command_is_there_while_enabled(monkeypatch):
    commands = {}

    def add(name, function):
        commands[name] = function
        return name

    monkeypatch.setattr(bpy.utils, "register_cli_command", add)
    monkeypatch.setattr(bpy.utils, "unregister_cli_command", commands.pop)
    ltsh_addon.register()
    assert commands["ltsh"](["--version"]) == 0 and commands["ltsh"](["nonsense"]) == 2
    ltsh_addon.unregister()
    assert commands == {}
