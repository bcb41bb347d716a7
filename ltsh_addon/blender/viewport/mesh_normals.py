"""Which normals Cycles gives the triangles of an evaluated mesh: interpolated ones, or the triangle's own."""

from __future__ import annotations

import bpy
import numpy as np

from ..foreach_values import read_values
from ..materials.shading_normals import unit

# Before, Cycles did not take corner normals where only faces are sharp.
_CORNERS_OF_SHARP_FACES = bpy.app.version >= (5, 0, 0)
# Between the normals of a face and of its triangles, where they count as one.
_SAME = 1e-5


def interpolated_normals(mesh, vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (C, 3) at the corners, which stand at the vertices `vertex` (C,), and the mask (F,) of the faces whose
    triangles are flat: there Cycles interpolates nothing.

    Faces count as flat as far as Cycles says so, which is not always how Blender's solid view shows them: with normals
    at all corners none are, and edges that are all sharp make none.
    """
    faces = len(mesh.polygons)
    sharp = _marks(mesh, "sharp_face", faces)
    by_vertex = not mesh.has_custom_normals and not sharp.all() and _edges_do_not_count(mesh, sharp)
    if by_vertex:
        normal = read_values(mesh.vertex_normals, "vector", (len(mesh.vertices), 3), np.float32).take(vertex, axis=0)
    else:
        normal = read_values(mesh.corner_normals, "vector", (len(vertex), 3), np.float32)
    flat = sharp if by_vertex or mesh.normals_domain == "FACE" else np.zeros(faces, bool)
    return normal, flat


def _edges_do_not_count(mesh, sharp_faces: np.ndarray) -> bool:
    """True where Cycles takes normals of vertices, with sharp faces apart."""
    edges = _marks(mesh, "sharp_edge", len(mesh.edges))
    return bool(edges.all() if edges.any() else not _CORNERS_OF_SHARP_FACES or not sharp_faces.any())


def _marks(mesh, name: str, count: int) -> np.ndarray:
    attribute = mesh.attributes.get(name)
    return np.zeros(count, bool) if attribute is None else read_values(attribute.data, "value", (count,), bool)


def own_normals(mesh, flat: np.ndarray, triangles: np.ndarray, place: np.ndarray, normal: np.ndarray):
    """Triangles (K,) that need corners of their own, and their normals (K, 3): those of faces `flat` (F,) that are not
    plane. `triangles` (T, 3) are corners with places and normals (C, 3)."""
    candidates = np.arange(len(triangles))
    if not flat.all():
        face = read_values(mesh.loop_triangle_polygons, "value", (len(triangles),), np.int32)
        candidates = np.nonzero(flat[face])[0]
    corners = triangles.take(candidates, axis=0)
    # `take` is several times as fast as an index.
    first, second, third = (place.take(corners[:, number], axis=0) for number in range(3))
    own = unit(np.cross(second - first, third - first))
    differs = np.zeros(len(candidates), bool)
    # All corners of a face have its normal where all faces are flat.
    for number in range(1 if flat.all() else 3):
        difference = np.abs(normal.take(corners[:, number], axis=0) - own)
        for axis in range(3):
            differs |= difference[:, axis] > _SAME
    differs &= own.any(axis=1)
    return candidates[differs], own[differs]
