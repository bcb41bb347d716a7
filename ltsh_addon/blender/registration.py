"""What LTSH adds to a running Blender: the command `blender [FILE] --command ltsh ...`."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from . import standard_output

_handles = []


def register(command_line: Callable[..., int]) -> None:
    """Add everything; `command_line` is `cli.main`. `unregister` removes it."""

    def run(arguments: list[str]) -> int:
        if "--json" in arguments:
            standard_output.reserve()
        return command_line(arguments, program="blender --command ltsh", open_file=bpy.data.filepath)

    _handles.append(bpy.utils.register_cli_command("ltsh", run))


def unregister() -> None:
    """Remove what `register` added."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
