"""The button "Preview with LTSH": what it gives back to scenes, views and files."""

import bpy
import pytest
import scene_parts

import ltsh_addon
from ltsh_addon.blender.ui import preview


def test_files_saved_during_a_preview_keep_the_artists_engine(addon, tmp_path):
    addon.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.ltsh.preview()
    path = scene_parts.save(tmp_path / "previewed.blend")
    assert addon.render.engine == "LTSH" and addon.ltsh_view.artist_engine == "BLENDER_WORKBENCH"
    bpy.ops.wm.open_mainfile(filepath=str(path))
    scene = bpy.context.scene
    assert scene.render.engine == "BLENDER_WORKBENCH" and not scene.ltsh_view.artist_engine
    bpy.ops.ltsh.preview()
    bpy.ops.ltsh.preview()
    assert scene.render.engine == "BLENDER_WORKBENCH"


@pytest.fixture
def views(addon):
    """The 3D view that the button takes; a second one beside it shows Rendered already."""
    all_views = [area.spaces.active for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
    first = next(area.spaces.active for area in bpy.context.screen.areas if area.type == "VIEW_3D")
    other = next(space for space in all_views if space != first)
    before = first.shading.type, other.shading.type
    first.shading.type, other.shading.type = "WIREFRAME", "RENDERED"
    yield first, other
    first.shading.type, other.shading.type = before


def shading(views):
    return [space.shading.type for space in views]


def test_ending_a_preview_gives_its_view_back_and_no_other(addon, views):
    addon.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.ltsh.preview()
    assert shading(views) == ["RENDERED", "RENDERED"]
    bpy.ops.ltsh.preview()
    assert shading(views) == ["WIREFRAME", "RENDERED"]
    bpy.ops.ltsh.preview()
    # Solid view meanwhile is the artist's choice.
    views[0].shading.type = "SOLID"
    bpy.ops.ltsh.preview()
    assert shading(views) == ["SOLID", "RENDERED"]


def test_undo_of_a_preview_gives_the_view_back(addon, views):
    addon.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.ed.undo_push(message="Before")
    bpy.ops.ltsh.preview()
    bpy.ops.ed.undo_push(message="Preview")
    assert bpy.ops.ed.undo() == {"FINISHED"}
    assert bpy.context.scene.render.engine == "BLENDER_WORKBENCH" and shading(views) == ["WIREFRAME", "RENDERED"]


def test_disabling_the_add_on_gives_the_view_back(addon, views):
    addon.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.ltsh.preview()
    ltsh_addon.unregister()
    try:
        assert addon.render.engine == "BLENDER_WORKBENCH" and shading(views) == ["WIREFRAME", "RENDERED"]
    finally:
        ltsh_addon.register()


def test_files_saved_during_a_preview_keep_the_shading(addon, views, tmp_path):
    addon.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.ltsh.preview()
    seen = []
    bpy.app.handlers.save_pre.append(lambda *_: seen.append(shading(views)))
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "previewed.blend"))
    finally:
        bpy.app.handlers.save_pre.pop()
    assert seen == [["WIREFRAME", "RENDERED"]] and shading(views) == ["RENDERED", "RENDERED"]


def test_an_engine_chosen_by_hand_is_not_taken_for_a_preview(addon, tmp_path):
    addon.render.engine = "LTSH"
    bpy.ops.ltsh.preview()
    assert addon.render.engine == "LTSH" and not addon.ltsh_view.artist_engine
    path = scene_parts.save(tmp_path / "own.blend")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert bpy.context.scene.render.engine == "LTSH"


def test_another_engine_chosen_by_hand_ends_the_preview(addon):
    addon.render.engine = "BLENDER_WORKBENCH"
    bpy.ops.ltsh.preview()
    preview._engine_changed()
    assert addon.ltsh_view.artist_engine == "BLENDER_WORKBENCH"
    addon.render.engine = "CYCLES"
    # Blender calls it between two events, of which there are none here.
    preview._engine_changed()
    addon.render.engine = "LTSH"
    assert not preview.is_previewing(addon)
