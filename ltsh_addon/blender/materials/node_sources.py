"""What feeds an input of a node, past reroutes, muted nodes and groups; nothing is edited."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .shader_graph import group_output, live_link, passed_through, socket_named


@dataclass(frozen=True)
class Source:
    """An output of a node, or an unlinked input (`node` None) whose own value counts."""

    tree: Any
    socket: Any
    node: Any
    groups: tuple  # (tree, group node) pairs that lead to `tree`

    def input(self, name) -> Source | None:
        """What feeds the input `name` (or position) of the node."""
        return source_of(self.tree, self.node.inputs[name], self.groups)


def source_of(tree, socket, groups: tuple = ()) -> Source | None:
    """What feeds the input `socket` of `tree`; None where a group has no inside or no outside."""
    link = live_link(socket)
    return Source(tree, socket, None, groups) if link is None else source_behind(tree, link.from_socket, groups)


def source_behind(tree, output, groups: tuple = ()) -> Source | None:
    """What the `output` of a node in `tree` really comes from; None as in `source_of`."""
    node, entry = output.node, None
    if node.mute:
        entry = passed_through(node, output)
    elif node.bl_idname == "NodeReroute":
        entry = node.inputs[0]
    elif node.bl_idname == "ShaderNodeGroup":
        end = group_output(node.node_tree) if node.node_tree is not None else None
        if end is not None:
            entry = socket_named(end.inputs, output.identifier)
            tree, groups = node.node_tree, (*groups, (tree, node))
    elif node.bl_idname == "NodeGroupInput":
        if groups:
            (tree, group), groups = groups[-1], groups[:-1]
            entry = socket_named(group.inputs, output.identifier)
    else:
        return Source(tree, output, node, groups)
    return None if entry is None else source_of(tree, entry, groups)
