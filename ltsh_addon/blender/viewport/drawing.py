"""What all passes draw with: textures, buffers, the G-buffer, shaders that run once per pixel, and the state of
the graphics card."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...scene import SurfaceSamples
from ...shading.header import filled, source_text

_TRIANGLE = ((-1.0, -1.0), (3.0, -1.0), (-1.0, 3.0))
_INTEGERS = ("INT", "IVEC2", "IVEC4")
# The depth test without a mask and with one. In a mask pixels have the depth 0 where there is no surface, 1 where it is
# anisotropic, 3/4 or 1 elsewhere. Shaders draw at 1/2, those of anisotropic lobes at 7/8: cards skip the others.
WITHIN_MASK = ("NONE", "LESS")


def glsl(name: str) -> str:
    """The text of `glsl/name`.glsl."""
    return source_text(Path(__file__).with_name("glsl") / f"{name}.glsl")


# Compiled shaders by what they are made from: all views of a session share them.
_compiled: dict[tuple, object] = {}
_deadline, _is_due = [math.inf], [False]  # see `new_shaders_until`; is the next one compiled in any case?


SLOW_SECONDS = 0.05  # of one image


class ShadersMissing(Exception):
    """Shaders or images are missing that the next drawing makes."""


@contextmanager
def new_shaders_until(moment: float) -> Iterator[None]:
    """Within this, once the `moment` has passed (in `time.monotonic`), missing shaders raise ShadersMissing, in turn
    after and before they are compiled: a drawing that compiles one uses none of which drivers compile more then."""
    _deadline[0] = moment
    try:
        yield
    finally:
        _deadline[0] = math.inf


def compiled(key: tuple, make: Callable):
    """What `make()` compiles, once for each `key`; needs an active GPU context. Raises ShadersMissing."""
    if key not in _compiled:
        if time.monotonic() > _deadline[0] and not _is_due[0]:
            _is_due[0] = True
            raise ShadersMissing
        _compiled[key], _is_due[0] = make(), False
        if time.monotonic() > _deadline[0]:
            raise ShadersMissing
    return _compiled[key]


def pause_if_slow(started: float) -> None:
    """Where drawings may be left to the next one (see `new_shaders_until`), and what was `started` then took so long
    that the window should answer, raise ShadersMissing."""
    if _deadline[0] != math.inf and time.monotonic() > max(started + SLOW_SECONDS, _deadline[0]):
        raise ShadersMissing


def forget_shaders() -> None:
    """Free the shaders that no view has any more."""
    _compiled.clear()


class PixelShader:
    """A shader that runs `source` for every pixel of the viewport; needs an active GPU context.

    `samplers` are the names of its textures, `constants` the types of its push constants by name. Name only those that
    the source uses: the compiler removes others, and setting them is an error. The source writes `color`, or with
    `is_depth` gl_FragDepth. With `is_brushed` it runs for the pixels of anisotropic surfaces, see WITHIN_MASK.
    """

    def __init__(
        self,
        source: str,
        samplers: Sequence[str],
        constants: Mapping[str, str],
        *,
        is_depth: bool = False,
        is_brushed: bool = False,
    ):
        self._integers = {name for name, kind in constants.items() if kind in _INTEGERS}
        key = source, *samplers, *constants.items(), is_depth, is_brushed
        self._shader, self._batch = compiled(key, lambda: _pixel_shader(source, samplers, constants, key[-2:]))

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


def _pixel_shader(source, samplers, constants, traits) -> tuple:
    """The shader and the batch of a `PixelShader`; `traits` are is_depth and is_brushed."""
    is_depth, is_brushed = traits
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
    info.vertex_source(filled(glsl("triangle"), {"Z": "0.75" if is_brushed else "0.0"}))
    info.fragment_source(source)
    shader = gpu.shader.create_from_info(info)
    return shader, batch_for_shader(shader, "TRIS", {"corner": _TRIANGLE})


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
    """The camera of a picture."""

    projection: np.ndarray  # (4, 4) to clip space
    eye: np.ndarray  # (3,) position of the eye, or in parallel views the unit direction toward it
    is_parallel: bool

    @classmethod
    def of(cls, view_matrix: Matrix, window_matrix: Matrix, is_parallel: bool) -> "ViewCamera":
        """The view of a region with these matrices."""
        to_view = np.array(view_matrix, np.float64)
        to_world = np.linalg.inv(to_view)
        eye = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2]) if is_parallel else to_world[:3, 3]
        return cls(np.array(window_matrix, np.float64) @ to_view, eye, is_parallel)

    def shifted(self, offset: np.ndarray, size: tuple[int, int]) -> "ViewCamera":
        """The same view, in which pixels show the point `offset` (2,) pixels right and up of their centers.

        `size` is that of the picture in pixels.
        """
        shift = np.eye(4)
        shift[:2, 3] = -2.0 * np.asarray(offset) / size
        return ViewCamera(shift @ self.projection, self.eye, self.is_parallel)

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


# Fields of `GBufferTextures` by their names in shaders.
SAMPLERS = {
    "positions": "position",
    "normals": "normal",
    "bases": "base",
    "f0s": "f0",
    "f90s": "f90",
    "dielectric_weights": "dielectric",
    "geometric_normals": "geometric_normal",
    "diffuse_normals": "diffuse_normal",
    "smooth_normals": "smooth_normal",
    "tangents": "tangent",
    "rebounds": "rebound",
}
# Fields of `VisibilityGrid` by their names in shaders.
VISIBILITY_SAMPLERS = {"visibility": "visibility", "grid_positions": "positions"}


@dataclass(frozen=True)
class VisibilityGrid:
    """The visible fraction of each light at the points of a picture. Other pictures of the same surfaces may use it."""

    visibility: gpu.types.GPUTexture  # RG, a layer for each light: the specular and the diffuse fraction
    positions: gpu.types.GPUTexture  # of the points; w = 0 where there is no surface
    projection: np.ndarray  # (4, 4) to the clip space that the texels fill
    sources: tuple = ()  # of each layer: a layer whose source is the same object is the same


@dataclass(frozen=True)
class GBufferTextures:
    """The surface points of a picture as textures of one size, with the fields of `scene.SurfaceSamples`.

    RGBA32F, one texel per pixel, row 0 at the bottom. A texture may be None where its default holds everywhere.
    """

    position: gpu.types.GPUTexture  # in the world, m; w = 1 + receiver, 0 where there is no surface
    normal: gpu.types.GPUTexture  # shading normal of the specular lobe; w = roughness
    base: gpu.types.GPUTexture  # diffuse albedo; w = index of refraction of the dielectric lobe
    f0: gpu.types.GPUTexture  # specular_f0; w = red of specular_dip
    f90: gpu.types.GPUTexture  # specular_f90; w = green of specular_dip
    dielectric: gpu.types.GPUTexture  # weight of the dielectric lobe; w = blue of specular_dip
    geometric_normal: gpu.types.GPUTexture | None = None  # w is not read; None: `normal`
    diffuse_normal: gpu.types.GPUTexture | None = None  # w = bump_alpha2; None: `normal`, bump_alpha2 0
    smooth_normal: gpu.types.GPUTexture | None = None  # w is not read; None: `diffuse_normal`
    tangent: gpu.types.GPUTexture | None = None  # of anisotropic lobes; w = anisotropy; None: 0
    rebound: gpu.types.GPUTexture | None = None  # diffuse_rebound; w = diffuse_roughness; None: 0
    visibility: VisibilityGrid | None = None  # None: every light is seen whole
    mask: gpu.types.GPUTexture | None = None  # depth buffer, see WITHIN_MASK; None: all pixels are lit
    has_sheen: bool = False  # there are texels of sheen: base.w = -sheen_a, normal.w = sheen_b
    has_velvet: bool = False  # there are texels of velvet: rebound.w = -sigma, rebound.rgb = albedo
    has_bent: bool = False  # there are dielectrics with an index of refraction between 0 and 1

    def __post_init__(self):
        if self.diffuse_normal is None and self.smooth_normal is not None:
            raise ValueError("G-buffer: smooth_normal without diffuse_normal, expected both")
        sizes = {
            field.name: (texture.width, texture.height)
            for field in fields(self)
            if not field.name.startswith("has_")
            and field.name != "visibility"
            and (texture := getattr(self, field.name)) is not None
        }
        if len(set(sizes.values())) != 1:
            raise ValueError(f"G-buffer: textures have the sizes {sizes}, expected one size for all")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.position.width, self.position.height


def every_texel(texture: gpu.types.GPUTexture, step: int) -> np.ndarray:
    """Every `step`-th texel (H, W, 4) in either direction."""
    return np.ascontiguousarray(read_texture(texture)[step // 2 :: step, step // 2 :: step])


def gbuffer_texels(gbuffer: GBufferTextures, step: int = 1) -> dict[str, np.ndarray]:
    """Every `step`-th texel of a G-buffer, (H, W, 4) by name of the texture."""
    textures = {name: getattr(gbuffer, name) for name in (*_REQUIRED, *_OPTIONAL)}
    return {name: every_texel(texture, step) for name, texture in textures.items() if texture is not None}


_REQUIRED = ("position", "normal", "base", "f0", "f90", "dielectric")
_OPTIONAL = ("diffuse_normal", "smooth_normal", "geometric_normal", "tangent", "rebound")


def samples_of_texels(texels: dict[str, np.ndarray], view: ViewCamera) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples (P) of a G-buffer by its `gbuffer_texels`, and their texels (P,), counted from the lower left."""
    pixel = np.flatnonzero(texels["position"][:, :, 3] > 0.0)
    values = {name: rows.reshape(-1, 4)[pixel].astype(np.float64) for name, rows in texels.items()}
    position, normal, base, f0, f90, dielectric = (values[name] for name in _REQUIRED)
    further = {name: values.get(name) for name in _OPTIONAL}
    bent, fuzzy = further["diffuse_normal"], base[:, 3] < 0.0
    tangent, rebound = further["tangent"], further["rebound"]
    return SurfaceSamples(
        position=position[:, :3],
        view=np.broadcast_to(view.eye, (len(pixel), 3)) if view.is_parallel else unit_xyz(view.eye - position[:, :3]),
        normal=unit_xyz(normal),
        diffuse_normal=unit_xyz(normal if bent is None else bent),
        roughness=np.where(fuzzy, 1.0, normal[:, 3]),
        specular_f0=f0[:, :3],
        specular_f90=f90[:, :3],
        dielectric=dielectric[:, :3],
        ior=np.where(fuzzy, 1.5, base[:, 3]),
        sheen_a=np.where(fuzzy, -base[:, 3], 0.0 if rebound is None else np.minimum(rebound[:, 3], 0.0)),
        sheen_b=np.where(fuzzy, normal[:, 3], 0.0),
        diffuse_albedo=base[:, :3],
        diffuse_roughness=None if rebound is None else np.maximum(rebound[:, 3], 0.0),
        diffuse_rebound=None if rebound is None else rebound[:, :3],
        geometric_normal=_unit_or_none(further["geometric_normal"]),
        smooth_normal=_unit_or_none(further["smooth_normal"]),
        bump_alpha2=None if bent is None else bent[:, 3],
        specular_dip=np.stack([f0[:, 3], f90[:, 3], dielectric[:, 3]], axis=1),
        receiver=np.rint(position[:, 3]).astype(np.int64) - 1,
        anisotropy=None if tangent is None else tangent[:, 3],
        tangent=None if tangent is None else tangent[:, :3],
    ), pixel


def unit_xyz(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors of the first three columns; zero vectors stay zero."""
    vectors = vectors[:, :3]
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def _unit_or_none(vectors: np.ndarray | None) -> np.ndarray | None:
    return None if vectors is None else unit_xyz(vectors)
