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
from ..materials.aovs import notes_of_material
from ..materials.bsdfs import bsdf_of, is_emission
from ..materials.graph import shaders_behind, surface_of
from .preflight import glows, materials_of

EXACT, APPROXIMATED, LEFT_OUT = "exact", "approximated", "left out"


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
    if unseen is not None and unseen.varies and ob.data.type == "AREA":
        notes.append("its emission varies, shaded as patches of constant radiance")
    return Entry(ob.name, kind, APPROXIMATED if notes else EXACT, tuple(notes))


def _material(material) -> Entry:
    surface = surface_of(material)
    if surface is None:
        return Entry(material.name, "", EXACT)
    shaders = shaders_behind(surface)
    # Whether it lights the scene is the kind of a material and no defect.
    notes = tuple(dict.fromkeys(notes_of_material(surface.node, shaders, emitter=True)))
    shown = [bsdf_of(leaf.node) or is_emission(leaf.node) or leaf.is_transparent for leaf in shaders.leaves]
    state = LEFT_OUT if shown and not any(shown) else APPROXIMATED if notes else EXACT
    return Entry(material.name, "emissive" if glows(material) else "", state, notes)


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
