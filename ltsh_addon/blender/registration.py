"""What LTSH adds to a running Blender: panels, operators, and the command `blender [FILE] --command ltsh ...`."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from . import (
    image_panels,
    operators,
    operators_fix,
    operators_view,
    overview,
    panels,
    probe,
    properties,
    settings_presets,
    viewer,
    wipe,
)

PARTS = (properties, operators, operators_fix, operators_view, overview, viewer, probe, wipe, settings_presets,
         panels, image_panels)  # fmt: skip

_handles = []


def register(command_line: Callable[..., int]) -> None:
    """Add everything; `command_line` is `cli.main`. `unregister` removes it."""

    def run(arguments: list[str]) -> int:
        return command_line(arguments, program="blender --command ltsh", open_file=bpy.data.filepath)

    for part in PARTS:
        part.register()
    _handles.append(bpy.utils.register_cli_command("ltsh", run))


def unregister() -> None:
    """Remove what `register` added."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
    for part in reversed(PARTS):
        part.unregister()
