"""What the evaluated scene holds: surfaces, instances and the traits of emitters."""

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import bpy
import numpy as np


def read_values(collection, name: str, shape: tuple[int, ...], dtype) -> np.ndarray:
    """The property `name` of all items of one of Blender's collections, as an array of `shape`."""
    values = np.empty(int(np.prod(shape)), dtype)
    collection.foreach_get(name, values)
    return values.reshape(shape)


def uv_maps(mesh) -> dict[str, np.ndarray]:
    """The UV maps (C, 2) of a mesh with C corners by name, "" the one that renders."""
    maps = {}
    for layer in mesh.uv_layers:
        maps[layer.name] = read_values(layer.uv, "vector", (len(mesh.loops), 2), np.float32)
        if layer.active_render:
            maps[""] = maps[layer.name]
    return maps


def image_pixels(image) -> np.ndarray:
    """Pixels (H, W, 4) float32 of an image, row 0 at the bottom."""
    width, height = image.size
    flat = np.empty(width * height * 4, np.float32)
    if flat.size:
        image.pixels.foreach_get(flat)
    return flat.reshape(height, width, 4)


# Before 5.0 Cycles did not use corner normals in meshes whose only sharp elements are faces.
_CORNERS_OF_SHARP_FACES = bpy.app.version >= (5, 0, 0)


def interpolated_normals(mesh, vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (C, 3) at the corners, whose vertices are `vertex` (C,), and the mask (F,) of flat faces, on which Cycles
    interpolates no normals."""
    has_vertex_normals, flat = kind_of_normals(mesh)
    if has_vertex_normals:
        normals = read_values(mesh.vertex_normals, "vector", (len(mesh.vertices), 3), np.float32)
        return normals.take(vertex, axis=0), flat
    return read_values(mesh.corner_normals, "vector", (len(vertex), 3), np.float32), flat


def kind_of_normals(mesh) -> tuple[bool, np.ndarray]:
    """Whether Cycles interpolates the normals of vertices, else those of corners; and the mask (F,) of flat faces.

    Faces are flat as in Cycles, which may differ from Blender's solid view: no face is flat if the normals belong to
    corners, and edges that are all sharp make faces flat only in meshes that do not mark faces.
    """
    faces = len(mesh.polygons)
    sharp = _marks(mesh, "sharp_face", faces)
    if "sharp_face" not in mesh.attributes and mesh.normals_domain == "FACE":
        sharp[:] = True
    by_vertex = not mesh.has_custom_normals and not sharp.all() and _edges_do_not_count(mesh, sharp)
    return by_vertex, sharp if by_vertex or mesh.normals_domain == "FACE" else np.zeros(faces, bool)


def _edges_do_not_count(mesh, sharp_faces: np.ndarray) -> bool:
    """True if Cycles takes the normals of vertices, except on sharp faces."""
    edges = _marks(mesh, "sharp_edge", len(mesh.edges))
    return bool(edges.all() if edges.any() else not _CORNERS_OF_SHARP_FACES or not sharp_faces.any())


def _marks(mesh, name: str, count: int) -> np.ndarray:
    attribute = mesh.attributes.get(name)
    return np.zeros(count, bool) if attribute is None else read_values(attribute.data, "value", (count,), bool)


def normals_at_corners(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Cycles' normals (C, 3) at all corners of `mesh`; corners of a flat face have the normal of the face. And the mask
    (F,) of the flat faces: where such a face is bent, Cycles takes the normals of its triangles."""
    count = len(mesh.loops)
    vertex = read_values(mesh.loops, "vertex_index", (count,), np.int32)
    normal, flat = interpolated_normals(mesh, vertex)
    if flat.any():
        is_flat = np.repeat(flat, read_values(mesh.polygons, "loop_total", (len(flat),), np.int32))
        normal[is_flat] = read_values(mesh.corner_normals, "vector", (count, 3), np.float32)[is_flat]
    return normal, flat


GREASE_PENCIL = ("GREASEPENCIL", "GPENCIL")
# STEPS_OF_RENDERS: what Blender does beside the engine. Freestyle, which finds no lines, would end it; compositing may
# write files.
STEPS_OF_RENDERS = ("use_freestyle", "use_compositing", "use_sequencer")
SURFACE_TYPES = ("MESH", "CURVE", "SURFACE", "FONT", "META", "CURVES", "POINTCLOUD")


def with_render_depsgraph(scene, visit: Callable, *, graphics: bool = False):
    """The result of `visit(depsgraph)`, called with the depsgraph of a final render of `scene`; with `graphics` it may
    use the graphics card."""
    outcome: dict = {}

    class Engine(bpy.types.RenderEngine):
        bl_idname, bl_label, bl_use_gpu_context = "LTSH_INVENTORY", "LTSH inventory", graphics

        def render(self, depsgraph):
            # An exception here would be printed and swallowed by Blender: hand it over instead.
            try:
                outcome["value"] = visit(depsgraph)
            except Exception as error:
                outcome["error"] = error

    render = scene.render
    saved = {name: getattr(render, name) for name in ("engine", "filepath", *STEPS_OF_RENDERS)}
    bpy.utils.register_class(Engine)
    try:
        for name in STEPS_OF_RENDERS:
            setattr(render, name, False)
        render.engine = Engine.bl_idname
        bpy.ops.render.render(scene=scene.name)
    finally:
        for name, value in saved.items():
            setattr(render, name, value)
        # Blender 4.5 hangs at exit when an engine is still registered.
        bpy.utils.unregister_class(Engine)
    if not outcome:
        raise RuntimeError(f"scene {scene.name!r}: Blender did not evaluate it for rendering, expected one view layer")
    if "error" in outcome:
        raise outcome["error"]
    return outcome["value"]


@dataclass(frozen=True)
class EmitterTraits:
    """The light group of an emitting object and the lobes that it lights."""

    group: str
    diffuse: bool
    glossy: bool

    @classmethod
    def of(cls, instance) -> "EmitterTraits":
        """The traits of a depsgraph instance.

        As in Cycles, the outermost instancer may switch lobes off, and its group is used if the object has none.
        """
        ob = instance.object
        group, diffuse, glossy = ob.original.lightgroup, ob.visible_diffuse, ob.visible_glossy
        if instance.is_instance and instance.parent is not None:
            parent = instance.parent
            group = group or parent.original.lightgroup
            diffuse, glossy = diffuse and parent.visible_diffuse, glossy and parent.visible_glossy
        return cls(group, diffuse, glossy)


@dataclass(frozen=True)
class RenderedSurface:
    """An original object with a surface, and its slots when it was evaluated, whose `material` is the original or None.

    It keeps no evaluated object: Blender makes those of instances for one step of the iteration only.
    """

    original: object
    material_slots: tuple[SimpleNamespace, ...]

    @classmethod
    def of(cls, ob) -> "RenderedSurface":
        """The surface of the evaluated object `ob`."""
        materials = [slot.material for slot in ob.material_slots]
        slots = (SimpleNamespace(material=material and material.original) for material in materials)
        return cls(ob.original, tuple(slots))


def surface_instancer(instance) -> RenderedSurface | None:
    """The outermost instancer of a depsgraph instance if it has a surface itself, else None."""
    if instance.is_instance and instance.parent is not None and instance.parent.type in SURFACE_TYPES:
        return RenderedSurface.of(instance.parent)
    return None


def rendered_surfaces(depsgraph) -> list[RenderedSurface]:
    """Objects with a surface, instances included, each once."""
    surfaces = {}
    for instance in depsgraph.object_instances:
        ob = instance.object
        # Hair has the materials of its emitter, which may itself be hidden.
        if ob.type in SURFACE_TYPES and (instance.show_self or instance.show_particles):
            key = (ob.original.name_full, ob.data.name_full if ob.data else "")
            if key not in surfaces:
                surfaces[key] = RenderedSurface.of(ob)
    return list(surfaces.values())


def is_surface(instance) -> bool:
    """True for an instance that has a surface and is shown."""
    return instance.object.type in SURFACE_TYPES and instance.show_self and is_rendered(instance.object)


def is_rendered(ob) -> bool:
    """False for curves, texts and metaballs: a render shows the mesh made from them, which is a separate instance."""
    return ob.type not in ("CURVE", "FONT", "SURFACE", "META") or isinstance(ob.data, bpy.types.Mesh)


def objects_in_views(layer) -> list:
    """The objects of a view layer that views show, but for local views."""
    return [ob for ob in layer.objects if ob.visible_get(view_layer=layer)]


def objects_in_renders(layer) -> set:
    """Objects of a view layer that renders show: neither they nor their collections are hidden there."""
    shown, collections = set(), [layer.layer_collection]
    for one in collections:
        if not one.collection.hide_render:
            shown.update(ob for ob in one.collection.objects if not (one.exclude or ob.hide_render))
            collections.extend(one.children)
    return shown


def owner_of(instance):
    """The object that brings an instance into the scene: its instancer, or itself if it has none."""
    return instance.parent if instance.is_instance and instance.parent else instance.object


def is_seen_by_cameras(instance, view_layer) -> bool:
    """False if the instance is hidden from camera rays, or contributes only indirectly in `view_layer`."""
    owner = owner_of(instance)
    if not (instance.object.visible_camera and owner.visible_camera):
        return False
    return not owner.original.indirect_only_get(view_layer=view_layer)


def data_pointer(ob) -> int:
    """A number that evaluated objects have in common when they share their data; 0 without data."""
    return ob.data.as_pointer() if ob.data is not None else 0


def mesh_key(instance) -> tuple:
    """A key of an evaluated mesh: its object, original data, instancer, and the address of the evaluated data.

    Blender may use the address of freed data again, but then one of the first three differs.
    """
    ob = instance.object
    data = ob.data
    parent = instance.parent.original.session_uid if instance.is_instance and instance.parent else 0
    original = data.original.session_uid if data is not None and data.original is not None else 0
    pointer = data_pointer(ob)
    shared = isinstance(data, bpy.types.Mesh) and not ob.modifiers and not instance.is_instance
    return (0 if shared else ob.original.session_uid, original, parent, pointer)


def visibility(depsgraph, space):
    """A function that is True for depsgraph instances shown in `space`; only its local view hides any."""
    if space is None or space.local_view is None:
        return lambda instance: True

    def in_local_view(instance) -> bool:
        return owner_of(instance).original.local_view_get(space)

    return in_local_view
