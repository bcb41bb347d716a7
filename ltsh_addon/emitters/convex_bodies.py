"""Convex bodies that glow evenly: from each point outside, all of their lights together are one polygon.

The lights of a glowing mesh that is closed, convex and of one radiance cover, as a point outside sees them, the inside
of the outline of the mesh, each direction once. The outline has about the square root of as many corners as the mesh
has lights. It is exact where it has few corners. Of more corners, lobes that cannot tell get fewer, on a polygon with
the same area and centroid in the plane square to the way to the body.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..lobes.polygon import dot, normal_frames
from ..scene import PolygonLight
from .light_polygons import ROUND_CORNERS, ROUND_LIMITS
from .planar_polygons import connected

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
