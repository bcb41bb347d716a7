"""Rays cast by Blender itself if Embree is not available: some ten times slower, and on one core.

The first half runs in the parent and imports no bpy. The second half runs in the second Blender.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ...files import save_array
from ...scene import SceneError
from ...visibility import Hits, Occluders, Tracer, open_tracer
from .blender_process import BlenderProcess, embree_libraries

RAYS = ("origins", "directions", "near", "far", "masks")


def open_rays(occluders: Occluders, folder: Path, warn: Callable[[str], None]) -> Tracer:
    """A tracer with Embree, or, after a warning, with a second Blender whose files go to `folder`."""
    try:
        return open_tracer(occluders, embree_libraries())
    except SceneError as error:
        warn(f"{error}; Blender itself casts the rays, some ten times slower")
        return Tracer(occluders, BlenderCaster(occluders, folder))


@dataclass(frozen=True)
class RaysJob:
    """Find the first hits of the rays in the job's folder on the occluders that block, or on those that do not."""

    occluders: str
    is_clear: bool


class BlenderCaster:
    """Casts rays as `visibility.rays.EmbreeCaster` does, in a second Blender."""

    chunk = 1 << 18
    description = "Blender's own rays (mathutils.bvhtree), slow"

    def __init__(self, occluders: Occluders, folder: Path):
        self._folder = Path(tempfile.mkdtemp(prefix="rays-", dir=folder))
        self._occluders = self._folder / "occluders.npz"
        occluders.save(self._occluders)
        self._process = BlenderProcess(self._folder)
        self.has = tuple(len(index) > 0 for index in occluders.split())

    def close(self) -> None:
        """End the second Blender."""
        self._process.end()

    def blocked(self, origins, directions, distances, masks) -> np.ndarray:
        """Mask (R,) of the rays that are blocked."""
        found = np.zeros(len(origins), bool)
        hits = self.closest(False, origins, directions, np.zeros(len(origins), np.float32), distances, masks)
        found[hits.ray] = True
        return found

    def closest(self, is_clear: bool, *rays: np.ndarray) -> Hits:
        """First hits of rays (origins, directions, near, far, masks) on blocking surfaces; `is_clear`: on others."""
        for name, values in zip(RAYS, rays, strict=True):
            save_array(self._folder / f"{name}.npy", values)
        self._process.do(RaysJob(str(self._occluders), is_clear), self._folder, None)
        return Hits(*(np.load(self._folder / f"{field.name}.npy") for field in fields(Hits)))


# In the second Blender:

# Blender takes positions and distances in single precision. FARTHEST_RAY: the longest distance in m. ROUNDING: how far
# the start of a ray may be off, as a share of its largest coordinate.
FARTHEST_RAY = 1e18
ROUNDING = 2.0**-21


@dataclass(frozen=True)
class _Tree:
    """The triangles of all instances with the same mask."""

    mask: int
    tree: object
    corners: np.ndarray  # (T, 3, 3)
    instance: np.ndarray  # (T,)
    triangle: np.ndarray  # (T,)


_trees: dict[str, tuple[list[_Tree], list[_Tree]]] = {}  # of the last file of occluders, by its path


def cast(job: RaysJob, folder: Path, progress) -> dict:
    """Write the first hits of the rays in `folder`; returns an empty manifest."""
    path = job.occluders
    if path not in _trees:
        _trees.clear()
        occluders = Occluders.load(path)
        _trees[path] = tuple(_grown(occluders, index) for index in occluders.split())
    rays = (np.load(folder / f"{name}.npy") for name in RAYS)
    for name, values in _closest(_trees[path][job.is_clear], *rays).items():
        save_array(folder / f"{name}.npy", values)
    return {}


def _grown(occluders: Occluders, index) -> list[_Tree]:
    import bpy  # noqa: F401, pip's has mathutils inside
    from mathutils.bvhtree import BVHTree

    trees = []
    for mask in np.unique(occluders.masks[index]):
        corners, instances, numbers = [], [], []
        for instance in index[occluders.masks[index] == mask]:
            mesh, matrix = occluders.meshes[occluders.mesh[instance]], occluders.matrices[instance]
            corners.append((mesh.vertices @ matrix[:, :3].T + matrix[:, 3])[mesh.triangles])
            instances.append(np.full(len(mesh.triangles), instance))
            numbers.append(np.arange(len(mesh.triangles)))
        corners = np.concatenate(corners)
        named = np.arange(3 * len(corners)).reshape(-1, 3).tolist()
        tree = BVHTree.FromPolygons(corners.reshape(-1, 3).tolist(), named, all_triangles=True)
        trees.append(_Tree(int(mask), tree, corners, np.concatenate(instances), np.concatenate(numbers)))
    return trees


def _closest(trees: list[_Tree], origins, directions, near, far, masks) -> dict[str, np.ndarray]:
    """The values of `Hits` by name."""
    count = len(origins)
    # A ray that goes on from a hit would hit the same surface again because its start is rounded: move the start.
    near = near + (near > 0.0) * ROUNDING * (np.abs(origins).max(axis=1, initial=0.0) + near)
    starts = (origins + near[:, None] * directions).tolist()
    ways, reach = directions.tolist(), np.minimum(far - near, FARTHEST_RAY)
    best, tree_of, index = np.full(count, np.inf), np.zeros(count, int), np.zeros(count, int)
    for number, tree in enumerate(trees):
        cast_ray = tree.tree.ray_cast
        for ray in np.flatnonzero((masks & tree.mask) != 0).tolist():
            _, _, met, distance = cast_ray(starts[ray], ways[ray], float(min(reach[ray], best[ray])))
            if met is not None and distance < best[ray]:
                best[ray], tree_of[ray], index[ray] = distance, number, met
    hit = np.flatnonzero(np.isfinite(best))
    instance, triangle = np.zeros((2, len(hit)), int)
    u, v = np.zeros((2, len(hit)), np.float32)
    for number, tree in enumerate(trees):
        here = tree_of[hit] == number
        met = index[hit[here]]
        instance[here], triangle[here] = tree.instance[met], tree.triangle[met]
        u[here], v[here] = _place(tree.corners[met], origins[hit[here]], directions[hit[here]])
    distance = (near[hit] + best[hit]).astype(np.float32)
    return {"ray": hit, "distance": distance, "instance": instance, "triangle": triangle, "u": u, "v": v}


def _place(corners, origins, directions):
    """Barycentric u and v (H,) of the hits on triangles (H, 3, 3); Moeller and Trumbore 1997."""
    first, second, start = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], origins - corners[:, 0]
    p, q = np.cross(directions, second), np.cross(start, first)
    determinant = (first * p).sum(axis=1)
    determinant = np.where(determinant == 0.0, 1.0, determinant)
    return (start * p).sum(axis=1) / determinant, (directions * q).sum(axis=1) / determinant
