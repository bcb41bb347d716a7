"""An oracle for shading: the light's surface cut into small patches of equal area, the BRDF written out.

Shares nothing with the package but its data classes. With 64 x 64 patches and a light that stays above every horizon
the error is below 1e-4 for roughness of 0.3 and more.
"""

from __future__ import annotations

import numpy as np
import textbook

from ltsh_addon.scene import PolygonLight


def patches_of(light, count=64) -> tuple[np.ndarray, np.ndarray]:
    """Points (S, 3) on the light and the area (S,) in m^2 that each stands for, negative where a fan of triangles over
    a concave polygon counts what is outside once more and takes it off again."""
    if isinstance(light, PolygonLight):
        first, *others = light.corners
        fans = [_triangle_patches(light, first, *pair, count) for pair in zip(others, others[1:], strict=False)]
        return tuple(np.concatenate(parts) for parts in zip(*fans, strict=True))
    steps = (np.arange(count) + 0.5) / count
    area = np.linalg.norm(np.cross(light.half_u, light.half_v))
    if light.is_round:
        radius, angle = np.meshgrid(np.sqrt(steps), 2.0 * np.pi * steps)
        s, t, area = radius * np.cos(angle), radius * np.sin(angle), area * np.pi
    else:
        s, t = np.meshgrid(2.0 * steps - 1.0, 2.0 * steps - 1.0)
        area = 4.0 * area
    centers = light.center + s.ravel()[:, None] * light.half_u + t.ravel()[:, None] * light.half_v
    return centers, np.full(count**2, area / count**2)


def _triangle_patches(light, a, b, c, count):
    """Centers of count^2 equal triangles, the upright ones and those upside down."""
    i, j = np.nonzero(np.add.outer(np.arange(count), np.arange(count)) < count)
    inner = i + j < count - 1
    u = np.concatenate([i + 1.0 / 3.0, i[inner] + 2.0 / 3.0]) / count
    v = np.concatenate([j + 1.0 / 3.0, j[inner] + 2.0 / 3.0]) / count
    centers = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    area = 0.5 * np.dot(np.cross(b - a, c - a), light.direction)
    return centers, np.full(count**2, area / count**2)


def spread_factor(light, cosine) -> np.ndarray:
    """What the spread of the light makes of its radiance; `cosine` is that of the angle from its direction."""
    if light.spread >= np.pi - 1e-6:
        return np.ones_like(cosine)
    limit = np.tan(0.5 * light.spread)
    tangent = np.sqrt(np.maximum(1.0 / np.maximum(cosine, 1e-6) ** 2 - 1.0, 0.0))
    return np.maximum(limit - tangent, 0.0) / (limit - 0.5 * light.spread)


def lambert(directions, samples):
    """Diffuse BRDF times cosine (P, S, 3)."""
    cosine = np.maximum(_dot(directions, samples.diffuse_normal), 0.0)
    return cosine[..., None] * samples.diffuse_albedo[:, None] / np.pi


def ggx(directions, samples):
    """Specular BRDF times cosine (P, S, 3): GGX, height-correlated Smith, Fresnel as in `SurfaceSamples`.

    Anisotropic lobes by the formulas for alpha_x and alpha_y of Heitz 2014, all samples or none."""
    alpha = samples.roughness[:, None] ** 2
    alpha2 = alpha**2
    cos_o = np.sum(samples.normal * samples.view, axis=-1)[:, None]
    cos_i = _dot(directions, samples.normal)
    half = directions + samples.view[:, None]
    half /= np.sqrt(np.einsum("psk,psk->ps", half, half))[..., None]
    cos_h, cos_d = _dot(half, samples.normal), np.einsum("psk,psk->ps", half, directions)
    distribution = alpha2 / (np.pi * (cos_h**2 * (alpha2 - 1.0) + 1.0) ** 2)
    lit = (cos_i > 0.0) & (cos_o > 0.0)
    smith = 1.0 / (1.0 + sum(textbook.smith_lambda(cosine, alpha) for cosine in (cos_o, np.where(lit, cos_i, 1.0))))
    if samples.anisotropy.any():
        along, across = _tangents(samples)
        x, y = alpha / (1.0 - samples.anisotropy[:, None]), alpha * (1.0 - samples.anisotropy[:, None])
        slopes = (_dot(half, along) / x) ** 2 + (_dot(half, across) / y) ** 2 + cos_h**2
        distribution = 1.0 / (np.pi * x * y * slopes**2)
        projected = [
            (_dot(vectors, along) * x) ** 2 + (_dot(vectors, across) * y) ** 2
            for vectors in (samples.view[:, None], directions)
        ]
        cosines = cos_o, np.where(lit, cos_i, 1.0)
        masking = [0.5 * (np.sqrt(1.0 + p / c**2) - 1.0) for p, c in zip(projected, cosines, strict=True)]
        smith = 1.0 / (1.0 + masking[0] + masking[1])
    value = np.where(lit, distribution * smith / (4.0 * cos_o), 0.0)
    schlick = (1.0 - cos_d[..., None]) ** 5
    f0, f90 = samples.specular_f0[:, None], samples.specular_f90[:, None]
    dip = samples.specular_dip[:, None] * (cos_d * (1.0 - cos_d) ** 6)[..., None]
    dielectric = samples.dielectric[:, None] * textbook.dielectric_fresnel(cos_d, samples.ior[:, None])[..., None]
    metal = f0 + (f90 - f0) * schlick - dip
    alone = ~samples.dielectric.any(axis=1)[:, None, None]
    return value[..., None] * (np.where(alone, np.maximum(metal, 0.0), metal) + dielectric)


def _tangents(samples):
    """Unit vectors (P, 3) along the tangent and across it."""
    across = np.cross(samples.normal, samples.tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.cross(across, samples.normal), across


def radiance(samples, lights, brdf, count=64, weight=None) -> np.ndarray:
    """Reflected radiance (P, 3); `weight(directions)` (P, S) multiplies the BRDF."""
    total = np.zeros((len(samples), 3))
    for light in lights:
        centers, area = patches_of(light, count)
        offset = centers - samples.position[:, None]
        distance2 = np.einsum("psk,psk->ps", offset, offset)
        directions = offset / np.sqrt(distance2)[..., None]
        cosine = np.maximum(-(directions @ light.direction), 0.0)
        geometry = area * cosine / distance2 * spread_factor(light, cosine)
        geometry = geometry * distance2 ** (0.5 * light.falloff) * distance2 / (light.smooth + distance2)
        if light.receivers is not None:
            geometry = geometry * np.isin(samples.receiver, light.receivers)[:, None]
        if weight is not None:
            geometry = geometry * weight(directions)
        total += np.einsum("ps,psc->pc", geometry, brdf(directions, samples)) * light.radiance
    return total


def fujii_slope(cosine):
    """G of Fujii's model, as OpenPBR has it."""
    theta = np.arccos(cosine)
    sine = np.sin(theta)
    return sine * (theta - 2 / 3 - sine * cosine) + 2 / 3 * np.tan(theta) * (1.0 - sine**3)


def rough(directions, normal, view, sigma):
    """Fujii's BRDF of one point times the cosine for `directions` (..., 3): what it reflects at once, and again for
    each unit of its rebound."""
    z, cosine = np.clip(directions @ normal, 0.0, 1.0), normal @ view
    a = 1.0 / (np.pi + sigma * (np.pi / 2 - 2 / 3))
    t = directions @ view - z * cosine
    t = np.where(t > 0.0, t / np.maximum(z, cosine), t)
    return z * (a + sigma * a * t), z * (1.0 - np.pi * a - sigma * a * fujii_slope(np.maximum(z, 1e-9)))


def velvet(directions, normal, view, sigma):
    """Ashikhmin's BRDF of one point times the cosine for `directions` (..., 3), as its authors wrote it down."""
    half = directions + view
    up = half @ normal / np.linalg.norm(half, axis=-1)
    cosines, seen, flat = directions @ normal, normal @ view, 1.0 - up**2
    density = np.exp(-(up**2) / (flat * sigma**2)) / (np.pi * sigma**2 * flat**2)
    masked = np.minimum(1.0, 2.0 * up * np.minimum(cosines, seen) * np.linalg.norm(half, axis=-1) / (half @ view))
    return np.where(cosines > 0.0, density * masked / (4.0 * seen), 0.0)


def reflected(samples, light, brdf, count=96):
    """Reflected radiance (P, 3) without the albedo; `brdf(directions (S, 3), number)` (S, ...) of each point."""
    (centers, area), total = patches_of(light, count), []
    for number, position in enumerate(samples.position):
        offset = centers - position
        distance = np.linalg.norm(offset, axis=1)[:, None]
        weight = area * np.maximum(-(offset @ light.direction), 0.0) / distance[:, 0] ** 3
        total.append(weight @ brdf(offset / distance, number))
    return np.reshape(total, (len(samples), -1)) * light.radiance


def relative_l2(image, halves) -> float:
    """Relative L2 distance of `image` (P, 3) from the mean of two `halves` (2, P, 3), their own noise removed."""
    squared = np.sum((image - halves[0]) * (image - halves[1])) / np.sum(halves[0] * halves[1])
    return float(np.sqrt(max(squared, 0.0)))


def bias(image, halves) -> float:
    """Relative difference of the sums."""
    return float(np.sum(image) / np.sum(halves.mean(axis=0)) - 1.0)


def _dot(directions, vectors):
    return np.einsum("psk,pk->ps", directions, vectors)
