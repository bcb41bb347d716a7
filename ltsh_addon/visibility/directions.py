"""Directions from surface points to a light, few and well spread, and how bright each is for the lobes of the point.

Directions aim at a quadrilateral around the light. Where a round, polygonal or textured light leaves it dark, the
direction has the weight 0. Half of the directions are spread evenly over the solid angle of the quadrilateral, which
suits diffuse lobes. The other half are spread evenly over its solid angle after the warp that flattens the peak of GGX
(`shading.lookup_table`), which suits specular lobes: none misses the light, however sharp the lobe. The balance
heuristic (Veach and Guibas 1995) combines both.

The sides of a sky surround all samples and count as one light. The specular lobe chooses its directions as above; of
the other directions, half follow the picture of the sky and half the cosine. Many plain lights of one color also count
as one light (`LightCluster`).

Everything is in single precision. Arrays are (S, Q), S directions from each of Q points, or (Q,). Vectors have their
components first.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cycles.horizons import SMALLEST_ALPHA, lobe_selection_pmf
from ..cycles.light_tree import light_selection_pmf, light_tree_rows
from ..emitters import light_profile, light_tree
from ..lobes import brdf
from ..lobes.lookup_table import WARP_REGULARIZATION
from ..lobes.polygon import convex_pieces
from ..scene import FlatLight, Light, PointLight, PolygonLight, QuadLight, SkyLight, SurfaceSamples

# Bits of a coordinate of the sequence, as many as single precision holds.
BITS = 23
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# In sr. Quadrilaterals with a smaller solid angle count as invisible.
_LEAST_SOLID_ANGLE = np.float32(1e-20)
# Length of each sequence
MOST_POINTS = 1024
# Cells along each side of the picture of a textured light.
_PICTURE = 128
# CELLS: cells along each edge of a side of the sky. NEXT_TO: distance from a sample to the plane that stands for the
# sky, in units of half the plane's side.
CELLS, NEXT_TO = 64, 1e-3
# Decimals of a color, as a share of its largest channel, that must agree for lights to count as one: their colors
# differ by at most 0.05 %.
COLOR_DIGITS = 3
# Corners of the outline of an ellipse
_ROUND_CORNERS = 16


def sequence(count: int, seed: int = 1) -> np.ndarray:
    """The first `count` points (2, count) of the Sobol sequence, uint32 of 23 bits, scrambled as by Owen (1995).

    Each block of 2^k points that starts at a multiple of 2^k is stratified as well as can be. XOR with any number keeps
    this property.
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
    """Scrambled uint32 values: Laine and Karras 2011, "Stratified sampling for stochastic transparency", with the
    constants of Vegdahl."""
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
    """Numbers x, y (S, Q) in (0, 1): the points `first` to `last` of the sequence `stream`, 0 or 1, scrambled by the
    seeds (Q,)."""
    coordinates = []
    for axis, points in enumerate(_POINTS[stream][:, first:last]):
        scrambled = mixed_bits(seeds + np.uint32((2 * stream + axis) * 0x9E3779B1 & 0xFFFFFFFF)) >> np.uint32(32 - BITS)
        numbers = (points[:, None] ^ scrambled).astype(np.float32)
        numbers += np.float32(0.5)
        numbers *= np.float32(2.0**-BITS)
        coordinates.append(numbers)
    return coordinates


def seeds_of(position: np.ndarray) -> np.ndarray:
    """Seeds (P,) uint32 of points (P, 3). They do not depend on the place of a point in a picture or a block."""
    bits = np.ascontiguousarray(position, dtype=np.float32).view(np.uint32)
    return mixed_bits(mixed_bits(mixed_bits(bits[:, 0]) ^ bits[:, 1]) ^ bits[:, 2])


def mixed_bits(values):
    """A hash of uint32 (Wellons 2018, "lowbias32")."""
    values = (values ^ (values >> np.uint32(16))) * np.uint32(0x7FEB352D)
    values = (values ^ (values >> np.uint32(15))) * np.uint32(0x846CA68B)
    return values ^ (values >> np.uint32(16))


class Emitter:
    """The quadrilateral at which directions to a light aim, and the brightness of the light in it, for all points.

    The quadrilateral is the light itself if that is an untextured triangle or convex quadrilateral; a triangle repeats
    its last corner. Otherwise it is the parallelogram center + s axes[0] + t axes[1], |s|, |t| <= 1, around the light.
    """

    def __init__(self, light: Light):
        self.light, self.selected_as = light, (light,)
        self.outline = light.polygon(_ROUND_CORNERS) - light.center
        self.profile = light_profile.Profile.of(light) if light.has_profile else None
        self.corners = self._own_corners()
        self.center, self.axes = _parallelogram(light) if self.corners is None else (None, None)
        self._picture = self._edge = None
        if self.corners is None and light.children:
            self._picture = picture_of(light, self._places)
        elif self.corners is None and isinstance(light, PolygonLight):
            self._edge = self._places(light.corners - light.center).astype(np.float32)

    def _own_corners(self) -> np.ndarray | None:
        """Corners (4, 3), relative to the center, of an untextured convex polygon of three or four corners; else None.
        A triangle repeats its last corner."""
        if not isinstance(self.light, PolygonLight) or self.light.children:
            return None
        pieces = convex_pieces(self.outline)
        return pieces[0][[0, 1, 2, -1]] if len(pieces) == 1 and len(pieces[0]) <= 4 else None

    def _places(self, offset: np.ndarray) -> np.ndarray:
        """Coordinates s, t (..., 2) of points of the light's plane, given by offsets (..., 3) from its center."""
        return (offset - self.center) @ np.linalg.pinv(self.axes)

    def corners_from(self, offset: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Corners (3, 4, Q) of the quadrilateral relative to points. The center of the light is at `offset` (3, Q) from
        the points, and the points are at `height` (Q,) over its plane."""
        if self.corners is not None:
            return offset[:, None] + self.corners.T.astype(np.float32)[:, :, None]
        u, v = self.axes.astype(np.float32)[:, :, None]
        middle = offset + self.center.astype(np.float32)[:, None]
        (low_s, high_s), (low_t, high_t) = self._ranges(middle, height)
        ends = ((low_s, low_t), (high_s, low_t), (high_s, high_t), (low_s, high_t))
        return np.stack([middle + s * u + t * v for s, t in ends], axis=1)

    def _ranges(self, middle, height):
        """Ranges of s and t over which the quadrilateral extends: no farther than the cone of a spread reaches."""
        squares = (self.axes * self.axes).sum(axis=1)
        if not self.light.has_spread or abs(self.axes[0] @ self.axes[1]) > 1e-6 * squares.max():
            return ((-_ONE, _ONE), (-_ONE, _ONE))
        ranges = []
        for axis, squared in zip(self.axes, squares, strict=True):
            foot = -dot(middle, (axis / max(squared, 1e-30)).astype(np.float32))
            reach = np.float32(self.profile.tangent / max(np.sqrt(squared), 1e-15)) * height
            ranges.append((np.clip(foot - reach, -_ONE, _ONE), np.clip(foot + reach, -_ONE, _ONE)))
        return ranges

    def brightness(self, towards: np.ndarray, distance: np.ndarray, offset: np.ndarray, height: np.ndarray):
        """Radiance as factors (S, Q) of its mean, along directions (3, S, Q) that meet the light's plane at `distance`
        (S, Q); None if all are 1. `offset` and `height` are as in `corners_from`."""
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
            pattern = self._picture[_cells(t), _cells(s)]
        else:
            pattern = _inside(self._edge, s, t) if self._edge is not None else s * s + t * t <= _ONE
        return pattern if factor is None else factor * pattern


def _parallelogram(light: Light):
    """Center, relative to that of the light, and half axes (2, 3) of a parallelogram around the light. Around a polygon
    it is the smallest rectangle along one of the edges."""
    if not isinstance(light, PolygonLight):
        return np.zeros(3), np.stack([light.half_u, light.half_v])
    outline, best = light.corners - light.center, (np.inf, np.zeros(3), np.zeros((2, 3)))
    for edge in np.roll(outline, -1, axis=0) - outline:
        if edge.any():
            axes = np.stack([edge, np.cross(light.direction, edge)]) / np.linalg.norm(edge)
            flat = outline @ axes.T
            low, high = flat.min(axis=0), flat.max(axis=0)
            candidate = np.prod(high - low), 0.5 * (low + high) @ axes, 0.5 * (high - low)[:, None] * axes
            best = min(best, candidate, key=lambda each: each[0])
    return best[1:]


def _inside(outline, s, t):
    """Mask of the places s, t that lie in a polygon (V, 2)."""
    inside = np.zeros(s.shape, bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > t) != (y1 > t)) & (s < x0 + (t - y0) * ((x1 - x0) / (y1 - y0)))
    return inside


def _cells(coordinate):
    """Rows or columns of a light's picture at coordinates from -1 to 1."""
    return np.clip((0.5 * _PICTURE) * (coordinate + _ONE), 0, _PICTURE - 1).astype(np.intp)


def picture_of(light, places_of):
    """Brightness (_PICTURE, _PICTURE) of a textured light in units of its mean. `places_of` returns the coordinates of
    points."""
    grid = (np.arange(_PICTURE) + 0.5) * (2.0 / _PICTURE) - 1.0
    picture = np.zeros((_PICTURE, _PICTURE), np.float32)
    mean = max(np.abs(light.radiance).mean(), 1e-30)
    for patch in light.leaves:
        outline = places_of(patch.polygon() - light.center)
        columns, rows = (slice(*np.searchsorted(grid, (axis.min(), axis.max()))) for axis in outline.T)
        cells = picture[rows, columns]
        cells[_inside(outline, *np.meshgrid(grid[columns], grid[rows]))] = np.abs(patch.radiance).mean() / mean
    return picture


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


class Sky(Emitter):
    """The sides of a cube as one emitter. Its `light` has their mean radiance; its shape is a mere placeholder."""

    def __init__(self, sides: Sequence[Light]):
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
        middles = (np.arange(CELLS) + 0.5) * (2.0 / CELLS) - 1.0
        angles = (4.0 / CELLS**2) * (1.0 + middles[:, None] ** 2 + middles**2) ** -1.5
        power = (values * angles).ravel()
        self.pmf = (power / power.sum()).astype(np.float32)
        self.ends = np.cumsum(power / power.sum()).astype(np.float32)
        self.values = (values / max(np.abs(radiance).mean(), 1e-30)).astype(np.float32).ravel()
        like = sides[0]
        super().__init__(
            SkyLight(
                name=like.name,
                center=np.array([0.0, 0.0, NEXT_TO]),
                half_u=np.array([1.0, 0.0, 0.0]),
                half_v=np.array([0.0, 1.0, 0.0]),
                direction=np.array([0.0, 0.0, -1.0]),
                radiance=radiance,
                affects_diffuse=like.affects_diffuse,
                affects_specular=like.affects_specular,
                receivers=like.receivers,
            )
        )
        self.selected_as = tuple(sides)

    def directions(self, x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Unit vectors (3, S, Q) for numbers (S, Q) in [0, 1). Half of them follow the brightness of the sky; those
        below the horizon of `normal` (3, Q) are mirrored. The other half follow the cosine."""
        by_picture = x < np.float32(0.5)
        x = np.where(by_picture, np.float32(2.0) * x, np.float32(2.0) * x - _ONE)
        return np.where(by_picture, self._by_picture(x, y, normal), _by_cosine(x, y, normal))

    def _by_picture(self, x, y, normal):
        cell = np.minimum(np.searchsorted(self.ends, x.ravel()).reshape(x.shape), len(self.ends) - 1)
        share = (x - (self.ends[cell] - self.pmf[cell])) / np.maximum(self.pmf[cell], np.float32(1e-30))
        slot, cell_of_side = np.divmod(cell, CELLS * CELLS)
        row, column = np.divmod(cell_of_side, CELLS)
        step = np.float32(2.0 / CELLS)
        s = (column.astype(np.float32) + np.clip(share, _ZERO, _ONE)) * step - _ONE
        t = (row.astype(np.float32) + y) * step - _ONE
        directions = np.stack([self.ahead[slot, k] + s * self.right[slot, k] + t * self.up[slot, k] for k in range(3)])
        directions /= np.sqrt(dot(directions, directions))
        below = np.minimum(dot(directions, normal[:, None]), _ZERO)
        below *= np.float32(-2.0)
        directions += below * normal[:, None]
        return directions

    def density(self, directions: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Probability density (S, Q) per sr of unit directions (3, S, Q) above the horizon of `normal`."""
        height = dot(directions, normal[:, None])
        mirrored = directions - np.float32(2.0) * height * normal[:, None]
        density = self._plain_density(directions) + self._plain_density(mirrored)
        density += np.maximum(height, _ZERO) * np.float32(1.0 / np.pi)
        density *= np.float32(0.5)
        return density

    def _plain_density(self, directions):
        cell, along = self._cells(directions)
        return self.pmf[cell] * np.float32(CELLS * CELLS / 4.0) / (along * along * along)

    def brightness_along(self, directions: np.ndarray) -> np.ndarray:
        """Radiance as factors (S, Q) of its mean, along unit directions (3, S, Q)."""
        return self.values[self._cells(directions)[0]]

    def _cells(self, directions):
        """Numbers (S, Q) of the cells that unit directions (3, S, Q) meet, and the largest components of these."""
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
    """Unit vectors (3, S, Q) around normals (3, Q), distributed as the cosine."""
    sign = np.copysign(_ONE, normal[2])
    a = -_ONE / (sign + normal[2])
    b = normal[0] * normal[1] * a
    tangent = np.stack([_ONE + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0]])[:, None]
    bitangent = np.stack([b, sign + normal[1] * normal[1] * a, -normal[1]])[:, None]
    radius, angle = np.sqrt(x), np.float32(2.0 * np.pi) * y
    directions = radius * np.cos(angle) * tangent + radius * np.sin(angle) * bitangent
    directions += np.sqrt(_ONE - x) * normal[:, None]
    return directions


def _cells_of(side: Light) -> np.ndarray:
    """Brightness (CELLS, CELLS) in units of the mean; rows along half_v, columns along half_u."""
    if not side.children:
        return np.ones((CELLS, CELLS))
    axes = np.linalg.pinv(np.stack([side.half_u, side.half_v]))
    picture = picture_of(side, lambda offset: offset @ axes)
    step = len(picture) // CELLS
    return picture.reshape(CELLS, step, CELLS, step).mean(axis=(1, 3))


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


class SphericalQuads:
    """Quadrilaterals (3, 4, Q) as points see them, for directions spread evenly over their solid angles (Q,).

    A diagonal splits each into two triangles, sampled as in Peters 2021, "BRDF importance sampling for polygonal
    lights", section 3 (after Arvo 1995), doi:10.1145/3450626.3459672.
    """

    def __init__(self, corners: np.ndarray):
        unit = corners / np.maximum(np.sqrt(dot(corners, corners)), _TINY)
        self.apex, far, self.near = unit[:, 0], unit[:, 2], (unit[:, 1], unit[:, 3])
        # Sums and differences stay accurate for corners that are close to each other or nearly opposite.
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
        self.has_solid_angle = self.solid_angle > _LEAST_SOLID_ANGLE
        np.maximum(self.solid_angle, _LEAST_SOLID_ANGLE, out=self.solid_angle)

    def take_rows(self, rows: slice) -> SphericalQuads:
        """The quadrilaterals of these `rows`, if they are (3, 4, S, Q): each sample sees several."""
        quads = copy.copy(self)
        for name in ("apex", "both"):
            setattr(quads, name, getattr(self, name)[:, rows])
        quads.near = [near[:, rows] for near in self.near]
        quads.terms = [tuple(term[rows] for term in terms) for terms in self.terms]
        for name in ("gap", "first", "solid_angle", "has_solid_angle"):
            setattr(quads, name, getattr(self, name)[rows])
        return quads

    def directions(self, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Unit vectors `out` (3, S, Q) for numbers x, y (S, Q) in [0, 1), which are overwritten."""
        x *= self.solid_angle
        is_second = x > self.first
        x -= np.where(is_second, self.first, _ZERO)
        x *= np.float32(0.5)
        volume, near_gap, near_both = (np.where(is_second, b, a) for a, b in zip(*self.terms, strict=True))
        cosine, sine = np.cos(x), np.sin(x, out=x)
        # The third corner of the subtriangle with this solid angle is on_apex `apex` + on_both `both`.
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
        # The cosine between the corner `near` and that third corner.
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
        # Correct what rounding changed.
        length = np.sqrt(dot(out, out))
        out /= np.maximum(length, _TINY, out=length)
        return out


class Warps:
    """Maps from the world to coordinates in which GGX lobes have no peak: the local frames, then the warps of
    `shading.lookup_table` with A, B and C = 1, the limit for alpha -> 0."""

    def __init__(self, rows: np.ndarray, cosine: np.ndarray, sine: np.ndarray, alpha: np.ndarray):
        """`rows` are local frames (3, 3, Q); `cosine` and `sine` are of the view's angle from the normal, (Q,) as is
        `alpha`."""
        self.rows = rows
        self.xx = cosine * cosine + np.float32(WARP_REGULARIZATION**2) * alpha * alpha
        self.xz = np.sqrt(self.xx) * sine
        self.zz = 2.0 * alpha
        self.determinant = self.xx * self.zz

    def local(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """World vectors (3, S, Q) in the local frames."""
        return self._turned(vectors, self.rows, out)

    def world(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Local vectors (3, S, Q) in the world."""
        return self._turned(vectors, self.rows.transpose(1, 0, 2), out)

    def _turned(self, vectors, rows, out):
        out = np.empty_like(vectors) if out is None else out
        for k in range(3):
            np.multiply(vectors[0], rows[k, 0], out=out[k])
            out[k] += vectors[1] * rows[k, 1]
            out[k] += vectors[2] * rows[k, 2]
        return out

    def warped(self, local: np.ndarray) -> np.ndarray:
        """Local vectors (3, S, Q) after the warp."""
        return np.stack([self.xx * local[0] + self.xz * local[2], local[1], self.zz * local[2]])

    def lengths(self, local: np.ndarray) -> np.ndarray:
        """Lengths (S, Q) that unit local vectors (3, S, Q) have after the warp."""
        warped = self.warped(local)
        warped *= warped
        return np.sqrt(warped[0] + warped[1] + warped[2])

    def unwarped(self, vectors: np.ndarray) -> np.ndarray:
        """Turn warped unit vectors (3, S, Q) in place into unit local vectors, and return the `lengths` of these."""
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
    """Cosine and sine (Q,) of the angle between view and normal, both (3, Q), and local frames (3, 3, Q): rows tangent,
    bitangent, normal."""
    # Differences of close vectors are exact. A single-precision normal is not quite a unit vector.
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


class LightSelection:
    """How likely Cycles chooses directions from samples (P) by `lights` (L) and by the lobes of the surface.

    Who chose a ray decides what it meets. Rays that the light chose start above a curved surface, and are not blocked
    if the light casts no shadow. Rays that the surface chose start at the surface, and are always blocked.
    """

    def __init__(self, samples: SurfaceSamples, lights: Sequence[Light], is_baked: bool):
        self._samples, self._lights, self._is_baked = samples, tuple(lights), is_baked
        self._first = None

    def _prepare(self):
        """Compute the chances on first use; most scenes never need them."""
        samples = self._samples
        moved = np.any(samples.position[1:] != samples.position[:-1], axis=1)
        # The samples of one hit are consecutive.
        self._hit = np.concatenate([np.zeros(min(len(samples), 1), int), np.cumsum(moved)])
        self._count = np.bincount(self._hit)
        self._first = np.cumsum(self._count) - self._count
        self._lobes = lobe_selection_pmf(samples, self._hit, is_baked=False)
        self._light_selection_pmf = np.full((len(self._lights), len(samples)), np.nan, np.float32)
        self._rows = light_tree_rows(self._lights)

    def bsdf_share(self, name: str, number: int, index, directions, solid_angle) -> np.ndarray:
        """Share (R,) of the light of light `number` that a pass gets because the surface chose the unit directions
        (3, R), seen from the samples `index` (R,). The light has the `solid_angle` (R,) in sr."""
        if self._first is None:
            self._prepare()
        by_light = self._pmf(number, index) / np.maximum(solid_angle, 1e-12)
        bsdf_share = self._density(name, index, directions.T.astype(np.float64))
        return (bsdf_share**2 / np.maximum(bsdf_share**2 + by_light**2, 1e-30)).astype(np.float32)

    def _pmf(self, number, index):
        unknown = np.unique(index[np.isnan(self._light_selection_pmf[number, index])])
        if len(unknown):
            position, normal = self._samples.position[unknown], self._samples.smooth_normal[unknown]
            self._light_selection_pmf[:, unknown] = light_selection_pmf(position, normal, self._lights, self._rows)
        return self._light_selection_pmf[number, index]

    def _density(self, name, index, directions):
        """Probability density (R,) per sr with which the lobes of a hit choose the directions (R, 3)."""
        hit, density = self._hit[index], np.zeros(len(index))
        for number in range(self._count[hit].max(initial=0)):
            here = np.flatnonzero(self._count[hit] > number)
            sample = self._first[hit[here]] + number
            specular, diffuse = self._lobes[:, sample]
            # A bake of one pass chooses by the lobes of that pass alone.
            if self._is_baked:
                whole = np.maximum(self._sum_of_hit(name, hit[here]), 1e-12)
                specular, diffuse = (
                    specular / whole if name == "specular" else 0.0 * specular,
                    diffuse / whole if name == "diffuse" else 0.0 * diffuse,
                )
            density[here] += specular * self._lobe_density(sample, directions[here])
            cosine = np.einsum("rk,rk->r", directions[here], self._samples.diffuse_normal[sample])
            density[here] += diffuse * np.maximum(cosine, 0.0) / np.pi
        return density

    def _sum_of_hit(self, name, hit):
        return np.bincount(self._hit, weights=self._lobes[int(name == "diffuse")])[hit]

    def _lobe_density(self, index, directions):
        samples = self._samples
        normal, view = samples.normal[index], samples.view[index]
        half = directions + view
        vertical = np.square(np.maximum(np.einsum("rk,rk->r", half, normal), 0.0))
        horizontal = np.maximum(np.square(half).sum(axis=1) - vertical, 0.0)
        alpha2 = np.square(np.maximum(samples.roughness[index] ** 2, SMALLEST_ALPHA))
        cosine = np.maximum(np.einsum("rk,rk->r", normal, view), 1e-3)
        return brdf.visible_normal_density(cosine, horizontal, vertical, alpha2)
