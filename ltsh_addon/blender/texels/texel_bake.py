"""The child's bake: meshes and materials of objects, maps of what varies over them, and Cycles' own bake.

Runs in the child, on the file in memory. Everything is baked into a UV map of its own, in which the wanted rows of the
wanted tile fill the unit square: so any tile and any block of rows is an image of its own, and none is large.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ...scene import FARTHEST
from ..foreach_values import read_values
from ..materials.material_maps import MaterialPlan
from ..processes.child import SceneError
from ..processes.missing_names import listed
from .texel_samples import BakeView, TexelMesh
from .uv_raster import tiles_of

UV_LAYER = "ltsh_texels"
NOT_BAKED = -1e9
SEEDS = {"A": 1, "B": 7919}
CYCLES_TYPES = {"specular": "GLOSSY", "diffuse": "DIFFUSE"}


class ObjectError(Exception):
    """An object cannot be baked; the message is one line and names it."""


@dataclass(frozen=True)
class Block:
    """Rows of a tile: first row (from below), number of rows, and the size of the whole tile."""

    tile: int
    first_row: int
    rows: int
    width: int
    height: int

    @property
    def name(self) -> str:
        return f"{self.tile}_{self.first_row}"

    def placed(self, uv: np.ndarray) -> np.ndarray:
        """uv (N, 2) so that the block fills the unit square."""
        column, row = (self.tile - 1001) % 10, (self.tile - 1001) // 10
        v = (uv[:, 1] - row) * (self.height / self.rows) - self.first_row / self.rows
        return np.stack([uv[:, 0] - column, v], axis=-1)


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
        names = listed((ob.name for ob in view_layer.objects if ob.type == "MESH"), missing[0])
        raise SceneError(f"object {missing[0]!r} is not in scene {scene.name!r}; meshes there: {names}")
    return [view_layer.objects[name] for name in wanted]


def check_object(ob) -> None:
    """Raise ObjectError for what can be told without evaluating the object."""
    if ob.type != "MESH":
        raise ObjectError(f"object {ob.name!r} is a {ob.type}, expected a mesh: convert it to one")
    if ob.library is not None or ob.data.library is not None:
        library = (ob.library or ob.data.library).filepath
        raise ObjectError(f"object {ob.name!r} is linked from {library}: bake it there, or make it local")
    if ob.hide_render:
        raise ObjectError(f"object {ob.name!r} is hidden in renders: show it")


def tiles_without_modifiers(ob, uv_name: str | None) -> list[int]:
    """UDIM tiles of a mesh object; none where they cannot be told without evaluating it."""
    if ob.type != "MESH" or ob.modifiers or len(ob.data.loops) == 0:
        return []
    layer = ob.data.uv_layers.get(uv_name) if uv_name else ob.data.uv_layers.active
    if layer is None:
        return []
    uv = _uv_of(layer, len(ob.data.loops))
    if (np.floor(uv.min(axis=0)) == 0.0).all() and (uv.max(axis=0) <= 1.0).all():
        return [1001]
    ob.data.calc_loop_triangles()
    triangles = read_values(ob.data.loop_triangles, "loops", (3 * len(ob.data.loop_triangles),), np.int32)
    return tiles_of(uv[triangles].reshape(-1, 3, 2))[0]


def read_mesh(ob, depsgraph, uv_name: str | None) -> tuple[TexelMesh, str, dict[str, np.ndarray]]:
    """The object `ob` as `depsgraph` evaluates it, the name of its UV map, and all of its UV maps (T, 3, 2) by name, ""
    for the one that renders. Raises ObjectError."""
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
        raise ObjectError(f"object {ob.name!r} has {wanted}, found {names}: unwrap it, or name another with --uv")
    loops, vertices = (read_values(mesh.loop_triangles, name, (3 * count,), np.int32) for name in ("loops", "vertices"))
    positions = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
    normals = read_values(mesh.corner_normals, "vector", (len(mesh.loops), 3), np.float32)
    maps = {other.name: _uv_of(other, len(mesh.loops))[loops].reshape(count, 3, 2) for other in mesh.uv_layers}
    uv = maps[layer.name]
    linear = matrix[:3, :3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(linear)) < 1e-30:
        raise ObjectError(f"object {ob.name!r}: its transform has no inverse, expected a scale other than 0")
    if max(np.abs(matrix).max(), np.abs(positions[vertices]).max()) > FARTHEST:
        raise ObjectError(f"object {ob.name!r} is farther away, or larger, than {FARTHEST:g} m: move it, or scale it")
    world_normals = normals[loops].astype(np.float64) @ np.linalg.inv(linear)
    world_normals /= np.maximum(np.linalg.norm(world_normals, axis=-1, keepdims=True), 1e-30)
    slots = max(len(ob.material_slots), 1)
    found = TexelMesh(
        corners=(positions[vertices].astype(np.float64) @ linear.T + matrix[:3, 3]).reshape(count, 3, 3),
        normals=world_normals.reshape(count, 3, 3),
        uv=uv,
        material=np.minimum(read_values(mesh.loop_triangles, "material_index", (count,), np.int32), slots - 1),
        vertices=vertices.reshape(count, 3),
    )
    a, b, c = np.moveaxis(uv.astype(np.float64), 1, 0)
    if not np.any((b - a)[:, 0] * (c - a)[:, 1] != (b - a)[:, 1] * (c - a)[:, 0]):
        raise ObjectError(f"object {ob.name!r}: all faces of UV map {layer.name!r} have no area: unwrap it")
    if not tiles_of(uv)[0]:
        raise ObjectError(
            f"object {ob.name!r}: all of UV map {layer.name!r} lies outside of the texture, expected some of it "
            "between 0 and 1, or whole faces in UDIM tiles: move it"
        )
    rendered = next((other.name for other in mesh.uv_layers if other.active_render), layer.name)
    return found, layer.name, {**maps, "": maps[rendered]}


def _uv_of(layer, count):
    return read_values(layer.uv, "vector", (count, 2), np.float32)


class ObjectBake:
    """Bakes maps of one object through Cycles, block by block."""

    def __init__(self, scene, ob, uv_name: str, plans: list[MaterialPlan]):
        self.scene, self.ob, self.uv_name, self.plans = scene, ob, uv_name, plans
        if uv_name not in ob.data.uv_layers:
            raise ObjectError(
                f"object {ob.name!r}: its UV map {uv_name!r} is made by modifiers, where textures cannot be baked: "
                "apply the modifiers"
            )
        active = ob.data.uv_layers.active_index
        layer = ob.data.uv_layers.new(name=UV_LAYER, do_init=False)
        if layer is None:
            raise ObjectError(f"object {ob.name!r} has eight UV maps, and baking needs one more: remove one")
        ob.data.uv_layers.active_index = active
        # A name in use gets a number.
        self.layer_name, self.images = layer.name, {}
        for plan in plans:
            plan.prepare()

    def close(self) -> None:
        """Take the UV map and the images out again."""
        self.ob.data.uv_layers.remove(self.ob.data.uv_layers[self.layer_name])
        for plan in self.plans:
            plan.remove()
        for image in self.images.values():
            bpy.data.images.remove(image)

    def maps(self, block: Block) -> np.ndarray:
        """(N, rows, W, 3) float32, row 0 below: map n of every material at once."""
        found = []
        for number in range(max((plan.count for plan in self.plans), default=0)):
            for plan in self.plans:
                plan.show(number)
            # A seed of its own: whatever was baked before, the bytes are the same.
            self.scene.cycles.seed, self.scene.cycles.samples = 0, 1
            found.append(self._bake(block, "EMIT", set()))
        return np.array(found)

    def radiance(self, block: Block, kind: str, samples: int) -> np.ndarray:
        """(2, rows, W, 3): Cycles' direct light, colors included, as two halves with their own seeds."""
        for plan in self.plans:
            plan.show(None)
        halves = []
        for seed in SEEDS.values():
            self.scene.cycles.seed, self.scene.cycles.samples = seed, samples
            halves.append(self._bake(block, CYCLES_TYPES[kind], {"DIRECT", "COLOR"}))
        return np.array(halves)

    def _bake(self, block: Block, kind: str, pass_filter) -> np.ndarray:
        image = self._image(block)
        image.pixels.foreach_set(np.full(block.rows * block.width * 4, NOT_BAKED, np.float32))
        self._place(block)
        for plan in self.plans:
            plan.target(image)
        options = {"pass_filter": pass_filter} if pass_filter else {}
        with bpy.context.temp_override(
            scene=self.scene, active_object=self.ob, object=self.ob, selected_objects=[self.ob]
        ):
            bpy.ops.object.bake(
                type=kind, margin=0, use_clear=False, uv_layer=self.layer_name, target="IMAGE_TEXTURES",
                save_mode="INTERNAL", use_selected_to_active=False, **options,
            )  # fmt: skip
        pixels = np.empty(block.rows * block.width * 4, np.float32)
        image.pixels.foreach_get(pixels)
        return np.ascontiguousarray(pixels.reshape(block.rows, block.width, 4)[..., :3])

    def _image(self, block):
        size = block.width, block.rows
        if size not in self.images:
            image = bpy.data.images.new("ltsh bake", *size, alpha=True, float_buffer=True, is_data=True)
            self.images[size] = image
        return self.images[size]

    def _place(self, block):
        layers = self.ob.data.uv_layers
        count = len(self.ob.data.loops)
        uv = _uv_of(layers[self.uv_name], count).astype(np.float64)
        layers[self.layer_name].uv.foreach_set("vector", block.placed(uv).astype(np.float32).ravel())
        self.ob.data.update()


def view_of(wanted, camera, bent: bool) -> BakeView:
    """The view `wanted`: "camera", "above" or a position (3,)."""
    if wanted == "above":
        return BakeView("above")
    if wanted == "camera":
        matrix = np.array(camera.matrix_world, dtype=np.float64)
        if camera.data.type == "ORTHO":
            axis = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
            return BakeView("direction", tuple(axis.tolist()), bent)
        return BakeView("point", tuple(matrix[:3, 3].tolist()), bent)
    return BakeView("point", tuple(wanted), bent)
