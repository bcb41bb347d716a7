"""The meshes that are baked: which objects, and their meshes and UV maps as they are rendered (runs in the child)."""

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...cycles.texels import TexelMesh
from ...cycles.uv import tiles_of
from ...scene import FARTHEST, SceneError, listed
from ..evaluated import normals_at_corners, objects_in_renders, read_values, uv_maps, with_render_depsgraph

UV_LAYER = "ltsh_texels"


class ObjectError(Exception):
    """An object cannot be baked; the message is one line and names it."""


def switch_off_holdouts(view_layer, objects, warnings: list[str]) -> None:
    """Let Cycles bake `objects` that are holdouts, which it bakes black."""
    for ob in objects:
        if ob.holdout_get(view_layer=view_layer):
            warnings.append(f"object {ob.name!r}: holdout is switched off, it is baked like any surface")
        ob.is_holdout = False
    collections = [view_layer.layer_collection]
    for collection in collections:
        collection.holdout = False
        collections.extend(collection.children)


def chosen_objects(scene, view_layer, wanted) -> list:
    """Objects to bake: "all" meshes that render, the "selected" ones, or those named. Raises SceneError."""
    if isinstance(wanted, str):
        rendered = objects_in_renders(view_layer)
        objects = [
            ob for ob in view_layer.objects
            if ob.type == "MESH" and ob in rendered and (wanted == "all" or ob.select_get())
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
    if layer is None and not uv_name and len(mesh.uv_layers):  # geometry nodes have made the mesh
        original = ob.data.uv_layers.active
        layer = mesh.uv_layers.get(original.name if original else "") or mesh.uv_layers[0]
    if layer is None:
        names = ", ".join(repr(other.name) for other in mesh.uv_layers) or "none"
        wanted = f"no UV map {uv_name!r}" if uv_name else "no UV map"
        raise ObjectError(f"object {ob.name!r} has {wanted}, found {names}: unwrap it, or choose another UV map")
    loops, vertices = (read_values(mesh.loop_triangles, name, (3 * count,), np.int32) for name in ("loops", "vertices"))
    positions = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
    normals, flat = normals_at_corners(mesh)
    maps = {name: of_corners[loops].reshape(count, 3, 2) for name, of_corners in uv_maps(mesh).items()}
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
    return texel_mesh, layer.name, {"": maps[layer.name], **maps}


def uv_of(layer, count):
    return read_values(layer.uv, "vector", (count, 2), np.float32)


def apply_modifiers(scene, objects) -> None:
    """Replace the meshes of objects by evaluated ones, except for modifiers that make instances as well.

    Modifiers may change UV maps and materials, which Cycles' bake reads from the object's own mesh, and copy faces,
    which need texels of their own in an atlas.
    """
    modified = [ob for ob in objects if ob.type == "MESH" and not (ob.library or ob.data.library) and len(ob.modifiers)]
    if not modified:
        return

    def visit(depsgraph):
        instancers = {item.parent.original for item in depsgraph.object_instances if item.is_instance and item.parent}
        return {ob: _evaluated_copy(ob, depsgraph) for ob in modified if ob not in instancers}

    for ob, mesh in with_render_depsgraph(scene, visit).items():
        ob.data = mesh
        for modifier in [modifier for modifier in ob.modifiers if modifier.type != "PARTICLE_SYSTEM"]:
            ob.modifiers.remove(modifier)


def _evaluated_copy(ob, depsgraph):
    """A new mesh with the result of the modifiers of `ob`; its generated coordinates are unchanged."""
    evaluated = ob.evaluated_get(depsgraph)
    mesh = bpy.data.meshes.new_from_object(evaluated, preserve_all_data_layers=True, depsgraph=depsgraph)
    mesh.use_auto_texspace = False
    mesh.texspace_location, mesh.texspace_size = ob.data.texspace_location, ob.data.texspace_size
    return mesh
