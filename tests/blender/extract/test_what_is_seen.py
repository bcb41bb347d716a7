"""Surfaces that do nothing are seen through, and scripts of Open Shading Language change nothing but what they feed."""

import hashlib
from pathlib import Path

import _cycles
import bpy
import numpy as np
import pytest
import scene_parts
from material_scenes import Build

from ltsh_addon.blender.materials.preview_material import preview_of

SIZE = (24, 16)


def floor(roughness=0.4):
    """A metal floor that fills the picture, its light and camera."""
    scene = scene_parts.empty_scene(*SIZE)
    scene_parts.add_top_camera()
    scene_parts.add_area_light("Key")
    made, node = scene_parts.principled("Floor", Roughness=roughness, Base_Color=(0.8, 0.5, 0.3, 1.0))
    scene_parts.add_plane(made, size=8.0)
    return scene, made, node


def sampled(folder: Path):
    """Samples, pixels, warnings and the Cycles reference of the open scene."""
    prepared = scene_parts.prepare()
    ((samples, pixel, unusable),), _ = scene_parts.sample(folder, prepared)
    assert unusable == 0
    return samples, pixel, prepared[3], scene_parts.reference(folder, prepared, 32)


def alpha(number):
    """Principled with that alpha from a node, in a group."""

    def make(made):
        inside = made.shader("BsdfPrincipled")
        made.link(made.value(number), inside.node.inputs["Alpha"])
        return inside

    return make


CLEAR = {
    "transparent": (Build.clear, ""),
    "tinted": (lambda made: made.shader("BsdfTransparent", Color=(0.5, 0.2, 0.2, 1.0)), "as clear, up to 80 %"),
    "alpha": (lambda made: made.shader("BsdfPrincipled", Alpha=0.0), ""),
    "alpha in a group": (lambda made: made.group(lambda: alpha(0.0)(made))[0], ""),
    "mix": (lambda made: made.mix(made.value(1.0), made.leaf(0.5), made.clear()), ""),
    "volume": (None, "its volume is not shaded, it is seen through"),
}


@pytest.mark.parametrize("kind", CLEAR)
def test_what_does_nothing_is_seen_through(tmp_path, kind):
    """Twenty layers of it, more than Cycles goes through by default, leave samples and reference as they are."""
    make, note = CLEAR[kind]
    floor()
    samples, pixel, warnings, halves = sampled(tmp_path)
    floor()
    made = Build("Pane")
    if make is None:
        made.link(made.shader("VolumePrincipled"), made.output.inputs["Volume"])
    else:
        made.show(make(made))
    assert preview_of(made.material).is_clear == (kind != "tinted")  # views tint what is behind
    for layer in range(20):
        scene_parts.add_plane(made.material, size=8.0, location=(0.0, 0.0, 2.0 + 0.1 * layer))
    through, pixel_behind, found, reference = sampled(tmp_path)
    assert warnings == [] and len(found) == bool(note) and all("'Pane'" in line and note in line for line in found)
    assert np.array_equal(pixel, pixel_behind)
    for name in ("position", "diffuse_albedo", "dielectric", "roughness"):
        np.testing.assert_allclose(getattr(through, name), getattr(samples, name), atol=1e-5)
    for name in halves:
        # Noise: the floor is rough, and the samples of the light are other ones.
        assert reference[name].sum() == pytest.approx(halves[name].sum(), rel=0.02)


def test_open_shading_language_without_scripts_is_the_same_picture(tmp_path):
    scene, _, _ = floor()
    samples, pixel, warnings, halves = sampled(tmp_path)
    scene, _, _ = floor()
    scene.cycles.shading_system = True
    again, same_pixel, found, reference = sampled(tmp_path)
    assert warnings == found == [] and np.array_equal(pixel, same_pixel) and len(pixel) == SIZE[0] * SIZE[1]
    for name in ("position", "diffuse_albedo", "dielectric"):
        assert np.array_equal(getattr(again, name), getattr(samples, name))
    assert all(np.array_equal(halves[name], reference[name]) for name in halves)


def test_a_script_is_named_and_stays_in_the_reference(tmp_path):
    """It paints the floor red: what feeds it counts for samples, the script for Cycles."""
    scene, made, node = floor()
    scene.cycles.shading_system = True
    source, compiled = tmp_path / "red.osl", tmp_path / "red.oso"
    source.write_text("shader red(output color Red = color(0)) { Red = color(1, 0, 0); }\n")
    assert _cycles.osl_compile(str(source), str(compiled))
    script = made.node_tree.nodes.new("ShaderNodeScript")
    script.bytecode = compiled.read_text()
    script.bytecode_hash = hashlib.md5(script.bytecode.encode()).hexdigest()
    made.node_tree.links.new(script.outputs.new("NodeSocketColor", "Red"), node.inputs["Base Color"])
    samples, pixel, (warning,), halves = sampled(tmp_path)
    assert warning.startswith("material 'Floor': node 'Script' is Open Shading Language, which is not read")
    assert len(pixel) == SIZE[0] * SIZE[1]
    color = samples.diffuse_albedo / samples.diffuse_albedo[:, :1]
    np.testing.assert_allclose(color, np.broadcast_to((1.0, 0.625, 0.375), color.shape), rtol=1e-3)
    red = halves["diffuse"].sum(axis=(0, 1, 2))
    assert red[0] > 0.0 and red[1] == red[2] == 0.0
    assert scene.cycles.shading_system and not script.mute and bpy.data.materials["Floor"] == made
