"""The first pass: draws the surfaces of a mirrored scene into a G-buffer, lobe by lobe."""

import math
import time
from dataclasses import replace

import bpy
import gpu
import numpy as np

from ...cycles.gbuffer import MOST_WIDENING
from ...shading.header import definitions, filled
from ..materials.preview_material import IMAGE_SLOTS, is_missing
from .drawing import (
    GBufferTextures,
    PixelShader,
    ViewCamera,
    compiled,
    drawing,
    float_table,
    float_texture,
    glsl,
    pause_if_slow,
    uniform_buffer,
)
from .meshes import DEFINES, LOOK_SIZE, albedo_table, blend_table, sheen_table
from .mirror import ShownInstance, ShownLook
from .shaders import slope_text

# Outputs of the surface shader, in groups that are drawn into at once. A group has at most six textures.
SURFACES = ("position", "normal", "base", "f0", "f90", "dielectric")
NORMALS = ("diffuse_normal", "smooth_normal", "geometric_normal")
TANGENTS, REBOUNDS, EMISSION, THROUGH = ("tangent",), ("rebound",), ("emission",), ("through",)
_ADDED = (EMISSION, THROUGH)
MASK = ("mask",)
# Types of the attributes of a mesh's corners.
_CORNER = {"position": "VEC3", "normal": "VEC3", "uv": "VEC2", "tangent": "VEC4"}
# The further attribute for anisotropic lobes: generated coordinates relative to the middle.
_AROUND = {"around": "VEC3"}
# Before Blender 5.0, Cycles did not normalize interpolated normals for normal maps.
NORMAL_MAPS_BEND_UNIT_NORMALS = bpy.app.version >= (5, 0, 0)
MISSING_COLOR = (1.0, 0.0, 1.0, 1.0)  # of images that are not found, as in Cycles


class SurfacePass:
    """Shaders and textures of one view's G-buffer; needs an active GPU context.

    Glass in front of the surfaces has a pass of its own. It is made with the pass of the surfaces, `before`, and shares
    its depth buffer.
    """

    def __init__(self, before: "SurfacePass | None" = None):
        self._before, self._is_glass = before, before is not None
        self._through: tuple | None = None
        self._shares: list | None = None
        self._size = self._depth = None
        self._widening = 0.0
        self._targets: dict = {}
        if before is not None:
            self._shaders, self._tables = before._shaders, before._tables
            self._black_image, self._missing_image = before._black_image, before._missing_image
            self._mask_shaders = before._mask_shaders
            return
        self._shaders = {(outputs, False): _shader(outputs) for outputs in (SURFACES, NORMALS, EMISSION)}
        self._tables = {"albedo_table": float_table(albedo_table()), "blend_table": float_table(blend_table())}
        self._tables["sheen_table"] = float_texture(sheen_table())
        self._mask_shaders: dict[bool, PixelShader] = {}  # by whether surfaces are anisotropic
        self._black_image = float_texture(np.zeros((1, 1, 4)))
        self._missing_image = float_texture(np.array(MISSING_COLOR).reshape(1, 1, 4))

    def draw(
        self, instances: list[ShownInstance], view: ViewCamera, size: tuple[int, int], points: float = math.inf
    ) -> GBufferTextures:
        """The G-buffer of `instances`, `size` (width, height) in pixels; valid until the next call.

        It has further normals if any surface is smooth or bent. Specular lobes take in how normals turn within a pixel,
        of which this is one of so many `points`.
        """
        # The variance of a square of one pixel is 1 / 12 in either direction.
        self._widening = 1.0 / (12.0 * points)
        if size != self._size:
            self._size, self._targets = size, {}
            self._depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
        if self._before is not None and self._depth is not self._before._depth:
            self._depth, self._targets = self._before._depth, {}
        return self._gbuffer(0, instances, view)

    def draw_lobe(self, number: int, instances: list[ShownInstance], view: ViewCamera) -> GBufferTextures:
        """The G-buffer of the lobes `number`, from 1 on, of the surfaces drawn last; valid until the next call.

        Pixels whose material has fewer lobes have no surface.
        """
        having = [instance for instance in instances if any(len(look.lobes) > number for look in instance.looks)]
        return self._gbuffer(number, having, view)

    def add_emission(self, instances: list[ShownInstance], view: ViewCamera, frame_buffer) -> None:
        """Add the emission of the surfaces drawn last to `frame_buffer`."""
        shining = [one for one in instances if any(np.any(it.look.emission) or it.look.glow > 0.0 for it in one.looks)]
        if shining:
            self._add(EMISSION, [(0, shining)], view, frame_buffer)

    def add_share_of_cycles(self, instances: list[ShownInstance], view: ViewCamera, frame_buffer) -> None:
        """Add 1 to `frame_buffer` where the surfaces drawn last are Cycles' alone in views with bounces."""
        if self._shares is None:
            values = np.zeros((2, LOOK_SIZE, 4))
            values[1, 1, :3] = 1.0  # the emission of a look
            self._shares = [uniform_buffer(one) for one in values]
        marked = [
            replace(one, looks=tuple(replace(it, uniforms=self._shares[it.look.is_of_cycles]) for it in one.looks))
            for one in instances
            if any(it.look.is_of_cycles for it in one.looks)
        ]
        self._add(EMISSION, [(0, marked)], view, frame_buffer)

    def through(self, instances: list[ShownInstance], view: ViewCamera) -> gpu.types.GPUTexture:
        """The texture (RGB) of the share of light from behind that the surfaces drawn last let through."""
        if (THROUGH, False) not in self._shaders:
            self._shaders[THROUGH, False] = _shader(THROUGH)
        if self._through is None or (self._through[0].width, self._through[0].height) != self._size:
            texture = gpu.types.GPUTexture(self._size, format="RGBA16F")
            self._through = texture, gpu.types.GPUFrameBuffer(color_slots=[texture])
        with self._through[1].bind():
            self._through[1].clear(color=(0.0, 0.0, 0.0, 0.0))
        most = max((len(look.lobes) for instance in instances for look in instance.looks), default=0)
        self._add(THROUGH, [(number, instances) for number in range(most)], view, self._through[1])
        return self._through[0]

    def _add(self, outputs, parts, view: ViewCamera, frame_buffer) -> None:
        """Add `outputs` of the lobes (number, instances) of `parts` to `frame_buffer`, on the surfaces drawn last."""
        with drawing(frame_buffer, (0, 0, *self._size), "ADDITIVE_PREMULT"):
            for number, instances in parts:
                self._draw_instances(outputs, instances, view, number)

    def _gbuffer(self, number, instances, view) -> GBufferTextures:
        textures = self._draw_into(SURFACES, instances, view, number)
        if has_bent_lobes(instances) or any(instance.mesh.is_smooth for instance in instances):
            textures = textures | self._draw_into(NORMALS, instances, view, number)
        every = [look for instance in instances for look in instance.looks]
        drawn = [lobe.look for look in every for lobe in look.lobes[number : number + 1]]
        if any(lobe.brush is not None for lobe in drawn):
            textures = textures | self._draw_into(TANGENTS, instances, view, number)
        if any(lobe.is_rough or lobe.kind == "velvet" for lobe in drawn):
            textures = textures | self._draw_into(REBOUNDS, instances, view, number)
        lobes = [lobe.look for look in every if self._draws(look) for lobe in look.lobes[number:]]
        marks = {
            "has_sheen": any(look.kind == "sheen" for look in lobes),
            "has_velvet": any(look.kind == "velvet" for look in lobes),
            "has_bent": any(look.is_bent for look in lobes),
        }
        return GBufferTextures(**textures, **marks, mask=self._draw_mask(textures, number > 0))

    def _draw_mask(self, textures: dict, is_further: bool) -> gpu.types.GPUTexture:
        """The depth buffer by which cards skip pixels before they shade, see `drawing.WITHIN_MASK`."""
        if (MASK, is_further) not in self._targets:
            texture = gpu.types.GPUTexture(self._size, format="DEPTH_COMPONENT32F")
            self._targets[MASK, is_further] = texture, gpu.types.GPUFrameBuffer(depth_slot=texture)
        texture, buffer = self._targets[MASK, is_further]
        read = {"positions": textures["position"]}
        if has_brushed := "tangent" in textures:
            read["tangents"] = textures["tangent"]
        if has_brushed not in self._mask_shaders:
            text = definitions({"BRUSHING": 1} if has_brushed else {}) + glsl("mask")
            self._mask_shaders[has_brushed] = PixelShader(text, tuple(read), {}, is_depth=True)
        shader = self._mask_shaders[has_brushed]
        with drawing(buffer, (0, 0, *self._size), depth="ALWAYS", writes_depth=True):
            shader.bind(read)
            shader.draw()
        return texture

    def _target(self, outputs, is_further: bool):
        """Textures by name, and the frame buffer that `outputs` are drawn into; without depth for further lobes."""
        if (outputs, is_further) not in self._targets:
            textures = {name: gpu.types.GPUTexture(self._size, format="RGBA32F") for name in outputs}
            depth = {} if is_further else {"depth_slot": self._depth}
            buffer = gpu.types.GPUFrameBuffer(color_slots=list(textures.values()), **depth)
            self._targets[outputs, is_further] = textures, buffer
        return self._targets[outputs, is_further]

    def _draw_into(self, outputs, instances, view: ViewCamera, number: int) -> dict:
        """Draw the lobes `number`; returns the textures by name."""
        is_further = number > 0
        textures, buffer = self._target(outputs, is_further)
        if (outputs, is_further) not in self._shaders:
            self._shaders[outputs, is_further] = _shader(outputs, is_further)
        depth = "NONE" if is_further else "LESS_EQUAL"
        with drawing(buffer, (0, 0, *self._size), depth=depth, writes_depth=not is_further):
            # Only the position tells where there is a surface. The others are cleared because old texels may be NaN.
            buffer.clear(color=(0.0, 0.0, 0.0, 0.0), **({} if is_further or self._is_glass else {"depth": 1.0}))
            gpu.state.face_culling_set("NONE")
            self._draw_instances(outputs, instances, view, number)
        return textures

    def _draw_instances(self, outputs, instances, view: ViewCamera, number: int) -> None:
        is_emission, is_later = outputs == EMISSION, number > 0 or outputs in _ADDED
        shader = self._shaders[outputs, number > 0 and outputs not in _ADDED]
        shader.bind()
        if is_later:
            shader.uniform_sampler("positions", self._target(SURFACES, False)[0]["position"])
        values = np.vstack([view.projection.T, view.homogeneous_eye, (self._widening, MOST_WIDENING, 0.0, 0.0)])
        # Kept alive, because the card reads it only when it draws.
        self._view_values = uniform_buffer(values)
        shader.uniform_block("view", self._view_values)
        for name, table in self._tables.items() if not is_emission else ():
            shader.uniform_sampler(name, table)
        # From near to far, so that hidden pixels are not computed.
        for instance in sorted(instances, key=lambda item: np.dot(view.projection[3], item.center)):
            looks = [pair for pair in zip(instance.mesh.slots, instance.looks, strict=True) if self._draws(pair[1])]
            if not looks:
                continue
            shader.uniform_float("model", instance.model)
            if not is_emission:
                marks = instance.mesh.is_smooth, instance.is_only_user
                shader.uniform_float("placement", (instance.receiver, instance.side, *marks))
            for slot, look in looks:
                for lobe in look.lobes[number : number + 1]:
                    shader.uniform_block("look", lobe.uniforms)
                    self._bind_images(shader, lobe, ("color",) if is_emission else IMAGE_SLOTS)
                    instance.mesh.batch(slot, lobe.look.uv_map).draw(shader)

    def _draws(self, look: ShownLook) -> bool:
        return look.is_glass == self._is_glass

    def _bind_images(self, shader, shown: ShownLook, slots: tuple[str, ...]) -> None:
        if shown.textures is None:
            shown.textures = {}
        for name, use in shown.look.images.items():
            if name not in shown.textures:
                started, is_lost = time.monotonic(), is_missing(use.image)
                shown.textures[name] = self._missing_image if is_lost else gpu.texture.from_image(use.image)
                pause_if_slow(started)
        for name in slots:
            shader.uniform_sampler(f"{name}_image", shown.textures.get(name, self._black_image))


def has_bent_lobes(instances: list[ShownInstance]) -> bool:
    """True if any diffuse lobe does not end at the horizon of its own normal."""
    lobes = (lobe.look for instance in instances for look in instance.looks for lobe in look.lobes)
    return any(lobe.normal is not None or lobe.kind == "translucent" for lobe in lobes)


def _shader(outputs, is_further: bool = False):
    info = gpu.types.GPUShaderCreateInfo()
    info.typedef_source(
        "struct SurfaceView { mat4 projection; vec4 eye; vec4 widening; };\n"
        f"struct SurfaceLook {{ vec4 data[{LOOK_SIZE}]; }};\n"
    )
    for name, value in DEFINES.items():
        info.define(name, value)
    drawn = {SURFACES: "SURFACES", NORMALS: "NORMALS", TANGENTS: "TANGENTS", REBOUNDS: "REBOUNDS"}
    drawn = {**drawn, EMISSION: "EMISSION", THROUGH: "THROUGH"}[outputs]
    info.define(f"DRAWS_{drawn}")
    if is_further:
        info.define("IS_FURTHER")
    info.uniform_buf(0, "SurfaceView", "view")
    info.uniform_buf(1, "SurfaceLook", "look")
    info.push_constant("MAT4", "model")
    # The compiler removes unused constants, and setting them is an error.
    if outputs != EMISSION:
        info.push_constant("VEC4", "placement")
    info.define("UNIT_NORMALS", "true" if NORMAL_MAPS_BEND_UNIT_NORMALS else "false")
    info.define("ONLY_USER", "false" if outputs == EMISSION else "(placement.w > 0.0)")
    samplers = ["color_image"]
    if outputs != EMISSION:
        samplers = [*(f"{name}_image" for name in IMAGE_SLOTS), "albedo_table", "blend_table", "sheen_table"]
    if is_further or outputs in _ADDED:
        samplers.append("positions")
    for slot, name in enumerate(samplers):
        info.sampler(slot, "FLOAT_2D", name)
    # Meshes without normal maps have no tangent: they get (0, 0, 0, 1).
    corner = {**_CORNER, **(_AROUND if outputs == TANGENTS else {})}
    for slot, (name, kind) in enumerate(corner.items()):
        info.vertex_in(slot, kind, name)
    passed = gpu.types.GPUStageInterfaceInfo(f"ltsh_{outputs[0]}_{int(is_further)}")
    for name, kind in {**corner, "object_normal": "VEC3"}.items():
        passed.smooth(kind, f"v_{name}")
    info.vertex_out(passed)
    for slot, name in enumerate(outputs):
        info.fragment_out(slot, "VEC4", f"out_{name}")
    info.vertex_source(glsl("surface_vertex"))
    functions = glsl("images") + ("" if outputs == EMISSION else glsl("reflectance") + glsl("normals"))
    if outputs == REBOUNDS:
        functions += slope_text() + glsl("rebound")
    info.fragment_source(filled(glsl("surface"), {"FUNCTIONS": functions}))
    return compiled((outputs, is_further), lambda: gpu.shader.create_from_info(info))
