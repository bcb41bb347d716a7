"""A picture that the light mixer mixes is the picture of a scene whose lights are changed like that."""

import bpy
import numpy as np
import pytest
import scene_parts as parts

from ltsh_addon import imaging
from ltsh_addon.pipeline import PictureOptions, shade_scene
from ltsh_addon.pipeline.mixer import Mixer, light_pictures
from ltsh_addon.pipeline.relight import RelightData, tint

SIZE = 48, 32
# Of single precision: in sums of five lights, and in files.
ROUNDING = 1e-5
# Factor of power, steps of exposure, color.
CHANGES = {"Key": (2.5, 0.0, (1.0, 0.6, 0.3)), "Spot": (1.0, -1.5, (0.8, 0.9, 1.0)), "Sun": (0.0, 0.0, (1.0, 1.0, 1.0))}


def add_light(kind, name, energy, color, **placement):
    return parts.link(parts.new_light(name, kind, energy=energy, color=color), **placement)


@pytest.fixture
def room(tmp_path):
    """A ball of flat faces on a floor under an area light, a spot, a sun, a glowing plane and the world."""
    parts.empty_scene(*SIZE)
    parts.add_camera()
    floor = parts.principled("Floor")[0]
    parts.add_plane(floor)
    parts.add_sphere(parts.principled("Ball")[0], smooth=False, location=(0.0, 0.0, 0.8))
    add_light("AREA", "Key", 60.0, (1.0, 0.9, 0.7), location=(1.0, -1.0, 2.5), rotation=(0.3, 0.4, 0.0))
    add_light("SPOT", "Spot", 80.0, (0.4, 0.9, 1.0), location=(-2.0, -1.0, 2.5), rotation=(0.4, -0.6, 0.0))
    add_light("SUN", "Sun", 0.7, (1.0, 1.0, 1.0), rotation=(0.7, 0.3, 0.0))
    material, _ = parts.bsdf_material("ShaderNodeEmission", "Glow", Strength=3.0)
    parts.add_plane(material, size=0.8, name="Lamp", location=(0.0, 1.5, 2.0), rotation=(2.4, 0.0, 0.0))
    parts.add_white_world()
    return parts.save(tmp_path / "room.blend")


def shade(scene, output, shadows):
    """Radiance (H, W, 3)."""
    options = PictureOptions(scene, output=output, techniques=("ltsh4",), shadows=shadows, keep_visibility=True)
    report = shade_scene(options)
    layers = imaging.read_layers(output / "shade.exr")
    return layers["ltsh4.specular"] + layers["ltsh4.diffuse"], report


@pytest.mark.parametrize("shadows", ["off", "on"])
def test_a_mixed_picture_is_that_of_a_changed_scene(room, tmp_path, shadows):
    before, _ = shade(room, tmp_path / "before", shadows)
    mixer = Mixer(light_pictures(RelightData.load(tmp_path / "before" / "shade.samples.npz")))
    assert {row.name for row in mixer.rows} == {"Key", "Spot", "Sun", "Lamp", "World"}
    factors = np.ones((len(mixer.rows), 3))
    np.testing.assert_allclose(mixer.mixed(factors)[::-1, :, :3], before, rtol=ROUNDING, atol=ROUNDING * before.max())
    for number, row in enumerate(mixer.rows):
        if row.name in CHANGES:
            power, exposure, color = CHANGES[row.name]
            data = bpy.data.objects[row.name].data
            assert row.settings[row.name] == pytest.approx([data.energy, data.exposure, *data.color])
            factor = tint(np.array(row.color), color)
            data.energy, data.exposure, data.color = data.energy * power, exposure, factor * data.color
            factors[number] = power * 2.0**exposure * factor
    expected, report = shade(parts.save(tmp_path / "changed.blend"), tmp_path / "after", shadows)
    found = mixer.mixed(factors)[::-1, :, :3]
    if shadows == "off":
        np.testing.assert_allclose(found, expected, rtol=ROUNDING, atol=ROUNDING * expected.max())
    # How many rays a light gets follows its share of all light, so both have noise of their own.
    difference = np.sqrt(np.square(found - expected).sum() / np.square(expected).sum())
    noise = 0.0 if report["shadows"] is None else max(report["shadows"]["noise"].values())
    assert difference < 3.0 * noise + ROUNDING
