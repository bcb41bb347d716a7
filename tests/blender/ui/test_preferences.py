"""Preferences: defaults, what they put into effect, what goes when the add-on is disabled; missing libraries."""

import logging
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

import ltsh_addon
from ltsh_addon.blender.ui import preflight, settings
from ltsh_addon.blender.ui.settings import Preferences, preferences
from ltsh_addon.workers import pool
from ltsh_addon.workers.pool import CORES_VARIABLE


def context_with(**chosen):
    """A context as of a Blender in which the add-on is enabled and some preferences were changed."""
    stored = {"cores": 0, "output_folder": "", "log_level": "WARNING", **chosen}
    addon = SimpleNamespace(preferences=SimpleNamespace(**stored))
    return SimpleNamespace(preferences=SimpleNamespace(addons={settings.ADDON: addon}))


@pytest.fixture
def enabled(monkeypatch):
    monkeypatch.setenv(CORES_VARIABLE, "6")
    ltsh_addon.register()
    yield
    ltsh_addon.unregister()


def test_without_being_enabled_there_are_defaults():
    assert settings.ADDON not in bpy.context.preferences.addons
    found = preferences(bpy.context)
    assert found == Preferences(0, settings.default_output_folder(), "WARNING")
    assert found.output_folder.is_absolute()


def test_defaults_are_those_of_the_registered_properties(enabled):
    properties = settings.LTSH_AddonPreferences.bl_rna.properties
    stored = {name: properties[name].default for name in ("cores", "output_folder", "log_level")}
    assert preferences(context_with(**stored)) == preferences(bpy.context)


def test_an_output_folder_beside_the_file_is_made_absolute(tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    found = preferences(context_with(output_folder="//results", cores=3, log_level="DEBUG"))
    assert found == Preferences(3, tmp_path / "results", "DEBUG")
    bpy.ops.wm.read_homefile(use_empty=True)


def test_the_folder_of_an_extension_is_the_one_that_updates_keep(monkeypatch):
    monkeypatch.setattr(settings, "ADDON", "bl_ext.user_default.ltsh")
    parts = Path(settings.default_output_folder()).parts
    assert parts[-5:] == ("extensions", ".user", "user_default", "ltsh", "results")


def test_the_limit_of_cores_reaches_this_process_and_its_children_until_disabled(enabled, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(8), raising=False)
    assert pool.cores() == 6
    settings.apply(context_with(cores=3))
    assert (pool.cores(), os.environ[CORES_VARIABLE]) == (3, "3")
    settings.apply(context_with(cores=100))
    assert pool.cores() == 8
    ltsh_addon.unregister()
    assert os.environ[CORES_VARIABLE] == "6"


@pytest.mark.parametrize("value", ["0", "", "-2", "many", "1e3"])
def test_a_limit_of_cores_that_makes_no_sense_is_none(monkeypatch, value):
    monkeypatch.delenv(CORES_VARIABLE, raising=False)
    unlimited = pool.cores()
    monkeypatch.setenv(CORES_VARIABLE, value)
    assert pool.cores() == unlimited >= 1


def test_the_log_level_decides_what_is_told(enabled, capsys):
    logger = logging.getLogger("ltsh_addon.workers.pool")
    (handler,) = logging.getLogger("ltsh_addon").handlers
    handler.setStream(sys.stderr)
    for level, told in (("WARNING", False), ("INFO", True), ("ERROR", False)):
        settings.apply(context_with(log_level=level))
        logger.info("a block is done")
        assert ("LTSH INFO: a block is done" in capsys.readouterr().err) is told
    ltsh_addon.unregister()
    assert logging.getLogger("ltsh_addon").handlers == [] and logging.getLogger("ltsh_addon").level == logging.NOTSET


def test_a_missing_library_is_named_with_what_to_do(monkeypatch):
    preflight.missing_libraries.cache_clear()
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    message = preflight.missing_libraries()
    assert "\n" not in message and "OpenEXR" in message and "install" in message and "Python 3." in message
    # A panel asks at every redraw: the answer stays until the add-on is enabled again.
    monkeypatch.undo()
    assert preflight.missing_libraries() == message
    ltsh_addon.register()
    ltsh_addon.unregister()
    assert preflight.missing_libraries() is None
