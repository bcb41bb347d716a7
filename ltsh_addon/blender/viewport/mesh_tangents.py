"""Tangents of normal maps at the corners of triangles, as MikkTSpace has them (Mikkelsen 2008), which Cycles uses."""

from __future__ import annotations

import numpy as np

from ..materials.shading_normals import unit


def corner_tangents(place, normal, uv, triangles) -> np.ndarray:
    """Tangents (C, 4) for corners with places (C, 3), unit normals (C, 3) and UV coordinates (C, 2), in the frame of
    the places; the last number is the sign of the bitangent. (1, 0, 0, -1) where no triangle (T, 3) has an area in UV.

    Triangles that share a place, a normal, UV coordinates and their orientation in UV share a tangent there: the mean
    of theirs, each projected onto the plane of the normal and weighted by its angle.
    """
    corner, area = triangles.ravel(), _uv_area(uv, triangles)
    of_triangle = unit(_towards_u(place, uv, triangles) * np.sign(area)[:, None])
    upward = normal[corner].astype(np.float64)
    flat = unit(_projected(of_triangle.repeat(3, axis=0), upward)) * _angles(place, triangles, upward)[:, None]
    used = (area != 0.0).repeat(3)
    group = _groups(place, normal, uv, corner, area)
    flat[~used] = 0.0
    total = np.stack([np.bincount(group, flat[:, axis]) for axis in range(3)], axis=-1)
    found = np.tile(np.array([1.0, 0.0, 0.0, -1.0], np.float32), (len(place), 1))
    found[corner[used], :3] = unit(total)[group[used]]
    found[corner[used], 3] = np.sign(area).repeat(3)[used]
    return found


def _uv_area(uv, triangles):
    """Twice the areas (T,) in UV, negative where a triangle is mirrored there."""
    first, second = _edges(uv, triangles)
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _towards_u(place, uv, triangles):
    """The directions (T, 3) in which u grows, for positive areas."""
    (first, second), (uv_first, uv_second) = _edges(place, triangles), _edges(uv, triangles)
    return first * uv_second[:, 1:] - second * uv_first[:, 1:]


def _edges(values, triangles):
    start = values[triangles[:, 0]].astype(np.float64)
    return values[triangles[:, 1]] - start, values[triangles[:, 2]] - start


def _angles(place, triangles, upward):
    """Angles (3 T,) at the corners of the triangles, seen along the normals `upward` (3 T, 3)."""
    points = place[triangles].astype(np.float64)
    ahead, back = (unit(_projected((np.roll(points, way, axis=1) - points).reshape(-1, 3), upward)) for way in (-1, 1))
    return np.arccos(np.clip((ahead * back).sum(axis=1), -1.0, 1.0))


def _groups(place, normal, uv, corner, area):
    """Numbers (3 T,) that are equal for corners of triangles which share a tangent."""
    # Negative zeros count as zero.
    rows = np.concatenate([place, normal, uv], axis=1, dtype=np.float32)[corner] + np.float32(0.0)
    rows = np.concatenate([rows, np.sign(area).astype(np.float32).repeat(3)[:, None]], axis=1)
    as_one = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel()
    return np.unique(as_one, return_inverse=True)[1].ravel()


def _projected(vectors, normals):
    return vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals
