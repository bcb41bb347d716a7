"""The pictures of a view: sums of samples, and the passes that show, copy and join them."""

from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property

import gpu
import numpy as np
from mathutils import Matrix

from ...imaging.denoise import FARTHEST
from ...scene import DEFAULT_TECHNIQUE
from ...shading.header import definitions, filled
from ..process.view import NEAR
from .drawing import PixelShader, ViewCamera, drawing, empty_texture, frame_buffer, glsl, size_of

MODES = ("single", "split", "difference")
TRANSMITTED = "transmitted"  # the passes of what glass shows alone
# RAYS: the shader constants with the rays of `ViewCamera.rays`.
RAYS = ("ray_x", "ray_y", "ray_center")


@dataclass(frozen=True)
class ShownPicture:
    """Which parts of the lighting are shown, and how."""

    technique: str
    passes: str  # combined, specular or diffuse
    mode: str = "single"  # of MODES
    second_technique: str = ""
    split: float = 0.5  # position of the line between 0 and 1
    difference_scale: float = 1.0
    exposure: float = 1.0
    transparent: bool = False
    line_width: float = 1.0
    second_picture: gpu.types.GPUTexture | None = None  # replaces the second technique's picture; without emission
    white: float = 1.0  # brightness that shows no difference, before the scene's own exposure
    also: tuple[tuple[str, str], ...] = ()  # further techniques and passes to draw, for `read`
    world: bool = True  # show the light of the world

    @property
    def takes_rest(self) -> bool:
        """True if Cycles' rest belongs to it: neither to passes alone, nor beside a picture of direct light."""
        return self.passes == "combined" and (self.mode == "single" or self.second_picture is None)

    @property
    def may_be_whole(self) -> bool:
        """True if Cycles' whole picture may stand for it: not for a technique that is chosen for its errors."""
        is_plain = self.mode == "single" and not self.transparent
        return self.takes_rest and is_plain and self.technique == DEFAULT_TECHNIQUE


class PicturePass:
    """Draws one or two pictures into the bound frame buffer; needs an active GPU context."""

    def __init__(self):
        constants = {"mode": "INT", "scales": "VEC4", "opacity": "FLOAT", "white": "FLOAT"}
        constants |= dict.fromkeys(("weights", "size"), "VEC2")
        constants |= dict.fromkeys(RAYS, "VEC4")
        modes = definitions({mode.upper(): number for number, mode in enumerate(MODES)})
        source = modes + glsl("octahedron") + _between("first_picture", "second_picture") + glsl("picture")
        self._shader = PixelShader(source, ("first_picture", "second_picture", "sky"), constants)

    def draw(self, pictures, weights, view: ViewCamera, size, shown: ShownPicture, background) -> None:
        """Fill the bound frame buffer of `size`, scene-linear, from one or two RGBA textures times their `weights`.

        The weighted alpha is the share of a pixel that shows a surface. `background` is a texture of
        `light_texels.background_texels`.
        """
        is_behind = shown.passes == "combined" and not shown.transparent
        constants = {
            "weights": (weights[0], weights[-1]),
            "size": size,
            "mode": MODES.index(shown.mode),
            "scales": (shown.exposure, shown.difference_scale, shown.split * size[0], 0.5 * shown.line_width),
            "opacity": 0.0 if shown.transparent else 1.0,
            "white": shown.white,
            **_rays(view, float(is_behind)),
        }
        textures = {"first_picture": pictures[0], "second_picture": pictures[-1], "sky": background}
        with drawing(None, (0, 0, *size)):
            self._shader.bind(textures, constants)
            self._shader.draw()


def _between(*names: str) -> str:
    """GLSL of vec4 `name`_between(vec2 at) for samplers with these names."""
    return "".join(filled(glsl("between"), {"name": name}) for name in names)


def _rays(view: ViewCamera, is_seen: float) -> dict[str, tuple]:
    """Values of the constants RAYS; with `is_seen` 0 the background is black."""
    return {name: (*ray, is_seen) for name, ray in zip(RAYS, view.rays, strict=True)}


def copy_shader() -> PixelShader:
    """The shader of `copy`."""
    return PixelShader("void main() { color = texelFetch(picture, ivec2(gl_FragCoord.xy), 0); }", ("picture",), {})


def copy(
    shader: PixelShader, picture: gpu.types.GPUTexture, target: gpu.types.GPUFrameBuffer, blend: str = "NONE"
) -> None:
    """Copy `picture` into `target`, which has its size, by `copy_shader`."""
    with drawing(target, (0, 0, *size_of(picture)), blend):
        shader.bind({"picture": picture})
        shader.draw()


@dataclass(frozen=True)
class ShownRest:
    """What Cycles adds to a view (see `viewport.rest`), as it was rendered for some view."""

    texture: gpu.types.GPUTexture  # RGBA, row 0 at the bottom; alpha is `process.view.marked_depth`
    view: ViewCamera
    is_everything: bool = False  # it is the whole picture
    ambient: tuple = (0.0, 0.0, 0.0)  # a guess of it over the colors of surfaces, where it is not known
    light: np.ndarray | None = None  # the mean (3,) of the direct light that belongs to it; None: that of the picture
    whole: gpu.types.GPUTexture | None = None  # RGB, with the direct light; None: not of what is shown
    whole_errs_less: bool = False  # than the view's own picture with few points of pixels and coarse shadows

    def is_of(self, view: ViewCamera) -> bool:
        """True if it was rendered for this very view."""
        return np.array_equal(self.view.projection, view.projection)


class RestPass:
    """Draws a picture with its rest; needs an active GPU context. Its shaders compile when they are first used."""

    @cached_property
    def _shader(self) -> PixelShader:
        samplers = ("picture", "of_cycles", "rest", "whole", "positions", "front_positions")
        samplers += "diffuse_colors", "specular_colors"
        constants = {"projection": "MAT4", "whole_share": "FLOAT", **dict.fromkeys(("scale", "ambient"), "VEC4")}
        constants |= dict.fromkeys(("has_moved", "is_parallel"), "INT")
        source = definitions({"FARTHEST": FARTHEST, "NEAR": NEAR}) + _between("rest") + glsl("rest")
        return PixelShader(source, samplers, constants)

    @cached_property
    def _given(self) -> PixelShader:
        return PixelShader(glsl("given"), ("picture", "share"), {"weight": "FLOAT"})

    def add_given(self, sums: "list[SampleSum]", share: "SampleSum", targets: "list[SampleSum]", weight: float) -> None:
        """Add to `targets` what a sample has of what is Cycles' alone, its `share` of pixels: call it with the `sums`
        before the sample and `weight` -1, then with those after it and 1."""
        for each, target in zip(sums, targets, strict=True):
            with drawing(target.within(), (0, 0, *each.size), "ADDITIVE_PREMULT"):
                self._given.bind({"picture": each.texture, "share": share.texture}, {"weight": weight})
                self._given.draw()

    def draw(self, textures: dict, weight: float, rest: ShownRest, view: ViewCamera, scale, whole_share: float):
        """The picture (RGBA texture, valid until the next call with the same `picture`) with the `rest`.

        `textures` are by the names of the samplers: `picture` and `of_cycles`, the sum by `add_given`, which count
        times `weight`; positions and colors of the surfaces, and positions of glass before them. The rest counts times
        `scale` (3,). Cycles' whole picture has the share `whole_share` of the result.
        """
        size = size_of(textures["picture"])
        target = SampleSum(size)
        constants = {
            "projection": Matrix(rest.view.projection.tolist()),
            "scale": (*scale, weight),
            "ambient": (*rest.ambient, float(rest.is_everything)),
            "has_moved": not rest.is_of(view),
            "is_parallel": rest.view.is_parallel,
            "whole_share": whole_share,
        }
        with drawing(target.within(), (0, 0, *size)):
            self._shader.bind({**textures, "rest": rest.texture, "whole": rest.whole or rest.texture}, constants)
            self._shader.draw()
        return target.texture


class VeilPass:
    """Draws what is behind glass; needs an active GPU context."""

    def __init__(self):
        constants = {"is_seen": "FLOAT", "beside": "FLOAT", **dict.fromkeys(RAYS, "VEC4")}
        self._shader = PixelShader(glsl("octahedron") + glsl("veil"), ("behind", "left", "glass", "sky"), constants)

    def draw(self, textures: dict[str, gpu.types.GPUTexture], target, view: ViewCamera, passes: str) -> None:
        """Add the picture of the surfaces, over the background, to `target`, dimmed where there is glass.

        `textures` are `behind`, the picture (RGBA); `left`, the share that glass lets through (RGB); `glass`, its
        positions; `sky`, the background. Glass is black in `passes` of reflected light; beside glass TRANSMITTED is.
        """
        with drawing(target, (0, 0, *size_of(textures["behind"])), "ADDITIVE_PREMULT"):
            seen = {"is_seen": float(passes in ("combined", TRANSMITTED)), "beside": float(passes != TRANSMITTED)}
            self._shader.bind(textures, {**seen, **_rays(view, 1.0)})
            self._shader.draw()


class SampleSum:
    """A picture that holds the sum of the samples."""

    def __init__(self, size: tuple[int, int]):
        self.size, self.texture, self._buffers = size, empty_texture(size), {}

    def within(self, mask: gpu.types.GPUTexture | None = None) -> gpu.types.GPUFrameBuffer:
        """The frame buffer of the picture, with `mask` as its depth buffer."""
        if mask not in self._buffers:
            self._buffers[mask] = frame_buffer(self.texture, mask)
        return self._buffers[mask]

    def clear(self) -> None:
        """Begin a new sum."""
        self.texture.clear(format="FLOAT", value=(0.0, 0.0, 0.0, 0.0))


# With more lights, telling which of them have changed takes longer than it saves.
MOST_COMPARED = 512


@dataclass(frozen=True)
class LightingState:
    """What lit a picture: state of surfaces and view (see `same_state`), lights, and sources of their visibility."""

    state: tuple
    lights: tuple
    sources: tuple

    def changes(self, new: "LightingState") -> frozenset[int] | None:
        """Numbers of the lights that are others in the picture `new`; None where more has changed."""
        count = len(self.lights)
        if not same_state(new.state, self.state) or len(new.lights) != count or count > MOST_COMPARED:
            return None
        pairs = zip(self.lights, new.lights, strict=True)
        return frozenset(number for number, (a, b) in enumerate(pairs) if not is_equal(a, b))

    def has_same_visibility(self, new: "LightingState", changed: frozenset[int]) -> bool:
        """True if the visibility is the same, but for that of the lights `changed`."""
        if len(self.sources) != len(new.sources):
            return False
        static = [number for number in range(len(self.sources)) if number not in changed]
        return all(a is b for number in static for a, b in zip(self.sources[number], new.sources[number], strict=True))


def is_equal(a, b) -> bool:
    """True for lights that look the same, occluders, and their parts: tuples, arrays, cones, words and numbers."""
    if a is b or type(a) is not type(b):
        return a is b
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(is_equal, a, b))
    if not is_dataclass(a):
        return np.array_equal(a, b)
    names = (item.name for item in fields(a) if item.name not in ("children", "faces"))
    return all(is_equal(getattr(a, name), getattr(b, name)) for name in names)


@dataclass(frozen=True)
class StaticLighting:
    """The light of all lights but the `moving` ones, kept while these change."""

    lit: LightingState
    moving: frozenset[int]
    pictures: list[SampleSum]

    def fits(self, new: LightingState) -> bool:
        """True if it is a part of the picture `new`."""
        changes = self.lit.changes(new)
        return changes is not None and changes <= self.moving and self.lit.has_same_visibility(new, self.moving)


def same_state(new, old) -> bool:
    """True if two states have identical objects of the scene, their first part, and equal values, their second."""
    return old is not None and new[1] == old[1] and all(a is b for a, b in zip(new[0], old[0], strict=True))
