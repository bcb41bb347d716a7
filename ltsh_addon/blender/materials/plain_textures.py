"""Which sockets are nothing but an image looked up at a UV map, so that no shader need run (runs in the child)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ..pixels.color_management import working_space
from ..processes.array_files import save_array
from .image_textures import EXTENSIONS, INTERPOLATIONS
from .node_sources import source_behind

# Color space of the image -> whether values are sRGB. Of others, and of floats in sRGB, Cycles knows more than we do.
BYTE_SPACES = {"sRGB": True, "Non-Color": False, "Linear Rec.709": False}
FLOAT_SPACES = {"Non-Color": False, "Linear Rec.709": False}
# Blender hands out pixels as four floats each: half a gigabyte.
MOST_PIXELS = 1 << 25
# Of the entries of the matrix to Rec.709.
SAME_SPACE = 1e-4


@dataclass(frozen=True)
class PlainTexture:
    """An image texture behind a socket, and which part of its color the socket takes."""

    image: str
    uv: str  # name of the UV map, "" for the one that renders
    extension: str
    interpolation: str
    srgb: bool
    part: str  # "color", "gray", or a channel "0", "1", "2"


def plain_texture(tree, socket, groups) -> PlainTexture | None:
    """What feeds an input from the output `socket` of `tree`, where that is an image texture; `groups` leads to `tree`
    from the material, as (tree, group node) pairs."""
    found, part = source_behind(tree, socket, groups), "color"
    if _is_node(found, "ShaderNodeSeparateColor") and found.node.mode == "RGB":
        part = str(list(found.node.outputs).index(found.socket))
        found = found.input(0)
    if not _is_node(found, "ShaderNodeTexImage") or found.socket.name != "Color" or found.node.image is None:
        return None
    node = found.node
    uv, srgb = _uv_map(found), _is_srgb(node.image)
    if uv is None or srgb is None or not _is_plain(node):
        return None
    return PlainTexture(node.image.name_full, uv, node.extension, node.interpolation, srgb, part)


def _is_node(source, kind: str) -> bool:
    return source is not None and source.node is not None and source.node.bl_idname == kind


def _uv_map(texture) -> str | None:
    """Name of the UV map that an image texture is looked up at, "" for the default, None for anything else."""
    found = texture.input("Vector")
    if found is None:
        return None
    if found.node is None:
        # Only the texture's own open input means a UV map; that of a group is a constant.
        return "" if found.socket == texture.node.inputs["Vector"] else None
    if getattr(found.node, "from_instancer", False):
        return None
    if _is_node(found, "ShaderNodeUVMap"):
        return found.node.uv_map
    return "" if _is_node(found, "ShaderNodeTexCoord") and found.socket.name == "UV" else None


def _is_plain(node) -> bool:
    mapping = node.texture_mapping
    return (
        node.projection == "FLAT"
        and node.extension in EXTENSIONS
        and node.interpolation in INTERPOLATIONS
        and not any((*mapping.translation, *mapping.rotation))
        and tuple(mapping.scale) == (1.0, 1.0, 1.0)
        and (mapping.mapping_x, mapping.mapping_y, mapping.mapping_z) == ("X", "Y", "Z")
        and mapping.vector_type == "POINT"
        and not (mapping.use_min or mapping.use_max)
    )


def _is_srgb(image) -> bool | None:
    """Whether an image of one file has sRGB values; None where it cannot be told, or is of another kind."""
    if image.source != "FILE" or not 0 < image.size[0] * image.size[1] <= MOST_PIXELS:
        return None
    scene = bpy.context.scene
    if scene.render.use_simplify and scene.cycles.texture_limit_render != "OFF":
        return None
    if np.abs(np.array(working_space()["to_rec709"]) - np.eye(3)).max() > SAME_SPACE:
        return None
    return (FLOAT_SPACES if image.is_float else BYTE_SPACES).get(image.colorspace_settings.name)


class SavedImages:
    """Pixels of images as .npy in a folder, row 0 below, each image once."""

    def __init__(self, folder: Path):
        self.folder, self._names = folder, {}

    def file_of(self, name: str) -> str | None:
        """File name of the pixels (H, W, 3) of the image `name`, uint8 or float32; None where it has an alpha."""
        if name not in self._names:
            self._names[name] = self._save(bpy.data.images[name])
        return self._names[name]

    def _save(self, image):
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
        pixels = pixels.reshape(height, width, 4)
        if (pixels[..., 3] != 1.0).any():
            return None
        colors = pixels[..., :3]
        name = f"image_{len(self._names)}.npy"
        save_array(self.folder / name, colors if image.is_float else np.rint(255.0 * colors).astype(np.uint8))
        return name
