"""A material's shader as a weighted sum of BSDF nodes: mixes, sums and groups taken apart (runs in the child).

Groups on the way are made single-user: their copies receive outputs that other users must not. Transparency is cut,
so that every ray meets one surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from .shader_graph import (
    bypass,
    carry_into_group,
    carry_out_of_group,
    cut,
    group_output,
    is_socket,
    live_link,
    mix_weights,
    passed_through,
    product,
    socket_named,
    total,
)

TRANSPARENT_NODES = ("ShaderNodeBsdfTransparent", "ShaderNodeHoldout")
GROUP_NODES = ("ShaderNodeGroup", "ShaderNodeCustomGroup")


@dataclass(frozen=True)
class Leaf:
    """A shader node that is neither mix nor sum, and its share in the material."""

    tree: Any  # the node tree it lives in
    node: Any
    weight: Any  # a float, or a socket of `tree`
    bound: float  # no weight is larger, as far as constants tell


def bsdf_leaves(tree, surface, warn: Callable[[str], None]) -> list[Leaf]:
    """The leaves behind the input `surface` of a material's `tree`, in the order in which they are linked."""
    walk = _Walk(warn)
    walk.follow(tree, surface, 1.0, 1.0)
    return list(walk.leaves.values())


def is_group(node) -> bool:
    """True for nodes that hold a node tree, or could."""
    return node.bl_idname in GROUP_NODES or hasattr(node, "node_tree")


class _Walk:
    """From a shader input backwards to the leaves."""

    def __init__(self, warn):
        self.warn = warn
        self.levels: list = []  # (tree, group node) from the material inwards
        self.leaves: dict = {}
        self.copied: set = set()  # group nodes whose trees have been made single-user

    def follow(self, tree, socket, weight, bound) -> None:
        link = live_link(socket)
        if link is None or (not is_socket(weight) and weight == 0.0):
            return
        node, output = link.from_node, link.from_socket
        if node.mute:
            inner = passed_through(node, output)
            if inner is not None:
                self.follow(tree, inner, weight, bound)
        elif node.bl_idname == "NodeReroute":
            self.follow(tree, node.inputs[0], weight, bound)
        elif is_group(node):
            self._into_group(tree, node, output, weight, bound)
        elif node.bl_idname == "NodeGroupInput":
            self._out_of_group(output, weight, bound)
        elif node.bl_idname == "ShaderNodeMixShader":
            self._mix(tree, node, weight, bound)
        elif node.bl_idname == "ShaderNodeAddShader":
            self._sum(tree, node, weight, bound)
        else:
            self._add(tree, node, weight, bound)

    def _add(self, tree, node, weight, bound):
        key = (tree.as_pointer(), node.name)
        known = self.leaves.get(key)
        if known is None:
            self.leaves[key] = Leaf(tree, node, weight, bound)
        else:
            summed = total(tree, known.weight, weight)
            self.leaves[key] = replace(known, weight=summed, bound=known.bound + bound)

    def _into_group(self, tree, node, output, weight, bound):
        if node.node_tree is None:
            return
        key = (tree.as_pointer(), node.name)
        if key not in self.copied:
            node.node_tree = node.node_tree.copy()
            self.copied.add(key)
        end = group_output(node.node_tree)
        socket = socket_named(end.inputs, output.identifier) if end is not None else None
        if socket is None:
            return
        inner = carry_into_group(tree, node, weight)
        self.levels.append((tree, node))
        self.follow(node.node_tree, socket, inner, bound)
        self.levels.pop()

    def _out_of_group(self, output, weight, bound):
        if not self.levels:
            return
        tree, node = self.levels.pop()
        socket = socket_named(node.inputs, output.identifier)
        if socket is not None and live_link(socket) is not None:
            self.follow(tree, socket, carry_out_of_group(node, weight), bound)
        self.levels.append((tree, node))

    def _mix(self, tree, node, weight, bound):
        branches = node.inputs[1], node.inputs[2]
        transparent = [self._is_transparent(tree, socket, list(self.levels)) for socket in branches]
        mixed = live_link(node.inputs[0]) is not None or 0.0 < node.inputs[0].default_value < 1.0
        for index in (0, 1):
            other = branches[1 - index]
            if mixed and transparent[index] and not transparent[1 - index] and live_link(other) is not None:
                self.warn(f"transparency of node {node.name!r} is cut, the surface is shaded and rendered opaque")
                bypass(tree, node, live_link(other).from_socket)
                self.follow(tree, other, weight, bound)
                return
        shares = mix_weights(tree, node.inputs[0])
        for socket, share in zip(branches, shares, strict=True):
            self.follow(tree, socket, product(tree, weight, share), bound if is_socket(share) else bound * share)

    def _sum(self, tree, node, weight, bound):
        transparent = [self._is_transparent(tree, socket, list(self.levels)) for socket in node.inputs]
        for socket, clear in zip(node.inputs, transparent, strict=True):
            if clear and not all(transparent):
                self.warn(f"transparency of node {node.name!r} is cut, the surface is shaded and rendered opaque")
                cut(tree, socket)
            else:
                self.follow(tree, socket, weight, bound)

    def _is_transparent(self, tree, socket, levels) -> bool:
        """True where nothing but transparency is behind `socket`; changes nothing."""
        link = live_link(socket)
        if link is None:
            return False
        node, output = link.from_node, link.from_socket
        if node.mute:
            inner = passed_through(node, output)
            return inner is not None and self._is_transparent(tree, inner, levels)
        if is_group(node):
            end = group_output(node.node_tree) if node.node_tree is not None else None
            inner = socket_named(end.inputs, output.identifier) if end is not None else None
            return inner is not None and self._is_transparent(node.node_tree, inner, [*levels, (tree, node)])
        if node.bl_idname == "NodeGroupInput":
            if not levels:
                return False
            outer = socket_named(levels[-1][1].inputs, output.identifier)
            return outer is not None and self._is_transparent(levels[-1][0], outer, levels[:-1])
        if node.bl_idname == "NodeReroute":
            return self._is_transparent(tree, node.inputs[0], levels)
        if node.bl_idname in ("ShaderNodeMixShader", "ShaderNodeAddShader"):
            shaders = [socket for socket in node.inputs if socket.type == "SHADER"]
            return all(self._is_transparent(tree, socket, levels) for socket in shaders)
        return node.bl_idname in TRANSPARENT_NODES
