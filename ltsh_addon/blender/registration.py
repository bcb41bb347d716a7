"""What LTSH adds to a running Blender: the command `blender [FILE] --command ltsh ...` and all of `PARTS`."""

from __future__ import annotations

import atexit
import importlib
from collections.abc import Callable
from contextlib import ExitStack

import bpy

from ..cli.progress import reserve_stdout

# Modules of this package with register() and unregister(), in the order in which they need each other.
PARTS = (
    "ui.settings",
    "engine.settings",
    "engine.render",
    "ui.preview",
    "ui.operators",
    "ui.preflight",
    "ui.comparison",
    "ui.panels",
    "ui.mixer",
)

# Takes back what is registered, last first; one that fails does not keep the others from it.
_registered = ExitStack()


def register(command_line: Callable[..., int]) -> None:
    """Add everything; `command_line` is `cli.main`. `unregister` removes it."""

    def run(arguments: list[str]) -> int:
        if "--json" in arguments:
            reserve_stdout()
        return command_line(arguments, program="blender --command ltsh", open_file=bpy.data.filepath)

    with ExitStack() as added:
        added.callback(bpy.utils.unregister_cli_command, bpy.utils.register_cli_command("ltsh", run))
        for name in PARTS:
            part = importlib.import_module(f".{name}", __package__)
            part.register()
            added.callback(part.unregister)
        _registered.push(added.pop_all())
    # Blender 4.5 hangs at exit when an engine is still registered.
    atexit.register(unregister)


def unregister() -> None:
    """Remove what `register` added."""
    from .ui import preflight

    atexit.unregister(unregister)
    preflight.missing_libraries.cache_clear()
    _registered.close()
