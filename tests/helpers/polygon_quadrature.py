"""Quadrature over spherical polygons that shares nothing with the package: signed fans of flat triangles.

A direction is a point p of a flat triangle (p0, p1, p2) that it is seen through, and d omega = det(p0, p1, p2) / |p|^3
du dv. The determinant carries the sign, so a fan from any apex covers any polygon, convex or not.
"""

import numpy as np

PIECES = 6
MAX_LEVELS = 40


def above_horizon(polygon):
    """Corners (W, 3) of the part of one polygon (V, 3) above z = 0, by cutting its edges one by one."""
    corners = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] > 0.0:
            corners.append(a)
        if (a[2] > 0.0) != (b[2] > 0.0):
            corners.append((a + a[2] / (a[2] - b[2]) * (b - a)) * np.array([1.0, 1.0, 0.0]))
    return np.array(corners).reshape(-1, 3)


def edge_pieces(polygon, pieces=PIECES):
    """Polygon (V, 3) as unit vectors with every edge cut into equal arcs: no arc is close to a half circle."""
    unit = polygon / np.linalg.norm(polygon, axis=1, keepdims=True)
    following = np.roll(unit, -1, axis=0)
    dot = np.clip((unit * following).sum(axis=1), -1.0, 1.0)
    theta = np.arctan2(np.linalg.norm(np.cross(unit, following), axis=1), dot)
    across = following - dot[:, None] * unit
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = across / np.where(length > 0.0, length, 1.0)
    angle = theta[:, None] * np.arange(pieces) / pieces
    points = np.cos(angle)[..., None] * unit[:, None] + np.sin(angle)[..., None] * across[:, None]
    return points.reshape(-1, 3)


def fan(polygon, apex, pieces=PIECES):
    """Triangles (T, 3, 3) from `apex` (3,) to the pieces of the edges of `polygon` (V, 3)."""
    start = edge_pieces(np.asarray(polygon, dtype=float), pieces)
    end = np.roll(start, -1, axis=0)
    return np.stack([np.broadcast_to(apex, start.shape), start, end], axis=1)


def triangle_nodes(order):
    """Barycentric coordinates (Q, 3) and weights (Q,) of Gauss-Legendre collapsed to a triangle; weights sum to 1/2."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    radius, share = (grid.ravel() for grid in np.meshgrid(nodes, nodes, indexing="ij"))
    return np.stack([1.0 - radius, radius * (1.0 - share), radius * share], axis=1), np.outer(
        weights * nodes, weights
    ).ravel()


def integrate_triangles(triangles, function, order):
    """Integrals (..., T) of function(directions (T, Q, 3)) -> (..., T, Q) over flat triangles (T, 3, 3)."""
    coordinates, weights = triangle_nodes(order)
    points = np.matmul(coordinates, triangles)
    length = np.linalg.norm(points, axis=2)
    measure = np.linalg.det(triangles)[:, None] * weights / length**3
    return (function(points / length[..., None]) * measure).sum(axis=-1)


def integral(polygon, function, apex=(0.0, 0.0, 1.0), order=20, pieces=PIECES):
    """Signed integral of a smooth function over one polygon (V, 3), no point of it beyond 110 degrees from the apex."""
    return integrate_triangles(fan(polygon, np.array(apex), pieces), function, order).sum(axis=-1)


def adaptive_integral(polygon, function, apex=(0.0, 0.0, 1.0), tolerance=1e-8, least_levels=2):
    """Signed integral over one polygon (V, 3) of a function that may peak, best at the apex: (value, error bound).

    Triangles on which two orders disagree are quartered. `tolerance` is per triangle and absolute. The first
    `least_levels` are quartered in any case: both orders may miss a feature in the corner of a large triangle.
    """
    triangles = fan(polygon, np.array(apex), 2)
    for _ in range(least_levels):
        triangles = quartered(triangles)
    total, bound = 0.0, 0.0
    for _ in range(MAX_LEVELS):
        triangles = quartered(triangles)
        fine = integrate_triangles(triangles, function, 9)
        difference = np.abs(fine - integrate_triangles(triangles, function, 6))
        done = difference <= tolerance
        total += fine[done].sum()
        bound += difference[done].sum()
        triangles = triangles[~done]
        if len(triangles) == 0:
            return total, bound
    raise AssertionError(f"adaptive quadrature: {len(triangles)} triangles still differ after {MAX_LEVELS} levels")


def quartered(triangles):
    """Four triangles (4 T, 3, 3) for each, with corners back on the unit sphere."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, bc, ca = (middle / np.linalg.norm(middle, axis=1, keepdims=True) for middle in (a + b, b + c, c + a))
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])
