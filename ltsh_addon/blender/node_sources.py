"""What feeds an input of a node, past reroutes, muted nodes and groups; nothing is edited."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .shader_graph import live_link, traced


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
    found = traced(tree, link.from_socket, groups)
    if found is None:
        return None
    tree, node, socket, groups = found
    return Source(tree, socket, node, groups)
