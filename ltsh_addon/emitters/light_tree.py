"""Many lights at once: lights that are far away, face away or count little are shaded together.

The lights of a group are the leaves of a binary tree. Neighboring samples form a tile. In every branch, a tile takes
the coarsest node that is small, or whose error is at most ERROR of the light that the tile gets from the group on
average. These are far fewer nodes than there are lights. A node becomes one point, two or four, with the mean and the
variances of its brightness; the normals of its lights count as uniform around their mean.

The error is estimated as the light of the node times the fourth power of its size, in units of the length over which
the integrand changes (see `small_lights`). Distances and angles are bounded for the whole tile. Where a horizon or the
plane of one of the lights may cross the node, some of the node's light adds to the error. Points in the tail of an
"ltsh" lobe get its true value there, as in `tails`.

If a tile has many leaves that are still too large, smaller tiles look at them again. The leaves that remain are shaded
together as polygons. On smooth surfaces, the light of ten samples of a tile is interpolated to the others, except for
near nodes. (Walter et al. 2005, "Lightcuts", with tiles instead of points, doi:10.1145/1073204.1073318.)
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ..lobes.polygon import dot
from ..scene import Light, QuadLight
from . import small_lights
from .tails import NEAR_RADII

# A group with fewer lights is shaded light by light.
FEWEST = 64
# Size of a node in units of the length over which the integrand changes. SMALL: such nodes are used whatever their
# light. LARGEST: no larger node is used. ERROR: in between, a node is used if its error is at most this share of the
# light that a tile gets from the group, for diffuse and for specular lobes.
SMALL, LARGEST, ERROR = 0.25, 3.0, (4e-4, 2.5e-4)
# Size of the nodes from which that light is estimated.
COARSE = 0.6
# Smaller nodes are one point, others two or four.
POINT = 0.08
# The error of a node's points, in units of its light times the fourth power of its size.
FOURTH_ORDER = 1.0
# Angle in rad from the peak of a sharp lobe beyond which single precision finds its tail to 2e-4.
SHARP_TAIL = 0.05
# Leaves are shaded as polygons if their error exceeds LEAF_ERROR of the tile's light, or their size LEAF_SIZE. In the
# finer tiles below the limit is FINER_LEAF_ERROR: these differ in where their lobes point, so that their light may be
# far below its bound.
LEAF_ERROR, FINER_LEAF_ERROR, LEAF_SIZE = 2e-3, 5e-4, 1.0
# The light of a node is interpolated between ten samples if the error of cubics is at most ERROR. That error is
# INTERPOLATED times the fourth power of the tile's size as seen from the node.
INTERPOLATED = 0.3
# ROUGHEST: how far all that the lobes depend on may differ from such cubics, in units of the lengths over which lobes
# change. LARGEST_WEIGHTS: limit for the sum of the absolute weights of the ten samples.
ROUGHEST, LARGEST_WEIGHTS = 1e-3, 8.0
# Lower limit of divisors: lengths in m, and cosines.
LEAST = np.float32(1e-12)
# TILE: most samples of a tile, for diffuse and for specular lobes. PAIRS: pairs of a sample and a point per chunk.
TILE, PAIRS = (400, 200), 32768
# A tile that must shade more than MANY_LEAVES leaves as polygons is cut into tiles of at most FINER_TILE samples.
FINER_TILE, MANY_LEAVES = 25, 20
# Least swing of a node, as a share of its power. Up to twice that, its lights count as parallel.
TURNED = 1e-6
# CROSSED: largest error of a node that a horizon crosses, as a share of its light times the sine of its radius. SWUNG:
# the same as a share of the swing of its lights, if some of them may face away.
CROSSED, SWUNG = 0.1, 0.02

# The points of a node along its axes, (W, P, 3), in W alternative ways. They have the node's variances; for a square
# they are the Gauss points.
CORNERS = np.array([[[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]])
# For specular lobes two opposite corners of a box are enough. The next node takes another pair.
PAIRS_OF_CORNERS = np.stack([CORNERS[0], -CORNERS[0]], axis=1)


@dataclass(frozen=True)
class LightTree:
    """N nodes with the root first. `number` is the light of a leaf, and -1 for a branch."""

    center: np.ndarray  # (N, 3) m, of brightness
    reach: np.ndarray  # (N,) m: sqrt(3) standard deviations of the brightness; for a square, half its diagonal
    axes: np.ndarray  # (3, 3, N) m: principal axes of the brightness (first axis), a standard deviation long
    axis: np.ndarray  # (N, 3) mean direction into which the lights shine
    cone: np.ndarray  # (N,) rad: largest angle of a light's direction from `axis`; reach, axis and cone are float32
    vector: np.ndarray  # (N, 3): mean radiance times area vectors
    swing: np.ndarray  # (N,) mean radiance times area: how much of a vector may belong to lights that face away
    color: np.ndarray  # (3, N) of the light, 1 on average
    power: np.ndarray  # (N,) mean radiance times area
    diagonal: np.ndarray  # (N,) mean of `SmallLight.diagonal`; float32, as are swing and color
    children: np.ndarray  # (N, 2) numbers of nodes
    number: np.ndarray  # (N,) of the light

    @classmethod
    def of(cls, lights) -> LightTree:
        """The tree of lights whose radiance is positive."""
        center, area, covariance, diagonal = small_lights.moments_of(lights)
        radiance = np.array([light.radiance for light in lights])
        brightness, size = radiance.mean(axis=1), np.linalg.norm(area, axis=1)
        power, normal = brightness * size, area / size[:, None]
        order, start, end, children = node_ranges(center, normal)
        sums = _Sums(order, start, end)
        total = sums(power)
        origin = center.mean(axis=0)
        middle = sums(power[:, None] * (center - origin)) / total[:, None]
        offset = center - origin
        spread = power[:, None, None] * (covariance + offset[:, :, None] * offset[:, None, :])
        spread = sums(spread) / total[:, None, None] - middle[:, :, None] * middle[:, None, :]
        alone = end - start == 1
        spread[alone] = covariance[order[start[alone]]]
        variances, axes = np.linalg.eigh(spread)
        variances = np.maximum(variances, 0.0)
        axes = (np.sqrt(variances)[:, None] * axes).transpose(2, 1, 0)
        axis = sums(power[:, None] * normal)
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        axis = np.where(length > 1e-9 * total[:, None], axis / np.maximum(length, 1e-300), normal[order[start]])
        vector = sums(brightness[:, None] * area)
        color = (sums(radiance * size[:, None]).T / total).astype(np.float32)
        # Cosines are taken as uniform over sqrt(3) standard deviations of the directions on either side of the mean.
        turned = np.maximum(1.0 - (length[:, 0] / total) ** 2, 0.0) * (end - start > 1)
        swing = (total * np.maximum(np.sqrt(1.5 * turned), TURNED)).astype(np.float32)
        cone = normal_spreads(axis, normal[order], start, end)
        number = np.where(end - start == 1, order[start], -1)
        diagonal = (sums(power * diagonal) / total).astype(np.float32)
        reach = np.sqrt(3.0 * variances.sum(axis=1))
        reach, axis, cone = (values.astype(np.float32) for values in (reach, axis, cone))
        return cls(middle + origin, reach, axes, axis, cone, vector, swing, color, total, diagonal, children, number)

    @cached_property
    def is_turned(self) -> np.ndarray:
        """Mask (N,) of the nodes whose lights face differently."""
        return self.swing > 2.0 * TURNED * self.power

    @cached_property
    def places(self) -> list[np.ndarray]:
        """Points (N W, 3), W for each node; one array for diffuse and one for specular lobes."""
        number, found = np.arange(len(self.center)), []
        for corners in (CORNERS, PAIRS_OF_CORNERS):
            # Nodes take the ways in turn, so that their errors cancel.
            ways = corners[number % len(corners)]
            points = np.stack([(ways * self.axes[:, axis].T[:, None]).sum(axis=2) for axis in range(3)], axis=2)
            found.append((self.center[:, None] + points).reshape(-1, 3))
        return found


class _Sums:
    """Sums over the lights of nodes. The lights of a node are `order[start:end]`."""

    def __init__(self, order, start, end):
        self.order, self.start, self.end = order, start, end

    def __call__(self, values):
        """Sums (N, ...) of the lights' `values` (L, ...)."""
        running = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values[self.order], axis=0)])
        found = running[self.end] - running[self.start]
        alone = self.end - self.start == 1
        found[alone] = values[self.order[self.start[alone]]]
        return found


def stand_ins(lights, most: int) -> tuple[list[Light], np.ndarray]:
    """Rectangles that stand for many flat lights with an area, and the share (N,) of each that shines. Each stands
    for neighbors that face alike. There are N = `most`, a power of two and at most as many as there are lights."""
    center, area, covariance, _ = small_lights.moments_of(lights)
    size = np.linalg.norm(area, axis=1)
    normal = area / size[:, None]
    order, start, end, _ = node_ranges(center, normal, most)
    sums = _Sums(order, start[-most:], end[-most:])
    whole = sums(size)
    radiance = sums(size[:, None] * np.array([light.radiance for light in lights])) / whole[:, None]
    origin = center.mean(axis=0)
    offset = center - origin
    middle = sums(size[:, None] * offset) / whole[:, None]
    spread = covariance + offset[:, :, None] * offset[:, None, :]
    spread = sums(size[:, None, None] * spread) / whole[:, None, None] - middle[:, :, None] * middle[:, None, :]
    axis = sums(size[:, None] * normal)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    axis = np.where(length > 1e-9 * whole[:, None], axis / np.maximum(length, 1e-300), normal[order[sums.start]])
    along = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    variances, axes = np.linalg.eigh(along @ spread @ along)
    # Uniform rectangles with these variances, but no smaller than their shining area.
    half_v, half_u = (np.sqrt(3.0 * np.maximum(variances[:, k], 0.0)) for k in (1, 2))
    half_u = np.maximum(half_u, 1e-6 * np.sqrt(whole))
    half_v = np.maximum(half_v, 0.25 * whole / half_u)
    rows = zip(middle + origin, half_u[:, None] * axes[:, :, 2], half_v[:, None] * axes[:, :, 1], axis, strict=True)
    share = whole / (4.0 * half_u * half_v)
    radiance *= share[:, None]
    like = QuadLight.like(lights[0])
    names = ("center", "half_u", "half_v", "direction")
    found = [
        like.altered(**dict(zip(names, row, strict=True)), radiance=own)
        for row, own in zip(rows, radiance, strict=True)
    ]
    return found, share


def node_ranges(center, normal, most=np.inf):
    """The order (L,) of the lights, the starts and the ends (N,) of the nodes in that order, and the children (N, 2) of
    the nodes. Each level halves the nodes above it where their lights differ most. The last level is the first that has
    `most` nodes."""
    count = len(center)
    order = np.arange(count)
    starts, ends, children = [np.array([0])], [np.array([count])], []
    first = 1
    while True:
        start, end = starts[-1], ends[-1]
        inner = np.nonzero(end - start > 1)[0]
        own = np.full((len(start), 2), -1)
        own[inner] = first + np.arange(2 * len(inner)).reshape(-1, 2)
        children.append(own)
        if len(inner) == 0 or len(start) >= most:
            return order, np.concatenate(starts), np.concatenate(ends), np.concatenate(children)
        start, end = start[inner], end[inner]
        first += 2 * len(inner)
        size = end - start
        member = np.repeat(np.arange(len(inner)), size)
        places = np.repeat(start - np.concatenate([[0], np.cumsum(size)[:-1]]), size) + np.arange(size.sum())
        bounds = np.concatenate([[0], np.cumsum(size)[:-1]])
        values = np.concatenate([center[order[places]], normal[order[places]]], axis=1)
        extent = np.maximum.reduceat(values, bounds) - np.minimum.reduceat(values, bounds)
        # A turn by 1 rad counts half as much as the whole width of a node.
        extent[:, 3:] *= 0.5 * np.linalg.norm(extent[:, :3], axis=1, keepdims=True)
        key = values[np.arange(len(values)), extent.argmax(axis=1)[member]]
        order[places] = order[places][np.lexsort((key, member))]
        middle = (start + end) // 2
        starts.append(np.stack([start, middle], axis=1).ravel())
        ends.append(np.stack([middle, end], axis=1).ravel())


def normal_spreads(axis, normals, start, end):
    """The largest angles (N,) in rad between the axes (N, 3) and the normals (L, 3) `start` to `end` of each node."""
    least, largest = np.ones(len(axis)), 1 << 16
    size = end - start
    for first in range(0, len(axis), largest):
        chosen = np.arange(first, min(first + largest, len(axis)))
        # Go level by level: each level has every light at most once.
        member = np.repeat(chosen, size[chosen])
        offset = np.concatenate([[0], np.cumsum(size[chosen])[:-1]])
        places = np.arange(len(member)) + np.repeat(start[chosen] - offset, size[chosen])
        least[chosen] = np.minimum.reduceat((axis[member] * normals[places]).sum(axis=1), offset)
    return np.arccos(np.clip(least, -1.0, 1.0))


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
    only_tails: bool  # True: nodes must be in the tails of the lobes, at least `SHARP_TAIL` from their peaks

    @classmethod
    def of(cls, lobes, position, columns) -> Tiles:
        """The tiles with these `columns`, of samples with x, y, z in `position` (3, Q)."""
        every = np.concatenate(columns)
        first = np.concatenate([[0], np.cumsum([len(own) for own in columns])[:-1]])
        place = position[:, every]
        low, high = (end.reduceat(place, first, axis=1).T for end in (np.minimum, np.maximum))
        horizons = [_cones_of(lobes.rows[row][:, every], first) for row in lobes.clip_rows]
        mirrored = width = None
        if lobes.sharpest is not None:
            mirrored = _cones_of(lobes.sharpest.mirrored[:, every], first)
            width = np.minimum.reduceat(lobes.sharpest.width[every], first)
        half = (0.5 * (high - low)).astype(np.float32)
        return cls(columns, 0.5 * (low + high), half, _lengths(half), horizons, mirrored, width, lobes.only_tails)


def _keys(lobes, position, chosen) -> np.ndarray:
    """Keys (D, Q') by which the columns `chosen` (Q',) are grouped: places, and directions of the lobes."""
    direction = lobes.rows[lobes.clip_rows[-1]] if lobes.sharpest is None else lobes.sharpest.mirrored
    place = position[:, chosen]
    extent = np.ptp(place, axis=1)
    weight = 4.0 / max(np.sqrt(extent @ extent), 1e-30)
    keys = np.concatenate([weight * (place - place.mean(axis=1, keepdims=True)), direction[:, chosen]])
    return keys.astype(np.float32)


@dataclass(frozen=True)
class Cubics:
    """Ten samples of each of T tiles, and cubics of two coordinates that interpolate to its other samples."""

    anchors: np.ndarray  # (T, 10) places of the ten samples in the tile
    weights: np.ndarray  # (T, R, 10) for the at most R samples of a tile
    are_smooth: np.ndarray  # (T,) True if all that the lobes depend on is close to such a cubic

    @classmethod
    def of(cls, parts, keys, shape) -> Cubics:
        """For tiles of the samples `parts`. `keys` (D, Q) come from `_keys`; `shape` (S, Q) is what the lobes
        depend on, in units of the lengths over which they change."""
        count = max(map(len, parts))
        index = np.stack([np.resize(part, count) for part in parts])
        own = np.moveaxis(keys[:, index], 0, -1)
        own -= own.mean(axis=1, keepdims=True)
        size = np.maximum(np.abs(own[..., :3]).max(axis=(1, 2)), 1e-30)[:, None]
        _, axes = np.linalg.eigh(own.transpose(0, 2, 1) @ own)
        u, v = np.moveaxis(own @ axes[:, :, :-3:-1], -1, 0)
        u, v = (one / np.maximum(np.abs(one).max(axis=1, keepdims=True), 1e-30) for one in (u, v))
        one = np.ones_like(u)
        powers = [one, u, u * u, u * u * u, v, v * u, v * u * u, v * v, v * v * u, v * v * v]
        values = np.stack(powers, axis=-1)
        # Choose the samples that determine cubics best, one after another, by a pivoted Cholesky decomposition.
        tile, left = np.arange(len(parts)), (values * values).sum(axis=2)
        found, anchors, least = np.zeros_like(values), np.zeros((len(parts), len(powers)), int), np.inf
        for step in range(len(powers)):
            place = left.argmax(axis=1)
            most = left[tile, place]
            column = values @ values[tile, place][:, :, None] - found @ found[tile, place][:, :, None]
            found[:, :, step] = column[..., 0] / np.sqrt(np.maximum(most, 1e-30))[:, None]
            left -= found[:, :, step] ** 2
            anchors[:, step], least = place, np.minimum(least, most)
        are_smooth = least > 1e-4
        chosen = found[tile[:, None], anchors].astype(np.float64)
        chosen[~are_smooth] = np.eye(len(powers))
        weights = (found @ np.linalg.inv(chosen)).astype(np.float32)
        are_smooth &= np.abs(weights).sum(axis=2).max(axis=1) < LARGEST_WEIGHTS
        shape = np.concatenate([own[..., :3] / size[..., None], np.moveaxis(shape[:, index], 0, -1)], axis=2)
        off = np.abs(weights @ shape[tile[:, None], anchors] - shape).max(axis=(1, 2))
        return cls(anchors, weights, are_smooth & (off < ROUGHEST))


def _halves(keys, part, most):
    """Parts of the columns `part` that are neighbors in `keys` (D, Q), at most `most` columns each."""
    if len(part) <= most:
        return [part]
    own = keys[:, part]
    along = own[np.argmax(np.ptp(own, axis=1))]
    order = np.argpartition(along, len(part) // 2)
    half = len(part) // 2
    return [*_halves(keys, part[order[:half]], most), *_halves(keys, part[order[half:]], most)]


def _cones_of(vectors, first):
    """Axes (T, 3) and angles (T,) of cones around the vectors (3, Q) of each tile. `first` (T,) is its first column."""
    own = vectors.astype(np.float64)
    own /= np.maximum(np.sqrt(dot(own, own)), 1e-30)
    axis = np.add.reduceat(own, first, axis=1)
    axis /= np.maximum(np.sqrt(dot(axis, axis)), 1e-30)
    count = np.diff(np.append(first, own.shape[1]))
    least = np.minimum.reduceat(dot(np.repeat(axis, count, axis=1), own), first)
    return axis.T.astype(np.float32), np.arccos(np.clip(least, -1.0, 1.0)).astype(np.float32)


def _angles(offset, distance, axis):
    """Angles (K,) in rad between vectors `offset` (K, 3), `distance` (K,) long, and the unit vectors `axis` (K, 3)."""
    return np.arccos(np.clip(_products(offset, axis) / distance, -1.0, 1.0))


def _products(one, two):
    """Dot products (K,) of vectors (K, 3)."""
    return np.einsum("ki,ki->k", one, two)


def _lengths(vectors):
    """Lengths (K,) of vectors (K, 3)."""
    return np.sqrt(_products(vectors, vectors))


def _heights(ranges, offset, axis, cone):
    """Heights (K,) of nodes at `offset` (K, 3) over planes through tiles with the normals `axis` (K, 3), and how much
    they may differ (K,) within `ranges`: the reach (K,) of the node, half the box (K, 3) of the tile, and the largest
    distance (K,) between them. Normals are within `cone` (K,) in rad of the axis."""
    reach, half, farthest = ranges
    slack = reach + _products(half, np.abs(axis)) + np.sin(np.minimum(cone, 0.5 * np.pi)) * farthest
    return _products(offset, axis), slack


@dataclass(frozen=True)
class NodeDistances:
    """Where nodes are as seen from tiles, for K pairs; lengths in m."""

    offset: np.ndarray  # (K, 3) from center to center
    half: np.ndarray  # (K, 3) half the box of the tile
    reach: np.ndarray  # of the node
    radius: np.ndarray  # of the tile
    distance: np.ndarray  # between the centers
    nearest: np.ndarray  # from the box to the center of the node
    parallax: np.ndarray  # rad: how much directions from points of the tile to points of the node may differ

    @classmethod
    def of(cls, tree: LightTree, tiles: Tiles, tile, node) -> NodeDistances:
        """For the numbers (K,) of tiles and nodes."""
        offset = (tree.center[node] - tiles.center[tile]).astype(np.float32)
        half, reach, radius = tiles.half[tile], tree.reach[node], tiles.radius[tile]
        gap = np.maximum(np.abs(offset) - half, 0.0)
        distance, nearest = (np.maximum(_lengths(vectors), LEAST) for vectors in (offset, gap))
        extent = radius + reach
        parallax = np.where(extent < distance, np.arcsin(np.minimum(extent / distance, 1.0)), np.float32(np.pi))
        return cls(offset, half, reach, radius, distance, nearest, parallax)

    def away(self, axes, cones):
        """Lower bound (K,) in rad on angles between directions to nodes and cones of directions; negative within."""
        return _angles(self.offset, self.distance, axes) - cones - self.parallax

    @property
    def ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The ranges for `_heights`."""
        return self.reach, self.half, self.distance + (self.radius + self.reach)


@dataclass
class _Pairs:
    """K pairs of a tile and a node: upper bounds on their light and on its error."""

    tile: np.ndarray
    node: np.ndarray
    are_leaves: np.ndarray
    is_dark: np.ndarray
    are_crossed: np.ndarray  # a horizon may cross the node
    is_smooth: np.ndarray  # light may be interpolated between samples
    are_in_tail: np.ndarray  # of all lobes
    is_wrong: np.ndarray  # no points may stand for the node
    size: np.ndarray  # of the node, in units of the length over which the integrand changes
    change: np.ndarray  # of the integrand over the tile
    light: np.ndarray  # upper bound for any sample
    mean: np.ndarray  # estimated mean over all samples; near a large tile few samples get the most
    crossed: np.ndarray  # light that is wrong where horizons and planes cross the node

    @classmethod
    def of(cls, tree: LightTree, tiles: Tiles, tile, node) -> _Pairs:
        """For the numbers (K,) of tiles and nodes."""
        between = NodeDistances.of(tree, tiles, tile, node)
        size, seen = between.reach / between.nearest, between.radius / between.nearest
        # Where a horizon or its own plane crosses a light, the cosine is at most this.
        rim = np.minimum(2.0 * size, 1.0)
        light, plane, crossed, is_dark = _shining(tree, node, between, rim)
        are_crossed = np.zeros(len(node), bool)
        for number, (axes, cones) in enumerate(tiles.horizons):
            turn = cones[tile]
            height, slack = _heights(between.ranges, between.offset, axes[tile], turn)
            is_dark |= height < -slack
            is_crossed = height < slack
            are_crossed |= is_crossed
            if tiles.mirrored is None and number == len(tiles.horizons) - 1:
                steepest = np.cos(np.clip(between.away(axes[tile], turn), 0.0, 0.5 * np.pi))
                light *= steepest
                is_crossed = is_crossed * np.minimum(rim / np.maximum(steepest, LEAST), 1.0)
            crossed += CROSSED * is_crossed
        # One light goes dark all at once behind its plane; lights that face differently go dark one after another.
        is_smooth = ~are_crossed & ((plane == 0.0) | tree.is_turned[node])
        are_in_tail, is_wrong = np.zeros((2, len(node)), bool)
        if tiles.mirrored is not None:
            axes, cones = tiles.mirrored
            turn, width = cones[tile], tiles.width[tile]
            away = np.maximum(between.away(axes[tile], turn), 0.0)
            # The criterion of `TailLimits`, for each of the lights.
            near = NEAR_RADII * np.sqrt(tree.diagonal[node])
            are_in_tail = np.sin(np.minimum(away, 0.5 * np.pi)) * between.nearest > near
            if tiles.only_tails:
                are_in_tail &= away > SHARP_TAIL
                is_wrong = ~are_in_tail
            light *= (width**2 / (width**2 + away**2)) ** 2
            length = np.minimum(width + away, 1.0)
            size, seen, turn = size / length, seen / length, turn / length
        light[is_dark] = 0.0
        mean = light / (1.0 + (between.radius / np.maximum(between.nearest, between.reach)) ** 2)
        change, are_leaves = np.minimum(seen + turn, 1.0), tree.number[node] >= 0
        are = are_leaves, is_dark, are_crossed, is_smooth, are_in_tail, is_wrong
        return cls(tile, node, *are, size, change, light, mean, light * crossed)

    @property
    def are_points(self) -> np.ndarray:
        """Mask (K,) of the nodes that are a single point."""
        return self.size < POINT

    def are_fine(self, most) -> np.ndarray:
        """Mask (K,) of the nodes that may be used: their error is at most `most` (K,), or they are small."""
        small = (self.size < SMALL) & (self.crossed <= most)
        error = self.light * FOURTH_ORDER * np.minimum(self.size, 1.0) ** 4 + self.crossed
        return (small | (self.size < LARGEST) & (error <= most)) & ~self.is_wrong

    def are_near(self, most) -> np.ndarray:
        """Mask (K,) of the leaves to shade as polygons; their error as points may be `most` (K,)."""
        are_points = self.are_fine(most) & (self.size < LEAF_SIZE)
        return self.are_leaves & ~are_points

    def by_tile(self):
        """Yield (number of a tile, its pairs)."""
        pairs = self.take(np.argsort(self.tile, kind="stable"))
        numbers, first = np.unique(pairs.tile, return_index=True)
        for number, start, end in zip(numbers, first, np.append(first, len(pairs.tile))[1:], strict=True):
            yield number, pairs.take(slice(start, end))

    def take(self, index) -> _Pairs:
        """The pairs at `index` (Q,)."""
        return _Pairs(*(getattr(self, own.name)[index] for own in fields(self)))

    @classmethod
    def joined(cls, parts) -> _Pairs:
        """All pairs of the `parts`."""
        return cls(*(np.concatenate([getattr(part, own.name) for part in parts]) for own in fields(cls)))


def _shining(tree: LightTree, node, between: NodeDistances, rim):
    """For K pairs: an upper bound on the light; the share of all light, and of this light, that may be wrong because a
    sample may be in the plane of a light; and whether the nodes face away."""
    angle, cone = _angles(-between.offset, between.distance, tree.axis[node]), tree.cone[node]
    shining = np.cos(np.clip(angle - cone - between.parallax, 0.0, 0.5 * np.pi))
    power = tree.power[node]
    light = power * shining / np.maximum(between.nearest, between.reach) ** 2
    height, slack = _heights(between.ranges, -between.offset, tree.axis[node], cone)
    plane = np.where(height < slack, np.minimum(SWUNG * (tree.swing[node] / power) + CROSSED * rim, 1.0), 0.0)
    return light, plane, np.minimum(plane / np.maximum(shining, LEAST), 1.0), height < -slack


def _refined(tree, tiles, is_fine) -> _Pairs:
    """The coarsest `_Pairs` of all tiles for which is_fine(pairs) holds or which are leaves, without dark ones."""
    fine, tile, node = [], np.arange(len(tiles.columns)), np.zeros(len(tiles.columns), int)
    while len(node) or not fine:
        pairs = _Pairs.of(tree, tiles, tile, node)
        done = pairs.are_leaves | is_fine(pairs)
        fine.append(pairs.take(done & ~pairs.is_dark))
        open_ones = ~(done | pairs.is_dark)
        tile, node = np.repeat(tile[open_ones], 2), tree.children[node[open_ones]].ravel()
    return _Pairs.joined(fine)


def add_far_lights(tree: LightTree, lobes, position, chosen, total) -> tuple[np.ndarray, np.ndarray]:
    """Add the light of the tree to `total` (F, 3, Q), for the columns `chosen` (Q',) of `lobes`, at x, y, z in
    `position` (3, Q). Returns the pairs (K,) that are left: columns, and numbers of the lights to shade as polygons."""
    is_specular = lobes.sharpest is not None
    keys = _keys(lobes, position, chosen)
    parts = _halves(keys, np.arange(len(chosen)), TILE[is_specular])
    tiles = Tiles.of(lobes, position, [chosen[part] for part in parts])
    cubics = Cubics.of(parts, keys, lobes.shape[:, chosen])
    coarse = _refined(tree, tiles, lambda pairs: pairs.size < COARSE)
    light = np.bincount(coarse.tile, coarse.mean, len(parts))
    most = ERROR[is_specular] * light
    pairs = _refined(tree, tiles, lambda pairs: pairs.are_fine(most[pairs.tile]))
    pairs.is_smooth &= cubics.are_smooth[pairs.tile] & (
        INTERPOLATED * pairs.change**4 * pairs.light <= most[pairs.tile]
    )
    near = pairs.are_near(LEAF_ERROR * light[pairs.tile])
    for number, own in pairs.take(~near).by_tile():
        columns = tiles.columns[number]
        smooth = own.is_smooth
        if smooth.any():
            few, weights = columns[cubics.anchors[number]], cubics.weights[number, : len(columns)].T
            total[:, :, columns] += _light_of(tree, lobes, position[:, few], (few, own.take(smooth))) @ weights
            own = own.take(~smooth)
        if not smooth.all():
            total[:, :, columns] += _light_of(tree, lobes, position[:, columns], (columns, own))
    light = np.bincount(pairs.tile[~near], pairs.mean[~near], len(parts))
    near, left, tile, node, finer = pairs.take(near), [], [], [], []
    for number, own in near.by_tile():
        if len(own.node) <= MANY_LEAVES:
            left.append((tiles.columns[number], own))
            continue
        for part in _halves(keys, parts[number], FINER_TILE):
            tile.append(np.full(len(own.node), len(finer)))
            node.append(own.node)
            finer.append((chosen[part], light[number]))
    if finer:
        columns, light = zip(*finer, strict=True)
        pairs = _Pairs.of(tree, Tiles.of(lobes, position, columns), np.concatenate(tile), np.concatenate(node))
        pairs = pairs.take(~pairs.is_dark)
        light = light + np.bincount(pairs.tile, pairs.mean, len(finer))
        near = pairs.are_near(FINER_LEAF_ERROR * light[pairs.tile])
        for number, own in pairs.take(~near).by_tile():
            part = columns[number]
            total[:, :, part] += _light_of(tree, lobes, position[:, part], (part, own))
        left += [(columns[number], own) for number, own in pairs.take(near).by_tile()]
    columns = [np.repeat(part, len(own.node)) for part, own in left]
    numbers = [np.tile(tree.number[own.node], len(part)) for part, own in left]
    return tuple(np.concatenate([np.empty(0, np.intp), *own]) for own in (columns, numbers))


@dataclass(frozen=True)
class PointDirections:
    """Like `small_lights.RaysToCenters`, arrays (Q, K) from Q samples of a tile to K points."""

    ends: np.ndarray  # (4, K): offsets of the points from the middle of the tile, then 1
    place: np.ndarray  # (4, Q): offsets of the samples, then 1
    squares: np.ndarray
    distance: np.ndarray
    flux: np.ndarray
    diagonal: np.ndarray  # (K,)
    slack: None = None

    def heights(self, vectors) -> np.ndarray:
        """Products (Q, K) of the rays with `vectors` (3, Q, 1)."""
        vectors = vectors[..., 0]
        return np.concatenate([vectors, -dot(vectors, self.place)[None]]).T @ self.ends


class _Points:
    """The K points that stand for nodes of a tree in a tile."""

    def __init__(self, tree, pairs: _Pairs, middle, is_specular):
        nodes, single, crossed = pairs.node, pairs.are_points, pairs.are_crossed
        places, turned = tree.places[is_specular], tree.is_turned[nodes]
        # Nodes that take longer come last.
        order = np.argsort(2 * turned + crossed, kind="stable")
        most = len(places) // len(tree.center)
        count = np.where(single, 1, most)[order]
        node = np.repeat(nodes[order], count)
        ends = np.cumsum(count)
        points = places[most * node + np.arange(len(node)) - np.repeat(ends - count, count)]
        alone = ends[count == 1] - 1
        points[alone] = tree.center[node[alone]]
        points -= middle
        self.is_crossed, self.is_turned = np.repeat(crossed[order], count), np.repeat(turned[order], count)
        self.colors = tree.color[:, node] / np.repeat(count, count).astype(np.float32)
        self.squared, vector = (points * points).sum(axis=1), tree.vector[node]
        self.ends, self.from_squares, self.from_plane = np.ones((3, 4, len(node)), np.float32)
        self.ends[:3] = points.T
        self.from_squares[:3], self.from_squares[3] = -2.0 * points.T, self.squared
        self.from_plane[:3], self.from_plane[3] = vector.T, -(vector * points).sum(axis=1)
        self.swing, self.diagonal = tree.swing[node], tree.diagonal[node]

    def fan(self, part, place) -> PointDirections:
        """Rays from `place` (4, Q) to the points `part`, a slice."""
        ends, size = self.ends[:, part], dot(place, place)
        # Matrix products lose digits of the squares if points are near compared with the size of the tile.
        if self.squared[part].min() > 4.0 * size.max():
            squares = place.T @ self.from_squares[:, part]
            squares += size[:, None]
        else:
            offset = ends[:3, None] - place[:3, :, None]
            squares = dot(offset, offset)
        distance = np.sqrt(squares)
        flux = place.T @ self.from_plane[:, part]
        if self.is_turned[part].any():
            flux = _mean_above_zero(flux, self.swing[part] * distance)
        else:
            np.maximum(flux, np.float32(0.0), out=flux)
        return PointDirections(ends, place, squares, distance, flux, self.diagonal[part])


def _light_of(tree, lobes, position, tile) -> np.ndarray:
    """The light (F, 3, Q) of nodes. `tile` is the columns (Q,), at x, y, z in `position` (3, Q), and the `_Pairs` with
    the nodes."""
    columns, pairs = tile
    middle = position.mean(axis=1)
    place = np.ones((4, len(columns)), np.float32)
    place[:3] = position - middle[:, None]
    clipped = lobes.clip_rows if lobes.sharpest is not None or len(lobes.clip_rows) > 1 else ()
    # Samples are the first axis: their values for many points are then read once.
    columns = columns[:, None]
    horizons = [lobes.rows[row][:, columns] for row in clipped]
    sums = np.zeros((len(lobes.colors), 3, len(columns)), np.float32)
    step = max(PAIRS // len(columns), 1)
    for is_tail in (True, False):
        exact = is_tail and lobes.limits is not None
        points = _Points(tree, pairs.take(pairs.are_in_tail == is_tail), middle, lobes.sharpest is not None)
        for first in range(0, len(points.squared), step):
            part = slice(first, first + step)
            fan = points.fan(part, place)
            if points.is_crossed[part].any():
                for normal in horizons:
                    fan.flux[fan.heights(normal) <= 0.0] = 0.0
            values = lobes.limits.at_centers(columns, fan, len(sums)) if exact else lobes.at_point(columns, fan)
            for own, value in zip(sums, values, strict=True):
                own += points.colors[:, part] @ value.T
    return sums


def _mean_above_zero(mean, swing):
    """Means (...) of max(0, x) for x uniform between mean - swing and mean + swing."""
    within = np.minimum(np.maximum(mean, -swing), swing)
    within += swing
    within *= within
    within /= np.float32(4.0) * swing
    within += np.maximum(mean - swing, np.float32(0.0))
    return within
