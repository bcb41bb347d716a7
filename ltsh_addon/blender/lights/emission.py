"""What lights emit: the node tree behind a light, and a render of it where that is not enough."""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..materials.bsdfs import EMISSION, emission_sockets, emits
from ..materials.graph import Source, is_socket, shaders_behind, source_of, surface_of, value_of
from ..render_settings import enable_passes

# Nodes whose value is the same everywhere, as long as what they are fed is.
CONSTANT_NODES = frozenset(
    "ShaderNode" + name
    for name in (
        *("Value", "RGB", "Blackbody", "Wavelength", "Math", "VectorMath", "Mix", "MixRGB", "Clamp", "MapRange"),
        *("CombineColor", "SeparateColor", "CombineXYZ", "SeparateXYZ", "ValToRGB", "HueSaturation", "Gamma"),
        *("BrightContrast", "Invert", "RGBCurve", "VectorCurve", "FloatCurve", "RGBToBW"),
    )
) | {"FunctionNodeInputColor", "FunctionNodeInputVector", "FunctionNodeInputInt", "FunctionNodeInputBool"}
# Values that depend on where the light shines, by node and output; all outputs where none is named.
DIRECTIONAL = {
    "ShaderNodeLightPath": (),
    "ShaderNodeLayerWeight": (),
    "ShaderNodeFresnel": (),
    "ShaderNodeCameraData": (),
    "ShaderNodeLightFalloff": (),
    "ShaderNodeTexIES": (),
    "ShaderNodeNewGeometry": ("Incoming",),
    "ShaderNodeTexCoord": ("Camera", "Window", "Reflection"),
}


@dataclass
class Emission:
    """What the nodes of a material or light emit."""

    emits: bool = False
    plain: bool = False  # one Emission node, white, of strength 1
    varies: bool = False
    directional: set[str] = field(default_factory=set)  # labels of nodes


def emission_of(data) -> Emission:
    """What the nodes of a material or light emit."""
    found, seen, surface = Emission(), set(), surface_of(data)
    leaves = [] if surface is None else shaders_behind(surface).leaves
    found.plain = len(leaves) == 1 and leaves[0].terms == ((),) and _is_neutral(leaves[0].node)
    for leaf in leaves:
        if not emits(leaf.node):
            continue
        found.emits = True
        alpha = (leaf.node.inputs["Alpha"],) if "Alpha" in leaf.node.inputs else ()
        for value in (*emission_sockets(leaf.node), *alpha):
            _note_value(source_of(value, leaf.groups), found, seen)
        for factor in {factor for term in leaf.terms for factor in term}:
            _note_value(factor.source, found, seen)
    return found


def _is_neutral(node) -> bool:
    """True for an Emission node that multiplies by 1."""
    if node.bl_idname != EMISSION:
        return False
    color, strength = (value_of(socket) for socket in emission_sockets(node))
    return strength == 1.0 and not is_socket(color) and color[:3] == (1.0, 1.0, 1.0)


def _note_value(source: Source | None, found: Emission, seen: set) -> None:
    """Note in `found` what a value depends on."""
    if source is None or source.node is None:
        return
    key = source.node, source.socket.identifier, source.groups
    if key in seen:
        return
    seen.add(key)
    kind = source.node.bl_idname
    if kind in DIRECTIONAL and (not DIRECTIONAL[kind] or source.socket.name in DIRECTIONAL[kind]):
        found.directional.add(source.node.bl_label)
    found.varies |= kind not in CONSTANT_NODES
    for entry in source.node.inputs:
        _note_value(source_of(entry, source.groups), found, seen)


PIXELS = 256
SAMPLES_PER_PIXEL = 4
# Pixels may be this much longer than wide (Blender's own limit is 200).
PIXEL_ASPECT = 100.0
# Only what is this close to the plane of the rectangle is seen, by its longer side.
CLIP = 1e-3


class Studio:
    """A scene with one object and a camera that looks at it; use `open_studio`."""

    def __init__(self, scene, camera):
        self.scene, self.camera = scene, camera

    @contextmanager
    def show(self, ob, matrix: np.ndarray):
        """Meanwhile `ob`, an object of no other scene, stands at `matrix` (4, 4)."""
        self.scene.collection.objects.link(ob)
        ob.matrix_world = Matrix(matrix.tolist())
        try:
            yield
        finally:
            bpy.data.objects.remove(ob)

    def look(self, center, half_u, half_v, direction, pixels: int = PIXELS) -> tuple[np.ndarray, np.ndarray]:
        """Radiance (H, W, 3) that the rectangle center +- half_u +- half_v emits toward `direction`, and where (H, W)
        anything was seen.

        Columns run along half_u; row 0 is at +half_v if (half_u, half_v, direction) is right-handed, else at -half_v.
        """
        width, height = 2.0 * np.linalg.norm(half_u), 2.0 * np.linalg.norm(half_v)
        right = 2.0 * half_u / width
        up = np.cross(direction, right)
        distance = max(width, height)
        axes = np.eye(4)
        axes[:3, 0], axes[:3, 1], axes[:3, 2], axes[:3, 3] = right, up, direction, center + distance * direction
        self.camera.matrix_world = Matrix(axes.tolist())
        lens = self.camera.data
        lens.ortho_scale = width
        lens.clip_start, lens.clip_end = (1.0 - CLIP) * distance, (1.0 + CLIP) * distance
        self._fit_pixels(width / height, pixels)
        with tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True) as name:
            path = Path(name) / "look.exr"
            self.scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True, scene=self.scene.name)
            light = _read_pixels(path)
        return light[..., :3], light[..., 3] > 0.5

    def _fit_pixels(self, ratio: float, pixels: int) -> None:
        """Spread about `pixels` x `pixels` over a rectangle of `ratio` width to height."""
        render = self.scene.render
        columns = rows = pixels
        if ratio > PIXEL_ASPECT:
            rows = max(1, round(pixels * PIXEL_ASPECT / ratio))
        elif ratio < 1.0 / PIXEL_ASPECT:
            columns = max(1, round(pixels * PIXEL_ASPECT * ratio))
        render.resolution_x, render.resolution_y = columns, rows
        aspect = ratio * rows / columns
        render.pixel_aspect_x, render.pixel_aspect_y = max(aspect, 1.0), max(1.0 / aspect, 1.0)


def _read_pixels(path: Path) -> np.ndarray:
    """The single-layer EXR `path` as (H, W, 4) float64, row 0 on top.

    Blender itself reads it: in a child started inside Blender the package's own reader may lack its library.
    """
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1].astype(np.float64)


@contextmanager
def open_studio(of_scene):
    """A `Studio` at the frame of `of_scene`; afterwards all is gone again."""
    scene = bpy.data.scenes.new("Look at an emitter")
    lens = bpy.data.cameras.new("Look at an emitter")
    camera = bpy.data.objects.new("Look at an emitter", lens)
    try:
        scene.frame_set(of_scene.frame_current, subframe=of_scene.frame_subframe)
        scene.collection.objects.link(camera)
        scene.camera, scene.world = camera, None
        lens.type, lens.sensor_fit = "ORTHO", "HORIZONTAL"
        render, cycles = scene.render, scene.cycles
        render.engine, render.film_transparent, render.resolution_percentage = "CYCLES", True, 100
        render.use_file_extension = render.use_overwrite = True
        cycles.device, cycles.samples, cycles.max_bounces, cycles.seed = "CPU", SAMPLES_PER_PIXEL, 0, 0
        cycles.use_adaptive_sampling = cycles.use_denoising = False
        cycles.pixel_filter_type = "BOX"
        cycles.sample_clamp_direct = 0.0
        settings = render.image_settings
        if bpy.app.version >= (5, 0, 0):
            settings.media_type = "IMAGE"
        settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
        settings.exr_codec = "NONE"
        enable_passes(scene.view_layers[0], ("combined",))
        yield Studio(scene, camera)
    finally:
        bpy.data.scenes.remove(scene)
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(lens)
