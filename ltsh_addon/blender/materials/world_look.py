"""The world as a constant background; nothing is edited."""

from __future__ import annotations

import bpy
import numpy as np

from .node_sources import source_of
from .node_values import value_at
from .shader_graph import material_output


def world_radiance(world) -> tuple[np.ndarray, bool]:
    """Radiance (3,) of the background, and whether that is all that there is to it.

    Where the world's nodes are more than one Background node of constants its viewport color stands in.
    """
    if world is None:
        return np.zeros(3), True
    tree = world.node_tree if bpy.app.version >= (5, 0, 0) or world.use_nodes else None
    if tree is None:
        return np.array(world.color, np.float64), True
    output = material_output(tree)
    source = source_of(tree, output.inputs["Surface"]) if output is not None else None
    if source is None or source.node is None:
        return np.zeros(3), True
    if source.node.bl_idname == "ShaderNodeBackground":
        parts = [value_at(source.tree, source.node.inputs[name], source.groups) for name in ("Color", "Strength")]
        if all(part is not None and part.is_constant for part in parts):
            return parts[0].offset * parts[1].offset, True
    return np.array(world.color, np.float64), False
