"""Objects with materials that may emit, found in the evaluated scene (runs in the child); `mesh_light_faces` makes
`AreaLight`s of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy
import numpy as np

from ...scene import AreaLight
from ..foreach_values import read_values
from ..materials.shader_graph import live_link, material_output
from ..pixels.inventory import SURFACE_TYPES, EmitterTraits, RenderedSurface, surface_instancer
from .emission_nodes import Emission, emission_behind
from .light_linking import Receivers


@dataclass
class Placement:
    """One instance of an object that shines: evaluated mesh in world space."""

    vertices: np.ndarray  # (N, 3)
    triangles: np.ndarray  # (T, 3) counterclockwise around the side that Cycles calls front
    slots: np.ndarray  # (T,) index of the material slot
    matrix: np.ndarray  # (4, 4)
    mesh: object = None  # copy of the evaluated mesh, where a texture must be looked at


@dataclass
class MeshLight:
    """An object whose materials may emit, before anybody has looked at them."""

    ob: object  # original
    light: AreaLight  # a stand-in with all that does not depend on the polygon
    materials: list  # original material or None per slot
    emission: list[Emission]  # per slot
    placements: list[Placement] = field(default_factory=list)
    instancers: dict[str, RenderedSurface] = field(default_factory=dict)  # by full name

    @property
    def varies(self) -> bool:
        return any(emission.varies for emission in self.emission)

    @property
    def emitting_materials(self) -> list[str]:
        """Full names of the materials that may emit."""
        pairs = zip(self.materials, self.emission, strict=True)
        return [material.name_full for material, emission in pairs if emission.emits]


def collect_mesh_lights(depsgraph, override, receivers: Receivers, warn, copies: bool = True) -> list[MeshLight]:
    """Objects that a render of `depsgraph` sees with materials that may emit; `override` replaces all materials.

    Without `copies` of their meshes, textures cannot be looked at, and no data is made.
    """
    found: dict[tuple, MeshLight | None] = {}
    known: dict[str, Emission] = {}
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type not in SURFACE_TYPES or not instance.show_self or not _is_rendered(ob):
            continue
        traits = EmitterTraits.of(instance)
        slots = tuple(slot.material.name_full if slot.material else "" for slot in ob.material_slots)
        key = (ob.original.name_full, ob.data.name_full if ob.data else "", slots, traits)
        if key not in found:
            found[key] = _mesh_light(ob, traits, override, receivers, known)
            if found[key] is not None and ob.type in ("CURVES", "POINTCLOUD"):
                warn(f"object {ob.original.name!r}: the emission of {ob.type.lower()} is not shaded, it lights nothing")
                found[key] = None
        if found[key] is not None:
            matrix = np.array(instance.matrix_world, dtype=np.float64)
            placement = _placement(ob, matrix, found[key], depsgraph if copies else None)
            if placement is not None:
                found[key].placements.append(placement)
                instancer = surface_instancer(instance)
                if instancer is not None:
                    found[key].instancers[instancer.original.name_full] = instancer
    return [light for light in found.values() if light is not None and light.placements]


def _is_rendered(ob) -> bool:
    """False for curves and texts themselves: renders see the mesh they make, which comes as an instance of its own."""
    return ob.type not in ("CURVE", "FONT", "SURFACE") or isinstance(ob.data, bpy.types.Mesh)


def _mesh_light(ob, traits: EmitterTraits, override, receivers: Receivers, known: dict) -> MeshLight | None:
    slots = [override] * max(1, len(ob.material_slots)) if override else [slot.material for slot in ob.material_slots]
    materials = [None if material is None else material.original for material in slots]
    emission = [_emission_of(material, known) for material in materials]
    if not any(part.emits for part in emission) or not (traits.diffuse or traits.glossy):
        return None
    nothing = np.zeros(3)
    light = AreaLight(
        name=ob.original.name,
        shape="RECTANGLE",
        center=nothing,
        half_u=nothing,
        half_v=nothing,
        direction=nothing,
        radiance=nothing,
        group=traits.group,
        affects_diffuse=traits.diffuse,
        affects_specular=traits.glossy,
        receivers=receivers.of(ob.original),
    )
    return MeshLight(ob.original, light, materials, emission)


def _emission_of(material, known: dict[str, Emission]) -> Emission:
    if material is None:
        return Emission()
    if material.name_full not in known:
        tree = material.node_tree if bpy.app.version >= (5, 0, 0) or material.use_nodes else None
        output = material_output(tree) if tree else None
        known[material.name_full] = emission_behind(tree, output.inputs["Surface"]) if output else Emission()
    return known[material.name_full]


def displaces(material) -> bool:
    """True if something feeds the Displacement socket of `material`."""
    output = material_output(material.node_tree)
    return output is not None and live_link(output.inputs["Displacement"]) is not None


def _placement(ob, matrix: np.ndarray, light: MeshLight, depsgraph) -> Placement | None:
    mesh = ob.to_mesh()
    try:
        if mesh is None or not np.isfinite(matrix).all():
            return None
        vertices = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        triangles = read_values(mesh.loop_triangles, "vertices", (count, 3), np.int32)
        slots = read_values(mesh.loop_triangles, "material_index", (count,), np.int32)
    finally:
        ob.to_mesh_clear()
    slots = np.clip(slots, 0, len(light.materials) - 1)
    if not len(slots) or not any(light.emission[slot].emits for slot in np.unique(slots)):
        return None
    copy = None
    if light.varies and depsgraph is not None:
        copy = bpy.data.meshes.new_from_object(ob, preserve_all_data_layers=True, depsgraph=depsgraph)
    world = vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    triangles = triangles.astype(np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        triangles = triangles[:, ::-1]
    return Placement(world, triangles, slots, matrix, copy)
