"""Saving a .blend whole or not at all (runs in the child): where the disk is full Blender may say nothing."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from .blender_process import SceneError

# What a compressed .blend ends with (Zstandard seekable format 0.1.1, facebook/zstd, contrib/seekable_format).
SEEK_TABLE_END = bytes.fromhex("b1ea928f")


def save_copy(path: Path, **options) -> None:
    """Save a compressed copy of the open file as `path`; `options` are those of `bpy.ops.wm.save_as_mainfile`. Raises
    SceneError, which names the folder, where it cannot be saved whole."""
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, compress=True, **options)
    except RuntimeError as error:
        path.with_name(f"{path.name}@").unlink(missing_ok=True)
        reason = " ".join(str(error).split()).removeprefix("Error: ")
        raise SceneError(f"{path.parent}: Blender cannot save there: {reason}") from error
    check_whole(path)


def check_whole(path: Path) -> None:
    """Raise SceneError where the end of the compressed .blend is missing."""
    with path.open("rb") as file:
        file.seek(-min(len(SEEK_TABLE_END), path.stat().st_size), os.SEEK_END)
        if file.read() != SEEK_TABLE_END:
            raise SceneError(f"{path.parent}: Blender could not save the whole .blend there; is the disk full?")
