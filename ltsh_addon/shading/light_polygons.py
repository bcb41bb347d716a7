"""Polygons of area lights as seen from shading points, in single precision: local corners, horizons, parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import light_cone
from .polygon import split_at_horizon

# Where at least this share of the points sees all of a light, all are computed as if they did: cheaper than gathering.
MOSTLY_WHOLE = 0.6


# Corners of a round light by how far it reaches, in units of the lobe's width where it meets the light: below 8 of them
# 32 corners are within 0.1 % of an ellipse, and so on.
ROUND_CORNERS = (32, 64, 128, 256)
ROUND_LIMITS = (8.0, 40.0, 300.0)
_FOCUSED_ROUND_CORNERS = (32, 64)


def light_levels(light, corners, position, width):
    """Yield (corners (V, 3), effort for its cone, chosen (Q',) of the points, None for all) as lobes need them.

    The lobes are `width` (Q,) or a number of radians wide, at points with x, y, z in `position` (3, Q), all in double
    precision, so that both paths come to the same decisions.
    """
    if light.is_focused:
        for effort, chosen in light_cone.efforts(light, position, width):
            if light.is_round:
                corners = light.polygon(_FOCUSED_ROUND_CORNERS[effort.chords > 2])
                effort = replace(effort, chords=2)
            yield corners, effort, chosen
    elif light.is_round:
        for outline, chosen in round_levels(light, position, width):
            yield outline, None, chosen
    else:
        yield corners, None, None


def round_levels(light, position, width):
    """Yield (corners (V, 3), chosen (Q',), None for all) of a round light for points with x, y, z in `position`
    (3, Q), all in double precision, with lobes that are `width` (Q,) or a number of radians wide."""
    offset = [position[axis] - light.center[axis] for axis in range(3)]
    height = np.abs(sum(offset[axis] * light.direction[axis] for axis in range(3)))
    reach = np.sqrt(max((light.half_u**2).sum(), (light.half_v**2).sum()))
    beyond = np.sqrt(sum(component * component for component in offset)) - reach
    distance = np.maximum(np.maximum(height, beyond), 1e-12 * reach)
    level = np.searchsorted(ROUND_LIMITS, reach / (distance * width))
    for number in np.unique(level):
        corners = light.polygon(ROUND_CORNERS[number])
        chosen = np.nonzero(level == number)[0]
        yield corners, None if len(chosen) == len(level) else chosen


def local_corners(light, corners: np.ndarray, offset: np.ndarray, rows: np.ndarray, scratch) -> np.ndarray:
    """Corners (C, V, P) of a light: coordinates along rows (C, 3, P), float32.

    corners (V, 3) in the world; offset (3, P) from the points to the light's center, which for "POLYGON" may lie
    anywhere near.
    """
    coordinates, _, points = rows.shape
    center = _along(rows, offset, scratch("center", (coordinates, points)), scratch)
    result = scratch("corners", (coordinates, len(corners), points))
    if light.is_round or light.shape == "POLYGON":
        for number, corner in enumerate((corners - light.center).astype(np.float32)):
            out = _along(rows, corner, scratch("axis", (coordinates, points)), scratch)
            np.add(center, out, out=result[:, number])
        return result
    # Corners 0 and 2 are opposite, and so are 1 and 3: half diagonals from the center.
    for number in (0, 1):
        half = ((corners[number] - corners[number + 2]) * 0.5).astype(np.float32)
        out = _along(rows, half, scratch("axis", (coordinates, points)), scratch)
        np.add(center, out, out=result[:, number])
        np.subtract(center, out, out=result[:, number + 2])
    return result


def _along(rows, vector, out, scratch):
    """Products (C, P) of rows (C, 3, P) with a vector (3,) or vectors (3, P)."""
    product = scratch("product", out.shape)
    np.multiply(rows[:, 0], vector[0], out=out)
    for axis in (1, 2):
        out += np.multiply(rows[:, axis], vector[axis], out=product)
    return out


def integrate_visible(corners: np.ndarray, facing: np.ndarray, clip_rows, count: int, integrate):
    """Integrals (count, P) over what is seen of polygons (C, V, P), and the mask (P,) of fragile points.

    A point sees the part of its polygon where all coordinates `clip_rows` are positive, if it is `facing` (P,) it.
    `integrate(polygons (C, W, Q), index)` returns (count, Q) and a mask (Q,) for the points `index` (None: all).
    """
    whole = facing.copy()
    partly = facing
    for row in clip_rows:
        whole &= np.minimum.reduce(corners[row], axis=0) > 0.0
    seen_whole = np.count_nonzero(whole)
    points = len(facing)
    if seen_whole == points:
        return integrate(corners, None)
    for row in clip_rows:
        partly = partly & (np.maximum.reduce(corners[row], axis=0) > 0.0)
    cut = np.nonzero(partly & ~whole)[0]
    values, fragile = np.zeros((count, points), np.float32), np.zeros(points, bool)
    if seen_whole > MOSTLY_WHOLE * points:
        found, mask = integrate(corners, None)
        np.multiply(found, whole, out=values)
        np.logical_and(mask, whole, out=fragile)
    elif seen_whole:
        index = np.nonzero(whole)[0]
        values[:, index], fragile[index] = integrate(np.take(corners, index, axis=2), index)
    if len(cut):
        for index, polygons in _clipped(np.take(corners, cut, axis=2), clip_rows):
            values[:, cut[index]], fragile[cut[index]] = integrate(polygons, cut[index])
    return values, fragile


def _clipped(corners, clip_rows):
    """Yield (index, polygons) of the parts of polygons (C, V, P) where all coordinates `clip_rows` are positive."""
    if not clip_rows:
        yield np.arange(corners.shape[2]), corners
        return
    for outer, part in split_at_horizon(corners, clip_rows[0]):
        for inner, polygons in _clipped(part, clip_rows[1:]):
            yield outer[inner], polygons
