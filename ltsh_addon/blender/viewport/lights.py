"""The lights of a view: area lights and flat glowing meshes, with nodes as far as they can be resolved."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np

from ...scene import Light
from ..evaluated import (
    SURFACE_TYPES,
    EmitterTraits,
)
from ..lights.area import area_light, node_light, note_unsupported, reason_to_leave_out
from ..lights.emission import emission_of, factors_of, open_studio
from ..lights.linking import Receivers
from ..lights.meshes import collect_mesh_lights, constant_mesh_lights
from ..lights.textures import (
    MOST_INSTANCES,
    NodeEmission,
    NodeLight,
    ShownTextures,
    node_emission,
    with_pattern,
)
from ..materials.graph import source_of, surface_of, tree_in_use
from ..materials.preview_material import preview_of
from ..materials.values import product, value_at

# FAR_AWAY: the eye where there is no camera, outside of all closed emissive meshes.
FAR_AWAY = np.full(3, 1e6)
# MOST_LIGHTS: patches and faces included. The time of a frame grows with their number.
MOST_LIGHTS = 2048
# Reasons why a light has no pattern.
NOT_RESOLVED = "its nodes are not resolved, it shines as without them"
NOT_YET = "it shines as without its nodes until Cycles has sources at them"
# Patterns: a function that returns how Cycles sees the nodes of evaluated light data, or why that is not known.
Patterns = Callable[[bpy.types.Light, NodeLight], NodeEmission | str]


def no_patterns(data, source: NodeLight) -> str:
    """The `Patterns` of views that resolve no nodes."""
    return NOT_RESOLVED


def view_lights(
    depsgraph, in_view: Callable, textures: ShownTextures, patterns: Patterns = no_patterns
) -> tuple[tuple[Light, ...], tuple[str, ...]]:
    """The lights among the instances that `in_view` accepts, and notes about what differs from Cycles.

    `textures` are those of the last call, for reuse.
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
        shown = [
            light
            for light in _with_nodes(plain, instance, (textures, patterns), notes)
            if np.any(light.radiance != 0.0)
        ]
        if shown:
            lights.extend(shown)
            note_unsupported(ob, matrix, SimpleNamespace(warn=notes.append))
    if emits:
        lights.extend(_mesh_lights(depsgraph, receivers, notes))
    return tuple(strongest(lights, notes)), tuple(dict.fromkeys(notes))


def strongest(lights: list[Light], notes: list[str], most: int = MOST_LIGHTS) -> list[Light]:
    """The `most` lights with the largest power, in their order; what is missing is told in `notes`."""
    if len(lights) <= most:
        return lights
    power = np.array([np.linalg.norm(light.area_vector) * np.abs(light.radiance).sum() for light in lights])
    chosen = np.sort(np.argsort(-power, kind="stable")[:most])
    missing = 1.0 - power[chosen].sum() / power.sum()
    notes.append(
        f"Of {len(lights)} lights, faces and patches the {most} strongest are shown, {100.0 * missing:.1f} % of the "
        "power is missing"
    )
    return [lights[index] for index in chosen]


def _has_emission(ob) -> bool:
    return any(slot.material is not None and np.any(_emission(slot.material)) for slot in ob.material_slots)


def _emission(material) -> np.ndarray:
    return np.zeros(3) if material is None else preview_of(material.original).emission


def _mesh_lights(depsgraph, receivers: Receivers, notes: list[str]) -> list[Light]:
    override = depsgraph.view_layer_eval.material_override
    mesh_lights = collect_mesh_lights(depsgraph, override, receivers, notes.append, copies=False)
    camera = depsgraph.scene.camera
    eye = FAR_AWAY if camera is None else np.array(camera.matrix_world.translation)
    return constant_mesh_lights(mesh_lights, _emission, eye, notes.append)


def patterns_of(scene, depsgraph) -> dict[tuple, NodeEmission]:
    """How Cycles sees the nodes of lights that views cannot read themselves, by the `key` of the `NodeLight`.

    `scene` is left as it was.
    """
    wanted: dict[tuple, NodeLight] = {}

    def note(data, source: NodeLight) -> str:
        if len(wanted) < MOST_INSTANCES:
            wanted[source.key] = source
        return NOT_YET

    receivers, sources = Receivers([]), (ShownTextures(), note)
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type == "LIGHT" and tree_in_use(ob.data) is not None:
            matrix = np.array(instance.matrix_world, dtype=np.float64)
            if not reason_to_leave_out(ob, matrix):
                _with_nodes(area_light(ob, matrix, EmitterTraits.of(instance), receivers), instance, sources, [])
    if not wanted:
        return {}
    with open_studio(scene) as studio:
        return {key: node_emission(source, studio) for key, source in wanted.items()}


def _with_nodes(light: Light, instance, sources: tuple, notes: list[str]) -> list[Light]:
    """The lights that the node tree of a depsgraph `instance` makes of `light`; [] where it emits nothing.

    `sources` are the textures and patterns of `view_lights`.
    """
    ob, (textures, patterns) = instance.object, sources
    data = ob.data
    emission = None if tree_in_use(data) is None else emission_of(data)
    if emission is None or emission.plain:
        return [light]
    surface = surface_of(data)
    source = source_of(surface) if surface is not None else None
    if source is None or source.node is None:
        return []
    if source.node.bl_idname == "ShaderNodeEmission" and emission.falloff is not None:
        if not light.is_distant:
            light = replace(light, falloff=emission.falloff.power, smooth=emission.falloff.smooth)
        entries, _ = factors_of(source)
        factor = functools.reduce(product, [value_at(*entry) for entry in entries])
        if factor is not None and factor.is_constant:
            return [replace(light, radiance=light.radiance * factor.offset)]
        is_area = not (light.is_facing or light.is_distant)
        patches = textures.split(light, factor, notes) if factor is not None and is_area else None
        if patches is not None:
            return patches
    warnings: list[str] = []
    matrix = np.array(instance.matrix_world, dtype=np.float64)
    unseen = node_light(ob, matrix, SimpleNamespace(warn=warnings.append), instance)
    pattern = patterns(data, unseen)
    if isinstance(pattern, str):
        notes.append(f"{light.name}: {pattern}")
        return [light if light.is_distant else replace(light, falloff=0, smooth=0.0)]
    notes += warnings
    if not light.is_distant:
        light = replace(light, falloff=unseen.falloff.power, smooth=unseen.falloff.smooth)
    if light.is_facing or light.is_distant:
        return with_pattern(light, pattern, unseen, notes.append)
    return textures.split_by_nodes(light, pattern, notes)
