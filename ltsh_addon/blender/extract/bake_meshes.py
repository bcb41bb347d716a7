"""The meshes that are baked: which objects, and their meshes and UV maps as they are rendered (runs in the child)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...cycles.texels import TexelMesh
from ...cycles.uv import tiles_of
from ...scene import FARTHEST, SceneError, listed
from ..evaluated import normals_at_corners, read_values, with_render_depsgraph

UV_LAYER = "ltsh_texels"


class ObjectError(Exception):
    """An object cannot be baked; the message is one line and names it."""


def chosen_objects(scene, view_layer, wanted) -> list:
    """Objects to bake: "all" meshes that render, the "selected" ones, or those named. Raises SceneError."""
    if isinstance(wanted, str):
        objects = [
            ob for ob in view_layer.objects
            if ob.type == "MESH" and not ob.hide_render and (wanted == "all" or ob.select_get())
        ]  # fmt: skip
        if not objects:
            raise SceneError(
                f"scene {scene.name!r}: no mesh that renders"
                + (" is selected; select one in the file or name it" if wanted == "selected" else ", nothing to bake")
            )
        return objects
    missing = [name for name in wanted if name not in view_layer.objects]
    if missing:
        names = listed(repr(ob.name) for ob in view_layer.objects if ob.type == "MESH")
        raise SceneError(f"object {missing[0]!r} is not in scene {scene.name!r}; meshes there: {names}")
    return [view_layer.objects[name] for name in wanted]


def check_object(ob) -> None:
    """Raise ObjectError if the object cannot be baked, as far as that is known without evaluating it."""
    if ob.type != "MESH":
        raise ObjectError(f"object {ob.name!r} is a {ob.type}, expected a mesh: convert it to one")
    if ob.library is not None or ob.data.library is not None:
        library = (ob.library or ob.data.library).filepath
        raise ObjectError(f"object {ob.name!r} is linked from {library}: bake it there, or make it local")
    if ob.hide_render:
        raise ObjectError(f"object {ob.name!r} is hidden in renders: show it")


def tiles_without_modifiers(ob, uv_name: str | None) -> list[int]:
    """The UDIM tiles of a mesh object; [] if they are unknown without evaluating it."""
    if ob.type != "MESH" or ob.modifiers or len(ob.data.loops) == 0:
        return []
    layer = ob.data.uv_layers.get(uv_name) if uv_name else ob.data.uv_layers.active
    if layer is None:
        return []
    uv = uv_of(layer, len(ob.data.loops))
    if (np.floor(uv.min(axis=0)) == 0.0).all() and (uv.max(axis=0) <= 1.0).all():
        return [1001]
    ob.data.calc_loop_triangles()
    triangles = read_values(ob.data.loop_triangles, "loops", (3 * len(ob.data.loop_triangles),), np.int32)
    return tiles_of(uv[triangles].reshape(-1, 3, 2))[0]


@dataclass(frozen=True)
class MeshFiles:
    """The mesh and the UV maps of an object, saved in files."""

    mesh: Path  # for `TexelMesh.load`
    uv_name: str
    uv_names: tuple[str, ...]  # "" for the one that renders
    uv_maps: Path  # .npz of arrays (T, 3, 2), named by the position in `uv_names`

    def uv_map(self, name: str, mesh: TexelMesh) -> np.ndarray:
        """The UV map `name` (T, 3, 2) of the `mesh`; zeros if it has none of that name."""
        if name not in self.uv_names:
            return np.zeros_like(mesh.uv)
        with np.load(self.uv_maps) as data:
            return data[str(self.uv_names.index(name))]


def save_mesh(mesh: TexelMesh, uv_name: str, uv_maps: dict, folder: Path, number: int) -> MeshFiles:
    """Save the results of `read_mesh` for object `number` as files in `folder`."""
    path, maps = folder / f"mesh_{number}.npz", folder / f"uv_{number}.npz"
    mesh.save(path)
    np.savez(maps, **{str(position): values for position, values in enumerate(uv_maps.values())})
    return MeshFiles(path, uv_name, tuple(uv_maps), maps)


def read_mesh(ob, depsgraph, uv_name: str | None) -> tuple[TexelMesh, str, dict[str, np.ndarray]]:
    """The evaluated mesh of `ob`, the name of the UV map to bake, and all UV maps (T, 3, 2) by name.

    "" names the UV map that renders. Raises ObjectError.
    """
    evaluated = ob.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph)
    try:
        return _read(ob, mesh, np.array(evaluated.matrix_world, dtype=np.float64), uv_name)
    finally:
        evaluated.to_mesh_clear()


def _read(ob, mesh, matrix, uv_name):
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    if count == 0:
        raise ObjectError(f"object {ob.name!r} has no faces, nothing to bake")
    layer = mesh.uv_layers.get(uv_name) if uv_name else mesh.uv_layers.active
    if layer is None:
        names = ", ".join(repr(other.name) for other in mesh.uv_layers) or "none"
        wanted = f"no UV map {uv_name!r}" if uv_name else "no UV map"
        raise ObjectError(f"object {ob.name!r} has {wanted}, found {names}: unwrap it, or choose another UV map")
    loops, vertices = (read_values(mesh.loop_triangles, name, (3 * count,), np.int32) for name in ("loops", "vertices"))
    positions = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
    normals, flat = normals_at_corners(mesh)
    maps = {other.name: uv_of(other, len(mesh.loops))[loops].reshape(count, 3, 2) for other in mesh.uv_layers}
    uv = maps[layer.name]
    linear = matrix[:3, :3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(linear)) < 1e-30:
        raise ObjectError(f"object {ob.name!r}: its transform has no inverse, expected a scale other than 0")
    if max(np.abs(matrix).max(), np.abs(positions[vertices]).max()) > FARTHEST:
        raise ObjectError(f"object {ob.name!r} is farther away, or larger, than {FARTHEST:g} m: move it, or scale it")
    world_normals = normals[loops].astype(np.float64) @ np.linalg.inv(linear)
    world_normals /= np.maximum(np.linalg.norm(world_normals, axis=-1, keepdims=True), 1e-30)
    slots = max(len(ob.material_slots), 1)
    texel_mesh = TexelMesh(
        corners=(positions[vertices].astype(np.float64) @ linear.T + matrix[:3, 3]).reshape(count, 3, 3),
        normals=world_normals.reshape(count, 3, 3),
        uv=uv,
        material=np.minimum(read_values(mesh.loop_triangles, "material_index", (count,), np.int32), slots - 1),
        mirrored=bool(np.linalg.det(linear) < 0.0),
    )
    is_flat = flat[read_values(mesh.loop_triangles, "polygon_index", (count,), np.int32)]
    texel_mesh.normals[is_flat] = texel_mesh.true_normals()[is_flat][:, None]
    a, b, c = np.moveaxis(uv.astype(np.float64), 1, 0)
    if not np.any((b - a)[:, 0] * (c - a)[:, 1] != (b - a)[:, 1] * (c - a)[:, 0]):
        raise ObjectError(f"object {ob.name!r}: all faces of UV map {layer.name!r} have no area: unwrap it")
    if not tiles_of(uv)[0]:
        raise ObjectError(
            f"object {ob.name!r}: all of UV map {layer.name!r} lies outside of the texture, expected some of it "
            "between 0 and 1, or whole faces in UDIM tiles: move it"
        )
    rendered = next((other.name for other in mesh.uv_layers if other.active_render), layer.name)
    return texel_mesh, layer.name, {**maps, "": maps[rendered]}


def uv_of(layer, count):
    return read_values(layer.uv, "vector", (count, 2), np.float32)


def apply_modifiers(scene, objects, uv_name: str | None, *, every: bool = False) -> None:
    """Replace the meshes of objects by evaluated ones where modifiers change the UV map or the materials.

    Booleans, arrays with caps and geometry nodes can do so; Cycles' bake reads both from the object's own mesh. With
    `every`, all modifiers are applied that make no instances: copies of faces need texels of their own.
    """
    probed = {}
    for ob in objects:
        if ob.type == "MESH" and ob.library is None and ob.data.library is None and len(ob.modifiers):
            layer = ob.data.uv_layers.get(uv_name) if uv_name else ob.data.uv_layers.active
            probed[ob] = "" if layer is None or every else _probe(ob.data, layer)
    if not probed:
        return

    def visit(depsgraph):
        instancers = {item.parent.original for item in depsgraph.object_instances if item.is_instance and item.parent}
        return {
            ob: _evaluated_copy(ob, depsgraph)
            for ob, probe in probed.items()
            if ob not in instancers and (every or not _bakes_from_own_mesh(ob, depsgraph, uv_name, probe))
        }

    made = with_render_depsgraph(scene, visit)
    for ob, probe in probed.items():
        if probe:
            ob.data.uv_layers.remove(ob.data.uv_layers[probe])
    for ob, mesh in made.items():
        ob.data = mesh
        for modifier in [modifier for modifier in ob.modifiers if modifier.type != "PARTICLE_SYSTEM"]:
            ob.modifiers.remove(modifier)


def _probe(mesh, layer) -> str:
    """The name of a new UV map of `mesh`, a copy of `layer` moved as `Block.placed` does; "" if there is no room."""
    name, active = layer.name, mesh.uv_layers.active_index
    probe = mesh.uv_layers.new(name=UV_LAYER, do_init=False)
    if probe is None:
        return ""
    mesh.uv_layers.active_index = active
    probe.uv.foreach_set("vector", _probed(uv_of(mesh.uv_layers[name], len(mesh.loops))).ravel())
    return probe.name


def _probed(uv: np.ndarray) -> np.ndarray:
    return (uv * (1.0, 4.0) - (0.0, 1.0)).astype(np.float32)


def _bakes_from_own_mesh(ob, depsgraph, uv_name, probe: str) -> bool:
    """True if the object's own mesh has the UV map and the materials with which it is rendered."""
    evaluated = ob.evaluated_get(depsgraph)
    if [slot.material and slot.material.original for slot in evaluated.material_slots] != [
        slot.material for slot in ob.material_slots
    ]:
        return False
    mesh = evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph)
    try:
        layers = mesh.uv_layers
        layer = layers.get(uv_name) if uv_name else layers.active
        if layer is None or not probe:
            return layer is None or layer.name in ob.data.uv_layers
        probe_layer, count = layers.get(probe), len(mesh.loops)
        return probe_layer is not None and np.allclose(
            uv_of(probe_layer, count), _probed(uv_of(layer, count)), atol=1e-4
        )
    finally:
        evaluated.to_mesh_clear()


def _evaluated_copy(ob, depsgraph):
    """A new mesh with the result of the modifiers of `ob`; its generated coordinates are unchanged."""
    evaluated = ob.evaluated_get(depsgraph)
    mesh = bpy.data.meshes.new_from_object(evaluated, preserve_all_data_layers=True, depsgraph=depsgraph)
    mesh.use_auto_texspace = False
    mesh.texspace_location, mesh.texspace_size = ob.data.texspace_location, ob.data.texspace_size
    return mesh
