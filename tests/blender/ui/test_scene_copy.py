"""The copy of the open file that a job works on: quick, whole, and nothing else has changed afterwards."""

import bpy
import numpy as np
import pytest

from ltsh_addon.blender import saving
from ltsh_addon.blender.ui import comparison


@pytest.fixture
def preferences(addon, tmp_path):
    """Blender's own, with the add-on and a saved file; as they were afterwards."""
    found = bpy.context.preferences
    before = found.filepaths.file_preview_type, found.is_dirty
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    found.filepaths.file_preview_type, found.is_dirty = "CAMERA", False
    yield found
    found.filepaths.file_preview_type, found.is_dirty = before


@pytest.fixture
def seen():
    """What handlers see while a file is saved: the kind of thumbnail, and the sizes of images."""
    found = []

    @bpy.app.handlers.persistent
    def look(*_):
        sizes = {image.name: tuple(image.size) for image in bpy.data.images}
        found.append((bpy.context.preferences.filepaths.file_preview_type, sizes))

    # After the add-on's own handler.
    bpy.app.handlers.save_pre.append(look)
    yield found
    bpy.app.handlers.save_pre.remove(look)


def test_no_thumbnail_is_drawn_and_the_preferences_stay(preferences, seen, tmp_path):
    bpy.context.scene.frame_current = 7
    saving.save_working_copy(tmp_path / "copy.blend")
    assert [kind for kind, _ in seen] == ["NONE"]
    assert preferences.filepaths.file_preview_type == "CAMERA" and not preferences.is_dirty
    assert bpy.data.filepath == str(tmp_path / "room.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "copy.blend"))
    assert bpy.context.scene.frame_current == 7


@pytest.mark.parametrize("unsaved", [True, False])
def test_the_preferences_stay_where_the_copy_cannot_be_saved(preferences, tmp_path, unsaved):
    preferences.is_dirty = unsaved
    with pytest.raises(RuntimeError):
        saving.save_working_copy(tmp_path / "missing" / "copy.blend")
    assert preferences.filepaths.file_preview_type == "CAMERA" and preferences.is_dirty == unsaved
    assert not saving.is_working_copy()


def test_pictures_of_results_are_not_made_again(preferences, seen, tmp_path, monkeypatch):
    monkeypatch.setattr(comparison.results, "result_of", lambda scene: object())
    monkeypatch.setattr(comparison, "refresh", lambda scene: refreshed.append(scene))
    refreshed, image = [], comparison.viewer_image(bpy.context.scene)
    comparison._store(image, np.ones((8, 6, 4), np.float32), True)
    saving.save_working_copy(tmp_path / "copy.blend")
    assert seen[-1][1][image.name] == (6, 8) == tuple(image.size) and not refreshed
    # A file for people holds none of what can be made again.
    bpy.ops.wm.save_mainfile()
    assert seen[-1][1][image.name] == (4, 4) and refreshed == [bpy.context.scene]
