"""Colors stay in the space of the file, whichever it is, and what is written says so."""

import shutil
from pathlib import Path

import bpy
import mathutils
import numpy as np
import OpenEXR
import pytest
import scene_parts

from ltsh_addon import imaging
from ltsh_addon.blender import render_settings
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.imaging.color import CHROMATICITIES, identified
from ltsh_addon.pipeline import PictureOptions, compare_scene

CHOOSES_SPACES = bpy.app.version >= (5, 0, 0)
SPACES = ("Linear Rec.709", "Linear Rec.2020", "ACEScg") if CHOOSES_SPACES else ("Linear Rec.709",)


def colored_room(space, *, surface=(0.7, 0.7, 0.7), **light):
    """A diffuse plane under one light; its colors mean the same in every space."""
    scene = scene_parts.empty_scene(24, 16)
    scene_parts.add_top_camera(6.0)
    scene_parts.add_area_light("Key", **light)
    material = scene_parts.bsdf_material("ShaderNodeBsdfDiffuse", "Floor", Color=(*surface, 1.0))[0]
    scene_parts.add_plane(material, size=12.0)
    if CHOOSES_SPACES:
        bpy.ops.wm.set_working_color_space(working_space=space, convert_colors=True)
    return scene


@pytest.mark.parametrize("space", SPACES)
def test_the_space_is_named_and_its_matrix_is_blenders(space):
    colored_room(space)
    found = render_settings.working_space()
    named = identified(found["to_rec709"], found["name"])
    assert named.name == space and found["name"] in (space, "")
    for color in ((0.2, 0.7, 0.1), (1.0, 0.0, 0.0)):
        assert np.allclose(named.rec709(color), mathutils.Color(color).from_scene_linear_to_rec709_linear(), atol=1e-6)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("temperature", [None, 2700.0])
def test_lights_and_surfaces_shine_as_in_cycles(tmp_path, space, temperature):
    given = {} if temperature is None else {"use_temperature": True, "temperature": temperature}
    colored_room(space, surface=(0.8, 0.3, 0.1), color=(0.9, 0.4, 0.2), **given)
    path = scene_parts.save(tmp_path / "scene.blend")
    options = PictureOptions(path, tmp_path / "out", techniques=("ltc",), passes=("diffuse",), cycles_samples=512)
    report = compare_scene(options)
    layers = imaging.read_layers(tmp_path / "out" / "compare.exr")
    ratio = layers["ltc.diffuse"].sum(axis=(0, 1)) / layers["cycles.diffuse"].sum(axis=(0, 1))
    # Each channel by itself, to the noise of 512 samples over 384 pixels.
    assert np.abs(ratio - 1.0).max() < 5e-4
    assert report["color_space"] == space and space in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    header = OpenEXR.File(str(tmp_path / "out" / "compare.exr"), header_only=True).header()
    assert header["ltsh:color_space"] == space
    assert np.allclose(header["chromaticities"], CHROMATICITIES[space], atol=1e-7)


@pytest.mark.skipif(not CHOOSES_SPACES, reason="before 5.0 files have no working space of their own")
def test_the_sheet_looks_the_same_whatever_the_space(tmp_path):
    """A gray surface: its product with the light's color then means the same in every space."""
    sheets, values = {}, {}
    for space in SPACES:
        colored_room(space, color=(0.9, 0.6, 0.3))
        path = scene_parts.save(tmp_path / "scene.blend")
        compare_scene(PictureOptions(path, tmp_path, techniques=("ltc",), passes=("diffuse",), cycles_samples=64))
        image = bpy.data.images.load(str(tmp_path / "compare.png"))
        sheets[space] = 255.0 * np.array(image.pixels[:]).reshape(image.size[1], image.size[0], 4)[..., :3]
        values[space] = imaging.read_layers(tmp_path / "compare.exr")["ltc.diffuse"]
        bpy.data.images.remove(image)
    for space in SPACES[1:]:
        assert np.abs(values[space] / values["Linear Rec.709"] - 1.0).max() > 0.1
        difference = np.abs(sheets[space] - sheets["Linear Rec.709"])
        # The renderings are the upper half. Blender rounds the converted colors to float32 of a few digits.
        upper = difference[difference.shape[0] // 2 :]
        assert np.quantile(upper, 0.999) <= 2.0


@pytest.mark.parametrize("space", ["Linear Rec.709", "Linear Rec.2020"])
def test_an_own_opencolorio_configuration_is_taken_into_account(tmp_path, monkeypatch, own_blender, space):
    own = tmp_path / "colormanagement"
    shutil.copytree(Path(bpy.utils.system_resource("DATAFILES")) / "colormanagement", own)
    config = (own / "config.ocio").read_text(encoding="utf-8")
    changed = config.replace("scene_linear: Linear Rec.709", f"scene_linear: {space}")
    assert (changed != config) == (space != "Linear Rec.709")
    (own / "config.ocio").write_text(changed, encoding="utf-8")
    colored_room("Linear Rec.709")
    path = scene_parts.save(tmp_path / "scene.blend")
    monkeypatch.setenv("OCIO", str(own / "config.ocio"))
    found = extract_pixels(PixelJob(path)).picture.color_space
    # Since 5.0 the space stands in the file; before, the configuration alone decides.
    assert found.name == ("Linear Rec.709" if CHOOSES_SPACES else space)
