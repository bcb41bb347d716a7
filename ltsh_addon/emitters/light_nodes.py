"""How neighboring lights and neighboring samples of a light tree are grouped.

Of lights there are binary trees of nodes, sums over their lights, and stand-ins for many lights. Samples form tiles,
with bounds on their positions and lobes. On smooth surfaces the light of ten samples of a tile is interpolated to the
others by cubics.
"""

import heapq
import itertools
from dataclasses import dataclass

import numpy as np

from ..lobes.polygon import dot
from ..scene import Light, QuadLight
from . import small_lights


class NodeSums:
    """Sums over the lights of nodes. The lights of a node are `order[start:end]`."""

    def __init__(self, order, start, end):
        self.order, self.start, self.end = order, start, end

    def __call__(self, values):
        """Sums (N, ...) of the lights' `values` (L, ...)."""
        running = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values[self.order], axis=0)])
        sums = running[self.end] - running[self.start]
        alone = self.end - self.start == 1
        sums[alone] = values[self.order[self.start[alone]]]
        return sums

    def moments(self, weight, offset, covariance, normal):
        """Of lights of a `weight` (L,): the sums of these (N,), the means (N, 3) and covariances (N, 3, 3) of what lies
        around `offset` (L, 3), the mean direction (N, 3) of unit `normal`s, and the length (N,) of their sum."""
        total = self(weight)
        middle = self(weight[:, None] * offset) / total[:, None]
        spread = weight[:, None, None] * (covariance + offset[:, :, None] * offset[:, None, :])
        spread = self(spread) / total[:, None, None] - middle[:, :, None] * middle[:, None, :]
        axis = self(weight[:, None] * normal)
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        axis, first = axis / np.maximum(length, 1e-300), normal[self.order[self.start]]
        return total, middle, spread, np.where(length > 1e-9 * total[:, None], axis, first), length[:, 0]


# LEAST_STAND_INS: of a group of lights, if there are as many. TURN: a turn by 1 rad counts as much as a way of so many
# times the size of the group.
LEAST_STAND_INS, TURN = 8, 0.1


def stand_ins(lights, most: int, group=0) -> tuple[list[Light], np.ndarray, list[np.ndarray]]:
    """Rectangles that stand for many flat lights with an area, the share (N,) of each that shines, and the numbers of
    the lights for which it stands: neighbors that face alike, of one `group` (L,). There are at most `most`, or up to
    LEAST_STAND_INS for each group."""
    center, area, covariance, _, _ = small_lights.moments_of(lights)
    size = np.linalg.norm(area, axis=1)
    normal, radiance = area / size[:, None], np.array([light.radiance for light in lights])
    group, weight = np.broadcast_to(group, size.shape), size * np.abs(radiance).sum(axis=1)
    members = _neighbors(center, normal, weight, [np.flatnonzero(group == one) for one in np.unique(group)], most)
    end = np.cumsum([len(numbers) for numbers in members])
    sums = NodeSums(np.concatenate(members), np.append(0, end[:-1]), end)
    origin = center.mean(axis=0)
    whole, middle, spread, axis, _ = sums.moments(size, center - origin, covariance, normal)
    radiance = sums(size[:, None] * radiance) / whole[:, None]
    along = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    variances, axes = np.linalg.eigh(along @ spread @ along)
    # Uniform rectangles with these variances, but no smaller than their shining area.
    half_v, half_u = (np.sqrt(3.0 * np.maximum(variances[:, k], 0.0)) for k in (1, 2))
    half_u = np.maximum(half_u, 1e-6 * np.sqrt(whole))
    half_v = np.maximum(half_v, 0.25 * whole / half_u)
    rows = zip(middle + origin, half_u[:, None] * axes[:, :, 2], half_v[:, None] * axes[:, :, 1], axis, strict=True)
    share = whole / (4.0 * half_u * half_v)
    radiance *= share[:, None]
    names = ("center", "half_u", "half_v", "direction")
    rectangles = [
        QuadLight.like(lights[numbers[0]], **dict(zip(names, row, strict=True)), radiance=mean)
        for row, mean, numbers in zip(rows, radiance, members, strict=True)
    ]
    return rectangles, share, members


def _neighbors(center, normal, weight, groups, most) -> list[np.ndarray]:
    """The numbers of lights in each group, of which those are halved again and again that have the most weight and
    differ most in place and direction."""
    key, ties = np.concatenate([center, normal], axis=1), itertools.count()
    for numbers in groups:
        key[numbers, 3:] *= TURN * np.linalg.norm(np.ptp(center[numbers], axis=0))

    def node(numbers):
        share = weight[numbers] / weight[numbers].sum()
        away = key[numbers] - share @ key[numbers]
        spread = (away * share[:, None]).T @ away
        ahead = away @ np.linalg.eigh(spread)[1][:, -1] > 0.0
        worth = weight[numbers].sum() * np.trace(spread) if ahead.any() and not ahead.all() else 0.0
        return -worth, next(ties), numbers, ahead

    def halved(heap, count):
        heapq.heapify(heap)
        while len(heap) < count and heap[0][0] < 0.0:
            *_, numbers, ahead = heapq.heappop(heap)
            for half in (numbers[ahead], numbers[~ahead]):
                heapq.heappush(heap, node(half))
        return heap

    nodes = halved([one for numbers in groups for one in halved([node(numbers)], min(LEAST_STAND_INS, most))], most)
    return [numbers for *_, numbers, _ in nodes]


def node_ranges(center, normal, body=None):
    """The order (L,) of the lights, the starts and the ends (N,) of the nodes in that order, and the children (N, 2) of
    the nodes. Each level halves the nodes above it where their lights differ most. Lights of the same `body` (L,) stay
    together, until a node has no others."""
    count = len(center)
    order = np.arange(count)
    if body is not None:
        sizes = np.bincount(body)[body]
        middles = np.stack([np.bincount(body, values)[body] for values in center.T], axis=1) / sizes[:, None]
        normals = np.where(sizes[:, None] > 1, 0.0, normal)
    starts, ends, children = [np.array([0])], [np.array([count])], []
    first = 1
    while True:
        start, end = starts[-1], ends[-1]
        inner = np.nonzero(end - start > 1)[0]
        child = np.full((len(start), 2), -1)
        child[inner] = first + np.arange(2 * len(inner)).reshape(-1, 2)
        children.append(child)
        if len(inner) == 0:
            return order, np.concatenate(starts), np.concatenate(ends), np.concatenate(children)
        start, end = start[inner], end[inner]
        first += 2 * len(inner)
        size = end - start
        member = np.repeat(np.arange(len(inner)), size)
        bounds = np.concatenate([[0], np.cumsum(size)[:-1]])
        places = np.repeat(start - bounds, size) + np.arange(size.sum())
        lights = order[places]
        values = np.concatenate([center[lights], normal[lights]], axis=1)
        if body is not None:
            numbers = body[lights]
            is_mixed = np.maximum.reduceat(numbers, bounds) > np.minimum.reduceat(numbers, bounds)
            together = np.concatenate([middles[lights], normals[lights]], axis=1)
            values = np.where(is_mixed[member, None], together, values)
        extent = np.maximum.reduceat(values, bounds) - np.minimum.reduceat(values, bounds)
        # A turn by 1 rad counts half as much as the whole width of a node.
        extent[:, 3:] *= 0.5 * np.linalg.norm(extent[:, :3], axis=1, keepdims=True)
        key = values[np.arange(len(values)), extent.argmax(axis=1)[member]]
        middle = (start + end) // 2
        if body is None:
            order[places] = lights[np.lexsort((key, member))]
        else:
            sort = np.lexsort((np.where(is_mixed[member], numbers, 0), key, member))
            order[places], numbers = lights[sort], numbers[sort]
            # Halve mixed nodes between two bodies.
            between = np.flatnonzero(np.diff(numbers) * (np.diff(member) == 0) * is_mixed[member[1:]]) + 1
            if len(between):
                aim, low = (middle - start + bounds)[is_mixed], bounds[is_mixed]
                after = np.searchsorted(between, aim)
                candidates = between[np.clip(np.stack([after - 1, after]), 0, len(between) - 1)]
                inside = (candidates > low) & (candidates < low + size[is_mixed])
                away = np.where(inside, np.abs(candidates - aim), len(places))
                chosen = candidates[away.argmin(axis=0), np.arange(len(aim))]
                middle[is_mixed] = chosen - low + start[is_mixed]
        starts.append(np.stack([start, middle], axis=1).ravel())
        ends.append(np.stack([middle, end], axis=1).ravel())


def normal_spreads(axis, normals, start, end):
    """The largest angles (N,) in rad between the axes (N, 3) and the normals (L, 3) `start` to `end` of each node."""
    cosines = over_lights(
        np.minimum, lambda node, light: products(axis[node], normals[light]), (np.arange(len(normals)), start, end)
    )
    return np.arccos(np.clip(cosines, -1.0, 1.0))


def over_lights(function, values, ranges):
    """For each of N nodes, the `function` of the values(nodes (M,), lights (M,)) of its lights, order[start:end]."""
    order, start, end = ranges
    result, largest = np.empty(len(start)), 1 << 16
    size = end - start
    for first in range(0, len(start), largest):
        chosen = np.arange(first, min(first + largest, len(start)))
        # Go level by level: each level has every light at most once.
        member = np.repeat(chosen, size[chosen])
        offset = np.concatenate([[0], np.cumsum(size[chosen])[:-1]])
        places = np.arange(len(member)) + np.repeat(start[chosen] - offset, size[chosen])
        result[chosen] = function.reduceat(values(member, order[places]), offset)
    return result


# ROUGHEST: how far all that the lobes depend on may differ from such cubics, in units of the lengths over which lobes
# change. LARGEST_WEIGHTS: limit for the sum of the absolute weights of the ten samples.
ROUGHEST, LARGEST_WEIGHTS = 1e-3, 8.0


@dataclass(frozen=True)
class Tiles:
    """T tiles of samples, and bounds on the lobes in them."""

    columns: list[np.ndarray]  # of the samples of each tile
    center: np.ndarray  # (T, 3) m
    half: np.ndarray  # (T, 3) m: half the box around the samples; this and what follows in single precision
    radius: np.ndarray  # (T,) m: half the diagonal of the box
    horizons: list[tuple[np.ndarray, np.ndarray]]  # cones around the normals of each horizon: axes (T, 3), angles (T,)
    mirrored: tuple[np.ndarray, np.ndarray] | None  # cones around the mirrored views; None for diffuse lobes
    width: np.ndarray | None  # (T,) rad, of the narrowest specular lobe
    only_tails: bool  # True: nodes must be in the tails of the lobes, `small_lights.SHARP_TAIL` from their peaks

    @classmethod
    def of(cls, lobes, position, columns) -> "Tiles":
        """The tiles with these `columns`, of samples with x, y, z in `position` (3, Q)."""
        every = np.concatenate(columns)
        first = np.concatenate([[0], np.cumsum([len(tile) for tile in columns])[:-1]])
        positions = position[:, every]
        low, high = (end.reduceat(positions, first, axis=1).T for end in (np.minimum, np.maximum))
        horizons = [direction_cones(lobes.rows[row][:, every], first) for row in lobes.clip_rows]
        mirrored = width = None
        if lobes.sharpest is not None:
            mirrored = direction_cones(lobes.sharpest.mirrored[:, every], first)
            width = np.minimum.reduceat(lobes.sharpest.width[every], first)
        half = (0.5 * (high - low)).astype(np.float32)
        return cls(columns, 0.5 * (low + high), half, lengths(half), horizons, mirrored, width, lobes.only_tails)


def neighbor_keys(lobes, position, chosen) -> np.ndarray:
    """Keys (D, Q') by which the columns `chosen` (Q',) are grouped: places, and directions of the lobes."""
    direction = lobes.rows[lobes.clip_rows[-1]] if lobes.sharpest is None else lobes.sharpest.mirrored
    positions = position[:, chosen]
    extent = np.ptp(positions, axis=1)
    weight = 4.0 / max(np.sqrt(extent @ extent), 1e-30)
    keys = np.concatenate([weight * (positions - positions.mean(axis=1, keepdims=True)), direction[:, chosen]])
    return keys.astype(np.float32)


@dataclass(frozen=True)
class TileCubics:
    """Ten samples of each of T tiles, and cubics of two coordinates that interpolate to its other samples."""

    anchors: np.ndarray  # (T, 10) places of the ten samples in the tile
    weights: np.ndarray  # (T, R, 10) for the at most R samples of a tile
    are_smooth: np.ndarray  # (T,) True if all that the lobes depend on is close to such a cubic

    @classmethod
    def of(cls, tiles, keys, shape) -> "TileCubics":
        """For tiles of the samples `tiles`. `keys` (D, Q) come from `neighbor_keys`; `shape` (S, Q) is what the lobes
        depend on, in units of the lengths over which they change."""
        count = max(map(len, tiles))
        index = np.stack([np.resize(members, count) for members in tiles])
        local = np.moveaxis(keys[:, index], 0, -1)
        local -= local.mean(axis=1, keepdims=True)
        size = np.maximum(np.abs(local[..., :3]).max(axis=(1, 2)), 1e-30)[:, None]
        _, axes = np.linalg.eigh(local.transpose(0, 2, 1) @ local)
        u, v = np.moveaxis(local @ axes[:, :, :-3:-1], -1, 0)
        u, v = (one / np.maximum(np.abs(one).max(axis=1, keepdims=True), 1e-30) for one in (u, v))
        one = np.ones_like(u)
        powers = [one, u, u * u, u * u * u, v, v * u, v * u * u, v * v, v * v * u, v * v * v]
        values = np.stack(powers, axis=-1)
        # Choose the samples that determine cubics best, one after another, by a pivoted Cholesky decomposition.
        tile, remaining = np.arange(len(tiles)), (values * values).sum(axis=2)
        factor, anchors, least = np.zeros_like(values), np.zeros((len(tiles), len(powers)), int), np.inf
        for step in range(len(powers)):
            pivot = remaining.argmax(axis=1)
            most = remaining[tile, pivot]
            column = values @ values[tile, pivot][:, :, None] - factor @ factor[tile, pivot][:, :, None]
            factor[:, :, step] = column[..., 0] / np.sqrt(np.maximum(most, 1e-30))[:, None]
            remaining -= factor[:, :, step] ** 2
            anchors[:, step], least = pivot, np.minimum(least, most)
        are_smooth = least > 1e-4
        chosen = factor[tile[:, None], anchors].astype(np.float64)
        chosen[~are_smooth] = np.eye(len(powers))
        weights = (factor @ np.linalg.inv(chosen)).astype(np.float32)
        are_smooth &= np.abs(weights).sum(axis=2).max(axis=1) < LARGEST_WEIGHTS
        shape = np.concatenate([local[..., :3] / size[..., None], np.moveaxis(shape[:, index], 0, -1)], axis=2)
        off = np.abs(weights @ shape[tile[:, None], anchors] - shape).max(axis=(1, 2))
        return cls(anchors, weights, are_smooth & (off < ROUGHEST))


def split_columns(keys, columns, most):
    """Parts of the columns `columns` that are neighbors in `keys` (D, Q), at most `most` columns each."""
    if len(columns) <= most:
        return [columns]
    values = keys[:, columns]
    along = values[np.argmax(np.ptp(values, axis=1))]
    order = np.argpartition(along, len(columns) // 2)
    half = len(columns) // 2
    return [*split_columns(keys, columns[order[:half]], most), *split_columns(keys, columns[order[half:]], most)]


def direction_cones(vectors, first):
    """Axes (T, 3) and angles (T,) of cones around the vectors (3, Q) of each tile. `first` (T,) is its first column."""
    unit = vectors.astype(np.float64)
    unit /= np.maximum(np.sqrt(dot(unit, unit)), 1e-30)
    axis = np.add.reduceat(unit, first, axis=1)
    axis /= np.maximum(np.sqrt(dot(axis, axis)), 1e-30)
    count = np.diff(np.append(first, unit.shape[1]))
    least = np.minimum.reduceat(dot(np.repeat(axis, count, axis=1), unit), first)
    return axis.T.astype(np.float32), np.arccos(np.clip(least, -1.0, 1.0)).astype(np.float32)


def products(one, two):
    """Dot products (K,) of vectors (K, 3)."""
    return np.einsum("ki,ki->k", one, two)


def lengths(vectors):
    """Lengths (K,) of vectors (K, 3)."""
    return np.sqrt(products(vectors, vectors))
