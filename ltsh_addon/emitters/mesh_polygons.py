"""The polygons of glowing meshes: the largest flat ones of a triangle mesh, and its outer side; and convex bodies.

Of convex bodies that glow evenly, all lights together are one polygon from each point outside. The lights of a mesh
that is closed, convex and of one radiance cover, as a point outside sees them, the inside of the outline of the mesh,
each direction once. The outline has about the square root of as many corners as the mesh has lights. It is exact where
it has few corners. Of more corners, lobes that cannot tell get fewer, on a polygon with the same area and centroid in
the plane square to the way to the body.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..lobes.polygon import dot, normal_frames
from ..scene import PolygonLight
from .light_polygons import ROUND_CORNERS, ROUND_LIMITS

# Two triangles with a common edge are in one plane if the angle between them is below PLANE_ANGLE, in rad, and if they
# are off it by at most PLANE_DISTANCE of their size. The limits allow for vertices in single precision.
PLANE_ANGLE = 1e-3
PLANE_DISTANCE = 1e-5
# A union of triangles is flat if it is off its plane by at most this share of its extent.
FLATNESS = 1e-4
# A corner is on a straight edge if its distance from the line between its neighbors is at most this share of the
# largest coordinate.
STRAIGHT = 1e-6
# A closed surface is a sheet if its volume is below this share of the cube of its extent.
SHEET = 1e-6


@dataclass(frozen=True)
class FlatPolygon:
    """A simple polygon, counterclockwise around its unit normal."""

    corners: np.ndarray  # (V, 3)
    normal: np.ndarray  # (3,)
    label: int


def flat_polygons(vertices: np.ndarray, triangles: np.ndarray, labels: np.ndarray) -> list[FlatPolygon]:
    """Polygons that cover the `triangles` (T, 3), indices of `vertices` (N, 3). None has more than one of the `labels`
    (T,).

    Neighbors in one plane become one polygon if their union is simple, that is, has one outline that does not touch
    itself.
    """
    crossed = np.cross(
        vertices[triangles[:, 1]] - vertices[triangles[:, 0]], vertices[triangles[:, 2]] - vertices[triangles[:, 0]]
    )
    area = np.linalg.norm(crossed, axis=-1)
    solid = area > 1e-12 * max(area.max(initial=0.0), 1e-300)
    triangles, labels, normals = triangles[solid], labels[solid], crossed[solid] / area[solid, None]
    neighbors = _coplanar_neighbors(vertices, triangles, labels, normals)
    groups = connected(len(triangles), neighbors)
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
    ends = np.append(starts[1:], len(order))[: len(starts)]
    polygons: dict[int, FlatPolygon] = {}  # by their place in `order`
    labels, triangle_corners = labels.tolist(), vertices[triangles]
    pairs = starts[ends - starts == 2]
    corners, pair_normals, are_quads = _quads(vertices, triangles[order[pairs]], triangles[order[pairs + 1]])
    for start, quad, normal in zip(pairs[are_quads].tolist(), corners[are_quads], pair_normals[are_quads], strict=True):
        polygons[start] = FlatPolygon(quad, normal, labels[order[start]])
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if start in polygons:
            continue
        members = order[start:end]
        outline = _outline(vertices, triangles[members]) if len(members) > 1 else None
        if outline is not None:
            polygons[start] = FlatPolygon(outline, _normal(outline), labels[members[0]])
            continue
        for rank, index in enumerate(members.tolist(), start):
            polygons[rank] = FlatPolygon(triangle_corners[index], normals[index], labels[index])
    return [polygons[rank] for rank in sorted(polygons)]


def _quads(vertices, first, second) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (G, 4, 3), unit normals (G, 3) and mask (G,) of pairs of coplanar triangles (G, 3) that clearly are a
    flat polygon of four corners. `_outline` looks at the other pairs one by one."""
    matches = (first[:, :, None] == np.roll(second, -1, axis=1)[:, None]) & (
        np.roll(first, -1, axis=1)[:, :, None] == second[:, None]
    )
    rows, match = np.arange(len(first)), matches.reshape(-1, 9).argmax(axis=1)
    edge, other = match // 3, match % 3
    index = [first[rows, (edge + step) % 3] for step in (1, 2, 0)] + [second[rows, (other + 2) % 3]]
    corners = vertices[np.stack(index, axis=1)]
    offset = corners - corners.mean(axis=1, keepdims=True)
    before, after = corners - np.roll(corners, 1, axis=1), np.roll(corners, -1, axis=1) - corners
    area = np.linalg.norm(np.cross(before, after), axis=-1)
    limit = STRAIGHT * np.maximum(np.abs(corners).max(axis=(1, 2)), np.ptp(corners, axis=1).max(axis=1))
    good = (matches.sum(axis=(1, 2)) == 1) & (area > limit[:, None] * np.linalg.norm(before + after, axis=-1)).all(
        axis=1
    )
    normals = np.cross(offset, np.roll(offset, -1, axis=1)).sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    height = np.abs((offset * normals[:, None]).sum(axis=-1)).max(axis=1)
    good &= height <= FLATNESS * np.linalg.norm(offset, axis=-1).max(axis=1)
    return corners, normals, good


def _coplanar_neighbors(vertices, triangles, labels, normals) -> np.ndarray:
    """Pairs (M, 2) of coplanar triangles that run through a common edge in opposite directions."""
    count = len(triangles)
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    owner, apex = np.repeat(np.arange(count), 3), np.roll(triangles, -2, axis=1).ravel()
    keys = np.stack([np.minimum(start, end), np.maximum(start, end)], axis=-1)
    _, edge, uses = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    order = order[uses[edge[order]] == 2]
    one, other = order[0::2], order[1::2]
    first, second = owner[one], owner[other]
    length = np.linalg.norm(vertices[start[one]] - vertices[end[one]], axis=-1)
    height = np.abs(np.sum((vertices[apex[other]] - vertices[start[one]]) * normals[first], axis=-1))
    turn = np.linalg.norm(normals[first] - normals[second], axis=-1)
    reach = np.maximum(length, np.linalg.norm(vertices[apex[other]] - vertices[start[one]], axis=-1))
    flat = (turn < PLANE_ANGLE) & (height <= PLANE_DISTANCE * reach)
    fits = flat & (start[one] == end[other]) & (labels[first] == labels[second])
    return np.stack([first[fits], second[fits]], axis=-1)


def connected(count: int, pairs: np.ndarray) -> np.ndarray:
    """The smallest index (count,) to which `pairs` (M, 2) connect each item."""
    label, (first, second) = np.arange(count), pairs.T
    while True:
        a, b = label[first], label[second]
        if np.array_equal(a, b):
            return label
        smaller = np.minimum(a, b)
        np.minimum.at(label, a, smaller)
        np.minimum.at(label, b, smaller)
        while not np.array_equal(label, label[label]):
            label = label[label]


def _outline(vertices, triangles) -> np.ndarray | None:
    """Corners (V, 3) of the union of coplanar `triangles`; None if that is no simple, flat polygon."""
    edges = {(int(a), int(b)) for triangle in triangles for a, b in zip(triangle, np.roll(triangle, -1), strict=True)}
    follow: dict[int, int] = {}
    for a, b in edges:
        if (b, a) not in edges:
            if a in follow:
                return None
            follow[a] = b
    loop = [next(iter(follow))] if follow else []
    while loop and follow.get(loop[-1]) is not None and follow[loop[-1]] != loop[0]:
        loop.append(follow[loop[-1]])
    if len(loop) < 3 or len(loop) != len(follow):
        return None
    corners = _without_straight_corners(vertices[loop])
    if len(corners) < 3:
        return None
    offset = corners - corners.mean(axis=0)
    flat = np.abs(offset @ _normal(corners)).max() <= FLATNESS * np.linalg.norm(offset, axis=-1).max()
    return corners if flat else None


def _without_straight_corners(corners):
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    chord = np.linalg.norm(before + after, axis=-1)
    area = np.linalg.norm(np.cross(before, after), axis=-1)
    limit = STRAIGHT * max(np.abs(corners).max(), np.ptp(corners, axis=0).max())
    return corners[area > limit * chord]


def _normal(corners: np.ndarray) -> np.ndarray:
    """Unit normal (3,) around which `corners` run counterclockwise."""
    offset = corners - corners.mean(axis=0)
    normal = np.cross(offset, np.roll(offset, -1, axis=0)).sum(axis=0)
    return normal / np.linalg.norm(normal)


def welded(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The `triangles` (T, 3) with the same index for all vertices (N, 3) at the same place."""
    _, first, number = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    return first[number.ravel()[triangles]]


def outward_side(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """The side from which closed `triangles` (T, 3) are seen: 1 if their normals point there, otherwise -1.

    A sheet of two layers, front and back, has no volume. Each layer is seen from the side of its normal.
    """
    return -1 if signed_volume(vertices, triangles) < -SHEET * np.ptp(vertices, axis=0).max() ** 3 else 1


def is_closed(triangles: np.ndarray) -> bool:
    """True if every edge of `triangles` (T, 3) belongs to two of them that run through it in opposite directions."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    directed = np.stack([start, end], axis=-1)
    unique, uses = np.unique(directed, axis=0, return_counts=True)
    if len(unique) == 0 or uses.max() > 1:
        return False
    reverse = unique[:, ::-1]
    return np.array_equal(unique, reverse[np.lexsort((reverse[:, 1], reverse[:, 0]))])


def signed_volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Volume inside closed `triangles` (T, 3), positive if their normals point outward."""
    offset = vertices - vertices.mean(axis=0)
    a, b, c = (offset[triangles[:, side]] for side in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def is_inside(point: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> bool:
    """True if closed `triangles` (T, 3) surround `point` (3,).

    Uses the sum of solid angles (Van Oosterom and Strackee 1983, doi:10.1109/TBME.1983.325207).
    """
    a, b, c = (vertices[triangles[:, side]] - point for side in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    volume = np.sum(a * np.cross(b, c), axis=-1)
    plane = la * lb * lc + np.sum(a * b, -1) * lc + np.sum(b * c, -1) * la + np.sum(c * a, -1) * lb
    return bool(abs(2.0 * np.arctan2(volume, plane).sum()) > 2.0 * np.pi)


# Surfaces are spheres whose corners are off one by at most BALL_CORNERS of its radius, and whose faces lie at least
# BALL_FACES of it from its center: an icosahedron whose edges were halved twice does.
BALL_CORNERS, BALL_FACES = 0.01, 0.93


@dataclass(frozen=True)
class Ball:
    """A component of a closed triangle mesh that is nearly a sphere."""

    center: np.ndarray  # (3,)
    radius: float  # that of the corners
    area: float  # of the triangles
    label: int
    triangles: np.ndarray  # numbers of them


def balls(vertices: np.ndarray, triangles: np.ndarray, labels: np.ndarray, side: int = 1) -> list[Ball]:
    """The connected components of closed `triangles` (T, 3), indices of `vertices` (N, 3), that are nearly spheres,
    have one of the `labels` (T,) each, and whose normals times `side` (1 or -1) point outward.

    From all sides together a convex body is seen as large as a sphere with its surface area (Cauchy 1832).
    """
    triangles = welded(vertices, triangles)
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    component = connected(len(vertices), edges)[triangles[:, 0]]
    spheres, order = [], np.argsort(component, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        corners = vertices[triangles[members]]
        crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(crossed, axis=-1)
        if len(np.unique(labels[members])) > 1 or not area.all():
            continue
        center = np.average(corners.mean(axis=1), axis=0, weights=area)
        distances = np.linalg.norm(corners - center, axis=-1)
        heights = side * ((corners[:, 0] - center) * crossed).sum(axis=-1) / (2.0 * area)
        radius = distances.max()
        is_ball = distances.min() > (1.0 - BALL_CORNERS) * radius and heights.min() > BALL_FACES * radius
        # Several spheres may be in one place: the area tells.
        if is_ball and BALL_FACES**2 < area.sum() / (4.0 * np.pi * radius**2) < 1.0:
            spheres.append(Ball(center, float(radius), float(area.sum()), int(labels[members[0]]), members))
    return spheres


# A body has at least so many lights. Smaller ones gain little.
FEWEST_LIGHTS = 16
# How far neighbors may be above the plane of a light, as a share of the distance, and all of the body, as a share of
# its radius.
BENT, DENTED = 1e-4, 1e-3
# Planes of a body of which all corners are checked to be behind.
PLANES_CHECKED = 64
# Points whose horizon on the body is looked for at a time: neighbors, most of which see the same lights.
POINTS = 256
# Points that see an outline farther than this cosine from the way to the body's center take its lights one by one.
LEAST_COSINE = 0.15


@dataclass(frozen=True)
class Outlines:
    """The flat polygons as which Q points see a body, square to the way to its center; in single precision."""

    points: np.ndarray  # (Q,) numbers of the points
    offset: np.ndarray  # (3, Q) m, from the points to the centers of the rectangles around the polygons
    direction: np.ndarray  # (3, Q) unit, to the points
    half_u: np.ndarray  # (3, Q) m, of the rectangles
    half_v: np.ndarray  # (3, Q)
    area: np.ndarray  # (Q,) m^2
    corners: np.ndarray  # (V, 3, Q) relative to the centers, counterclockwise as seen; unused ones repeat the first


@dataclass(frozen=True, eq=False)
class ConvexBody:
    """A closed convex surface of F lights; lengths in m, relative to `center`. Its H half edges have a light each."""

    numbers: np.ndarray  # (F,) of its lights
    center: np.ndarray  # (3,)
    normals: np.ndarray  # (F, 3) outward, whichever side shines
    heights: np.ndarray  # (F,) of the planes of the lights over the center
    starts: np.ndarray  # (3, H) first corners of the half edges
    own: np.ndarray  # (H,) place of the light to which a half edge belongs
    other: np.ndarray  # (H,) place of the light on the other side of the edge

    def outlines(self, position: np.ndarray, width: np.ndarray | float) -> Iterator[Outlines]:
        """Yield the outlines that points with x, y, z in `position` (3, Q) see, as their lobes need that are `width`
        (Q,) or a number of radians wide. Points inside the body and close to a flat side are left out."""
        position = position - self.center[:, None]
        edges, points = self._horizon(position)
        distance = np.sqrt(np.maximum(dot(position, position), 1e-300))
        frames = normal_frames(position / distance).astype(np.float32)
        corners = (np.take(self.starts, edges, axis=1) - np.take(position, points, axis=1)).astype(np.float32)
        x, y, along = (dot(corners, np.take(axis, points, axis=1)) for axis in frames)
        is_ahead = -along > LEAST_COSINE * np.sqrt(dot(corners, corners))
        count = np.bincount(points, minlength=len(distance))
        is_seen = (count >= 3) & (np.bincount(points, is_ahead, len(distance)) == count)
        seen, chosen = np.flatnonzero(is_seen), is_seen[points]
        if not len(seen):
            return
        flat = (np.stack([x, y]) / -along)[:, chosen]
        flat = flat[:, np.argsort(8.0 * points[chosen] + np.arctan2(flat[1], flat[0]))]
        count = count[seen]
        first = np.cumsum(count) - count
        radius = np.sqrt(np.maximum.reduceat((flat * flat).sum(axis=0), first))
        level = np.searchsorted(ROUND_LIMITS, radius / (width if np.ndim(width) == 0 else width[seen]))
        level[count <= np.array(ROUND_CORNERS)[level]] = -1  # all corners
        for number in np.unique(level):
            alike = np.flatnonzero(level == number)
            corner = np.arange(count[alike].max())[:, None]
            polygons = np.take(flat, first[alike] + np.where(corner < count[alike], corner, 0), axis=1)
            if number >= 0:
                polygons = fewer_corners(polygons, count[alike], ROUND_CORNERS[number])
            yield _placed(seen[alike], polygons, distance[seen[alike]].astype(np.float32), frames[:, :, seen[alike]])

    def _horizon(self, position) -> tuple[np.ndarray, np.ndarray]:
        """Half edges (N,) between a light whose outside the points (3, Q) see and one whose outside they do not see,
        and the numbers (N,) of the points."""
        edges, points = [], []
        for start in range(0, position.shape[1], POINTS):
            some = position[:, start : start + POINTS]
            low, high = some.min(axis=1), some.max(axis=1)
            height = self.normals @ (0.5 * (low + high)) - self.heights
            slack = np.abs(self.normals) @ (0.5 * (high - low)) + 1e-9 * self.heights
            chosen = np.flatnonzero((height > -slack)[self.own] & (height <= slack)[self.other])
            faces, places = np.unique(np.stack([self.own[chosen], self.other[chosen]]), return_inverse=True)
            is_near = dot(self.normals[faces].T[..., None], some[:, None]) > self.heights[faces, None]
            own, other = places.reshape(2, -1)
            edge, point = np.divmod(np.flatnonzero(is_near[own] & ~is_near[other]), some.shape[1])
            edges.append(chosen[edge])
            points.append(point + start)
        return np.concatenate(edges), np.concatenate(points)


def fewer_corners(flat: np.ndarray, count: np.ndarray, most: int) -> np.ndarray:
    """Polygons (2, `most`, Q) with the areas and centroids of the convex polygons (2, V, Q), whose corners from `count`
    (Q,) on repeat the first. Corners stay where the outline turns most, by equal steps of its affine length."""
    columns, before = np.arange(flat.shape[2]), np.roll(flat, 1, axis=1)
    before[:, 0] = flat[:, count - 1, columns]
    along = flat - before
    ahead = np.roll(along, -1, axis=1)
    length = np.cbrt(np.maximum(along[0] * ahead[1] - along[1] * ahead[0], np.float32(0.0)))
    np.cumsum(length, axis=0, out=length)
    length /= np.maximum(length[-1], 1e-300)
    steps = (np.arange(most) + 0.5) / most
    places = np.searchsorted((length.T + 2.0 * columns[:, None]).ravel(), steps + 2.0 * columns[:, None])
    chosen = np.minimum(places - len(length) * columns[:, None], count[:, None] - 1).T
    coarse = flat[:, chosen, columns]
    (area, center), (least, middle) = _area_and_centroid(flat), _area_and_centroid(coarse)
    return center[:, None] + np.sqrt(area / np.maximum(least, 1e-300)) * (coarse - middle[:, None])


def _area_and_centroid(flat):
    """Areas (Q,) and centroids (2, Q) of polygons (2, V, Q)."""
    first = flat - flat[:, :1]
    second = np.roll(first, -1, axis=1)
    twice = first[0] * second[1] - first[1] * second[0]
    area = twice.sum(axis=0)
    return 0.5 * area, flat[:, 0] + (twice * (first + second)).sum(axis=1) / (3.0 * np.maximum(area, 1e-300))


def _placed(points, flat, distance, frames) -> Outlines:
    """Polygons (2, V, Q) at distances (Q,), in units of these, along the first two of three axes; the third goes to the
    points."""
    u, v, direction = frames
    area, _ = _area_and_centroid(flat)
    # The rectangle lies along the principal axes of the corners.
    x, y = flat - flat.mean(axis=1, keepdims=True)
    angle = 0.5 * np.arctan2(2.0 * (x * y).sum(axis=0), (x * x - y * y).sum(axis=0))
    cos, sin = np.cos(angle), np.sin(angle)
    u, v = cos * u + sin * v, cos * v - sin * u
    flat = np.stack([cos * flat[0] + sin * flat[1], cos * flat[1] - sin * flat[0]])
    low, high = flat.min(axis=1), flat.max(axis=1)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * distance
    offset = distance * (middle[0] * u + middle[1] * v - direction)
    s, t = (flat - middle[:, None])[:, :, None] * distance
    return Outlines(points, offset, direction, half[0] * u, half[1] * v, area * distance**2, s * u + t * v)


def convex_bodies(lights: Sequence, corners: Sequence[np.ndarray]) -> list[ConvexBody]:
    """The bodies that some of the `lights` form; `corners` are those of `Light.polygon`."""
    chosen = [number for number, light in enumerate(lights) if isinstance(light, PolygonLight)]
    if len(chosen) < FEWEST_LIGHTS:
        return []
    sizes = np.array([len(corners[number]) for number in chosen])
    owner = np.repeat(np.arange(len(chosen)), sizes)
    places = np.concatenate([corners[number] for number in chosen])
    _, glow = np.unique([lights[number].radiance for number in chosen], axis=0, return_inverse=True)
    _, corner = np.unique(np.column_stack([places, glow.ravel()[owner]]), axis=0, return_inverse=True)
    ends = np.cumsum(sizes)
    following = np.arange(len(owner)) + 1
    following[ends - 1] = ends - sizes
    start, end = corner.ravel(), corner.ravel()[following]
    group = connected(int(start.max()) + 1, np.stack([start, end], axis=1))[start]
    order = np.argsort(group, kind="stable")
    bodies = []
    for edges in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        edges = edges[start[edges] != end[edges]]
        faces, own = np.unique(owner[edges], return_inverse=True)
        if len(faces) >= FEWEST_LIGHTS:
            normals = np.array([lights[chosen[face]].direction for face in faces])
            body = _convex_body(places[edges], normals, own, (start[edges], end[edges]))
            if body is not None:
                bodies.append(replace(body, numbers=np.array(chosen)[faces]))
    return bodies


def _convex_body(places, normals, own, ends) -> ConvexBody | None:
    """The body of half edges that start at `places` (H, 3) and belong to the faces `own` (H,) with `normals`; the ends
    are numbers of corners. None if they are not the surface of a convex body."""
    start, end = ends
    count = int(max(start.max(), end.max())) + 1
    key, reverse = start * count + end, end * count + start
    order = np.argsort(key)
    twin = order[np.minimum(np.searchsorted(key[order], reverse), len(order) - 1)]
    is_closed = (key[twin] == reverse).all() and len(np.unique(key)) == len(key)
    if not is_closed or len(np.unique(start)) - len(key) // 2 + len(normals) != 2:
        return None
    sizes = np.bincount(own)
    middles = np.stack([np.bincount(own, values) / sizes for values in places.T], axis=1)
    center = middles.mean(axis=0)
    places, middles = places - center, middles - center
    heights = (normals * middles).sum(axis=1)
    if heights.sum() < 0.0:
        normals, heights = -normals, -heights
    toward = middles[own[twin]] - places
    above = (toward * normals[own]).sum(axis=1)
    radius = np.linalg.norm(places, axis=1).max()
    some = slice(None, None, -(-len(normals) // PLANES_CHECKED))
    dent = (places @ normals[some].T - heights[some]).max()
    if (above > BENT * np.linalg.norm(toward, axis=1)).any() or dent > DENTED * radius or heights.min() <= 0.0:
        return None
    return ConvexBody(np.empty(0, int), center, normals, heights, np.ascontiguousarray(places.T), own, own[twin])
