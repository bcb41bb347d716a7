"""The copy of the open file that final renders work on: unsaved changes count, and the artist's file is not written.

Blender runs `RenderEngine.render` in a thread of its own, where the file must not be saved; the handler of the start
of a render runs in the main thread.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..processes.child import SceneError
from .view_properties import ENGINE

_current: dict = {}


@contextlib.contextmanager
def _without_previews():
    """Meanwhile saving draws no thumbnail, which takes a render of its own."""
    paths = bpy.context.preferences.filepaths
    before = paths.file_preview_type
    try:
        paths.file_preview_type = "NONE"
        yield
    finally:
        paths.file_preview_type = before


@persistent
def _take(*_) -> None:
    """Save a copy where a scene of the file has our engine."""
    _drop()
    if all(scene.render.engine != ENGINE for scene in bpy.data.scenes):
        return
    folder = tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True)
    _current["folder"] = folder
    path = Path(folder.name) / "scene.blend"
    try:
        _current["saving"] = True
        with _without_previews():
            bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, check_existing=False, relative_remap=True)
    except RuntimeError as error:
        _current["error"] = " ".join(str(error).split()).removeprefix("Error: ")
    finally:
        _current.pop("saving")


@persistent
def _drop(*_) -> None:
    """Delete the copy."""
    folder = _current.pop("folder", None)
    _current.clear()
    if folder is not None:
        folder.cleanup()


def is_saving() -> bool:
    """True while the copy is written."""
    return "saving" in _current


def saved_copy() -> Path:
    """The copy of the file as it was when the render started. Raises SceneError."""
    if "error" in _current:
        raise SceneError(f"a copy of the open file could not be saved for the render: {_current['error']}")
    if "folder" not in _current:
        raise SceneError("no copy of the open file was saved for the render; start the render again")
    return Path(_current["folder"].name) / "scene.blend"


HANDLERS = (("render_init", _take), ("render_complete", _drop), ("render_cancel", _drop))


def register() -> None:
    """Add the handlers."""
    for name, function in HANDLERS:
        getattr(bpy.app.handlers, name).append(function)


def unregister() -> None:
    """Remove the handlers and the copy."""
    for name, function in HANDLERS:
        functions = getattr(bpy.app.handlers, name)
        if function in functions:
            functions.remove(function)
    _drop()
