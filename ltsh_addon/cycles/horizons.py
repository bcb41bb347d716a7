"""Which normals and which parts of a lobe Cycles takes where a smooth normal leaves the face's horizon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scene import AreaLight, SurfaceSamples
from ..shading import brdf, polygon

# Reflected rays stay at least this far above the true surface, or this share of the view's own elevation.
MINIMUM_REFLECTION_ELEVATION = 0.01
ELEVATION_SHARE = 0.9


def unit(vectors: np.ndarray) -> np.ndarray:
    """`vectors` (..., 3) divided by their length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def valid_specular_normal(normal: np.ndarray, true_normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Unit normals (P, 3) bent towards `true_normal` just enough that the mirrored view leaves the surface.

    In the plane of both normals let phi be the angle of the normal from the true normal and (x, z) the view's
    components. The mirrored view's elevation is x sin 2phi + z cos 2phi = a cos(2phi - delta) with a = |(x, z)| and
    tan delta = x / z. It starts at z for phi = 0 and first falls to the threshold t at phi = (delta + acos(t / a)) / 2.
    Cycles bends specular normals (not diffuse ones) by this rule; t = min(0.9 z, 0.01). Inputs are unit (P, 3) with
    `view . true_normal` > 0. Agrees with Cycles' own normals to 1e-4, 99 % of them to 1e-5.
    """
    elevation = np.sum(view * true_normal, axis=-1)
    threshold = np.minimum(ELEVATION_SHARE * elevation, MINIMUM_REFLECTION_ELEVATION)
    mirrored = 2.0 * np.sum(normal * view, axis=-1, keepdims=True) * normal - view
    bend = np.sum(mirrored * true_normal, axis=-1) < threshold
    tangent = unit(normal - np.sum(normal * true_normal, axis=-1, keepdims=True) * true_normal)
    x = np.sum(view * tangent, axis=-1)
    span = np.hypot(x, elevation)
    ratio = np.divide(threshold, span, out=np.ones_like(span), where=span > 0.0)
    angle = 0.5 * (np.arctan2(x, elevation) + np.arccos(np.clip(ratio, -1.0, 1.0)))
    bent = np.sin(angle)[:, None] * tangent + np.cos(angle)[:, None] * true_normal
    return np.where(bend[:, None], bent, normal)


def bump_alpha2(normal: np.ndarray, smooth_normal: np.ndarray) -> np.ndarray:
    """Squared GGX roughness (P,) of the shadowing that Cycles puts on a bump-mapped diffuse lobe; 0 means none.

    The lobe is multiplied by 2 / (1 + sqrt(1 + alpha^2 tan^2 theta_i)), theta_i the angle between light direction and
    smooth normal, and is 0 below the smooth horizon; alpha^2 = tan^2 theta_d / 8, at most 1, theta_d the angle between
    both normals (Estevez, Lecocq and Stein 2019, "A Microfacet-Based Shadowing Function to Solve the Bump Terminator
    Problem", doi:10.1007/978-1-4842-4427-2_12). Agrees with Cycles 4.5.15 and 5.2.3 to 1e-4 of the total.
    """
    cosine2 = np.square(np.sum(normal * smooth_normal, axis=-1))
    tangent2 = np.divide(1.0 - cosine2, cosine2, out=np.full_like(cosine2, np.inf), where=cosine2 > 0.0)
    return np.clip(tangent2 / 8.0, 0.0, 1.0)


SMALLEST_ALPHA = 1e-3
# Directions at which both probabilities are compared: around the horizon, closest to each other near the highlight,
# at heights between the two horizons.
AROUND, CONCENTRATION = 48, 6.0
HEIGHTS = (0.25, 0.75)
# In rad. What lies between horizons that are closer is not worth a look.
SMALLEST_ANGLE = 1e-4
BLOCK = 4096


def end_at_horizons_of_cycles(samples: SurfaceSamples, lights: tuple[AreaLight, ...]) -> SurfaceSamples:
    """The samples with the smooth normal as geometric normal where that horizon is nearer to what Cycles sums up."""
    reflects = (samples.specular_f90 != 0.0).any(axis=1) | (samples.dielectric != 0.0).any(axis=1)
    apart = np.abs(samples.geometric_normal - samples.smooth_normal).max(axis=1) > SMALLEST_ANGLE
    differ = np.flatnonzero(reflects & apart)
    if len(differ) == 0 or not lights:
        return samples
    normal = np.array(samples.geometric_normal)
    for start in range(0, len(differ), BLOCK):
        block = differ[start : start + BLOCK]
        by_lobe, by_light = horizon_excess(samples.take(block), lights)
        # Where none of the directions meets a light, all are far from the highlight: the light's choice counts.
        smooth = block[np.abs(by_lobe) <= np.abs(by_light)]
        normal[smooth] = samples.smooth_normal[smooth]
    return replace(samples, geometric_normal=normal)


def horizon_excess(samples: SurfaceSamples, lights: tuple[AreaLight, ...]) -> tuple[np.ndarray, np.ndarray]:
    """What only one of the horizons lets through (P,), of directions that the lobe chose and of those that the light
    chose: the smooth horizon is wrong about the former, that of the mesh about the latter.

    Where both horizons make no difference the first is 1 and the second 0.
    """
    crossed = np.stack([_crosses(samples, light) for light in lights])
    index = np.flatnonzero(crossed.any(axis=0))
    by_lobe, by_light = np.ones(len(samples)), np.zeros(len(samples))
    if len(index) == 0:
        return by_lobe, by_light
    samples, crossed = samples.take(index), crossed[:, index]
    solid_angle = np.stack([_solid_angle(samples.position, light) for light in lights])
    brightness = solid_angle * np.array([np.abs(light.radiance).sum() for light in lights])[:, None]
    density = brightness / np.maximum(brightness.sum(axis=0) * solid_angle, 1e-12)
    towards, width = _directions(samples)
    lobe = _lobe_density(samples, towards)
    by_lobe[index] = 0.0
    for number, light in enumerate(lights):
        rows = np.flatnonzero(crossed[number])
        excess = np.abs(light.radiance).sum() * lobe[rows] * width[rows]
        excess *= _hits(light, samples.position[rows], towards[rows])
        light2 = np.square(density[number, rows])[:, None, None]
        weight = light2 / (light2 + np.square(lobe[rows]))
        by_light[index[rows]] += (excess * weight).sum(axis=(1, 2))
        by_lobe[index[rows]] += (excess * (1.0 - weight)).sum(axis=(1, 2))
    return by_lobe, by_light


def _solid_angle(position, light) -> np.ndarray:
    """Solid angle (P,) of the light in sr, 0 from behind it."""
    axes = np.concatenate([_plane_axes(light), -light.direction[None]])
    corners = np.einsum("ak,pvk->avp", axes, light.polygon() - position[:, None])
    whole = np.abs(polygon.solid_angle(polygon.project_to_sphere(corners)))
    return np.where(corners[2].mean(axis=0) > 0.0, whole, 0.0)


def _plane_axes(light) -> np.ndarray:
    """Two orthonormal axes (2, 3) in the plane of the light."""
    first = light.polygon()[0] - light.center
    first /= max(np.linalg.norm(first), 1e-30)
    return np.stack([first, np.cross(light.direction, first)])


def _crosses(samples, light) -> np.ndarray:
    """Mask (P,): from where the light is not wholly on one side of both horizons."""
    corners, above = light.polygon(), []
    for normal in (samples.smooth_normal, samples.geometric_normal):
        above.append(normal @ corners.T > (normal * samples.position).sum(axis=1, keepdims=True))
    above = np.concatenate(above, axis=1)
    return above.any(axis=1) & ~above.all(axis=1) & ((light.center - samples.position) @ light.direction < 0.0)


def _lobe_density(samples, towards) -> np.ndarray:
    """Probability (P, H, N) per sr that the lobe chooses the directions."""
    half = towards + samples.view[:, None, None]
    vertical = np.square(np.maximum(np.einsum("phni,pi->phn", half, samples.normal), 0.0))
    horizontal = np.maximum(np.square(half).sum(axis=3) - vertical, 0.0)
    alpha2 = np.square(np.maximum(samples.roughness**2, SMALLEST_ALPHA))[:, None, None]
    cosine = np.maximum((samples.normal * samples.view).sum(axis=1), 1e-3)[:, None, None]
    return brdf.visible_normal_density(cosine, horizontal, vertical, alpha2)


def _directions(samples):
    """Unit directions (P, H, N, 3) between the horizons and the solid angle (P, H, N) of each, negative where the
    horizon of the mesh is the lower one."""
    mirrored = 2.0 * (samples.normal * samples.view).sum(axis=1, keepdims=True) * samples.normal - samples.view
    flat = mirrored - (mirrored * samples.smooth_normal).sum(axis=1, keepdims=True) * samples.smooth_normal
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    across = np.cross(samples.smooth_normal, flat)
    step = (np.arange(AROUND) + 0.5) / AROUND * 2.0 - 1.0
    angle = np.pi * np.sinh(CONCENTRATION * step) / np.sinh(CONCENTRATION)
    span = np.pi * CONCENTRATION * np.cosh(CONCENTRATION * step) / np.sinh(CONCENTRATION) * 2.0 / AROUND
    around = np.cos(angle)[:, None] * flat[:, None] + np.sin(angle)[:, None] * across[:, None]
    # How high above the smooth horizon that of the mesh lies there.
    rise = -np.arctan2(
        np.einsum("pni,pi->pn", around, samples.geometric_normal),
        np.einsum("pi,pi->p", samples.smooth_normal, samples.geometric_normal)[:, None],
    )
    elevation = rise[:, None] * np.array(HEIGHTS)[:, None]
    towards = np.cos(elevation)[..., None] * around[:, None]
    towards += np.sin(elevation)[..., None] * samples.smooth_normal[:, None, None]
    return towards, rise[:, None] * span * np.cos(elevation) / len(HEIGHTS)


def _hits(light, position, towards) -> np.ndarray:
    """Mask (P, H, N): which rays from `position` (P, 3) meet the light's polygon."""
    axes = _plane_axes(light)
    outline = (light.polygon() - light.center) @ axes.T
    steepness = towards @ light.direction
    height = ((light.center - position) @ light.direction)[:, None, None]
    distance = height / np.where(steepness < 0.0, steepness, -1e-30)
    point = distance[..., None] * towards + (position - light.center)[:, None, None]
    x, y = (point @ axis for axis in axes)
    inside = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside & (steepness < 0.0)
