"""Round lights are polygons with as many corners as it takes: their error against finer polygons and exact ellipses."""

import numpy as np
import pytest
from surface_scenes import area_light, single_sample, unit

from ltsh_addon import shading
from ltsh_addon.scene import PolygonLight, SurfaceSamples

# Of the root mean square, and of a single value no less than a hundredth of the largest.
TYPICAL, WORST = 1e-3, 0.05


def samples_under(light, distance, roughness, grazing, count=120, seed=0):
    """Points at `distance`, in half axes, from the light's plane, whose mirror directions meet the light or not."""
    generator = np.random.default_rng(seed)
    side = generator.uniform(-1.3, 1.3, size=(count, 2))
    position = light.center + side[:, :1] * light.half_u + side[:, 1:] * light.half_v
    position = position + distance * np.linalg.norm(light.half_u) * light.direction
    angle, radius = generator.uniform(0.0, 2.0 * np.pi, count), np.sqrt(generator.uniform(0.0, 1.1, count))
    target = light.center + (radius * np.cos(angle))[:, None] * light.half_u
    target = target + (radius * np.sin(angle))[:, None] * light.half_v
    toward = unit(target - position)
    cosine = generator.uniform(*((0.03, 0.15) if grazing else (0.15, 0.98)), size=(count, 1))
    normal = cosine * toward + np.sqrt(1.0 - cosine**2) * unit(np.cross(toward, generator.normal(size=(count, 3))))
    ones = np.ones((count, 3))
    return SurfaceSamples(
        position, 2.0 * (toward * normal).sum(axis=1, keepdims=True) * normal - toward, normal, normal,
        np.full(count, roughness), ones, ones, np.zeros(count), np.full(count, 1.5), ones,
    )  # fmt: skip


def light_of(shape):
    return area_light(shape=shape, half_u=(0.6, 0, 0), half_v=(0, -0.6 if shape == "DISK" else -0.25, 0))


def relative_error(found, expected):
    error = np.abs(found - expected)
    assert np.sqrt((error**2).sum() / (expected**2).sum()) < TYPICAL
    assert (error / np.maximum(expected, 0.01 * expected.max())).max() < WORST


@pytest.mark.parametrize("grazing", [False, True], ids=["steep", "grazing"])
@pytest.mark.parametrize("roughness", [0.1, 0.5])
@pytest.mark.parametrize("distance", [0.05, 0.2, 3.0])
@pytest.mark.parametrize("shape", ["DISK", "ELLIPSE"])
def test_round_lights_are_round(shape, distance, roughness, grazing):
    """Both lobes and precisions, against a polygon of 768 corners, which is within 1e-6."""
    light = light_of(shape)
    samples = samples_under(light, distance, roughness, grazing)
    fine = PolygonLight.like(light, corners=light.polygon(768))
    expected = shading.shade(samples, [fine], "ltsh4", dtype=np.float64, workers=1)
    for dtype in (np.float32, np.float64):
        found = shading.shade(samples, [light], "ltsh4", dtype=dtype, workers=1)
        relative_error(found.specular, expected.specular)
        relative_error(found.diffuse, expected.diffuse)


@pytest.mark.parametrize("distance", [0.2, 2.0])
@pytest.mark.parametrize("roughness", [0.15, 0.5])
def test_fine_polygons_are_the_ellipses_of_the_reference(roughness, distance):
    """That 768 corners are enough is no assumption: the reference integrates the ellipse itself, to 1e-4."""
    light = light_of("ELLIPSE")
    samples = samples_under(light, distance, roughness, False, count=12)
    fine = PolygonLight.like(light, corners=light.polygon(192))
    found, expected = (
        shading.shade(samples, [one], shading.REFERENCE, passes=["specular"]).specular for one in (fine, light)
    )
    assert np.abs(found - expected).max() < 5e-4 * expected.max()


def test_a_point_at_the_middle_of_a_light_is_finite():
    """No lobe is resolved there."""
    light = light_of("DISK")
    sample = single_sample(position=light.center + 1e-9 * light.direction, normal=-light.direction)
    assert np.isfinite(shading.shade(sample, [light], "ltsh4").combined).all()
