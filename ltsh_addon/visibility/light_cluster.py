"""`LightCluster`: many plain lights of one color as one emitter; and which lights share their rays."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..emitters import light_nodes, light_tree
from ..lobes.polygon import STRAIGHT, convex_pieces, dot
from ..scene import FlatLight, Light, PointLight, PolygonLight, QuadLight
from .emitter import Emitter, Sky

_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)


class LightCluster:
    """Many plain lights of one color as one emitter: each ray goes to one light, chosen by what it may give the sample.

    The lights, cut into quadrilaterals, are the leaves of a binary tree. A ray goes down from the root. It takes a half
    of a node with a probability proportional to a bound on the light of that half; the bound covers distance, cosines
    and the lobe, and is 0 only where no light arrives (Conty Estevez and Kulla 2018, "Importance sampling of many
    lights with adaptive tree splitting", doi:10.1145/3233305). `light` stands for all of them: it has their total
    power, and reaches as far as they do.
    """

    def __init__(self, lights: Sequence[Light]):
        corners, owner = _quads_of(lights)
        names = "direction", "radiance", "is_round"
        normal, radiance, is_round = (np.array([getattr(light, name) for light in lights])[owner] for name in names)
        across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        area = 0.5 * np.linalg.norm(across, axis=1) * np.where(is_round, 0.25 * np.pi, 1.0)
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        center, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
        power = (radiance * area[:, None]).sum(axis=0)
        axes, like = radius * np.sqrt(0.5) * np.eye(3), lights[0]
        self.light = QuadLight(
            name=like.name,
            center=center,
            half_u=axes[0],
            half_v=axes[1],
            direction=np.array([0.0, 0.0, -1.0]),
            radiance=power / (2.0 * radius * radius),
            affects_diffuse=like.affects_diffuse,
            affects_specular=like.affects_specular,
            receivers=like.receivers,
        )
        ball = {"half_u": radius * np.eye(3)[0], "half_v": radius * np.eye(3)[1]}
        self.selected_as = (PointLight.like(self.light, radiance=power / (4.0 * np.pi * radius**2), **ball),)
        corners = corners - center
        values = radiance.mean(axis=1)
        self.brightness = (values / max(self.light.radiance.mean(), 1e-30)).astype(np.float32)
        self.corners = np.ascontiguousarray(corners.transpose(2, 1, 0), dtype=np.float32)
        self.normal = np.ascontiguousarray(normal.T, dtype=np.float32)
        self.is_round = is_round if is_round.any() else None
        self.has_mesh = any(isinstance(light, PolygonLight) for light in lights)
        self._build(corners, normal, values * area)

    def _build(self, corners, normal, power):
        """Set the arrays of the nodes, with the root first."""
        low, high = corners.min(axis=1), corners.max(axis=1)
        order, start, end, self.children = light_nodes.node_ranges(0.5 * (low + high), normal)
        alone = end - start == 1
        first = order[start]
        self.leaf = np.where(alone, first, -1)
        low, high, sums, vector = low[first], high[first], power[first], power[first, None] * normal[first]
        for begin, last in reversed(_levels(self.children)):
            inner = begin + np.flatnonzero(self.children[begin:last, 0] >= 0)
            one, other = self.children[inner].T
            low[inner], high[inner] = np.minimum(low[one], low[other]), np.maximum(high[one], high[other])
            sums[inner], vector[inner] = sums[one] + sums[other], vector[one] + vector[other]
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        axis = np.where(length > 1e-9 * sums[:, None], vector / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
        self.center = np.ascontiguousarray(0.5 * (low + high).T, dtype=np.float32)
        self.radius = (0.5 * np.linalg.norm(high - low, axis=1)).astype(np.float32)
        self.axis = np.ascontiguousarray(axis.T, dtype=np.float32)
        self.cone = light_nodes.normal_spreads(axis, normal[order], start, end).astype(np.float32)
        self.power = (sums / sums[0]).astype(np.float32)
        self.order, self.start, self.end = order, start, end
        self.running = np.append(0.0, np.cumsum(power[order]))
        self.cut = self._cut()

    def _cut(self):
        """Numbers (K,) of the at most CUT nodes that make up the cluster, with few turns and short ways in each."""
        size = np.where(self.leaf < 0, self.power * (self.radius / self.radius[0] + self.cone), _ZERO)
        nodes = [(-float(size[0]), 0)]
        while len(nodes) < CUT and nodes[0][0] < 0.0:
            halves = self.children[heapq.heappop(nodes)[1]].tolist()
            for half in halves:
                heapq.heappush(nodes, (-float(size[half]), half))
        return np.array(sorted(node for _, node in nodes))

    def pick(self, x: np.ndarray, lobes: "Sequence[LobeBound]", lobe_of_row: np.ndarray):
        """The leaves (S, Q) to which S rays from each of Q samples go, the probabilities (L, S, Q) of these by lobe,
        and the numbers x (S, Q) in [0, 1), rescaled for reuse. Row r of the rays chooses by lobe `lobe_of_row[r]`."""
        shape, sample, count = x.shape, np.tile(np.arange(x.shape[1]), len(x)), len(self.cut)
        x, lobe_of_ray, rays = x.ravel(), np.repeat(lobe_of_row, x.shape[1]), np.arange(x.size)
        bounds = self._bounds((None, self.cut), lobes, (slice(None), None))
        ends = np.cumsum(bounds, axis=2)
        whole = np.maximum(ends[:, :, -1:], _TINY)
        ends, bounds = ends / whole, bounds / whole
        place = np.empty(x.size, np.intp)
        for number in np.unique(lobe_of_row):
            mine = np.flatnonzero(lobe_of_ray == number)
            steps = (ends[number] + np.arange(shape[1])[:, None]).ravel()
            place[mine] = np.searchsorted(steps, x[mine] + sample[mine].astype(float), side="right")
        place = np.clip(place, sample * count, sample * count + (count - 1))
        bounds, ends = bounds.reshape(len(lobes), -1), ends.reshape(len(lobes), -1)
        pmf, node = bounds[:, place], self.cut[place - sample * count]
        mine = pmf[lobe_of_ray, rays]
        x = _rescaled(x - (ends[lobe_of_ray, place] - mine), mine)
        offset = self.center[:, node] + lobes[0].offset[:, sample]
        distance = np.sqrt(np.maximum(dot(offset, offset), _TINY))
        limit = FAR * distance * np.minimum.reduce([lobe.lengths(offset / distance, sample) for lobe in lobes])
        rays = np.flatnonzero((self.cone[node] > NARROW) | (self.radius[node] > limit))
        while len(rays):
            rays = rays[self.leaf[node[rays]] < 0]
            halves, columns = self.children[node[rays]], sample[rays]
            bounds = np.stack([self._bounds((half,), lobes, (columns,)) for half in halves.T])
            both = bounds.sum(axis=0)
            share = np.divide(bounds[0], both, out=np.zeros_like(both), where=both > 0.0)
            mine = share[lobe_of_ray[rays], np.arange(len(rays))]
            is_first = x[rays] < mine
            x[rays] = _rescaled(x[rays] - np.where(is_first, _ZERO, mine), np.where(is_first, mine, _ONE - mine))
            pmf[:, rays] *= np.where(both > 0.0, np.where(is_first, share, _ONE - share), _ZERO)
            node[rays] = np.where(is_first, *halves.T)
        # Within a node, leaves are chosen by their power alone.
        start, end = self.start[node], self.end[node]
        whole = self.running[end] - self.running[start]
        target = self.running[start] + x * whole
        leaf = np.clip(np.searchsorted(self.running, target, side="right") - 1, start, end - 1)
        size = self.running[leaf + 1] - self.running[leaf]
        x = _rescaled((target - self.running[leaf]).astype(np.float32), size.astype(np.float32))
        pmf *= (size / np.maximum(whole, 1e-300)).astype(np.float32)
        return self.order[leaf].reshape(shape), pmf.reshape(len(lobes), *shape), x.reshape(shape)

    def _bounds(self, nodes, lobes, samples):
        """By lobe (L, ...), an approximate upper bound on the light that `samples` get from `nodes`, two indices."""
        offset = self.center[:, *nodes] + lobes[0].offset[:, *samples]
        squares = np.maximum(dot(offset, offset), _TINY)
        distance, radius = np.sqrt(squares), self.radius[nodes]
        spread = np.where(radius < distance, np.arcsin(np.minimum(radius / distance, _ONE)), np.float32(np.pi))
        spread += _SLACK
        offset /= distance
        light = self.power[nodes] / np.maximum(squares, radius * radius)
        light *= _cosine_at_most(-dot(offset, self.axis[:, *nodes]), self.cone[nodes] + spread)
        return np.stack([light * lobe.at_most(offset, spread, samples) for lobe in lobes])


def _rescaled(x, size):
    """Numbers x (R,) in [0, size), as numbers in [0, 1)."""
    return np.clip(x / np.maximum(size, _TINY), _ZERO, np.float32(1.0 - 2.0**-24))


# CUT: nodes that all samples bound. In these nodes, rays choose leaves by power alone, if the lights turn by less than
# NARROW rad and the radius of the node is below FAR of the distance, and of the angle over which the lobe changes.
CUT, NARROW, FAR = 128, np.float32(0.7), np.float32(0.3)
# In rad, the error of angles in single precision.
_SLACK = np.float32(2e-3)


@dataclass(frozen=True)
class LobeBound:
    """What bounds the lobe of each sample: vectors (3, Q) and values (Q,)."""

    offset: np.ndarray  # m, from the sample to the center of the cluster
    normal: np.ndarray
    mirrored: np.ndarray | None = None  # the mirrored view; specular lobes only
    width: np.ndarray | None = None  # in rad

    def at_most(self, directions, spread, samples):
        """Upper bound (...) of the lobes of the `samples`, an index, within angles `spread` (...) of `directions`
        (3, ...)."""
        cosine = _cosine_at_most(dot(directions, self.normal[:, *samples]), spread)
        if self.mirrored is None:
            return cosine
        toward = np.clip(dot(directions, self.mirrored[:, *samples]), -_ONE, _ONE)
        away = np.maximum(np.arccos(toward) - spread, _ZERO)
        squared = np.square(self.width[samples])
        return np.square(squared / (squared + away * away)) * (cosine > 0.0)

    def lengths(self, directions, samples):
        """The angles (R,) in rad, at most 1, over which the lobes of `samples` (R,) change at `directions` (3, R)."""
        if self.mirrored is None:
            return np.ones(len(samples), np.float32)
        toward = np.clip(dot(directions, self.mirrored[:, samples]), -_ONE, _ONE)
        return np.minimum(self.width[samples] + np.arccos(toward), _ONE)


def _cosine_at_most(cosine, spread):
    """Upper bound (R,), not below 0, on the cosines of angles within `spread` (R,) of arccos `cosine` (R,)."""
    angle = np.maximum(np.arccos(np.clip(cosine, -_ONE, _ONE)) - spread, _ZERO)
    return np.where(angle < np.float32(0.5 * np.pi), np.maximum(np.cos(angle), _ZERO), _ZERO)


def _levels(children):
    """First number and end of the nodes of each level."""
    levels = [(0, 1)]
    while True:
        first, last = levels[-1]
        more = 2 * int(np.count_nonzero(children[first:last, 0] >= 0))
        if more == 0:
            return levels
        levels.append((last, last + more))


def _quads_of(lights: Sequence[Light]) -> tuple[np.ndarray, np.ndarray]:
    """Convex quadrilaterals (N, 4, 3) that make up the lights, and the number (N,) of the light of each; triangles
    repeat their last corner. A round light gives the parallelogram around it."""
    quads, owner = [], []
    counts = np.array([len(light.corners) if isinstance(light, PolygonLight) else 0 for light in lights])
    for count in np.unique(counts):
        numbers = np.flatnonzero(counts == count)
        if count == 0:
            center, u, v = (
                np.array([getattr(lights[number], name) for number in numbers])
                for name in ("center", "half_u", "half_v")
            )
            corners = center[:, None] + np.stack([-u - v, u - v, u + v, v - u], axis=1)
        else:
            corners = np.array([lights[number].corners for number in numbers])
        if count == 3:
            corners = corners[:, [0, 1, 2, 2]]
        elif count > 3:
            edges = np.roll(corners, -1, axis=1) - corners
            normals = np.array([lights[number].direction for number in numbers])
            turns = (np.cross(edges, np.roll(edges, -1, axis=1)) * normals[:, None]).sum(axis=2)
            least = STRAIGHT * np.square(edges).sum(axis=2).max(axis=1, keepdims=True)
            others = ~((turns > least).all(axis=1) | (turns < -least).all(axis=1)) | (count > 4)
            for number, outline in zip(numbers[others], corners[others], strict=True):
                for piece in convex_pieces(outline):
                    starts = range(1, len(piece) - 1, 2)
                    fan = [piece[[0, first, first + 1, min(first + 2, len(piece) - 1)]] for first in starts]
                    quads.append(np.array(fan))
                    owner.append(np.full(len(fan), number))
            numbers, corners = numbers[~others], corners[~others]
        quads.append(corners[:, :4])
        owner.append(numbers)
    quads, owner = np.concatenate(quads), np.concatenate(owner)
    order = np.argsort(owner, kind="stable")
    return quads[order], owner[order]


# Decimals of a color, as a share of its largest channel, that must agree for lights to count as one: their colors
# differ by at most 0.05 %.
COLOR_DIGITS = 3


def shared_numbers(lights: Sequence[Light], tracer=None) -> tuple[tuple[int, ...], ...]:
    """Which of the `lights` share their rays, and so the share of them that is visible, as tuples of numbers.

    The sides of a sky do. So do plain lights that have the same color, group and pass and are blocked by the same
    things, if there are at least `light_tree.FEWEST` of them. Without a tracer, all lights count as blocked by the same
    things.
    """
    shared: dict[tuple, list[int]] = {}
    masks: dict[str, tuple] = {}
    for number, light in enumerate(lights):
        if tracer is not None and light.name not in masks:
            ways = (tracer.occluders.mask_of, tracer.occluders.surface_mask_of, tracer.occluders.chosen_by)
            masks[light.name] = tuple(way(light.name) for way in ways)
        shared.setdefault(sharing_key(light, number, masks.get(light.name)), []).append(number)
    groups = []
    for kind, numbers in shared.items():
        is_one = kind[0] == "sky" or len(numbers) >= light_tree.FEWEST
        groups.extend([tuple(numbers)] if is_one else [(number,) for number in numbers])
    return tuple(sorted(groups))


def sharing_key(light: Light, number: int, masks: tuple | None = None) -> tuple:
    """A key that is equal for lights that share their rays if they are many; `masks`: of their shadow linking."""
    if light.is_side:
        return "sky", light.name
    is_plain = isinstance(light, FlatLight) and not (light.has_profile or light.children)
    radiance = light.radiance.tolist()
    brightest = max(radiance)
    if not is_plain or min(radiance) < 0.0 or brightest == 0.0 or not any(light.area_vector.tolist()):
        return "one", number
    color = tuple(round(value / brightest, COLOR_DIGITS) for value in radiance)
    return "many", light.group, light.receivers, light.affects_diffuse, light.affects_specular, color, masks


def emitters_of(
    lights: Sequence[Light], tracer=None
) -> tuple[tuple[Emitter | LightCluster, ...], tuple[tuple[int, ...], ...]]:
    """The emitters, and for each the numbers of the `lights` it stands for."""
    numbers, emitters = shared_numbers(lights, tracer), []
    for group in numbers:
        members = [lights[number] for number in group]
        kind = LightCluster if len(group) > 1 else Emitter
        emitters.append(Sky(members) if members[0].is_side else kind(members if kind is LightCluster else members[0]))
    return tuple(emitters), numbers
