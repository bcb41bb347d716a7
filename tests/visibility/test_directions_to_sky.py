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


def test_the_sides_of_a_sky_have_one_emitter():
    lights, _ = sky_lights(LIKE, pictures())
    lamp = SkyLight("Sky", [0, 0, 1], [0.1, 0, 0], [0, 0.1, 0], [0, 0, -1], np.ones(3))
    emitters, numbers = emitters_of([lamp, *lights])
    assert numbers == ((0,), (1, 2, 3, 4, 5)) and isinstance(emitters[1], Sky)


def test_weights_of_directions_add_up_to_the_irradiance():
    """Beside the sum over pixels. 1024 stratified directions leave 1 % at a contrast of 50, patches differ by 2 %."""
    taken = pictures()
    sky = Sky(sky_lights(LIKE, taken)[0])
    points = unit_points(np.arange(3, dtype=np.uint32), 0, 0, 1024)
    directions = sky.directions(*points, NORMALS)
    np.testing.assert_allclose((directions**2).sum(axis=0), 1.0, atol=1e-5)
    cosine = np.einsum("ksq,kq->sq", directions, NORMALS)
    assert cosine.min() > -1e-3
    density = sky.density(directions, NORMALS)
    found = (np.maximum(cosine, 0.0) * sky.brightness_along(directions) / density).mean(axis=0) * sky.light.radiance[0]
    expected = np.zeros(3)
    for picture in taken:
        offsets = picture.offsets()
        toward = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
        light = (picture.radiance[..., 0] * picture.solid_angles())[..., None]
        expected += (np.maximum(toward @ NORMALS, 0.0) * light).sum(axis=(0, 1))
    np.testing.assert_allclose(found, expected, rtol=0.03)


def test_densities_add_up_to_one():
    """Over the hemisphere of the normal, by the midpoints of pixels."""
    taken = pictures()
    sky, total = Sky(sky_lights(LIKE, taken)[0]), np.zeros(3)
    for picture in taken:
        offsets = picture.offsets().reshape(-1, 3)
        toward = (offsets / np.linalg.norm(offsets, axis=1, keepdims=True)).T[:, :, None]
        directions = np.broadcast_to(toward, (*toward.shape[:2], 3)).astype(np.float32)
        above = np.einsum("ksq,kq->sq", directions, NORMALS) > 0.0
        total += (sky.density(directions, NORMALS) * above * picture.solid_angles().reshape(-1, 1)).sum(axis=0)
    assert total == pytest.approx(np.ones(3), abs=0.02)
