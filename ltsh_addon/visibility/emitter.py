"""`Emitter`: the quadrilateral at which directions to a light aim, and where the light is bright in it.

Where a round, polygonal or textured light leaves the quadrilateral dark, the direction has the weight 0.
`Sky` is the emitter of all sides of a sky.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..emitters import light_profile
from ..emitters.light_polygons import cached_on_children
from ..lobes.polygon import convex_pieces, dot, normal_frames
from ..scene import Light, PolygonLight

_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# Cells along each side of the picture of a textured light.
_PICTURE = 128
# Corners of the outline of an ellipse
_ROUND_CORNERS = 16


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
            self._picture = cached_on_children("_picture", [light], lambda lights: picture_of(light, self._places))
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
    outlines = [patch.polygon() for patch in light.leaves]
    ends = np.cumsum([len(outline) for outline in outlines])[:-1]
    places = np.split(places_of(np.concatenate(outlines) - light.center), ends)
    for patch, outline in zip(light.leaves, places, strict=True):
        columns, rows = (slice(*np.searchsorted(grid, (axis.min(), axis.max()))) for axis in outline.T)
        cells = picture[rows, columns]
        cells[_inside(outline, *np.meshgrid(grid[columns], grid[rows]))] = np.abs(patch.radiance).mean() / mean
    return picture


# CELLS: cells along each edge of a side of the sky. NEXT_TO: distance from a sample to the plane that stands for the
# sky, in units of half the plane's side.
CELLS, NEXT_TO = 64, 1e-3


class Sky(Emitter):
    """The sides of a cube as one emitter. Its `light` has their mean radiance; its shape is a mere placeholder."""

    def __init__(self, sides: Sequence[Light]):
        ahead = np.repeat(np.eye(3), 2, axis=0)
        ahead[1::2] *= -1.0
        axes = np.stack([ahead, np.roll(ahead, 1, axis=1), np.roll(ahead, 2, axis=1)])
        values, radiance = np.zeros((6, CELLS, CELLS)), np.zeros(3)
        for side in sides:
            axis = int(np.argmax(np.abs(side.center)))
            slot = 2 * axis + int(side.center[axis] < 0.0)
            axes[1:, slot] = side.half_u, side.half_v
            values[slot] = np.abs(side.radiance).mean() * _cells_of(side)
            radiance += side.radiance / 6.0
        # Ahead, right and up (3, 6) of each side: the component that is not 0, and its sign.
        self.component, self.sign = np.abs(axes).argmax(axis=2), axes.sum(axis=2).astype(np.float32)
        middles = (np.arange(CELLS) + 0.5) * (2.0 / CELLS) - 1.0
        angles = (4.0 / CELLS**2) * (1.0 + middles[:, None] ** 2 + middles**2) ** -1.5
        power = (values * angles).ravel()
        self.pmf = (power / power.sum()).astype(np.float32)
        self.ends = np.cumsum(power / power.sum()).astype(np.float32)
        self.values = (values / max(np.abs(radiance).mean(), 1e-30)).astype(np.float32).ravel()
        self.is_constant = np.ptp(values) <= 1e-6 * values.max()
        right, up, away = np.eye(3)
        shape = {"center": NEXT_TO * away, "half_u": right, "half_v": up, "direction": -away}
        super().__init__(replace(sides[0], **shape, radiance=radiance, children=()))
        self.selected_as = tuple(sides)

    def directions(self, x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Unit vectors (3, S, Q) for numbers (S, Q) in [0, 1). Half of them follow the brightness of the sky; those
        below the horizon of `normal` (3, Q) are mirrored. The other half follow the cosine, as all do where the sky is
        constant."""
        if self.is_constant:
            return _by_cosine(x, y, normal)
        by_picture = x < np.float32(0.5)
        x = np.where(by_picture, np.float32(2.0) * x, np.float32(2.0) * x - _ONE)
        directions, flat = _by_cosine(x, y, normal), np.flatnonzero(by_picture)
        chosen = self._by_picture(x.ravel()[flat], y.ravel()[flat], np.take(normal, flat % normal.shape[1], axis=1))
        directions.reshape(3, -1)[:, flat] = chosen
        return directions

    def _by_picture(self, x, y, normal):
        """Unit vectors (3, R) for numbers and normals of their own (R,), (3, R)."""
        cell = np.minimum(np.searchsorted(self.ends, x), len(self.ends) - 1)
        share = (x - (self.ends[cell] - self.pmf[cell])) / np.maximum(self.pmf[cell], np.float32(1e-30))
        slot, cell_of_side = np.divmod(cell, CELLS * CELLS)
        row, column = np.divmod(cell_of_side, CELLS)
        step = np.float32(2.0 / CELLS)
        s = (column.astype(np.float32) + np.clip(share, _ZERO, _ONE)) * step - _ONE
        t = (row.astype(np.float32) + y) * step - _ONE
        directions = np.empty((3, len(x)), np.float32)
        for component, sign, size in zip(self.component, self.sign, (_ONE, s, t), strict=True):
            directions[component[slot], np.arange(len(x))] = sign[slot] * size
        directions /= np.sqrt(dot(directions, directions))
        below = np.minimum(dot(directions, normal), _ZERO)
        below *= np.float32(-2.0)
        directions += below * normal
        return directions

    def along(self, directions: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Probability density (S, Q) per sr of unit directions (3, S, Q), 0 below the horizon of `normal`, and the
        radiance as factors (S, Q) of its mean, or 1."""
        height = dot(directions, normal[:, None])
        if self.is_constant:
            return np.maximum(height, _ZERO) * np.float32(1.0 / np.pi), _ONE
        mirrored = directions - np.float32(2.0) * height * normal[:, None]
        (density, cell), (other, _) = self._by_cells(directions), self._by_cells(mirrored)
        density += other
        density += np.maximum(height, _ZERO) * np.float32(1.0 / np.pi)
        density *= np.float32(0.5) * (height > _ZERO)
        return density, self.values[cell]

    def _by_cells(self, directions):
        """Density (S, Q) of unit directions (3, S, Q) by the picture alone, and the numbers (S, Q) of their cells."""
        sizes = np.abs(directions)
        along = np.maximum(np.maximum(sizes[0], sizes[1]), sizes[2])
        slot = np.where(sizes[0] == along, 0, np.where(sizes[1] == along, 2, 4)).ravel()
        # Component k of the ray n is at the place k R + n.
        flat, ray = directions.ravel(), np.arange(along.size)
        slot += flat[(slot >> 1) * along.size + ray] < _ZERO
        cell = slot.reshape(along.shape)
        for component, sign in zip(self.component[:0:-1] * along.size, self.sign[:0:-1], strict=True):
            coordinate = (sign[slot] * flat[component[slot] + ray]).reshape(along.shape) / along
            coordinate += _ONE
            coordinate *= np.float32(CELLS / 2.0)
            cell = cell * CELLS + np.clip(coordinate, 0, CELLS - 1, out=coordinate).astype(np.intp)
        return self.pmf[cell] * np.float32(CELLS * CELLS / 4.0) / (along * along * along), cell


def _by_cosine(x, y, normal):
    """Unit vectors (3, S, Q) around normals (3, Q), distributed as the cosine."""
    tangent, bitangent, _ = normal_frames(normal)[:, :, None]
    radius, angle = np.sqrt(x), np.float32(2.0 * np.pi) * y
    directions = radius * np.cos(angle) * tangent + radius * np.sin(angle) * bitangent
    directions += np.sqrt(_ONE - x) * normal[:, None]
    return directions


def _cells_of(side: Light) -> np.ndarray:
    """Brightness (CELLS, CELLS) in units of the mean; rows along half_v, columns along half_u."""
    if not side.children:
        return np.ones((CELLS, CELLS))

    def made(_):
        axes = np.linalg.pinv(np.stack([side.half_u, side.half_v]))
        picture = picture_of(side, lambda offset: offset @ axes)
        step = len(picture) // CELLS
        return picture.reshape(CELLS, step, CELLS, step).mean(axis=(1, 3))

    return cached_on_children("_cells", [side], made)
