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
    if link is None:
        return Source(tree, socket, None, groups)
    node, output = link.from_node, link.from_socket
    if node.mute:
        inner = passed_through(node, output)
        return None if inner is None else source_of(tree, inner, groups)
    if node.bl_idname == "NodeReroute":
        return source_of(tree, node.inputs[0], groups)
    if node.bl_idname == "ShaderNodeGroup":
        end = group_output(node.node_tree) if node.node_tree is not None else None
        inner = socket_named(end.inputs, output.identifier) if end is not None else None
        return None if inner is None else source_of(node.node_tree, inner, (*groups, (tree, node)))
    if node.bl_idname == "NodeGroupInput":
        if not groups:
            return None
        outer, group = groups[-1]
        entry = socket_named(group.inputs, output.identifier)
        return None if entry is None else source_of(outer, entry, groups[:-1])
    return Source(tree, output, node, groups)
