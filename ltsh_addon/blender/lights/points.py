"""Point, spot and sun lights of an evaluated scene as `AreaLight`.

As Cycles 4.5 and 5.2 have them. The radius of points and spots is not scaled with the object; the cone of a spot is.
Radiance of balls and disks: L = strength / (4 pi^2 r^2), strength / pi without Normalize, strength the product of
color, temperature color, energy and 2^exposure; of a sun of half the angle h: strength / (pi sin^2 h), or strength.
"""

from __future__ import annotations

import math

import numpy as np

from ...scene import AreaLight, SpotCone

# In m and rad: what has no size is that large. Only its solid angle times its radiance matters.
LEAST_RADIUS, LEAST_ANGLE = 1e-6, 2e-5
# Suns fill at most this half angle in rad: as far as a plane in front of the eye reaches.
WIDEST_SUN = 1.5698
# Of a cone without blend.
SHARPEST = 1e9


def point_light(ob, matrix: np.ndarray, **traits) -> AreaLight:
    """The evaluated point, spot or sun light `ob` at `matrix` (4, 4); `traits` are fields of the AreaLight."""
    light, axis = ob.data, -matrix[:3, 2] / max(np.linalg.norm(matrix[:3, 2]), 1e-30)
    if light.type == "SUN":
        return _sun(light, ob.original.name, axis, traits)
    radius = max(light.shadow_soft_size, 0.0)
    # Without a size it is the intensity that is given.
    area = math.pi * max(radius, LEAST_RADIUS) ** 2 if radius <= LEAST_RADIUS else 1.0
    scale = 1.0 / math.pi / area
    if light.normalize:
        scale /= 4.0 * math.pi * radius**2 if radius > LEAST_RADIUS else 4.0
    radius = max(radius, LEAST_RADIUS)
    return AreaLight(
        name=ob.original.name,
        shape="FACING_DISK" if light.use_soft_falloff else "BALL",
        center=matrix[:3, 3],
        half_u=np.array([radius, 0.0, 0.0]),
        half_v=np.array([0.0, radius, 0.0]),
        direction=axis if light.type == "SPOT" else np.array([0.0, 0.0, -1.0]),
        radiance=strength(light) * scale,
        cone=_cone(light, matrix) if light.type == "SPOT" else None,
        **traits,
    )


def strength(light) -> np.ndarray:
    """Color times power (3,)."""
    value = np.array(light.color, dtype=np.float64) * light.energy * 2.0**light.exposure
    if light.use_temperature:
        value *= np.array(light.temperature_color, dtype=np.float64)[:3]
    return value


def _cone(light, matrix) -> SpotCone:
    cosine = math.cos(0.5 * light.spot_size)
    blend = (1.0 - cosine) * light.spot_blend
    return SpotCone(np.linalg.inv(matrix[:3, :3]), cosine, min(1.0 / max(blend, 1e-30), SHARPEST))


def _sun(light, name, axis, traits) -> AreaLight:
    half = 0.5 * light.angle
    value = strength(light)
    if half <= LEAST_ANGLE:
        half = LEAST_ANGLE
        value = value / (math.pi * math.sin(half) ** 2)
    elif light.normalize:
        value = value / (math.pi * math.sin(half) ** 2)
    half = min(half, WIDEST_SUN)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first *= math.sin(half) / np.linalg.norm(first)
    return AreaLight(
        name=name,
        shape="DISK",
        center=-math.cos(half) * axis,
        half_u=first,
        half_v=np.cross(axis, first),
        direction=axis,
        radiance=value,
        is_distant=True,
        **traits,
    )
