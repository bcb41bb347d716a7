"""Shading in double precision: exact polygons, any degree, and the reference quadrature.

`single_precision` is the fast path; the points for which that is not accurate come here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from . import reference
from .edge_integrals import vector_irradiance
from .lobe_integrals import form_factor, integrals_on_sphere, polygon_integrals
from .lookup_table import Lobe, LookupTable
from .polygon import split_at_horizon

REFERENCE = "reference"
FINE_ROUND_LIGHT_CORNERS = 64


@dataclass(frozen=True)
class LightOfEachSample:
    """One light per sample, in place of an AreaLight for all; its corners are (V, P, 3)."""

    center: np.ndarray  # (P, 3)
    direction: np.ndarray  # (P, 3)
    radiance: np.ndarray  # (P, 3)
    affects_diffuse: bool = True
    affects_specular: bool = True


def _of(vector, index):
    """The vector (3,) that is the same for all samples, or those of the samples `index`."""
    return vector if vector.ndim == 1 else vector[index]


def shade_diffuse(samples, lights, radiance):
    """Add to radiance (G, P, 3) what the diffuse lobes of `samples` reflect of `lights`, (light, group, corners)."""
    frame = _frame(samples.diffuse_normal, samples.view)
    lit = np.nonzero(samples.diffuse_albedo.any(axis=1))[0]
    bumped = (samples.diffuse_normal[lit] != samples.smooth_normal[lit]).any(axis=1)
    for light, group, corners in lights:
        if not light.affects_diffuse:
            continue
        for index, polygon in _visible_parts(samples, frame, light, corners, lit[~bumped]):
            irradiance = np.abs(form_factor(polygon))
            radiance[group, index] += irradiance[:, None] * samples.diffuse_albedo[index] * _of(light.radiance, index)
        for index, polygon in _visible_parts(samples, frame, light, corners, lit[bumped], samples.smooth_normal):
            irradiance = _shadowed_form_factor(samples, frame, index, polygon)
            radiance[group, index] += irradiance[:, None] * samples.diffuse_albedo[index] * _of(light.radiance, index)


def _shadowed_form_factor(samples, frame, index, polygon):
    """Form factor (Q,) times the bump shadowing of `SurfaceSamples`, taken at the mean direction of the polygon."""
    direction = -integrals_on_sphere(vector_irradiance, polygon)
    smooth = _to_local(frame[:, :, index], samples.smooth_normal[index].T)
    along = (direction * smooth).sum(axis=0)
    tangent2 = (direction * direction).sum(axis=0) / np.maximum(along, 1e-30) ** 2 - 1.0
    shadowing = 2.0 / (1.0 + np.sqrt(1.0 + samples.bump_alpha2[index] * np.maximum(tangent2, 0.0)))
    return np.where(along > 0.0, np.abs(form_factor(polygon)) * shadowing, 0.0)


def shade_specular(samples, lights, table, radiance, error=None):
    """As `shade_diffuse` for the specular lobes; `table` or REFERENCE, which adds its estimates to error (P,)."""
    cosine = (samples.normal * samples.view).sum(axis=1)
    frame = _frame(samples.normal, samples.view)
    terms = (samples.specular_f0, samples.specular_f90, samples.specular_dip, samples.dielectric)
    reflective = np.any([term.any(axis=1) for term in terms], axis=0)
    lit = np.nonzero((cosine > 0.0) & reflective)[0]
    cosine = np.clip(cosine, 0.0, 1.0)
    lobe = None
    if table != REFERENCE and len(lit):
        lobe = _fresnel_lobe(table, cosine, samples)
    for light, group, corners in lights:
        if not light.affects_specular:
            continue
        if table == REFERENCE:
            parts = _reference_integrals(samples, cosine, frame, light, corners, lit, error)
        else:
            visible = _visible_parts(samples, frame, light, corners, lit, samples.geometric_normal)
            parts = ((index, _table_integrals(table, lobe.take(index), polygon)) for index, polygon in visible)
        for index, integrals in parts:
            plain, schlick, dip, dielectric = integrals[..., None]
            f0, f90 = samples.specular_f0[index], samples.specular_f90[index]
            reflected = f0 * plain + (f90 - f0) * schlick + samples.dielectric[index] * dielectric
            reflected -= samples.specular_dip[index] * dip
            radiance[group, index] += np.maximum(reflected, 0.0) * _of(light.radiance, index)


def _reference_integrals(samples, cosine, frame, light, corners, candidates, error):
    """Yield (index, integrals (4, Q)) by quadrature; round lights are exact ellipses. Adds to `error`."""
    batches = []
    if light.is_round:
        candidates, whole, local = _uncut_ellipses(samples, frame, light, candidates)
        if len(whole):
            batches.append((whole, lambda warp: reference.EllipseBoundary.warped(warp, *local)))
        corners = light.polygon(FINE_ROUND_LIGHT_CORNERS)
    for index, polygon in _visible_parts(samples, frame, light, corners, candidates, samples.geometric_normal):
        batches.append((index, partial(reference.PolygonBoundary.warped, polygon=polygon)))
    for index, make_boundary in batches:
        alpha = samples.roughness[index] ** 2
        integrals, estimate = reference.lobe_integrals(make_boundary, cosine[index], alpha, samples.ior[index])
        error[index] += estimate
        yield index, integrals


def _uncut_ellipses(samples, frame, light, candidates):
    """Split the candidates: (those whose light is cut by the geometric horizon, the others that see it, for these the
    center and half axes in local frames)."""
    index = _in_front(samples.position, light, candidates)
    offset = (light.center - samples.position[index]).T
    height, swing = _ellipse_extent(samples.geometric_normal[index].T, offset, light)
    cut = index[(height < swing) & (height > -swing)]
    index, offset = index[height >= swing], offset[:, height >= swing]
    height, swing = _ellipse_extent(samples.normal[index].T, offset, light)
    index, offset = index[height > -swing], offset[:, height > -swing]
    axes = frame[:, :, index]
    return cut, index, [_to_local(axes, vector) for vector in (offset, light.half_u[:, None], light.half_v[:, None])]


def _ellipse_extent(normal, offset, light):
    """Heights (P,) of the light's center over the planes with `normal` (3, P), and how far it reaches up and down."""
    u, v = (sum(normal[k] * vector[k] for k in range(3)) for vector in (light.half_u, light.half_v))
    return (normal * offset).sum(axis=0), np.hypot(u, v)


def _fresnel_lobe(table: LookupTable, cosine, samples) -> Lobe:
    """Lobes with four coefficient vectors: F = 1, (1 - c)^5, c (1 - c)^6 and the dielectric of each sample's IOR."""
    if not samples.dielectric.any():
        lobe = table.lookup(cosine, samples.roughness.astype(cosine.dtype), curves=3)
        return lobe.with_coefficients(np.concatenate([lobe.coefficients, np.zeros_like(lobe.coefficients[:1])]))
    lobe = table.lookup(cosine, samples.roughness.astype(cosine.dtype))
    weights = table.dielectric_weights(samples.ior)
    dielectric = sum(weight * vector for weight, vector in zip(weights, lobe.coefficients, strict=True))
    return lobe.with_coefficients(np.stack([*lobe.coefficients[:3], dielectric]))


def _table_integrals(table, lobe, polygon):
    """Integrals (4, P), never negative; corners run counterclockwise as seen from the point (`AreaLight.polygon`)."""
    signed = polygon_integrals(table, lobe, polygon, lobe.coefficients)
    return np.maximum(-signed, 0.0)


def _frame(normal, view):
    """Local frames (3, 3, P): rows tangent, bitangent, normal; the view has y = 0 and x >= 0."""
    cosine = (normal * view).sum(axis=1, keepdims=True)
    tangent = view - cosine * normal
    length = np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    # Where view and normal coincide any tangent serves: take the axis that the normal is farthest from.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    other = axis - (axis * normal).sum(axis=1, keepdims=True) * normal
    tangent = np.where(length > 1e-7, tangent, other)
    tangent = tangent / np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    bitangent = np.cross(normal, tangent)
    return np.stack([tangent.T, bitangent.T, normal.T])


def _in_front(position, light, candidates):
    """Those candidate points that lie on the side to which the light shines."""
    center, direction = _of(light.center, candidates), _of(light.direction, candidates)
    return candidates[((position[candidates] - center) * direction).sum(axis=1) > 0.0]


def _to_local(axes, vectors):
    """World vectors (3, ..., P) in local frames (3, 3, P)."""
    return np.stack([sum(row[k] * vectors[k] for k in range(3)) for row in axes])


def _visible_parts(samples, frame, light, corners, candidates, second_normal=None):
    """Yield (index, polygons (3, W, Q) in local frames) of the candidate points that the light shines on.

    Polygons are clipped at the shading horizon, and before that at the horizon of `second_normal` (P, 3).
    """
    index = _in_front(samples.position, light, candidates)
    if len(index) == 0:
        return
    corners = corners[:, None, :] if corners.ndim == 2 else corners[:, index]
    offset = (corners - samples.position[index]).transpose(2, 0, 1)
    local = _to_local(frame[:, :, index], offset)
    parts = [(slice(None), local)]
    if second_normal is not None:
        height = (offset * second_normal[index].T[:, None, :]).sum(axis=0)
        if not (height > 0.0).all():
            with_height = np.concatenate([local, height[None]])
            parts = ((part, clipped[:3]) for part, clipped in split_at_horizon(with_height, axis=3))
    for outer, polygon in parts:
        for inner, clipped in split_at_horizon(polygon):
            yield index[outer][inner], clipped
