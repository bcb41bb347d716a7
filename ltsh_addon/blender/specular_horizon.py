"""Where Cycles ends a specular lobe. Needs no bpy.

Cycles estimates the light of an area light twice and weights both estimates by the power heuristic (Veach and Guibas
1995). Directions that the lobe chose end at the horizon of the mesh, directions that the light chose end at that of
the smooth normal, so which horizon counts depends on the probabilities of both: small lights and rough lobes have the
smooth one, large lights and sharp lobes that of the mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scene import AreaLight, SurfaceSamples

SMALLEST_ALPHA = 1e-3
BLOCK = 65536


def end_at_horizons_of_cycles(samples: SurfaceSamples, lights: tuple[AreaLight, ...]) -> SurfaceSamples:
    """The samples with the smooth normal as geometric normal where the light's choice of directions counts more."""
    reflects = (samples.specular_f90 != 0.0).any(axis=1) | (samples.dielectric != 0.0).any(axis=1)
    differ = np.flatnonzero(reflects & (samples.geometric_normal != samples.smooth_normal).any(axis=1))
    if len(differ) == 0 or not lights:
        return samples
    normal = np.array(samples.geometric_normal)
    for start in range(0, len(differ), BLOCK):
        block = differ[start : start + BLOCK]
        smooth = block[_light_counts_more(samples.take(block), lights)]
        normal[smooth] = samples.smooth_normal[smooth]
    return replace(samples, geometric_normal=normal)


def _light_counts_more(samples, lights) -> np.ndarray:
    """Mask (P,)."""
    brightness, light_density, lobe_density = (
        np.stack(column) for column in zip(*(_densities(samples, light) for light in lights), strict=True)
    )
    total = brightness.sum(axis=0)
    light_density = light_density * np.divide(brightness, total, out=np.zeros_like(brightness), where=total > 0.0)
    # How much each light's highlight matters here, with the sign of what counts more.
    sign = np.sign(light_density - lobe_density)
    return (brightness * lobe_density * sign).sum(axis=0) >= 0.0


def _area(light) -> float:
    """Area of the light in m^2."""
    corners = light.polygon()
    spokes = corners[1:] - corners[0]
    return 0.5 * float(np.linalg.norm(np.cross(spokes[:-1], spokes[1:]).sum(axis=0)))


def _densities(samples, light):
    """(irradiance-like brightness, density of the light's directions, of the lobe's towards the light), each (P,)."""
    offset = light.center - samples.position
    distance2 = np.maximum((offset * offset).sum(axis=1), 1e-12)
    towards = offset / np.sqrt(distance2)[:, None]
    area = _area(light)
    facing = np.maximum(-(towards @ light.direction), 0.0)
    # A disk of the same area seen along its axis: right for small lights, never more than a half space.
    solid_angle = 2.0 * np.pi * (1.0 - 1.0 / np.sqrt(1.0 + area * np.maximum(facing, 1e-3) / (np.pi * distance2)))
    at_horizon = _at_horizon(samples, towards, np.arccos(np.clip(1.0 - solid_angle / (2.0 * np.pi), -1.0, 1.0)))
    half = at_horizon + samples.view
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    alpha2 = np.square(np.maximum(samples.roughness**2, SMALLEST_ALPHA))
    cosine = np.maximum((samples.normal * samples.view).sum(axis=1), 1e-3)
    height = np.maximum((half * samples.normal).sum(axis=1), 0.0)
    density = alpha2 / (np.pi * np.square(height * height * (alpha2 - 1.0) + 1.0))
    masking = 1.0 / (1.0 + 0.5 * (np.sqrt(1.0 + alpha2 * (1.0 / cosine**2 - 1.0)) - 1.0))
    brightness = np.abs(light.radiance).sum() * solid_angle * (facing > 0.0)
    return brightness, 1.0 / np.maximum(solid_angle, 1e-9), density * masking / (4.0 * cosine)


def _at_horizon(samples, towards, reach):
    """Unit directions (P, 3) on the smooth horizon, below the point of a light that is nearest to the mirror direction;
    the light reaches `reach` (P,) rad around `towards` (P, 3)."""
    mirrored = 2.0 * (samples.normal * samples.view).sum(axis=1, keepdims=True) * samples.normal - samples.view
    angle = np.arccos(np.clip((mirrored * towards).sum(axis=1), -1.0, 1.0))
    fraction = np.divide(np.minimum(reach, angle), angle, out=np.zeros_like(angle), where=angle > 1e-6)[:, None]
    nearest = towards + fraction * (mirrored - towards)
    flat = nearest - (nearest * samples.smooth_normal).sum(axis=1, keepdims=True) * samples.smooth_normal
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
