"""The varying values of a material: images that are read directly, and maps that Cycles bakes (in the child).

For a bake the material emits the values of a map. A color or normal takes a map of its own; three numbers share one.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

from ...cycles.lobes import LOBE_AOVS
from ...cycles.texels import EXTENSIONS, INTERPOLATIONS, MapValue, TextureFile, TextureValue
from ...files import save_array
from ...lobes.brdf import dielectric_reflectance
from ...visibility.occluders import Transparency
from ..render_settings import working_space
from .graph import carry_out_of_group, computed, cut, is_socket, live_link, material_output, source_behind, value_of
from .values import has_plain_mapping, is_srgb, opaque_pixels

# UV_MAP: number of the map that shows the coordinates of the UV map being baked.
UV_MAP = -1
# SAME_SPACE: the working space is Rec.709 if its matrix to Rec.709 differs less from the identity.
SAME_SPACE = 1e-4


class SavedImages:
    """Images saved as .npy files in a folder, each once, with row 0 at the bottom."""

    def __init__(self, folder: Path):
        self.folder, self._names = folder, {}

    def file_of(self, image) -> str | None:
        """File name of the pixels (H, W, 3) of `image`, uint8 or float32; None if the image is not opaque."""
        if image.name_full not in self._names:
            self._names[image.name_full] = self._save(image)
        return self._names[image.name_full]

    def _save(self, image):
        colors = opaque_pixels(image)
        if colors is None:
            return None
        name = f"image_{len(self._names)}.npy"
        save_array(self.folder / name, colors if image.is_float else np.rint(255.0 * colors).astype(np.uint8))
        return name


def plain_texture(output, groups, kind: str) -> tuple[bpy.types.Image, TextureFile, str] | None:
    """The image, how it is read, and its component if the `output` of a node shows a texture unchanged, else None.

    `groups` are those around the node (see `graph.Source`), `kind` is the type of the socket that shows it. The
    component is "color", or the number of a channel.
    """
    source, component = source_behind(output, groups), "color"
    if source is not None and not source.arrives_whole(kind):
        return None
    if _is_node(source, "ShaderNodeSeparateColor") and source.node.mode == "RGB":
        component = str(list(source.node.outputs).index(source.socket))
        source = source.input(0)
        if source is not None and not source.arrives_whole("RGBA"):
            return None
    if not _is_node(source, "ShaderNodeTexImage") or source.socket.name != "Color" or source.node.image is None:
        return None
    node = source.node
    uv, srgb = _uv_map(source), _known_encoding(node.image)
    if uv is None or srgb is None or not _is_plain(node):
        return None
    return node.image, TextureFile(uv, node.extension, node.interpolation, srgb), component


def _is_node(source, kind: str) -> bool:
    return source is not None and source.node is not None and source.node.bl_idname == kind


def _uv_map(texture) -> str | None:
    """Name of the UV map at which an image texture is read, "" for the default one; None for other coordinates."""
    vector = texture.input("Vector")
    if vector is None or not vector.arrives_whole("VECTOR"):
        return None
    if vector.node is None:
        # The texture's own unlinked input means the default UV map; the unlinked input of a group is a constant.
        return "" if vector.socket == texture.node.inputs["Vector"] else None
    if getattr(vector.node, "from_instancer", False):
        return None
    if _is_node(vector, "ShaderNodeUVMap"):
        return vector.node.uv_map
    return "" if _is_node(vector, "ShaderNodeTexCoord") and vector.socket.name == "UV" else None


def _is_plain(node) -> bool:
    return (
        node.projection == "FLAT"
        and node.extension in EXTENSIONS
        and node.interpolation in INTERPOLATIONS
        and has_plain_mapping(node)
    )


def _known_encoding(image) -> bool | None:
    """Whether an image from a single file has sRGB values; None if that is unknown, or for other kinds of images."""
    scene = bpy.context.scene
    if image.source != "FILE" or (scene.render.use_simplify and scene.cycles.texture_limit_render != "OFF"):
        return None
    is_other_space = np.abs(np.array(working_space()["to_rec709"]) - np.eye(3)).max() > SAME_SPACE
    return None if is_other_space else is_srgb(image)


def _alphas_in_use(tree, paths):
    """Sockets of the material's `tree` with the linked alphas of images, in the tree and in the groups of `paths`.

    They must stay linked: Cycles reads other colors from an image if its alpha feeds nothing.
    """
    places = dict.fromkeys(groups[:depth] for groups in ((), *paths) for depth in range(len(groups) + 1))
    for path in places:
        for node in (path[-1].node_tree if path else tree).nodes:
            if node.bl_idname == "ShaderNodeTexImage" and node.outputs["Alpha"].is_linked:
                socket = node.outputs["Alpha"]
                for group in reversed(path):
                    socket = carry_out_of_group(group, socket)
                yield socket


class MaterialPlan:
    """The maps of one material, and the nodes that make the material emit them.

    `lobes` are dictionaries of `bsdfs.lobe_values`, and `paths` the groups around each (see `graph.Source`). Textures
    on the UV maps `uv_names` need no map: they are saved to `images`, unless that is None.
    """

    def __init__(self, material, lobes: tuple[dict, ...], paths: tuple, images: SavedImages | None, uv_names=()):
        self.material, self.tree = material, material.node_tree
        self.textures: list[TextureFile] = []
        self._images, self._uv_names = images, {"", *uv_names}
        # The sockets of each map in the tree of the material: one color, or up to three numbers.
        self._maps: list[list] = []
        self._colors: set[int] = set()  # numbers of the maps of one color
        self._numbers: int | None = None  # number of the map that takes the next number
        self.lobes = tuple(
            {name: self._recorded(name, value, groups) for name, value in lobe.items()}
            for lobe, groups in zip(lobes, paths, strict=True)
        )
        self._alphas = list(_alphas_in_use(self.tree, paths))
        self._output, self._surface, self._image_node, self._places = None, None, None, None
        self._emissions: dict[int, object] = {}  # number of a map -> the node that emits it

    @property
    def count(self) -> int:
        """Number of maps."""
        return len(self._maps)

    def record(self) -> dict:
        """The record of the material for `cycles.texels.BakeMaterial.of`."""
        corrected = bool(self.material.cycles.use_bump_map_correction)
        lobes = [
            {name: vars(value) if isinstance(value, MapValue | TextureValue) else value for name, value in lobe.items()}
            for lobe in self.lobes
        ]
        return {"corrected": corrected, "lobes": lobes, "textures": [vars(texture) for texture in self.textures]}

    def _recorded(self, name, value, groups):
        if not is_socket(value):
            return list(value[:3]) if isinstance(value, tuple) else value
        texture = self._looked_up(name, value, groups) if self._images is not None else None
        if texture is not None:
            return texture
        socket = value
        for group in reversed(groups):
            socket = carry_out_of_group(group, socket)
        if LOBE_AOVS[name][0] == "COLOR":
            self._colors.add(len(self._maps))
            self._maps.append([socket])
            return MapValue(len(self._maps) - 1)
        if self._numbers is None or len(self._maps[self._numbers]) == 3:
            self._maps.append([])
            self._numbers = len(self._maps) - 1
        self._maps[self._numbers].append(socket)
        return MapValue(self._numbers, len(self._maps[self._numbers]) - 1)

    def _looked_up(self, name, socket, groups):
        """The `TextureValue` of a socket that shows an image unchanged, or None."""
        is_color = LOBE_AOVS[name][0] == "COLOR"
        shown = plain_texture(socket, groups, "RGBA" if is_color else "VALUE")
        if shown is None or shown[1].uv not in self._uv_names:
            return None
        image, texture, component = shown
        if is_color and component != "color":
            return None
        file = self._images.file_of(image)
        if file is None:
            return None
        texture = replace(texture, file=file)
        if texture not in self.textures:
            self.textures.append(texture)
        return TextureValue(
            self.textures.index(texture), "gray" if component == "color" and not is_color else component
        )

    def prepare(self, uv_name: str) -> None:
        """Add the nodes that `show` and `target` need; `uv_name` is the UV map that UV_MAP shows."""
        self._output = material_output(self.tree)
        if self._output is None:
            self._output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        link = live_link(self._output.inputs["Surface"])
        self._surface = link.from_socket if link else None
        self._emissions = {number: self._emission(number) for number in range(self.count)}
        self._places = self.tree.nodes.new("ShaderNodeUVMap")
        self._places.uv_map = uv_name
        self._emissions[UV_MAP] = self.tree.nodes.new("ShaderNodeEmission")
        self.tree.links.new(self._places.outputs["UV"], self._emissions[UV_MAP].inputs["Color"])
        self._image_node = self.tree.nodes.new("ShaderNodeTexImage")

    def _emission(self, number):
        emission, sockets = self.tree.nodes.new("ShaderNodeEmission"), self._maps[number]
        for alpha in self._alphas:
            one = computed("MAXIMUM", alpha, value_of(emission.inputs["Strength"]), clamp=True)
            self.tree.links.new(one, emission.inputs["Strength"])
        if number in self._colors:
            self.tree.links.new(sockets[0], emission.inputs["Color"])
            return emission
        # A number may come from a color or vector socket; a link to a number socket converts it as the shader would.
        combined = self.tree.nodes.new("ShaderNodeCombineXYZ")
        for socket, target in zip(sockets, combined.inputs, strict=False):
            self.tree.links.new(socket, target)
        self.tree.links.new(combined.outputs[0], emission.inputs["Color"])
        return emission

    def show(self, number: int | None) -> None:
        """Make the material emit map `number`, black if there is no such map; None restores its surface."""
        surface = self._output.inputs["Surface"]
        cut(surface)
        if number is None:
            if self._surface is not None:
                self.tree.links.new(self._surface, surface)
        elif number in self._emissions:
            self.tree.links.new(self._emissions[number].outputs[0], surface)

    def target(self, image) -> None:
        """Make `image` the target of bakes."""
        self._image_node.image = image
        self.tree.nodes.active = self._image_node

    def remove(self) -> None:
        """Remove the nodes of `prepare` and restore the surface."""
        self.show(None)
        for node in (self._image_node, self._places, *self._emissions.values()):
            self.tree.nodes.remove(node)


# Transparency:

LIGHT_PATH = "ShaderNodeLightPath"
DIRECTIONAL = FRESNEL, LAYER_WEIGHT, GEOMETRY = "ShaderNodeFresnel", "ShaderNodeLayerWeight", "ShaderNodeNewGeometry"
# UNKNOWN: outputs of nodes that differ from shadow ray to shadow ray by more than `Transparency.cosines`.
UNKNOWN = {
    LIGHT_PATH: ("Ray Length", "Transparent Depth"),
    GEOMETRY: ("Incoming",),
    "ShaderNodeTexCoord": ("Reflection", "Window"),
}
# COSINES: those of `Transparency.cosines` for shares that do not vary, closest at grazing angles, where Fresnel is
# steepest.
_FRONT = np.square(np.linspace(1e-3, 1.0, 129))
COSINES = np.append(-_FRONT[::-1], _FRONT)
EVEN = 1e-4  # shares that differ less count as the same


def shown_to_shadow_ray(node, output: str, number: float | None, cosine: float | None) -> float | None:
    """What the `output` of a node is for a shadow ray that meets a surface at `cosine` (see `Transparency.cosines`),
    where its first input is the constant `number`; None: unknown. Bumps are left out: on average they change little."""
    kind = node.bl_idname
    if kind == LIGHT_PATH:
        return None if output in UNKNOWN[kind] else float(output in ("Is Shadow Ray", "Ray Depth"))
    if cosine is None or (kind == GEOMETRY and output != "Backfacing") or (kind != GEOMETRY and number is None):
        return None
    if kind == GEOMETRY:
        return float(cosine < 0.0)
    if output == "Facing":
        blend = min(max(number, 0.0), 1.0 - 1e-5)
        return 1.0 - abs(cosine) ** (2.0 * blend if blend < 0.5 else 0.5 / (1.0 - blend))
    index = max(number, 1e-5) if kind == FRESNEL else 1.0 / max(1.0 - number, 1e-5)
    return float(dielectric_reflectance(abs(cosine), index if cosine >= 0.0 else 1.0 / index))


def even_transparency(shares: np.ndarray, cosines, triangles: int) -> Transparency:
    """The transparency of so many triangles by their `shares` (A,) at `cosines` (A,); () with a single share."""
    shares = np.clip(shares, 0.0, 1.0).astype(np.float32)
    if np.ptp(shares) <= EVEN:
        return Transparency(float(shares.mean()))
    uv = np.zeros((triangles, 3, 2), np.float32)
    return Transparency(1.0, shares[:, None, None], uv, "EXTEND", "Closest", cosines=tuple(cosines))
