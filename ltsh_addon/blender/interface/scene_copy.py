"""A copy of the open file for a second Blender. The window waits for it, so nothing is made that is only for people."""

from __future__ import annotations

import contextlib
from pathlib import Path

import bpy

from . import viewer


def save_scene_copy(path: Path) -> None:
    """Save the open file, unsaved changes included, as `path`. Raises RuntimeError."""
    with _without_previews(), viewer.kept_as_it_is():
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, compress=False, check_existing=False)


@contextlib.contextmanager
def _without_previews():
    """Meanwhile saving draws no thumbnail: that is a render of its own, many times as long as the writing."""
    preferences = bpy.context.preferences
    before, unsaved = preferences.filepaths.file_preview_type, preferences.is_dirty
    try:
        preferences.filepaths.file_preview_type = "NONE"
        yield
    finally:
        preferences.filepaths.file_preview_type, preferences.is_dirty = before, unsaved
