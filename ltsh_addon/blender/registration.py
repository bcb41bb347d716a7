"""What LTSH adds to a running Blender: the command `blender [FILE] --command ltsh ...` and the render engine."""

from __future__ import annotations

import atexit
from collections.abc import Callable

import bpy

from . import engine, engine_panels, engine_preview, split_gizmo, view_properties

# Each has register() and unregister(); removed in reverse order.
MODULES = (view_properties, engine, engine_panels, engine_preview, split_gizmo)
_handles = []
_registered = []


def register(command_line: Callable[..., int]) -> None:
    """Add everything; `command_line` is `cli.main`. `unregister` removes it."""

    def run(arguments: list[str]) -> int:
        return command_line(arguments, program="blender --command ltsh", open_file=bpy.data.filepath)

    _handles.append(bpy.utils.register_cli_command("ltsh", run))
    for module in MODULES:
        module.register()
        _registered.append(module)
    # Blender 4.5 hangs at exit when an engine is still registered.
    atexit.register(unregister)


def unregister() -> None:
    """Remove what `register` added."""
    atexit.unregister(unregister)
    while _registered:
        _registered.pop().unregister()
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
