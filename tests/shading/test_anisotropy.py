"""Anisotropic GGX against the textbook's formulas on small patches of the light."""

from dataclasses import replace

import numpy as np
import pytest
import quadrature
import random_surfaces

from ltsh_addon.scene import QuadLight
from ltsh_addon.shading import shade

COUNT = 60
HALF_U, HALF_V = np.array([1.5, 0.2, 0.1]), np.array([-0.15, -0.6, 1.0])
LIGHT = QuadLight(
    "Key", [0.3, 2.5, 2.2], HALF_U, HALF_V, random_surfaces.unit(np.cross(HALF_U, HALF_V)), [2.0, 1.5, 1.0]
)


def surfaces(anisotropy, seed=1, lowest=0.3):
    """COUNT samples under the light, with lobes that 192 x 192 patches of it resolve and alphas of at most 1."""
    random = np.random.default_rng(seed)
    samples = random_surfaces.samples("plain", COUNT, random)
    tangent = random.normal(size=(COUNT, 3))
    across = 1.0 - anisotropy
    roughness = (lowest + (1.0 - lowest) * samples.roughness) * np.sqrt(min(across, 1.0 / across))
    normal = random_surfaces.unit(samples.normal + [0.0, 0.0, 1.5])
    own = {"normal": normal, "geometric_normal": None, "roughness": roughness, "tangent": tangent}
    return replace(samples, anisotropy=np.full(COUNT, anisotropy), **own)


def specular(samples, technique, light=LIGHT, **options):
    return shade(samples, [light], technique, passes=("specular",), workers=1, **options).specular[0]


@pytest.mark.parametrize("anisotropy", [0.2, 0.62, 0.9, -0.5])
def test_reference_is_the_integral_of_anisotropic_ggx(anisotropy):
    """0.62 is that of a Principled BSDF with 0.95, 0.9 that of a Glossy BSDF."""
    samples = surfaces(anisotropy, lowest=0.9 if anisotropy > 0.8 else 0.4)
    expected = quadrature.radiance(samples, [LIGHT], quadrature.ggx, count=192)
    found = specular(samples, "reference")
    assert (expected.max(axis=1) > 1e-4).sum() > COUNT // 2
    # The patches leave 2e-4 of the largest light, and of lobes so narrow in one direction 5e-4.
    assert np.abs(found - expected).max() < 1e-3 * expected.max()


@pytest.mark.parametrize(("anisotropy", "tolerance"), [(0.1, 2e-4), (-0.5, 2e-4), (0.68, 1e-3), (0.9, 2e-3)])
def test_techniques_are_near_the_reference(anisotropy, tolerance):
    """They take fewer points of the same integrand, in single precision."""
    samples = surfaces(anisotropy)
    expected, found = specular(samples, "reference"), specular(samples, "ltsh4")
    assert np.linalg.norm(found - expected) < tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize(("technique", "tolerance"), [("reference", 3e-4), ("ltsh4", 5e-3)])
@pytest.mark.parametrize("anisotropy", [0.1, -0.5, 0.9])
def test_the_parts_of_a_light_that_is_wide_and_near_add_up(anisotropy, technique, tolerance):
    """In the space of half vectors its edges run around nearly all of the hemisphere. Small parts are easy."""
    samples, count = surfaces(anisotropy, lowest=0.1), 12
    light = replace(LIGHT, half_u=4.0 * HALF_U, half_v=4.0 * HALF_V)
    steps = (2.0 * np.arange(count) + 1.0) / count - 1.0
    own = {"half_u": light.half_u / count, "half_v": light.half_v / count}
    lights = [replace(light, center=light.center + s * light.half_u + t * light.half_v, **own)
              for s in steps for t in steps]  # fmt: skip
    expected = shade(samples, lights, "reference", passes=("specular",), workers=1).specular.sum(axis=0)
    found = specular(samples, technique, light)
    assert np.abs(found - expected).max() < tolerance * expected.max()


@pytest.mark.parametrize("kind", ["spread", "disk", "ball", "spot", "polygon", "linear", "sun"])
def test_anisotropic_lobes_meet_all_kinds_of_lights(kind):
    """Lights of 32 corners in place of round ones, and fewer points."""
    random = np.random.default_rng(5)
    samples, light = surfaces(0.3), random_surfaces.light(kind, 0, random)
    expected, found = specular(samples, "reference", light), specular(samples, "ltc", light)
    assert np.linalg.norm(expected) > 0.0
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)


def test_hardly_anisotropic_is_isotropic():
    samples = surfaces(1e-9)
    plain = replace(samples, anisotropy=np.zeros(COUNT))
    first, second = specular(samples, "reference"), specular(plain, "reference")
    assert np.allclose(first, second, rtol=1e-3, atol=1e-4 * first.max())


@pytest.mark.parametrize("technique", ["ltc", "ltsh2", "ltsh4"])
def test_isotropic_samples_beside_anisotropic_ones_stay_what_they_are(technique):
    samples = surfaces(0.5)
    plain = np.arange(COUNT) % 2 == 0
    mixed = replace(samples, anisotropy=np.where(plain, 0.0, samples.anisotropy))
    alone = specular(mixed.take(plain), technique)
    assert np.array_equal(specular(mixed, technique)[plain], alone)
