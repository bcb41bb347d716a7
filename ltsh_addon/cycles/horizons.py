"""Which normals and which parts of a lobe Cycles takes where a smooth normal leaves the face's horizon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scene import AreaLight, SurfaceSamples
from ..shading import brdf, polygon
from .light_tree import light_chances

SPECULAR_FIELDS = ("specular_f0", "specular_f90", "specular_dip", "dielectric")
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
HEIGHTS = (1.0 / 6.0, 0.5, 5.0 / 6.0)
# In rad. What lies between horizons that are closer is not worth a look.
SMALLEST_ANGLE = 1e-4
# Of what lies between the horizons. A sample is split where more than this comes from below either.
SMALLEST_SHARE = 5e-3
BLOCK = 2048


def end_at_horizons_of_cycles(
    samples: SurfaceSamples, lights: tuple[AreaLight, ...], hit: np.ndarray | None = None, is_baked: bool = False
) -> tuple[SurfaceSamples, np.ndarray]:
    """Samples (Q) whose specular lobes end where those of Cycles do, and of which of `samples` (P) each is, (Q,).

    Between the horizons of the smooth normal and of the mesh Cycles counts directions that a light chose above the
    former, and directions that the surface chose above the latter, each with its weight of multiple importance
    sampling. Where this leaves a part, a sample becomes two: one that ends at the mesh's horizon, and one without
    diffuse light that ends at the smooth one. They follow one another and add up to the sample. `hit` (P,) are
    the numbers of the hits on surfaces; left out: each sample is one. Of what is `is_baked`, Cycles chooses directions
    by the specular lobes alone.
    """
    index = np.arange(len(samples))
    reflects = (samples.specular_f90 != 0.0).any(axis=1) | (samples.dielectric != 0.0).any(axis=1)
    apart = np.abs(samples.geometric_normal - samples.smooth_normal).max(axis=1) > SMALLEST_ANGLE
    differ = np.flatnonzero(reflects & apart)
    if len(differ) == 0 or not lights:
        return samples, index
    chances = lobe_chances(samples, index if hit is None else hit, is_baked)
    by_smooth = np.zeros(len(samples))
    for start in range(0, len(differ), BLOCK):
        block = differ[start : start + BLOCK]
        by_smooth[block] = smooth_share(*horizon_excess(samples.take(block), lights, chances[:, block]))
    by_smooth = np.where(by_smooth < SMALLEST_SHARE, 0.0, np.where(by_smooth > 1.0 - SMALLEST_SHARE, 1.0, by_smooth))
    split = np.flatnonzero((by_smooth > 0.0) & (by_smooth < 1.0))
    index = np.concatenate([index, split])
    ends_smooth = np.concatenate([by_smooth == 1.0, np.ones(len(split), dtype=bool)])
    share = np.concatenate([np.where(by_smooth == 1.0, 1.0, 1.0 - by_smooth), by_smooth[split]])[:, None]
    diffuse = np.concatenate([np.ones(len(samples)), np.zeros(len(split))])[:, None]
    order = np.argsort(index, kind="stable")
    index, ends_smooth, share, diffuse = index[order], ends_smooth[order], share[order], diffuse[order]
    ended = samples.take(index)
    specular = {name: getattr(ended, name) * share for name in SPECULAR_FIELDS}
    normal = np.where(ends_smooth[:, None], ended.smooth_normal, ended.geometric_normal)
    return replace(ended, geometric_normal=normal, diffuse_albedo=ended.diffuse_albedo * diffuse, **specular), index


def smooth_share(by_lobe: np.ndarray, by_light: np.ndarray) -> np.ndarray:
    """Share (P,) of a lobe that ends at the smooth horizon, the rest at the mesh's, from `horizon_excess`."""
    both = by_lobe + by_light
    # Where none of the directions meets a light, all are far from the highlight: the light's choice counts.
    return np.clip(np.divide(by_light, both, out=np.ones_like(both), where=both != 0.0), 0.0, 1.0)


def lobe_chances(samples: SurfaceSamples, hit: np.ndarray, is_baked: bool) -> np.ndarray:
    """How likely Cycles chooses directions by the specular and the diffuse lobe of the samples, (2, P): about as their
    albedos are to those of all samples with the same `hit` (P,)."""
    specular = _reflectance(samples, np.clip((samples.normal * samples.view).sum(axis=1), 0.0, 1.0))
    diffuse = np.zeros_like(specular) if is_baked else samples.diffuse_albedo.mean(axis=1)
    _, hit = np.unique(hit, return_inverse=True)
    both = np.stack([specular, diffuse])
    return both / np.maximum(np.bincount(hit, weights=both.sum(axis=0))[hit], 1e-12)


def _reflectance(samples, cosine) -> np.ndarray:
    """Mean reflectance (P, ...) of the lobes for cosines (P, ...) of the half angle."""
    names = ("specular_f0", "specular_f90", "dielectric")
    values = [getattr(samples, name).mean(axis=1) for name in names] + [np.maximum(samples.ior, 1.0)]
    f0, f90, weight, ior = (value.reshape(-1, *[1] * (cosine.ndim - 1)) for value in values)
    schlick = f0 + (f90 - f0) * brdf.schlick_curve(cosine)
    return np.maximum(schlick + weight * brdf.dielectric_reflectance(cosine, ior), 0.0)


def horizon_excess(
    samples: SurfaceSamples, lights: tuple[AreaLight, ...], chances: np.ndarray, choose=light_chances
) -> tuple[np.ndarray, np.ndarray]:
    """What only one of the horizons lets through (P,), of directions that a lobe chose and of those that the light
    chose: the smooth horizon is wrong about the former, that of the mesh about the latter.

    `chances` (2, P) as of `lobe_chances`; `choose` tells those of the lights, see `light_tree.light_chances`. Where
    both horizons make no difference the first is 1 and the second 0.
    """
    crossed = np.stack([_crosses(samples, light) for light in lights])
    index = np.flatnonzero(crossed.any(axis=0))
    by_lobe, by_light = np.ones(len(samples)), np.zeros(len(samples))
    if len(index) == 0:
        return by_lobe, by_light
    samples, crossed, chances = samples.take(index), crossed[:, index], chances[:, index]
    chance = choose(samples.position, samples.smooth_normal, lights)
    towards, width = _directions(samples)
    lobe = _lobe_density(samples, towards)
    half = np.sqrt(np.maximum(0.5 + 0.5 * np.einsum("phni,pi->phn", towards, samples.view), 0.0))
    reflected = lobe * _seen_by_light(samples, towards) * _reflectance(samples, half)
    diffuse = np.maximum(np.einsum("phni,pi->phn", towards, samples.diffuse_normal), 0.0) / np.pi
    chosen2 = np.square(chances[0][:, None, None] * lobe + chances[1][:, None, None] * diffuse)
    by_lobe[index] = 0.0
    for number, light in enumerate(lights):
        rows = np.flatnonzero(crossed[number])
        excess = np.abs(light.radiance).sum() * reflected[rows] * width[rows]
        excess *= _hits(light, samples.position[rows], towards[rows])
        density = chance[number, rows] / np.maximum(_solid_angle(samples.position[rows], light), 1e-12)
        light2 = np.square(density)[:, None, None]
        weight = light2 / np.maximum(light2 + chosen2[rows], 1e-30)
        by_light[index[rows]] += (excess * weight).sum(axis=(1, 2))
        by_lobe[index[rows]] += (excess * (1.0 - weight)).sum(axis=(1, 2))
    return by_lobe, by_light


def _solid_angle(position, light) -> np.ndarray:
    """Solid angle (P,) of the light in sr, 0 from behind it."""
    if light.is_facing:
        cosine = _facing_cone(light, position)[1]
        return 2.0 * np.pi * (1.0 - cosine)
    axes = np.concatenate([_plane_axes(light), -light.direction[None]])
    corners = np.einsum("ak,pvk->avp", axes, light.polygon() - light.origins(position)[:, None])
    whole = np.abs(polygon.solid_angle(polygon.project_to_sphere(corners)))
    return np.where(corners[2].mean(axis=0) > 0.0, whole, 0.0)


def _facing_cone(light, position):
    """Unit vectors (P, 3) to the center of a light that faces every point, and the cosine (P,) of half its width."""
    offset = light.center - position
    distance = np.linalg.norm(offset, axis=1)
    ratio = np.minimum(light.radius / np.maximum(distance, 1e-30), 1.0)
    cosine = np.sqrt(1.0 - ratio**2) if light.shape == "BALL" else 1.0 / np.sqrt(1.0 + ratio**2)
    return offset / np.maximum(distance, 1e-30)[:, None], cosine


def _plane_axes(light) -> np.ndarray:
    """Two orthonormal axes (2, 3) in the plane of the light."""
    first = light.polygon()[0] - light.center
    first /= max(np.linalg.norm(first), 1e-30)
    return np.stack([first, np.cross(light.direction, first)])


def _crosses(samples, light) -> np.ndarray:
    """Mask (P,): from where the light is not wholly on one side of both horizons."""
    corners, above, position = light.polygon(), [], light.origins(samples.position)
    for normal in (samples.smooth_normal, samples.geometric_normal):
        above.append(normal @ corners.T > (normal * position).sum(axis=1, keepdims=True))
    if light.is_facing:
        offset = light.center - position
        heights = [(normal * offset).sum(axis=1) for normal in (samples.smooth_normal, samples.geometric_normal)]
        above = [np.stack([height > -light.radius, height > light.radius], axis=1) for height in heights]
    above = np.concatenate(above, axis=1)
    return (
        above.any(axis=1) & ~above.all(axis=1)
        if light.is_facing
        else above.any(axis=1) & ~above.all(axis=1) & ((light.center - position) @ light.direction < 0.0)
    )


def _lobe_density(samples, towards) -> np.ndarray:
    """Probability (P, H, N) per sr that the lobe chooses the directions."""
    half = towards + samples.view[:, None, None]
    vertical = np.square(np.maximum(np.einsum("phni,pi->phn", half, samples.normal), 0.0))
    horizontal = np.maximum(np.square(half).sum(axis=3) - vertical, 0.0)
    alpha2 = np.square(np.maximum(samples.roughness**2, SMALLEST_ALPHA))[:, None, None]
    cosine = np.maximum((samples.normal * samples.view).sum(axis=1), 1e-3)[:, None, None]
    return brdf.visible_normal_density(cosine, horizontal, vertical, alpha2)


def _seen_by_light(samples, towards) -> np.ndarray:
    """Share (P, H, N) of the microfacets seen by the eye, in the middle of the directions, that these reach: 0 below
    the horizon of the lobe."""
    alpha2 = np.square(np.maximum(samples.roughness**2, SMALLEST_ALPHA))[:, None, None]
    to_eye = np.maximum((samples.normal * samples.view).sum(axis=1), 1e-3)[:, None, None]
    to_light = np.maximum(np.einsum("phni,pi->phn", towards, samples.normal), 0.0)
    slopes = [np.sqrt(cosine * cosine + alpha2 * (1.0 - cosine * cosine)) for cosine in (to_eye, to_light)]
    return to_light * (to_eye + slopes[0]) / np.maximum(to_eye * slopes[1] + to_light * slopes[0], 1e-30)


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
    if light.is_facing:
        axis, cosine = _facing_cone(light, position)
        return np.einsum("phni,pi->phn", towards, axis) > cosine[:, None, None]
    axes, position = _plane_axes(light), light.origins(position)
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
