"""The walk over node trees: sources behind sockets, through groups, reroutes and muted nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy

GROUP_SOCKET_NAME = "ltsh weight"


def live_link(socket):
    """The link that feeds the input `socket`, or None."""
    for link in socket.links:
        if not link.is_muted and link.is_valid:
            return link
    return None


def value_of(socket):
    """The socket that feeds the input `socket`, or its own value: a number or a tuple."""
    link = live_link(socket)
    if link is not None:
        return link.from_socket
    value = socket.default_value
    return tuple(value) if hasattr(value, "__len__") else float(value)


def is_socket(value) -> bool:
    """True for what nodes compute, False for constants."""
    return isinstance(value, bpy.types.NodeSocket)


def is_constant(value, expected) -> bool:
    """True where `value` (of `value_of`) is the constant `expected`, a number or the first components of a tuple."""
    if is_socket(value):
        return False
    found = value if isinstance(value, tuple) else (value,)
    wanted = expected if isinstance(expected, tuple) else (expected,)
    return all(abs(a - b) < 1e-6 for a, b in zip(found, wanted, strict=False))


def material_output(tree):
    """The Material Output that Cycles uses, or None."""
    return tree.get_output_node("CYCLES") or tree.get_output_node("ALL")


def group_output(tree):
    """The Group Output in use of a group's `tree`, or None."""
    for node in tree.nodes:
        if node.bl_idname == "NodeGroupOutput" and node.is_active_output:
            return node
    return None


def socket_named(sockets, identifier: str):
    """The socket with `identifier`, or None."""
    return next((socket for socket in sockets if socket.identifier == identifier), None)


def passed_through(node, output):
    """The input socket that a muted `node` hands on to its `output`, or None."""
    return next((link.from_socket for link in node.internal_links if link.to_socket == output), None)


def bypass(tree, node, source) -> None:
    """Feed everything that `node` feeds from the socket `source` instead."""
    for target in [link.to_socket for link in node.outputs[0].links]:
        tree.links.new(source, target)


def cut(tree, socket) -> None:
    """Take away what feeds the input `socket`."""
    for link in list(socket.links):
        tree.links.remove(link)


def _math(tree, operation: str, first, second, clamp: bool = False):
    node = tree.nodes.new("ShaderNodeMath")
    node.operation, node.use_clamp = operation, clamp
    for value, socket in zip((first, second), node.inputs, strict=False):
        if is_socket(value):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return node.outputs[0]


def product(tree, first, second):
    """first * second."""
    if not is_socket(first) and not is_socket(second):
        return first * second
    for constant, other in ((first, second), (second, first)):
        if not is_socket(constant) and constant in (0.0, 1.0):
            return other if constant else 0.0
    return _math(tree, "MULTIPLY", first, second)


def total(tree, first, second):
    """first + second."""
    if not is_socket(first) and not is_socket(second):
        return first + second
    return _math(tree, "ADD", first, second)


def mix_weights(tree, factor):
    """Weights of both inputs of a Mix Shader node whose factor socket is `factor`; Cycles clamps the factor."""
    value = value_of(factor)
    if not is_socket(value):
        value = min(max(value, 0.0), 1.0)
        return 1.0 - value, value
    clamped = _math(tree, "ADD", value, 0.0, clamp=True)
    return _math(tree, "SUBTRACT", 1.0, clamped), clamped


def carry_into_group(tree, group, value):
    """The same number inside the node `group` of `tree`, whose node tree has no other user."""
    if not is_socket(value):
        return value
    inner = group.node_tree
    item = inner.interface.new_socket(GROUP_SOCKET_NAME, in_out="INPUT", socket_type="NodeSocketFloat")
    tree.links.new(value, socket_named(group.inputs, item.identifier))
    return socket_named(inner.nodes.new("NodeGroupInput").outputs, item.identifier)


def carry_out_of_group(group, value):
    """The same number outside the node `group`, computed in its node tree, which has no other user."""
    if not is_socket(value):
        return value
    inner = group.node_tree
    item = inner.interface.new_socket(GROUP_SOCKET_NAME, in_out="OUTPUT", socket_type="NodeSocketFloat")
    inner.links.new(value, socket_named(group_output(inner).inputs, item.identifier))
    return socket_named(group.outputs, item.identifier)


def ensure_nodes(material) -> None:
    """Give a material without nodes (possible up to 4.5) the tree that Cycles renders in its place."""
    if bpy.app.version >= (5, 0, 0) or (material.use_nodes and material.node_tree):
        return
    color = tuple(material.diffuse_color)
    material.use_nodes = True
    fill_with_bsdf(material.node_tree, "ShaderNodeBsdfDiffuse", color)


def fill_with_bsdf(tree, node_type: str, color) -> None:
    """Replace all nodes of `tree` by one BSDF of `color` (4 numbers)."""
    tree.nodes.clear()
    bsdf = tree.nodes.new(node_type)
    bsdf.inputs[0].default_value = color
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(bsdf.outputs[0], output.inputs["Surface"])


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
