"""`LightCluster`: many plain lights of one color as one emitter; and which lights share their rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..emitters import light_tree
from ..lobes.polygon import convex_pieces, dot
from ..scene import FlatLight, Light, PointLight, PolygonLight, QuadLight, SkyLight
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
        pieces = [(piece, light) for light in lights for piece in _quads_of(light)]
        corners = np.array([piece for piece, _ in pieces])
        owners = [light for _, light in pieces]
        normal = np.array([light.direction for light in owners])
        radiance = np.array([light.radiance for light in owners])
        is_round = np.array([light.is_round for light in owners])
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
        order, start, end, self.children = light_tree.node_ranges(0.5 * (low + high), normal)
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
        self.cone = light_tree.normal_spreads(axis, normal[order], start, end).astype(np.float32)
        self.power = (sums / sums[0]).astype(np.float32)

    def pick(self, x: np.ndarray, lobes: Sequence[LobeBound], lobe_of_ray: np.ndarray):
        """The leaves (R,) that rays take, the probability (R,) of each by lobe, and the numbers x (R,) in [0, 1),
        rescaled for reuse. Ray r chooses by the lobe `own[r]`."""
        node, pmf = np.zeros(len(x), np.intp), np.ones((len(lobes), len(x)), np.float32)
        while True:
            inner = np.flatnonzero(self.leaf[node] < 0)
            if len(inner) == 0:
                return self.leaf[node], pmf, x
            one, other = self.children[node[inner]].T
            bounds = (self._bounds(one, lobes, inner), self._bounds(other, lobes, inner))
            both = bounds[0] + bounds[1]
            share = np.divide(bounds[0], both, out=np.zeros_like(both), where=both > 0.0)
            mine = share[lobe_of_ray[inner], np.arange(len(inner))]
            is_first = x[inner] < mine
            size = np.where(is_first, mine, _ONE - mine)
            rest = (x[inner] - np.where(is_first, _ZERO, mine)) / np.maximum(size, _TINY)
            x[inner] = np.clip(rest, _ZERO, np.float32(1.0 - 2.0**-24))
            pmf[:, inner] *= np.where(both > 0.0, np.where(is_first, share, _ONE - share), _ZERO)
            node[inner] = np.where(is_first, one, other)

    def _bounds(self, node, lobes, rays):
        """By lobe, an approximate upper bound (R,) on the light that the `rays` (R,) get from their nodes."""
        offset = self.center[:, node] + lobes[0].offset[:, rays]
        squares = np.maximum(dot(offset, offset), _TINY)
        distance, radius = np.sqrt(squares), self.radius[node]
        spread = np.where(radius < distance, np.arcsin(np.minimum(radius / distance, _ONE)), np.float32(np.pi))
        spread += _SLACK
        offset /= distance
        light = self.power[node] / np.maximum(squares, radius * radius)
        light *= _cosine_at_most(-dot(offset, self.axis[:, node]), self.cone[node] + spread)
        return np.stack([light * lobe.at_most(offset, spread, rays) for lobe in lobes])


# In rad, the error of angles in single precision.
_SLACK = np.float32(2e-3)


@dataclass(frozen=True)
class LobeBound:
    """What bounds the lobe of each ray: vectors (3, R) and values (R,)."""

    offset: np.ndarray  # m, from the sample to the center of the cluster
    normal: np.ndarray
    mirrored: np.ndarray | None = None  # the mirrored view; specular lobes only
    width: np.ndarray | None = None  # in rad

    def at_most(self, directions, spread, rays):
        """Upper bound (R,) of the lobe within angles `spread` (R,) of `directions` (3, R)."""
        cosine = _cosine_at_most(dot(directions, self.normal[:, rays]), spread)
        if self.mirrored is None:
            return cosine
        toward = np.clip(dot(directions, self.mirrored[:, rays]), -_ONE, _ONE)
        away = np.maximum(np.arccos(toward) - spread, _ZERO)
        squared = np.square(self.width[rays])
        return np.square(squared / (squared + away * away)) * (cosine > 0.0)


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


def _quads_of(light: Light) -> list[np.ndarray]:
    """Convex quadrilaterals (4, 3) that make up a light; triangles repeat their last corner. A round light gives the
    parallelogram around it."""
    if not isinstance(light, PolygonLight):
        u, v = light.half_u, light.half_v
        return [light.center + np.stack([-u - v, u - v, u + v, v - u])]
    if len(light.corners) == 3:
        return [light.corners[[0, 1, 2, 2]]]
    quads = []
    for piece in convex_pieces(light.corners):
        for first in range(1, len(piece) - 1, 2):
            quads.append(piece[[0, first, first + 1, min(first + 2, len(piece) - 1)]])
    return quads


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
            ways = (tracer.mask_of, tracer.surface_mask_of, tracer.chosen_by)
            masks[light.name] = tuple(way(light.name) for way in ways)
        shared.setdefault(_kind(light, number, masks.get(light.name)), []).append(number)
    groups = []
    for kind, numbers in shared.items():
        is_one = kind[0] == "sky" or len(numbers) >= light_tree.FEWEST
        groups.extend([tuple(numbers)] if is_one else [(number,) for number in numbers])
    return tuple(sorted(groups))


def _kind(light, number, masks) -> tuple:
    """A key that is equal for lights that share their rays."""
    if _is_side(light):
        return "sky", light.name
    is_plain = isinstance(light, FlatLight) and not (light.has_profile or light.children)
    brightest = light.radiance.max()
    if not is_plain or light.radiance.min() < 0.0 or brightest == 0.0 or not light.area_vector.any():
        return "one", number
    color = tuple(np.round(light.radiance / brightest, COLOR_DIGITS).tolist())
    return "many", light.group, light.receivers, light.affects_diffuse, light.affects_specular, color, masks


def emitters_of(
    lights: Sequence[Light], tracer=None
) -> tuple[tuple[Emitter | LightCluster, ...], tuple[tuple[int, ...], ...]]:
    """The emitters, and for each the numbers of the `lights` it stands for."""
    numbers, emitters = shared_numbers(lights, tracer), []
    for group in numbers:
        members = [lights[number] for number in group]
        is_sky = _is_side(members[0])
        emitters.append(Sky(members) if is_sky else LightCluster(members) if len(group) > 1 else Emitter(members[0]))
    return tuple(emitters), numbers


def _is_side(light: Light) -> bool:
    """True for a side of the sky, a cube around all samples."""
    if not isinstance(light, SkyLight):
        return False
    axes = np.stack([light.center, light.half_u, light.half_v])
    return bool(np.array_equal(np.abs(axes).sum(axis=0), np.ones(3)) and np.allclose(axes @ axes.T, np.eye(3)))
