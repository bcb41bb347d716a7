"""The largest flat polygons of a triangle mesh, and its outer side. Needs no bpy."""

from dataclasses import dataclass

import numpy as np

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
