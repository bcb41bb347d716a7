"""Adds LTSH to a running Blender: the command `blender [FILE] --command ltsh ...` and all of `PARTS`."""

import atexit
import importlib
from collections.abc import Callable
from contextlib import ExitStack

import bpy

from ..cli.progress import reserve_stdout

# Modules of this package: their CLASSES (by default all that they define), HANDLERS (pairs of a name and a function),
# register() and unregister(), as far as they have them. Each needs only those before it.
PARTS = (
    "ui.settings",
    "engine.settings",
    "engine.render",
    "engine.overlay",
    "ui.preview",
    "ui.operators",
    "ui.preflight",
    "ui.comparison",
    "ui.panels",
    "ui.mixer",
    "ui.gestures",
)

# Unregisters everything, last first, even if one part fails.
_registered = ExitStack()


def register(command_line: Callable[..., int]) -> None:
    """Register the command and all parts; `command_line` is `cli.main`."""

    def run(arguments: list[str]) -> int:
        if "--json" in arguments:
            reserve_stdout()
        return command_line(arguments, program="blender --command ltsh", open_file=bpy.data.filepath)

    with ExitStack() as added:
        added.callback(bpy.utils.unregister_cli_command, bpy.utils.register_cli_command("ltsh", run))
        for name in PARTS:
            part = importlib.import_module(f".{name}", __package__)
            for kind in getattr(part, "CLASSES", None) or _defined_in(part):
                bpy.utils.register_class(kind)
                added.callback(bpy.utils.unregister_class, kind)
            for event, function in getattr(part, "HANDLERS", ()):
                getattr(bpy.app.handlers, event).append(function)
                added.callback(_remove_handler, event, function)
            if hasattr(part, "register"):
                part.register()
                added.callback(part.unregister)
        _registered.push(added.pop_all())
    # Blender 4.5 hangs at exit if an engine is still registered.
    atexit.register(unregister)


def _defined_in(part) -> list[type]:
    """The classes for Blender that the module `part` defines, in their order."""
    kinds = [kind for kind in vars(part).values() if isinstance(kind, type) and hasattr(kind, "bl_rna")]
    return [kind for kind in kinds if kind.__module__ == part.__name__]


def _remove_handler(event: str, function: Callable) -> None:
    handlers = getattr(bpy.app.handlers, event)
    if function in handlers:
        handlers.remove(function)


def unregister() -> None:
    """Undo `register`."""
    from .ui import preflight

    atexit.unregister(unregister)
    preflight.missing_libraries.cache_clear()
    _registered.close()
