"""Polygons seen from shading points: clipping at the horizon, projection to the sphere, solid angle.

Batches of polygons are arrays (3, V, P): coordinate, corner, point. Unused corners repeat a neighbor: an edge between
equal corners contributes exactly zero to every integral.
"""

from __future__ import annotations

import numpy as np


def clip_to_horizon(vertices: np.ndarray, axis: int = 2) -> np.ndarray:
    """The part of polygons (C, V, P) with C coordinates where coordinate `axis` is positive, as (C, W, P).

    Sutherland and Hodgman 1974; W <= V + 1 where all are convex, else W <= 2 V. Each polygon needs a corner above. New
    corners have coordinate 0 exactly. A non-convex polygon may get coincident edges on the horizon, which cancel in a
    signed integral.
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
    """Move the used slots to the front, in order; repeat the last one up to the largest count of the batch."""
    count = used.sum(axis=0)
    order = np.argsort(~used, axis=0, kind="stable")
    row = np.minimum(np.arange(max(int(count.max(initial=1)), 1))[:, None], count - 1)
    index = np.take_along_axis(order, row, axis=0)
    return np.take_along_axis(slots, index[None], axis=1)


def split_at_horizon(vertices: np.ndarray, axis: int = 2):
    """Yield (index (Q,), polygons (C, W, Q)) for the points that see a part of their polygon (C, V, P) where coordinate
    `axis` is positive: first those that see all of it, then those whose polygon is clipped."""
    above = vertices[axis] > 0.0
    whole = above.all(axis=0)
    cut = above.any(axis=0) & ~whole
    if whole.any():
        index = np.nonzero(whole)[0]
        yield index, vertices if whole.all() else vertices[:, :, index]
    if cut.any():
        index = np.nonzero(cut)[0]
        yield index, clip_to_horizon(vertices[:, :, index], axis)


def project_to_sphere(vertices: np.ndarray) -> np.ndarray:
    """Unit vectors along `vertices` (3, V, P); a corner at the origin stays (0, 0, 0)."""
    squared = vertices[0] * vertices[0] + vertices[1] * vertices[1] + vertices[2] * vertices[2]
    tiny = np.finfo(vertices.dtype).tiny
    return vertices / np.sqrt(np.maximum(squared, tiny))


def edge_sums(unit: np.ndarray) -> np.ndarray:
    """Sums (3, V, P) of the two ends of every edge of spherical polygons (3, V, P).

    What an edge contributes is computed from its start and this sum, which is exact where the ends are nearly opposite:
    a x b = a x (a + b) and 1 + a . b = |a + b|^2 / 2 keep their digits there.
    """
    return unit + np.roll(unit, -1, axis=1)


def one_plus_cosine(total: np.ndarray) -> np.ndarray:
    """1 + cos(theta) of edges of length theta from the sums (3, ...) of their ends."""
    return 0.5 * (total[0] * total[0] + total[1] * total[1] + total[2] * total[2])


def solid_angle(unit: np.ndarray) -> np.ndarray:
    """Signed solid angle (P,) in sr of spherical polygons (3, V, P) in the hemisphere z >= 0.

    Positive where the corners run counterclockwise about +z as seen from outside the sphere. Product over the edges of
    the spherical triangles with apex e_z (Van Oosterom and Strackee 1983), with one arc tangent at the end.
    """
    total = edge_sums(unit)
    real = total[2] + one_plus_cosine(total)
    imaginary = unit[0] * total[1] - unit[1] * total[0]
    product_real, product_imaginary = real[0], imaginary[0]
    for edge in range(1, unit.shape[1]):
        product_real, product_imaginary = (
            product_real * real[edge] - product_imaginary * imaginary[edge],
            product_real * imaginary[edge] + product_imaginary * real[edge],
        )
        # Only the argument matters: keep the magnitude near one so that many edges neither overflow nor underflow.
        scale = np.abs(product_real) + np.abs(product_imaginary)
        scale = 1.0 / np.where(scale > 0.0, scale, 1.0)
        product_real, product_imaginary = product_real * scale, product_imaginary * scale
    angle = 2.0 * np.arctan2(product_imaginary, product_real)
    # Close to 2 pi rounding may cross the branch cut; the area projected on the horizon still has the right sign.
    wrapped = (np.abs(angle) > 6.0) & (imaginary.sum(axis=0) * angle < 0.0)
    return np.where(wrapped, -angle, angle)
