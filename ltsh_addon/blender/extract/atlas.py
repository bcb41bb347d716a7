"""The atlas of a bake: a UV map in which many objects share one texture, each with texels that no other has."""

import math
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ...cycles.uv import cross
from ...scene import ATLAS, SceneError
from ..evaluated import read_values
from .bake_meshes import ObjectError, check_object, uv_of

# BORDER: texels around islands that no other has, so that twice as many lie between islands: bilinear lookups stay
# within the margin of an island down to the second mip level.
BORDER = 2
# SHARPEST: faces of an island face within this angle of its direction, as Blender's Smart UV Project has it.
SHARPEST = math.radians(66.0)
# EACH_FACE: settings of Blender's Lightmap Pack.
EACH_FACE = {"PREF_CONTEXT": "ALL_FACES", "PREF_PACK_IN_ONE": True, "PREF_NEW_UVLAYER": False}
# BOXES: islands are packed as boxes: their shapes save 5 % and take a thousand times as long.
BOXES = {"shape_method": "AABB"}
# DENSITY: custom property of objects, a factor of their texels per metre.
DENSITY = "ltsh_density"


@dataclass(frozen=True)
class Island:
    """The mesh of an object in world space, in a scene of its own, with a UV map."""

    copy: bpy.types.Object
    scene: bpy.types.Scene
    density: float  # factor of the texels per metre

    def uv(self) -> np.ndarray:
        """UV coordinates (C, 2) of the corners of the faces."""
        return uv_of(self.copy.data.uv_layers[0], len(self.copy.data.loops)).astype(np.float64)

    def area(self) -> float:
        """Area of the surface in square metres."""
        triangles = self.copy.data.loop_triangles
        return float(read_values(triangles, "area", (len(triangles),), np.float32).sum(dtype=np.float64))

    def units_per_metre(self) -> float:
        """Units of the UV map on a metre of the surface, on average."""
        triangles = self.copy.data.loop_triangles
        corners = self.uv()[read_values(triangles, "loops", (3 * len(triangles),), np.int32)]
        a, b, c = np.moveaxis(corners.reshape(-1, 3, 2), 1, 0)
        return math.sqrt(0.5 * np.abs(cross(b - a, c - a)).sum() / self.area())


def make_atlas(
    objects, side: int, density: float | None = None, unwrap: str = "smart", name: str = ATLAS
) -> tuple[dict[str, float], dict[str, str]]:
    """Give `objects` the UV map `name` of an atlas; returns the texels per metre, and the problems of others, by name.

    The texture has `side` texels a side, the surface `density` texels per metre (None: as many as fit); `unwrap` is
    "smart", or "faces" where every edge is a seam. Objects that share a mesh get one each. Nothing else of the scene
    changes. Raises SceneError where the islands do not fit.
    """
    with _islands(objects, name) as (islands, problems):
        if not islands:
            return {}, problems
        unwrapped = list(islands.values())
        _unwrap(unwrapped, unwrap)
        _pack(unwrapped, side, density)
        for ob, island in islands.items():
            ob.data.uv_layers[name].uv.foreach_set("vector", island.uv().astype(np.float32).ravel())
        return {ob.name: side * island.units_per_metre() for ob, island in islands.items()}, problems


def make_single(ob) -> None:
    """Give `ob` a mesh that no other object has."""
    if ob.type == "MESH" and ob.library is None and ob.data.users > 1:
        ob.data = ob.data.copy()


@contextmanager
def _islands(objects, name):
    """Within this context: the Island of each of `objects`, in a scene of their own, so that no selection changes.

    Yields them by object, and the problems of other objects by name.
    """
    scene, islands, problems = bpy.data.scenes.new("ltsh atlas"), {}, {}
    try:
        tool_settings = scene.tool_settings
        tool_settings.use_uv_select_sync = True  # without, 4.5 packs nothing
        for ob in objects:
            try:
                islands[ob] = _island(ob, scene, name)
            except ObjectError as error:
                problems[ob.name] = str(error)
        yield islands, problems
    finally:
        for mesh in [ob.data for ob in scene.objects]:
            bpy.data.meshes.remove(mesh)  # with its object
        bpy.data.scenes.remove(scene)


def _island(ob, scene, name) -> Island:
    """The Island of `ob` in `scene`; the mesh of `ob` gets the UV map of the atlas, not yet filled."""
    check_object(ob)
    make_single(ob)
    density = ob.get(DENSITY, 1.0)
    if not isinstance(density, int | float) or not 0.0 < density < math.inf:
        raise ObjectError(f"object {ob.name!r}: its property {DENSITY!r} is {density!r}, expected a number above 0")
    mesh = ob.data.copy()
    mesh.materials.clear()  # aspects of their images would count
    mesh.transform(ob.matrix_world)
    mesh.polygons.foreach_set("hide", np.zeros(len(mesh.polygons), bool))
    for layer in list(mesh.uv_layers):
        mesh.uv_layers.remove(layer)
    mesh.uv_layers.new(do_init=False)
    copy = bpy.data.objects.new(ob.name, mesh)
    scene.collection.objects.link(copy)
    island = Island(copy, scene, float(density))
    if not island.area() > 0.0:
        raise ObjectError(f"object {ob.name!r} has no faces with an area, nothing to bake")
    layers = ob.data.uv_layers
    if name not in layers:
        active = layers.active_index
        if layers.new(name=name, do_init=False) is None:
            raise ObjectError(f"object {ob.name!r} has eight UV maps, and the atlas needs one of its own: remove one")
        layers.active_index = max(active, 0)
    return island


@contextmanager
def _editing(islands):
    """Within this context all faces are edited, selected."""
    copies = [island.copy for island in islands]
    scene = islands[0].scene
    layer = scene.view_layers[0]
    for copy in copies:
        copy.select_set(True, view_layer=layer)
    layer.objects.active = copies[0]
    names = "selected_objects", "selected_editable_objects", "objects_in_mode", "objects_in_mode_unique_data"
    context = {"scene": scene, "view_layer": layer, "active_object": copies[0], "object": copies[0]}
    with bpy.context.temp_override(**context, **dict.fromkeys(names[:2], copies)):
        bpy.ops.object.mode_set(mode="EDIT")
        try:
            edited = {"edit_object": copies[0], **dict.fromkeys(names, copies)}
            with bpy.context.temp_override(**edited):
                bpy.ops.mesh.select_all(action="SELECT")
                yield
        finally:
            bpy.ops.object.mode_set(mode="OBJECT")


def _unwrap(islands, how: str) -> None:
    with _editing(islands):
        if how == "faces":
            lightmap_pack = bpy.ops.uv.lightmap_pack
            lightmap_pack(**EACH_FACE)
        else:
            bpy.ops.uv.smart_project(angle_limit=SHARPEST)
        average_islands_scale = bpy.ops.uv.average_islands_scale
        average_islands_scale()


def _pack(islands, side: int, density: float | None) -> None:
    """Pack unwrapped `islands` into the unit square, as `make_atlas` says."""
    # Their units are metres, but for the islands' own densities.
    unpacked = [island.uv() * (island.density / island.units_per_metre()) for island in islands]

    def packed(factor: float, options: dict) -> float:
        pack_islands = bpy.ops.uv.pack_islands
        for island, uv in zip(islands, unpacked, strict=True):
            island.copy.data.uv_layers[0].uv.foreach_set("vector", (uv * factor).astype(np.float32).ravel())
        with _editing(islands):
            pack_islands(**options, **BOXES)
        return max(island.uv().max() for island in islands)

    if density is None:
        packed(1.0, {"margin_method": "FRACTION", "margin": BORDER / side})
        return
    needed, options = side, {"scale": False, "margin_method": "ADD"}
    # Each try begins with the same islands, so that it can be repeated. Half a texel is no reason for another size.
    while (extent := packed(density / needed, {**options, "margin": BORDER / needed}) + (BORDER - 0.5) / needed) > 1.0:
        needed = max(math.ceil(needed * extent), needed + 1)
    if needed > side:
        raise SceneError(
            f"the atlas has {side} texels a side, but {density:g} texels per metre take {needed}: make it larger, or "
            "lower the texels per metre"
        )
