"""Lights and materials of a scene as the panels list them: what is exact, approximated or left out, and why.

Read from the nodes without evaluating the scene, so it takes no time; the report of a job also knows what instances,
textures and the render's own state add.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ..lights.area import (
    LightInventory,
    reason_to_leave_out,
    unseen_light,
)
from ..lights.area import (
    note_unsupported as note_unsupported_light,
)
from ..lights.emission import emission_behind
from ..materials.bsdfs import (
    LOBE_SOCKETS,
    METALLIC,
    NOT_SUPPORTED,
    PRINCIPLED,
    TRANSPARENT_NODES,
    is_group,
    note_unsupported,
)
from ..materials.graph import group_output, is_constant, live_link, material_output, value_of
from .preflight import glows, materials_of

EXACT, APPROXIMATED, LEFT_OUT = "exact", "approximated", "left out"
MIXES = ("ShaderNodeMixShader", "ShaderNodeAddShader")


@dataclass(frozen=True)
class Entry:
    """One light or material; `notes` say why it is not exact."""

    name: str
    kind: str  # of a light: its shape
    state: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Overview:
    """What the panels list."""

    lights: tuple[Entry, ...]
    materials: tuple[Entry, ...]


_known: dict[str, Overview] = {}


def overview(scene) -> Overview:
    """Lights and materials of `scene`, read again once something in the file has changed."""
    if scene.name not in _known:
        _known[scene.name] = Overview(
            tuple(_light(ob) for ob in scene.objects if ob.type == "LIGHT" and not ob.hide_render),
            tuple(_material(material) for material in materials_of(scene)),
        )
    return _known[scene.name]


def _light(ob) -> Entry:
    matrix = np.array(ob.matrix_world, dtype=np.float64)
    kind = ob.data.shape if ob.data.type == "AREA" else ob.data.type
    problem = reason_to_leave_out(ob, matrix)
    if problem:
        return Entry(ob.name, kind, LEFT_OUT, (problem,))
    inventory = LightInventory()
    unseen = unseen_light(ob, matrix, inventory)
    note_unsupported_light(ob, matrix, inventory)
    notes = [note.partition(": ")[2] for note in inventory.warnings]
    if unseen is not None and _varies(ob.data):
        notes.append("its emission varies, shaded as patches of constant radiance")
    return Entry(ob.name, kind, APPROXIMATED if notes else EXACT, tuple(notes))


def _varies(light) -> bool:
    output = light.node_tree.get_output_node("CYCLES") or light.node_tree.get_output_node("ALL")
    return output is not None and emission_behind(light.node_tree, output.inputs["Surface"]).varies


def _material(material) -> Entry:
    notes: list[str] = []
    output = material_output(material.node_tree) if material.node_tree is not None else None
    if output is None:
        return Entry(material.name, "", EXACT)
    if live_link(output.inputs["Volume"]) is not None:
        notes.append("its volume is not shaded")
    leaves = list(_shaders(material.node_tree, output.inputs["Surface"], set()))
    for node in leaves:
        if node.bl_idname in TRANSPARENT_NODES:
            if len(leaves) > 1:
                notes.append(f"node {node.name!r}: transparency is cut, the surface is shaded opaque")
        elif node.bl_idname != "ShaderNodeEmission":
            _note_bsdf(node, notes.append)
    kind = "emissive" if glows(material) else ""
    unique = tuple(dict.fromkeys(notes))
    left_out = unique and all(note.endswith(NOT_SUPPORTED) for note in unique) and len(unique) == len(leaves)
    return Entry(material.name, kind, LEFT_OUT if left_out else APPROXIMATED if unique else EXACT, unique)


def _note_bsdf(node, note) -> None:
    if node.bl_idname not in LOBE_SOCKETS and node.bl_idname != METALLIC:
        note(f"node {node.name!r} {NOT_SUPPORTED}")
        return
    note_unsupported(node, note)
    if node.bl_idname == PRINCIPLED and not is_constant(value_of(node.inputs["Alpha"]), 1.0):
        note(f"Alpha of {node.name!r} is cut, the surface is shaded opaque")


def _shaders(tree, socket, seen: set):
    """Shader nodes behind an input that are neither mix nor sum nor group, each once; the tree stays as it is."""
    link = live_link(socket)
    if link is None:
        return
    node = link.from_node
    key = tree.as_pointer(), node.name
    if key in seen:
        return
    seen.add(key)
    if node.bl_idname in MIXES or node.bl_idname == "NodeReroute" or node.mute:
        for other in node.inputs:
            if other.type == "SHADER":
                yield from _shaders(tree, other, seen)
    elif is_group(node):
        end = group_output(node.node_tree) if node.node_tree is not None else None
        for other in end.inputs if end is not None else ():
            if other.type == "SHADER":
                yield from _shaders(node.node_tree, other, seen)
        for other in node.inputs:
            if other.type == "SHADER":
                yield from _shaders(tree, other, seen)
    elif node.bl_idname != "NodeGroupInput":
        yield node


@bpy.app.handlers.persistent
def _forget(*_):
    _known.clear()


def register():
    for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.load_post, bpy.app.handlers.undo_post):
        handlers.append(_forget)


def unregister():
    for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.load_post, bpy.app.handlers.undo_post):
        if _forget in handlers:
            handlers.remove(_forget)
    _known.clear()
