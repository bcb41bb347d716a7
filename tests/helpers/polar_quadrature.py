"""Fast quadrature over spherical polygons in polar coordinates around e_z: batches of polygons, smooth functions.

The part above the horizon of a polygon is swept by meridians from e_z to its boundary,

    int f dw = sum_edges int_edge G(w) dphi,   G(w) = int_0^theta f sin(t) dt along the meridian to w,

with the sign of dphi, so that any flat polygon will do; one around -e_z lacks a hemisphere. Where an edge runs below
the horizon its meridians end there: nothing is clipped. Both integrals are Gauss-Legendre rules. Along an arc
dphi = (x dy - y dx) / sin^2(theta), and G / sin^2 is smooth at e_z: for polynomials of low degree on the sphere the
rules converge to rounding. No closed form of an edge enters.
"""

import numpy as np

INNER, OUTER = 10, 14


def integrate(polygons, function):
    """Signed integrals (P,) of function(directions (P, S, 3)) -> (P, S) over the parts above z = 0 of polygons
    (P, V, 3); positive where corners run counterclockwise as seen from outside."""
    total = -_winding_around_nadir(polygons) * _over_hemisphere(len(polygons), function)
    for corner in range(polygons.shape[1]):
        start, end = polygons[:, corner], polygons[:, (corner + 1) % polygons.shape[1]]
        height, other = start[:, 2:], end[:, 2:]
        crosses = (height > 0.0) != (other > 0.0)
        share = np.where(crosses, height / np.where(crosses, height - other, 1.0), 0.0)
        crossing = (start + share * (end - start)) * np.array([1.0, 1.0, 0.0])
        # Of an edge that does not cross the horizon one of the parts is a point, where it begins.
        rises = other > 0.0
        above = np.where(height > 0.0, start, crossing), np.where(rises, end, crossing)
        below = np.where(height > 0.0, crossing, start), np.where(rises, crossing, end)
        never, always = ~crosses & (height <= 0.0), ~crosses & (height > 0.0)
        total += _along_arc(*(np.where(never, np.array([1.0, 0.0, 0.0]), point) for point in above), function)
        total += _along_horizon(*(np.where(always, np.array([1.0, 0.0, 0.0]), point) for point in below), function)
    return total


def _winding_around_nadir(polygons):
    """How often (P,) the flat polygons (P, V, 3) run around -e_z, in the sense of the azimuth."""
    following = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0]
    turns = np.arctan2(cross, (polygons[..., :2] * following[..., :2]).sum(axis=2)).sum(axis=1)
    offset = polygons - polygons[:, :1]
    normal = np.cross(offset, np.roll(offset, -1, axis=1)).sum(axis=1)
    below = (normal * polygons[:, 0]).sum(axis=1) * normal[:, 2] < 0.0
    return np.where(below, np.rint(turns / (2.0 * np.pi)), 0.0)


def _over_hemisphere(count, function):
    angle = 2.0 * np.pi * np.arange(4) / 3
    corners = np.stack([np.cos(angle), np.sin(angle), np.zeros(4)], axis=1)[:, None] * np.ones((count, 1))
    return sum(_along_horizon(corners[n], corners[n + 1], function) for n in range(3))


def _along_arc(start, end, function):
    """Sum over the arcs through which segments (P, 3) above the horizon are seen."""
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / np.where(length > 0.0, length, 1.0)
    # The segment's point nearest to the origin, from the end that is nearer to it.
    near = np.where((start**2).sum(axis=1, keepdims=True) < (end**2).sum(axis=1, keepdims=True), start, end)
    foot = near - (near * along).sum(axis=1, keepdims=True) * along
    distance = np.linalg.norm(foot, axis=1)
    foot = foot / np.where(distance > 0.0, distance, 1.0)[:, None]
    first, last = (np.arctan2((point * along).sum(axis=1), distance) for point in (start, end))
    middle = 0.5 * (first + last)
    total = 0.0
    for low, high in ((first, middle), (middle, last)):
        for node, weight in zip(*_rule(OUTER), strict=True):
            angle = (low + node * (high - low))[:, None]
            point = np.cos(angle) * foot + np.sin(angle) * along
            velocity = np.cos(angle) * along - np.sin(angle) * foot
            turn = point[:, 0] * velocity[:, 1] - point[:, 1] * velocity[:, 0]
            total = total + weight * (high - low) * turn * _along_meridian(point, function)
    return total


def _along_horizon(start, end, function):
    """As `_along_arc` of segments below the horizon: of the horizon's arc over them."""
    cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    turn = np.arctan2(cross, start[:, 0] * end[:, 0] + start[:, 1] * end[:, 1])
    first = np.arctan2(start[:, 1], start[:, 0])
    total = 0.0
    for node, weight in zip(*_rule(OUTER), strict=True):
        angle = first + node * turn
        point = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        total = total + weight * turn * _along_meridian(point, function)
    return total


def _along_meridian(point, function):
    """Integrals (P,) of f sin(t) dt / sin^2(theta) from e_z to unit vectors (P, 3)."""
    nodes, weights = _rule(INNER)
    radius = np.hypot(point[:, 0], point[:, 1])
    theta = np.arctan2(radius, point[:, 2])
    heading = point[:, :2] / np.where(radius > 0.0, radius, 1.0)[:, None]
    angle = theta[:, None] * nodes
    sine = np.sin(angle)
    directions = np.stack([sine * heading[:, :1], sine * heading[:, 1:], np.cos(angle)], axis=2)
    # (sin t / sin theta) dt / sin theta, whose limit at e_z is node / theta^2 theta d(node)
    small = radius < 1e-7
    scale = np.where(small, 1.0, theta / np.where(small, 1.0, radius) ** 2)
    measure = np.where(small[:, None], nodes, sine * scale[:, None])
    return (function(directions) * measure) @ weights


def _rule(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights
