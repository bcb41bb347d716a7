"""Copies of the open file: compressed and checked for completeness, or quickly for a second Blender."""

import contextlib
import os
from pathlib import Path

import bpy

from ..scene import SceneError, error_line

# The last bytes of a compressed .blend (Zstandard seekable format 0.1.1, facebook/zstd, contrib/seekable_format).
SEEK_TABLE_END = bytes.fromhex("b1ea928f")

_state = {"keeps engine": False, "is working copy": False}


def save_working_copy(path: Path, *, keep_engine: bool = False) -> None:
    """Save the open file, unsaved changes included, as `path` for a second Blender. Raises RuntimeError.

    Even during a preview a file is saved with the artist's engine; `keep_engine` saves the engine in use.
    """
    with _without_thumbnail():
        _state.update({"keeps engine": keep_engine, "is working copy": True})
        try:
            bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, compress=False, check_existing=False)
        finally:
            _state.update({"keeps engine": False, "is working copy": False})


def is_working_copy() -> bool:
    """True while a copy is being saved that no artist opens."""
    return _state["is working copy"]


def keeps_engine() -> bool:
    """True while a copy is being saved with the engine in use."""
    return _state["keeps engine"]


@contextlib.contextmanager
def _without_thumbnail():
    """Within this context saving draws no thumbnail, whose render takes many times as long as the writing."""
    preferences = bpy.context.preferences
    before, unsaved = preferences.filepaths.file_preview_type, preferences.is_dirty
    try:
        preferences.filepaths.file_preview_type = "NONE"
        yield
    finally:
        preferences.filepaths.file_preview_type, preferences.is_dirty = before, unsaved


def save_copy(path: Path, **options) -> None:
    """Save a compressed copy of the open file as `path`; `options` are those of `bpy.ops.wm.save_as_mainfile`.

    Raises SceneError, which names the folder, if it cannot be saved completely.
    """
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, compress=True, **options)
    except RuntimeError as error:
        path.with_name(f"{path.name}@").unlink(missing_ok=True)
        reason = error_line(error).removeprefix("Error: ")
        raise SceneError(f"{path.parent}: Blender cannot save there: {reason}") from error
    check_whole(path)


def check_whole(path: Path) -> None:
    """Raise SceneError if the end of the compressed .blend `path` is missing."""
    with path.open("rb") as file:
        file.seek(-min(len(SEEK_TABLE_END), path.stat().st_size), os.SEEK_END)
        if file.read() != SEEK_TABLE_END:
            raise SceneError(f"{path.parent}: Blender could not save the whole .blend there; is the disk full?")
