"""Area lights and flat emissive meshes of a viewport's scene, as far as constants tell what they emit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np

from ...scene import AreaLight
from ..lights.area_lights import area_light, note_unsupported, reason_to_leave_out
from ..lights.emission_nodes import Emission, emission_behind
from ..lights.light_linking import Receivers
from ..lights.mesh_light_faces import constant_mesh_lights
from ..lights.mesh_lights import collect_mesh_lights
from ..materials.node_sources import source_of
from ..materials.node_values import value_at
from ..materials.shader_graph import material_output
from ..materials.surface_looks import look_of
from ..pixels.inventory import SURFACE_TYPES, EmitterTraits

# Where nothing says on which side of closed emissive meshes the eye is, it is outside.
FAR_AWAY = np.full(3, 1e6)


def view_lights(depsgraph, in_view: Callable) -> tuple[tuple[AreaLight, ...], tuple[str, ...]]:
    """The lights among the instances that `in_view` says yes to, and what is not shown as Cycles has it."""
    notes: list[str] = []
    receivers = Receivers([ob.original for ob in depsgraph.objects])
    lights, emits = [], False
    for instance in depsgraph.object_instances:
        ob = instance.object
        if not instance.show_self or not in_view(instance):
            continue
        emits = emits or (ob.type in SURFACE_TYPES and _has_emission(ob))
        if ob.type != "LIGHT":
            continue
        matrix = np.array(instance.matrix_world, dtype=np.float64)
        problem = reason_to_leave_out(ob, matrix)
        if problem:
            notes.append(f"{ob.original.name}: {problem}")
            continue
        light = _with_nodes(area_light(ob, matrix, EmitterTraits.of(instance), receivers), ob.data, notes)
        if np.any(light.radiance != 0.0):
            lights.append(light)
            note_unsupported(ob, matrix, SimpleNamespace(warn=notes.append))
    if emits:
        lights.extend(_mesh_lights(depsgraph, receivers, notes))
    return tuple(lights), tuple(dict.fromkeys(notes))


def _has_emission(ob) -> bool:
    return any(slot.material is not None and np.any(_emission(slot.material)) for slot in ob.material_slots)


def _emission(material) -> np.ndarray:
    return np.zeros(3) if material is None else look_of(material.original).emission


def _mesh_lights(depsgraph, receivers: Receivers, notes: list[str]) -> list[AreaLight]:
    override = depsgraph.view_layer_eval.material_override
    found = collect_mesh_lights(depsgraph, override, receivers, notes.append, copies=False)
    camera = depsgraph.scene.camera
    eye = FAR_AWAY if camera is None else np.array(camera.matrix_world.translation)
    return constant_mesh_lights(found, _emission, eye, notes.append)


def _with_nodes(light: AreaLight, data, notes: list[str]) -> AreaLight:
    """`light` with what constants in its node tree make of it."""
    tree = data.node_tree if bpy.app.version >= (5, 0, 0) or data.use_nodes else None
    if tree is None:
        return light
    output = material_output(tree)
    emission = emission_behind(tree, output.inputs["Surface"]) if output is not None else Emission()
    if emission.plain:
        return light
    source = source_of(tree, output.inputs["Surface"]) if output is not None else None
    if source is None or source.node is None:
        return replace(light, radiance=np.zeros(3))
    if source.node.bl_idname == "ShaderNodeEmission":
        color, strength = (value_at(source.tree, source.node.inputs[name]) for name in ("Color", "Strength"))
        if color is not None and strength is not None and color.is_constant and strength.is_constant:
            return replace(light, radiance=light.radiance * color.offset * strength.offset)
    notes.append(f"{light.name}: its nodes are not resolved, it shines as without them")
    return light
