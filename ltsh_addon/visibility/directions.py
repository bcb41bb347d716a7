"""Directions from surface points to a light, few and well spread, and how bright each is for the lobes of the point.

A light is a quadrilateral; what a round, polygonal or textured one leaves dark of it has the weight 0. Half of the
directions are spread evenly over the solid angle of the light, as diffuse lobes need them. The other half are spread
evenly over the light after the warp that flattens the peak of GGX (`shading.lookup_table`), as specular lobes need
them: none misses the light, however sharp the lobe. The balance heuristic (Veach and Guibas 1995) joins both.

The sides of a sky, which surround all samples, are one light: half of the directions that are not by the specular lobe
are by its picture, half by the cosine. Many plain lights of one color are one light too (`Cluster`).

All is in single precision, arrays are (S, Q): S directions from each of Q points, or (Q,). Vectors are lists of three.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..cycles.horizons import SMALLEST_ALPHA, lobe_chances
from ..cycles.light_tree import light_chances, light_rows
from ..scene import AreaLight, SurfaceSamples
from ..shading import brdf, light_cone, light_tree
from ..shading.lookup_table import WARP_REGULARIZATION
from ..shading.polygon import convex_pieces

# Bits of a point of the sequence: what fits into single precision.
BITS = 23
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# In sr: what is smaller is not seen.
_LEAST_SOLID_ANGLE = np.float32(1e-20)
# Of a sequence
MOST_POINTS = 1024
# Cells along each side of the picture of a light with a texture.
_PICTURE = 128
# Cells along each side of a side of the sky; and how far from a sample the light is that stands for the sky, a plane,
# by half its side.
CELLS, NEXT_TO = 64, 1e-3
# Of the color of lights that are taken together, by its largest channel: 0.05 % of what they give may have another.
COLOR_DIGITS = 3
# Corners of an ellipse to aim at
_ROUND_CORNERS = 16


def sequence(count: int, seed: int = 1) -> np.ndarray:
    """The first `count` points (2, count) of the Sobol sequence, uint32 of 23 bits, scrambled as by Owen (1995).

    Every 2^k points, counted from the first, are stratified as well as can be. XOR with any number keeps that.
    """
    number = np.arange(count, dtype=np.uint32)
    points = np.zeros((2, count), np.uint32)
    direction = np.uint32(1) << np.uint32(31)
    for bit in range(32):
        is_set = (number >> np.uint32(bit)) & np.uint32(1)
        points[0] ^= is_set << np.uint32(31 - bit)
        points[1] ^= is_set * direction
        direction ^= direction >> np.uint32(1)
    scrambled = [_nested_scramble(row, 2 * seed + axis) for axis, row in enumerate(points)]
    return np.stack(scrambled) >> np.uint32(32 - BITS)


def _nested_scramble(values, seed):
    """Laine and Karras 2011, "Stratified sampling for stochastic transparency", with the constants of Vegdahl."""
    values = _reversed_bits(values) + np.uint32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        values = values ^ (values * np.uint32(factor))
    return _reversed_bits(values)


def _reversed_bits(values):
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        low, step = np.uint32(mask), np.uint32(shift)
        values = ((values >> step) & low) | ((values & low) << step)
    return values


_POINTS = [sequence(MOST_POINTS, seed) for seed in (1, 2)]


def unit_points(seeds: np.ndarray, stream: int, first: int, last: int) -> list[np.ndarray]:
    """Numbers x, y (S, Q) in (0, 1): points `first` to `last` of the sequence `stream`, 0 or 1, changed by the seeds
    (Q,)."""
    found = []
    for axis, points in enumerate(_POINTS[stream][:, first:last]):
        own = mixed_bits(seeds + np.uint32((2 * stream + axis) * 0x9E3779B1 & 0xFFFFFFFF)) >> np.uint32(32 - BITS)
        numbers = (points[:, None] ^ own).astype(np.float32)
        numbers += np.float32(0.5)
        numbers *= np.float32(2.0**-BITS)
        found.append(numbers)
    return found


def seeds_of(position: np.ndarray) -> np.ndarray:
    """Seeds (P,) uint32 of points (P, 3): the same wherever a point stands in a picture or a block."""
    bits = np.ascontiguousarray(position, dtype=np.float32).view(np.uint32)
    return mixed_bits(mixed_bits(mixed_bits(bits[:, 0]) ^ bits[:, 1]) ^ bits[:, 2])


def mixed_bits(values):
    """A hash of uint32 (Wellons 2018, "lowbias32")."""
    values = (values ^ (values >> np.uint32(16))) * np.uint32(0x7FEB352D)
    values = (values ^ (values >> np.uint32(15))) * np.uint32(0x846CA68B)
    return values ^ (values >> np.uint32(16))


class Emitter:
    """What directions need of a light, the same for all points: a quadrilateral, and how bright the light is in it.

    It is the light itself where that is a rectangle without a texture, a triangle or a convex quadrilateral; else
    center + s axes[0] + t axes[1], |s|, |t| <= 1, around it.
    """

    def __init__(self, light: AreaLight):
        self.light, self.chosen_as = light, (light,)
        self.outline = light.polygon(_ROUND_CORNERS) - light.center
        self.profile = light_cone.Profile.of(light) if light.is_profiled else None
        self.corners = self._own_corners()
        self.center, self.axes = _parallelogram(light) if self.corners is None else (None, None)
        self._picture = self._edge = None
        if self.corners is None and light.detail:
            self._picture = picture_of(light, self._places)
        elif self.corners is None and light.shape == "POLYGON":
            self._edge = self._places(light.corners - light.center).astype(np.float32)

    def _own_corners(self) -> np.ndarray | None:
        """Corners (4, 3) of a polygon that has no more, from the center of the light; a triangle repeats the last."""
        if self.light.shape != "POLYGON" or self.light.detail:
            return None
        pieces = convex_pieces(self.outline)
        return pieces[0][[0, 1, 2, -1]] if len(pieces) == 1 and len(pieces[0]) <= 4 else None

    def _places(self, offset: np.ndarray) -> np.ndarray:
        """Numbers s, t (..., 2) of points of the light's plane, (..., 3) from its center."""
        return (offset - self.center) @ np.linalg.pinv(self.axes)

    def corners_from(self, offset: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Corners (3, 4, Q) of the quadrilateral from points with the center of the light at offset (3, Q), at height
        (Q,) over its plane."""
        if self.corners is not None:
            return offset[:, None] + self.corners.T.astype(np.float32)[:, :, None]
        u, v = self.axes.astype(np.float32)[:, :, None]
        middle = offset + self.center.astype(np.float32)[:, None]
        (low_s, high_s), (low_t, high_t) = self._ranges(middle, height)
        ends = ((low_s, low_t), (high_s, low_t), (high_s, high_t), (low_s, high_t))
        return np.stack([middle + s * u + t * v for s, t in ends], axis=1)

    def _ranges(self, middle, height):
        """From where to where along both axes the quadrilateral reaches: as far as the cone of a spread."""
        squares = (self.axes * self.axes).sum(axis=1)
        if not self.light.is_focused or abs(self.axes[0] @ self.axes[1]) > 1e-6 * squares.max():
            return ((-_ONE, _ONE), (-_ONE, _ONE))
        ranges = []
        for axis, squared in zip(self.axes, squares, strict=True):
            foot = -dot(middle, (axis / max(squared, 1e-30)).astype(np.float32))
            reach = np.float32(self.profile.tangent / max(np.sqrt(squared), 1e-15)) * height
            ranges.append((np.clip(foot - reach, -_ONE, _ONE), np.clip(foot + reach, -_ONE, _ONE)))
        return ranges

    def brightness(self, towards: np.ndarray, distance: np.ndarray, offset: np.ndarray, height: np.ndarray):
        """Factors (S, Q) of the mean radiance along directions (3, S, Q) that meet the light's plane at `distance`
        (S, Q), the others as for `corners_from`; None: all 1."""
        factor = None
        if self.profile is not None:
            radius = np.sqrt(np.maximum(distance * distance - height * height, _ZERO))
            factor = self.profile.at(radius, np.maximum(height, _TINY)).astype(np.float32)
        if self._picture is None and self._edge is None and not self.light.is_round:
            return factor
        along = np.linalg.pinv(self.axes).T.astype(np.float32)
        start = offset + self.center.astype(np.float32)[:, None]
        s, t = (dot(towards, axis) * distance - dot(start, axis) for axis in along)
        if self._picture is not None:
            own = self._picture[_cells(t), _cells(s)]
        else:
            own = _inside(self._edge, s, t) if self._edge is not None else s * s + t * t <= _ONE
        return own if factor is None else factor * own


def _parallelogram(light: AreaLight):
    """Center, seen from that of the light, and half axes (2, 3) of a parallelogram around it: of a polygon the smallest
    rectangle along an edge."""
    if light.shape != "POLYGON":
        return np.zeros(3), np.stack([light.half_u, light.half_v])
    outline, best = light.corners - light.center, (np.inf, np.zeros(3), np.zeros((2, 3)))
    for edge in np.roll(outline, -1, axis=0) - outline:
        if edge.any():
            axes = np.stack([edge, np.cross(light.direction, edge)]) / np.linalg.norm(edge)
            flat = outline @ axes.T
            low, high = flat.min(axis=0), flat.max(axis=0)
            found = np.prod(high - low), 0.5 * (low + high) @ axes, 0.5 * (high - low)[:, None] * axes
            best = min(best, found, key=lambda each: each[0])
    return best[1:]


def _inside(outline, s, t):
    """Mask of the places s, t in a polygon (V, 2)."""
    inside = np.zeros(s.shape, bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > t) != (y1 > t)) & (s < x0 + (t - y0) * ((x1 - x0) / (y1 - y0)))
    return inside


def _cells(place):
    """Rows or columns of the picture of a light at places from -1 to 1."""
    return np.clip((0.5 * _PICTURE) * (place + _ONE), 0, _PICTURE - 1).astype(np.intp)


def picture_of(light, places_of):
    """Brightness (_PICTURE, _PICTURE) of a textured light by the places of its patches, as a share of its mean."""
    grid = (np.arange(_PICTURE) + 0.5) * (2.0 / _PICTURE) - 1.0
    picture = np.zeros((_PICTURE, _PICTURE), np.float32)
    mean = max(np.abs(light.radiance).mean(), 1e-30)
    for patch in light.patches:
        outline = places_of(patch.polygon() - light.center)
        columns, rows = (slice(*np.searchsorted(grid, (axis.min(), axis.max()))) for axis in outline.T)
        part = picture[rows, columns]
        part[_inside(outline, *np.meshgrid(grid[columns], grid[rows]))] = np.abs(patch.radiance).mean() / mean
    return picture


def shared_numbers(lights: Sequence[AreaLight], tracer=None) -> tuple[tuple[int, ...], ...]:
    """Which of the `lights` share their rays, and so the share of them that is seen: the squares of a sky, and lights
    of one color, group and pass that light and are blocked by the same things, where there are FEWEST of them.

    Without a tracer everything is blocked by the same things.
    """
    shared: dict[tuple, list[int]] = {}
    masks: dict[str, tuple] = {}
    for number, light in enumerate(lights):
        if tracer is not None and light.name not in masks:
            ways = (tracer.mask_of, tracer.surface_mask_of, tracer.chosen_by)
            masks[light.name] = tuple(way(light.name) for way in ways)
        shared.setdefault(_kind(light, number, masks.get(light.name)), []).append(number)
    found = []
    for kind, own in shared.items():
        is_one = kind[0] == "sky" or len(own) >= light_tree.FEWEST
        found.extend([tuple(own)] if is_one else [(number,) for number in own])
    return tuple(sorted(found))


def _kind(light, number, masks) -> tuple:
    """What lights that share their rays have in common."""
    if _is_side(light):
        return "sky", light.name
    is_even = light.is_even and not (light.is_distant or light.is_facing or light.is_profiled or light.detail)
    brightest = light.radiance.max()
    if not is_even or light.radiance.min() < 0.0 or brightest == 0.0 or not light.area_vector.any():
        return "one", number
    color = tuple(np.round(light.radiance / brightest, COLOR_DIGITS).tolist())
    return "many", light.group, light.receivers, light.affects_diffuse, light.affects_specular, color, masks


def emitters_of(
    lights: Sequence[AreaLight], tracer=None
) -> tuple[tuple[Emitter | Cluster, ...], tuple[tuple[int, ...], ...]]:
    """Emitters, and which of the `lights` each stands for."""
    numbers, emitters = shared_numbers(lights, tracer), []
    for own in numbers:
        members = [lights[number] for number in own]
        is_sky = _is_side(members[0])
        emitters.append(Sky(members) if is_sky else Cluster(members) if len(own) > 1 else Emitter(members[0]))
    return tuple(emitters), numbers


def _is_side(light: AreaLight) -> bool:
    """True for a side of the cube around all samples."""
    if not light.is_distant or light.shape != "RECTANGLE":
        return False
    axes = np.stack([light.center, light.half_u, light.half_v])
    return bool(np.array_equal(np.abs(axes).sum(axis=0), np.ones(3)) and np.allclose(axes @ axes.T, np.eye(3)))


class Sky(Emitter):
    """The sides of a cube as one emitter; its `light` has their mean radiance and next to nothing else of them."""

    def __init__(self, sides: Sequence[AreaLight]):
        self.ahead = np.repeat(np.eye(3, dtype=np.float32), 2, axis=0)
        self.ahead[1::2] *= -1.0
        self.right, self.up = np.roll(self.ahead, 1, axis=1), np.roll(self.ahead, 2, axis=1)
        values, radiance = np.zeros((6, CELLS, CELLS)), np.zeros(3)
        for side in sides:
            axis = int(np.argmax(np.abs(side.center)))
            slot = 2 * axis + int(side.center[axis] < 0.0)
            self.right[slot], self.up[slot] = side.half_u, side.half_v
            values[slot] = np.abs(side.radiance).mean() * _cells_of(side)
            radiance += side.radiance / 6.0
        place = (np.arange(CELLS) + 0.5) * (2.0 / CELLS) - 1.0
        angles = (4.0 / CELLS**2) * (1.0 + place[:, None] ** 2 + place**2) ** -1.5
        power = (values * angles).ravel()
        self.chances = (power / power.sum()).astype(np.float32)
        self.ends = np.cumsum(power / power.sum()).astype(np.float32)
        self.values = (values / max(np.abs(radiance).mean(), 1e-30)).astype(np.float32).ravel()
        like = sides[0]
        super().__init__(
            AreaLight(
                like.name,
                "RECTANGLE",
                center=np.array([0.0, 0.0, NEXT_TO]),
                half_u=np.array([1.0, 0.0, 0.0]),
                half_v=np.array([0.0, 1.0, 0.0]),
                direction=np.array([0.0, 0.0, -1.0]),
                radiance=radiance,
                affects_diffuse=like.affects_diffuse,
                affects_specular=like.affects_specular,
                receivers=like.receivers,
                is_distant=True,
            )
        )
        self.chosen_as = tuple(sides)

    def directions(self, x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Unit vectors (3, S, Q) for numbers (S, Q) in [0, 1): half of them by their brightness, of which those below
        the horizon of `normal` (3, Q) are mirrored, half of them by their cosine."""
        by_picture = x < np.float32(0.5)
        x = np.where(by_picture, np.float32(2.0) * x, np.float32(2.0) * x - _ONE)
        return np.where(by_picture, self._by_picture(x, y, normal), _by_cosine(x, y, normal))

    def _by_picture(self, x, y, normal):
        cell = np.minimum(np.searchsorted(self.ends, x.ravel()).reshape(x.shape), len(self.ends) - 1)
        share = (x - (self.ends[cell] - self.chances[cell])) / np.maximum(self.chances[cell], np.float32(1e-30))
        slot, place = np.divmod(cell, CELLS * CELLS)
        row, column = np.divmod(place, CELLS)
        step = np.float32(2.0 / CELLS)
        s = (column.astype(np.float32) + np.clip(share, _ZERO, _ONE)) * step - _ONE
        t = (row.astype(np.float32) + y) * step - _ONE
        found = np.stack([self.ahead[slot, k] + s * self.right[slot, k] + t * self.up[slot, k] for k in range(3)])
        found /= np.sqrt(dot(found, found))
        below = np.minimum(dot(found, normal[:, None]), _ZERO)
        below *= np.float32(-2.0)
        found += below * normal[:, None]
        return found

    def density(self, directions: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Of `directions` per sr, for unit directions (3, S, Q) above the horizon of `normal`."""
        height = dot(directions, normal[:, None])
        mirrored = directions - np.float32(2.0) * height * normal[:, None]
        found = self._plain_density(directions) + self._plain_density(mirrored)
        found += np.maximum(height, _ZERO) * np.float32(1.0 / np.pi)
        found *= np.float32(0.5)
        return found

    def _plain_density(self, directions):
        cell, along = self._cells(directions)
        return self.chances[cell] * np.float32(CELLS * CELLS / 4.0) / (along * along * along)

    def brightness_along(self, directions: np.ndarray) -> np.ndarray:
        """Factors (S, Q) of the mean radiance along unit directions (3, S, Q)."""
        return self.values[self._cells(directions)[0]]

    def _cells(self, directions):
        """Number (S, Q) of the cell, and the largest component, of unit directions (3, S, Q)."""
        sizes = np.abs(directions)
        axis = np.argmax(sizes, axis=0)
        along = np.take_along_axis(sizes, axis[None], axis=0)[0]
        slot = 2 * axis + (np.take_along_axis(directions, axis[None], axis=0)[0] < 0.0)
        column, row = (
            np.clip(
                (sum(axes[slot, k] * directions[k] for k in range(3)) / along + _ONE) * np.float32(CELLS / 2.0),
                0,
                CELLS - 1,
            ).astype(np.intp)
            for axes in (self.right, self.up)
        )
        return (slot * CELLS + row) * CELLS + column, along


def _by_cosine(x, y, normal):
    """Unit vectors (3, S, Q) around normals (3, Q), by the cosine."""
    sign = np.copysign(_ONE, normal[2])
    a = -_ONE / (sign + normal[2])
    b = normal[0] * normal[1] * a
    tangent = np.stack([_ONE + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0]])[:, None]
    bitangent = np.stack([b, sign + normal[1] * normal[1] * a, -normal[1]])[:, None]
    radius, angle = np.sqrt(x), np.float32(2.0 * np.pi) * y
    found = radius * np.cos(angle) * tangent + radius * np.sin(angle) * bitangent
    found += np.sqrt(_ONE - x) * normal[:, None]
    return found


def _cells_of(side: AreaLight) -> np.ndarray:
    """Brightness (CELLS, CELLS) by the mean, rows along half_v, columns along half_u."""
    if not side.detail:
        return np.ones((CELLS, CELLS))
    axes = np.linalg.pinv(np.stack([side.half_u, side.half_v]))
    picture = picture_of(side, lambda offset: offset @ axes)
    step = len(picture) // CELLS
    return picture.reshape(CELLS, step, CELLS, step).mean(axis=(1, 3))


class Cluster:
    """Many plain lights of one color as one emitter: a ray goes to one of them, chosen by what it may give the sample.

    The lights, cut into quadrilaterals, are the leaves of a tree. Down from its root a ray takes either half of a node
    as likely as the bounds on distance, on cosines and on the lobe say that it is bright: 0 only where nothing arrives
    (Conty Estevez and Kulla 2018, "Importance sampling of many lights with adaptive tree splitting",
    doi:10.1145/3233305). `light` stands for all of them: it has their mean power, and reaches as far.
    """

    def __init__(self, lights: Sequence[AreaLight]):
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
        self.light = AreaLight(
            like.name,
            "RECTANGLE",
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
        self.chosen_as = (replace(self.light, shape="BALL", radiance=power / (4.0 * np.pi * radius**2), **ball),)
        corners = corners - center
        values = radiance.mean(axis=1)
        self.brightness = (values / max(self.light.radiance.mean(), 1e-30)).astype(np.float32)
        self.corners = np.ascontiguousarray(corners.transpose(2, 1, 0), dtype=np.float32)
        self.normal = np.ascontiguousarray(normal.T, dtype=np.float32)
        self.is_round = is_round if is_round.any() else None
        self._build(corners, normal, values * area)

    def _build(self, corners, normal, power):
        """The nodes, the root first."""
        low, high = corners.min(axis=1), corners.max(axis=1)
        order, start, end, self.children = light_tree.ranges(0.5 * (low + high), normal)
        alone = end - start == 1
        own = order[start]
        self.leaf = np.where(alone, own, -1)
        low, high, sums, vector = low[own], high[own], power[own], power[own, None] * normal[own]
        for first, last in reversed(_levels(self.children)):
            inner = first + np.flatnonzero(self.children[first:last, 0] >= 0)
            one, other = self.children[inner].T
            low[inner], high[inner] = np.minimum(low[one], low[other]), np.maximum(high[one], high[other])
            sums[inner], vector[inner] = sums[one] + sums[other], vector[one] + vector[other]
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        axis = np.where(length > 1e-9 * sums[:, None], vector / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
        self.center = np.ascontiguousarray(0.5 * (low + high).T, dtype=np.float32)
        self.radius = (0.5 * np.linalg.norm(high - low, axis=1)).astype(np.float32)
        self.axis = np.ascontiguousarray(axis.T, dtype=np.float32)
        self.cone = light_tree.cones(axis, normal[order], start, end).astype(np.float32)
        self.power = (sums / sums[0]).astype(np.float32)

    def pick(self, x: np.ndarray, lobes: Sequence[ClusterLobe], own: np.ndarray):
        """Leaves (R,), by lobe how likely (R,) each is taken, and what is left of the numbers x (R,) in [0, 1), for
        rays that go by the lobe `own` (R,)."""
        node, chances = np.zeros(len(x), np.intp), np.ones((len(lobes), len(x)), np.float32)
        while True:
            inner = np.flatnonzero(self.leaf[node] < 0)
            if len(inner) == 0:
                return self.leaf[node], chances, x
            one, other = self.children[node[inner]].T
            bounds = (self._bounds(one, lobes, inner), self._bounds(other, lobes, inner))
            both = bounds[0] + bounds[1]
            share = np.divide(bounds[0], both, out=np.zeros_like(both), where=both > 0.0)
            mine = share[own[inner], np.arange(len(inner))]
            is_first = x[inner] < mine
            size = np.where(is_first, mine, _ONE - mine)
            rest = (x[inner] - np.where(is_first, _ZERO, mine)) / np.maximum(size, _TINY)
            x[inner] = np.clip(rest, _ZERO, np.float32(1.0 - 2.0**-24))
            chances[:, inner] *= np.where(both > 0.0, np.where(is_first, share, _ONE - share), _ZERO)
            node[inner] = np.where(is_first, one, other)

    def _bounds(self, node, lobes, rays):
        """By lobe, about how much light (R,) of a node, at most, the `rays` (R,) get."""
        offset = self.center[:, node] + lobes[0].offset[:, rays]
        squares = np.maximum(dot(offset, offset), _TINY)
        distance, radius = np.sqrt(squares), self.radius[node]
        spread = np.where(radius < distance, np.arcsin(np.minimum(radius / distance, _ONE)), np.float32(np.pi))
        spread += _SLACK
        offset /= distance
        light = self.power[node] / np.maximum(squares, radius * radius)
        light *= _cosine_at_most(-dot(offset, self.axis[:, node]), self.cone[node] + spread)
        return np.stack([light * lobe.at_most(offset, spread, rays) for lobe in lobes])


# In rad, for what single precision leaves of angles.
_SLACK = np.float32(2e-3)


@dataclass(frozen=True)
class ClusterLobe:
    """What bounds a lobe of rays: vectors (3, R) and values (R,)."""

    offset: np.ndarray  # m, to the center of the cluster
    normal: np.ndarray
    mirrored: np.ndarray | None = None  # the mirrored view, of specular lobes
    width: np.ndarray | None = None  # in rad

    def at_most(self, directions, spread, rays):
        """Of the lobe (R,) in cones of an angle `spread` (R,) around `directions` (3, R)."""
        cosine = _cosine_at_most(dot(directions, self.normal[:, rays]), spread)
        if self.mirrored is None:
            return cosine
        toward = np.clip(dot(directions, self.mirrored[:, rays]), -_ONE, _ONE)
        away = np.maximum(np.arccos(toward) - spread, _ZERO)
        squared = np.square(self.width[rays])
        return np.square(squared / (squared + away * away)) * (cosine > 0.0)


def _cosine_at_most(cosine, spread):
    """The largest cosine (R,), not below 0, of angles that differ by at most `spread` (R,) from those of `cosine`."""
    angle = np.maximum(np.arccos(np.clip(cosine, -_ONE, _ONE)) - spread, _ZERO)
    return np.where(angle < np.float32(0.5 * np.pi), np.maximum(np.cos(angle), _ZERO), _ZERO)


def _levels(children):
    """First and last number of the nodes of each level."""
    levels = [(0, 1)]
    while True:
        first, last = levels[-1]
        more = 2 * int(np.count_nonzero(children[first:last, 0] >= 0))
        if more == 0:
            return levels
        levels.append((last, last + more))


def _quads_of(light: AreaLight) -> list[np.ndarray]:
    """Convex quadrilaterals (4, 3), of which triangles repeat the last corner, that a light consists of; the
    parallelogram around a round one."""
    if light.shape != "POLYGON":
        u, v = light.half_u, light.half_v
        return [light.center + np.stack([-u - v, u - v, u + v, v - u])]
    if len(light.corners) == 3:
        return [light.corners[[0, 1, 2, 2]]]
    found = []
    for piece in convex_pieces(light.corners):
        for first in range(1, len(piece) - 1, 2):
            found.append(piece[[0, first, first + 1, min(first + 2, len(piece) - 1)]])
    return found


class SphericalQuads:
    """Quadrilaterals (3, 4, Q) as points see them, for directions spread evenly over their solid angles (Q,).

    Two triangles on either side of a diagonal, sampled as in Peters 2021, "BRDF importance sampling for polygonal
    lights", section 3 (after Arvo 1995), doi:10.1145/3450626.3459672.
    """

    def __init__(self, corners: np.ndarray):
        unit = corners / np.maximum(np.sqrt(dot(corners, corners)), _TINY)
        self.apex, far, self.near = unit[:, 0], unit[:, 2], (unit[:, 1], unit[:, 3])
        # By sums and differences: corners may be close to each other, or nearly opposite.
        self.both, chord = self.apex + far, far - self.apex
        self.gap = np.float32(0.5) * dot(self.both, self.both)
        self.terms, angles = [], []
        for near in self.near:
            volume = np.abs(dot(_cross(near - self.apex, chord), self.apex))
            near_both = dot(near, self.both)
            both = self.apex + near
            self.terms.append((volume, np.float32(0.5) * dot(both, both), near_both))
            angles.append(2.0 * np.arctan2(volume, self.gap + near_both))
        self.first, self.solid_angle = angles[0], angles[0] + angles[1]
        self.is_seen = self.solid_angle > _LEAST_SOLID_ANGLE
        np.maximum(self.solid_angle, _LEAST_SOLID_ANGLE, out=self.solid_angle)

    def part(self, rows: slice) -> SphericalQuads:
        """The `rows` of quadrilaterals (3, 4, S, Q), of which each sample has several."""
        found = copy.copy(self)
        for name in ("apex", "both"):
            setattr(found, name, getattr(self, name)[:, rows])
        found.near = [near[:, rows] for near in self.near]
        found.terms = [tuple(term[rows] for term in terms) for terms in self.terms]
        for name in ("gap", "first", "solid_angle", "is_seen"):
            setattr(found, name, getattr(self, name)[rows])
        return found

    def directions(self, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Unit vectors `out` (3, S, Q) for numbers (S, Q) in [0, 1), which are lost."""
        x *= self.solid_angle
        is_second = x > self.first
        x -= np.where(is_second, self.first, _ZERO)
        x *= np.float32(0.5)
        volume, near_gap, near_both = (np.where(is_second, b, a) for a, b in zip(*self.terms, strict=True))
        cosine, sine = np.cos(x), np.sin(x, out=x)
        # The third corner of the part of the triangle that has the solid angle: `apex` and `both` times these.
        on_apex = np.multiply(cosine, volume, out=volume)
        on_apex -= (self.gap + near_both) * sine
        on_both = sine
        on_both *= near_gap
        scale = on_both * self.gap
        squared = on_apex + on_both
        squared *= scale
        squared *= np.float32(2.0)
        squared += on_apex * on_apex
        scale += on_apex
        scale *= np.float32(2.0)
        scale /= np.maximum(squared, _TINY, out=squared)
        on_apex *= scale
        on_apex -= _ONE
        on_both *= scale
        # Between the corner `near` and that one.
        near_gap -= _ONE
        near_gap *= on_apex
        near_both *= on_both
        near_gap += near_both
        cosine = np.clip(near_gap, -_ONE, _ONE, out=near_gap)
        height = cosine - _ONE
        height *= y
        height += _ONE
        share = height + _ONE
        share *= y
        share /= np.maximum(cosine + _ONE, _TINY)
        np.sqrt(share, out=share)
        on_apex *= share
        on_both *= share
        cosine *= share
        height -= cosine
        for k in range(3):
            near = np.where(is_second, self.near[1][k], self.near[0][k])
            np.multiply(near, height, out=out[k])
            out[k] += on_apex * self.apex[k]
            out[k] += on_both * self.both[k]
        # Rounding leaves a little.
        length = np.sqrt(dot(out, out))
        out /= np.maximum(length, _TINY, out=length)
        return out


class Warps:
    """The maps from the world to where GGX lobes have no peak: local frames, then the warps of `shading.lookup_table`
    with A, B and C = 1, the limit for alpha -> 0."""

    def __init__(self, rows: np.ndarray, cosine: np.ndarray, sine: np.ndarray, alpha: np.ndarray):
        """Local frames (3, 3, Q); cosine and sine of the view's angle from the normal, and alpha, (Q,)."""
        self.rows = rows
        self.xx = cosine * cosine + np.float32(WARP_REGULARIZATION**2) * alpha * alpha
        self.xz = np.sqrt(self.xx) * sine
        self.zz = 2.0 * alpha
        self.determinant = self.xx * self.zz

    def local(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Vectors (3, S, Q) along the local frames of those in the world."""
        return self._turned(vectors, self.rows, out)

    def world(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Vectors (3, S, Q) in the world of those in the local frames."""
        return self._turned(vectors, self.rows.transpose(1, 0, 2), out)

    def _turned(self, vectors, rows, out):
        out = np.empty_like(vectors) if out is None else out
        for k in range(3):
            np.multiply(vectors[0], rows[k, 0], out=out[k])
            out[k] += vectors[1] * rows[k, 1]
            out[k] += vectors[2] * rows[k, 2]
        return out

    def warped(self, local: np.ndarray) -> np.ndarray:
        """Vectors (3, S, Q) after the warp of those in the local frames."""
        return np.stack([self.xx * local[0] + self.xz * local[2], local[1], self.zz * local[2]])

    def lengths(self, local: np.ndarray) -> np.ndarray:
        """Lengths (S, Q) after the warp of unit vectors (3, S, Q) in the local frames."""
        warped = self.warped(local)
        warped *= warped
        return np.sqrt(warped[0] + warped[1] + warped[2])

    def unwarped(self, vectors: np.ndarray) -> np.ndarray:
        """Turn warped unit vectors (3, S, Q) into unit vectors in the local frames, and return their `lengths`."""
        x, y, z = vectors
        z /= self.zz
        x -= self.xz * z
        x /= self.xx
        length = x * x
        length += y * y
        length += z * z
        np.maximum(length, _TINY, out=length)
        np.sqrt(length, out=length)
        np.divide(_ONE, length, out=length)
        vectors *= length
        return length


def frames(normal: np.ndarray, view: np.ndarray):
    """Cosine and sine (Q,) of the view's angle from the normal, both (3, Q), and local frames (3, 3, Q): rows tangent,
    bitangent, normal."""
    # The difference of vectors that are close is exact; a normal from single precision is not quite a unit vector.
    across = view - normal
    squared = dot(normal, normal)
    across -= dot(across, normal) / squared * normal
    sine = np.sqrt(dot(across, across))
    axis = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normal), axis=0)].T
    tangent = np.where(sine > 1e-6, across / np.maximum(sine, _TINY), axis)
    tangent -= dot(tangent, normal) / squared * normal
    tangent /= np.sqrt(dot(tangent, tangent))
    normal = normal / np.sqrt(squared)
    rows = np.stack([tangent, _cross(normal, tangent), normal])
    return np.clip(dot(normal, view), _ZERO, _ONE), sine, rows


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class Choices:
    """How likely Cycles chooses directions from samples (P) by `lights` (L) and by the lobes of the surface.

    Both see the light past different things. Rays that the light chose start above a curved surface, and nothing
    blocks them where the light casts no shadow; rays that the surface chose start at the surface, and are always
    blocked.
    """

    def __init__(self, samples: SurfaceSamples, lights: Sequence[AreaLight], is_baked: bool):
        self._samples, self._lights, self._is_baked = samples, tuple(lights), is_baked
        self._first = None

    def _prepare(self):
        """What is needed once something is asked for, which in most scenes is never."""
        samples = self._samples
        moved = np.any(samples.position[1:] != samples.position[:-1], axis=1)
        # The samples of a hit follow one another.
        self._hit = np.concatenate([np.zeros(min(len(samples), 1), int), np.cumsum(moved)])
        self._count = np.bincount(self._hit)
        self._first = np.cumsum(self._count) - self._count
        self._lobes = lobe_chances(samples, self._hit, is_baked=False)
        self._chances = np.full((len(self._lights), len(samples)), np.nan, np.float32)
        self._rows = light_rows(self._lights)

    def by_surface(self, name: str, number: int, index, directions, solid_angle) -> np.ndarray:
        """Share (R,) of the light of light `number`, which has the `solid_angle` (R,), that a pass gets because the
        surface chose the unit directions (3, R), from the samples `index` (R,)."""
        if self._first is None:
            self._prepare()
        by_light = self._chance(number, index) / np.maximum(solid_angle, 1e-12)
        by_surface = self._density(name, index, directions.T.astype(np.float64))
        return (by_surface**2 / np.maximum(by_surface**2 + by_light**2, 1e-30)).astype(np.float32)

    def _chance(self, number, index):
        unknown = np.unique(index[np.isnan(self._chances[number, index])])
        if len(unknown):
            position, normal = self._samples.position[unknown], self._samples.smooth_normal[unknown]
            self._chances[:, unknown] = light_chances(position, normal, self._lights, self._rows)
        return self._chances[number, index]

    def _density(self, name, index, directions):
        """Probability (R,) per sr that the lobes of a hit choose the directions (R, 3)."""
        hit, density = self._hit[index], np.zeros(len(index))
        for number in range(self._count[hit].max(initial=0)):
            here = np.flatnonzero(self._count[hit] > number)
            own = self._first[hit[here]] + number
            specular, diffuse = self._lobes[:, own]
            # Bakes of a pass choose by its lobes alone.
            if self._is_baked:
                whole = np.maximum(self._sum_of_hit(name, hit[here]), 1e-12)
                specular, diffuse = (
                    specular / whole if name == "specular" else 0.0 * specular,
                    diffuse / whole if name == "diffuse" else 0.0 * diffuse,
                )
            density[here] += specular * self._lobe_density(own, directions[here])
            cosine = np.einsum("rk,rk->r", directions[here], self._samples.diffuse_normal[own])
            density[here] += diffuse * np.maximum(cosine, 0.0) / np.pi
        return density

    def _sum_of_hit(self, name, hit):
        return np.bincount(self._hit, weights=self._lobes[int(name == "diffuse")])[hit]

    def _lobe_density(self, own, directions):
        samples = self._samples
        normal, view = samples.normal[own], samples.view[own]
        half = directions + view
        vertical = np.square(np.maximum(np.einsum("rk,rk->r", half, normal), 0.0))
        horizontal = np.maximum(np.square(half).sum(axis=1) - vertical, 0.0)
        alpha2 = np.square(np.maximum(samples.roughness[own] ** 2, SMALLEST_ALPHA))
        cosine = np.maximum(np.einsum("rk,rk->r", normal, view), 1e-3)
        return brdf.visible_normal_density(cosine, horizontal, vertical, alpha2)
