"""Where a UV map is cut, and where the surface goes on beyond a cut: margins of adjacent faces. Needs no bpy.

As Blender's bake has it (margin type ADJACENT_FACES): a point at some distance, in texels, outside of an edge shows
what lies at that distance inside of the same edge of the mesh where the UV map has it a second time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .uv_raster import cross, repeated

# UV coordinates closer than this are one point.
SAME_UV = 1e-6
# Points looked up at a time.
POINTS_PER_BLOCK = 32768
_NEIGHBORS = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]


@dataclass(frozen=True)
class UvSeams:
    """E edges of triangles at which a UV map is cut and the surface is not, in texels of one tile."""

    edges: np.ndarray  # (E, 2, 2) both ends
    outward: np.ndarray  # (E, 2) unit
    beyond: np.ndarray  # (E, 2, 2) the same ends on the other side of the cut
    inward: np.ndarray  # (E, 2) unit, into the triangle on the other side
    island: np.ndarray  # (E,) that the other side belongs to
    islands: np.ndarray  # (T,) number of the part of the UV map that each triangle belongs to
    size: tuple[int, int]  # width, height
    cells: np.ndarray  # (N,) increasing: texels that edges pass through, (y + 1) * (W + 2) + x + 1
    crossing: np.ndarray  # (N,) the edges

    @classmethod
    def of(cls, uv: np.ndarray, vertices: np.ndarray, width: int, height: int, tile=(0, 0)) -> UvSeams:
        """Seams of triangles uv (T, 3, 2) with vertices (T, 3) of the mesh, on a texture that fills the unit square at
        `tile`."""
        uv = np.asarray(uv, dtype=np.float64)
        edge, partner = _paired(vertices)
        same = _ends(vertices, edge) == _ends(vertices, partner)
        ends, others = _ends(uv, edge), _ends(uv, partner)
        others = np.where(same[:, :1, None], others, others[:, ::-1])
        together = (np.abs(ends - others) <= SAME_UV).all(axis=(1, 2))
        islands = _connected(len(uv), edge[together] // 3, partner[together] // 3)
        corners = (uv - np.asarray(tile)) * (width, height)
        third, other_third = _third(corners, edge), _third(corners, partner)
        ends, others = ((part - np.asarray(tile)) * (width, height) for part in (ends, others))
        with np.errstate(invalid="ignore"):
            inward, other_inward = _towards(ends, third), _towards(others, other_third)
            cut = ~together & np.isfinite(inward).all(axis=1) & np.isfinite(other_inward).all(axis=1)
        edges = ends[cut]
        cells, crossing = _cells(edges, width, height)
        island = islands[partner[cut] // 3]
        parts = (edges, -inward[cut], others[cut], other_inward[cut], island, islands)
        return cls(*parts, (width, height), cells, crossing)

    def reflected(self, points: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For points (P, 2) in texels, outside of all triangles, and for each the covered texel `near` (P, 2) closest
        to it: the points (Q,) that have an edge in front of them, where the surface goes on (Q, 2), and the island."""
        found = [
            self._reflected(points[first : first + POINTS_PER_BLOCK], near[first : first + POINTS_PER_BLOCK], first)
            for first in range(0, max(len(points), 1), POINTS_PER_BLOCK)
        ]
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))

    def _reflected(self, points, near, first):
        point, edge = self._candidates(near)
        start, side = self.edges[edge, 0], self.edges[edge, 1] - self.edges[edge, 0]
        offset = points[point] - start
        share = (offset * side).sum(axis=1) / (side * side).sum(axis=1)
        distance = (offset * self.outward[edge]).sum(axis=1)
        facing = np.flatnonzero((share >= 0.0) & (share <= 1.0) & (distance > 0.0))
        order = facing[np.lexsort((edge[facing], distance[facing], point[facing]))]
        closest = order[np.flatnonzero(np.diff(point[order], prepend=-1))]
        point, edge, share, distance = point[closest], edge[closest], share[closest, None], distance[closest, None]
        beyond = self.beyond[edge, 0] * (1.0 - share) + self.beyond[edge, 1] * share
        return point + first, beyond + distance * self.inward[edge], self.island[edge]

    def _candidates(self, near):
        """(point, edge) for the edges through the texels around `near`; a pair may come several times."""
        stride = self.size[0] + 2
        cell = np.concatenate([(near[:, 1] + 1 + y) * stride + near[:, 0] + 1 + x for x, y in _NEIGHBORS])
        low = np.searchsorted(self.cells, cell, side="left")
        which, step = repeated(np.searchsorted(self.cells, cell, side="right") - low)
        return which % max(len(near), 1), self.crossing[low[which] + step]


def _paired(vertices):
    """Numbers (N,) 3 * triangle + corner of the edges that some other triangle has too, and those of the others."""
    ends = np.sort(np.stack([vertices, np.roll(vertices, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    new = np.concatenate([[True], (np.diff(ends[order], axis=0) != 0).any(axis=1)]) if len(order) else order
    start = np.flatnonzero(new)
    count = np.diff(start, append=len(order))
    # Of an edge with more than two triangles every one goes on into the next.
    last = start + count - 1
    following = np.arange(len(order)) + 1
    following[last] = start
    shared = np.repeat(count > 1, count)
    return order[shared], order[following[shared]]


def _ends(values, edge):
    """Values (T, 3, ...) at both ends of edges (N,): (N, 2, ...)."""
    return np.stack([values[edge // 3, edge % 3], values[edge // 3, (edge + 1) % 3]], axis=1)


def _third(values, edge):
    return values[edge // 3, (edge + 2) % 3]


def _towards(ends, corner):
    """Unit vectors (N, 2) perpendicular to edges (N, 2, 2) towards the side of a corner (N, 2); NaN without area."""
    side = ends[:, 1] - ends[:, 0]
    turn = np.sign(cross(side, corner - ends[:, 0]))
    length = np.linalg.norm(side, axis=1)
    scale = np.divide(turn, length, out=np.full(len(side), np.nan), where=(length > 0.0) & (turn != 0.0))
    return np.stack([-side[:, 1], side[:, 0]], axis=-1) * scale[:, None]


def _connected(count, first, second):
    """The smallest number (count,) that each is connected to by pairs first (N,), second (N,)."""
    label = np.arange(count)
    while True:
        a, b = label[first], label[second]
        if np.array_equal(a, b):
            return label
        smaller = np.minimum(a, b)
        np.minimum.at(label, a, smaller)
        np.minimum.at(label, b, smaller)
        while not np.array_equal(label, label[label]):
            label = label[label]


def _cells(edges, width, height):
    """(cells, edges) as in UvSeams, found by points half a texel apart on the part of each edge that is in the tile."""
    start, side = edges[:, 0], edges[:, 1] - edges[:, 0]
    first, last = np.zeros(len(edges)), np.ones(len(edges))
    for axis, limit in ((0, width), (1, height)):
        along = np.where(side[:, axis] != 0.0, side[:, axis], 1e-30)
        to_low, to_high = (-1.0 - start[:, axis]) / along, (limit + 1.0 - start[:, axis]) / along
        first, last = np.maximum(first, np.minimum(to_low, to_high)), np.minimum(last, np.maximum(to_low, to_high))
    steps = np.ceil(2.0 * (last - first) * np.linalg.norm(side, axis=1)) + 1.0
    edge, step = repeated(np.where(last >= first, steps, 0.0))
    share = first[edge] + (last - first)[edge] * (step / np.maximum(steps[edge] - 1.0, 1.0))
    at = np.floor(start[edge] + share[:, None] * side[edge]).astype(np.int64)
    at = np.clip(at, -1, (width, height)) + 1
    pairs = np.unique(np.stack([at[:, 1] * (width + 2) + at[:, 0], edge]), axis=1)
    return pairs[0], pairs[1]
