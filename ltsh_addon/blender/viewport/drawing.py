"""What all passes draw with: textures, buffers, shaders that run once per pixel, and the state of the graphics card."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...shading.header import source_text

_TRIANGLE = ((-1.0, -1.0), (3.0, -1.0), (-1.0, 3.0))
_INTEGERS = ("INT", "IVEC2", "IVEC4")
# The depth test without a mask and with one: pixels are drawn at the depth 1/2.
WITHIN_MASK = ("NONE", "LESS")


def glsl(name: str) -> str:
    """The text of `glsl/name`.glsl."""
    return source_text(Path(__file__).with_name("glsl") / f"{name}.glsl")


class PixelShader:
    """A shader that runs `source` for every pixel of the viewport; needs an active GPU context.

    `samplers` are the names of its textures, `constants` the types of its push constants by name. Name only those that
    the source uses: the compiler removes others, and setting them is an error. The source writes `color`, or with
    `is_depth` gl_FragDepth.
    """

    def __init__(self, source: str, samplers: Iterable[str], constants: Mapping[str, str], is_depth: bool = False):
        info = gpu.types.GPUShaderCreateInfo()
        info.vertex_in(0, "VEC2", "corner")
        if is_depth:
            info.depth_write("ANY")
        else:
            info.fragment_out(0, "VEC4", "color")
        for name, kind in constants.items():
            info.push_constant(kind, name)
        for slot, name in enumerate(samplers):
            info.sampler(slot, "FLOAT_2D_ARRAY" if name in ("table", "visibility") else "FLOAT_2D", name)
        info.vertex_source(glsl("triangle"))
        info.fragment_source(source)
        self._integers = {name for name, kind in constants.items() if kind in _INTEGERS}
        self._shader = gpu.shader.create_from_info(info)
        self._batch = batch_for_shader(self._shader, "TRIS", {"corner": _TRIANGLE})

    def bind(self, textures: Mapping[str, gpu.types.GPUTexture], constants: Mapping | None = None) -> None:
        """Make this the shader that draws, with `textures` by the names of samplers, and push constants."""
        self._shader.bind()
        for name, texture in textures.items():
            self._shader.uniform_sampler(name, texture)
        self._set(constants or {})

    def draw(self, **constants) -> None:
        """Draw, with new values of these push constants."""
        self._set(constants)
        self._batch.draw(self._shader)

    def _set(self, constants) -> None:
        for name, value in constants.items():
            (self._shader.uniform_int if name in self._integers else self._shader.uniform_float)(name, value)


@contextmanager
def drawing(
    target, rect: tuple[int, int, int, int], blend: str = "NONE", depth: str = "NONE", writes_depth: bool = False
) -> Iterator[None]:
    """Draws within it go into the frame buffer `target` (None: the bound one), to its pixels `rect` (x, y, width,
    height). `blend` and `depth` are the modes of `gpu.state`."""
    with nullcontext() if target is None else target.bind():
        viewport = gpu.state.viewport_get()
        gpu.state.viewport_set(*rect)
        gpu.state.blend_set(blend)
        gpu.state.depth_test_set(depth)
        gpu.state.depth_mask_set(writes_depth)
        try:
            yield
        finally:
            gpu.state.viewport_set(*viewport)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)


def size_of(texture: gpu.types.GPUTexture) -> tuple[int, int]:
    """Width and height in pixels."""
    return texture.width, texture.height


def read_texture(texture: gpu.types.GPUTexture) -> np.ndarray:
    """The values (H, W, 4) of a texture of floats, row 0 at the bottom."""
    buffer = texture.read()
    buffer.dimensions = texture.width * texture.height * 4
    return np.array(buffer, np.float32).reshape(texture.height, texture.width, 4)


def empty_texture(size: tuple[int, int]) -> gpu.types.GPUTexture:
    """RGBA32F texture of zeros; `size` is (width, height)."""
    texture = gpu.types.GPUTexture(size, format="RGBA32F")
    texture.clear(format="FLOAT", value=(0.0, 0.0, 0.0, 0.0))
    return texture


def frame_buffer(color: gpu.types.GPUTexture, depth: gpu.types.GPUTexture | None = None) -> gpu.types.GPUFrameBuffer:
    """A frame buffer of the textures."""
    return gpu.types.GPUFrameBuffer(color_slots=[color], **({} if depth is None else {"depth_slot": depth}))


def float_buffer(values: np.ndarray) -> gpu.types.Buffer:
    """A copy of `values` in float32 for the card."""
    return gpu.types.Buffer("FLOAT", values.size, np.ascontiguousarray(values, np.float32).reshape(-1))


def float_texture(values: np.ndarray) -> gpu.types.GPUTexture:
    """RGBA32F texture of values (H, W, 4), or an array texture of values (N, H, W, 4)."""
    height, width = values.shape[-3:-1]
    layers = values.shape[0] if values.ndim == 4 else 0
    return gpu.types.GPUTexture((width, height), layers=layers, format="RGBA32F", data=float_buffer(values))


def float_table(values: np.ndarray) -> gpu.types.GPUTexture:
    """R32F texture of values (H, W), row 0 first."""
    return gpu.types.GPUTexture(values.shape[::-1], format="R32F", data=float_buffer(values))


def uniform_buffer(values: np.ndarray) -> gpu.types.GPUUniformBuf:
    """A uniform buffer of values (N, 4)."""
    return gpu.types.GPUUniformBuf(float_buffer(values))


@dataclass(frozen=True)
class ViewCamera:
    """The camera of a picture. All positions that are drawn are relative to `origin`."""

    projection: np.ndarray  # (4, 4) to clip space
    eye: np.ndarray  # (3,) position of the eye, or in parallel views the unit direction toward it
    is_parallel: bool
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) in the world

    @classmethod
    def of(cls, view_matrix: Matrix, window_matrix: Matrix, is_parallel: bool) -> ViewCamera:
        """The view of a region with these matrices."""
        to_view = np.array(view_matrix, np.float64)
        to_world = np.linalg.inv(to_view)
        eye = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2]) if is_parallel else to_world[:3, 3]
        return cls(np.array(window_matrix, np.float64) @ to_view, eye, is_parallel)

    def around(self, origin: np.ndarray) -> ViewCamera:
        """The same view of the world, with positions relative to `origin` (3,)."""
        to_world = np.eye(4)
        to_world[:3, 3] = origin - self.origin
        eye = self.eye if self.is_parallel else self.eye - to_world[:3, 3]
        return ViewCamera(self.projection @ to_world, eye, self.is_parallel, origin)

    def shifted(self, offset: np.ndarray, size: tuple[int, int]) -> ViewCamera:
        """The same view, in which pixels show the point `offset` (2,) pixels right and up of their centers.

        `size` is that of the picture in pixels.
        """
        shift = np.eye(4)
        shift[:2, 3] = -2.0 * np.asarray(offset) / size
        return ViewCamera(shift @ self.projection, self.eye, self.is_parallel, self.origin)

    @property
    def rays(self) -> np.ndarray:
        """(3, 3): the change of the eye's ray from the center of the picture to its right end, the change to its upper
        end, and the ray of the center. Rays may have any length."""
        if self.is_parallel:
            return np.stack([np.zeros(3), np.zeros(3), -self.eye])
        back = np.linalg.inv(self.projection)
        corners = (back[:3] - self.eye[:, None] * back[3]).T
        return np.stack([corners[0], corners[1], corners[2] + corners[3]]) / np.linalg.norm(corners[2] + corners[3])

    @property
    def homogeneous_eye(self) -> tuple[float, ...]:
        """The eye's position and 1, or the direction toward it and 0."""
        return (*self.eye, 0.0 if self.is_parallel else 1.0)
