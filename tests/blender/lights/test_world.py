"""The light of the world is that of Cycles: worlds of all kinds on a ball above a plane."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from lit_plane import measured

from ltsh_addon.blender.process.pixels import faceted
from ltsh_addon.pipeline import PictureOptions, compare_scene
from ltsh_addon.scene import PASSES
from ltsh_addon.shading import shade


def start(width=24, height=16):
    scene = scene_parts.empty_scene(width, height)
    scene_parts.add_camera(location=(0.0, -3.2, 1.9), rotation=(1.08, 0.0, 0.0))
    surface = scene_parts.principled("Surface", Roughness=0.45, Metallic=0.5)[0]
    scene_parts.add_plane(surface, size=8.0)
    scene_parts.add_sphere(surface, radius=0.6, location=(0.0, 0.0, 0.9), segments=64)
    return scene


def coarse_map(world):
    """Cycles' own map of bright places takes longer than the picture."""
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 512


def errors(folder, technique, samples=512):
    """By pass the error beyond Cycles' noise and the bias of unshadowed light, and the prepared scene."""
    prepared = scene_parts.prepare()
    coarse_map(prepared[2].world)
    _, surface, halves = measured(folder, samples, prepared)
    found = {}
    shading = shade(surface, prepared[2].lights, technique, workers=1)
    for name in PASSES:
        radiance = getattr(shading, name).sum(axis=0)
        found[name] = quadrature.relative_l2(radiance, halves[name]), quadrature.bias(radiance, halves[name])
    return found, prepared


def gradient():
    world, sky = scene_parts.add_world(Strength=1.5)
    tree = world.node_tree
    places, mapping = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
    mapping.inputs["Rotation"].default_value = 0.3, 1.2, 0.1
    colors = tree.nodes.new("ShaderNodeTexGradient")
    tree.links.new(places.outputs["Generated"], mapping.inputs[0])
    tree.links.new(mapping.outputs[0], colors.inputs[0])
    tree.links.new(colors.outputs["Color"], sky.inputs["Color"])


def environment_image(has_sun):
    """Bands of color, a window 40 times as bright, and a sun that has half of the light."""
    v, u = np.mgrid[0:128, 0:256] / np.array([128.0, 256.0])[:, None, None]
    pixels = np.ones((128, 256, 4), np.float32)
    for channel in range(3):
        pixels[..., channel] = 0.3 + 0.25 * np.sin(6.0 * np.pi * u + channel) * np.sin(2.0 * np.pi * v)
    pixels[(v > 0.7) & (v < 0.76) & (u > 0.2) & (u < 0.24)] = 12.0, 10.0, 8.0, 1.0
    if has_sun:
        pixels[np.hypot(2.0 * (u - 0.6), v - 0.8) < 0.03] = 100.0, 80.0, 60.0, 1.0
    image = bpy.data.images.new("Sky", 256, 128, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    return image


def picture(projection):
    world, sky = scene_parts.add_world()
    tree = world.node_tree
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image, texture.projection = environment_image(projection == "EQUIRECTANGULAR"), projection
    tree.links.new(texture.outputs["Color"], sky.inputs["Color"])


def sky_texture(kind):
    """One of the kinds of sky that this Blender has: 0 is one with a sun disk."""
    world, sky = scene_parts.add_world(Strength=0.1)
    node = world.node_tree.nodes.new("ShaderNodeTexSky")
    kinds = ["MULTIPLE_SCATTERING" if bpy.app.version >= (5, 0, 0) else "NISHITA", "HOSEK_WILKIE", "PREETHAM"]
    node.sky_type = kinds[kind]
    node.sun_elevation, node.sun_rotation, node.sun_direction = 0.6, 0.7, (0.4, 0.5, 0.6)
    world.node_tree.links.new(node.outputs[0], sky.inputs["Color"])


def seen_otherwise():
    """Red to the camera, and what surfaces see is in a group."""
    world, sky = scene_parts.add_world(Color=(0.2, 0.5, 1.0, 1.0))
    tree = world.node_tree
    group, _, end = scene_parts.new_group({}, {"Color": "Color"})
    path, mix = group.nodes.new("ShaderNodeLightPath"), group.nodes.new("ShaderNodeMixRGB")
    mix.inputs[1].default_value, mix.inputs[2].default_value = (0.2, 0.5, 1.0, 1.0), (9.0, 0.0, 0.0, 1.0)
    group.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    group.links.new(mix.outputs[0], end.inputs[0])
    tree.links.new(scene_parts.add_group(tree, group).outputs[0], sky.inputs["Color"])


WORLDS = {
    "constant": lambda: scene_parts.add_world(Color=(0.5, 0.7, 1.0, 1.0), Strength=1.3),
    "gradient": gradient,
    "equirectangular": lambda: picture("EQUIRECTANGULAR"),
    "mirror ball": lambda: picture("MIRROR_BALL"),
    "sky with a sun": lambda: sky_texture(0),
    "Hosek and Wilkie": lambda: sky_texture(1),
    "Preetham": lambda: sky_texture(2),
    "seen otherwise by the camera": seen_otherwise,
}


@pytest.mark.parametrize("kind", WORLDS)
def test_a_world_lights_as_in_cycles(tmp_path, kind):
    """Of the light, unshadowed; patches differ by 0.5 %, and 512 samples leave as much of the noise."""
    start()
    WORLDS[kind]()
    groups = set(bpy.data.node_groups)
    found, (scene, _, inventory, warnings) = errors(tmp_path, "ltsh4")
    assert {light.name for light in inventory.lights} == {"World"} and warnings == []
    assert set(bpy.data.node_groups) == groups and len(bpy.data.worlds) == 1
    suns = [light for light in inventory.lights if light.shape == "DISK"]
    assert len(suns) == (kind == "sky with a sun")
    for sun in suns:  # 0.545 degrees across, where the node says
        assert np.arcsin(sun.center[2]) == pytest.approx(0.6, abs=2e-3)
        assert np.arctan(np.linalg.norm(sun.half_u)) == pytest.approx(np.radians(0.545) / 2.0, rel=0.05)
    for name, most in (("specular", 0.02), ("diffuse", 0.01)):
        distance, bias = found[name]
        assert distance < most and abs(bias) < most, (name, found)


@pytest.mark.newest
def test_the_reference_quadrature_knows_worlds(tmp_path):
    start(12, 8)
    picture("EQUIRECTANGULAR")
    found, _ = errors(tmp_path, "reference", 1024)
    for distance, bias in found.values():
        assert distance < 0.01 and abs(bias) < 0.01, found


def test_a_world_has_groups_and_is_seen_by_the_lobes_that_the_file_says():
    start()
    world, _ = scene_parts.add_world("Sky", Color=(1.0, 1.0, 1.0, 1.0))
    world.cycles_visibility.glossy = False
    world.lightgroup = "Outside"
    _, _, inventory, warnings = scene_parts.prepare()
    assert {(light.name, light.group) for light in inventory.lights} == {("Sky", "Outside")}
    assert all(light.affects_diffuse and not light.affects_specular for light in inventory.lights)
    # What Cycles lets through all the same is named, once.
    (line,) = [line for line in warnings if "Sky" in line]
    assert "hidden from glossy rays" in line and "35 %" in line


@pytest.mark.parametrize(
    ("node", "output", "word"),
    [("LightPath", "Is Glossy Ray", "Is Glossy Ray"), ("TexCoord", "Window", "Window"), ("Value", 0, "not finite")],
    ids=["seen otherwise by some rays", "by the camera", "beyond all measure"],
)
def test_a_world_that_cannot_be_had_is_named(node, output, word):
    start()
    world, sky = scene_parts.add_world("Sky", Color=(1e20, 1e20, 1e20, 1.0))
    source = world.node_tree.nodes.new(f"ShaderNode{node}").outputs[output]
    world.node_tree.links.new(source, sky.inputs["Color" if node == "TexCoord" else "Strength"])
    if node == "Value":
        source.default_value = 1e15
    scene_parts.add_area_light("Key")
    _, _, inventory, warnings = scene_parts.prepare()
    assert {light.name for light in inventory.lights} == {"Key"} or node == "TexCoord"
    assert sum("world 'Sky'" in line and word in line for line in warnings) == 1, warnings


def test_reflections_that_show_the_patches_of_a_world_are_named(tmp_path):
    start()
    picture("EQUIRECTANGULAR")
    prepared = scene_parts.prepare()
    ((surface, _, _),) = scene_parts.sample(tmp_path, prepared)[0]
    assert faceted(surface, prepared[2].lights, prepared[2].sky_detail) == []
    sharp = replace(surface, roughness=np.where(np.arange(len(surface)) % 4 == 0, 0.1, surface.roughness))
    (line,) = faceted(sharp, prepared[2].lights, prepared[2].sky_detail)
    assert "'World'" in line and "25 % of the samples" in line
    assert faceted(sharp, [light for light in prepared[2].lights if not light.children], 1.0) == []
    assert faceted(sharp, prepared[2].lights, 0.0) == []


@pytest.mark.parametrize("kind", ["constant", "sky with a sun"])
def test_what_blocks_a_world_blocks_it_as_in_cycles(tmp_path, kind):
    """Beyond the noise of both sides, of which 256 rays a light and pixel leave some 2 %."""
    start(24, 16)
    WORLDS[kind]()
    coarse_map(bpy.context.scene.world)
    path = scene_parts.save(tmp_path / "scene.blend")
    report = compare_scene(
        PictureOptions(scene=path, output=tmp_path / "out", techniques=("ltsh4",), cycles_samples=512)
    )
    for name in PASSES:
        statistics = report["passes"][name]["techniques"]["ltsh4"]["against_cycles"]
        assert statistics["unbiased_relative_error"] < 0.035, (name, statistics)
