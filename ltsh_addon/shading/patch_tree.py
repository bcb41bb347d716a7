"""Distant lights with a detail, the sky: patches of it, and a map of it.

Double precision takes patches, `PatchTree`: the coarsest that the lobe of a sample cannot resolve. Each sample gets all
of the light that is above its horizons. A patch has the mean radiance of its parts. What the mean loses is as
`light_polygons.fitting_patches` says.

Single precision takes a map of all directions, `SkyMap`: its means around so many directions as cover a lobe evenly,
whatever its width (Krivanek and Colbert 2008, "Real-time Shading with Filtered Importance Sampling",
doi:10.1111/j.1467-8659.2008.01252.x, with fixed points in the domain in which lobes are spherical harmonics). Between
the centers of patches the map is interpolated, so that sharp reflections show no facets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from ..scene import AreaLight
from .light_cone import gauss_legendre
from .light_polygons import LEAST_COSINE, LOBE_WIDTH
from .polygon import dot

# In rad: mirrors meet patches without parts, too.
LEAST_WIDTH = 1e-7
# As of `light_polygons`. The sky is all around: what patches lose on one side of a lobe they gain on another. Measured
# on skies with and without fine detail: 0.15 and 0.3 % (relative L2) off the smallest ones, with 200 patches a lobe.
PATCH_PRODUCT, LARGEST_PATCH = 0.1, 0.6
# Normals along each side of a cube's face of which the diffuse reflection is known, directions that are added at a
# time, and how large a patch is, half its diagonal in rad, for which one of them stands.
GRID, GRID_POINTS, POINT_SIZE = 33, 512, 0.04
# Samples whose patches are chosen at a time.
CHUNK = 1024
# Texels along each side of a side of a map, at most and at least.
MOST_TEXELS, FEWEST_TEXELS = 256, 2
# Directions that a lobe takes of a map, and how much denser they are at its peak: their heights are equal steps to this
# power. Measured with a window as bright as all the rest: 1.2 % (relative L2) off the smallest patches where the cosine
# of the view is at least 0.2; 0.5 % without windows.
DIRECTIONS, DENSE = 224, 0.85
# Standard deviation of what is looked up around each of them, by the side of a square of its solid angle.
BLUR = 0.6
# Samples at a time.
MAP_CHUNK = 96


@dataclass(frozen=True)
class PatchTree:
    """The N patches of a distant light, rectangles, in single precision; the first is all of it."""

    center: np.ndarray  # (3, N)
    half_u: np.ndarray  # (3, N)
    half_v: np.ndarray  # (3, N)
    radiance: np.ndarray  # (3, N) W m^-2 sr^-1
    direction: np.ndarray  # (3,) unit, toward the samples
    toward: np.ndarray  # (3, N) unit
    size: np.ndarray  # (N,) half the diagonal, by the distance of the center
    reach: np.ndarray  # (N,) rad, from the center
    largest: np.ndarray  # (N,) what the size may be, by the width of a lobe; infinite for patches without parts
    first: np.ndarray  # (N,) the first of the parts
    count: np.ndarray  # (N,) of the parts

    @classmethod
    def of(cls, light: AreaLight) -> PatchTree:
        """That of a distant rectangle, made once."""
        return _kept("_patch_tree", [light], cls._made)

    @classmethod
    def _made(cls, lights) -> PatchTree:
        (light,), first = lights, []
        patches = [light]
        for patch in patches:  # which grows meanwhile
            first.append(len(patches))
            patches += patch.detail
        count = np.array([len(patch.detail) for patch in patches])
        center, half_u, half_v, radiance = (
            np.array([getattr(patch, name) for patch in patches]).T
            for name in ("center", "half_u", "half_v", "radiance")
        )
        diagonal = np.sqrt((half_u * half_u + half_v * half_v).sum(axis=0))
        distance = np.sqrt(dot(center, center))
        # Right-handed with the direction.
        half_u *= np.copysign(1.0, np.cross(half_u[:, 0], half_v[:, 0]) @ light.direction)
        first = np.array(first)
        return cls(
            *(values.astype(np.float32) for values in (center, half_u, half_v, radiance, light.direction)),
            (center / distance).astype(np.float32),
            (diagonal / distance).astype(np.float32),
            (diagonal / np.abs(light.direction @ center)).astype(np.float32),
            _largest_sizes(diagonal, radiance, first, count),
            first,
            count,
        )

    @property
    def size_on_plane(self) -> np.ndarray:
        """Half the diagonals (N,) by that of the whole."""
        squares = dot(self.half_u, self.half_u) + dot(self.half_v, self.half_v)
        return np.sqrt(squares / squares[0])

    def places(self, toward):
        """Where directions (3, ...) meet the plane, s and t (...) along the half axes of the whole, and whether that is
        in the light."""
        whole = (self.center[:, 0], self.half_u[:, 0], self.half_v[:, 0], -self.direction)
        center, half_u, half_v, away = (vector.astype(np.float64) for vector in whole)
        ahead = np.tensordot(away, toward, 1)
        far = (away @ center) / np.where(ahead > 0.0, ahead, 1.0)
        s, t = ((np.tensordot(half, toward, 1) * far - half @ center) / (half @ half) for half in (half_u, half_v))
        return s, t, (ahead > 0.0) & (np.maximum(np.abs(s), np.abs(t)) < 1.0)

    def area_vectors(self, patch) -> np.ndarray:
        """Areas (3, Q), by the square of the distance of the plane, toward the samples."""
        half_u, half_v = self.half_u[:, patch], self.half_v[:, patch]
        lengths = 4.0 * np.sqrt(dot(half_u, half_u) * dot(half_v, half_v))
        return self.direction[:, None] * lengths.astype(np.float32)

    def corners(self, patch) -> np.ndarray:
        """Corners (3, 4, Q), counterclockwise as seen from the samples."""
        center, half_u, half_v = (values[:, patch] for values in (self.center, self.half_u, self.half_v))
        ways = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
        return np.stack([center + np.float32(s) * half_u + np.float32(t) * half_v for s, t in ways], axis=1)

    def form_factors(self, normals: np.ndarray) -> np.ndarray:
        """Radiance (3, P) that a white diffuse surface with `normals` (P, 3) reflects of all of the light, within 0.1 %
        of the largest."""
        return interpolated(self.reflected, normals)

    @cached_property
    def reflected(self) -> np.ndarray:
        """Radiance (6, GRID, GRID, 3) that white diffuse surfaces reflect, by the normal as `interpolated` has it."""
        place = np.linspace(-1.0, 1.0, GRID)
        normals = np.ones((3, 2, GRID, GRID, 3))
        for axis in range(3):
            normals[axis, 1, ..., axis] = -1.0
            normals[axis, ..., (axis + 1) % 3] = place[:, None]
            normals[axis, ..., (axis + 2) % 3] = place
        normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).reshape(-1, 3).astype(np.float32)
        result = np.zeros((len(normals), 3))
        for toward, light in self._points():
            for start in range(0, toward.shape[1], GRID_POINTS):
                part = slice(start, start + GRID_POINTS)
                result += np.maximum(normals @ toward[:, part], np.float32(0.0)) @ light[:, part].T
        return result.reshape(6, GRID, GRID, 3)

    def _points(self):
        """Yield unit directions (3, Q) and radiance times solid angle by pi (3, Q) that stand for the leaves."""
        leaves = np.flatnonzero(self.count == 0)
        steps = np.ceil(self.size[leaves] / POINT_SIZE).astype(int)
        for count in np.unique(steps):
            patch = leaves[steps == count]
            place = (np.arange(count) + 0.5) * (2.0 / count) - 1.0
            s, t = (values.ravel() for values in np.meshgrid(place, place))
            center, half_u, half_v = (values[:, patch, None] for values in (self.center, self.half_u, self.half_v))
            points = center + half_u * s + half_v * t
            squares = dot(points, points)
            flux = -(points * self.area_vectors(patch)[..., None]).sum(axis=0) / count**2
            light = self.radiance[:, patch, None] * (flux / (np.pi * squares * np.sqrt(squares)))
            yield (
                (points / np.sqrt(squares)).reshape(3, -1).astype(np.float32),
                light.reshape(3, -1).astype(np.float32),
            )

    def pairs(self, samples, horizons, index: np.ndarray, is_specular: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield (columns (Q,) of `index`, patches (Q,)) of the samples `index` (M,), whose lobes end at the `horizons`,
        normals (P, 3)."""
        for start in range(0, len(index), CHUNK):
            part = index[start : start + CHUNK]
            normals = [np.ascontiguousarray(normal[part].T, np.float32) for normal in horizons]
            peak = _Peaks(samples, part) if is_specular else None
            column, patch = np.arange(len(part)), np.zeros(len(part), np.intp)
            while len(column):
                above = np.ones(len(column), bool)
                toward = self.toward[:, patch]
                for normal in normals:
                    above &= dot(np.take(normal, column, axis=1), toward) > -self.reach[patch]
                column, patch, toward = column[above], patch[above], toward[:, above]
                size = self.size[patch]
                fits = size < self.largest[patch] * (1.0 if peak is None else peak.lengths(column, toward, size))
                if fits.any():
                    yield start + column[fits], patch[fits]
                column, patch = column[~fits], patch[~fits]
                count = self.count[patch]
                ends = np.cumsum(count)
                number = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - count, count)
                column, patch = np.repeat(column, count), np.repeat(self.first[patch], count) + number


class _Peaks:
    """Where the specular lobes of Q samples are narrowest."""

    def __init__(self, samples, index):
        normal, view = (np.ascontiguousarray(values[index].T, np.float32) for values in (samples.normal, samples.view))
        cosine = dot(normal, view)
        self.mirrored = np.float32(2.0) * cosine * normal - view
        alpha = np.square(samples.sharpest_roughness[index].astype(np.float32))
        width = alpha * np.maximum(np.abs(cosine), LEAST_COSINE)
        self.width = np.maximum(LOBE_WIDTH * width, LEAST_WIDTH).astype(np.float32)

    def lengths(self, column, toward, size) -> np.ndarray:
        """The least angle (R,) in rad, at most 1, over which lobes change where they meet patches."""
        chord = np.sqrt(np.maximum(np.float32(2.0) - np.float32(2.0) * dot(self.mirrored[:, column], toward), 0.0))
        return np.minimum(np.maximum(chord - size, np.float32(0.0)) + self.width[column], np.float32(1.0))


def _largest_sizes(diagonal, radiance, first, count) -> np.ndarray:
    """What sizes may be (N,): by the contrast, which is how much the parts of a patch differ from it, by the whole."""
    area, brightness = diagonal * diagonal, np.abs(radiance[:, 0]).sum()
    owner = np.repeat(np.arange(len(count)), count)
    part = np.arange(1, len(count))
    different = area[part] * np.abs(radiance[:, part] - radiance[:, owner]).sum(axis=0)
    contrast = np.bincount(owner, different, len(count)) / np.maximum(area * brightness, 1e-30)
    largest = np.minimum(np.sqrt(PATCH_PRODUCT / np.maximum(contrast, 1e-9)), LARGEST_PATCH)
    return np.where(count == 0, np.inf, largest).astype(np.float32)


def _kept(name, lights, made):
    """What made(lights) gives, kept with the parts of the first of them, which copies of it share."""
    key = [light.detail[0] for light in lights], [(*light.center, *light.radiance) for light in lights]
    kept = vars(lights[0].detail[0])
    old = kept.get(name)
    is_same = old is not None and old[0][1] == key[1] and all(map(lambda one, two: one is two, old[0][0], key[0]))
    if not is_same:
        kept[name] = key, made(lights)
    return kept[name][1]


def interpolated(grid: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Values (3, P) for `normals` (P, 3) from those of a grid (6, GRID, GRID, 3) on a cube: of sides +x, -x, +y ...,
    along the two axes that follow."""
    size = len(grid[0])
    axis = np.argmax(np.abs(normals), axis=1)
    rows = np.arange(len(normals))
    along = normals[rows, axis]
    face = 2 * axis + (along < 0.0)
    places = [
        np.clip((normals[rows, (axis + step) % 3] / np.abs(along) + 1.0) * 0.5 * (size - 1), 0.0, size - 1.0)
        for step in (1, 2)
    ]
    lows = [np.minimum(place.astype(np.intp), size - 2) for place in places]
    (s, t), (i, j) = [place - low for place, low in zip(places, lows, strict=True)], lows
    near = grid[face, i, j] * (1.0 - t)[:, None] + grid[face, i, j + 1] * t[:, None]
    far = grid[face, i + 1, j] * (1.0 - t)[:, None] + grid[face, i + 1, j + 1] * t[:, None]
    return (near * (1.0 - s)[:, None] + far * s[:, None]).T


@dataclass(frozen=True)
class SkyMap:
    """Radiance (3, 6, n, n) of distant lights from all directions, by the side of a cube as `interpolated` has them, in
    levels, each smoother than the one before it: rows of `width` texels, with a border of those of the other sides."""

    texels: np.ndarray  # (3, T)
    width: int
    first: np.ndarray  # (N,) texel of levels
    rows: np.ndarray  # (N,) of a side
    scale: np.ndarray  # (N,) half the texels along a side
    sharpest: float  # area on a cube of half side 1 over which the second level is smooth, a standard deviation squared
    reflected: np.ndarray  # as of PatchTree
    nodes: tuple[np.ndarray, np.ndarray]  # see `_nodes`; LAPACK need not give the same last bits in every process

    @classmethod
    def of(cls, lights) -> SkyMap:
        """That of distant AreaLights with a detail, made once."""
        return _kept("_sky_map", lights, cls._made)

    @classmethod
    def _made(cls, lights) -> SkyMap:
        trees = [PatchTree.of(light) for light in lights]
        grids = [_grid(tree) for tree in trees]
        side = min(max(grid.shape[1] for grid in grids), MOST_TEXELS)
        directions = _cells(side)
        radiance, angle = np.zeros((3, 6, side, side)), dot(directions, directions) ** -1.5
        for tree, grid in zip(trees, grids, strict=True):
            s, t, seen = tree.places(directions)
            row, column = (np.minimum((0.5 * (place[seen] + 1.0) * grid.shape[1]).astype(int), grid.shape[1] - 1)
                           for place in (t, s))  # fmt: skip
            radiance[:, seen] += grid[:, row, column]
        levels = [radiance]
        while True:
            # With the interpolation between texels the variances are 3/4 and 3/2 of their square.
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

    def means(self, toward, area) -> np.ndarray:
        """Mean radiance (3, ...) around directions `toward` (3, ...), by the `area` (...) around each: a solid angle in
        sr times the cube of the length of `toward`."""
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
        # From here on the area on a cube of half side 1, then the level.
        level = inverse * inverse
        level *= inverse
        level *= area
        np.log2(level, out=level)
        level += np.float32(np.log2(BLUR * BLUR / self.sharpest) + 1.0)
        np.clip(level, 0.0, len(self.first) - 1.001, out=level)
        low = level.astype(np.intp)
        level -= low
        found = self._at(low, face, s, t)
        low += 1
        more = self._at(low, face, s, t)
        more -= found
        more *= level
        found += more
        return found

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
        found = np.empty((3, *s.shape), np.float32)
        for out, texels in zip(found, self.texels, strict=True):
            np.multiply(np.take(texels, row), here, out=out)
            out += np.take(texels[1:], row) * right
            out += np.take(texels[self.width :], row) * below
            out += np.take(texels[self.width + 1 :], row) * both
        return found

    def add(self, lobes, chosen: np.ndarray, total: np.ndarray) -> None:
        """Add to total (F, 3, Q) what the columns `chosen` (Q',) of `float32.Lobes` reflect of the sky."""
        nodes, angle = self.nodes
        for start in range(0, len(chosen), MAP_CHUNK):
            part = chosen[start : start + MAP_CHUNK]
            first, second, third = (lobes.rows[row][:, part] for row in range(3))
            axes = _cross(second, third), _cross(third, first), _cross(first, second)
            determinant = dot(first, axes[0])
            stretch = _stretch(axes)
            directions = [nodes[0] * stretch, nodes[1] / stretch, nodes[2]]
            inverse = np.float32(1.0) / np.sqrt(dot(directions, directions))
            directions = [place * inverse for place in directions]
            own = angle * (inverse * inverse * inverse)
            # The world direction of each node, by the inverse of the lobe's axes but for a factor.
            toward = sum(place * axis[:, None] for place, axis in zip(directions, axes, strict=True))
            area = own * (determinant * determinant)
            values = lobes.at_point.at_nodes(part, directions, toward) * own
            if len(lobes.clip_rows) > 1:
                values = values * _share_above(lobes, part, toward, area)
            radiance = self.means(toward, area)
            for value, target in zip(values, total, strict=True):
                for channel in range(3):
                    target[channel, part] += (value * radiance[channel]).sum(axis=0)


def _stretch(axes):
    """By what (Q,) to multiply directions along the first of the axes (3, Q) of lobes, and to divide them along the
    second, so that what they cover is about round in the world: the root of what would make it so."""
    across = _cross(axes[0], axes[2])
    squares = dot(across, across) / (dot(axes[1], axes[1]) * dot(axes[2], axes[2]))
    return squares ** np.float32(-0.125)


def _share_above(lobes, part, toward, area) -> np.ndarray:
    """Which share (N, Q) of the `area` around directions (3, N, Q) is above the horizons of lobes but their own."""
    squares = dot(toward, toward)
    radius = np.sqrt(area / (np.float32(np.pi) * np.sqrt(squares)))
    share = np.float32(1.0)
    for row in lobes.clip_rows:
        if row != 2:
            height = dot(lobes.rows[row][:, None, part], toward) / (lobes.lengths[row][part] * radius)
            share = share * np.clip(np.float32(0.5) + np.float32(0.5) * height, np.float32(0.0), np.float32(1.0))
    return share


def _nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3, N, 1) above z = 0 and the solid angles (N, 1) around them, sums over which are exact for
    polynomials of degree 4: a spiral of golden angles."""
    number = np.arange(count) + 0.5
    z = (1.0 - number / count) ** DENSE
    turn = np.pi * (np.sqrt(5.0) - 1.0) * number
    nodes = np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z])
    angle = -2.0 * np.pi * np.diff((1.0 - np.arange(count + 1) / count) ** DENSE)
    place, weight = gauss_legendre(6)
    high, around = np.meshgrid(0.5 * (place + 1.0), 0.25 * np.pi * np.arange(8), indexing="ij")
    wide = np.sqrt(1.0 - high * high)
    exact = np.stack([wide * np.cos(around), wide * np.sin(around), high]).reshape(3, -1)
    weight = np.repeat(weight, 8) * (np.pi / 8.0)
    powers = [(i, j, k) for i in range(5) for j in range(min(5 - i, 2)) for k in range(5 - i - j)]
    moments, wanted = (
        np.array([np.prod([vector**power for vector, power in zip(vectors, own, strict=True)], axis=0)
                  for own in powers]) for vectors in (nodes, exact)
    )  # fmt: skip
    change = np.linalg.lstsq(moments * angle, wanted @ weight - moments @ angle, rcond=None)[0]
    return nodes[:, :, None].astype(np.float32), (angle * (1.0 + change))[:, None].astype(np.float32)


def _cross(a, b):
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _cells(count: int, more: int = 0) -> np.ndarray:
    """Centers (3, 6, n, n) of `count` texels along each side of the sides of a cube, and of `more` around them."""
    place = (np.arange(-more, count + more) + 0.5) * (2.0 / count) - 1.0
    t, s = np.meshgrid(place, place, indexing="ij")
    found = np.empty((3, 6, *s.shape))
    for axis in range(3):
        found[axis, 2 * axis], found[axis, 2 * axis + 1] = 1.0, -1.0
        found[(axis + 1) % 3, 2 * axis : 2 * axis + 2], found[(axis + 2) % 3, 2 * axis : 2 * axis + 2] = s, t
    return found


@cache
def _bordered(count: int) -> np.ndarray:
    """Texels (6, n + 2, n + 2), numbers of those of the sides of a cube, with those of the other sides around."""
    directions = _cells(count, 1)
    axis = np.argmax(np.abs(directions), axis=0)
    along, s, t = (np.take_along_axis(directions, ((axis + step) % 3)[None], axis=0)[0] for step in range(3))
    row, column = (np.clip((0.5 * (place / np.abs(along) + 1.0) * count).astype(int), 0, count - 1) for place in (t, s))
    return ((2 * axis + (along < 0.0)) * count + row) * count + column


def _with_border(radiance):
    """Radiance (3, 6, n + 2, n + 2) from that (3, 6, n, n) of the texels of a cube."""
    return radiance.reshape(3, -1)[:, _bordered(radiance.shape[2])]


def _blurred(radiance, variance):
    """Radiance (3, 6, n, n) with a variance added, at most 1/2 of the square of a texel."""
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
    """Radiance (3, n, n) of a light cut into halves and halves again, by place along half_v and half_u: between the
    centers of patches it changes evenly, and they keep their means."""
    leaves = np.flatnonzero(tree.count == 0)
    s, t, _ = tree.places(tree.center[:, leaves])
    level = np.rint(-np.log2(tree.size_on_plane[leaves])).astype(int)
    finest = int(level.max())
    row, column = ((0.5 * (place + 1.0) * 2.0**level).astype(int) for place in (t, s))
    means, known = [], []
    for own in range(finest, -1, -1):
        if own == finest:
            mean, cut = np.zeros((3, 2**own, 2**own)), np.zeros((2**own, 2**own))
        else:
            mean, cut = 0.25 * _sums_of_four(means[-1]), _sums_of_four(known[-1])
        here = level == own
        mean[:, row[here], column[here]], cut[row[here], column[here]] = tree.radiance[:, leaves[here]], 1.0
        means.append(mean)
        known.append(cut)
    grid = means.pop()
    for mean, cut in zip(means[::-1], known[-2::-1], strict=True):
        grid = np.where(cut > 0.0, mean, _doubled(grid))
    return grid


def _doubled(grid):
    """Values (3, 2 n, 2 n) from those (3, n, n): each changes as its neighbors do, where those on both sides agree."""
    around = np.pad(grid, ((0, 0), (1, 1), (1, 1)), mode="edge")
    found = np.empty((3, 2 * grid.shape[1], 2 * grid.shape[2]))
    steps = []
    for before, after in ((around[:, :-2, 1:-1], around[:, 2:, 1:-1]), (around[:, 1:-1, :-2], around[:, 1:-1, 2:])):
        one, other = grid - before, after - grid
        least = np.where(np.abs(one) < np.abs(other), one, other)
        steps.append(np.where(one * other > 0.0, 0.25 * least, 0.0))
    for i, way in enumerate((-1.0, 1.0)):
        for j, other_way in enumerate((-1.0, 1.0)):
            found[:, i::2, j::2] = grid + way * steps[0] + other_way * steps[1]
    return found
