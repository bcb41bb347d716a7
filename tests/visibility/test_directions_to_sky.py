"""Directions to the sky: as likely as they say, and all of its light in their weights."""

import numpy as np
import pytest

from ltsh_addon.cycles.environment import CUBE, SkyPicture, sky_lights
from ltsh_addon.scene import SkyLight
from ltsh_addon.visibility.emitter import Sky
from ltsh_addon.visibility.light_cluster import emitters_of
from ltsh_addon.visibility.sampling import unit_points

LIKE = SkyLight("Sky", [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], np.ones(3))
NORMALS = np.array([[0.0, 0.6, -0.8], [0.0, 0.8, 0.0], [1.0, 0.0, 0.6]], np.float32)  # (3, Q)


def pictures():
    """A sky that is dark on one side and 50 times as bright in a window as elsewhere; pixels as many as its cells."""
    found = []
    for number, axes in enumerate(CUBE):
        radiance = np.full((64, 64, 3), 0.0 if number == 3 else 1.0 + number)
        radiance[10:14, 30:50] *= 50.0
        found.append(SkyPicture(*axes, radiance))
    return found


def constant():
    """A sky of the radiance 2."""
    return [SkyPicture(*axes, np.full((64, 64, 3), 2.0)) for axes in CUBE]


def test_the_sides_of_a_sky_have_one_emitter():
    lights, _ = sky_lights(LIKE, pictures())
    lamp = SkyLight("Sky", [0, 0, 1], [0.1, 0, 0], [0, 0.1, 0], [0, 0, -1], np.ones(3))
    emitters, numbers = emitters_of([lamp, *lights])
    assert numbers == ((0,), (1, 2, 3, 4, 5)) and isinstance(emitters[1], Sky)


@pytest.mark.parametrize("taken", (pictures(), constant()), ids=("window", "constant"))
def test_weights_of_directions_add_up_to_the_irradiance(taken):
    """Beside the sum over pixels. 1024 stratified directions leave 1 % at a contrast of 50, patches differ by 2 %."""
    sky = Sky(sky_lights(LIKE, taken)[0])
    points = unit_points(np.arange(3, dtype=np.uint32), 0, 0, 1024)
    directions = sky.directions(*points, NORMALS)
    np.testing.assert_allclose((directions**2).sum(axis=0), 1.0, atol=1e-5)
    cosine = np.einsum("ksq,kq->sq", directions, NORMALS)
    assert cosine.min() > -1e-3
    density, brightness = sky.along(directions, NORMALS)
    found = (np.maximum(cosine, 0.0) * brightness / density).mean(axis=0) * sky.light.radiance[0]
    expected = np.zeros(3)
    for picture in taken:
        offsets = picture.offsets()
        toward = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
        light = (picture.radiance[..., 0] * picture.solid_angles())[..., None]
        expected += (np.maximum(toward @ NORMALS, 0.0) * light).sum(axis=(0, 1))
    np.testing.assert_allclose(found, expected, rtol=0.03)


def test_each_direction_to_a_constant_sky_tells_its_irradiance():
    """That is pi times the radiance. Planes tilted by an angle b get (1 + cos b) / 2 of it, on average."""
    sky = Sky(sky_lights(LIKE, constant())[0])
    directions = sky.directions(*unit_points(np.arange(3, dtype=np.uint32), 0, 0, 1024), NORMALS)
    density, brightness = sky.along(directions, NORMALS)
    weights = brightness / density * sky.light.radiance[0]
    # The least of 1024 cosines is about 0.02, of which the rounding of 1e-7 is 5e-6.
    np.testing.assert_allclose(np.einsum("ksq,kq->sq", directions, NORMALS) * weights, 2.0 * np.pi, rtol=1e-4)
    tilted = np.roll(NORMALS, 1, axis=1)
    found = (np.maximum(np.einsum("ksq,kq->sq", directions, tilted), 0.0) * weights).mean(axis=0)
    # 1024 stratified directions; near the horizon of the normal weights are large.
    np.testing.assert_allclose(found, np.pi * (1.0 + (tilted * NORMALS).sum(axis=0)), rtol=0.03)
