"""An oracle for shading: the light's surface cut into small patches of equal area, the BRDF written out.

Shares nothing with the package but its data classes. With 64 x 64 patches and a light that stays above every horizon
the error is below 1e-4 for roughness of 0.3 and more.
"""

from __future__ import annotations

import numpy as np


def patch_centers(light, count=64) -> tuple[np.ndarray, float]:
    """Points (S, 3) on the light, and its area in m^2."""
    steps = (np.arange(count) + 0.5) / count
    area = np.linalg.norm(np.cross(light.half_u, light.half_v))
    if light.is_round:
        radius, angle = np.meshgrid(np.sqrt(steps), 2.0 * np.pi * steps)
        s, t, area = radius * np.cos(angle), radius * np.sin(angle), area * np.pi
    else:
        s, t = np.meshgrid(2.0 * steps - 1.0, 2.0 * steps - 1.0)
        area = 4.0 * area
    return light.center + s.ravel()[:, None] * light.half_u + t.ravel()[:, None] * light.half_v, area


def lambert(directions, samples):
    """Diffuse BRDF times cosine (P, S, 3)."""
    cosine = np.maximum(_dot(directions, samples.diffuse_normal), 0.0)
    return cosine[..., None] * samples.diffuse_albedo[:, None] / np.pi


def ggx(directions, samples):
    """Specular BRDF times cosine (P, S, 3): GGX, height-correlated Smith, Fresnel as in `SurfaceSamples`."""
    alpha2 = samples.roughness[:, None] ** 4
    cos_o = np.sum(samples.normal * samples.view, axis=-1)[:, None]
    cos_i = _dot(directions, samples.normal)
    half = directions + samples.view[:, None]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cos_h, cos_d = _dot(half, samples.normal), np.sum(half * directions, axis=-1)
    distribution = alpha2 / (np.pi * (cos_h**2 * (alpha2 - 1.0) + 1.0) ** 2)
    lit = (cos_i > 0.0) & (cos_o > 0.0)
    smith = 1.0 / (1.0 + _smith(alpha2, cos_o) + _smith(alpha2, np.where(lit, cos_i, 1.0)))
    value = np.where(lit, distribution * smith / (4.0 * cos_o), 0.0)
    schlick = (1.0 - cos_d[..., None]) ** 5
    f0, f90 = samples.specular_f0[:, None], samples.specular_f90[:, None]
    dip = samples.specular_dip[:, None] * (cos_d * (1.0 - cos_d) ** 6)[..., None]
    dielectric = samples.dielectric[:, None] * dielectric_fresnel(cos_d, samples.ior[:, None])[..., None]
    return value[..., None] * (f0 + (f90 - f0) * schlick - dip + dielectric)


def dielectric_fresnel(cosine, ior):
    """Reflectance of unpolarized light from the two amplitude formulas."""
    cos_t = np.sqrt(np.maximum(1.0 - (1.0 - cosine**2) / ior**2, 0.0))
    parallel = (ior * cosine - cos_t) / (ior * cosine + cos_t)
    perpendicular = (cosine - ior * cos_t) / (cosine + ior * cos_t)
    return 0.5 * (parallel**2 + perpendicular**2)


def radiance(samples, lights, brdf, count=64, weight=None) -> np.ndarray:
    """Reflected radiance (P, 3); `weight(directions)` (P, S) multiplies the BRDF."""
    total = np.zeros((len(samples), 3))
    for light in lights:
        centers, area = patch_centers(light, count)
        offset = centers - samples.position[:, None]
        distance2 = np.sum(offset**2, axis=-1)
        directions = offset / np.sqrt(distance2)[..., None]
        geometry = np.maximum(-(directions @ light.direction), 0.0) / distance2
        if weight is not None:
            geometry = geometry * weight(directions)
        total += np.einsum("ps,psc->pc", geometry, brdf(directions, samples)) * area / len(centers) * light.radiance
    return total


def relative_l2(image, halves) -> float:
    """Relative L2 distance of `image` (P, 3) from the mean of two `halves` (2, P, 3), their own noise removed."""
    squared = np.sum((image - halves[0]) * (image - halves[1])) / np.sum(halves[0] * halves[1])
    return float(np.sqrt(max(squared, 0.0)))


def bias(image, halves) -> float:
    """Relative difference of the sums."""
    return float(np.sum(image) / np.sum(halves.mean(axis=0)) - 1.0)


def _dot(directions, vectors):
    return np.einsum("psk,pk->ps", directions, vectors)


def _smith(alpha2, cosine):
    return 0.5 * (np.sqrt(1.0 + alpha2 * (1.0 / cosine**2 - 1.0)) - 1.0)
