"""UV maps: which face a texel lies on, and where the surface goes on beyond a seam."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..lobes.polygon import clip_to_horizon

# Blender's bake shifts its sampling points by this much, in texels, so that centers exactly on an edge belong to one
# side. The same shift here gives the same texels.
NUDGE = (0.001, 0.002)
# Number of points off the triangle after which Cycles' bake takes the center.
ATTEMPTS = 10
# Blender bakes triangles of less than half this area, in texels, at the center alone.
SMALLEST_AREA = float(np.finfo(np.float32).eps)
# Points that stand for those over which Cycles takes the mean.
LATTICE = 64
# Regularization that keeps point weights from growing; the moments of the unit square are about a tenth.
STIFFNESS = 1e-3
GOLDEN_RATIO = 0.5 * (5.0**0.5 - 1.0)
_NO_ROW = 1 << 40
# How far a triangle may stick out of its tile, in tiles: more than rounding, less than a texel.
TILE_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Texels:
    """Q texels of a block of rows, and where they lie on the triangles."""

    index: np.ndarray  # (Q,) increasing: (y - first row) * W + x
    triangle: np.ndarray  # (Q,)
    barycentric: np.ndarray  # (Q, 3) weights of the triangle's corners, none negative
    covers: int  # sum over all texels of how often each is covered
    overlaps: int  # number of texels that are covered more than once
    unbaked: int = 0  # number of further texels that Cycles left out

    def baked(self, is_baked: np.ndarray) -> "Texels":
        """The texels that Cycles baked, given by the mask `is_baked` (Q,)."""
        unbaked = int(np.count_nonzero(~is_baked))
        remaining = self.index[is_baked], self.triangle[is_baked], self.barycentric[is_baked]
        return Texels(*remaining, self.covers, self.overlaps, unbaked)


@dataclass(frozen=True)
class UvTriangles:
    """Triangles of a UV map in texels of one tile. `texels` finds the texels of a block of rows."""

    corners: np.ndarray  # (T, 3, 2) float64, in texels
    width: int
    height: int

    @classmethod
    def in_tile(cls, uv: np.ndarray, width: int, height: int, tile: tuple[int, int] = (0, 0)) -> "UvTriangles":
        """Triangles uv (T, 3, 2) on a texture of width x height texels that fills the unit square at `tile`."""
        # Single precision, as in Blender: otherwise rounding would move texels from one side of an edge to the other.
        size = np.array([width, height], dtype=np.float32)
        corners = (np.asarray(uv, dtype=np.float32) - np.asarray(tile, dtype=np.float32)) * size
        return cls(corners.astype(np.float64), width, height)

    def texels(self, first_row: int, row_count: int, conservative: bool = False) -> Texels:
        """The texels of `row_count` rows whose centers are covered. Where triangles overlap, the last one wins, as in
        Blender.

        `conservative` adds the texels that a triangle touches without covering their center. Their sample is the point
        of the triangle nearest to the center.
        """
        owner = np.full(row_count * self.width, -1, dtype=np.int64)
        shifted = self.corners.astype(np.float32) - (np.float32(0.5) + np.array(NUDGE, np.float32))
        spans = _center_spans(shifted, first_row, row_count, (self.width, self.height))
        triangle, index = _expand(*spans, self.width, first_row)
        owner[index] = triangle
        covered = owner >= 0
        covers, overlaps = len(index), 0
        if covers > np.count_nonzero(covered):
            overlaps = int(np.count_nonzero(np.bincount(index) > 1))
        if conservative:
            spans = _touching_spans(self.corners, first_row, row_count, self.width)
            triangle, index = _expand(*spans, self.width, first_row)
            free = ~covered[index]
            owner[index[free]] = triangle[free]
        texel = np.flatnonzero(owner >= 0)
        triangle = owner[texel]
        center = np.stack([texel % self.width + 0.5, texel // self.width + first_row + 0.5], axis=-1)
        return Texels(texel, triangle, barycentric_of_nearest(self.corners[triangle], center), covers, overlaps)

    def spread(self, texels: Texels, number: int, count: int, width: float) -> Texels:
        """`texels` at point `number` of `count`. With more points, their mean tends to that of Cycles' bake.

        Measured with Cycles 4.5.15 and 5.2.3: the samples of a texel fill the part of a square of `width` texels around
        its center that lies on the triangle of the center. If ATTEMPTS random points of the square in a row miss
        the triangle, a sample is at the center.
        """
        if count == 1:
            return texels
        # A golden-ratio lattice, symmetric about (1/2, 1/2).
        u, v = (number + 0.5) / count, ((number - 0.5 * (count - 1)) * GOLDEN_RATIO + 0.5) % 1.0
        half = 0.5 * width
        moved = np.full((len(texels.index), 2), ((u - 0.5) * width, (v - 0.5) * width))
        corners = self.corners[texels.triangle] - self.places(texels)[:, None]
        outside = ~_contains_square(corners, half)
        moved[outside] = _covered_point(corners[outside], half, u, v)
        return replace(texels, barycentric=barycentric_of_nearest(corners, moved))

    def places(self, texels: Texels) -> np.ndarray:
        """Places (Q, 2) of the samples of texels, in texels."""
        return np.einsum("qcx,qc->qx", self.corners[texels.triangle], texels.barycentric)

    def at(self, texels: Texels, points: np.ndarray) -> Texels:
        """`texels` moved to points (Q, 2) of their triangles, in texels."""
        return replace(texels, barycentric=barycentric_of_nearest(self.corners[texels.triangle], points))


@dataclass(frozen=True)
class PointWeights:
    """Weights for other points than those of `UvTriangles.spread`. With them, whatever changes linearly or
    quadratically over a texel has the same mean, in the least-squares sense; they are as close to equal weights as
    possible."""

    center: np.ndarray  # (Q, 2) in texels
    half: float  # half the side of the square, in texels
    mean: np.ndarray  # (Q, 5) mean of the `_moments` of the points
    slope: np.ndarray  # (Q, 5) change of the weight with each moment

    @classmethod
    def of(cls, triangles: UvTriangles, texels: Texels, points: Iterable[np.ndarray], width: float) -> "PointWeights":
        """The weights for `points`, each (Q, 2), in a square of `width` texels."""
        center, half = triangles.places(texels), 0.5 * width
        wanted = np.tile((0.0, 0.0, 1.0 / 3.0, 0.0, 1.0 / 3.0), (len(center), 1))
        edge = np.flatnonzero(~_contains_square(triangles.corners[texels.triangle] - center[:, None], half))
        some = replace(texels, triangle=texels.triangle[edge], barycentric=texels.barycentric[edge])
        some = replace(some, index=texels.index[edge])
        spread = (triangles.spread(some, number, LATTICE, width) for number in range(LATTICE))
        wanted[edge] = sum(_moments((triangles.places(at) - center[edge]) / half) for at in spread) / LATTICE
        count, total, products = 0, np.zeros((len(center), 5)), np.zeros((len(center), 5, 5))
        for at in points:
            moments = _moments((at - center) / half)
            count, total = count + 1, total + moments
            products += moments[:, :, None] * moments[:, None, :]
        mean = total / count
        spread = products / count - mean[:, :, None] * mean[:, None, :] + STIFFNESS * np.eye(5)
        return cls(center, half, mean, np.linalg.solve(spread, (wanted - mean)[..., None])[..., 0])

    def at(self, points: np.ndarray) -> np.ndarray:
        """Weights (Q,) of points (Q, 2), 1 on average."""
        return 1.0 + np.sum((_moments((points - self.center) / self.half) - self.mean) * self.slope, axis=1)


def _moments(offsets):
    """x, y, x^2, xy, y^2 (Q, 5) of offsets (Q, 2)."""
    x, y = offsets.T
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)


def _contains_square(corners, half):
    """Mask (Q,) of the triangles (Q, 3, 2) that contain the square of +-half around the origin. The origin is on each
    of them."""
    start, side = corners, np.roll(corners, -1, axis=1) - corners
    # The corner of the square that is farthest beyond a side decides.
    reach = half * np.abs(side).sum(axis=-1)
    return (np.abs(cross(start, side)) >= reach).all(axis=1)


def _covered_point(corners, half, u, v):
    """The points (Q, 2) at (u, v), each in [0, 1], of the parts of the square of +-half around the origin that
    triangles (Q, 3, 2) cover; the origin is on each of them. Equal areas of the unit square give equal areas of the
    part, except for the area that stands for the origin."""
    ends = _borders(corners, half)
    areas = np.abs(cross(ends[:, :, 0], ends[:, :, 1]))
    total = areas.sum(axis=1)
    missed = np.where(total > 2.0 * SMALLEST_AREA, 1.0 - np.minimum(total / (8.0 * half * half), 1.0), 1.0) ** ATTEMPTS
    around = np.flatnonzero(u >= missed)
    share = (u - missed[around]) / (1.0 - missed[around]) * total[around]
    sums = np.cumsum(areas[around], axis=1)
    which = np.minimum((sums <= share[:, None]).sum(axis=1), ends.shape[1] - 1)
    rows = np.arange(len(around))
    area = areas[around][rows, which]
    share = np.divide(share - (sums[rows, which] - area), area, out=np.zeros(len(rows)), where=area > 0.0)
    ends = ends[around][rows, which]
    points = np.zeros((len(corners), 2))
    points[around] = np.sqrt(v) * (ends[:, 0] + np.clip(share, 0.0, 1.0)[:, None] * (ends[:, 1] - ends[:, 0]))
    return points


def _borders(corners, half):
    """Ends (Q, S, 2, 2) of the borders of the parts of the square of +-half around the origin that triangles (Q, 3, 2)
    cover; both ends are equal if there is none. The origin is on each triangle."""
    x, y = np.moveaxis(corners, (2, 1), (0, 1))
    part = np.stack([x, y, half - x, half + x, half - y, half + y])
    for side in range(2, len(part)):
        part = clip_to_horizon(part, side)
    corners = np.moveaxis(part[:2], (0, 1), (2, 1))
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)


def _center_spans(corners, first_row, row_count, size):
    """(triangle, row, first x, last x) of the runs of integer points in triangles (T, 3, 2), float32, of a texture of
    `size` (width, height).

    It follows Blender's rasterizer down to the rounding. A side is followed from its upper end row by row in single
    precision; a point on the left side is outside.
    """
    width, height = size
    sides = [_side_rows(corners[:, k], corners[:, (k + 1) % 3], first_row, row_count, height) for k in range(3)]
    first = np.min([side.first for side in sides], axis=0)
    last = np.max([side.last for side in sides], axis=0)
    triangle, step = repeated(last - first + 1)
    row = first[triangle] + step
    offset = np.cumsum(np.maximum(last - first + 1, 0)) - np.maximum(last - first + 1, 0)
    low_x, high_x = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for side in sides:
        of, number = repeated(side.last - side.first + 1)
        position = offset[of] + (side.first - first)[of] + number
        x = side.x[side.start[of] + number]
        low_x[position], high_x[position] = np.minimum(low_x[position], x), np.maximum(high_x[position], x)
    crossed = np.flatnonzero(np.isfinite(low_x))
    low_x, high_x = low_x[crossed], high_x[crossed]
    return triangle[crossed], row[crossed], np.floor(low_x) + 1.0, np.minimum(np.floor(high_x), width - 1.0)


@dataclass(frozen=True)
class _Side:
    """Where one side of each triangle meets the rows of the block."""

    first: np.ndarray  # (T,) first row; _NO_ROW if there is none
    last: np.ndarray  # (T,) last row; -_NO_ROW if there is none
    start: np.ndarray  # (T,) place in `x` of the first row
    x: np.ndarray  # one for each row of each side


def _side_rows(start, end, first_row, row_count, height):
    upward = (start[:, 1] < end[:, 1])[:, None]
    low, high = np.where(upward, start, end), np.where(upward, end, start)
    top = np.minimum(np.floor(high[:, 1]), height - 1.0)
    first = np.maximum(np.ceil(low[:, 1]), first_row)
    last = np.minimum(top, first_row + row_count - 1.0)
    with np.errstate(invalid="ignore"):
        meeting = np.flatnonzero(np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1) & (first <= last))
    # Sides with the most rows come first, so that those still being followed are always the first ones.
    meeting = meeting[np.argsort(first[meeting] - top[meeting], kind="stable")]
    low, high, top = low[meeting], high[meeting], top[meeting].astype(np.float32)
    rise = high[:, 1] - low[:, 1]
    flat = rise <= np.finfo(np.float32).eps
    slope = np.divide(low[:, 0] - high[:, 0], rise, out=np.zeros_like(rise), where=~flat)
    x = np.where(flat, np.minimum(low[:, 0], high[:, 0]), slope * (low[:, 1] - top) + low[:, 0])
    rows = np.zeros(len(start) + 1, np.int64)
    rows[meeting + 1] = last[meeting] - first[meeting] + 1.0
    end_of_side = np.cumsum(rows)
    values = np.empty(end_of_side[-1], np.float32)
    steps, skipped = top - first[meeting], top - last[meeting]
    target = end_of_side[meeting + 1] - 1 + skipped.astype(np.int64)
    active = len(meeting)
    for step in range(int(steps[0]) + 1 if active else 0):
        active = np.searchsorted(-steps[:active], -step, side="right")
        within = np.flatnonzero(skipped[:active] <= step)
        values[target[within] - step] = x[within]
        x[:active] += slope[:active]
    rows_of = np.full((2, len(start)), [[_NO_ROW], [-_NO_ROW]], dtype=np.int64)
    rows_of[:, meeting] = first[meeting], last[meeting]
    return _Side(*rows_of, end_of_side[:-1], values)


def _touching_spans(corners, first_row, row_count, width):
    """(triangle, row, first x, last x) of the runs of unit squares that triangles (T, 3, 2) touch."""
    order = np.argsort(corners[:, :, 1], axis=1, kind="stable")
    low, middle, high = np.moveaxis(np.take_along_axis(corners, order[:, :, None], axis=1), 1, 0)
    area = cross(middle - low, high - low)
    solid = np.flatnonzero(np.isfinite(area) & (area != 0.0))
    low, middle, high = low[solid], middle[solid], high[solid]
    # A triangle that ends on the border between two rows does not reach into the next row.
    last = np.maximum(np.ceil(high[:, 1]) - 1.0, np.floor(low[:, 1]))
    triangle, row = _rows_of(np.floor(low[:, 1]), last, first_row, row_count)
    low, middle, high = low[triangle], middle[triangle], high[triangle]
    inside = np.clip(middle[:, 1], row, row + 1.0) == middle[:, 1]
    ends = []
    for border in (row, row + 1.0):
        ends += _chain_ends(low, middle, high, np.clip(border, low[:, 1], high[:, 1]))
    ends.append(np.where(inside, middle[:, 0], ends[0]))
    low_x, high_x = np.min(ends, axis=0), np.max(ends, axis=0)
    last_x = np.maximum(np.ceil(high_x) - 1.0, np.floor(low_x))
    return solid[triangle], row, np.floor(low_x), np.minimum(last_x, width - 1.0)


def _rows_of(first, last, first_row, row_count):
    """(triangle, row) for every row from `first` (T,) to `last` (T,) within the block."""
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(first) & np.isfinite(last)
    first = np.maximum(np.where(finite, first, 0.0), first_row)
    last = np.minimum(np.where(finite, last, -1.0), first_row + row_count - 1.0)
    triangle, step = repeated(last - first + 1.0)
    return triangle, first[triangle] + step


def repeated(counts):
    """Numbers 0 0 0 1 1 3 ..., each repeated as `counts` (N,) says, and positions 0 1 2 0 1 0 ... within each."""
    counts = np.where(counts > 0.0, counts, 0.0).astype(np.int64)
    number = np.repeat(np.arange(len(counts)), counts)
    ends = np.cumsum(counts)
    return number, np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)


def _chain_ends(low, middle, high, y):
    """Where a horizontal line at y (S,) meets the long side and one of the two short sides of triangles: two x (S,)."""
    below = y <= middle[:, 1]
    start, end = np.where(below[:, None], low, middle), np.where(below[:, None], middle, high)
    return _x_on(low, high, y), _x_on(start, end, y)


def _x_on(start, end, y):
    rise = end[:, 1] - start[:, 1]
    share = np.divide(y - start[:, 1], rise, out=np.ones_like(rise), where=rise > 0.0)
    return start[:, 0] + share * (end[:, 0] - start[:, 0])


def _expand(span_triangle, row, first_x, last_x, width, first_row):
    """(triangle, index in the block) of every texel of the spans, in the order of the triangles."""
    first_x = np.clip(first_x, 0.0, width)
    span, step = repeated(last_x - first_x + 1.0)
    index = ((row[span] - first_row) * width + first_x[span]).astype(np.int64) + step
    return span_triangle[span], index


def barycentric_of_nearest(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric weights (Q, 3), none negative, of the point of each triangle (Q, 3, 2) nearest to `points` (Q, 2).

    For a triangle without area it is the nearest point of its sides.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    area = cross(b - a, c - a)
    safe = np.where(area != 0.0, area, 1.0)
    weights = np.stack([cross(b - points, c - points), cross(c - points, a - points), cross(a - points, b - points)])
    weights = (weights / safe).T
    outside = np.flatnonzero((weights < 0.0).any(axis=1) | (area == 0.0))
    if len(outside):
        weights[outside] = _nearest_on_sides(corners[outside], points[outside])
    return weights


def _nearest_on_sides(corners, points):
    best, distance = np.zeros((len(points), 3)), np.full(len(points), np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, side = corners[:, first], corners[:, second] - corners[:, first]
        length2 = (side * side).sum(axis=1)
        share = ((points - start) * side).sum(axis=1)
        share = np.clip(np.divide(share, length2, out=np.zeros_like(share), where=length2 > 0.0), 0.0, 1.0)
        gap = points - start - share[:, None] * side
        distance2 = (gap * gap).sum(axis=1)
        nearer = np.flatnonzero(distance2 < distance)
        distance[nearer] = distance2[nearer]
        best[nearer] = 0.0
        best[nearer, first], best[nearer, second] = 1.0 - share[nearer], share[nearer]
    return best


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cross products (...) of vectors (..., 2) in a plane."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def column_and_row(tile: int) -> tuple[int, int]:
    """Column and row of a UDIM tile."""
    return (tile - 1001) % 10, (tile - 1001) // 10


def tiles_of(uv: np.ndarray) -> tuple[list[int], float]:
    """UDIM tiles (1001 is the unit square, ten to a row) in which triangles uv (T, 3, 2) lie, and an area: 0 if all
    triangles lie within tiles, otherwise the area of all triangles, in tiles.

    If a triangle reaches over a border, the texture repeats or is wrong. Then only the unit square counts. A triangle
    on a border has no tile, unless all are: unwraps put slivers a float step beyond.
    """
    uv = np.asarray(uv, dtype=np.float64)
    area = np.abs(cross(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]))
    solid = np.isfinite(area) & (area > 0.0)
    uv, area = uv[solid], area[solid]
    tile = np.floor(uv.mean(axis=1))
    inside = ((uv.max(axis=1) > tile + TILE_TOLERANCE) & (uv.min(axis=1) < tile + 1.0 - TILE_TOLERANCE)).all(axis=1)
    uv, tile = (uv[inside], tile[inside]) if inside.any() else (uv, tile)
    column, row = tile.astype(np.int64).T
    origin = np.stack([column, row], axis=-1)[:, None]
    within = np.all((uv >= origin - TILE_TOLERANCE) & (uv <= origin + 1.0 + TILE_TOLERANCE), axis=(1, 2))
    numbered = (column >= 0) & (column < 10) & (row >= 0)
    if (within & numbered).all():
        return sorted(set((1001 + column + 10 * row).tolist())), 0.0
    touching = (uv.min(axis=1) < 1.0).all(axis=1) & (uv.max(axis=1) > 0.0).all(axis=1)
    return ([1001] if touching.any() else []), float(0.5 * area.sum())
