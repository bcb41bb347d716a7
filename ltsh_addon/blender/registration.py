"""What LTSH adds to a running Blender: the command `blender [FILE] --command ltsh ...`."""

from __future__ import annotations

import bpy

_handles = []


def _run_command(arguments: list[str]) -> int:
    from .. import cli

    return cli.main(arguments, program="blender --command ltsh", open_file=bpy.data.filepath)


def register() -> None:
    """Add everything; `unregister` removes it."""
    _handles.append(bpy.utils.register_cli_command("ltsh", _run_command))


def unregister() -> None:
    """Remove what `register` added."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
