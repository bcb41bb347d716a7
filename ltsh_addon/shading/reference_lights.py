"""The lights of the reference quadrature: exact ellipses, convex pieces of polygons, lights with a spread."""

from __future__ import annotations

from functools import partial

import numpy as np

from . import light_cone, reference
from .convex_pieces import convex_pieces
from .local_view import in_front, light_view, to_local, visible_parts
from .polygon import split_at_horizon

FINE_ROUND_LIGHT_CORNERS = 128
# Per arc of a cone's edge, where the factor of the spread is 0.
CONE_CHORDS = 4


def reference_integrals(samples, cosine, frame, light, corners, candidates, error):
    """Yield (index, integrals (4, Q)) by quadrature; integrals of the same point add up. Adds to error (P,)."""
    if light.is_round:
        corners = light.polygon(FINE_ROUND_LIGHT_CORNERS)
    if light.is_focused:
        batches = _cone_parts(samples, cosine, frame, light, corners, candidates)
    elif light.is_round:
        batches = _ellipses(samples, frame, light, corners, candidates)
    else:
        pieces = convex_pieces(corners) if light.shape == "POLYGON" else [corners]
        batches = (batch for piece in pieces for batch in _polygons(samples, frame, light, piece, candidates))
    for index, make_boundary, cone in batches:
        alpha = samples.roughness[index] ** 2
        setting = (cosine[index], alpha, samples.ior[index])
        integrals, estimate = reference.lobe_integrals(make_boundary, *setting, cone=cone)
        error[index] += estimate
        yield index, integrals


def _polygons(samples, frame, light, corners, candidates):
    """Yield (index, make_boundary, None) of polygons."""
    for index, polygon in visible_parts(samples, frame, light, corners, candidates, samples.geometric_normal):
        yield index, partial(reference.PolygonBoundary.warped, polygon=polygon), None


def _ellipses(samples, frame, light, corners, candidates):
    """As `_polygons`; exact ellipses where the geometric horizon does not cut them."""
    cut, whole, local = _uncut_ellipses(samples, frame, light, candidates)
    if len(whole):
        yield whole, lambda warp: reference.EllipseBoundary.warped(warp, *local), None
    yield from _polygons(samples, frame, light, corners, cut)


def _uncut_ellipses(samples, frame, light, candidates):
    """Split the candidates: (those whose light is cut by the geometric horizon, the others that see it, for these the
    center and half axes in local frames)."""
    index = in_front(samples, light, candidates)
    offset = (light.center - samples.position[index]).T
    height, swing = _ellipse_extent(samples.geometric_normal[index].T, offset, light)
    cut = index[(height < swing) & (height > -swing)]
    index, offset = index[height >= swing], offset[:, height >= swing]
    height, swing = _ellipse_extent(samples.normal[index].T, offset, light)
    index, offset = index[height > -swing], offset[:, height > -swing]
    axes = frame[:, :, index]
    return cut, index, [to_local(axes, vector) for vector in (offset, light.half_u[:, None], light.half_v[:, None])]


def _ellipse_extent(normal, offset, light):
    """Heights (P,) of the light's center over the planes with `normal` (3, P), and how far it reaches up and down."""
    u, v = (sum(normal[k] * vector[k] for k in range(3)) for vector in (light.half_u, light.half_v))
    return (normal * offset).sum(axis=0), np.hypot(u, v)


def _cone_parts(samples, cosine, frame, light, corners, candidates):
    """As `_polygons`, with the cone: the part of a light in the cone of each point, cut in two where both the foot, at
    which the factor has its tip, and the peak of the lobe lie in it."""
    tangent, share = light_cone.cone(light.spread)
    for index, polygon in visible_parts(samples, frame, light, corners, candidates, samples.geometric_normal):
        warp = reference.limit_warp(cosine[index], samples.roughness[index] ** 2)
        view = light_view(samples, frame, light, index, warp.to_original_domain)
        near = np.nonzero(light_cone.DiskParts(polygon[3:]).least < tangent * view.distance)[0]
        if len(near) == 0:
            continue
        index, view = index[near], view.take(near)
        part = light_cone.DiskParts(polygon[3:, :, near])
        reach = tangent * view.distance
        flat = part.inside(reach, CONE_CHORDS)
        axis = view.foot[3:] / view.distance
        for chosen, boundary, at_foot in _around_foot_and_peak(part, reach, flat, view):
            cone = reference.Cone(axis[:, chosen], tangent, share, at_foot)
            yield index[chosen], partial(reference.PolygonBoundary.warped, polygon=boundary), cone


def _around_foot_and_peak(part, reach, flat, view):
    """Yield (chosen (R,), polygons (3, W, R), mask (R,) of those to be integrated around the foot)."""
    peak, _, seen, _ = view.peak()
    following = np.roll(part.flat, -1, axis=1)
    along, offset = following - part.flat, peak[:, None] - part.flat
    side = along[0] * offset[1] - along[1] * offset[0]
    peak_inside = seen & ((side >= 0.0).all(axis=0) | (side <= 0.0).all(axis=0))
    squared = peak[0] * peak[0] + peak[1] * peak[1]
    peak_inside &= squared < reach * reach
    both = part.encloses & peak_inside & (squared > 0.0)
    corners = view.corners(flat)[3:]
    toward_peak = flat[0] * peak[0] + flat[1] * peak[1] - 0.5 * squared
    with_height = np.concatenate([corners, np.where(both, toward_peak, 1.0)[None]])
    for chosen, polygons in split_at_horizon(with_height, axis=3):
        yield chosen, polygons[:3], (part.encloses & ~peak_inside)[chosen]
    cut = np.nonzero(both)[0]
    if len(cut):
        with_height = np.concatenate([corners, -toward_peak[None]])[:, :, cut]
        for chosen, polygons in split_at_horizon(with_height, axis=3):
            yield cut[chosen], polygons[:3], np.ones(len(chosen), bool)
