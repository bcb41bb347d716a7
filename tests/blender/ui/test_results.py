"""Results as images: wipe, difference, numbers, presets, the manual."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from job_window import image_pixels

from ltsh_addon import imaging
from ltsh_addon.blender.engine import overlay
from ltsh_addon.blender.ui import comparison, operators, results
from ltsh_addon.blender.ui import settings as settings_module
from ltsh_addon.blender.ui.overlay import INK, PLATE, label_places
from ltsh_addon.imaging.color import signed_error_colors
from ltsh_addon.scene import COMPARED_TECHNIQUES, DEFAULT_TECHNIQUE

HEIGHT, WIDTH = 6, 10
PICTURES = ("ltc", "ltsh4c", "cycles")


def seen():
    return image_pixels("LTSH Comparison")


@pytest.fixture
def pictures(addon, tmp_path, show_results):
    """Results that are shown, in the folder of a saved file."""
    parts.save(tmp_path / "room.blend")
    return show_results(addon, tmp_path)


@pytest.fixture
def scene(addon, pictures):
    return addon


def test_left_of_the_line_is_the_first_picture_and_right_the_second(scene, pictures):
    """A dragged line is seen before the settings know it."""
    for split, columns in ((0.0, 0), (0.3, 3), (1.0, WIDTH)):
        expected = pictures["cycles.combined"].copy()
        expected[:, :columns] = pictures["ltsh4c.combined"][:, :columns]
        scene.ltsh.split = split
        np.testing.assert_array_equal(seen(), expected)
        scene.ltsh.split = 0.5
        comparison.drag_split(scene, split)
        np.testing.assert_array_equal(seen(), expected)
        assert scene.ltsh.split == 0.5 and comparison.split_of(scene) == split
        comparison.drag_split(scene, None)
        assert comparison.split_of(scene) == 0.5


def test_moving_the_line_reads_no_file_again(scene):
    scene.ltsh.split = 0.2
    images = [image for image in results.our_images(scene) if not comparison.is_viewer(image)]
    for image in images:
        image.pixels[0] = 7.0  # which is gone when Blender reads the file
    scene.ltsh.split = 0.8
    assert images and all(image.pixels[0] == 7.0 for image in images)


def test_changing_technique_and_pass_changes_the_picture_at_once(scene, pictures):
    scene.ltsh.mode = "A"
    for name in PICTURES:
        for part in ("specular", "diffuse", "combined"):
            scene.ltsh.first, scene.ltsh.pass_name = name, part
            np.testing.assert_array_equal(seen(), pictures[f"{name}.{part}"])


def test_side_by_side_and_swapped(scene, pictures):
    scene.ltsh.mode = "SIDE"
    sides = [pictures["ltsh4c.combined"], pictures["cycles.combined"]]
    np.testing.assert_array_equal(seen(), np.concatenate(sides, axis=1))
    bpy.ops.ltsh.swap()
    np.testing.assert_array_equal(seen(), np.concatenate(sides[::-1], axis=1))


def test_the_difference_has_the_colors_of_the_sheet(scene, pictures):
    """Blender shows linear values; through the sRGB curve they are those of imaging.color."""
    scene.ltsh.mode, scene.ltsh.error_scale = "ERROR", 2.0
    image = bpy.data.images["LTSH Comparison"]
    assert not image.use_view_as_render
    weights = np.array([0.2126, 0.7152, 0.0722])
    difference = (pictures["ltsh4c.combined"] - pictures["cycles.combined"]) @ weights
    linear = seen().astype(np.float64)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    # The colors stand in a table of 1023 steps of the whole range.
    assert np.abs(shown - signed_error_colors(difference, 2.0)).max() < 0.01
    red = difference > 1.0
    assert red.any() and (linear[red][:, 0] > linear[red][:, 2]).all()
    scene.ltsh.mode = "WIPE"
    assert image.use_view_as_render


def result_and_choice(scene):
    result = results.result_of(scene)
    return result, results.choice_of(scene.ltsh, result)


def test_the_scale_of_the_difference_is_that_of_the_results_or_the_artists(scene):
    result, choice = result_and_choice(scene)
    group = result.groups[""]
    assert comparison.error_scale(scene.ltsh, group, choice) == group["scales"]["combined"] > 0.0
    scene.ltsh.error_scale = 0.25
    assert comparison.error_scale(scene.ltsh, group, choice) == 0.25


def test_saving_and_loading_keep_what_is_shown_and_nothing_large(scene, tmp_path):
    scene.ltsh.mode, scene.ltsh.first = "WIPE", "ltc"
    before = seen().copy()
    path = parts.save(tmp_path / "room.blend")
    np.testing.assert_array_equal(seen(), before)
    comparison.settle()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert bpy.context.scene.ltsh.first == "ltc"
    np.testing.assert_array_equal(seen(), before)
    # Pictures are read from the folder of the results: moved with it, they are found.
    assert bpy.context.scene.ltsh.result_folder.startswith("//")
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    (tmp_path / "ltsh").rename(moved / "ltsh")
    bpy.ops.wm.open_mainfile(filepath=str(path.rename(moved / "room.blend")))
    np.testing.assert_array_equal(seen(), before)


def test_another_file_gets_nothing_of_what_was_shown_before(addon, tmp_path, show_results):
    """Its scene has the same name, and the picture had changed just before."""
    parts.save(tmp_path / "room.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"), copy=True)
    show_results(addon, tmp_path)
    addon.ltsh.split = 0.25
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other.blend"))
    assert not [image.name for image in bpy.data.images if comparison.is_viewer(image)]


def test_new_results_replace_the_old_pictures(scene, tmp_path, show_results):
    pictures = show_results(scene, tmp_path, seed=2)
    scene.ltsh.mode = "A"
    np.testing.assert_array_equal(seen(), pictures["ltsh4c.combined"])
    assert len([image for image in bpy.data.images if image.name.startswith("LTSH ltsh4c")]) == 1


@pytest.mark.parametrize("damage", ["folder gone", "picture gone", "index broken"])
def test_results_that_vanish_do_no_harm(scene, tmp_path, damage):
    folder = tmp_path / "ltsh" / "compare" / "images"
    if damage == "folder gone":
        (tmp_path / "ltsh").rename(tmp_path / "gone")
    elif damage == "picture gone":
        (folder / "ltc.specular.exr").unlink()
    else:
        (folder / "index.json").write_text('{"command": ')
    # Setting a property would print the error of its update function, which nobody can catch.
    scene.ltsh["first"], scene.ltsh["pass_name"] = 1, 1
    comparison.changed(scene.ltsh, bpy.context)
    if damage != "picture gone":
        assert results.result_of(scene) is None and not bpy.ops.ltsh.swap.poll()
        with pytest.raises(RuntimeError, match="There are no results yet"):
            bpy.ops.ltsh.swap()
        with pytest.raises(RuntimeError, match="holds no results: run the command first"):
            bpy.ops.ltsh.show_results(command="compare")


def test_two_scenes_have_results_of_their_own(scene, tmp_path, show_results):
    first = seen().copy()
    other = bpy.data.scenes.new("Other")
    pictures = show_results(other, tmp_path / "other", seed=3)
    np.testing.assert_array_equal(seen(), first)
    image = comparison.viewer_image(other)
    assert image.name == "LTSH Comparison.001"
    assert abs(image.pixels[0] - pictures["ltsh4c.combined"][-1, 0, 0]) == 0.0


def test_figures_of_passes_that_the_report_lacks_are_measured(scene, tmp_path):
    """The report here has none at all: relative L2 by its definition, from both halves of Cycles."""
    index = json.loads((tmp_path / "ltsh" / "compare" / "images" / "index.json").read_text())
    layers = imaging.read_layers(tmp_path / "ltsh" / "compare" / "compare.exr")
    row = index["groups"][""]["figures"]["specular"]["techniques"]["ltsh4c"]
    halves = [layers[f"cycles_{half}.specular"].astype(np.float64) for half in "AB"]
    technique = layers["ltsh4c.specular"]
    squared = ((technique - halves[0]) * (technique - halves[1])).sum() / (halves[0] * halves[1]).sum()
    assert row["unbiased_squared_error"] == pytest.approx(squared, rel=1e-6)
    assert 0.0 < row["flip"] < 1.0


@pytest.mark.parametrize(
    ("corners", "places"),
    [
        ((100.0, 200.0, 500.0, 400.0), (100.0, 500.0, 148.0, 412.0)),
        # The picture goes on behind the sidebar, the header, and out of the region.
        ((-50.0, -20.0, 900.0, 640.0), (12.0, 588.0, 64.0, 508.0)),
    ],
)
def test_labels_of_a_picture_stay_where_they_are_seen(corners, places):
    def part(kind, alignment, x, y, width, height):
        return SimpleNamespace(type=kind, alignment=alignment, x=x, y=y, width=width, height=height)

    window = part("WINDOW", "NONE", 10, 20, 800, 600)
    area = SimpleNamespace(
        regions=(window, part("UI", "RIGHT", 610, 20, 200, 600), part("HEADER", "TOP", 10, 580, 800, 40))
    )
    assert label_places(corners, area, window, 2.0, 2 if corners[0] < 0.0 else 1) == places


def test_results_open_in_an_image_editor_that_is_free(scene):
    """Not in a UV Editor, nor in one that shows a picture of the artist's."""
    texture, render = bpy.data.images.new("Texture", 4, 4), SimpleNamespace(type="RENDER_RESULT")

    def editor(ui_type, image):
        return SimpleNamespace(ui_type=ui_type, spaces=SimpleNamespace(active=SimpleNamespace(image=image)))

    taken = [editor("VIEW_3D", None), editor("UV", None), editor("IMAGE_EDITOR", texture)]
    for free in (editor("IMAGE_EDITOR", None), editor("IMAGE_EDITOR", render),
                 editor("IMAGE_EDITOR", comparison.viewer_image(scene))):  # fmt: skip
        context = SimpleNamespace(window=SimpleNamespace(screen=SimpleNamespace(areas=[*taken, free])))
        assert comparison.put_in_editor(context, scene)
        assert free.spaces.active.image == comparison.viewer_image(scene)
        assert [area.spaces.active.image for area in taken] == [None, None, texture]
    context = SimpleNamespace(window=SimpleNamespace(screen=SimpleNamespace(areas=taken)))
    assert not comparison.put_in_editor(context, scene)
    assert not comparison.open_editor(SimpleNamespace(window=None), scene)


def test_an_area_that_has_been_closed_is_not_read(scene):
    """Its memory is gone, and Blender would end; here reading it is an error."""

    class Closed:
        def __getattribute__(self, name):
            raise AssertionError(name)

    assert comparison._arrange(Closed(), 0) is None


def test_presets_of_ours_set_everything_they_name(scene):
    files = sorted(Path(settings_module.PRESETS_PARENT, "presets", "ltsh").glob("*.py"))
    assert [path.stem for path in files] == ["Draft", "Lightmap_Archviz", "Lightmap_Level", "Measurement", "Standard"]
    seen_values = set()
    for path in files:
        assert bpy.ops.script.execute_preset(filepath=str(path), menu_idname="LTSH_PT_presets") == {"FINISHED"}
        seen_values.add(tuple(str(getattr(scene.ltsh, name)) for name in settings_module.KEPT))
        named = re.findall(r'^settings\.(?:property_unset\("(\w+)"\)|(\w+) = )', path.read_text(), re.MULTILINE)
        assert len(named) == path.read_text().count("settings.")
        assert {first or second for first, second in named} <= set(settings_module.KEPT)
        if path.stem.startswith("Lightmap"):
            of_bakes = {name for name in settings_module.KEPT if name.startswith("bake_")}
            assert {"shadows", "shadow_rays", *of_bakes} <= {first or second for first, second in named}
    assert len(seen_values) == 5


@pytest.mark.newest
def test_files_keep_the_techniques_that_they_were_saved_with(scene, tmp_path):
    assert (scene.ltsh.techniques, scene.ltsh.first) == (set(COMPARED_TECHNIQUES), DEFAULT_TECHNIQUE)
    assert scene.ltsh_view.technique == DEFAULT_TECHNIQUE
    scene.ltsh.techniques, scene.ltsh_view.technique = {"ltc", "ltsh4"}, "ltsh4"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "before.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "before.blend"))
    assert (bpy.context.scene.ltsh.techniques, bpy.context.scene.ltsh_view.technique) == ({"ltc", "ltsh4"}, "ltsh4")


def test_a_preset_of_the_artist_brings_the_settings_back(scene, tmp_path, monkeypatch):
    def folder(kind, *, path="", create=False):
        (tmp_path / path).mkdir(parents=True, exist_ok=True)
        return str(tmp_path / path)

    monkeypatch.setattr(bpy.utils, "user_resource", folder)
    scene.ltsh.techniques, scene.ltsh.cycles_samples, scene.ltsh.bake_size = {"ltsh2", "reference"}, 77, "2048"
    assert bpy.ops.ltsh.add_preset(name="Mine") == {"FINISHED"}
    (saved,) = tmp_path.glob("presets/ltsh/*.py")
    scene.ltsh.techniques, scene.ltsh.cycles_samples, scene.ltsh.bake_size = {"ltc"}, 4, "256"
    bpy.ops.script.execute_preset(filepath=str(saved), menu_idname="LTSH_PT_presets")
    assert (scene.ltsh.techniques, scene.ltsh.cycles_samples, scene.ltsh.bake_size) == (
        {"ltsh2", "reference"}, 77, "2048")  # fmt: skip


def test_every_setting_of_a_job_is_part_of_presets(scene):
    about_view = {"mode", "groups", "group", "first", "second", "pass_name", "split", "error_scale"}
    about_view |= {"mixed", "mixed_active", "active_light", "mode_before_mix", "match_target", "match_colors"}
    of_the_file = {"output_folder", "result_folder", "last_results", "bake_uv_map", "bake_active"}
    settings = set(scene.ltsh.__class__.__annotations__)
    assert settings - about_view - of_the_file == set(settings_module.KEPT)


def test_the_manual_names_what_the_panels_show(scene, tmp_path, monkeypatch):
    """Every button and every setting, by the words on it; a manual that is missing is told."""
    text = operators.PICTURE_LINE.sub("", operators.MANUAL.read_text(encoding="utf-8"))
    assert "![" not in text and "\n\n\n" not in text
    buttons = ("Shade Camera View", "Compare with Cycles", "Bake Selected", "Open in Image Editor",
               "the cross", "Esc")  # fmt: skip
    names = [item.name for item in scene.ltsh.bl_rna.properties
             if item.identifier in scene.ltsh.__class__.__annotations__ and not item.is_hidden]  # fmt: skip
    skipped = {"A", "B", "groups", "View", "Pass", "Object"}
    assert [word for word in (*buttons, *names) if word not in text and word not in skipped] == []
    assert len(text.splitlines()) < 150 and max(map(len, text.splitlines())) <= 120
    manual = tmp_path / "manual.md"
    monkeypatch.setattr(operators, "MANUAL", manual)
    with pytest.raises(RuntimeError, match="manual.md: cannot be read"):
        bpy.ops.ltsh.manual()


def luminance(color):
    """Relative luminance of an sRGB color (IEC 61966-2-1)."""
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in color[:3]]
    return np.dot(linear, (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize("color", [INK, overlay.CAPTION_COLOR, overlay.BRIGHTER_COLOR, overlay.DARKER_COLOR])
def test_captions_stand_out_from_their_plates(color):
    """On white pictures, which are the worst; WCAG 2.2, criterion 1.4.3, https://www.w3.org/TR/WCAG22/."""
    behind = PLATE[3] * luminance(PLATE) + (1.0 - PLATE[3])
    assert (luminance(color) + 0.05) / (behind + 0.05) > 4.5
