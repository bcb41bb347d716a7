"""How likely Cycles chooses a light for a point: the probabilities of its light tree (Conty Estevez and Kulla 2018,
"Importance Sampling of Many Lights with Adaptive Tree Splitting", doi:10.1145/3233305).

These do not change what a render converges to, except for directions between two horizons: `horizons` decides by them
where lobes end, and `visibility.estimator` how much of the light a shadow ray along such a direction stands for.
Bumped and coarse smooth meshes under several lights need them. With the bounds of each light alone, as if all lights
were one leaf, specular light on three of four such spheres, under 4 or 14 lights, is 1.6 to 2.6 % off (relative L2) and
up to 0.5 % in the mean; on the fourth it is 0.05 % off, and on the example scene 0.01 %.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np

from ..emitters.facing import cone_angle
from ..scene import Light

# MOST_LIGHTS_OF_LEAF: as in Cycles. BUCKETS: along each axis Cycles tries to cut a node between these.
MOST_LIGHTS_OF_LEAF = 8
BUCKETS = 12
# If there are more lights, all count as one leaf: none of them matters much.
MOST_LIGHTS = 64
# Pairs of points and lights in one chunk.
PAIRS = 2**14


@dataclass(frozen=True)
class LightTreeNode:
    """A node of the light tree: lights in a box. Their directions are within the angle `spread` of `axis`, and each
    shines as far as the angle `reach` from its own direction."""

    lights: tuple[int, ...]
    low: np.ndarray  # (3,) m
    high: np.ndarray  # (3,) m
    axis: np.ndarray  # (3,) unit
    spread: float  # rad
    reach: float  # rad
    power: float
    halves: "tuple[LightTreeNode, LightTreeNode] | None" = None

    def joined(self, other: "LightTreeNode") -> "LightTreeNode":
        """Both nodes as one."""
        wide, narrow = (other, self) if other.spread > self.spread else (self, other)
        cosine = float(np.clip(wide.axis @ narrow.axis, -1.0, 1.0))
        apart, axis, spread = np.arccos(cosine), wide.axis, wide.spread
        if wide.spread + 5e-4 < min(np.pi, apart + narrow.spread):
            spread = min(0.5 * (apart + wide.spread + narrow.spread), np.pi)
            across = narrow.axis - cosine * axis
            length = np.linalg.norm(across)
            if spread < np.pi and length > 1e-6:
                turn = spread - wide.spread
                axis = np.cos(turn) * axis + np.sin(turn) * across / length
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        lights, reach = self.lights + other.lights, max(self.reach, other.reach)
        return LightTreeNode(lights, low, high, axis, spread, reach, self.power + other.power)

    def cost(self) -> float:
        """Power, times the area of the box, times the measure of directions (eq. 2)."""
        x, y, z = self.high - self.low
        area = 2.0 * (x * y + y * z + z * x)
        far = min(np.pi, self.spread + self.reach)
        sine, cosine = np.sin(self.spread), np.cos(self.spread)
        fringe = 2.0 * far * sine - np.cos(self.spread - 2.0 * far) - 2.0 * self.spread * sine + cosine
        directions = 2.0 * np.pi * (1.0 - cosine) + 0.5 * np.pi * fringe
        return self.power * (area if area > 0.0 else np.linalg.norm(self.high - self.low)) * directions

    def bounds(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Upper and lower bound (2, P) on what points (P, 3) with normals get from lights in the box."""
        center, radius = 0.5 * (self.low + self.high), 0.5 * np.linalg.norm(self.high - self.low)
        offset = center - position
        distance = np.linalg.norm(offset, axis=1)
        ratio = np.minimum(radius / np.maximum(distance, 1e-30), 1.0)
        width = np.where(ratio < 1.0, np.sqrt(1.0 - ratio**2), -1.0)
        is_above = (normal * offset).sum(axis=1) + np.abs(normal) @ (0.5 * (self.high - self.low)) > 0.0
        distance = np.maximum(distance, 0.5 * radius)
        return _bounds(self, offset, normal, width, distance, distance) * is_above


def _bounds(node, offset, normal, width, near, far):
    """Bounds (2, P) for a node that lies within a cone around the offset; `width` (P,) is the cosine of its angle."""
    axis = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-30)[:, None]
    here, there = (axis * normal).sum(axis=1), -(axis @ node.axis)
    most_here = np.where(here >= width, 1.0, _cosine_of_sum(here, width, -1.0))
    least_here = np.maximum(_cosine_of_sum(here, width, 1.0), 0.0)
    closest = np.where(there >= width, 1.0, _cosine_of_sum(there, width, -1.0))
    is_inside = closest >= np.cos(node.spread)
    most_there = np.where(is_inside, 1.0, _cosine_of_sum(closest, np.cos(node.spread), -1.0))
    end = node.spread + node.reach
    is_seen = (most_here >= 0.0) & (is_inside | (end > np.pi) | (closest > np.cos(end)))
    farthest = _cosine_of_sum(there, width, 1.0)
    rest = node.reach - node.spread
    is_whole = is_seen & (rest >= 0.0) & (there >= 0.0) & (width >= 0.0) & (farthest >= np.cos(rest))
    least_there = _cosine_of_sum(farthest, np.cos(node.spread), 1.0)
    most = node.power * np.abs(most_here * most_there) / np.maximum(near, 1e-30) ** 2
    least = node.power * np.abs(least_here * least_there) / np.maximum(far, 1e-30) ** 2
    return np.stack([np.where(is_seen, most, 0.0), np.where(is_whole, least, 0.0)])


def _cosine_of_sum(first, second, sign):
    """Cosine of the sum of two angles in [0, pi], or of their difference for `sign` -1, from their cosines."""
    return first * second - sign * np.sqrt(np.maximum(1.0 - first**2, 0.0) * np.maximum(1.0 - second**2, 0.0))


def light_selection_pmf(
    position: np.ndarray, normal: np.ndarray, lights: tuple[Light, ...], rows: np.ndarray | None = None
) -> np.ndarray:
    """Probability (L, P) with which each light is chosen for points (P, 3) with smooth normals. Down to the leaves, the
    halves of a node are chosen by their upper bounds half of the time, and by their lower bounds the other half.
    `rows` are the `light_tree_rows` of the lights."""
    rows = light_tree_rows(lights) if rows is None else rows
    bounds = light_bounds_at(position, normal, lights, rows)
    if len(lights) > MOST_LIGHTS:
        return selection_pmf(bounds)
    distant = np.array([light.is_distant for light in lights], dtype=bool)
    if distant.all():
        return selection_pmf(bounds)
    if distant.any():
        # The distant lights and the tree of the others are the two halves of the whole.
        near, pmf = np.flatnonzero(~distant), np.zeros((len(lights), len(position)))
        shares = selection_pmf(np.stack([bounds[near].sum(axis=0), bounds[distant].sum(axis=0)]))
        pmf[near] = shares[0] * light_selection_pmf(
            position, normal, tuple(lights[number] for number in near), rows[near]
        )
        pmf[distant] = shares[1] * selection_pmf(bounds[distant])
        return pmf
    pmf = np.zeros((len(lights), len(position)))
    nodes = [(_tree(rows.tobytes(), len(lights)), np.ones(len(position)))]
    while nodes:
        node, probability = nodes.pop()
        if node.halves is None:
            pmf[list(node.lights)] = probability * selection_pmf(bounds[list(node.lights)])
            continue
        halves = node.halves
        half_bounds = [
            bounds[half.lights[0]] if len(half.lights) == 1 else half.bounds(position, normal) for half in halves
        ]
        nodes.extend(
            (half, probability * share)
            for half, share in zip(halves, selection_pmf(np.stack(half_bounds)), strict=True)
        )
    return pmf


def selection_pmf(bounds: np.ndarray) -> np.ndarray:
    """Probabilities (N, P) of alternatives, given upper and lower bounds (N, 2, P) on their light."""
    most, least = bounds[:, 0], bounds[:, 1]
    # If all lower bounds are 0, all alternatives with an upper bound above 0 are equally likely.
    least = np.where(least.sum(axis=0) > 0.0, least, most > 0.0)
    return sum(0.5 * bound / np.maximum(bound.sum(axis=0), 1e-30) for bound in (most, least))


def light_bounds_at(
    position: np.ndarray, normal: np.ndarray, lights: tuple[Light, ...], rows: np.ndarray
) -> np.ndarray:
    """Upper and lower bound (L, 2, P) on what points (P, 3) with normals get from each light. A flat light counts as
    its rectangle. In single precision if there are more than MOST_LIGHTS."""
    kind = np.float32 if len(lights) > MOST_LIGHTS else np.float64
    bounds = np.empty((len(lights), 2, len(position)), kind)
    distant, facing = (np.array([getattr(light, name) for light in lights]) for name in ("is_distant", "is_facing"))
    for number in np.flatnonzero(facing):
        bounds[number] = _facing_bounds(lights[number], position, normal)
    # Subtract large coordinates in double precision.
    middle = position.mean(axis=0) if len(position) else np.zeros(3)
    step = max(PAIRS // max(len(position), 1), 1)
    for flat, points, origin in ((~distant, position - middle, middle), (distant, 0.0 * position, 0.0)):
        numbers = np.flatnonzero(flat & ~facing)
        for start in range(0, len(numbers), step):
            chunk = numbers[start : start + step]
            shifted = np.concatenate([rows[chunk, :3] - origin, rows[chunk, 3:]], axis=1)
            bounds[chunk] = _flat_bounds(shifted.astype(kind), points.astype(kind).T, normal.astype(kind).T)
    return bounds


def _flat_bounds(rows, position, normal):
    """As `light_bounds_at`, (N, 2, P), for flat lights given by `light_tree_rows` (N, 16) and points (3, P) with
    normals."""
    center, half_u, half_v, direction = (rows[:, start : start + 3].T[..., None] for start in (0, 3, 6, 9))
    reach, power = np.maximum(np.cos(rows[:, 12, None]), 0.0), rows[:, 13, None]
    x, y, z = center - position[:, None]

    def along(vectors):
        return x * vectors[0] + y * vectors[1] + z * vectors[2]

    square, u, v = x * x + y * y + z * z, along(half_u), along(half_v)
    shorten = 1.0 / np.maximum(np.sqrt(square), 1e-30)
    here, there = along(normal) * shorten, -along(direction) * shorten
    farthest, width = square, np.ones_like(square)
    for of_u, of_v in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        offset = of_u * u + of_v * v
        corner = ((of_u * half_u + of_v * half_v) ** 2).sum(axis=0)
        length = np.maximum(square + 2.0 * offset + corner, 1e-30)
        farthest = np.maximum(farthest, length)
        width = np.minimum(width, (square + offset) * shorten / np.sqrt(length))
    width = np.maximum(width, -1.0)
    most_here = np.where(here >= width, 1.0, _cosine_of_sum(here, width, -1.0))
    least_here = np.maximum(_cosine_of_sum(here, width, 1.0), 0.0)
    most_there = np.where(there >= width, 1.0, _cosine_of_sum(there, width, -1.0))
    least_there = _cosine_of_sum(there, width, 1.0)
    is_seen = (there > 0.0) & (most_here >= 0.0) & (most_there >= reach)
    is_whole = is_seen & (width >= 0.0) & (least_there >= reach)
    most = is_seen * power * most_here * most_there * shorten**2
    least = is_whole * power * least_here * least_there / farthest
    return np.stack([most, least], axis=1)


def _facing_bounds(light, position, normal):
    """As `light_bounds_at`, (2, P), for one point or spot light."""
    offset = light.center - position
    distance = np.linalg.norm(offset, axis=1)
    axis = offset / np.maximum(distance, 1e-30)[:, None]
    if light.is_sphere:
        ratio = np.minimum(light.radius / np.maximum(distance, 1e-30), 1.0)
        width = np.where(ratio < 1.0, np.sqrt(1.0 - ratio**2), -1.0)
    else:
        width = distance / np.maximum(np.hypot(distance, light.radius), 1e-30)
    inside = width < 0.0
    near = np.where(inside, light.radius / np.sqrt(2.0), distance)
    far = np.where(inside, near, distance / np.maximum(width, 1e-30))
    node = _leaf(np.array(_row(light)), 0)
    if light.cone is None:
        here = (axis * normal).sum(axis=1)
        most = np.where(here >= width, 1.0, np.maximum(_cosine_of_sum(here, width, -1.0), 0.0))
        least = np.maximum(_cosine_of_sum(here, width, 1.0), 0.0) * np.maximum(width, 0.0)
        return node.power * np.stack([most / np.maximum(near, 1e-30) ** 2, least / np.maximum(far, 1e-30) ** 2])
    between = np.arccos(np.clip(-(axis @ node.axis), -1.0, 1.0)) - np.arccos(np.clip(width, -1.0, 1.0))
    share = np.clip((np.cos(np.maximum(between, 0.0)) - np.cos(node.reach)) * light.cone.sharpness, 0.0, 1.0)
    return _bounds(node, axis, normal, width, near, far) * (share * share * (3.0 - 2.0 * share))


def light_tree_rows(lights: tuple[Light, ...]) -> np.ndarray:
    """What the tree needs to know of each light, (L, 16)."""
    return np.array([_row(light) for light in lights])


def _row(light) -> list[float]:
    power = np.abs(light.radiance).mean() * np.linalg.norm(light.area_vector)
    reach = 0.5 * light.spread if light.cone is None else min(cone_angle(light.cone), 0.5 * np.pi)
    spread = np.pi if light.is_facing and light.cone is None else 0.0
    size = light.radius if light.is_facing else 0.0
    return [*light.center, *light.half_u, *light.half_v, *light.direction, reach, power, spread, size]


def _leaf(row, number: int) -> LightTreeNode:
    center, half_u, half_v, direction = row[:12].reshape(4, 3)
    reach = np.abs(half_u) + np.abs(half_v)
    reach = np.maximum(reach, row[15])
    return LightTreeNode((number,), center - reach, center + reach, direction, row[14], row[12], row[13])


@lru_cache(maxsize=4)
def _tree(rows: bytes, count: int) -> LightTreeNode:
    """The tree of `count` lights, given the bytes of their `light_tree_rows`."""
    rows = np.frombuffer(rows).reshape(count, -1)
    return _grown([_leaf(row, number) for number, row in enumerate(rows)], rows[:, :3])


def _all(nodes) -> LightTreeNode:
    """All nodes as one. Those without power do not widen it."""
    lights = tuple(number for node in nodes for number in node.lights)
    return replace(reduce(LightTreeNode.joined, [node for node in nodes if node.power] or nodes[:1]), lights=lights)


def _grown(nodes: list[LightTreeNode], centers: np.ndarray) -> LightTreeNode:
    """The tree over `nodes` of one light each, cut where it costs least; `centers` (L, 3) are those of all lights."""
    whole = _all(nodes)
    if len(nodes) < 2:
        return whole
    places = centers[[node.lights[0] for node in nodes]]
    extent = places.max(axis=0) - places.min(axis=0)
    least, cut = whole.cost(), None
    for axis in np.flatnonzero(extent > 0.0):
        along = (places[:, axis] - places[:, axis].min()) / extent[axis]
        bucket = np.clip((BUCKETS * along).astype(int), 0, BUCKETS - 1)
        for end in range(1, BUCKETS):
            parts = [[c for c, b in zip(nodes, bucket, strict=True) if (b < end) == first] for first in (True, False)]
            if all(parts):
                cost = extent.max() / extent[axis] * sum(_all(side).cost() for side in parts)
                least, cut = (cost, (axis, len(parts[0]))) if cost < least else (least, cut)
    if cut is None and len(nodes) <= MOST_LIGHTS_OF_LEAF:
        return whole
    order, middle = np.arange(len(nodes)), len(nodes) // 2
    if cut is not None:
        order, middle = np.argsort(places[:, cut[0]], kind="stable"), cut[1]
    halves = [[nodes[number] for number in side] for side in (order[:middle], order[middle:])]
    return replace(whole, halves=tuple(_grown(half, centers) for half in halves))
