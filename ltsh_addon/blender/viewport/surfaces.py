"""The first pass: surfaces of the scene into a G-buffer."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from mathutils import Matrix

from ...shading.header import filled
from ..materials.looks import IMAGE_SLOTS, is_missing
from .mirror import ShownInstance, ShownLook
from .shaders import glsl
from .textures import (
    DEFINES,
    LOOK_SIZE,
    GBufferTextures,
    albedo_table,
    blend_table,
    float_table,
    float_texture,
    uniform_buffer,
)

# No more than six textures can be drawn into at once.
SURFACES = ("position", "normal", "base", "f0", "f90", "dielectric")
NORMALS = ("diffuse_normal", "smooth_normal", "geometric_normal")
EMISSION = ("emission",)
# Before, Cycles left interpolated normals as long as they are.
NORMAL_MAPS_BEND_UNIT_NORMALS = bpy.app.version >= (5, 0, 0)
# That of images which are not found, as in Cycles.
MISSING_COLOR = (1.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class View:
    """From where a picture is seen: matrices (4, 4), and the eye's place or, in parallel views, the way to it."""

    projection: np.ndarray  # world to clip space
    eye: np.ndarray  # (3,)
    is_parallel: bool

    @classmethod
    def of(cls, view_matrix: Matrix, window_matrix: Matrix, is_parallel: bool) -> View:
        """That of a region's matrices."""
        to_world = view_matrix.inverted()
        eye = to_world.col[2].xyz.normalized() if is_parallel else to_world.translation
        return cls(np.array(window_matrix @ view_matrix, np.float64), np.array(eye), is_parallel)


class SurfacePass:
    """Shaders and textures of one view's G-buffer; needs an active GPU context."""

    def __init__(self):
        self._shaders = {(outputs, False): _shader(outputs) for outputs in (SURFACES, NORMALS, EMISSION)}
        self._tables = {"albedo_table": float_table(albedo_table()), "blend_table": float_table(blend_table())}
        self._nothing = float_texture(np.zeros((1, 1, 4)))
        self._missing = float_texture(np.array(MISSING_COLOR).reshape(1, 1, 4))
        self._size, self._textures, self._buffers = None, {}, {}
        self._lobe_textures: dict = {}

    def draw(self, instances: list[ShownInstance], view: View, size: tuple[int, int]) -> GBufferTextures:
        """The G-buffer of `instances`, `size` pixels wide and high; valid until the next call.

        Normals of their own are there where a surface is smooth or bent.
        """
        self._resize(size)
        textures = dict(self._draw_into(SURFACES, instances, view, size))
        if has_normals(instances):
            textures.update(self._draw_into(NORMALS, instances, view, size))
        return GBufferTextures(**textures)

    def draw_lobe(self, number: int, instances: list[ShownInstance], view: View) -> GBufferTextures:
        """The G-buffer of the lobes `number`, from 1 on, of what `draw` drew last; valid until the next call.

        There is no surface where a material has fewer lobes.
        """
        having = [instance for instance in instances if any(len(look.lobes) > number for look in instance.looks)]
        textures = dict(self._draw_into(SURFACES, having, view, self._size, number))
        if has_normals(having):
            textures.update(self._draw_into(NORMALS, having, view, self._size, number))
        return GBufferTextures(**textures)

    @property
    def depth(self) -> gpu.types.GPUTexture:
        """The depth of what was drawn last."""
        return self._depth

    def add_emission(self, instances: list[ShownInstance], view: View, size: tuple[int, int], frame_buffer) -> None:
        """Add what the surfaces drawn last emit to `frame_buffer`."""
        shining = [instance for instance in instances if any(np.any(look.look.emission) for look in instance.looks)]
        if not shining:
            return
        with frame_buffer.bind():
            gpu.state.viewport_set(0, 0, *size)
            gpu.state.depth_test_set("NONE")
            gpu.state.blend_set("ADDITIVE_PREMULT")
            try:
                self._draw_instances(self._shaders[EMISSION, False], shining, view, is_emission=True)
            finally:
                gpu.state.blend_set("NONE")

    def free(self) -> None:
        """Let go of everything."""
        self._size, self._textures, self._buffers, self._tables, self._shaders = None, {}, {}, {}, {}
        self._lobe_textures = {}
        self._nothing = self._missing = self._depth = None

    def _resize(self, size) -> None:
        if size == self._size:
            return
        self._textures = {name: gpu.types.GPUTexture(size, format="RGBA32F") for name in (*SURFACES, *NORMALS)}
        self._depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
        self._buffers = {
            outputs: gpu.types.GPUFrameBuffer(
                depth_slot=self._depth, color_slots=[self._textures[name] for name in outputs]
            )
            for outputs in (SURFACES, NORMALS)
        }
        self._lobe_textures = {}
        self._size = size

    def _target(self, outputs, is_further: bool):
        """Textures by name and the frame buffer that `outputs` are drawn into; those of further lobes have no depth."""
        if not is_further:
            return {name: self._textures[name] for name in outputs}, self._buffers[outputs]
        if outputs not in self._lobe_textures:
            textures = {name: gpu.types.GPUTexture(self._size, format="RGBA32F") for name in outputs}
            buffer = gpu.types.GPUFrameBuffer(color_slots=list(textures.values()))
            self._lobe_textures[outputs] = textures, buffer
        return self._lobe_textures[outputs]

    def _draw_into(self, outputs, instances, view: View, size, number: int = 0) -> dict:
        """Draw the lobes `number`; the textures by name."""
        textures, buffer = self._target(outputs, number > 0)
        if (outputs, number > 0) not in self._shaders:
            self._shaders[outputs, True] = _shader(outputs, is_further=True)
        with buffer.bind():
            gpu.state.viewport_set(0, 0, *size)
            # Only the position tells where there is a surface, but no number may be left that is not one.
            if number > 0:
                buffer.clear(color=(0.0, 0.0, 0.0, 0.0))
            else:
                buffer.clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("NONE" if number > 0 else "LESS_EQUAL")
            gpu.state.depth_mask_set(number == 0)
            gpu.state.face_culling_set("NONE")
            try:
                self._draw_instances(self._shaders[outputs, number > 0], instances, view, number)
            finally:
                gpu.state.depth_test_set("NONE")
                gpu.state.depth_mask_set(False)
        return textures

    def _draw_instances(self, shader, instances, view: View, number: int = 0, is_emission: bool = False) -> None:
        shader.bind()
        if number > 0 or is_emission:
            shader.uniform_sampler("positions", self._textures["position"])
        values = np.vstack([view.projection.T, [*view.eye, 0.0 if view.is_parallel else 1.0]])
        # Kept until all is drawn: the card reads it then.
        self._view_values = uniform_buffer(values)
        shader.uniform_block("view", self._view_values)
        for name, table in self._tables.items() if not is_emission else ():
            shader.uniform_sampler(name, table)
        # From near to far: what is hidden need not be computed.
        for instance in sorted(instances, key=lambda item: np.dot(view.projection[3], item.center)):
            shader.uniform_float("model", instance.model)
            if not is_emission:
                marks = instance.mesh.is_smooth, instance.is_only_user
                shader.uniform_float("placement", (instance.receiver, instance.side, *marks))
            for slot, look in zip(instance.mesh.slots, instance.looks, strict=True):
                for lobe in look.lobes[number : number + 1]:
                    shader.uniform_block("look", lobe.uniforms)
                    if not is_emission:
                        self._bind_images(shader, lobe)
                    instance.mesh.batch(slot, lobe.look.uv_map).draw(shader)

    def _bind_images(self, shader, shown: ShownLook) -> None:
        if shown.textures is None:
            shown.textures = {
                name: self._missing if is_missing(use.image) else gpu.texture.from_image(use.image)
                for name, use in shown.look.images.items()
            }
        for name in IMAGE_SLOTS:
            shader.uniform_sampler(f"{name}_image", shown.textures.get(name, self._nothing))


def has_normals(instances: list[ShownInstance]) -> bool:
    """True where the diffuse lobe or a horizon has a normal of its own."""
    return has_bent_lobes(instances) or any(instance.mesh.is_smooth for instance in instances)


def has_bent_lobes(instances: list[ShownInstance]) -> bool:
    """True where a diffuse lobe does not end at its own normal's horizon."""
    return any(_bends(lobe) for instance in instances for look in instance.looks for lobe in look.lobes)


def _bends(shown: ShownLook) -> bool:
    """True where the diffuse lobe has a normal of its own."""
    return shown.look.normal is not None or shown.look.kind == "translucent"


def _shader(outputs, is_further: bool = False):
    info = gpu.types.GPUShaderCreateInfo()
    info.typedef_source(
        f"struct SurfaceView {{ mat4 projection; vec4 eye; }};\nstruct SurfaceLook {{ vec4 data[{LOOK_SIZE}]; }};\n"
    )
    for name, value in DEFINES.items():
        info.define(name, value)
    info.define({SURFACES: "DRAWS_SURFACES", NORMALS: "DRAWS_NORMALS", EMISSION: "DRAWS_EMISSION"}[outputs])
    if is_further:
        info.define("IS_FURTHER")
    info.uniform_buf(0, "SurfaceView", "view")
    info.uniform_buf(1, "SurfaceLook", "look")
    info.push_constant("MAT4", "model")
    # What a shader does not use is not there for whom sets it.
    if outputs != EMISSION:
        info.push_constant("VEC4", "placement")
    info.define("UNIT_NORMALS", "true" if NORMAL_MAPS_BEND_UNIT_NORMALS else "false")
    info.define("ONLY_USER", "false" if outputs == EMISSION else "(placement.w > 0.0)")
    images = (*(f"{name}_image" for name in IMAGE_SLOTS), "albedo_table", "blend_table")
    needs_seen = is_further or outputs == EMISSION
    for slot, name in enumerate((*(images if outputs != EMISSION else ()), *(("positions",) if needs_seen else ()))):
        info.sampler(slot, "FLOAT_2D", name)
    info.vertex_in(0, "VEC3", "position")
    info.vertex_in(1, "VEC3", "normal")
    info.vertex_in(2, "VEC2", "uv")
    # Meshes without normal maps have none: they get (0, 0, 0, 1).
    info.vertex_in(3, "VEC4", "tangent")
    passed = gpu.types.GPUStageInterfaceInfo(f"ltsh_{outputs[0]}_{int(is_further)}")
    passed.smooth("VEC3", "v_position")
    passed.smooth("VEC3", "v_normal")
    passed.smooth("VEC3", "v_object_normal")
    passed.smooth("VEC2", "v_uv")
    passed.smooth("VEC4", "v_tangent")
    info.vertex_out(passed)
    for slot, name in enumerate(outputs):
        info.fragment_out(slot, "VEC4", f"out_{name}")
    info.vertex_source(glsl("surface_vertex"))
    functions = "" if outputs == EMISSION else glsl("images") + glsl("reflectance") + glsl("normals")
    info.fragment_source(filled(glsl("surface"), {"FUNCTIONS": functions}))
    return gpu.shader.create_from_info(info)
