"""The button "Preview with LTSH": what it gives back to scenes, views and files."""

import random

import bpy
import pytest
import scene_parts

import ltsh_addon
from ltsh_addon.blender.saving import save_working_copy
from ltsh_addon.blender.ui import preview

ARTISTS = "BLENDER_WORKBENCH"


@pytest.fixture
def views(addon):
    """The 3D view that the button takes; a second one beside it shows Rendered already."""
    addon.render.engine = ARTISTS
    all_views = [area.spaces.active for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
    first = next(area.spaces.active for area in bpy.context.screen.areas if area.type == "VIEW_3D")
    other = next(space for space in all_views if space != first)
    before = first.shading.type, other.shading.type
    first.shading.type, other.shading.type = "WIREFRAME", "RENDERED"
    yield first, other
    first.shading.type, other.shading.type = before


def shading(views):
    return [space.shading.type for space in views]


@pytest.mark.parametrize("end", [lambda: bpy.ops.ltsh.preview(), ltsh_addon.unregister])
def test_ending_a_preview_gives_its_view_back_and_no_other(views, end):
    bpy.ops.ltsh.preview()
    assert shading(views) == ["RENDERED", "RENDERED"]
    end()
    assert bpy.context.scene.render.engine == ARTISTS and shading(views) == ["WIREFRAME", "RENDERED"]


@pytest.mark.parametrize("seed", range(3))
def test_undo_and_redo_leave_the_preview_as_it_is(views, seed):
    """A walk of edits, undo, redo and clicks on the button, beside a list of what each step of undo has."""
    chosen, on, at = random.Random(seed), False, -1
    scene_parts.link(scene_parts.new_light("Key", "AREA"))
    steps = []  # energy and engine of the artist
    kinds = ["edit", "engine", "preview", "preview", *3 * ["undo", "redo"]]
    for number, kind in enumerate(["edit", "engine", "edit", "preview", *chosen.choices(kinds, k=60)]):
        scene, light = bpy.context.scene, bpy.data.lights["Key"]
        if kind == "preview":
            bpy.ops.ltsh.preview()
            on = not on
        elif kind in ("edit", "engine"):
            light.energy = number
            if kind == "engine" and not on:
                scene.render.engine = chosen.choice(["CYCLES", ARTISTS])
            engine = scene.ltsh_view.artist_engine if on else scene.render.engine
            del steps[at + 1 :]
            at = len(steps)
            steps.append((number, engine))
            bpy.ops.ed.undo_push(message=kind)
        elif 0 <= at + (move := 1 if kind == "redo" else -1) < len(steps):
            at += move
            assert getattr(bpy.ops.ed, kind)() == {"FINISHED"}
        scene, energy, engine = bpy.context.scene, *steps[at]
        assert bpy.data.lights["Key"].energy == energy
        assert scene.render.engine == ("LTSH" if on else engine), (number, kind)
        assert shading(views) == ["RENDERED" if on else "WIREFRAME", "RENDERED"], (number, kind)
        assert preview.is_previewing(scene) == on and scene.ltsh_view.artist_engine == (engine if on else "")


def test_a_view_that_is_changed_during_a_preview_is_the_artists_choice(views):
    bpy.ops.ltsh.preview()
    views[0].shading.type = "SOLID"
    bpy.ops.ltsh.preview()
    assert shading(views) == ["SOLID", "RENDERED"]


def test_views_that_are_opened_during_a_preview_end_with_it(views):
    """As a new window or a split area: of such a view nobody knows what it showed before."""
    bpy.ops.ltsh.preview()
    del preview._former_shading[bpy.context.scene.session_uid][views[1].as_pointer()]
    bpy.ops.ltsh.preview()
    assert shading(views) == ["WIREFRAME", "WIREFRAME"]


def test_another_file_in_the_same_windows_gives_the_views_back(views, tmp_path):
    path = scene_parts.save(tmp_path / "other.blend")
    bpy.ops.ltsh.preview()
    bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    assert preview.view_of(bpy.context).shading.type == "WIREFRAME" and not preview._former_shading


def test_a_file_that_blender_saved_by_itself_during_a_preview_opens_without_it(addon, tmp_path):
    """Auto Save writes the state of the last step of undo, which has the engine of the preview."""
    addon.render.engine, addon.ltsh_view.artist_engine = "LTSH", ARTISTS
    path = tmp_path / "auto.blend"
    save_working_copy(path, keep_engine=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert bpy.context.scene.render.engine == ARTISTS and not preview.is_previewing(bpy.context.scene)


def test_files_saved_during_a_preview_keep_engine_and_shading(addon, views, tmp_path):
    bpy.ops.ltsh.preview()
    seen = []
    bpy.app.handlers.save_pre.append(lambda *_: seen.append(shading(views)))
    try:
        path = scene_parts.save(tmp_path / "previewed.blend")
    finally:
        bpy.app.handlers.save_pre.pop()
    assert seen == [["WIREFRAME", "RENDERED"]] and shading(views) == ["RENDERED", "RENDERED"]
    assert addon.render.engine == "LTSH" and addon.ltsh_view.artist_engine == ARTISTS
    bpy.ops.wm.open_mainfile(filepath=str(path))
    scene = bpy.context.scene
    assert scene.render.engine == ARTISTS and not scene.ltsh_view.artist_engine


def test_an_engine_chosen_by_hand_is_not_taken_for_a_preview(addon, tmp_path):
    addon.render.engine = "LTSH"
    bpy.ops.ltsh.preview()
    assert addon.render.engine == "LTSH" and not addon.ltsh_view.artist_engine
    path = scene_parts.save(tmp_path / "own.blend")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert bpy.context.scene.render.engine == "LTSH"


def test_another_engine_chosen_by_hand_ends_the_preview(addon, views):
    bpy.ops.ltsh.preview()
    preview._engine_changed()
    assert addon.ltsh_view.artist_engine == ARTISTS
    addon.render.engine = "CYCLES"
    # Blender calls it between two events, of which there are none here.
    preview._engine_changed()
    addon.render.engine = "LTSH"
    assert not preview.is_previewing(addon)
