"""The example scene that is shipped, and the script that made it."""

import importlib
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from ltsh_addon.blender.saving import check_whole, save_copy
from ltsh_addon.cli.commands import DEMO_SCENE
from ltsh_addon.scene import SceneError

ROOT = Path(__file__).resolve().parents[3]
SPECULAR_NODES = {"BSDF_PRINCIPLED", "BSDF_GLOSSY"}


@pytest.fixture
def demo():
    bpy.ops.wm.open_mainfile(filepath=str(DEMO_SCENE), load_ui=False, use_scripts=False)
    return bpy.context.scene


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_a_file_that_was_cut_while_it_was_saved_is_refused(tmp_path, share):
    whole, cut = tmp_path / "whole.blend", tmp_path / "cut.blend"
    save_copy(whole)
    content = whole.read_bytes()
    cut.write_bytes(content[: int(share * len(content))])
    with pytest.raises(SceneError, match="is the disk full"):
        check_whole(cut)


def surface_shader(material):
    """The one shader that feeds the material's surface."""
    (output,) = (node for node in material.node_tree.nodes if node.type == "OUTPUT_MATERIAL")
    (link,) = output.inputs["Surface"].links
    return link.from_node


def test_four_area_lights_of_the_four_shapes_shine(demo):
    lights = [ob.data for ob in demo.objects if ob.type == "LIGHT"]
    assert {light.type for light in lights} == {"AREA"}
    assert sorted(light.shape for light in lights) == ["DISK", "ELLIPSE", "RECTANGLE", "SQUARE"]
    assert all(light.energy > 0.0 for light in lights)
    # Between them they use what the radiance of a light depends on.
    assert any(light.use_temperature for light in lights) and any(light.exposure != 0.0 for light in lights)
    assert any(max(light.color) > 2.0 * min(light.color) for light in lights)


def test_every_material_is_a_single_scatter_ggx_lobe(demo):
    used = {slot.material for ob in demo.objects for slot in ob.material_slots}
    assert used and None not in used
    for material in used:
        shader = surface_shader(material)
        assert shader.type in SPECULAR_NODES and shader.distribution == "GGX", material.name
    assert {surface_shader(material).type for material in used} == SPECULAR_NODES


@pytest.mark.parametrize("kind", ["metal", "plastic"])
def test_balls_of_metal_and_plastic_go_from_smooth_to_rough(demo, kind):
    balls = [ob for ob in demo.objects if ob.name.startswith(f"{kind} ball")]
    shaders = [surface_shader(ball.material_slots[0].material) for ball in balls]
    roughness = sorted(shader.inputs["Roughness"].default_value for shader in shaders)
    assert np.allclose((roughness[0], roughness[-1]), (0.1, 0.8)) and len(roughness) >= 6
    assert np.diff(roughness).min() > 0.05 and np.diff(roughness).max() < 0.3
    assert {shader.inputs["Metallic"].default_value for shader in shaders} == {float(kind == "metal")}


def test_nothing_lies_outside_the_file(demo):
    images = [image for image in bpy.data.images if image.type == "IMAGE"]
    assert len(images) >= 4 and all(image.packed_file is not None and image.users > 0 for image in images)
    assert not bpy.data.libraries and not bpy.data.texts and not bpy.data.sounds and not bpy.data.movieclips
    # Paths of packed images are not looked up, and none may lead to the machine the file was made on.
    assert all(str(Path.home()) not in path for path in bpy.utils.blend_paths(absolute=False, packed=True))


def scene_arrays():
    """All meshes, matrices, images, lights of the open file as arrays by name."""
    arrays = {}
    for mesh in bpy.data.meshes:
        vertices = np.empty(3 * len(mesh.vertices), dtype=np.float32)
        mesh.vertices.foreach_get("co", vertices)
        corners = np.empty(len(mesh.loops), dtype=np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        arrays[f"mesh {mesh.name} vertices"], arrays[f"mesh {mesh.name} corners"] = vertices, corners
    for ob in bpy.data.objects:
        arrays[f"object {ob.name}"] = np.array(ob.matrix_world)
    for image in bpy.data.images:
        arrays[f"image {image.name}"] = np.array(image.pixels[:], np.float32)
    for light in bpy.data.lights:
        arrays[f"light {light.name}"] = np.array([light.energy, light.size, light.size_y, *light.color])
    return arrays


def test_the_script_makes_the_scene_that_is_shipped(demo, monkeypatch):
    """Textures are the same to within a step of 8 bits, since numpy's sines depend on the machine."""
    shipped = scene_arrays()
    monkeypatch.setattr(sys, "path", [str(ROOT / "docs"), *sys.path])
    importlib.import_module("demo_scene").build()
    made = scene_arrays()
    assert shipped.keys() == made.keys() and len(shipped) > 100
    for name in shipped:
        assert np.allclose(shipped[name], made[name], rtol=1e-6, atol=1.01 / 255 if "image" in name else 1e-6), name


def test_shapes_are_closed_enough_to_shade(demo):
    """Every vertex is finite, every face has an area: degenerate faces would have no normal."""
    for mesh in bpy.data.meshes:
        assert np.isfinite([vertex.co for vertex in mesh.vertices]).all(), mesh.name
        areas = np.empty(len(mesh.polygons))
        mesh.polygons.foreach_get("area", areas)
        assert areas.min() > 1e-9, mesh.name
