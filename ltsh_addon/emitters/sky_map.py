"""The sky, that is `SkyLight`s with children, as a map of all directions, for single precision.

A lobe is the sum over a few directions that cover it evenly; each gets the mean of the map around it (Krivanek and
Colbert 2008, "Real-time Shading with Filtered Importance Sampling", doi:10.1111/j.1467-8659.2008.01252.x, but with
fixed points among the visible normals). Smooth skies need fewer directions; how many is measured for each sky. The map
is interpolated between the centers of patches, so that sharp reflections show no facets. Double precision uses the
patches themselves, `light_polygons.PatchTree`.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from ..lobes.brdf import spiral, visible_directions
from ..lobes.polygon import dot
from .light_polygons import PatchTree, cached_on_children, local_frames

# Greatest and least number of texels along each side of a side of a map.
MOST_TEXELS, FEWEST_TEXELS = 256, 2
# Lobes whose rougher side has at most each of ROUGHNESS take the fewest of DIRECTIONS whose error is at most TOLERANCE
# of the sky's light (relative L2 over TRIALS lobes), compared with MANY directions.
ROUGHNESS, DIRECTIONS = (0.05, 0.15, 0.3, 0.5, 0.75, 1.0), (12, 24, 48, 96, 192)
TOLERANCE, TRIALS, MANY = 0.005, 48, 576
# Standard deviation of the mean around each direction, in units of the side of a square with its solid angle.
BLUR = 0.35


@dataclass(frozen=True)
class SkyMap:
    """Radiance (3, 6, n, n) of distant lights from all directions, in levels of which each is smoother than the one
    before. The sides of the cube are in the order of `interpolated`. Rows have `width` texels, with a border of texels
    of the neighboring sides."""

    texels: np.ndarray  # (3, T)
    width: int
    first: np.ndarray  # (N * 6,) first texel of each side of each level
    scale: np.ndarray  # (N,) half the texels along a side
    sharpest: float  # variance of the second level's blur, as an area on a cube of half side 1
    reflected: np.ndarray  # as in PatchTree
    directions: np.ndarray  # (len(ROUGHNESS),) how many lobes take

    @classmethod
    def of(cls, lights) -> "SkyMap":
        """The map of `SkyLight`s with children, made once."""
        return cached_on_children("_sky_map", lights, cls._made)

    @classmethod
    def _made(cls, lights) -> "SkyMap":
        trees = [PatchTree.of(light) for light in lights]
        grids = [_grid(tree) for tree in trees]
        side = min(max(FEWEST_TEXELS, *(grid.shape[1] for grid in grids)), MOST_TEXELS)
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
        first = np.concatenate([[0], np.cumsum(6 * (count + 2) * (side + 2))[:-1]])
        made = cls(
            np.concatenate([_in_rows(level, side + 2) for level in levels], axis=1),
            side + 2,
            (first[:, None] + np.arange(6) * ((count + 2) * (side + 2))[:, None]).ravel().astype(np.int32),
            (0.5 * count).astype(np.float32),
            0.75 * (2.0 / side) ** 2,
            sum(tree.reflected for tree in trees),
            np.empty(0),
        )
        return replace(made, directions=np.array(list(map(made._fewest, ROUGHNESS))))

    @cached_property
    def is_constant(self) -> bool:
        """True if the sky has one radiance, but for rounding."""
        return bool((np.ptp(self.texels, axis=1) <= 1e-6 * np.abs(self.texels).max(axis=1)).all())

    def _fewest(self, roughness: float) -> int:
        """The number of directions that lobes of a `roughness` need."""
        height, *turned = spiral(TRIALS).astype(np.float64)[..., 0]
        up = 1.0 - 2.0 * height
        normal = np.stack([*(np.sqrt(1.0 - up * up) * turned), up], axis=1)
        cosine = np.linspace(1.0, 0.3, TRIALS, dtype=np.float32)
        view = np.stack([np.sqrt(1.0 - cosine * cosine), 0.0 * cosine, cosine])
        frames = local_frames(normal, np.roll(normal, 7, axis=0)).astype(np.float32)

        def reflected(count):
            alphas = np.full((2, TRIALS), roughness * roughness, np.float32)
            directions, angle, weight, _ = visible_directions(spiral(count), view, alphas)
            light = (self.means(to_world(frames, directions), angle) * weight).sum(axis=1)
            return light / weight.sum(axis=0)

        exact = reflected(MANY)
        for count in DIRECTIONS[:-1]:
            if np.linalg.norm(reflected(count) - exact) <= TOLERANCE * np.linalg.norm(exact):
                return count
        return DIRECTIONS[-1]

    def counts(self, roughness: np.ndarray) -> np.ndarray:
        """How many directions lobes of `roughness` (P,) take."""
        return np.take(self.directions, np.minimum(np.searchsorted(ROUGHNESS, roughness), len(ROUGHNESS) - 1))

    def means(self, toward, area) -> np.ndarray:
        """Mean radiance (3, ...) around directions `toward` (3, ...). `area` (...) is the solid angle in sr over which
        the mean is taken, times the cube of the length of `toward`."""
        if self.is_constant:
            return np.broadcast_to(self.texels[:, :1, None], (3, *area.shape)).copy()
        x, y, z = toward
        sizes = np.abs(x), np.abs(y), np.abs(z)
        largest = np.maximum(np.maximum(*sizes[:2]), sizes[2])
        is_x, is_y = sizes[0] == largest, sizes[1] == largest
        along, s, t = (
            np.where(is_x, first, np.where(is_y, second, third))
            for first, second, third in ((x, y, z), (y, z, x), (z, x, y))
        )
        side = np.where(is_x, np.int32(0), np.where(is_y, np.int32(2), np.int32(4)))
        side += along < 0.0
        inverse = np.divide(np.float32(1.0), largest, out=largest)
        s *= inverse
        t *= inverse
        # The area on a cube of half side 1, then the nearest level.
        level = inverse * inverse
        level *= inverse
        level *= area
        np.maximum(level, np.float32(1e-30), out=level)
        np.log2(level, out=level)
        level += np.float32(np.log2(BLUR * BLUR / self.sharpest) + 1.5)
        np.clip(level, 0.0, len(self.scale) - 0.5, out=level)
        level = level.astype(np.int32)
        scale = np.take(self.scale, level, mode="clip")
        level *= 6
        level += side
        texel = np.take(self.first, level, mode="clip")
        for coordinate in (s, t):
            coordinate += np.float32(1.0)
            coordinate *= scale
            coordinate += np.float32(0.5)
        row, column = t.astype(np.int32), s.astype(np.int32)
        t -= row
        s -= column
        row *= self.width
        texel += row
        texel += column
        texel = texel.astype(np.intp)
        both = s * t
        below, right = t - both, s - both
        here = np.float32(1.0) - s - below
        radiance = np.empty((3, *s.shape), np.float32)
        for out, texels in zip(radiance, self.texels, strict=True):
            np.multiply(np.take(texels, texel, mode="clip"), here, out=out)
            for step, share in ((1, right), (self.width, below), (self.width + 1, both)):
                out += np.take(texels[step:], texel, mode="clip") * share
        return radiance


def to_world(frames, directions) -> np.ndarray:
    """Vectors (3, N, Q) in the world of local ones [x, y, z] (N, Q) in frames (3, 3, Q)."""
    x, y, z = directions
    world = frames[0][:, None] * x
    world += frames[1][:, None] * y
    world += frames[2][:, None] * z
    return world


def share_above(height, other, angle) -> np.ndarray:
    """The share (N, Q) above both of two horizons of what is above the first, for the solid angles `angle` (N, Q) in sr
    around directions with the sines `height` and `other` (N, Q) over them."""
    inverse = np.float32(1.0) / (np.sqrt(angle * np.float32(4.0 / np.pi)) + np.float32(1e-30))
    first, both = (
        np.clip(sine * inverse + np.float32(0.5), np.float32(1e-30), np.float32(1.0))
        for sine in (height, np.minimum(height, other))
    )
    return np.divide(both, first, out=both)


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
    squares = dot(tree.half_u, tree.half_u) + dot(tree.half_v, tree.half_v)
    level = np.rint(-np.log2(np.sqrt((squares / squares[0])[leaves]))).astype(int)
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
