"""Nodes that write the quantities of `aovs` into shader outputs (AOVs), and the passes for them (runs in the child)."""

from __future__ import annotations

import bpy

from .aovs import AOV_PREFIX, HIT_AOVS, LOBE_AOVS, aov_kind, lobe_aov
from .shader_graph import is_socket


def write_aov(tree, name: str, value) -> None:
    """A node in `tree` that writes `value`, a socket of it, a number or a color, into the AOV `name`."""
    node = tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = AOV_PREFIX + name
    target = node.inputs["Color" if aov_kind(name) == "COLOR" else "Value"]
    if is_socket(value):
        tree.links.new(value, target)
    elif isinstance(value, tuple):
        target.default_value = (*value[:3], 1.0)
    else:
        target.default_value = float(value)


def write_lobe(tree, slot: int, values: dict, names) -> None:
    """Write the AOVs `names` of one lobe: of `values` (see `bsdf_lobes.lobe_of`), or what changes nothing."""
    for name in names:
        neutral = LOBE_AOVS[name][1]
        write_aov(tree, lobe_aov(name, slot), values.get(name, 0.0 if neutral is None else neutral))


def declare_aovs(view_layer) -> None:
    """Add a pass to `view_layer` for every AOV that some material writes, and all that belong to a hit."""
    trees = [material.node_tree for material in bpy.data.materials if material.node_tree] + list(bpy.data.node_groups)
    written = {
        node.aov_name.removeprefix(AOV_PREFIX)
        for tree in trees
        if tree.bl_idname == "ShaderNodeTree"
        for node in tree.nodes
        if node.bl_idname == "ShaderNodeOutputAOV" and node.aov_name.startswith(AOV_PREFIX)
    }
    for name in sorted(written | set(HIT_AOVS)):
        aov = view_layer.aovs.add()
        aov.name, aov.type = AOV_PREFIX + name, aov_kind(name)


def remove_aovs(view_layer) -> None:
    """Take the passes of `declare_aovs` out again."""
    for aov in [aov for aov in view_layer.aovs if aov.name.startswith(AOV_PREFIX)]:
        view_layer.aovs.remove(aov)
