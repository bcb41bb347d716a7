"""Finding the BSDF that a material shows, through groups, reroutes, muted nodes and mixes (runs in the child).

The node trees are those of the file as opened in the child, so they are edited freely: groups on the way are made
single-user (their copies receive outputs that other users must not), transparency is cut.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy

TRANSPARENT_NODES = ("ShaderNodeBsdfTransparent", "ShaderNodeHoldout")
PREFERRED_NODES = ("ShaderNodeBsdfPrincipled", "ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfDiffuse")


def live_link(socket):
    """The link that feeds the input `socket`, or None."""
    for link in socket.links:
        if not link.is_muted and link.is_valid:
            return link
    return None


def material_output(tree):
    """The Material Output that Cycles uses, or None."""
    return tree.get_output_node("CYCLES") or tree.get_output_node("ALL")


class BsdfSearch:
    """Walks from a material's Surface input to one BSDF; `warn` receives what had to be cut or ignored."""

    def __init__(self, warn: Callable[[str], None]):
        self.warn = warn
        self.groups: list = []  # (tree, group node) from the material inwards

    def find(self, tree, socket):
        """(tree, node) of the BSDF behind the input `socket` of `tree`, or None if nothing is linked."""
        link = live_link(socket)
        if link is None:
            return None
        node, output = link.from_node, link.from_socket
        if node.mute:
            inner = [passed.from_socket for passed in node.internal_links if passed.to_socket == output]
            return self.find(tree, inner[0]) if inner else None
        if node.bl_idname == "NodeReroute":
            return self.find(tree, node.inputs[0])
        if node.bl_idname == "ShaderNodeGroup":
            return self._find_in_group(tree, node, output)
        if node.bl_idname == "NodeGroupInput":
            return self._find_outside_group(output)
        if node.bl_idname == "ShaderNodeMixShader":
            return self._find_in_mix(tree, node)
        if node.bl_idname == "ShaderNodeAddShader":
            return self._find_in_sum(tree, node)
        return tree, node

    def _find_in_group(self, tree, node, output):
        if node.node_tree is None:
            return None
        node.node_tree = node.node_tree.copy()
        outputs = [
            inner for inner in node.node_tree.nodes if inner.bl_idname == "NodeGroupOutput" and inner.is_active_output
        ]
        sockets = [socket for inner in outputs for socket in inner.inputs if socket.identifier == output.identifier]
        if not sockets:
            return None
        self.groups.append((tree, node))
        found = self.find(node.node_tree, sockets[0])
        # A shader that came in through Group Input has emptied the stack further on purpose.
        if self.groups and self.groups[-1][1] == node:
            self.groups.pop()
        return found

    def _find_outside_group(self, output):
        if not self.groups:
            return None
        tree, node = self.groups.pop()
        sockets = [socket for socket in node.inputs if socket.identifier == output.identifier]
        return self.find(tree, sockets[0]) if sockets else None

    def _find_in_mix(self, tree, node):
        factor, branches = node.inputs[0], [node.inputs[1], node.inputs[2]]
        kinds = [self._peek(socket) for socket in branches]
        for index, kind in enumerate(kinds):
            other = live_link(branches[1 - index])
            if kind in TRANSPARENT_NODES and kinds[1 - index] not in TRANSPARENT_NODES and other is not None:
                self.warn(f"transparency of node {node.name!r} is cut, the surface is shaded and rendered opaque")
                _bypass(tree, node, other.from_socket)
                return self.find(tree, branches[1 - index])
        if live_link(factor) is None and factor.default_value in (0.0, 1.0):
            return self.find(tree, branches[int(factor.default_value)])
        # The larger share first; a supported BSDF before any other.
        order = [1, 0] if live_link(factor) is None and factor.default_value > 0.5 else [0, 1]
        order.sort(key=lambda index: kinds[index] not in PREFERRED_NODES)
        return self._choose(tree, node, [branches[index] for index in order])

    def _find_in_sum(self, tree, node):
        branches = [socket for socket in node.inputs if live_link(socket) is not None]
        lit = [socket for socket in branches if self._peek(socket) != "ShaderNodeEmission"]
        if len(lit) < len(branches) and lit:
            self.warn(f"emission in node {node.name!r} is not shaded")
        lit.sort(key=lambda socket: self._peek(socket) not in PREFERRED_NODES)
        if len(lit) == 1:
            return self.find(tree, lit[0])
        return self._choose(tree, node, lit or branches)

    def _choose(self, tree, node, branches):
        for socket in branches:
            found = self.find(tree, socket)
            if found is not None:
                self.warn(f"node {node.name!r} combines several BSDFs, only the lobe of {found[1].name!r} is shaded")
                return found
        return None

    def _peek(self, socket) -> str:
        """Type of the node behind `socket`, past reroutes; "" when unlinked."""
        link = live_link(socket)
        while link is not None and link.from_node.bl_idname == "NodeReroute":
            link = live_link(link.from_node.inputs[0])
        return link.from_node.bl_idname if link else ""


def _bypass(tree, node, source) -> None:
    """Feed everything that `node` feeds from `source` instead."""
    for target in [link.to_socket for link in node.outputs[0].links]:
        tree.links.new(source, target)


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
