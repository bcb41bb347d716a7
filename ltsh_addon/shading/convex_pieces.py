"""Simple polygons cut into convex pieces: ears are clipped off, then pieces are joined as long as they stay convex.

The joining is that of Hertel and Mehlhorn 1983: at most four times as many pieces as needed.
"""

from __future__ import annotations

import numpy as np

# Turns below this share of the squared size of the polygon count as straight.
STRAIGHT = 1e-12


def convex_pieces(corners: np.ndarray) -> list[np.ndarray]:
    """Convex polygons (W, 3), all the same way around as the simple, flat polygon `corners` (V, 3) that they make up.

    Repeated corners and corners on straight edges are left out. A polygon without area gives no pieces.
    """
    flat = _in_its_plane(corners)
    size = np.ptp(flat, axis=0).max()
    limit = STRAIGHT * size * size
    ring = _without_straight_corners(list(range(len(flat))), flat, limit)
    if len(ring) < 3:
        return []
    pieces = _joined(_ears(ring, flat, limit), flat, limit)
    return [corners[piece] for piece in pieces]


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
    """Twice the area of triangles, positive where they run counterclockwise."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _without_straight_corners(ring, flat, limit):
    """The corners of `ring` at which the polygon turns."""
    position = 0
    while len(ring) >= 3 and position < len(ring):
        before, corner, after = (ring[(position + step) % len(ring)] for step in (-1, 0, 1))
        if abs(_turn(flat[before], flat[corner], flat[after])) <= limit:
            del ring[position]
            # The neighbor before may be straight now.
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
    """Position of the best ear: of those without another corner inside, the one that is the least like a sliver."""
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
        own = (points == a).all(axis=1) | (points == b).all(axis=1) | (points == c).all(axis=1)
        if not (inside & ~own).any():
            return int(position)
    # Not a simple polygon: the smallest triangle does the least harm.
    return int(np.argmin(np.abs(area)))


def _joined(pieces, flat, limit):
    """The pieces, lists of corners, joined along common edges as long as the union is convex."""
    pieces = [list(piece) for piece in pieces]
    first = 0
    while first < len(pieces):
        for second in range(first + 1, len(pieces)):
            union = _union(pieces[first], pieces[second], flat, limit)
            if union is not None:
                pieces[first] = union
                del pieces[second]
                break
        else:
            first += 1
    return pieces


def _union(a, b, flat, limit):
    """The two polygons as one, if they share an edge and make a convex polygon; else None."""
    for position, start in enumerate(a):
        end = a[(position + 1) % len(a)]
        for other, corner in enumerate(b):
            if corner == end and b[(other + 1) % len(b)] == start:
                # a from `end` around to `start`, then b from there to `end`
                ring = a[position + 1 :] + a[: position + 1] + (b[other:] + b[:other])[2:]
                points = flat[ring]
                turns = _turn(np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0))
                return ring if (turns >= -limit).all() else None
    return None
