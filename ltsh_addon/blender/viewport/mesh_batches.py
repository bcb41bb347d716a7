"""Evaluated meshes as batches for the graphics card: one per material slot, corners as vertices."""

from __future__ import annotations

from dataclasses import dataclass, field

import gpu
import numpy as np

from ..foreach_values import read_values
from .mesh_normals import interpolated_normals, own_normals
from .mesh_tangents import corner_tangents


@dataclass
class MeshBatches:
    """One evaluated mesh; `slots` are the material slots that have faces."""

    slots: tuple[int, ...]
    triangles: int
    indices: dict[int, gpu.types.GPUIndexBuf]
    corners: gpu.types.GPUVertBuf | None
    corner_count: int
    uv: dict[str, np.ndarray]  # (C, 2) by name; "" is the active one
    middle: np.ndarray  # (3,) of the bounding box
    is_smooth: bool  # do normals differ from those of the faces?
    _uv_buffers: dict[str, gpu.types.GPUVertBuf] = field(default_factory=dict)
    _tangents: dict[str, gpu.types.GPUVertBuf] = field(default_factory=dict)
    _batches: dict[tuple[int, str], gpu.types.GPUBatch] = field(default_factory=dict)

    def batch(self, slot: int, uv_map: str) -> gpu.types.GPUBatch:
        """What draws the faces of `slot` with a UV map; maps that the mesh lacks are zero, as in Cycles."""
        key = slot, uv_map
        if key not in self._batches:
            batch = gpu.types.GPUBatch(type="TRIS", buf=self.corners, elem=self.indices[slot])
            batch.vertbuf_add(self._uv_buffer(uv_map))
            if uv_map in self._tangents:
                batch.vertbuf_add(self._tangents[uv_map])
            self._batches[key] = batch
        return self._batches[key]

    def add_tangents(self, ob, uv_map: str) -> None:
        """Make sure that normal maps on `uv_map` have tangents; `ob` is an evaluated object with this mesh."""
        if uv_map in self._tangents or uv_map not in self.uv:
            return
        found = _arrays(ob)
        tangents = corner_tangents(found.place, found.normal, found.uv[uv_map], found.triangles)
        self._tangents[uv_map] = _vertex_buffer({"tangent": tangents})
        self._batches.clear()

    def _uv_buffer(self, uv_map: str) -> gpu.types.GPUVertBuf:
        if uv_map not in self._uv_buffers:
            values = self.uv.get(uv_map)
            if values is None:
                values = np.zeros((self.corner_count, 2), np.float32)
            self._uv_buffers[uv_map] = _vertex_buffer({"uv": values})
        return self._uv_buffers[uv_map]


def _vertex_buffer(attributes: dict[str, np.ndarray]) -> gpu.types.GPUVertBuf:
    layout = gpu.types.GPUVertFormat()
    for name, values in attributes.items():
        layout.attr_add(id=name, comp_type="F32", len=values.shape[1], fetch_mode="FLOAT")
    buffer = gpu.types.GPUVertBuf(layout, len(next(iter(attributes.values()))))
    for name, values in attributes.items():
        buffer.attr_fill(name, values)
    return buffer


@dataclass
class _Arrays:
    """Corners and triangles of an evaluated mesh; flat faces that are not plane have corners of their own."""

    triangles: np.ndarray  # (T, 3) of corners
    slots: np.ndarray  # (T,)
    place: np.ndarray  # (C, 3)
    normal: np.ndarray  # (C, 3)
    uv: dict[str, np.ndarray]
    middle: np.ndarray  # (3,)
    is_smooth: bool


def mesh_batches(ob) -> MeshBatches | None:
    """Those of the evaluated object `ob`; None where it has no faces."""
    found = _arrays(ob)
    if found is None:
        return None
    triangles, slots = found.triangles, found.slots
    used = tuple(int(slot) for slot in np.flatnonzero(np.bincount(slots)))
    indices = {
        slot: gpu.types.GPUIndexBuf(
            type="TRIS", seq=triangles if len(used) == 1 else np.ascontiguousarray(triangles[slots == slot])
        )
        for slot in used
    }
    buffer = _vertex_buffer({"position": found.place, "normal": found.normal})
    return MeshBatches(used, len(triangles), indices, buffer, len(found.place), found.uv, found.middle, found.is_smooth)


def _arrays(ob) -> _Arrays | None:
    mesh = ob.to_mesh()
    if mesh is None:
        return None
    try:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        if count == 0:
            return None
        triangles = read_values(mesh.loop_triangles, "loops", (count, 3), np.int32)
        slots = _slots(mesh, count, max(len(ob.material_slots), 1))
        # Attributes are copied as they lie in memory, `mesh.loops` and `mesh.vertices` one by one.
        vertex = read_values(mesh.attributes[".corner_vert"].data, "value", (len(mesh.loops),), np.int32)
        place = read_values(mesh.attributes["position"].data, "vector", (len(mesh.vertices), 3), np.float32)
        middle = 0.5 * (place.min(axis=0) + place.max(axis=0)).astype(np.float64)
        place, uv = place.take(vertex, axis=0), _uv_maps(mesh, len(vertex))
        normal, flat = interpolated_normals(mesh, vertex)
        if flat.any():
            chosen, own = own_normals(mesh, flat, triangles, place, normal)
            corners = triangles[chosen].ravel()
            triangles[chosen] = len(vertex) + np.arange(len(corners)).reshape(-1, 3)
            normal = np.concatenate([normal, own.repeat(3, axis=0)])
            place = np.concatenate([place, place.take(corners, axis=0)])
            uv = {name: np.concatenate([values, values.take(corners, axis=0)]) for name, values in uv.items()}
    finally:
        ob.to_mesh_clear()
    return _Arrays(triangles, slots, place, normal, uv, middle, not flat.all())


def _slots(mesh, count: int, slots: int) -> np.ndarray:
    """The material slot (count,) of every triangle."""
    if slots == 1:
        return np.zeros(count, np.int32)
    return np.clip(read_values(mesh.loop_triangles, "material_index", (count,), np.int32), 0, slots - 1)


def _uv_maps(mesh, corners: int) -> dict[str, np.ndarray]:
    maps = {}
    for layer in mesh.uv_layers:
        maps[layer.name] = read_values(layer.uv, "vector", (corners, 2), np.float32)
        if layer.active_render:
            maps[""] = maps[layer.name]
    return maps
