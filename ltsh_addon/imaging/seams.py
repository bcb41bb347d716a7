"""The islands of a UV map: pictures of them in which the surface goes on beyond seams, and lights that fit there.

Works on one texture with any number of objects. Texels are counted from the lower left corner of the texture; the
center of the first one is at (.5, .5).
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..cycles.texels import TexelMesh
from ..cycles.uv import cross, repeated
from ..emitters.mesh_polygons import connected

# SAME_PLACE: corners that are nearer count as one, relative to the size of all. SAME_UV: the same in texels.
SAME_PLACE, SAME_UV = 1e-6, 1.0 / 64.0
# Cosines of the normals on both sides of a seam. SMOOTH: they show the same light. FOLD: the surface turns back, like
# that of a sheet of paper.
SMOOTH, FOLD = 0.999, -0.5
# FRAMES: texels around islands, the first that needs no more than MOST_CANVAS times the texture. STEP: between points
# at which a frame is looked up.
FRAMES, MOST_CANVAS, STEP = (8, 4, 2), 6.0, 0.7
# LEAST_WEIGHT: of the texels that show a place beyond a seam, out of 1.
LEAST_WEIGHT = 0.25
# What fits seams: RINGS of texels around them change, SMOOTHLY; COVERED and MARGIN texels resist a change so much,
# relative to a step at a seam. PRECISION: of the solution, relative. MOST_STEPS: of the solver.
RINGS, SMOOTHLY, COVERED, MARGIN, PRECISION, MOST_STEPS = 3, 0.01, 0.1, 0.001, 1e-4, 200
# MARGIN_TEXELS: how far the margin beside a seam shows the surface beyond it, so that lookups near the seam do.
MARGIN_TEXELS = 2.0


@dataclass(frozen=True)
class TexelGrid:
    """The texels of one texture, and the faces on which they lie."""

    triangle: np.ndarray  # (H, W) number of the triangle, -1 where there is none
    uv: np.ndarray  # (T, 3, 2) in texels
    corners: np.ndarray  # (T, 3, 3) m
    normals: np.ndarray  # (T, 3, 3) unit

    @classmethod
    def of(cls, triangle: np.ndarray, uv: np.ndarray, mesh: TexelMesh) -> "TexelGrid":
        """The grid of one mesh, whose UV map is `uv` (T, 3, 2), in texels."""
        return cls(triangle, uv, mesh.corners, mesh.normals)


@dataclass(frozen=True)
class Seams:
    """E edges at which two faces meet on the surface, but not in the texture; all twice, seen from either side."""

    start: np.ndarray  # (E, 2) in texels, on this side
    end: np.ndarray  # (E, 2)
    inward: np.ndarray  # (E, 2) unit vector into this side
    triangle: np.ndarray  # (E,) on this side
    normal: np.ndarray  # (E, 2, 3) at start and end
    other: np.ndarray  # (E,) the number of the same edge on the other side


@dataclass(frozen=True)
class Islands:
    """The islands of a grid, and the seams between them."""

    grid: TexelGrid
    seams: Seams
    number: np.ndarray  # (T,) of the island of each triangle

    @property
    def of_texels(self) -> np.ndarray:
        """The number (H * W,) of the island of each texel, -1 where there is none."""
        triangle = self.grid.triangle.reshape(-1)
        return np.where(triangle >= 0, self.number[triangle], -1)


def islands_of(grid: TexelGrid) -> Islands:
    """The islands of a grid."""
    count = len(grid.uv)
    size = max(float(np.ptp(grid.corners.reshape(-1, 3), axis=0).max()), 1e-30)
    place = np.round(grid.corners.reshape(-1, 3) / (SAME_PLACE * size)).astype(np.int64)
    vertex = np.unique(place, axis=0, return_inverse=True)[1].reshape(count, 3)
    first, second, third = np.arange(3), np.array([1, 2, 0]), np.array([2, 0, 1])
    low = np.where(
        vertex[:, first] <= vertex[:, second], first, second
    )  # (T, 3) corner of the end with the lower number
    triangle = np.repeat(np.arange(count), 3)
    low, high, apex = low.ravel(), (np.add(first, second) - low).ravel(), np.tile(third, count)
    ends = np.stack([grid.uv[triangle, low], grid.uv[triangle, high]], axis=1)
    key = np.stack([vertex[triangle, low], vertex[triangle, high], *np.round(ends.reshape(-1, 4) * 8.0).T.astype(int)])
    order = np.lexsort(key[::-1])
    order = order[key[0, order] != key[1, order]]
    a, b = order[:-1], order[1:]
    meets = (key[:2, a] == key[:2, b]).all(axis=0)
    # Three or more faces at an edge: only those that also meet in the texture belong together.
    is_first = np.concatenate([[True], ~meets]) if len(order) else np.zeros(0, bool)
    of_edge = np.cumsum(is_first) - 1
    pair = (np.bincount(of_edge)[of_edge] == 2)[:-1] if len(order) else np.zeros(0, bool)
    is_same = np.abs(ends[a] - ends[b]).max(axis=(1, 2), initial=0.0) < SAME_UV
    joined = np.stack([triangle[a[meets & is_same]], triangle[b[meets & is_same]]], axis=1)
    islands = np.unique(connected(count, joined), return_inverse=True)[1]
    side = grid.uv[triangle, apex] - ends[:, 0]
    along = ends[:, 1] - ends[:, 0]
    seam = np.flatnonzero(meets & ~is_same & pair)
    edges, number = np.concatenate([a[seam], b[seam]]), np.arange(len(seam))
    other = np.concatenate([number + len(seam), number])
    length = np.linalg.norm(along[edges], axis=1)
    inward = np.stack([-along[edges, 1], along[edges, 0]], axis=1) / np.maximum(length, 1e-30)[:, None]
    inward *= np.sign(cross(along[edges], side[edges]))[:, None]
    normal = np.stack([grid.normals[triangle, low], grid.normals[triangle, high]], axis=1)[edges]
    seams = Seams(ends[edges, 0], ends[edges, 1], inward, triangle[edges], normal, other)
    # Faces without area in the texture show nothing.
    solid = (length > SAME_UV) & inward.any(axis=1)
    solid &= solid[other]
    return Islands(grid, _chosen(seams, solid), islands)


def _chosen(seams: Seams, mask: np.ndarray) -> Seams:
    """The seams of a mask (E,) that holds both sides of each."""
    number = np.cumsum(mask) - 1
    values = (seams.start, seams.end, seams.inward, seams.triangle, seams.normal, number[seams.other])
    return Seams(*(value[mask] for value in values))


@dataclass(frozen=True)
class Canvas:
    """The islands apart from each other in a picture of their own, each in a frame in which its surface goes on.

    A filter of the canvas mixes no islands, and the light on both sides of a seam.
    """

    shape: tuple[int, int]
    texel: np.ndarray  # (Q,) flat numbers of the covered texels of the texture
    place: np.ndarray  # (Q,) their flat numbers on the canvas
    frame: np.ndarray  # (F,) flat numbers on the canvas of the texels of frames that lie on a surface
    sources: np.ndarray  # (F, 4) flat numbers of texels of the texture
    weights: np.ndarray  # (F, 4)

    def put(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The canvas (h, w, C) of a texture (H, W, C), and the mask (h, w) of its texels that have a value."""
        flat = image.reshape(-1, image.shape[-1])
        canvas, mask = np.zeros((math.prod(self.shape), flat.shape[1]), np.float32), np.zeros(self.shape, bool)
        canvas[self.place] = flat[self.texel]
        canvas[self.frame] = sum(self.weights[:, n, None] * flat[self.sources[:, n]] for n in range(4))
        mask.reshape(-1)[self.place] = mask.reshape(-1)[self.frame] = True
        return canvas.reshape(*self.shape, -1), mask

    def taken(self, canvas: np.ndarray, image: np.ndarray) -> np.ndarray:
        """The texture `image` (H, W, C) with the covered texels of a canvas (h, w, C)."""
        taken = image.copy()
        taken.reshape(-1, image.shape[-1])[self.texel] = canvas.reshape(-1, image.shape[-1])[self.place]
        return taken


def canvas_of(islands: Islands) -> Canvas:
    """The canvas of the covered texels of a grid."""
    (height, width), island_of = islands.grid.triangle.shape, islands.of_texels
    texel = np.flatnonzero(island_of >= 0)
    number = island_of[texel]
    count = int(islands.number.max(initial=-1)) + 1
    low, high = np.full((count, 2), max(height, width)), np.full((count, 2), -1)
    position = np.stack([texel % width, texel // width], axis=1)
    np.minimum.at(low, number, position)
    np.maximum.at(high, number, position)
    sides = np.where(high >= low, high - low + 1, 0)
    is_there = sides[:, 0] > 0
    for frame in FRAMES:
        framed = np.where(is_there[:, None], sides + 2 * frame, 0)
        if framed.prod(axis=1).sum() <= MOST_CANVAS * width * height:
            break
    corner, shape = _shelves(framed)
    offset = corner + frame - low

    def on_canvas(x, y, island):
        return (y + offset[island, 1]) * shape[1] + x + offset[island, 0]

    place = on_canvas(*position.T, number)
    taken = np.zeros(math.prod(shape), bool)
    taken[place] = True

    def located(x, y, island):
        near = (x >= low[island, 0] - frame) & (x <= high[island, 0] + frame) & is_there[island]
        near &= (y >= low[island, 1] - frame) & (y <= high[island, 1] + frame)
        return np.where(near, on_canvas(x, y, island), -1)

    return Canvas(shape, texel, place, *_frame(islands, islands.seams, frame, located, taken))


def _frame(islands: Islands, seams: Seams, depth: float, located: Callable, taken: np.ndarray):
    """The texels (F,) up to `depth` texels beyond seams, the texels (F, 4) that show their surface, and weights (F, 4).

    `located(x, y, island)` are their numbers, -1 where there is none. `taken` (by number) is updated.
    """
    of_texels, width = islands.of_texels, islands.grid.triangle.shape[1]
    along = seams.end - seams.start
    count = np.ceil(np.linalg.norm(along, axis=1) / STEP)
    edge, step = repeated(count + 1.0)
    start = seams.start[edge] + (step / np.maximum(count[edge], 1.0))[:, None] * along[edge]
    of_edge = islands.number[seams.triangle[edge]]
    texels, sources, weights = [np.zeros(0, np.int64)], [np.zeros((0, 4), np.int64)], [np.zeros((0, 4))]
    # The nearest to a seam first.
    for distance in np.arange(0.5 * STEP, depth, STEP):
        x, y = np.floor(start - distance * seams.inward[edge]).astype(np.int64).T
        at, first = np.unique(located(x, y, of_edge), return_index=True)
        free = (at >= 0) & ~taken[at]
        at, first = at[free], first[free]
        center = np.stack([x[first], y[first]], axis=1) + 0.5
        place, is_flat = _beyond(seams, edge[first], center)
        source, weight = bilinear(place, of_texels.reshape(-1, width))
        other = islands.number[seams.triangle[seams.other[edge[first]]]]
        weight = weight * (of_texels[source] == other[:, None]) * is_flat[:, None]
        total = weight.sum(axis=1, keepdims=True)
        shown = total[:, 0] > LEAST_WEIGHT
        taken[at[shown]] = True
        texels.append(at[shown])
        sources.append(source[shown])
        weights.append(weight[shown] / total[shown])
    return np.concatenate(texels), np.concatenate(sources), np.concatenate(weights).astype(np.float32)


def _beyond(seams: Seams, edge: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the texture shows the surface of points (Q, 2) beyond edges (Q,): places (Q, 2), and the mask (Q,) of those
    where it is not folded back."""
    other = seams.other[edge]
    along, along_other = seams.end[edge] - seams.start[edge], seams.end[other] - seams.start[other]
    squared = (along * along).sum(axis=1)
    share = ((point - seams.start[edge]) * along).sum(axis=1) / squared
    distance = -((point - seams.start[edge]) * seams.inward[edge]).sum(axis=1)
    distance *= np.sqrt((along_other * along_other).sum(axis=1) / squared)
    place = seams.start[other] + share[:, None] * along_other + distance[:, None] * seams.inward[other]
    is_flat = (seams.normal[edge] * seams.normal[other]).sum(axis=-1).min(axis=1, initial=1.0) > FOLD
    return place, is_flat


def bilinear(place: np.ndarray, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The flat numbers (Q, 4) of the texels of a `plane` (H, W) between which places (Q, 2) lie, and weights (Q, 4).

    Texels beyond the border count as those at the border.
    """
    height, width = plane.shape
    corner = np.floor(place - 0.5)
    x, y = corner.astype(np.int64).T
    right, up = (place - 0.5 - corner).T
    columns, rows = np.clip([x, x + 1, x, x + 1], 0, width - 1), np.clip([y, y, y + 1, y + 1], 0, height - 1)
    weights = np.stack([(1 - right) * (1 - up), right * (1 - up), (1 - right) * up, right * up], axis=1)
    return (rows * width + columns).T, weights


def _shelves(sizes: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Corners (N, 2) of rectangles of `sizes` (N, 2) in rows, the highest first, and the height and width of all."""
    corner, x, y, row = np.zeros_like(sizes), 0, 0, 0
    width = max(int(sizes[:, 0].max(initial=1)), math.isqrt(int(sizes.prod(axis=1).sum())) + 1)
    for number in np.argsort(-sizes[:, 1], kind="stable"):
        across, up = sizes[number].tolist()
        if x + across > width:
            x, y, row = 0, y + row, 0
        corner[number] = x, y
        x, row = x + across, max(row, up)
    return corner, (max(y + row, 1), width)


class SeamFit:
    """Makes lights equal on both sides of the smooth seams of a grid, by the least changes near them.

    Sources: Iwanicki 2013, "Lighting Technology of The Last of Us"; Liu, Ferguson, Jacobson and Gingold 2017,
    "Seamless: Seam erasure and seam-aware decoupling of shape from mesh resolution".
    """

    def __init__(self, islands: Islands):
        (height, width), of_texels, seams = islands.grid.triangle.shape, islands.of_texels, islands.seams
        seams = _chosen(
            seams, (seams.normal * seams.normal[seams.other]).sum(axis=-1).min(axis=1, initial=1.0) > SMOOTH
        )

        one_side = np.flatnonzero(np.arange(len(seams.other)) < seams.other)
        along = seams.end - seams.start
        length = np.linalg.norm(along, axis=1)
        points = np.ceil(2.0 * np.maximum(length, length[seams.other])[one_side]) + 1.0
        edge, step = repeated(points)
        share = ((step + 0.5) / points[edge])[:, None]
        sides = one_side[edge], seams.other[one_side][edge]
        looked_up = [bilinear(seams.start[side] + share * along[side], islands.grid.triangle) for side in sides]
        texels = np.concatenate([numbers for numbers, _ in looked_up], axis=1)
        # A texel of the margin that several islands look up shows the surface beyond the one that needs it most.
        claim, need = np.full(height * width, -1), np.concatenate([weight for _, weight in looked_up], axis=1)
        island = np.repeat(np.stack([islands.number[seams.triangle[side]] for side in sides], axis=1), 4, axis=1)
        order = np.argsort(need, axis=None, kind="stable")
        order = order[need.ravel()[order] > 0.0]
        claim[texels.ravel()[order]] = island.ravel()[order]

        def located(x, y, island):
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            at = np.where(inside, y * width + x, 0)
            return np.where(inside & (claim[at] == island), at, -1)

        known = of_texels >= 0
        shown = _frame(islands, seams, MARGIN_TEXELS, located, known)
        rest = _beside(np.flatnonzero((claim >= 0) & ~known), claim, of_texels.reshape(height, width))
        self.margin, *self._shown = (np.concatenate(both) for both in zip(shown, rest, strict=True))
        known[self.margin] = True
        usable = known[texels].all(axis=1)
        signs = np.repeat([1.0, -1.0], 4)
        texels, self._values = texels[usable], (need * signs)[usable]
        self.texels, self._links = _band(np.unique(texels), known.reshape(height, width))
        self._columns = np.searchsorted(self.texels, texels)
        self._keep = np.where(of_texels[self.texels] >= 0, COVERED, MARGIN)[:, None]

    def fit(self, image: np.ndarray, *, changed: bool = True) -> None:
        """Set the texels of an image (H, W, C) in the `margin` of smooth seams; `changed`: fit the others near them."""
        flat = image.reshape(-1, image.shape[-1])
        sources, weights = self._shown
        flat[self.margin] = sum(weights[:, n, None] * flat[sources[:, n]] for n in range(4))
        if changed and len(self.texels):
            light = flat[self.texels].astype(np.float64)
            # A sharp edge of a shadow across a seam would swing below black.
            flat[self.texels] = np.maximum(light + self._changes(light), np.minimum(light, 0.0))

    def _changes(self, light: np.ndarray) -> np.ndarray:
        """The changes (N, C) of the `light` (N, C), by conjugate gradients."""
        target = -self._transposed(self._steps(light))
        change, rest = np.zeros_like(target), target
        direction, squared = rest.copy(), (rest * rest).sum(axis=0)
        limit = PRECISION**2 * squared
        for _ in range(MOST_STEPS):
            if (squared <= limit).all():
                break
            product = self._product(direction)
            step = squared / np.maximum((direction * product).sum(axis=0), 1e-300)
            change, rest = change + step * direction, rest - step * product
            before, squared = squared, (rest * rest).sum(axis=0)
            direction = rest + squared / np.maximum(before, 1e-300) * direction
        return change

    def _steps(self, light):
        """The steps (S, C) of light at the seams."""
        return np.einsum("sk,skc->sc", self._values, light[self._columns])

    def _transposed(self, steps):
        """The light (N, C) to which the transpose of `_steps` takes steps (S, C)."""
        weighted = (self._values[..., None] * steps[:, None]).reshape(-1, steps.shape[1])
        return _added(self._columns.ravel(), weighted, len(self.texels))

    def _product(self, change):
        """The product of the normal equations with a change (N, C)."""
        a, b = self._links
        slope = SMOOTHLY * (change[a] - change[b])
        smooth = _added(a, slope, len(change)) - _added(b, slope, len(change))
        return self._transposed(self._steps(change)) + self._keep * change + smooth


def _beside(texels: np.ndarray, claim: np.ndarray, of_texels: np.ndarray):
    """As `_frame`, for `texels` that no surface beyond a seam shows: the nearest ones of islands that `claim` them."""
    height, width = of_texels.shape
    y, x = np.divmod(texels, width)
    source = np.full(len(texels), -1)
    ways = sorted(itertools.product((-2, -1, 0, 1, 2), repeat=2), key=lambda way: -math.hypot(*way))
    for down, right in ways:
        row, column = np.clip(y + down, 0, height - 1), np.clip(x + right, 0, width - 1)
        there = of_texels[row, column] == claim[texels]
        source[there] = (row * width + column)[there]
    texels, source = texels[source >= 0], source[source >= 0]
    return texels, np.repeat(source[:, None], 4, axis=1), np.full((len(texels), 4), 0.25, np.float32)


def _added(number: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, C) of the `values` (S, C) by number (S,)."""
    return np.stack([np.bincount(number, column, count) for column in values.T], axis=1)


def _band(texels: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Flat numbers (N,), sorted, of `texels` and RINGS of `known` (H, W) ones around them, and pairs of neighbors."""
    chosen = np.zeros(known.shape, bool)
    chosen.reshape(-1)[texels] = True
    for _ in range(RINGS):
        wider = np.pad(chosen, 1)
        wider = wider[1:-1, 1:-1] | wider[2:, 1:-1] | wider[:-2, 1:-1] | wider[1:-1, 2:] | wider[1:-1, :-2]
        chosen = wider & known
    number = np.cumsum(chosen.ravel()).reshape(chosen.shape) - 1
    pairs = [
        (one[both], other[both])
        for one, other, both in (
            (number[:, 1:], number[:, :-1], chosen[:, 1:] & chosen[:, :-1]),
            (number[1:], number[:-1], chosen[1:] & chosen[:-1]),
        )
    ]
    return np.flatnonzero(chosen), tuple(np.concatenate(numbers) for numbers in zip(*pairs, strict=True))


def nearest_covered(coverage: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (Q,) of the margin texels, and the flat indices (Q,) of the nearest covered texel of each.

    Margin texels are those not covered in `coverage` (H, W) and at most `margin` texels from a covered one, by
    Euclidean distance. Of several nearest texels the first in memory is taken. Exact: along the rows first, then over
    the rows within reach (Felzenszwalb and Huttenlocher 2012, "Distance Transforms of Sampled Functions").
    """
    height, width = coverage.shape
    if margin <= 0 or not coverage.any() or coverage.all():
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    column = _nearest_in_row(coverage, margin)
    rows, columns = np.nonzero(~coverage & _within_reach(column >= 0, margin))
    best = np.full(len(rows), margin * margin + 1, dtype=np.int64)
    source = np.full(len(rows), -1, dtype=np.int64)
    for step in range(-margin, margin + 1):
        row = rows + step
        inside = (row >= 0) & (row < height)
        row = np.clip(row, 0, height - 1)
        nearest = column[row, columns]
        distance = (nearest - columns).astype(np.int64) ** 2 + step * step
        better = inside & (nearest >= 0) & (distance < best)
        best[better] = distance[better]
        source[better] = row[better] * width + nearest[better]
    reached = source >= 0
    return (rows * width + columns)[reached], source[reached]


def _nearest_in_row(coverage, margin):
    """Column (H, W) of the nearest covered texel in the same row, the left one of two; -1 beyond `margin`."""
    height, width = coverage.shape
    columns = np.arange(width, dtype=np.int32)
    far = np.int32(width + 2 * margin + 2)
    before = np.maximum.accumulate(np.where(coverage, columns, -far), axis=1)
    after = np.minimum.accumulate(np.where(coverage, columns, 2 * far)[:, ::-1], axis=1)[:, ::-1]
    to_left, to_right = columns - before, after - columns
    nearest = np.where(to_left <= to_right, before, after)
    return np.where(np.minimum(to_left, to_right) <= margin, nearest, -1).astype(np.int32)


def _within_reach(mask, margin):
    """Mask (H, W) of the texels that have a true value of `mask` (H, W) at most `margin` rows above or below."""
    height = len(mask)
    counts = np.zeros((height + 1, mask.shape[1]), dtype=np.int32)
    np.cumsum(mask, axis=0, out=counts[1:])
    rows = np.arange(height)
    return counts[np.minimum(rows + margin + 1, height)] > counts[np.maximum(rows - margin, 0)]
