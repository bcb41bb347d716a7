"""Area lights and flat emissive meshes of a viewport's scene, as far as constants and images tell what they emit."""

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
from ..lights.shown_textures import ShownTextures
from ..materials.linear_values import product
from ..materials.look_reader import look_of
from ..materials.node_sources import source_of
from ..materials.node_values import value_at
from ..materials.shader_graph import material_output
from ..pixels.inventory import SURFACE_TYPES, EmitterTraits

# Where nothing says on which side of closed emissive meshes the eye is, it is outside.
FAR_AWAY = np.full(3, 1e6)
# Patches and faces included. A frame takes as long as all of them do.
MOST_LIGHTS = 2048


def view_lights(depsgraph, in_view: Callable, textures: ShownTextures) -> tuple[tuple[AreaLight, ...], tuple[str, ...]]:
    """The lights among the instances that `in_view` says yes to, and what is not shown as Cycles has it.

    `textures` are those of the last time.
    """
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
        plain = area_light(ob, matrix, EmitterTraits.of(instance), receivers)
        shown = [light for light in _with_nodes(plain, ob.data, textures, notes) if np.any(light.radiance != 0.0)]
        if shown:
            lights.extend(shown)
            note_unsupported(ob, matrix, SimpleNamespace(warn=notes.append))
    if emits:
        lights.extend(_mesh_lights(depsgraph, receivers, notes))
    return tuple(strongest(lights, notes)), tuple(dict.fromkeys(notes))


def strongest(lights: list[AreaLight], notes: list[str], most: int = MOST_LIGHTS) -> list[AreaLight]:
    """The `most` lights with the largest power, in their order; the others are named in `notes`."""
    if len(lights) <= most:
        return lights
    power = np.array([np.linalg.norm(light.area_vector) * np.abs(light.radiance).sum() for light in lights])
    kept = np.sort(np.argsort(-power, kind="stable")[:most])
    left = 1.0 - power[kept].sum() / power.sum()
    notes.append(
        f"Of {len(lights)} lights, faces and patches the {most} strongest are shown, {100.0 * left:.1f} % of the power "
        "is missing"
    )
    return [lights[index] for index in kept]


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


def _with_nodes(light: AreaLight, data, textures: ShownTextures, notes: list[str]) -> list[AreaLight]:
    """`light` with what constants and images in its node tree make of it."""
    tree = data.node_tree if bpy.app.version >= (5, 0, 0) or data.use_nodes else None
    if tree is None:
        return [light]
    output = material_output(tree)
    emission = emission_behind(tree, output.inputs["Surface"]) if output is not None else Emission()
    if emission.plain:
        return [light]
    source = source_of(tree, output.inputs["Surface"]) if output is not None else None
    if source is None or source.node is None:
        return []
    if source.node.bl_idname == "ShaderNodeEmission":
        inputs = (source.node.inputs[name] for name in ("Color", "Strength"))
        factor = product(*(value_at(source.tree, socket, source.groups) for socket in inputs))
        if factor is not None and factor.is_constant:
            return [replace(light, radiance=light.radiance * factor.offset)]
        patches = None if factor is None else textures.split(light, factor, notes)
        if patches is not None:
            return patches
    notes.append(f"{light.name}: its nodes are not resolved, it shines as without them")
    return [light]
