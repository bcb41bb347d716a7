"""Albedos of rough glass, reflected and refracted light together, as Cycles tabulates them. Needs no bpy.

Computed when a scene has glass with multiple scattering, in about a second: for each node the mean over visible
normals (Heitz 2018, "Sampling the GGX distribution of visible normals").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

NODES = 16
NORMALS_PER_AXIS = 24
SMALLEST_COSINE = 1e-4
MAX_F0 = 0.99


@dataclass(frozen=True)
class GlassAlbedos:
    """Tables by roughness, cosine of the view and ((ior - 1) / (ior + 1))^(1/2), for one side of the surface."""

    albedo: np.ndarray  # (R, C, Z) of all light
    average: np.ndarray  # (R, Z) integral of 2 mu albedo(mu)


@cache
def glass_albedos(inside: bool) -> GlassAlbedos:
    """Tables of a surface seen from outside, or from inside."""
    nodes = np.clip(np.linspace(0.0, 1.0, NODES), SMALLEST_COSINE, 1.0)
    albedo = np.empty((NODES, NODES, NODES))
    root = np.sqrt(np.minimum(nodes**4, MAX_F0))
    for row, roughness in enumerate(nodes):
        normals = _visible_normals(roughness**2, nodes)
        for column, ior in enumerate((1.0 + root) / (1.0 - root)):
            albedo[row, :, column] = _albedo(normals, nodes, roughness**2, 1.0 / ior if inside else ior)
    # The albedo is linear between nodes, mu times it is not: Simpson's rule for each piece.
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    ends = nodes[:, None] * albedo
    between = middle[:, None] * 0.5 * (albedo[:, 1:] + albedo[:, :-1])
    pieces = (ends[:, 1:] + ends[:, :-1] + 4.0 * between) * np.diff(nodes)[:, None] / 6.0
    return GlassAlbedos(albedo, 2.0 * pieces.sum(axis=1))


def _visible_normals(alpha, cosine):
    """Normals (N, C, 3) that are seen under `cosine` (C,), the view having y = 0, evenly by probability."""
    steps = (np.arange(NORMALS_PER_AXIS) + 0.5) / NORMALS_PER_AXIS
    radius, turn = np.meshgrid(np.sqrt(steps), 2.0 * np.pi * steps)
    s, t = (radius * np.cos(turn)).reshape(-1, 1), (radius * np.sin(turn)).reshape(-1, 1)
    view = np.stack([alpha * np.sqrt(1.0 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    first = np.broadcast_to([0.0, 1.0, 0.0], view.shape)
    second = np.cross(view, first)
    half = 0.5 * (1.0 + view[:, 2])
    t = (1.0 - half) * np.sqrt(1.0 - s * s) + half * t
    height = np.sqrt(np.maximum(1.0 - s * s - t * t, 0.0))
    normal = s[..., None] * first + t[..., None] * second + height[..., None] * view
    normal[..., :2] *= alpha
    normal[..., 2] = np.maximum(normal[..., 2], 0.0)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _albedo(normals, cosine, alpha, ior):
    """Albedo (C,) for views under `cosine` (C,)."""
    view = np.stack([np.sqrt(1.0 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)
    towards = np.maximum((normals * view).sum(axis=-1), 0.0)
    fresnel = internal_reflectance(towards, ior)
    refracted = np.sqrt(np.maximum(1.0 - (1.0 - towards**2) / ior**2, 0.0))
    up = 2.0 * towards * normals[..., 2] - cosine
    down = (refracted - towards / ior) * normals[..., 2] + cosine / ior
    reflected, transmitted = (_seen(height, cosine, alpha) for height in (up, down))
    return (fresnel * reflected + (1.0 - fresnel) * transmitted).mean(axis=0)


def internal_reflectance(cosine, ior):
    """Fresnel reflectance of a dielectric of any relative `ior`, with total reflection where it is below 1."""
    square = 1.0 - (1.0 - cosine**2) / ior**2
    refracted = np.sqrt(np.maximum(square, 0.0))
    parallel = (refracted - ior * cosine) / np.maximum(refracted + ior * cosine, 1e-12)
    perpendicular = (cosine - ior * refracted) / np.maximum(cosine + ior * refracted, 1e-12)
    return np.where(square > 0.0, 0.5 * (parallel**2 + perpendicular**2), 1.0)


def _seen(height, cosine, alpha):
    """Share of the light towards directions with cosine `height` that height-correlated Smith masking lets through,
    given that the normal is seen; none below the horizon."""
    entering, leaving = (_masked(value, alpha) for value in (cosine, np.maximum(height, 1e-9)))
    return np.where(height > 0.0, (1.0 + entering) / (1.0 + entering + leaving), 0.0)


def _masked(cosine, alpha):
    return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / cosine**2 - 1.0)) - 1.0)
