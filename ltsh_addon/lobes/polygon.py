"""Polygons seen from shading points: clipping at the horizon, projection to the sphere, solid angle, convex pieces.

Batches of polygons are arrays (3, V, P): coordinate, corner, point. Unused corners repeat a neighbor, because an edge
between equal corners contributes exactly zero to every integral.
"""

from functools import cache

import numpy as np

# Most corners for which a bit pattern tells which are above the horizon.
PATTERN_CORNERS = 8
# Kinds of polygons. DARK: no corner is above the horizon. WHOLE: all are. SINGLE_RUN: those above are consecutive.
# SEVERAL_RUNS: those above may form several runs.
DARK, WHOLE, SINGLE_RUN, SEVERAL_RUNS = range(4)
# Turns below this share of the squared size of the polygon count as straight.
STRAIGHT = 1e-12
# If at least this share of the points sees all of a light, the light is computed as if all points did: that is cheaper
# than gathering them.
MOSTLY_WHOLE = 0.6


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (...) of vectors (3, ...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (3, ...) of vectors (3, ...)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def normal_frames(normal: np.ndarray) -> np.ndarray:
    """Frames (3, 3, P) around unit normals (3, P): rows of an arbitrary tangent, the bitangent and the normal (Duff et
    al. 2017, "Building an Orthonormal Basis, Revisited")."""
    x, y, z = normal
    sign = np.copysign(1.0, z).astype(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    bitangent = np.stack([b, sign + y * y * a, -y])
    return np.stack([tangent, bitangent, normal])


def clip_to_horizon(vertices: np.ndarray, axis: int = 2) -> np.ndarray:
    """The parts (C, W, P) of polygons (C, V, P) with C coordinates where coordinate `axis` is positive.

    Sutherland and Hodgman 1974; W <= V + 1 if all are convex, otherwise W <= 2 V. Each polygon needs a corner above.
    New corners have coordinate 0 exactly. A non-convex polygon may get coincident edges on the horizon; these cancel in
    a signed integral.
    """
    height = vertices[axis]
    above = height > 0.0
    following = np.roll(vertices, -1, axis=1)
    crosses = above != np.roll(above, -1, axis=0)
    span = np.where(crosses, height - following[axis], 1.0)
    crossing = vertices + (height / span) * (following - vertices)
    crossing[axis] = 0.0
    coordinates, count = vertices.shape[:2]
    slots = np.stack([vertices, crossing], axis=2).reshape(coordinates, 2 * count, -1)
    used = np.stack([above, crosses], axis=1).reshape(2 * count, -1)
    return _compact(slots, used)


def _compact(slots: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Move the used slots to the front in order, and repeat the last one up to the largest count of the batch."""
    count = used.sum(axis=0)
    order = np.argsort(~used, axis=0, kind="stable")
    row = np.minimum(np.arange(max(int(count.max(initial=1)), 1))[:, None], count - 1)
    index = np.take_along_axis(order, row, axis=0)
    return np.take_along_axis(slots, index[None], axis=1)


@cache
def _pattern_kinds(corners: int) -> np.ndarray:
    """DARK, WHOLE, SINGLE_RUN or SEVERAL_RUNS (2^V,) by pattern; bit n of a pattern is set if corner n is above."""
    patterns = np.arange(2**corners)
    following = (patterns >> 1) | ((patterns & 1) << (corners - 1))
    crossings = np.array([bin(changes).count("1") for changes in patterns ^ following])
    kinds = np.where(crossings == 2, SINGLE_RUN, SEVERAL_RUNS)
    kinds[0], kinds[-1] = DARK, WHOLE
    return kinds.astype(np.uint8)


@cache
def _run_corners(corners: int) -> np.ndarray:
    """Corners (V + 3, 2^V) of clipped polygons by pattern. Their order is: the last corner above, the first corner
    above, the run of corners above with its last one repeated (V - 1 in all), the corner below after the run, and the
    corner below before it."""
    table = np.zeros((corners + 3, 2**corners), dtype=np.intp)
    for first in range(corners):
        for count in range(1, corners):
            run = [(first + step) % corners for step in range(count)]
            rows = [run[-1], run[0], *run, *run[-1:] * (corners - 1 - count)]
            below = [(run[-1] + 1) % corners, (first - 1) % corners]
            table[:, sum(1 << corner for corner in run)] = rows + below
    return table


def horizon_patterns(heights: np.ndarray) -> np.ndarray:
    """Bit patterns (P,) of the corners above the horizon, at most `PATTERN_CORNERS`, from their heights (V, P)."""
    above = (heights > 0.0).view(np.uint8)
    result = above[0].copy()
    for corner in range(1, len(above)):
        result |= above[corner] << np.uint8(corner)
    return result


def clip_single_run(vertices: np.ndarray, patterns: np.ndarray, axis: int = 2) -> np.ndarray:
    """As `clip_to_horizon`, but cheaper, for polygons (C, V, P) whose corners above form one run; V + 1 corners each.

    All convex polygons that cross the horizon are of this kind. `patterns` (P,) come from `horizon_patterns`.
    """
    coordinates, corners, points = vertices.shape
    index = np.take(_run_corners(corners), patterns, axis=1)
    index *= points
    index += np.arange(points)
    gathered = np.take(vertices.reshape(coordinates, -1), index, axis=1)
    result, below = gathered[:, :-2], gathered[:, -2:]
    ends = result[:, :2]
    below -= ends
    below *= ends[axis] / -below[axis]
    ends += below
    ends[axis] = 0.0
    return result


def split_at_horizon(vertices: np.ndarray, axis: int = 2):
    """Yield (index (Q,), polygons (C, W, Q)): the parts of polygons (C, V, P) where coordinate `axis` is positive, for
    the points that see some of theirs. Whole polygons come first, then clipped ones."""
    corners = vertices.shape[1]
    if corners > PATTERN_CORNERS:
        patterns, above = None, vertices[axis] > 0.0
        kinds = np.where(above.all(axis=0), WHOLE, np.where(above.any(axis=0), SEVERAL_RUNS, DARK))
    else:
        patterns = horizon_patterns(vertices[axis])
        kinds = _pattern_kinds(corners)[patterns]
    for kind in (WHOLE, SINGLE_RUN, SEVERAL_RUNS):
        index = np.nonzero(kinds == kind)[0]
        if len(index) == 0:
            continue
        clipped = vertices if len(index) == len(kinds) else np.take(vertices, index, axis=2)
        if kind == SINGLE_RUN:
            clipped = clip_single_run(clipped, patterns[index], axis)
        elif kind == SEVERAL_RUNS:
            clipped = clip_to_horizon(clipped, axis)
        yield index, clipped


def integrate_visible(corners: np.ndarray, facing: np.ndarray, clip_rows, count: int, integrate):
    """Integrals (count, P) over the visible parts of polygons (C, V, P), and the mask (P,) of points that need float64.

    A point that is `facing` (P,) its polygon sees the part where all coordinates `clip_rows` are positive.
    `integrate(polygons (C, W, Q), index)` returns (count, Q) and a mask (Q,) for the points `index` (None: all).
    """
    whole = facing.copy()
    partly = facing
    for row in clip_rows:
        whole &= np.minimum.reduce(corners[row], axis=0) > 0.0
    seen_whole = np.count_nonzero(whole)
    points = len(facing)
    if seen_whole == points:
        return integrate(corners, None)
    for row in clip_rows:
        partly = partly & (np.maximum.reduce(corners[row], axis=0) > 0.0)
    cut = np.nonzero(partly & ~whole)[0]
    values, needs_float64 = np.zeros((count, points), np.float32), np.zeros(points, bool)
    if seen_whole > MOSTLY_WHOLE * points:
        integrals, mask = integrate(corners, None)
        np.multiply(integrals, whole, out=values)
        np.logical_and(mask, whole, out=needs_float64)
    elif seen_whole:
        index = np.nonzero(whole)[0]
        values[:, index], needs_float64[index] = integrate(np.take(corners, index, axis=2), index)
    if len(cut):
        for index, polygons in _clipped(np.take(corners, cut, axis=2), clip_rows):
            values[:, cut[index]], needs_float64[cut[index]] = integrate(polygons, cut[index])
    return values, needs_float64


def _clipped(corners, clip_rows):
    """Yield (index, polygons): the parts of polygons (C, V, P) where all coordinates `clip_rows` are positive."""
    if not clip_rows:
        yield np.arange(corners.shape[2]), corners
        return
    for outer, above in split_at_horizon(corners, clip_rows[0]):
        for inner, polygons in _clipped(above, clip_rows[1:]):
            yield outer[inner], polygons


def split_long_edges(vertices: np.ndarray) -> np.ndarray:
    """Polygons (3, V, P) with a corner added on every edge (3, 2 V, P): its point nearest to the origin.

    An edge that passes close by the origin is an arc of almost half a circle, whose plane is lost to rounding. With the
    new corner, itself rounded, all integrals are those of the same polygon.
    """
    following = np.roll(vertices, -1, axis=1)
    along = following - vertices
    squared = dot(along, along)
    squared = np.where(squared > 0.0, squared, 1.0)
    # Both directions of an edge give the same bits.
    start, end = (np.clip(side / squared, 0.0, 1.0) for side in (dot(following, along), -dot(vertices, along)))
    nearest = start * vertices + end * following
    return np.stack([vertices, nearest], axis=2).reshape(3, -1, vertices.shape[2])


def project_to_sphere(vertices: np.ndarray) -> np.ndarray:
    """Unit vectors along `vertices` (3, V, P); a corner at the origin stays (0, 0, 0)."""
    return vertices / np.sqrt(np.maximum(dot(vertices, vertices), np.finfo(vertices.dtype).tiny))


def edge_sums(unit: np.ndarray) -> np.ndarray:
    """Sums (3, V, P) of the two ends of every edge of spherical polygons (3, V, P).

    The contribution of an edge is computed from its start and this sum, which is exact if the ends are nearly opposite:
    a x b = a x (a + b) and 1 + a . b = |a + b|^2 / 2 keep their digits then.
    """
    return unit + np.roll(unit, -1, axis=1)


def one_plus_cosine(total: np.ndarray) -> np.ndarray:
    """1 + cos(theta) of edges of length theta from the sums (3, ...) of their ends."""
    return 0.5 * dot(total, total)


def solid_angle(unit: np.ndarray) -> np.ndarray:
    """Signed solid angle (P,) in sr of spherical polygons (3, V, P) in the hemisphere z >= 0.

    It is positive if the corners run counterclockwise about +z as seen from outside the sphere. An area around which
    the boundary winds several times counts as often. It is the sum over the edges of the spherical triangles with apex
    e_z (Van Oosterom and Strackee 1983), each at most pi.
    """
    total = edge_sums(unit)
    imaginary = unit[0] * total[1] - unit[1] * total[0]
    return 2.0 * np.arctan2(imaginary, total[2] + one_plus_cosine(total)).sum(axis=0)


def convex_pieces(corners: np.ndarray) -> list[np.ndarray]:
    """Convex polygons (W, 3) that make up the simple, flat polygon `corners` (V, 3), with its sense of rotation.

    Repeated corners and corners on straight edges are left out. A polygon without area gives no pieces, a convex one
    itself, and others triangles: ears that are clipped off.
    """
    flat = _in_its_plane(corners)
    size = np.ptp(flat, axis=0).max()
    limit = STRAIGHT * size * size
    ring = _without_straight_corners(list(range(len(flat))), flat, limit)
    if len(ring) < 3:
        return []
    points = flat[ring]
    is_convex = (_turn(np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0)) > 0.0).all()
    return [corners[piece] for piece in ([ring] if is_convex else _ears(ring, flat, limit))]


def _in_its_plane(corners):
    """Coordinates (V, 2) in which the polygon runs counterclockwise."""
    offset = corners - corners.mean(axis=0)
    normal = np.cross(offset, np.roll(offset, -1, axis=0)).sum(axis=0)
    length = np.sqrt(normal @ normal)
    if length == 0.0:
        return np.zeros((len(corners), 2))
    normal = normal / length
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.sqrt(first @ first)
    return np.stack([offset @ first, offset @ np.cross(normal, first)], axis=1)


def _turn(a, b, c):
    """Twice the area of triangles, positive if they run counterclockwise."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _without_straight_corners(ring, flat, limit):
    """The corners of `ring` at which the polygon turns."""
    position = 0
    while len(ring) >= 3 and position < len(ring):
        before, corner, after = (ring[(position + step) % len(ring)] for step in (-1, 0, 1))
        if abs(_turn(flat[before], flat[corner], flat[after])) <= limit:
            del ring[position]
            # The corner before may be straight now.
            position = max(position - 2, 0)
        else:
            position += 1
    return ring


def _ears(ring, flat, limit):
    """Triangles, lists of corners, that fill the ring."""
    triangles, ring = [], list(ring)
    while len(ring) > 3:
        best = _next_ear(ring, flat)
        triangles.append([ring[best - 1], ring[best], ring[(best + 1) % len(ring)]])
        del ring[best]
        ring = _without_straight_corners(ring, flat, limit)
    return [*triangles, ring] if len(ring) == 3 else triangles


def _next_ear(ring, flat):
    """Position of the best ear: the one least like a sliver among those without another corner inside."""
    points = flat[ring]
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    area = _turn(before, points, after)
    sides = [((p - q) ** 2).sum(axis=1) for p, q in ((before, points), (points, after), (after, before))]
    quality = area / np.maximum(sum(sides), np.finfo(float).tiny)
    for position in np.argsort(-quality):
        if area[position] <= 0.0:
            break
        a, b, c = before[position], points[position], after[position]
        inside = (_turn(a, b, points) >= 0.0) & (_turn(b, c, points) >= 0.0) & (_turn(c, a, points) >= 0.0)
        is_corner = (points == a).all(axis=1) | (points == b).all(axis=1) | (points == c).all(axis=1)
        if not (inside & ~is_corner).any():
            return int(position)
    # The polygon is not simple: the smallest triangle does the least harm.
    return int(np.argmin(np.abs(area)))
