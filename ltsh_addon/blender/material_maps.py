"""What varies over a material, as maps that a bake of its emission writes (runs in the child).

A color or normal takes a map of its own, three numbers share one.
"""

from __future__ import annotations

import bpy

from .aovs import LOBE_AOVS
from .shader_graph import cut, group_output, is_socket, live_link, material_output, socket_named

GROUP_SOCKET_NAME = "ltsh map"


class MaterialPlan:
    """The maps of one material and the nodes that show them in its place.

    `lobes` are dictionaries of `bsdf_lobes.lobe_of` and `trees` the node trees of their sockets.
    """

    def __init__(self, material, lobes: tuple[dict, ...], trees: tuple):
        self.material, self.tree = material, material.node_tree
        # Of each map its sockets in the tree of the material: one color, or up to three numbers.
        self._maps: list[list] = []
        self._numbers: int | None = None  # the map that takes further numbers
        self.lobes = tuple(
            {name: self._recorded(name, value, tree) for name, value in lobe.items()}
            for lobe, tree in zip(lobes, trees, strict=True)
        )
        self._output, self._surface, self._emissions, self._image_node = None, None, [], None

    @property
    def count(self) -> int:
        """Number of maps."""
        return len(self._maps)

    def record(self) -> dict:
        """What `texel_samples.BakeMaterial.of` reads."""
        return {"corrected": bool(self.material.cycles.use_bump_map_correction), "lobes": list(self.lobes)}

    def _recorded(self, name, value, tree):
        if not is_socket(value):
            return list(value[:3]) if isinstance(value, tuple) else value
        socket = carried_out(self.tree, tree, value)
        if LOBE_AOVS[name][0] == "COLOR":
            self._maps.append([socket])
            return {"map": len(self._maps) - 1}
        if self._numbers is None or len(self._maps[self._numbers]) == 3:
            self._maps.append([])
            self._numbers = len(self._maps) - 1
        self._maps[self._numbers].append(socket)
        return {"map": self._numbers, "channel": len(self._maps[self._numbers]) - 1}

    def prepare(self) -> None:
        """Add the nodes."""
        self._output = material_output(self.tree)
        if self._output is None:
            self._output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        link = live_link(self._output.inputs["Surface"])
        self._surface = link.from_socket if link else None
        self._emissions = [self._emission(sockets) for sockets in self._maps]
        self._image_node = self.tree.nodes.new("ShaderNodeTexImage")

    def _emission(self, sockets):
        emission = self.tree.nodes.new("ShaderNodeEmission")
        if sockets[0].type in ("RGBA", "VECTOR"):
            self.tree.links.new(sockets[0], emission.inputs["Color"])
            return emission
        combined = self.tree.nodes.new("ShaderNodeCombineXYZ")
        for socket, target in zip(sockets, combined.inputs, strict=False):
            self.tree.links.new(socket, target)
        self.tree.links.new(combined.outputs[0], emission.inputs["Color"])
        return emission

    def show(self, number: int | None) -> None:
        """Make the material emit map `number` (black where there is none), or look as it does (None)."""
        surface = self._output.inputs["Surface"]
        cut(self.tree, surface)
        if number is None:
            if self._surface is not None:
                self.tree.links.new(self._surface, surface)
        elif number < len(self._emissions):
            self.tree.links.new(self._emissions[number].outputs[0], surface)

    def target(self, image) -> None:
        """Bake into `image`."""
        self._image_node.image = image
        self.tree.nodes.active = self._image_node

    def remove(self) -> None:
        """Take the nodes out again."""
        self.show(None)
        self.tree.nodes.remove(self._image_node)
        for emission in self._emissions:
            self.tree.nodes.remove(emission)


def carried_out(material_tree, tree, socket):
    """The value of `socket`, which lives in `tree`, in the tree of the material, past the groups in between."""
    while tree != material_tree:
        outer, group = _user_of(material_tree, tree)
        item = tree.interface.new_socket(GROUP_SOCKET_NAME, in_out="OUTPUT", socket_type=_socket_type(socket))
        tree.links.new(socket, socket_named(group_output(tree).inputs, item.identifier))
        tree, socket = outer, socket_named(group.outputs, item.identifier)
    return socket


def _socket_type(socket) -> str:
    return {"RGBA": "NodeSocketColor", "VECTOR": "NodeSocketVector"}.get(socket.type, "NodeSocketFloat")


def _user_of(tree, inner):
    """(tree, group node) that holds the node tree `inner`, which has one user, within `tree`."""
    for node in tree.nodes:
        held = getattr(node, "node_tree", None)
        if held == inner:
            return tree, node
        if isinstance(held, bpy.types.NodeTree):
            found = _user_of(held, inner)
            if found is not None:
                return found
    return None
