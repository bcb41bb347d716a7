"""Evaluated meshes as batches for the graphics card: one per material slot, corners as vertices."""

from __future__ import annotations

from dataclasses import dataclass, field

import gpu
import numpy as np

from .mesh_normals import interpolated_normals, own_normals, read


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
    _batches: dict[tuple[int, str], gpu.types.GPUBatch] = field(default_factory=dict)

    def batch(self, slot: int, uv_map: str) -> gpu.types.GPUBatch:
        """What draws the faces of `slot` with a UV map; maps that the mesh lacks are zero, as in Cycles."""
        key = slot, uv_map
        if key not in self._batches:
            batch = gpu.types.GPUBatch(type="TRIS", buf=self.corners, elem=self.indices[slot])
            batch.vertbuf_add(self._uv_buffer(uv_map))
            self._batches[key] = batch
        return self._batches[key]

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


def mesh_batches(ob) -> MeshBatches | None:
    """Those of the evaluated object `ob`; None where it has no faces."""
    mesh = ob.to_mesh()
    if mesh is None:
        return None
    try:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        if count == 0:
            return None
        triangles = read(mesh.loop_triangles, "loops", (count, 3), np.int32)
        slots = _slots(mesh, count, max(len(ob.material_slots), 1))
        # Attributes are copied as they lie in memory, `mesh.loops` and `mesh.vertices` one by one.
        vertex = read(mesh.attributes[".corner_vert"].data, "value", (len(mesh.loops),), np.int32)
        place = read(mesh.attributes["position"].data, "vector", (len(mesh.vertices), 3), np.float32)
        middle = 0.5 * (place.min(axis=0) + place.max(axis=0)).astype(np.float64)
        place, uv = place[vertex], _uv_maps(mesh, len(vertex))
        normal, flat = interpolated_normals(mesh, vertex)
        if flat.any():
            chosen, own = own_normals(mesh, flat, triangles, place, normal)
            corners = triangles[chosen].ravel()
            triangles[chosen] = len(vertex) + np.arange(len(corners)).reshape(-1, 3)
            place, normal = np.concatenate([place, place[corners]]), np.concatenate([normal, own.repeat(3, axis=0)])
            uv = {name: np.concatenate([values, values[corners]]) for name, values in uv.items()}
    finally:
        ob.to_mesh_clear()
    used = tuple(int(slot) for slot in np.flatnonzero(np.bincount(slots)))
    indices = {
        slot: gpu.types.GPUIndexBuf(
            type="TRIS", seq=triangles if len(used) == 1 else np.ascontiguousarray(triangles[slots == slot])
        )
        for slot in used
    }
    buffer = _vertex_buffer({"position": place, "normal": normal})
    return MeshBatches(used, count, indices, buffer, len(place), uv, middle, not flat.all())


def _slots(mesh, count: int, slots: int) -> np.ndarray:
    """The material slot (count,) of every triangle."""
    if slots == 1:
        return np.zeros(count, np.int32)
    return np.clip(read(mesh.loop_triangles, "material_index", (count,), np.int32), 0, slots - 1)


def _uv_maps(mesh, corners: int) -> dict[str, np.ndarray]:
    maps = {}
    for layer in mesh.uv_layers:
        maps[layer.name] = read(layer.uv, "vector", (corners, 2), np.float32)
        if layer.active_render:
            maps[""] = maps[layer.name]
    return maps
