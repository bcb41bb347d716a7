"""Flat lights whose radiance varies, as patches of constant radiance. Needs no bpy.

An image of the light is cut in halves, again and again where the error is largest, until the mean of |radiance - that
of its patch| is below `ERROR` of the mean radiance.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, replace

import numpy as np

from ...scene import AreaLight

ERROR = 0.02
# Cells along each side at most, and so 64 x 64 patches.
GRID = 64
# Corners of the polygon that stands for an ellipse cut into patches: 2e-3 of its radius from it, with its area.
ROUND_CORNERS = 64
# Largest rectangle at the edge of a round light with a spread, whose half axes are 1.
FOCUSED_EDGE = 0.125


@dataclass(frozen=True)
class Patches:
    """Cells (K, 4) as left, right, bottom, top in [-1, 1], their mean radiance (K, 3), the relative L1 error left."""

    cells: np.ndarray
    radiance: np.ndarray
    error: float


def cut_into_patches(image: np.ndarray, covered: np.ndarray, most: int = GRID * GRID) -> Patches:
    """At most `most` patches of an `image` (H, W, 3), row 0 on top, of which only the pixels `covered` (H, W) count."""
    height, width = covered.shape
    least = (-(-height // GRID), -(-width // GRID))
    total = np.abs(image[covered]).sum()
    number = itertools.count()
    whole = (0, height, 0, width)
    error = _error(image, covered, whole)
    # A heap of (-error, tie breaker, cell); what cannot be cut any more is laid aside.
    open_cells, done = [(-error, next(number), whole)], []
    while open_cells and error > ERROR * total and len(open_cells) + len(done) < most:
        own, _, cell = heapq.heappop(open_cells)
        halves = _best_halves(image, covered, cell, least)
        if halves is None:
            done.append(cell)
            continue
        error += own
        for half in halves:
            part = _error(image, covered, half)
            error += part
            heapq.heappush(open_cells, (-part, next(number), half))
    cells = np.array(sorted(done + [cell for _, _, cell in open_cells]))
    means = np.array([_mean(image, covered, cell) for cell in cells])
    lit = np.any(means != 0.0, axis=-1)
    bounds = np.stack([cells[:, 2], cells[:, 3], height - cells[:, 1], height - cells[:, 0]], axis=-1)
    scale = np.array([width, width, height, height])
    share = max(error, 0.0) / total if total > 0.0 else 0.0
    return Patches((2.0 * bounds / scale - 1.0)[lit], means[lit], float(share))


def _mean(image, covered, cell) -> np.ndarray:
    rows, columns = slice(cell[0], cell[1]), slice(cell[2], cell[3])
    inside = covered[rows, columns]
    return image[rows, columns][inside].mean(axis=0) if inside.any() else np.zeros(3)


def _deviations(image, covered, cell) -> np.ndarray:
    """Differences (N, 3) of the pixels of `cell` from their mean."""
    rows, columns = slice(cell[0], cell[1]), slice(cell[2], cell[3])
    values = image[rows, columns][covered[rows, columns]]
    return values - values.mean(axis=0) if len(values) else values


def _error(image, covered, cell) -> float:
    return float(np.abs(_deviations(image, covered, cell)).sum())


def _best_halves(image, covered, cell, least):
    """The two halves of `cell` by the cut that leaves the smaller squares of differences; None: too small to cut.

    Squares never grow by a cut, unlike the absolute differences that say when to stop.
    """
    top, bottom, left, right = cell
    choices = []
    if bottom - top >= 2 * least[0]:
        middle = (top + bottom) // 2
        choices.append(((top, middle, left, right), (middle, bottom, left, right)))
    if right - left >= 2 * least[1]:
        middle = (left + right) // 2
        choices.append(((top, bottom, left, middle), (top, bottom, middle, right)))
    return min(choices, key=lambda halves: sum(_squares(image, covered, half) for half in halves), default=None)


def _squares(image, covered, cell) -> float:
    return float(np.square(_deviations(image, covered, cell)).sum())


def split_light(light: AreaLight, patches: Patches) -> list[AreaLight]:
    """`light` as one light per patch; cells are along its half_u and half_v.

    Cells wholly inside become rectangles, others polygons.
    """
    outline = _outline(light)
    parts = []
    for cell, radiance in zip(patches.cells, patches.radiance, strict=True):
        parts.extend(_light_of_cell(replace(light, radiance=radiance), outline, cell))
    return parts


def _light_of_cell(light: AreaLight, outline: np.ndarray, cell) -> list[AreaLight]:
    """The part of `light` in `cell`; `outline` (V, 2) is that of the light where it is no rectangle."""
    size = (cell[1] - cell[0]) * (cell[3] - cell[2])
    inside = outline if light.shape in ("SQUARE", "RECTANGLE") else clip_to_cell(outline, cell)
    share = polygon_area(inside) / size
    if light.shape in ("SQUARE", "RECTANGLE") or share >= 1.0 - 1e-6:
        return [_rectangle(light, cell)]
    if share <= 1e-9:
        return []
    if not light.is_focused:
        whole = _rectangle(light, cell)
        return [replace(whole, shape="POLYGON", corners=_in_space(light, inside))]
    # Polygons have no spread: small rectangles with the same power stand for the edge.
    if max(cell[1] - cell[0], cell[3] - cell[2]) > FOCUSED_EDGE:
        return [part for half in _halves(cell) for part in _light_of_cell(light, outline, half)]
    bounds = np.stack([inside.min(axis=0), inside.max(axis=0)], axis=-1).ravel()
    full = (bounds[1] - bounds[0]) * (bounds[3] - bounds[2])
    return [_rectangle(replace(light, radiance=light.radiance * share * size / full), bounds)]


def _halves(cell) -> list[tuple]:
    left, right, bottom, top = cell
    if right - left >= top - bottom:
        middle = 0.5 * (left + right)
        return [(left, middle, bottom, top), (middle, right, bottom, top)]
    middle = 0.5 * (bottom + top)
    return [(left, right, bottom, middle), (left, right, middle, top)]


def _rectangle(light: AreaLight, cell) -> AreaLight:
    left, right, bottom, top = cell
    return replace(
        light,
        shape="RECTANGLE",
        corners=None,
        center=light.center + 0.5 * (left + right) * light.half_u + 0.5 * (bottom + top) * light.half_v,
        half_u=0.5 * (right - left) * light.half_u,
        half_v=0.5 * (top - bottom) * light.half_v,
    )


def _outline(light: AreaLight) -> np.ndarray:
    """Corners (V, 2) of `light` along half_u and half_v."""
    if light.shape == "POLYGON":
        offset = light.corners - light.center
        axes = np.stack([light.half_u, light.half_v], axis=-1)
        outline = np.linalg.lstsq(axes, offset.T, rcond=None)[0].T
        return outline if signed_area(outline) > 0.0 else outline[::-1]
    step = 2.0 * np.pi / ROUND_CORNERS
    # No corner where the ellipse touches its rectangle: the polygon stays inside.
    angle = step * (np.arange(ROUND_CORNERS) + 0.5)
    return np.sqrt(step / np.sin(step)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _in_space(light: AreaLight, outline: np.ndarray) -> np.ndarray:
    corners = light.center + outline[:, :1] * light.half_u + outline[:, 1:] * light.half_v
    mirrored = np.dot(np.cross(light.half_u, light.half_v), light.direction) < 0.0
    return corners[::-1] if mirrored else corners


def clip_to_cell(outline: np.ndarray, cell) -> np.ndarray:
    """The part (W, 2) of a polygon (V, 2) in the rectangle left, right, bottom, top (Sutherland and Hodgman 1974).

    Of a concave polygon that falls apart the parts hang together by edges that run there and back.
    """
    left, right, bottom, top = cell
    for axis, sign, bound in ((0, 1.0, left), (0, -1.0, right), (1, 1.0, bottom), (1, -1.0, top)):
        if len(outline) == 0:
            break
        height = sign * (outline[:, axis] - bound)
        clipped = []
        for index in range(len(outline)):
            after = (index + 1) % len(outline)
            if height[index] >= 0.0:
                clipped.append(outline[index])
            if (height[index] >= 0.0) != (height[after] >= 0.0):
                share = height[index] / (height[index] - height[after])
                clipped.append(outline[index] + share * (outline[after] - outline[index]))
        outline = np.array(clipped).reshape(-1, 2)
    return outline


def signed_area(outline: np.ndarray) -> float:
    """Area of a polygon (V, 2), positive if it is counterclockwise."""
    if len(outline) < 3:
        return 0.0
    x, y = outline.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))


def polygon_area(outline: np.ndarray) -> float:
    """Area of a polygon (V, 2)."""
    return abs(signed_area(outline))
