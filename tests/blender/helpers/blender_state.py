"""What add-ons can add to a running Blender, as text that can be compared before and after."""

import contextlib
import logging
import os
import sys

import bpy

_REGISTRABLE = ("Panel", "Operator", "Menu", "Header", "UIList", "PropertyGroup", "AddonPreferences", "RenderEngine",
                "Gizmo", "GizmoGroup", "KeyingSetInfo", "Node", "NodeTree", "NodeSocket", "FileHandler", "AssetShelf",
                "WorkSpaceTool")  # fmt: skip
_DRAWN = (bpy.types.Panel, bpy.types.Menu, bpy.types.Header)


def _subclasses(base) -> list[type]:
    found = []
    for child in base.__subclasses__():
        found += [child, *_subclasses(child)]
    return found


def _types_of_blender(base) -> list[type]:
    """Blender makes classes when they are asked for by name: `__subclasses__` knows those alone."""
    kinds = [getattr(bpy.types, name) for name in dir(bpy.types)]
    return [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, base)]


def _label(function) -> str:
    return f"{getattr(function, '__module__', '?')}.{getattr(function, '__qualname__', function)}"


def state() -> dict[str, list[str]]:
    """Kind -> sorted names of what is there: classes, properties, handlers, entries of menus and panels, and so on."""
    registered = [
        kind
        for name in _REGISTRABLE
        if hasattr(bpy.types, name)
        for kind in _subclasses(getattr(bpy.types, name))
        # Classes of Blender itself appear when somebody asks for them.
        if getattr(kind, "is_registered", False) and kind.__module__ != "bpy.types"
    ]
    owners = [*_types_of_blender(bpy.types.ID), bpy.types.WindowManager, bpy.types.Bone, bpy.types.PoseBone]
    drawn = [kind for kind in registered if issubclass(kind, _DRAWN)]
    return {
        "classes": sorted(f"{kind.__module__}.{kind.__qualname__}" for kind in registered),
        "types": sorted(dir(bpy.types)),
        "properties": sorted(
            f"{owner.__name__}.{item.identifier}"
            for owner in owners
            for item in owner.bl_rna.properties
            if item.is_runtime
        ),
        "handlers": sorted(
            f"{name}: {_label(function)}"
            for name in dir(bpy.app.handlers)
            if isinstance(functions := getattr(bpy.app.handlers, name), list)
            for function in functions
        ),
        "entries": sorted(
            f"{kind.__name__}: {_label(function)}"
            for kind in drawn
            for function in getattr(getattr(kind, "draw", None), "_draw_funcs", ())
            if function.__qualname__ != f"{kind.__name__}.draw"
        ),
        "engines": sorted(
            # A class that is no longer registered may keep its own list: nobody sees it.
            f"{kind.__name__}: {engine}"
            for kind in drawn
            if getattr(kind, "is_registered", False)
            for engine in _engines(kind)
        ),
        "shortcuts": sorted(
            f"{keymap.name}: {item.idname}"
            for configuration in [bpy.context.window_manager.keyconfigs.addon]
            if configuration is not None
            for keymap in configuration.keymaps
            for item in keymap.keymap_items
        ),
        "environment": sorted(f"{name}={value}" for name, value in os.environ.items() if name.startswith("LTSH")),
        "loggers": sorted(
            f"{name}: {item.level} {item.handlers} {item.propagate}"
            for name, item in logging.Logger.manager.loggerDict.items()
            if isinstance(item, logging.Logger) and "ltsh_addon" in name and (item.level or item.handlers)
        ),
        "paths": list(sys.path),
    }


def _engines(kind) -> set[str]:
    engines = getattr(kind, "COMPAT_ENGINES", ())
    return engines if isinstance(engines, set) else set()


def difference(before: dict, after: dict) -> dict[str, tuple[list[str], list[str]]]:
    """Kind -> (what is gone, what is new), of those that changed."""
    return {
        kind: ([item for item in before[kind] if item not in after[kind]],
               [item for item in after[kind] if item not in before[kind]])
        for kind in before
        if before[kind] != after[kind]
    }  # fmt: skip


@contextlib.contextmanager
def counted_draw_handlers():
    """A list of what was added to editors as draw handlers and what runs by timers, and not taken back."""
    left: list = []
    timers = bpy.app.timers
    originals = [(timers, "register", timers.register), (timers, "unregister", timers.unregister)]
    for kind in _types_of_blender(bpy.types.Space):
        if hasattr(kind, "draw_handler_add"):
            originals += [(kind, name, getattr(kind, name)) for name in ("draw_handler_add", "draw_handler_remove")]

    def adding(original):
        def add(function, *arguments, **options):
            handle = original(function, *arguments, **options)
            left.append((function, handle))
            return handle

        return add

    def removing(original):
        def remove(key, *arguments):
            left[:] = [item for item in left if key not in item]
            return original(key, *arguments)

        return remove

    for owner, name, original in originals:
        wrap = adding if name in ("register", "draw_handler_add") else removing
        setattr(owner, name, wrap(original) if owner is timers else staticmethod(wrap(original)))
    try:
        yield left
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original if owner is timers else staticmethod(original))
