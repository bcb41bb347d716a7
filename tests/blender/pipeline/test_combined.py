"""`combined` of shade and compare is what Cycles shows without bounces, with what glows and what is behind."""

import bpy
import numpy as np
import pytest
import scene_parts as parts

from ltsh_addon import imaging
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.pipeline import PictureOptions, compare_scene, shade_scene

SIZE, SAMPLES = 24, 512
# Three standard deviations of the noise of the truth and of the picture in a pixel, by the largest reflected radiance;
# what all of it may be off.
NOISE, BIAS = {"ltsh4": 0.03, "cycles": 0.12}, 0.02
EXPOSURE = 1.7


def room(transparent):
    """A floor, a ball that glows and reflects, a hole in the picture, lamps in sight, and a sky that varies."""
    scene = parts.empty_scene(SIZE, SIZE)
    scene.cycles.max_bounces, scene.cycles.film_exposure = 0, EXPOSURE
    scene.render.film_transparent = transparent
    parts.add_plane(parts.principled("Floor", Base_Color=(0.6, 0.5, 0.3, 1.0), Roughness=0.6)[0], 3.0)
    glow = parts.principled("Glow", Base_Color=(0.2, 0.5, 0.3, 1.0), Emission_Color=(0.2, 0.4, 1.0, 1.0))[0]
    glow.node_tree.nodes["Principled BSDF"].inputs["Emission Strength"].default_value = 2.0
    parts.add_sphere(glow, 0.4, smooth=False, segments=8, location=(0.5, 0.0, 0.4))
    parts.add_sphere(parts.principled("Hole")[0], 0.3, "Hole", location=(-0.6, -0.4, 0.3)).is_holdout = True
    parts.add_camera((0.0, -4.0, 2.0), (1.2, 0.0, 0.0))
    parts.add_area_light("Seen", (-0.6, 0.6, 1.6), (0.3, 0.0, 0.0), energy=30.0, size=0.5, size_y=0.4)
    bpy.data.objects["Seen"].visible_camera = True
    bulb = parts.new_light("Bulb", "POINT", energy=20.0, shadow_soft_size=0.15)
    parts.link(bulb, (0.7, 0.8, 1.5)).visible_camera = True
    world, sky = parts.add_world(Strength=0.5)
    gradient = parts.add_node(world.node_tree, "ShaderNodeTexGradient")
    place = parts.add_node(world.node_tree, "ShaderNodeTexCoord")
    world.node_tree.links.new(place.outputs["Generated"], gradient.inputs["Vector"])
    world.node_tree.links.new(gradient.outputs["Color"], sky.inputs["Color"])
    return scene


def rendered(folder):
    """Combined (H, W, 4) of the open scene by Cycles, from the centers of the pixels."""
    with parts.render_settings.pinned_pixel_filter(bpy.context.scene):
        return read_layer(parts.cycles_channels(folder, SAMPLES, seed=5), "Combined", "RGBA").astype(float)


@pytest.mark.parametrize("transparent", [False, True], ids=["opaque film", "transparent film"])
def test_combined_is_the_picture_of_cycles_without_bounces(tmp_path, transparent):
    room(transparent)
    path = parts.save(tmp_path / "room.blend")
    truth = rendered(tmp_path)
    options, names = PictureOptions(path, output=tmp_path, techniques=("ltsh4",), cycles_samples=32), ["ltsh4"]
    if transparent:
        report, file = shade_scene(options), "shade.exr"
    else:
        report, file = compare_scene(options), "compare.exr"
        names.append("cycles")
    assert not [line for line in report["warnings"] if "origin" in line]
    layers = imaging.read_layers(tmp_path / file)
    light = layers["ltsh4.specular"] + layers["ltsh4.diffuse"]
    is_lit = light.any(axis=-1)
    assert is_lit.mean() > 0.2 and (~is_lit).mean() > 0.2
    # One of a thousand rays strays from the center of its pixel, at edges to something much brighter.
    stray = 4.5 / SAMPLES
    for name in names:
        combined = layers[f"{name}.combined"]
        np.testing.assert_allclose(combined[..., 3], truth[..., 3], atol=stray)
        off = np.abs(combined[..., :3] - truth[..., :3]).max(axis=-1)
        # What is not reflected is no estimate.
        assert off[~is_lit].max() < stray * truth[..., :3].max()
        assert np.mean(off[is_lit] > NOISE[name] * light.max()) < 0.02, name
        total = combined[is_lit, :3].sum() / truth[is_lit, :3].sum()
        assert abs(total - 1.0) < BIAS, (name, total)
    emission = layers["ltsh4.combined"][..., :3] - layers["ltsh4.specular"] - layers["ltsh4.diffuse"]
    # The lamps, their front and the ball, and the sky behind all of it.
    assert emission.max() > 20.0 and (emission[is_lit].max(axis=-1) > 1.0).sum() > 20
    # Black on one side of the sky.
    assert (emission[0] > 1e-3).mean() > 0.3 or transparent


def test_shade_shows_the_same_picture(tmp_path):
    """Through the view transform of the scene, which is none here."""
    scene = room(True)
    scene.view_settings.view_transform = "Standard"
    path = parts.save(tmp_path / "room.blend")
    shade_scene(PictureOptions(path, output=tmp_path, techniques=("ltc", "ltsh4")))
    layers = imaging.read_layers(tmp_path / "shade.exr")
    assert not any(name.startswith("cycles") for name in layers)
    image = bpy.data.images.load(str(tmp_path / "shade.png"))
    found = np.array(image.pixels[:]).reshape(SIZE, SIZE, 4)[::-1]
    whole = layers["ltsh4.combined"]
    seen = np.clip(whole[..., :3] / np.maximum(whole[..., 3:], 1e-6), 0.0, 1.0)
    seen = np.where(seen < 0.0031308, 12.92 * seen, 1.055 * seen ** (1.0 / 2.4) - 0.055)
    is_whole = whole[..., 3] == 1.0
    assert is_whole.mean() > 0.2
    # Steps of 255 values, twice.
    np.testing.assert_allclose(found[is_whole, :3], seen[is_whole], atol=2.0 / 255.0)
    np.testing.assert_allclose(found[..., 3], np.clip(whole[..., 3], 0.0, 1.0), atol=1.0 / 255.0)
