"""Node trees of area lights: what Cycles sees of the light is what lights; patches stay within their stated error."""

import math

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_image, add_instancer, add_lamp_plane, assert_agrees, into_collection, light_tree, start

from ltsh_addon.blender.lights import textures

PLACEMENTS = {
    "rectangle": {},
    "mirrored ellipse": {"shape": "ELLIPSE", "scale": (-1.0, 1.0, 1.0)},
    "stretched, shining to the other side": {"scale": (1.0, -1.3, -1.0), "rotation": (math.pi - 0.2, 0.3, 0.0)},
    "rectangle with a spread": {"spread": 1.5},
    "disk with a spread": {"shape": "DISK", "spread": 1.5},
}


def picture(height=4, width=8, seed=3):
    """Colors (H, W, 3) with strong contrast."""
    return np.random.default_rng(seed).random((height, width, 3)) ** 3


def add_picture_light(**settings):
    light = scene_parts.add_area_light(**settings)
    tree, emission = light_tree(light)
    tree.links.new(add_image(tree, picture()).outputs["Color"], emission.inputs["Color"])
    return light


@pytest.mark.parametrize("name", PLACEMENTS)
def test_an_image_on_a_light_is_that_of_cycles(tmp_path, name):
    start()
    add_picture_light(**PLACEMENTS[name])
    # Cycles does not look for bright parts of a texture: its noise is twice that of a plain light.
    _, _, inventory, warnings = assert_agrees(tmp_path, samples=2048, count=8)
    (light,) = inventory.lights
    assert len(light.leaves) > 16 and warnings == []
    assert {patch.spread for patch in light.leaves} == {light.spread}


def test_patches_keep_the_power_of_the_light():
    start()
    add_picture_light()
    lights = scene_parts.prepare()[2].lights
    (whole,) = lights
    areas = [4.0 * np.linalg.norm(np.cross(light.half_u, light.half_v)) for light in whole.leaves]
    power = sum(area * light.radiance for area, light in zip(areas, whole.leaves, strict=True))
    assert np.allclose(power, sum(areas) * whole.radiance, rtol=1e-9)
    plain = 100.0 / math.pi  # watts over pi, of a light that is white all over
    assert np.allclose(power, plain * picture().mean(axis=(0, 1)), rtol=1e-4)


def test_a_smooth_texture_needs_patches_along_one_side_only(tmp_path):
    start()
    tree, emission = light_tree(scene_parts.add_area_light())
    ramp = tree.nodes.new("ShaderNodeTexGradient")
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["UV"], ramp.inputs["Vector"])
    tree.links.new(ramp.outputs["Fac"], emission.inputs["Strength"])
    _, _, inventory, warnings = assert_agrees(tmp_path)
    (light,) = inventory.lights
    assert warnings == [] and 16 <= len(light.leaves) <= 32
    assert np.allclose([np.linalg.norm(patch.half_v) for patch in light.leaves], 0.35)


def test_constant_nodes_keep_the_light_whole(tmp_path):
    """A black body inside a node group, with a strength computed from constants, on a disk with a spread."""
    start()
    tree, emission = light_tree(scene_parts.add_area_light(shape="DISK", spread=1.2, color=(1.0, 0.5, 1.0)))
    group, _, end = scene_parts.new_group({}, {"Color": "Color"})
    black_body, holder = group.nodes.new("ShaderNodeBlackbody"), scene_parts.add_group(tree, group)
    black_body.inputs[0].default_value = 3000.0
    group.links.new(black_body.outputs[0], end.inputs[0])
    product = tree.nodes.new("ShaderNodeMath")
    product.operation = "MULTIPLY"
    product.inputs[0].default_value, product.inputs[1].default_value = 0.5, 3.0
    tree.links.new(holder.outputs[0], emission.inputs["Color"])
    tree.links.new(product.outputs[0], emission.inputs["Strength"])
    _, _, inventory, warnings = assert_agrees(tmp_path, count=64)
    (light,) = inventory.lights
    assert warnings == [] and light.shape == "DISK"
    plain = 100.0 / math.pi / (math.pi / 4.0 * 1.2**2) * np.array([1.0, 0.5, 1.0])
    # Cycles' black body of 3000 K is (1.77, 0.84, 0.27) in the linear colors of Rec.709.
    assert np.allclose(light.radiance, plain * 1.5 * (1.77, 0.84, 0.27), rtol=0.02)


def test_a_light_without_emission_is_none(tmp_path):
    start()
    scene_parts.add_area_light("Key")
    dark = scene_parts.add_area_light("Dark")
    tree, emission = light_tree(dark)
    tree.links.remove(emission.outputs[0].links[0])
    assert [light.name for light in assert_agrees(tmp_path)[2].lights] == ["Key"]


@pytest.mark.parametrize("is_placed", [False, True], ids=["on the light", "in the world"])
def test_instances_have_a_look_of_their_own_where_they_need_one(tmp_path, monkeypatch, is_placed):
    looks, look = [], textures.node_emission
    monkeypatch.setattr(textures, "node_emission", lambda *values: looks.append(values) or look(*values))
    start()
    light = add_picture_light()
    if is_placed:
        tree, emission = light_tree(light)
        place = tree.nodes.new("ShaderNodeNewGeometry").outputs["Position"]
        tree.links.new(place, emission.inputs["Strength"])
    collection = into_collection("Lamps", light)
    for x in (-0.8, 0.0, 0.9):
        add_instancer(collection, f"At {x}", location=(x, 0.0, 0.4), scale=(1.0 + abs(x),) * 3)
    _, _, inventory, warnings = assert_agrees(tmp_path, samples=2048, count=8, tolerance=5e-3)
    assert len(looks) == (3 if is_placed else 1) and warnings == []
    assert len({round(float(np.linalg.norm(light.half_v)), 4) for light in inventory.lights}) > 1
    if is_placed:
        monkeypatch.setattr(textures, "MOST_INSTANCES", 2)
        assert sum("'Light'" in line and "2 instances" in line for line in scene_parts.prepare()[3]) == 1


def test_a_texture_too_fine_is_named_with_its_error():
    start()
    tree, emission = light_tree(scene_parts.add_area_light("Fine"))
    pixels = np.random.default_rng(8).random((256, 256, 3))
    tree.links.new(add_image(tree, pixels).outputs["Color"], emission.inputs["Color"])
    _, _, inventory, warnings = scene_parts.prepare()
    assert len(inventory.lights[0].leaves) == 64 * 64
    # The mean distance of a number in [0, 1] from its mean is a quarter, half of the mean, here less by what the
    # 16 pixels of each patch have in common.
    assert any("'Fine'" in line and "4096 patches" in line and " 4" in line for line in warnings), warnings


@pytest.mark.parametrize("kind", ["LightPath", "LayerWeight"])
def test_emission_that_depends_on_the_direction_is_named(kind):
    start()
    tree, emission = light_tree(scene_parts.add_area_light("Odd"))
    node = tree.nodes.new("ShaderNode" + kind)
    output = node.outputs["Is Camera Ray"] if kind == "LightPath" else node.outputs[0]
    tree.links.new(output, emission.inputs["Strength"])
    try:
        warnings = scene_parts.prepare()[3]
    except scene_parts.pixels.SceneError:
        return  # dark when seen head-on
    assert sum("'Odd'" in line and "direction" in line for line in warnings) == 1, warnings


def test_looking_leaves_nothing_behind():
    start()
    add_picture_light()
    before = {name: len(getattr(bpy.data, name)) for name in ("scenes", "objects", "cameras", "meshes", "lights")}
    scene = bpy.context.scene
    scene_parts.prepare()
    assert not any("look" in image.name for image in bpy.data.images)
    assert {name: len(getattr(bpy.data, name)) for name in before} == before and bpy.context.scene == scene


def halves(first, second):
    """Colors (4, 8, 3): one half of the picture `first`, the other `second`."""
    return np.where(np.arange(8)[None, :, None] < 4, np.array(first), np.array(second)) * np.ones((4, 8, 1))


def panel_of_colors(colors):
    tree, emission = light_tree(scene_parts.add_area_light("Lit"))
    tree.links.new(add_image(tree, colors).outputs["Color"], emission.inputs["Color"])


def screen_of_colors(colors):
    material, emission = scene_parts.bsdf_material("ShaderNodeEmission", "Screen")
    tree = material.node_tree
    tree.links.new(add_image(tree, colors).outputs["Color"], emission.inputs["Color"])
    add_lamp_plane(material, "Lit")


def sky_of_colors(colors):
    world, sky = scene_parts.add_world("Lit")
    texture, image = world.node_tree.nodes.new("ShaderNodeTexEnvironment"), add_image(world.node_tree, colors)
    texture.image, texture.interpolation = image.image, "Closest"
    world.node_tree.links.new(texture.outputs["Color"], sky.inputs["Color"])


@pytest.mark.parametrize("build", [panel_of_colors, screen_of_colors, sky_of_colors])
def test_lights_of_several_colors_are_named_with_what_their_gray_shadows_may_be_off(build):
    """Of halves (3, 0, 0) and (0, 0, 1), the first of which has 3/4 of the mean of all colors, a shadow on the second
    takes all of the blue and shows 1/4: .75 off. One hue needs no colors, in whatever pattern."""
    for colors, share in ((halves((3.0, 0, 0), (0, 0, 1.0)), 75), (halves((1.0, 0.5, 0.5), (4.0, 2.0, 2.0)), None)):
        start()
        build(colors)
        lines = [line for line in scene_parts.prepare(with_occluders=True)[3] if "several colors" in line]
        assert len(lines) == (share is not None)
        if lines:
            told = int(lines[0].partition("'Lit' (")[2].partition(" %")[0])
            assert abs(told - share) <= 2, lines  # edges of patches of a sky
