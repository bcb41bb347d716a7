"""What varies over a material: images that are looked up, and maps that a bake of its emission writes (in the child).

A color or normal takes a map of its own, three numbers share one.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import bpy

from ...cycles.lobes import LOBE_AOVS
from .graph import cut, group_output, is_socket, live_link, material_output, socket_named
from .values import SavedImages, plain_texture

GROUP_SOCKET_NAME = "ltsh map"


class MaterialPlan:
    """The maps of one material and the nodes that show them in its place.

    `lobes` are dictionaries of `bsdf_lobes.lobe_of` and `trees` the node trees of their sockets; textures at one of the
    UV maps `uv_names` are saved as `images`, where these are not None, and need no map.
    """

    def __init__(self, material, lobes: tuple[dict, ...], trees: tuple, images: SavedImages | None, uv_names=()):
        self.material, self.tree = material, material.node_tree
        self.textures: list[dict] = []  # as `texel_samples.BakeMaterial` reads them
        self._images, self._uv_names = images, {"", *uv_names}
        # Of each map its sockets in the tree of the material: one color, or up to three numbers.
        self._maps: list[list] = []
        self._colors: set[int] = set()  # maps of one color
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
        corrected = bool(self.material.cycles.use_bump_map_correction)
        return {"corrected": corrected, "lobes": list(self.lobes), "textures": self.textures}

    def _recorded(self, name, value, tree):
        if not is_socket(value):
            return list(value[:3]) if isinstance(value, tuple) else value
        texture = self._looked_up(name, value, tree) if self._images is not None else None
        if texture is not None:
            return texture
        socket = carried_out(self.tree, tree, value)
        if LOBE_AOVS[name][0] == "COLOR":
            self._colors.add(len(self._maps))
            self._maps.append([socket])
            return {"map": len(self._maps) - 1}
        if self._numbers is None or len(self._maps[self._numbers]) == 3:
            self._maps.append([])
            self._numbers = len(self._maps) - 1
        self._maps[self._numbers].append(socket)
        return {"map": self._numbers, "channel": len(self._maps[self._numbers]) - 1}

    def _looked_up(self, name, socket, tree):
        """The record of a socket behind which is nothing but an image, or None."""
        found = plain_texture(tree, socket, _path_to(self.tree, tree))
        if found is None or found.uv not in self._uv_names:
            return None
        is_color = LOBE_AOVS[name][0] == "COLOR"
        if is_color != (found.part == "color"):
            if is_color:
                return None
            found = replace(found, part="gray")
        file = self._images.file_of(found.image)
        if file is None:
            return None
        record = {"file": file, **asdict(found)}
        part = record.pop("part")
        del record["image"]
        if record not in self.textures:
            self.textures.append(record)
        return {"texture": self.textures.index(record), "part": part}

    def prepare(self) -> None:
        """Add the nodes."""
        self._output = material_output(self.tree)
        if self._output is None:
            self._output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        link = live_link(self._output.inputs["Surface"])
        self._surface = link.from_socket if link else None
        self._emissions = [self._emission(number) for number in range(self.count)]
        self._image_node = self.tree.nodes.new("ShaderNodeTexImage")

    def _emission(self, number):
        emission, sockets = self.tree.nodes.new("ShaderNodeEmission"), self._maps[number]
        if number in self._colors:
            self.tree.links.new(sockets[0], emission.inputs["Color"])
            return emission
        # A number may come from a color or vector socket: linking to another number converts it as the shader would.
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
        inner = _led_to(tree, socket)
        if inner is None:
            item = tree.interface.new_socket(GROUP_SOCKET_NAME, in_out="OUTPUT", socket_type=_socket_type(socket))
            inner = socket_named(group_output(tree).inputs, item.identifier)
            tree.links.new(socket, inner)
        tree, socket = outer, socket_named(group.outputs, inner.identifier)
    return socket


def _led_to(tree, socket):
    """The input of the group's output that an earlier plan has led `socket` to, or None."""
    for inner in group_output(tree).inputs:
        if inner.name == GROUP_SOCKET_NAME and any(link.from_socket == socket for link in inner.links):
            return inner
    return None


def _path_to(material_tree, tree) -> tuple:
    """(tree, group node) pairs from the tree of a material inwards to `tree`."""
    path = ()
    while tree != material_tree:
        outer, group = _user_of(material_tree, tree)
        path, tree = ((outer, group), *path), outer
    return path


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
