"""Lights with children: each sample takes all of the light once, in patches as small as it needs."""

from dataclasses import replace

import numpy as np
import pytest
import random_surfaces

from ltsh_addon import shading
from ltsh_addon.cycles.patches import cut_into_patches, split_light
from ltsh_addon.emitters.light_polygons import fitting_patches
from ltsh_addon.scene import light_of

PLACES = {
    "rectangle": {"half_u": (0.8, 0, 0), "half_v": (0, -0.6, 0)},
    "ellipse": {"shape": "ELLIPSE", "half_u": (0.9, 0, 0), "half_v": (0, -0.7, 0)},
    "spread": {"half_u": (0.8, 0, 0), "half_v": (0, -0.6, 0), "spread": 1.2},
}


def textured_light(place="rectangle", most=128):
    """A light with blurred noise of high contrast on it."""
    image = np.random.default_rng(8).normal(size=(64, 64, 3))
    for axis in (0, 1):
        image = sum(np.roll(image, shift, axis) for shift in range(-6, 7))
    image = np.exp(image / image.std())
    x, y = np.meshgrid(*(np.linspace(-1.0, 1.0, 64),) * 2)
    covered = np.hypot(x, y) < 1.0 if place == "ellipse" else np.ones((64, 64), bool)
    placed = {
        "name": "Lamp",
        "shape": "RECTANGLE",
        "center": (0.0, 0.0, 2.0),
        "direction": (0.0, 0.0, -1.0),
        "radiance": (5.0, 3.0, 1.0),
    }
    (light,) = split_light(light_of(placed | PLACES[place]), cut_into_patches(image, covered, most))
    return light


def metals(count):
    """White metals of all kinds of roughness."""
    samples, white = random_surfaces.samples("plain", count, np.random.default_rng(1)), np.ones((count, 3))
    terms = {"specular_f0": white, "specular_f90": white, "specular_dip": 0.0 * white, "dielectric": 0.0 * white}
    return replace(samples, roughness=0.02 + 0.98 * samples.roughness, diffuse_albedo=white, **terms)


@pytest.mark.parametrize("specular", [False, True])
@pytest.mark.parametrize("place", PLACES)
def test_every_sample_gets_the_whole_light_once(place, specular):
    light, samples = textured_light(place), metals(50)
    power, count = np.zeros((50, 3)), np.zeros(50)
    for index, patches in fitting_patches(light, samples, specular):
        for patch in patches:
            power[index] += np.linalg.norm(patch.area_vector) * patch.radiance
            count[index] += 1
    # The pixels of an ellipse cover its edge only roughly.
    expected = np.linalg.norm(light.area_vector) * light.radiance
    assert np.allclose(power, expected, rtol=1e-9 if place != "ellipse" else 0.02)
    assert count.max() <= len(light.leaves) and count.mean() < len(light.leaves)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_patches_that_fit_give_the_light_of_the_smallest_ones(dtype):
    """Of the table "ltc": a tree of lights gives those of degrees above 0 the true value in their tails."""
    light, samples = textured_light(), metals(150)
    expected = shading.shade(samples, light.leaves, "ltc", workers=1, dtype=np.float64, rows=[0] * len(light.leaves))
    found = shading.shade(samples, [light], "ltc", workers=1, dtype=dtype)
    for name in shading.PASSES:
        exact, coarse = getattr(expected, name), getattr(found, name)
        # Of the whole light as one patch it is 5 % and more.
        assert np.linalg.norm(coarse - exact) < 3e-3 * np.linalg.norm(exact), name
        plain = getattr(shading.shade(samples, [replace(light, children=())], "ltc", passes=(name,), workers=1), name)
        assert np.linalg.norm(plain - exact) > 0.04 * np.linalg.norm(exact), name


def test_dark_patches_shine_where_the_lobe_meets_no_other():
    """Surfaces 2 cm under a light of two cells, of which one has a hundredth of the other's brightness."""
    image = np.ones((64, 64, 3))
    image[:, :32] += 99.0 * (np.arange(64) >= 32)[:, None, None]
    covered = np.ones((64, 64), bool)
    (light,) = split_light(replace(textured_light(), children=()), cut_into_patches(image, covered, 128))
    light = replace(light, children=tuple(one for leaf in light.leaves for one in quarters(leaf, 3)))
    samples = metals(2000)
    x, y = np.meshgrid(np.linspace(-0.75, 0.75, 50), np.linspace(-0.55, 0.55, 40))
    position = np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.98)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(position), 1))
    view = np.array([0.0, -3.0, 3.5]) - position
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    normals = dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), up)
    samples = replace(samples, position=position, view=view, roughness=np.full(len(up), 0.12), **normals)
    found = shading.shade(samples, [light], passes=("specular",), workers=1).specular[0]
    chosen = np.arange(0, len(up), 19)
    expected = shading.shade(samples.take(chosen), light.leaves, passes=("specular",), workers=1, dtype=np.float64)
    expected = expected.specular.sum(axis=0)
    assert (np.abs(found[chosen] - expected) < 0.01 * expected).all()


def quarters(light, levels):
    """`light` cut into quarters, and these again, `levels` times."""
    if levels == 0:
        return [light]
    half = {"half_u": 0.5 * light.half_u, "half_v": 0.5 * light.half_v}
    centers = [light.center + s * half["half_u"] + t * half["half_v"] for s in (-1, 1) for t in (-1, 1)]
    return [one for center in centers for one in quarters(replace(light, center=center, **half), levels - 1)]


def test_the_reference_takes_the_same_patches():
    light, samples = textured_light(most=16), metals(6)
    expected = shading.shade(samples, light.leaves, shading.REFERENCE, workers=1).specular.sum(axis=0)
    found = shading.shade(samples, [light], shading.REFERENCE, workers=1)
    assert np.linalg.norm(found.specular - expected) < 3e-3 * np.linalg.norm(expected)
    assert found.quadrature_error.shape == (6,) and found.quadrature_error.max() > 0.0
