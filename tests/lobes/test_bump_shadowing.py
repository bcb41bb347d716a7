"""The mean of bump shadowing over lights, beside quadrature over their area."""

import numpy as np
import pytest
from surface_scenes import area_light, single_sample, unit

from ltsh_addon.shading import shade

# Of lights whose form factor is not tiny.
PROMISED = 3e-3
NODES, WEIGHTS = (0.5 * values for values in np.polynomial.legendre.leggauss(48))
# Sides of a cube around the point, and ever larger lights beside it.
SIDES = [np.roll([0.0, 0.0, sign], axis) for axis in range(3) for sign in (-1.0, 1.0)]
SIZES = (0.1, 0.3, 1.0, 3.0, 8.0)


def clipped(corners, axis):
    """The part of a polygon (V, 3) above the plane through the origin with a normal (3,)."""
    height, result = corners @ axis, []
    for i in range(len(corners)):
        j = (i + 1) % len(corners)
        result += [corners[i]] if height[i] > 0.0 else []
        if (height[i] > 0.0) != (height[j] > 0.0):
            result.append(corners[i] + height[i] / (height[i] - height[j]) * (corners[j] - corners[i]))
    return np.array(result).reshape(-1, 3)


def by_quadrature(corners, normal, smooth, alpha2):
    """Form factor under bump shadowing of the polygon (V, 3), by nodes in triangles that are dense near the edges."""
    corners = clipped(clipped(corners, smooth), normal)
    if len(corners) < 3:
        return 0.0
    center, total, u = corners.mean(axis=0), 0.0, NODES[:, None] + 0.5
    for start, end in zip(corners - center, np.roll(corners, -1, axis=0) - center, strict=True):
        outward = (1.0 - (1.0 - u) ** 2)[..., None]
        point = center + outward * (start + (NODES + 0.5)[:, None] * (end - start))
        distance = np.linalg.norm(point, axis=2)
        weight = (WEIGHTS[:, None] * WEIGHTS) * 2.0 * (1.0 - u) * outward[..., 0] * abs(point @ np.cross(start, end))
        cosine, z = np.maximum(point @ normal, 0.0) / distance, np.maximum(point @ smooth / distance, 1e-12)
        total += (weight * cosine / distance**3 * 2.0 / (1.0 + np.sqrt(1.0 + alpha2 * (1.0 / z**2 - 1.0)))).sum()
    return total / np.pi


def lights(size, random):
    """The sides of a cube around the origin, or one square light 1 m away, turned and moved at random."""
    toward = SIDES if size is None else [unit(random.normal(size=3))]
    size = 1.0 if size is None else size
    for axis in toward:
        half_u = size * (np.roll(axis, 1) if len(toward) > 1 else unit(np.cross(axis, random.normal(size=3))))
        half_v = np.cross(half_u, axis)
        move = 0.0 if len(toward) > 1 else 0.3 * (random.uniform(-1.0, 1.0, (2, 1)) * [half_u, half_v]).sum(axis=0)
        yield area_light(center=axis + move, half_u=half_u, half_v=half_v)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [None, *SIZES])
def test_bump_shadowing_is_its_mean_over_the_light(size, dtype):
    random, errors = np.random.default_rng(7), []
    for number in range(60):
        tangent = np.tan(random.uniform(0.0, np.pi / 3.0))
        # As Cycles has it, or any.
        alpha2 = tangent**2 / 8.0 if number % 2 else random.uniform(0.0, 2.0) ** 2
        smooth = unit(random.normal(size=3))
        normal = unit(smooth + tangent * unit(np.cross(smooth, random.normal(size=3))))
        sample = single_sample(diffuse_normal=normal, smooth_normal=smooth, bump_alpha2=alpha2)
        for light in lights(size, random):
            expected = light.radiance[0] * by_quadrature(light.polygon(), normal, smooth, alpha2)
            reflected = shade(sample, [light], workers=1, dtype=dtype, passes=("diffuse",)).diffuse[0, 0, 0]
            if expected > 0.01:
                errors.append(reflected / expected - 1.0)
    errors = np.abs(errors)
    assert len(errors) > 10
    assert errors.max() < PROMISED
    assert np.sqrt((errors**2).mean()) < 0.2 * PROMISED
