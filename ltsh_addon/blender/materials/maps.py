"""What varies over a material: images that are looked up, and maps that a bake of its emission writes (in the child).

A color or normal takes a map of its own, three numbers share one.
"""

from __future__ import annotations

from dataclasses import asdict, replace

from ...cycles.lobes import LOBE_AOVS
from .graph import carry_out_of_group, cut, is_socket, live_link, material_output
from .values import SavedImages, plain_texture


class MaterialPlan:
    """The maps of one material and the nodes that show them in its place.

    `lobes` are dictionaries of `bsdfs.lobe_values` and `paths` the groups (see `graph.Source`) that lead to each;
    textures at one of the UV maps `uv_names` are saved as `images`, where these are not None, and need no map.
    """

    def __init__(self, material, lobes: tuple[dict, ...], paths: tuple, images: SavedImages | None, uv_names=()):
        self.material, self.tree = material, material.node_tree
        self.textures: list[dict] = []  # as `cycles.texels.BakeMaterial` reads them
        self._images, self._uv_names = images, {"", *uv_names}
        # Of each map its sockets in the tree of the material: one color, or up to three numbers.
        self._maps: list[list] = []
        self._colors: set[int] = set()  # maps of one color
        self._numbers: int | None = None  # the map that takes further numbers
        self.lobes = tuple(
            {name: self._recorded(name, value, groups) for name, value in lobe.items()}
            for lobe, groups in zip(lobes, paths, strict=True)
        )
        self._output, self._surface, self._emissions, self._image_node = None, None, [], None

    @property
    def count(self) -> int:
        """Number of maps."""
        return len(self._maps)

    def record(self) -> dict:
        """What `cycles.texels.BakeMaterial.of` reads."""
        corrected = bool(self.material.cycles.use_bump_map_correction)
        return {"corrected": corrected, "lobes": list(self.lobes), "textures": self.textures}

    def _recorded(self, name, value, groups):
        if not is_socket(value):
            return list(value[:3]) if isinstance(value, tuple) else value
        texture = self._looked_up(name, value, groups) if self._images is not None else None
        if texture is not None:
            return texture
        socket = value
        for _, group in reversed(groups):
            socket = carry_out_of_group(group, socket)
        if LOBE_AOVS[name][0] == "COLOR":
            self._colors.add(len(self._maps))
            self._maps.append([socket])
            return {"map": len(self._maps) - 1}
        if self._numbers is None or len(self._maps[self._numbers]) == 3:
            self._maps.append([])
            self._numbers = len(self._maps) - 1
        self._maps[self._numbers].append(socket)
        return {"map": self._numbers, "channel": len(self._maps[self._numbers]) - 1}

    def _looked_up(self, name, socket, groups):
        """The record of a socket behind which is nothing but an image, or None."""
        found = plain_texture(socket.id_data, socket, groups)
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
