"""The sky, that is `SkyLight`s with children, as a map of all directions, for single precision.

A lobe is integrated over a fixed number of directions that cover it evenly, whatever its width; each gets the mean of
the map around it (Krivanek and Colbert 2008, "Real-time Shading with Filtered Importance Sampling",
doi:10.1111/j.1467-8659.2008.01252.x, but with fixed points in the domain in which lobes are spherical harmonics). The
map is interpolated between the centers of patches, so that sharp reflections show no facets. Double precision uses the
patches themselves, `light_polygons.PatchTree`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ..lobes.polygon import cross, dot
from .light_polygons import PatchTree, cached_on_children
from .light_profile import gauss_legendre

# Greatest and least number of texels along each side of a side of a map.
MOST_TEXELS, FEWEST_TEXELS = 256, 2
# DIRECTIONS: how many a lobe takes of a map. DENSE: how much denser they are at its peak; their heights are equal steps
# to this power. Off as many as one likes (relative L2): 0.1 % under a gradient, 0.4 % with a window six times as bright
# as all the rest, 1.5 % with one thirty times as bright.
DIRECTIONS, DENSE = 160, 0.85
# Standard deviation of the mean around each direction, in units of the side of a square with its solid angle.
BLUR = 0.45
# Samples per chunk.
MAP_CHUNK = 128


@dataclass(frozen=True)
class SkyMap:
    """Radiance (3, 6, n, n) of distant lights from all directions, in levels of which each is smoother than the one
    before. The sides of the cube are in the order of `interpolated`. Rows have `width` texels, with a border of texels
    of the neighboring sides."""

    texels: np.ndarray  # (3, T)
    width: int
    first: np.ndarray  # (N,) first texel of each level
    rows: np.ndarray  # (N,) rows of a side
    scale: np.ndarray  # (N,) half the texels along a side
    sharpest: float  # variance of the second level's blur, as an area on a cube of half side 1
    reflected: np.ndarray  # as in PatchTree
    nodes: tuple[np.ndarray, ...]  # see `_nodes`; LAPACK need not give the same last bits in every process

    @classmethod
    def of(cls, lights) -> SkyMap:
        """The map of `SkyLight`s with children, made once."""
        return cached_on_children("_sky_map", lights, cls._made)

    @classmethod
    def _made(cls, lights) -> SkyMap:
        trees = [PatchTree.of(light) for light in lights]
        grids = [_grid(tree) for tree in trees]
        side = min(max(grid.shape[1] for grid in grids), MOST_TEXELS)
        directions = _cells(side)
        radiance, angle = np.zeros((3, 6, side, side)), dot(directions, directions) ** -1.5
        for tree, grid in zip(trees, grids, strict=True):
            s, t, inside = tree.places(directions)
            row, column = (np.minimum((0.5 * (coordinate[inside] + 1.0) * grid.shape[1]).astype(int), grid.shape[1] - 1)
                           for coordinate in (t, s))  # fmt: skip
            radiance[:, inside] += grid[:, row, column]
        levels = [radiance]
        while True:
            # With the interpolation between texels, the variances are 3/4 and 3/2 of the square of a texel.
            levels += [_blurred(radiance, 0.5), _blurred(_blurred(_blurred(radiance, 0.5), 0.5), 0.25)]
            if len(radiance[0, 0]) == FEWEST_TEXELS:
                break
            wide = _sums_of_four(angle)
            radiance, angle = _sums_of_four(radiance * angle) / wide, wide
        count = np.array([level.shape[2] for level in levels])
        return cls(
            np.concatenate([_in_rows(level, side + 2) for level in levels], axis=1),
            side + 2,
            np.concatenate([[0], np.cumsum(6 * (count + 2) * (side + 2))[:-1]]),
            count + 2,
            (0.5 * count).astype(np.float32),
            0.75 * (2.0 / side) ** 2,
            sum(tree.reflected for tree in trees),
            _nodes(DIRECTIONS),
        )

    def _directions(self, rows):
        """For lobes with the axes `rows` (3, 3, Q): directions along them (3, N, Q), the same in the world up to a
        factor, their weights (N, Q), and the solid angles around them as in `means`."""
        nodes, angle, weight = self.nodes
        first, second, third = rows
        axes = cross(second, third), cross(third, first), cross(first, second)
        determinant = dot(first, axes[0])
        stretch = _stretch(axes)
        directions = [nodes[0] * stretch, nodes[1] / stretch, nodes[2]]
        inverse = np.float32(1.0) / np.sqrt(dot(directions, directions))
        directions = [coordinate * inverse for coordinate in directions]
        inverse *= inverse * inverse
        # The inverse of the lobe's axes gives the world direction up to a factor.
        toward = sum(coordinate * axis[:, None] for coordinate, axis in zip(directions, axes, strict=True))
        return directions, toward, weight * inverse, (angle * inverse) * (determinant * determinant)

    def means(self, toward, area) -> np.ndarray:
        """Mean radiance (3, ...) around directions `toward` (3, ...). `area` (...) is the solid angle in sr over which
        the mean is taken, times the cube of the length of `toward`."""
        x, y, z = toward
        size_x, size_y, size_z = np.abs(toward)
        is_x, is_y = (size_x >= size_y) & (size_x >= size_z), size_y >= size_z
        along, s, t = (
            np.where(is_x, first, np.where(is_y, second, third))
            for first, second, third in ((x, y, z), (y, z, x), (z, x, y))
        )
        face = np.where(is_x, np.int8(0), np.where(is_y, np.int8(2), np.int8(4))) + (along < 0.0)
        inverse = np.float32(1.0) / np.abs(along)
        s *= inverse
        t *= inverse
        # The area on a cube of half side 1, then the level.
        level = inverse * inverse
        level *= inverse
        level *= area
        np.log2(level, out=level)
        level += np.float32(np.log2(BLUR * BLUR / self.sharpest) + 1.0)
        np.clip(level, 0.0, len(self.first) - 1.001, out=level)
        low = level.astype(np.intp)
        level -= low
        radiance = self._at(low, face, s, t)
        low += 1
        coarser = self._at(low, face, s, t)
        coarser -= radiance
        coarser *= level
        radiance += coarser
        return radiance

    def _at(self, level, face, s, t) -> np.ndarray:
        """Radiance (3, ...) of a level (...) at s, t (...) of a side of the cube."""
        scale = np.take(self.scale, level)
        half = scale + np.float32(0.5)
        s, t = s * scale, t * scale
        s += half
        t += half
        row, column = t.astype(np.intp), s.astype(np.intp)
        t -= row
        s -= column
        row += face * np.take(self.rows, level)
        row *= self.width
        row += column
        row += np.take(self.first, level)
        both = s * t
        below, right = t - both, s - both
        here = np.float32(1.0) - s - below
        radiance = np.empty((3, *s.shape), np.float32)
        for out, texels in zip(radiance, self.texels, strict=True):
            np.multiply(np.take(texels, row), here, out=out)
            out += np.take(texels[1:], row) * right
            out += np.take(texels[self.width :], row) * below
            out += np.take(texels[self.width + 1 :], row) * both
        return radiance

    def add(self, lobes, chosen: np.ndarray, total: np.ndarray) -> None:
        """Add what the columns `chosen` (Q',) of `lobes32.Lobes` reflect of the sky to `total` (F, 3, Q)."""
        for start in range(0, len(chosen), MAP_CHUNK):
            columns = chosen[start : start + MAP_CHUNK]
            directions, toward, weight, area = self._directions(lobes.rows[:3, :, columns])
            values = lobes.at_point.at_nodes(columns, directions, toward, weight)
            if len(lobes.clip_rows) > 1:
                values = values * _share_above(lobes, columns, toward, area)
            radiance = self.means(toward, area)
            for value, target in zip(values, total, strict=True):
                for channel in range(3):
                    target[channel, columns] += (value * radiance[channel]).sum(axis=0)


def _stretch(axes):
    """Factor (Q,) by which directions are stretched along the first axis (3, Q) of lobes and shrunk along the second.
    It is the root of the factor that would make the area they cover round in the world."""
    across = cross(axes[0], axes[2])
    squares = dot(across, across) / (dot(axes[1], axes[1]) * dot(axes[2], axes[2]))
    return squares ** np.float32(-0.125)


def _share_above(lobes, columns, toward, area) -> np.ndarray:
    """Share (N, Q) of the `area` around directions (3, N, Q) above the horizons of lobes, except for their own."""
    squares = dot(toward, toward)
    radius = np.sqrt(area / (np.float32(np.pi) * np.sqrt(squares)))
    share = np.float32(1.0)
    for row in lobes.clip_rows:
        if row != 2:
            height = dot(lobes.rows[row][:, None, columns], toward) / (lobes.lengths[row][columns] * radius)
            share = share * np.clip(np.float32(0.5) + np.float32(0.5) * height, np.float32(0.0), np.float32(1.0))
    return share


def _nodes(count: int) -> tuple[np.ndarray, ...]:
    """Unit vectors (3, N, 1) above z = 0, a spiral of golden angles, the solid angles (N, 1) around them, and weights
    (N, 1), close to these, with which sums are exact for polynomials of degree 4."""
    number = np.arange(count) + 0.5
    z = (1.0 - number / count) ** DENSE
    turn = np.pi * (np.sqrt(5.0) - 1.0) * number
    nodes = np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z])
    angle = -2.0 * np.pi * np.diff((1.0 - np.arange(count + 1) / count) ** DENSE)
    abscissa, weight = gauss_legendre(6)
    high, around = np.meshgrid(0.5 * (abscissa + 1.0), 0.25 * np.pi * np.arange(8), indexing="ij")
    wide = np.sqrt(1.0 - high * high)
    exact = np.stack([wide * np.cos(around), wide * np.sin(around), high]).reshape(3, -1)
    weight = np.repeat(weight, 8) * (np.pi / 8.0)
    powers = [(i, j, k) for i in range(5) for j in range(min(5 - i, 2)) for k in range(5 - i - j)]
    moments, wanted = (
        np.array([np.prod([vector**power for vector, power in zip(vectors, exponents, strict=True)], axis=0)
                  for exponents in powers]) for vectors in (nodes, exact)
    )  # fmt: skip
    change = np.linalg.lstsq(moments * angle, wanted @ weight - moments @ angle, rcond=None)[0]
    return tuple(values[..., None].astype(np.float32) for values in (nodes, angle, angle * (1.0 + change)))


def _cells(count: int, more: int = 0) -> np.ndarray:
    """Centers (3, 6, n, n) of `count` texels along each side of the sides of a cube, and of `more` texels around
    them."""
    coordinate = (np.arange(-more, count + more) + 0.5) * (2.0 / count) - 1.0
    t, s = np.meshgrid(coordinate, coordinate, indexing="ij")
    directions = np.empty((3, 6, *s.shape))
    for axis in range(3):
        directions[axis, 2 * axis], directions[axis, 2 * axis + 1] = 1.0, -1.0
        directions[(axis + 1) % 3, 2 * axis : 2 * axis + 2], directions[(axis + 2) % 3, 2 * axis : 2 * axis + 2] = s, t
    return directions


@cache
def _bordered(count: int) -> np.ndarray:
    """Numbers (6, n + 2, n + 2) of the texels of the sides of a cube, with texels of the neighboring sides around."""
    directions = _cells(count, 1)
    axis = np.argmax(np.abs(directions), axis=0)
    along, s, t = (np.take_along_axis(directions, ((axis + step) % 3)[None], axis=0)[0] for step in range(3))
    row, column = (
        np.clip((0.5 * (coordinate / np.abs(along) + 1.0) * count).astype(int), 0, count - 1) for coordinate in (t, s)
    )
    return ((2 * axis + (along < 0.0)) * count + row) * count + column


def _with_border(radiance):
    """Radiance (3, 6, n + 2, n + 2) with a border, from radiance (3, 6, n, n) of the texels of a cube."""
    return radiance.reshape(3, -1)[:, _bordered(radiance.shape[2])]


def _blurred(radiance, variance):
    """Radiance (3, 6, n, n) blurred by `variance`, at most 1/2, in units of the square of a texel."""
    values, share = _with_border(radiance), 0.5 * variance
    values = (1.0 - variance) * values[:, :, 1:-1] + share * (values[:, :, :-2] + values[:, :, 2:])
    return (1.0 - variance) * values[..., 1:-1] + share * (values[..., :-2] + values[..., 2:])


def _in_rows(radiance, width):
    """Texels (3, T) of a level, in rows of `width`."""
    values = _with_border(radiance)
    values = np.pad(values, ((0, 0), (0, 0), (0, 0), (0, width - values.shape[3])))
    return np.ascontiguousarray(values.reshape(3, -1), np.float32)


def _sums_of_four(values):
    """Sums (..., n / 2, n / 2) over squares of 2 x 2."""
    rows = values[..., 0::2, :] + values[..., 1::2, :]
    return rows[..., 0::2] + rows[..., 1::2]


def _grid(tree: PatchTree) -> np.ndarray:
    """Radiance (3, n, n) of a light that was halved repeatedly, by place along half_v and half_u. It changes smoothly
    between the centers of patches, and patches keep their means."""
    leaves = np.flatnonzero(tree.count == 0)
    s, t, _ = tree.places(tree.center[:, leaves])
    level = np.rint(-np.log2(tree.size_on_plane[leaves])).astype(int)
    finest = int(level.max())
    row, column = ((0.5 * (coordinate + 1.0) * 2.0**level).astype(int) for coordinate in (t, s))
    means, known = [], []
    for depth in range(finest, -1, -1):
        if depth == finest:
            mean, cut = np.zeros((3, 2**depth, 2**depth)), np.zeros((2**depth, 2**depth))
        else:
            mean, cut = 0.25 * _sums_of_four(means[-1]), _sums_of_four(known[-1])
        here = level == depth
        mean[:, row[here], column[here]], cut[row[here], column[here]] = tree.radiance[:, leaves[here]], 1.0
        means.append(mean)
        known.append(cut)
    grid = means.pop()
    for mean, cut in zip(means[::-1], known[-2::-1], strict=True):
        grid = np.where(cut > 0.0, mean, _doubled(grid))
    return grid


def _doubled(grid):
    """Values (3, 2 n, 2 n) from values (3, n, n). Each gets a slope where its neighbors on both sides agree on one."""
    around = np.pad(grid, ((0, 0), (1, 1), (1, 1)), mode="edge")
    fine = np.empty((3, 2 * grid.shape[1], 2 * grid.shape[2]))
    steps = []
    for before, after in ((around[:, :-2, 1:-1], around[:, 2:, 1:-1]), (around[:, 1:-1, :-2], around[:, 1:-1, 2:])):
        one, other = grid - before, after - grid
        least = np.where(np.abs(one) < np.abs(other), one, other)
        steps.append(np.where(one * other > 0.0, 0.25 * least, 0.0))
    for i, way in enumerate((-1.0, 1.0)):
        for j, other_way in enumerate((-1.0, 1.0)):
            fine[:, i::2, j::2] = grid + way * steps[0] + other_way * steps[1]
    return fine
