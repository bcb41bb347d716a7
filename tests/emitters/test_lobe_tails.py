"""The tails of the lobes: spheres whose rims reflect light from behind the camera, with the true BRDF as oracle.

Toward the rim a lobe points away from the camera, and what comes back to it is a thousandth of the lobe's peak. Errors
that an L2 norm does not see can be larger than that.
"""

import numpy as np
import pytest
from surface_scenes import area_light, unit

from ltsh_addon import shading
from ltsh_addon.scene import SurfaceSamples

PIXELS, DISTANCE, RINGS = 24, 6.0, 10
# In units of the sphere's mean radiance; found is 0.1
BRIGHTEST = 0.15
# Of the largest radiance of a ring. Found is 0.0014: inside the highlight, where ltc has 0.0008.
HIGHLIGHT = 0.002
SURFACES = {"dielectric": 1.5, "water": 1.33, "metal": None}
ROUGHNESS = (0.2, 0.3, 0.5, 0.7, 1.0)


def light(center, size):
    """A square light that shines on the sphere."""
    center = np.array(center, float)
    direction = -unit(center)
    half_u = np.cross(direction, [0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    half_u = 0.5 * size * unit(half_u - (half_u @ direction) * direction)
    half_v = np.cross(half_u, direction)
    return area_light(center=center, direction=direction, half_u=half_u, half_v=half_v, radiance=(10.0, 10.0, 10.0))


KEY, BACK, FRONT = light((2.5, -2.5, 2.5), 1.5), light((-2.0, 2.5, 2.0), 1.5), light((-1.0, -4.0, 1.0), 1.0)
LOW, TOP = light((1.5, -5.0, -2.0), 0.5), light((0.0, 0.0, 3.0), 2.0)
LIGHTS = {"key": [KEY], "front": [FRONT], "low": [LOW], "top and key": [TOP, KEY], "three": [KEY, FRONT, BACK]}


def sphere(surface, roughness):
    """Samples of a unit sphere as a camera at a distance of 6 sees it, PIXELS across."""
    half = 1.02 * np.tan(np.arcsin(1.0 / DISTANCE))
    t = ((np.arange(PIXELS) + 0.5) / PIXELS * 2.0 - 1.0) * half
    x, z = (grid.ravel() for grid in np.meshgrid(t, t))
    ray = unit(np.stack([x, np.ones_like(x), z], axis=1))
    reach = ray[:, 1] * DISTANCE
    root = reach**2 - (DISTANCE**2 - 1.0)
    ray, reach, root = ray[root > 0.0], reach[root > 0.0], np.sqrt(root[root > 0.0])
    normal = unit(np.array([0.0, -DISTANCE, 0.0]) + (reach - root)[:, None] * ray)
    one = np.ones_like(normal)
    metal, count = SURFACES[surface] is None, len(normal)
    return SurfaceSamples(
        position=normal,
        view=-ray,
        normal=normal,
        diffuse_normal=normal,
        roughness=np.full(count, roughness),
        specular_f0=0.9 * one if metal else 0.0 * one,
        specular_f90=one if metal else 0.0 * one,
        dielectric=np.full(count, 0.0 if metal else 1.0),
        ior=np.full(count, SURFACES[surface] or 1.5),
        diffuse_albedo=0.0 * one,
    )


@pytest.fixture(scope="module")
def pictures():
    """{(surface, roughness, lights): (n.v, {technique: radiance})}, one number per pixel."""
    found = {}
    for surface in SURFACES:
        for roughness in ROUGHNESS:
            samples = sphere(surface, roughness)
            cosine = (samples.normal * samples.view).sum(axis=1)
            for name, lights in LIGHTS.items():
                radiance = {
                    technique: shading.shade(samples, lights, technique, passes=("specular",)).combined[:, 0]
                    for technique in ("ltc", "ltsh2", "ltsh4", "ltsh4c", shading.REFERENCE)
                }
                found[surface, roughness, name] = cosine, radiance
    return found


@pytest.mark.parametrize("technique", ["ltsh2", "ltsh4", "ltsh4c"])
def test_no_pixel_is_black_where_there_is_light(pictures, technique):
    for scene, (_, radiance) in pictures.items():
        exact = radiance[shading.REFERENCE]
        black = (radiance[technique] <= 0.0) & (exact > 0.05 * exact.mean())
        assert not black.any(), (scene, np.count_nonzero(black))


@pytest.mark.parametrize("technique", ["ltsh4", "ltsh4c"])
def test_no_pixel_is_far_too_bright(pictures, technique):
    """Fitted with an L2 norm alone some pixels were four times too bright plus seven times the sphere's mean."""
    for scene, (_, radiance) in pictures.items():
        exact = radiance[shading.REFERENCE]
        excess = (radiance[technique] - 4.0 * exact).max() / exact.mean()
        assert excess < BRIGHTEST, (scene, excess)


def test_no_ring_is_further_off_than_with_cosines(pictures):
    """Rings of n.v, a tenth wide: the largest error of each against that of LTC, give or take what nobody sees."""
    for scene, (cosine, radiance) in pictures.items():
        exact = radiance[shading.REFERENCE]
        ring = np.minimum((cosine * RINGS).astype(int), RINGS - 1)
        for number in np.unique(ring):
            here = ring == number
            errors = {name: np.abs(radiance[name] - exact)[here].max() for name in ("ltc", "ltsh4")}
            margin = 0.001 * exact.mean() + HIGHLIGHT * exact[here].max()
            assert errors["ltsh4"] <= errors["ltc"] + margin, (scene, number / RINGS, errors, margin)


def test_errors_are_a_twentieth_of_those_with_cosines(pictures):
    """Root mean squares over all spheres, each in means of its own: found are 0.029 and 0.63."""
    means = {
        name: np.mean([
            np.sqrt(np.mean((radiance[name] - radiance[shading.REFERENCE]) ** 2)) / radiance[shading.REFERENCE].mean()
            for _, radiance in pictures.values()
        ])
        for name in ("ltc", "ltsh4", "ltsh4c")
    }  # fmt: skip
    assert means["ltsh4"] < 0.055 * means["ltc"], means
    assert means["ltsh4c"] < 0.7 * means["ltsh4"], means
