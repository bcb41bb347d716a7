"""Evaluated meshes as batches for the graphics card, one per material slot, with the normals and tangents of Cycles;
materials and tables of closures as textures and buffers."""

from dataclasses import dataclass, field

import gpu
import numpy as np

from ...cycles import closures, horizons
from ...cycles.horizons import unit
from ...cycles.lobes import LEAST_VELVET, LOBE_KINDS
from ..evaluated import interpolated_normals, read_values, uv_maps
from ..extract.occluder_shapes import ball, points_of
from ..materials.preview_material import IMAGE_SLOTS, OTHER_KINDS, PreviewMaterial
from ..materials.values import EXTENSIONS, Value

# MOST_TRIANGLES: of a point cloud, where its balls can have fewer.
MOST_TRIANGLES = 1 << 20
# _SAME: normals of a face and of its triangle count as equal if no component differs by more.
_SAME = 1e-5


def non_planar_normals(mesh, flat: np.ndarray, triangles: np.ndarray, position: np.ndarray, normal: np.ndarray):
    """Triangles (K,) that need corners of their own, and their normals (K, 3): triangles of non-planar flat faces.

    `flat` (F,) is the mask of flat faces. `triangles` (T, 3) are numbers of corners with the positions `position` and
    the normals `normal`, both (C, 3).
    """
    candidates = np.arange(len(triangles))
    if not flat.all():
        face = read_values(mesh.loop_triangle_polygons, "value", (len(triangles),), np.int32)
        candidates = np.nonzero(flat[face])[0]
    corners = triangles.take(candidates, axis=0)
    # `take` is several times as fast as an index.
    first, second, third = (position.take(corners[:, number], axis=0) for number in range(3))
    face_normal = unit(np.cross(second - first, third - first))
    differs = np.zeros(len(candidates), bool)
    # All corners of a face have its normal where all faces are flat.
    for number in range(1 if flat.all() else 3):
        difference = np.abs(normal.take(corners[:, number], axis=0) - face_normal)
        for axis in range(3):
            differs |= difference[:, axis] > _SAME
    differs &= face_normal.any(axis=1)
    return candidates[differs], face_normal[differs]


def corner_tangents(position, normal, uv, triangles) -> np.ndarray:
    """Tangents (C, 4) of corners by MikkTSpace (Mikkelsen 2008), which Cycles uses; w is the sign of the bitangent.

    Corners have positions (C, 3), unit normals (C, 3) and UV coordinates (C, 2). Tangents are in the frame of the
    positions. They are (1, 0, 0, -1) where no triangle (T, 3) has an area in UV.

    Corners with the same position, normal, UV coordinates and orientation in UV share a tangent: the mean over their
    triangles, each projected onto the plane of the normal and weighted by its angle.
    """
    (first, second), (uv_first, uv_second) = _edges(position, triangles), _edges(uv, triangles)
    # Twice the areas in UV, negative where a triangle is mirrored there; then the directions in which u grows.
    corner, area = triangles.ravel(), uv_first[:, 0] * uv_second[:, 1] - uv_first[:, 1] * uv_second[:, 0]
    of_triangle = unit((first * uv_second[:, 1:] - second * uv_first[:, 1:]) * np.sign(area)[:, None])
    upward = normal[corner].astype(np.float64)
    flat = unit(_projected(of_triangle.repeat(3, axis=0), upward)) * _angles(position, triangles, upward)[:, None]
    used = (area != 0.0).repeat(3)
    group = _groups(position, normal, uv, corner, area)
    flat[~used] = 0.0
    total = np.stack([np.bincount(group, flat[:, axis]) for axis in range(3)], axis=-1)
    tangents = np.tile(np.array([1.0, 0.0, 0.0, -1.0], np.float32), (len(position), 1))
    tangents[corner[used], :3] = unit(total)[group[used]]
    tangents[corner[used], 3] = np.sign(area).repeat(3)[used]
    return tangents


def _edges(values, triangles):
    start = values[triangles[:, 0]].astype(np.float64)
    return values[triangles[:, 1]] - start, values[triangles[:, 2]] - start


def _angles(position, triangles, upward):
    """Angles (3 T,) at the corners of the triangles, seen along the normals `upward` (3 T, 3)."""
    points = position[triangles].astype(np.float64)
    ahead, back = (unit(_projected((np.roll(points, way, axis=1) - points).reshape(-1, 3), upward)) for way in (-1, 1))
    return np.arccos(np.clip((ahead * back).sum(axis=1), -1.0, 1.0))


def _groups(position, normal, uv, corner, area):
    """Numbers (3 T,) of the groups of corners that share a tangent."""
    # Adding 0 turns negative zeros into zeros, as the rows are compared bytewise.
    rows = np.concatenate([position, normal, uv], axis=1, dtype=np.float32)[corner] + np.float32(0.0)
    rows = np.concatenate([rows, np.sign(area).astype(np.float32).repeat(3)[:, None]], axis=1)
    as_one = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel()
    return np.unique(as_one, return_inverse=True)[1].ravel()


def _projected(vectors, normals):
    return vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals


@dataclass
class MeshBatches:
    """One evaluated mesh on the graphics card."""

    slots: tuple[int, ...]  # material slots that have faces
    triangles: int
    indices: dict[int, gpu.types.GPUIndexBuf]
    corners: gpu.types.GPUVertBuf | None
    corner_count: int
    uv: dict[str, np.ndarray]  # (C, 2) by name; "" is the one that renders
    middle: np.ndarray  # (3,) of the bounding box
    is_smooth: bool  # some normals differ from those of their faces
    _uv_buffers: dict[str, gpu.types.GPUVertBuf] = field(default_factory=dict)
    _tangents: dict[str, gpu.types.GPUVertBuf] = field(default_factory=dict)
    _batches: dict[tuple[int, str], gpu.types.GPUBatch] = field(default_factory=dict)
    _around: gpu.types.GPUVertBuf | None = None

    def batch(self, slot: int, uv_map: str) -> gpu.types.GPUBatch:
        """The batch of the faces of `slot` with a UV map. A map that the mesh lacks is zero, as in Cycles."""
        key = slot, uv_map
        if key not in self._batches:
            batch = gpu.types.GPUBatch(type="TRIS", buf=self.corners, elem=self.indices[slot])
            batch.vertbuf_add(self._uv_buffer(uv_map))
            if uv_map in self._tangents:
                batch.vertbuf_add(self._tangents[uv_map])
            if self._around is not None:
                batch.vertbuf_add(self._around)
            self._batches[key] = batch
        return self._batches[key]

    def add_around(self, ob) -> None:
        """Add the generated coordinates for tangents around axes of the object; `ob` is as for `add_tangents`."""
        if self._around is None:
            self._around = _vertex_buffer({"around": texture_space(ob, _arrays(ob).vertex)})
            self._batches.clear()

    def add_tangents(self, ob, uv_map: str) -> None:
        """Add the tangents for normal maps on `uv_map`; `ob` is an evaluated object with this mesh."""
        if uv_map in self._tangents or uv_map not in self.uv:
            return
        arrays = _arrays(ob)
        tangents = corner_tangents(arrays.position, arrays.normal, arrays.uv[uv_map], arrays.triangles)
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
    """Corners and triangles of an evaluated mesh. Triangles of non-planar flat faces have corners of their own."""

    triangles: np.ndarray  # (T, 3) of corners
    slots: np.ndarray  # (T,)
    vertex: np.ndarray  # (C,)
    position: np.ndarray  # (C, 3)
    normal: np.ndarray  # (C, 3)
    uv: dict[str, np.ndarray]
    middle: np.ndarray  # (3,)
    is_smooth: bool


def mesh_batches(ob) -> MeshBatches | None:
    """The mesh of the evaluated object `ob` on the graphics card; None where it has no faces."""
    arrays = _arrays(ob)
    if arrays is None:
        return None
    triangles, slots = arrays.triangles, arrays.slots
    used = tuple(int(slot) for slot in np.flatnonzero(np.bincount(slots)))
    indices = {
        slot: gpu.types.GPUIndexBuf(
            type="TRIS", seq=triangles if len(used) == 1 else np.ascontiguousarray(triangles[slots == slot])
        )
        for slot in used
    }
    buffer = _vertex_buffer({"position": arrays.position, "normal": arrays.normal})
    return MeshBatches(
        used, len(triangles), indices, buffer, len(arrays.position), arrays.uv, arrays.middle, arrays.is_smooth
    )


def _arrays(ob) -> _Arrays | None:
    if ob.type == "POINTCLOUD":
        return _balls(*points_of(ob.data))
    # Asking hair for a mesh is an error.
    mesh = None if ob.type == "CURVES" else ob.to_mesh()
    if mesh is None:
        return None
    try:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        if count == 0:
            return None
        triangles = read_values(mesh.loop_triangles, "loops", (count, 3), np.int32)
        slots = _slots(mesh, count, max(len(ob.material_slots), 1))
        # Reading attributes is a copy of memory; `mesh.loops` and `mesh.vertices` would be read one by one.
        vertex = read_values(mesh.attributes[".corner_vert"].data, "value", (len(mesh.loops),), np.int32)
        position = read_values(mesh.attributes["position"].data, "vector", (len(mesh.vertices), 3), np.float32)
        middle = 0.5 * (position.min(axis=0) + position.max(axis=0)).astype(np.float64)
        position, uv = position.take(vertex, axis=0), uv_maps(mesh)
        normal, flat = interpolated_normals(mesh, vertex)
        if flat.any():
            chosen, face_normals = non_planar_normals(mesh, flat, triangles, position, normal)
            corners = triangles[chosen].ravel()
            triangles[chosen] = len(vertex) + np.arange(len(corners)).reshape(-1, 3)
            normal = np.concatenate([normal, face_normals.repeat(3, axis=0)])
            vertex = np.concatenate([vertex, vertex[corners]])
            position = np.concatenate([position, position.take(corners, axis=0)])
            uv = {name: np.concatenate([values, values.take(corners, axis=0)]) for name, values in uv.items()}
    finally:
        ob.to_mesh_clear()
    return _Arrays(triangles, slots, vertex, position, normal, uv, middle, not flat.all())


def _balls(center: np.ndarray, radius: np.ndarray) -> _Arrays | None:
    """Smooth balls, of fewer triangles where there are many."""
    if not len(center):
        return None
    normal, triangles = ball(int(np.clip(np.log2(MOST_TRIANGLES / (5.0 * len(center))) // 2.0, 1, 4)))
    triangles = (triangles + len(normal) * np.arange(len(center))[:, None, None]).reshape(-1, 3).astype(np.int32)
    position = (center[:, None] + radius[:, None, None] * normal).reshape(-1, 3).astype(np.float32)
    normal = np.tile(normal, (len(center), 1)).astype(np.float32)
    middle = 0.5 * (position.min(axis=0) + position.max(axis=0)).astype(np.float64)
    slots, vertex = np.zeros(len(triangles), np.int32), np.arange(len(position), dtype=np.int32)
    return _Arrays(triangles, slots, vertex, position, normal, {}, middle, is_smooth=True)


def texture_space(ob, vertex: np.ndarray) -> np.ndarray:
    """Generated coordinates minus 0.5, (C, 3), of the vertices `vertex` (C,) of the evaluated object `ob`."""
    mesh = ob.to_mesh()
    try:
        position = read_values(mesh.vertices, "undeformed_co", (len(mesh.vertices), 3), np.float32)
        middle, size = np.array(mesh.texspace_location), np.array(mesh.texspace_size)
    finally:
        ob.to_mesh_clear()
    return ((position - middle) * np.divide(0.5, size, out=np.ones(3), where=size != 0.0)).astype(np.float32)[vertex]


def _slots(mesh, count: int, slots: int) -> np.ndarray:
    """The material slot (count,) of every triangle."""
    if slots == 1:
        return np.zeros(count, np.int32)
    return np.clip(read_values(mesh.loop_triangles, "material_index", (count,), np.int32), 0, slots - 1)


# The layout of a look's uniform buffer in units of vec4: start and size of the slots, start of the terms of conductors,
# start of the layers (coat and others), whole size.
FIRST_SLOT, SLOT_SIZE = 3, 6
FIRST_TERM = FIRST_SLOT + SLOT_SIZE * len(IMAGE_SLOTS)
LAYERS = FIRST_TERM + 5
LOOK_SIZE = LAYERS + 5
# Numbers for the direction of tangents of anisotropic lobes, by `Brush.direction`; 0: not anisotropic.
DIRECTIONS = {"X": 1, "Y": 2, "Z": 3, "": 4}
VIEW_FACTORS = {"fresnel": 1, "facing": 2}
KINDS = {**LOBE_KINDS, **{kind: max(LOBE_KINDS.values()) + n for n, kind in enumerate(OTHER_KINDS, 1)}}
DEFINES = {
    **{name.upper(): str(int(number)) for name, number in KINDS.items()},
    **{f"{name.upper()}_SLOT": str(position) for position, name in enumerate(IMAGE_SLOTS)},
    **{f"EXTENSION_{name}": str(position) for position, name in enumerate(EXTENSIONS)},
    "EXTENSIONS": str(len(EXTENSIONS)),
    "FIRST_SLOT": str(FIRST_SLOT),
    "SLOT_SIZE": str(SLOT_SIZE),
    "FIRST_TERM": str(FIRST_TERM),
    "LAYERS": str(LAYERS),
    "LEAST_VELVET": str(LEAST_VELVET),
    "MAX_F0": str(closures.MAX_F0),
    "AVERAGE_START": str(closures.DIELECTRIC_AVERAGE[0]),
    "AVERAGE_SLOPE": str(closures.DIELECTRIC_AVERAGE[1]),
    "ELEVATION_SHARE": str(horizons.ELEVATION_SHARE),
    "MINIMUM_REFLECTION_ELEVATION": str(horizons.MINIMUM_REFLECTION_ELEVATION),
}


def look_values(look: PreviewMaterial) -> np.ndarray:
    """The uniform buffer (LOOK_SIZE, 4) of a look."""
    data = np.zeros((LOOK_SIZE, 4))
    flags = (look.normal is not None) + 2 * look.corrected
    data[0] = KINDS[look.kind], look.scattered, flags, look.normal_strength
    data[1] = *look.emission, look.through
    data[2] = *look.value("tint").offset, look.value("specular_level").offset[0]
    for position, name in enumerate(IMAGE_SLOTS):
        value = look.normal if name == "normal" else look.value(name)
        if value is not None:
            start = FIRST_SLOT + SLOT_SIZE * position
            data[start : start + SLOT_SIZE] = _slot_values(value)
    data[LAYERS, 0] = look.weight
    if look.view_factor is not None:
        factor = look.view_factor
        data[LAYERS + 2, :3] = VIEW_FACTORS[factor.kind], factor.parameter, factor.is_complement
    data[LAYERS + 2, 3] = look.glow
    if look.sheen is not None:
        data[LAYERS + 3, :2] = look.sheen
    data[LAYERS + 3, 2] = look.value("diffuse_roughness").offset[0] if look.is_rough else 0.0
    if look.brush is not None:
        brush = look.brush
        data[LAYERS + 4, :3] = brush.aspect, 2.0 * np.pi * brush.rotation, DIRECTIONS[brush.direction]
    if look.coat is not None:
        data[LAYERS, 1:] = look.coat.weight, look.coat.roughness, look.coat.ior
        data[LAYERS + 1] = *look.coat.tint, look.coat.follows_normal
    if look.kind.startswith("conductor"):
        exact = look.kind == "conductor"
        index, extinction = look.value("color").offset[None], np.maximum(look.value("tint").offset, 0.0)[None]
        data[FIRST_TERM : FIRST_TERM + 4, :3] = np.stack(closures.conductor_fit(index, extinction, exact))[:, 0]
        data[FIRST_TERM + 4, :3] = closures.conductor_average(index, extinction, exact)[0]
    return data


def _slot_values(value: Value) -> np.ndarray:
    rows = np.zeros((SLOT_SIZE, 4))
    rows[3, :3] = value.offset
    if value.image is not None:
        use = value.image
        rows[:3], rows[3, 3] = value.matrix, 1.0
        rows[4:6, :3] = use.mapping
        rows[4, 3] = use.closest
        # Cycles interpolates such images before it converts them to linear values.
        is_encoded = not use.image.is_float and use.image.colorspace_settings.name == "sRGB"
        encoding = is_encoded * (1 + use.by_alpha)
        rows[5, 3] = EXTENSIONS.index(use.extension) + len(EXTENSIONS) * encoding
    return rows


def albedo_table() -> np.ndarray:
    """(33, 32): directional albedo of GGX by roughness and cosine; the last row is its average by roughness."""
    return np.vstack(closures.albedo_tables())


def sheen_table() -> np.ndarray:
    """(N, N, 4): albedo, a and b of sheen (see `closures.sheen_lobe`), albedo of velvet; rows by cosine, columns by
    roughness."""
    nodes = np.linspace(0.0, 1.0, closures.SHEEN_NODES)
    cosine, roughness = (axis.ravel() for axis in np.meshgrid(nodes, nodes, indexing="ij"))
    values = np.concatenate([closures.sheen_lobe(cosine, roughness), closures.velvet_albedo(cosine, roughness)[None]])
    return values.T.reshape(len(nodes), len(nodes), 4)


def blend_table() -> np.ndarray:
    """(256, 16): the place of a dielectric's albedo between f0 and 1; rows by roughness and cosine.

    Columns are uniform in the fourth root of f0.
    """
    count = closures.GLASS_NODES
    nodes = np.linspace(0.0, 1.0, count)
    roughness, cosine, coordinate = (axis.ravel() for axis in np.meshgrid(nodes, nodes, nodes, indexing="ij"))
    f0 = np.minimum(coordinate**4, closures.MAX_F0)
    ior = (1.0 + np.sqrt(f0)) / (1.0 - np.sqrt(f0))
    share = closures.dielectric_albedo(np.zeros((len(ior), 1)), ior, roughness, cosine)[:, 0]
    return share.reshape(count * count, count)
