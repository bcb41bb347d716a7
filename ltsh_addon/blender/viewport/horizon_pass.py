"""Chooses per pixel which horizon ends the specular lobe, as `materials.specular_horizon` does for samples."""

from __future__ import annotations

from collections.abc import Sequence

import gpu
from gpu_extras.batch import batch_for_shader

from ..materials import specular_horizon as rule
from .gbuffer_textures import SAMPLERS, GBufferTextures
from .horizon_source import BRIGHTNESS, CHOICE, EXCESS, ROUND_CORNERS, TEXTURES, fragment_source
from .lighting_source import VERTEX
from .uploaded_lights import UploadedLights, shares

_TRIANGLE = ((-1.0, -1.0), (3.0, -1.0), (-1.0, 3.0))
_RESULTS = {BRIGHTNESS: "brightnesses", EXCESS: "excesses", CHOICE: "horizons"}


class HorizonPass:
    """The choice for one view; needs an active GPU context."""

    def __init__(self):
        self._shaders = {step: _shader(step) for step in TEXTURES}
        self._size, self._textures, self._buffers = None, {}, {}

    def free(self) -> None:
        """Let go of everything."""
        self._size, self._shaders, self._textures, self._buffers = None, {}, {}, {}

    def draw(self, gbuffer: GBufferTextures, lights: UploadedLights, view: Sequence[float]) -> gpu.types.GPUTexture:
        """Normals of the horizons (RGB) of a G-buffer with smooth and geometric normals; valid until the next call.

        `view` is the camera's place and 1, or for parallel views the unit direction toward it and 0.
        """
        self._resize(gbuffer.size)
        corners = [ROUND_CORNERS if light.is_round else len(light.polygon()) for light in lights.lights]
        directions = rule.AROUND * len(rule.HEIGHTS)
        self._run(BRIGHTNESS, gbuffer, lights, shares(corners))
        self._run(EXCESS, gbuffer, lights, shares([directions * count for count in corners]), view)
        self._run(CHOICE, gbuffer, lights, [(0, 0)])
        return self._textures[_RESULTS[CHOICE]]

    def _resize(self, size) -> None:
        if size != self._size:
            self._textures = {name: gpu.types.GPUTexture(size, format="RGBA32F") for name in _RESULTS.values()}
            self._buffers = {
                step: gpu.types.GPUFrameBuffer(color_slots=[self._textures[name]]) for step, name in _RESULTS.items()
            }
            self._size = size

    def _run(self, step, gbuffer, lights, light_shares, view=None) -> None:
        shader, batch = self._shaders[step]
        with self._buffers[step].bind():
            gpu.state.viewport_set(0, 0, *self._size)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("NONE")
            try:
                shader.bind()
                for name in TEXTURES[step]:
                    own = self._textures.get(name) or (lights.texture if name == "lights" else None)
                    shader.uniform_sampler(name, own or getattr(gbuffer, SAMPLERS[name]))
                if view is not None:
                    shader.uniform_float("view", view)
                for first, end in light_shares:
                    if step != CHOICE:
                        shader.uniform_int("place", (first, end))
                    batch.draw(shader)
                    gpu.state.blend_set("ADDITIVE_PREMULT")
            finally:
                gpu.state.blend_set("NONE")


def _shader(step):
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC2", "corner")
    info.fragment_out(0, "VEC4", "color")
    # What a shader does not use is not there for whom sets it.
    if step != CHOICE:
        info.push_constant("IVEC2", "place")
    if step == EXCESS:
        info.push_constant("VEC4", "view")
    for slot, name in enumerate(TEXTURES[step]):
        info.sampler(slot, "FLOAT_2D", name)
    info.vertex_source(VERTEX)
    info.fragment_source(fragment_source(step))
    shader = gpu.shader.create_from_info(info)
    return shader, batch_for_shader(shader, "TRIS", {"corner": _TRIANGLE})
