"""The example scene: built in a child as a user's is, opened here and looked at."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from ltsh_addon.blender import demo as demo_module
from ltsh_addon.blender.process import blender_process
from ltsh_addon.blender.process.blend_file import build_demo
from ltsh_addon.blender.saving import check_whole

ROOT = Path(__file__).resolve().parents[3]
SPECULAR_NODES = {"BSDF_PRINCIPLED", "BSDF_GLOSSY"}


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("demo") / "demo.blend"
    build_demo(path)
    return path


@pytest.fixture
def demo(demo_file):
    bpy.ops.wm.open_mainfile(filepath=str(demo_file), load_ui=False, use_scripts=False)
    return bpy.context.scene


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_a_file_that_was_cut_while_it_was_saved_is_refused(demo_file, tmp_path, share):
    check_whole(demo_file)
    content, cut = demo_file.read_bytes(), tmp_path / "cut.blend"
    cut.write_bytes(content[: int(share * len(content))])
    with pytest.raises(blender_process.SceneError, match="is the disk full"):
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


def test_two_builds_are_equal(demo, tmp_path):
    first = scene_arrays()
    demo_module.build(tmp_path / "again.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "again.blend"), load_ui=False, use_scripts=False)
    second = scene_arrays()
    assert first.keys() == second.keys() and len(first) > 100
    assert not [name for name in first if not np.array_equal(first[name], second[name])]


def test_shapes_are_closed_enough_to_shade(demo):
    """Every vertex is finite, every face has an area: degenerate faces would have no normal."""
    for part in demo_module.everything():
        assert np.isfinite(part.shape.vertices).all(), part.name
    for mesh in bpy.data.meshes:
        areas = np.empty(len(mesh.polygons))
        mesh.polygons.foreach_get("area", areas)
        assert areas.min() > 1e-9, mesh.name


def test_a_build_that_cannot_be_saved_leaves_the_old_file(tmp_path):
    folder = tmp_path / "demo.blend"
    folder.mkdir()
    with pytest.raises((OSError, blender_process.SceneError)):
        build_demo(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["demo.blend"]
