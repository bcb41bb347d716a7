"""The pictures of a view: sums of samples, and the passes that show, copy and join them."""

from __future__ import annotations

from dataclasses import dataclass

import gpu

from ...shading.header import definitions
from .camera import ViewCamera
from .gbuffer import empty_texture, frame_buffer
from .shaders import glsl, pixel_shader

MODES = ("single", "split", "difference")
# RAYS: the shader constants with the rays of `ViewCamera.rays`.
RAYS = ("ray_x", "ray_y", "ray_center")


@dataclass(frozen=True)
class ShownPicture:
    """Which parts of the lighting are shown, and how."""

    technique: str
    passes: str  # combined, specular or diffuse
    mode: str  # of MODES
    second_technique: str
    split: float  # place of the line between 0 and 1
    difference_scale: float
    exposure: float
    transparent: bool
    line_width: float = 1.0
    second_picture: gpu.types.GPUTexture | None = None  # replaces the second technique's picture; without emission
    white: float = 1.0  # brightness that shows no difference, before the scene's own exposure
    also: tuple[tuple[str, str], ...] = ()  # further techniques and passes to draw, for `read`
    world: bool = True  # show the light of the world


class PicturePass:
    """Draws one or two pictures into the bound frame buffer; needs an active GPU context."""

    def __init__(self):
        constants = {"mode": "INT", "scales": "VEC4", "opacity": "FLOAT", "white": "FLOAT", "weights": "VEC2"}
        constants |= dict.fromkeys(RAYS, "VEC4")
        modes = definitions({mode.upper(): number for number, mode in enumerate(MODES)})
        source = modes + glsl("octahedron") + glsl("picture")
        self._shader, self._batch = pixel_shader(source, ("first_picture", "second_picture", "sky"), constants)

    def draw(self, pictures, weights, view: ViewCamera, shown: ShownPicture, background) -> None:
        """Fill the bound frame buffer, scene-linear, from one or two RGBA textures times their `weights`.

        The weighted alpha is the share of a pixel that shows a surface. `background` is a texture of
        `sky.background_texels`.
        """
        size = pictures[0].width, pictures[0].height
        gpu.state.viewport_set(0, 0, *size)
        gpu.state.blend_set("NONE")
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        shader = self._shader
        shader.bind()
        shader.uniform_sampler("first_picture", pictures[0])
        shader.uniform_sampler("second_picture", pictures[-1])
        shader.uniform_float("weights", (weights[0], weights[-1]))
        shader.uniform_int("mode", MODES.index(shown.mode))
        scales = (shown.exposure, shown.difference_scale, shown.split * size[0], 0.5 * shown.line_width)
        shader.uniform_float("scales", scales)
        shader.uniform_sampler("sky", background)
        shader.uniform_float("opacity", 0.0 if shown.transparent else 1.0)
        is_behind = shown.passes == "combined" and not shown.transparent
        for name, ray in zip(RAYS, view.rays, strict=True):
            shader.uniform_float(name, (*ray, float(is_behind)))
        shader.uniform_float("white", shown.white)
        self._batch.draw(shader)


class CopyPass:
    """Copies a picture into another one; needs an active GPU context."""

    def __init__(self):
        self._shader, self._batch = pixel_shader(glsl("copy"), ("picture",), {})

    def draw(self, picture: gpu.types.GPUTexture, target: gpu.types.GPUFrameBuffer) -> None:
        """Copy `picture` into `target`, which has its size."""
        with target.bind():
            gpu.state.viewport_set(0, 0, picture.width, picture.height)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("NONE")
            self._shader.bind()
            self._shader.uniform_sampler("picture", picture)
            self._batch.draw(self._shader)


class VeilPass:
    """Draws what is behind glass; needs an active GPU context."""

    def __init__(self):
        constants = {"is_seen": "FLOAT", **dict.fromkeys(RAYS, "VEC4")}
        samplers = ("behind", "left", "glass", "sky")
        self._shader, self._batch = pixel_shader(glsl("octahedron") + glsl("veil"), samplers, constants)

    def draw(self, textures, target, view: ViewCamera, is_seen: bool) -> None:
        """Add the picture of the surfaces, over the background, to `target`, dimmed where there is glass.

        `textures` are the picture (RGBA), the share that glass lets through (RGB), the positions of the glass, and the
        background. Without `is_seen` the background behind glass is black.
        """
        shader = self._shader
        with target.bind():
            gpu.state.viewport_set(0, 0, textures[0].width, textures[0].height)
            gpu.state.blend_set("ADDITIVE_PREMULT")
            gpu.state.depth_test_set("NONE")
            try:
                shader.bind()
                for name, texture in zip(("behind", "left", "glass", "sky"), textures, strict=True):
                    shader.uniform_sampler(name, texture)
                shader.uniform_float("is_seen", float(is_seen))
                for name, ray in zip(RAYS, view.rays, strict=True):
                    shader.uniform_float(name, (*ray, 1.0))
                self._batch.draw(shader)
            finally:
                gpu.state.blend_set("NONE")


class SampleSum:
    """A picture that holds the sum of the samples."""

    def __init__(self, size: tuple[int, int]):
        self.texture, self._buffers = empty_texture(size), {}

    def within(self, mask: gpu.types.GPUTexture | None = None) -> gpu.types.GPUFrameBuffer:
        """The frame buffer of the picture, with `mask` as its depth buffer."""
        if mask not in self._buffers:
            self._buffers[mask] = frame_buffer(self.texture, mask)
        return self._buffers[mask]

    def clear(self) -> None:
        """Begin a new sum."""
        self.texture.clear(format="FLOAT", value=(0.0, 0.0, 0.0, 0.0))
