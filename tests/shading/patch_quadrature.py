"""Reflected radiance by sums over patches of the light's surface: f cos cos_l s / r^2 dA, written out.

Shares nothing with the package but the scene's vocabulary: the oracle for lights with a spread, polygons and Fresnel
terms. Patches are small; what they leave is second order in their size, for the kink at a cone's edge as well.
"""

import numpy as np
import textbook
from surface_scenes import unit


def patches(light, count, position=None):
    """Centers (Q, 3) and areas (Q,) of count^2 patches of a rectangle or an ellipse; of a rectangle with a spread the
    part around the cone of the point `position` (3,)."""
    steps = (np.arange(count) + 0.5) / count
    area = np.linalg.norm(np.cross(light.half_u, light.half_v))
    if light.shape in ("RECTANGLE", "SQUARE"):
        (s_low, s_high), (t_low, t_high) = (around_cone(light, half, position) for half in (light.half_u, light.half_v))
        s, t = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
        s, t = s_low + (s_high - s_low) * s, t_low + (t_high - t_low) * t
        weights = np.full(s.shape, (s_high - s_low) * (t_high - t_low) * area / count**2)
    else:
        radius, angle = (grid.ravel() for grid in np.meshgrid(steps, 2.0 * np.pi * steps, indexing="ij"))
        s, t = radius * np.cos(angle), radius * np.sin(angle)
        weights = radius * 2.0 * np.pi * area / count**2
    return light.center + s[:, None] * light.half_u + t[:, None] * light.half_v, weights


def around_cone(light, half, position):
    """Range of the coordinate along `half` in [-1, 1] that contains all light that reaches the position."""
    if position is None or light.spread > np.pi - 1e-4:
        return -1.0, 1.0
    offset, length = position - light.center, half @ half
    middle = offset @ half / length
    reach = (offset @ light.direction) * np.tan(0.5 * light.spread) / np.sqrt(length)
    return np.clip(middle - reach, -1.0, 1.0), np.clip(middle + reach, -1.0, 1.0)


def spread_factor(light, toward_point):
    """s(theta) at unit directions (Q, 3) from the light to the point, as Blender's manual and Cycles have it."""
    if light.spread > np.pi - 1e-4:
        return np.ones(len(toward_point))
    half = 0.5 * light.spread
    cosine = np.clip(toward_point @ light.direction, 1e-12, 1.0)
    tangent = np.sqrt(1.0 - cosine**2) / cosine
    if half <= 0.05:
        return np.maximum(np.tan(half) - tangent, 0.0) * 3.0 / half**3
    return np.maximum((np.tan(half) - tangent) / (np.tan(half) - half), 0.0)


def incident(sample, light, count, points=None, areas=None):
    """Unit directions (Q, 3) from the one point of `sample` to patches of the light, and cos_l s / r^2 dA (Q,)."""
    if points is None:
        points, areas = patches(light, count, sample.position[0])
    offset = points - sample.position[0]
    distance = np.linalg.norm(offset, axis=1)
    direction = offset / distance[:, None]
    cosine = np.maximum(-(direction @ light.direction), 0.0)
    return direction, cosine * spread_factor(light, -direction) * areas / distance**2


def diffuse(sample, light, count=300, **patch):
    """Radiance (3,) of the Lambertian lobe."""
    direction, measure = incident(sample, light, count, **patch)
    cosine = np.maximum(direction @ sample.diffuse_normal[0], 0.0)
    return sample.diffuse_albedo[0] * light.radiance * (cosine @ measure) / np.pi


def specular(sample, light, count=300, **patch):
    """Radiance (3,) of the true GGX lobe with all Fresnel terms."""
    direction, measure = incident(sample, light, count, **patch)
    direction, measure = (values[direction @ sample.normal[0] > 0.0] for values in (direction, measure))
    local, view = in_frame(sample, direction)
    alpha = sample.roughness[0] ** 2
    lobe = textbook.ggx_brdf(view, local, alpha) * local[:, 2] * measure
    half = unit(view + local)
    fresnel = fresnel_factor(sample, np.clip(half @ view, 0.0, 1.0))
    return light.radiance * (fresnel * lobe[:, None]).sum(axis=0)


def fresnel_factor(sample, cosine):
    """Reflectance (Q, 3) of the sample at cosines (Q,) of the half angle, term by term."""
    missing = (1.0 - cosine)[:, None]
    f0, f90, dip, coat = (
        getattr(sample, name)[0] for name in ("specular_f0", "specular_f90", "specular_dip", "dielectric")
    )
    dielectric = 0.5 * sum(textbook.fresnel_amplitudes(cosine, sample.ior[0]))
    return f0 + (f90 - f0) * missing**5 - dip * cosine[:, None] * missing**6 + coat * dielectric[:, None]


def in_frame(sample, direction):
    """Directions (Q, 3) and the view (3,) in the frame of the specular lobe."""
    normal, view = sample.normal[0], sample.view[0]
    tangent = unit(view - (view @ normal) * normal)
    frame = np.stack([tangent, np.cross(normal, tangent), normal])
    return direction @ frame.T, frame @ view
