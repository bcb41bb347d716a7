"""One frame of a view: G-buffer, lighting, picture.

Only what has changed is drawn again. While nothing changes, every further frame adds another point of each pixel, and
the picture is their mean.
"""

import math
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import gpu
import numpy as np

from ...scene import PASSES
from .drawing import GBufferTextures, PixelShader, ViewCamera, VisibilityGrid, float_texture, read_texture, size_of
from .light_texels import UploadedLights, background_texels, sky_texels, upload_lights
from .lighting import GOLDEN, HorizonPass, LightingPass
from .mirror import SceneMirror
from .pictures import (
    TRANSMITTED,
    LightingState,
    PicturePass,
    RestPass,
    SampleSum,
    ShownPicture,
    StaticLighting,
    VeilPass,
    copy,
    copy_shader,
    same_state,
)
from .shadow_rays import ShadowRays
from .shadows import FIRST_POINTS, LiveShadows
from .surfaces import SurfacePass, has_bent_lobes


class SurfaceLayer:
    """The G-buffer of one layer, surfaces or glass, and the horizons that end its lobes."""

    def __init__(self, before: "SurfaceLayer | None" = None):
        self._surfaces = SurfacePass(None if before is None else before._surfaces)
        self._horizons = defaultdict(HorizonPass)  # of the first lobes (False), which stay, and of further ones (True)
        self._gbuffer: GBufferTextures | None = None
        self._first_lobe: GBufferTextures | None = None
        self._further_lobe: tuple[int, GBufferTextures | None] = (0, None)  # the last, before its horizons
        self.smooth_normal: gpu.types.GPUTexture | None = None  # of the lobe that is lit
        self.visibility: VisibilityGrid | None = None  # of the lights from all lobes
        self.threshold = 0.5  # see `HorizonPass.draw`
        self.through, self.add_emission = self._surfaces.through, self._surfaces.add_emission
        self.add_share_of_cycles = self._surfaces.add_share_of_cycles

    @property
    def position(self) -> gpu.types.GPUTexture:
        """The positions of the surfaces drawn last."""
        return self._gbuffer.position

    @property
    def colors(self) -> dict[str, gpu.types.GPUTexture]:
        """The colors of their first lobes."""
        return {"diffuse_colors": self._gbuffer.base, "specular_colors": self._gbuffer.f0}

    def draw(self, mirror, view: ViewCamera, size, points: float) -> None:
        """Draw the surfaces, see `SurfacePass.draw`."""
        self._first_lobe, self._further_lobe = None, (0, None)
        self._gbuffer = self._surfaces.draw(mirror.instances, view, size, points)

    def choose_horizons(self, mirror, view: ViewCamera, lights: UploadedLights) -> None:
        """Choose the horizons of specular lobes as Cycles does; diffuse lobes keep a second one only if they need it.

        Only bump-mapped and translucent looks need it.
        """
        self._first_lobe = None
        self._first_lobe = self._with_horizons(self._gbuffer, False, mirror, view, lights)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self._gbuffer.size

    @property
    def is_ready(self) -> bool:
        """True if the horizons are chosen."""
        return self._first_lobe is not None

    def lobe(self, number: int, mirror, view: ViewCamera, lights: UploadedLights) -> GBufferTextures:
        """The G-buffer of the lobes `number`, with their horizons; valid until the next call."""
        if number == 0:
            self.smooth_normal = self._gbuffer.smooth_normal
            return self._first_lobe
        if self._further_lobe[0] != number:
            self._further_lobe = number, self._surfaces.draw_lobe(number, mirror.instances, view)
        return self._with_horizons(self._further_lobe[1], True, mirror, view, lights)

    def _with_horizons(self, gbuffer, is_further: bool, mirror, view: ViewCamera, lights) -> GBufferTextures:
        self.smooth_normal = gbuffer.smooth_normal
        if gbuffer.geometric_normal is None:
            return gbuffer
        horizon = self._horizons[is_further].draw(gbuffer, lights, view.homogeneous_eye, self.threshold)
        smooth_normal = gbuffer.smooth_normal if has_bent_lobes(mirror.instances) else None
        return replace(gbuffer, geometric_normal=horizon, smooth_normal=smooth_normal)


# CENTERS: the points of pixels of a single frame, their centers, in pixels right and up of them.
CENTERS = np.zeros((1, 2))


@dataclass(frozen=True)
class Frame:
    """What a frame draws."""

    mirror: SceneMirror
    view: ViewCamera
    size: tuple[int, int]
    pictures: tuple[tuple[str, str], ...]  # technique and passes of each
    with_emission: bool  # of surfaces and background, in combined pictures
    world: bool  # with the light of the world

    @classmethod
    def of(cls, mirror: SceneMirror, view: ViewCamera, size: tuple[int, int], shown: ShownPicture) -> "Frame":
        """The frame that has the picture `shown`."""
        pictures = [(shown.technique, shown.passes)]
        if shown.mode != "single" and shown.second_picture is None:
            pictures.append((shown.second_technique, shown.passes))
        return cls(mirror, view, size, (*pictures, *shown.also), shown.second_picture is None, shown.world)

    @property
    def surfaces(self) -> tuple[tuple, tuple]:
        """The state that the G-buffers depend on, see `same_state`."""
        view = self.view
        key = view.projection.tobytes(), view.eye.tobytes(), view.is_parallel, self.size
        return (self.mirror,), (self.mirror.surfaces_version, *key)

    @property
    def content(self) -> tuple:
        """Which pictures there are, and of what."""
        return self.pictures, self.with_emission, self.world


# Of each point of the pixels, for `ViewRenderer.keeps_points`.
_OF_POINTS = ("_surfaces", "_glass", "_drawn", "_horizons_of", "_static", "_lighting_state")


class ViewRenderer:
    """The GPU's side of one view; needs an active GPU context."""

    def __init__(self):
        self._surfaces = SurfaceLayer()
        self._glass: SurfaceLayer | None = None
        self._picture = PicturePass()
        self._veil: VeilPass | None = None
        self._lighting: dict[str, LightingPass] = {}
        self._sums: list[SampleSum] = []  # of the pictures
        self._behind: list[SampleSum] = []  # what is lit behind glass
        self._parts: list[SampleSum] = []  # the lights of passes that several pictures have
        self._lights, self._horizons_of = None, None  # UploadedLights | None
        self._drawn, self._uploaded = None, (None, None)
        self._shown, self.samples = None, 0  # the state of the pictures, and the number of their points
        self._lighting_state: LightingState | None = None
        self._static: StaticLighting | None = None
        # Where lights alone have changed, the first picture has the others' light of before: the pictures are split.
        self.may_split, self._is_split = True, False
        # For further frames: keep all points of pixels apart, so that what has not changed in each is not drawn again.
        self.keeps_points, self._points, self._point = False, {}, 0
        self._sky, self._sky_light, self._background = None, None, None
        self.step = 1  # pixels in either direction for which one is drawn, as while a view moves
        self._size = (1, 1)  # of what is shown
        self.shadows: ShadowRays | LiveShadows | None = None
        # Pictures get a rest, and this one as soon as there is one; `_of_cycles`: their light of what is Cycles' alone.
        self.has_bounces, self.rest = False, None  # bool, ShownRest | None
        self.shows_whole = False  # Cycles' picture stands for the view's own
        self._rest_pass = RestPass()
        self._share: list[SampleSum] = []  # of the last sample
        self._of_cycles: list[SampleSum] = []

    def draw(
        self, mirror: SceneMirror, view: ViewCamera, size: tuple[int, int], shown: ShownPicture, target, points=CENTERS
    ) -> None:
        """Draw the scene into the frame buffer `target`, which has `size` pixels.

        The first call shows pixels at the first of `points` (N, 2), in pixels right and up of their centers. While
        nothing changes, every further call adds the next point. The picture is their mean; `samples` is their number.
        Of `step` pixels in either direction one is computed, and what is between them is interpolated.

        Where only some lights have changed, the others are not drawn again: their light keeps the horizons that were
        chosen before. The next call without a change begins anew with all lights.
        """
        self._size = size
        frame = Frame.of(mirror, view, tuple(-(-side // self.step) for side in size), shown)
        self._upload_sky(mirror)
        version = None
        if self.shadows is not None:
            self.shadows.shown = size
            self.shadows.take_news()
            version = self.shadows.version
        values = *frame.surfaces[1], frame.content, version, self.has_bounces
        state = (mirror, mirror.lights, mirror.sky, self.shadows), values
        is_same = same_state(state, self._shown)
        if not is_same or (self._is_split and not self.keeps_points):
            self.samples = 0
        if self.samples < len(points):
            self._shown = None  # until the sample is complete
            lit_by = None
            if self.keeps_points or (self.may_split and not is_same):
                lit_by = (mirror, mirror.sky, self.shadows), (*frame.surfaces[1], frame.content)
            sample = replace(frame, view=frame.view.shifted(points[self.samples], size))
            is_drawn = self._draw_sample(sample, lit_by)
            self._shown, self.samples = state, self.samples + is_drawn
        count = len(frame.pictures) - len(shown.also)
        self._show(range(count), frame.view, shown, target)

    def show(self, number: int, view: ViewCamera, shown: ShownPicture, target) -> None:
        """Draw the picture `number` of those drawn last, as `draw` does; `shown` must have its passes."""
        self._show([number], view, shown, target)

    def _whole_share(self, shown: ShownPicture) -> float:
        """The share of Cycles' whole picture in what is shown. Where it errs less than few points of pixels and coarse
        shadows, it gives way with every point under fine ones."""
        if not (self._has_whole(shown) and self.rest.whole_errs_less):
            return 0.0
        if self.step > 1:
            return 1.0
        if size_of(self.rest.whole) != self._size:
            return 0.0
        return max(1.0 - self.samples / FIRST_POINTS, 0.0) if self.shadows.is_fine else 1.0

    def _has_whole(self, shown: ShownPicture) -> bool:
        has_one = self.has_bounces and self.rest is not None and self.rest.whole is not None
        return has_one and self.shadows is not None and shown.may_be_whole

    def show_whole(self, view: ViewCamera, shown: ShownPicture, target) -> bool:
        """Show Cycles' whole picture where there is one, after a `draw` that failed; False where there is none."""
        if self._has_whole(shown):
            with target.bind():
                self._picture.draw([self.rest.whole], [1.0], view, self._size, shown, self._background)
        return self._has_whole(shown)

    def _show(self, numbers, view, shown, target) -> None:
        whole_share = self._whole_share(shown)
        self.shows_whole = whole_share == 1.0
        pictures, weights = [self._sums[number].texture for number in numbers], [1.0 / self.samples] * len(numbers)
        if self.shows_whole:
            pictures, weights = [self.rest.whole], [1.0]
        elif self.has_bounces and self.rest is not None and shown.takes_rest:
            pictures, weights = [self._with_rest(one, view, whole_share) for one in numbers], [1.0] * len(pictures)
        if shown.mode != "single" and shown.second_picture is not None:
            pictures, weights = [*pictures, shown.second_picture], [*weights, 1.0]
        # The sample has bound other buffers, and Blender's own binding is unknown to Python.
        with target.bind():
            self._picture.draw(pictures, weights, view, self._size, shown, self._background)

    def _with_rest(self, number: int, view: ViewCamera, whole_share: float) -> gpu.types.GPUTexture:
        """The mean of a picture's samples with the rest."""
        front = self._surfaces if self._glass is None or not self._has_glass else self._glass
        textures = {"picture": self._sums[number].texture, "of_cycles": self._of_cycles[number].texture}
        textures |= {"positions": self._surfaces.position, "front_positions": front.position, **self._surfaces.colors}
        scale, light = np.ones(3), self.rest.light
        if light is not None:
            scale = np.divide(self.mean_light(), light, out=scale, where=light > 0.0)
        return self._rest_pass.draw(textures, 1.0 / self.samples, self.rest, view, scale, whole_share)

    def wait(self) -> None:
        """Wait until the card has finished the picture."""
        # Blender knows the size of a buffer only once it has been bound.
        with (buffer := self._sums[0].within()).bind():
            buffer.read_color(0, 0, 1, 1, 4, 0, "FLOAT")

    def mean_light(self) -> np.ndarray:
        """The mean (3,) of some pixels of the last picture."""
        return self.read()[2::5, 2::5, :3].mean(axis=(0, 1), dtype=np.float64)

    def _draw_sample(self, frame: Frame, state: tuple | None) -> bool:
        """Add one point of every pixel to the pictures; the first point replaces them.

        The first point may keep the light of lights that have not changed, in the same `state`; None: it may not.
        Returns False where nothing was drawn because its shadows are not ready.
        """
        if self.keeps_points:
            self._take_point()
        else:
            self._points.clear()
        layers = self._draw_surfaces(frame)
        if not self._trace(layers, frame):
            return False
        self._sums = _cleared(self._sums, frame, self.samples == 0)
        if self.has_bounces:
            self._of_cycles = _cleared(self._of_cycles, frame, self.samples == 0)
            self._share = _cleared(self._share, replace(frame, pictures=frame.pictures[:1]), True)
            for layer in layers:
                layer.add_share_of_cycles(frame.mirror.instances, frame.view, self._share[0].within())
            if self.samples > 0:
                self._rest_pass.add_given(self._sums, self._share[0], self._of_cycles, -1.0)
        self._light_layers(layers, frame, state)
        if self.has_bounces:
            self._rest_pass.add_given(self._sums, self._share[0], self._of_cycles, 1.0)
        return True

    def _light_layers(self, layers: list[SurfaceLayer], frame: Frame, state: tuple | None) -> None:
        """Add the light of the sample to the pictures."""
        if len(layers) == 1:
            self._light_surfaces(frame, self._sums, state)
            self._add_emission(self._surfaces, frame, self._sums)
            return
        self._behind = _cleared(self._behind, frame, True)
        behind = [(technique, "combined" if passes == TRANSMITTED else passes) for technique, passes in frame.pictures]
        behind = replace(frame, pictures=tuple(behind))
        self._light_surfaces(behind, self._behind, state)
        self._add_emission(self._surfaces, behind, self._behind)
        textures = {
            "left": self._glass.through(frame.mirror.instances, frame.view),
            "glass": self._glass.lobe(0, frame.mirror, frame.view, self._lights).position,
            "sky": self._background,
        }
        for picture, target, (_, passes) in zip(self._behind, self._sums, frame.pictures, strict=True):
            shown = passes if frame.with_emission or passes != "combined" else "diffuse"
            self._veil.draw({"behind": picture.texture, **textures}, target.within(), frame.view, shown)
        front = [pair for pair in zip(frame.pictures, self._sums, strict=True) if pair[0][1] != TRANSMITTED]
        frame, sums = replace(frame, pictures=tuple(pair[0] for pair in front)), [pair[1] for pair in front]
        self._light(self._glass, frame, sums, "ADDITIVE")
        self._add_emission(self._glass, frame, sums)

    def _take_point(self) -> None:
        """Take the layers of the next point, and keep those of the last one."""
        self._points[self._point] = {name: getattr(self, name) for name in _OF_POINTS}
        fresh = {"_surfaces": SurfaceLayer(), **dict.fromkeys(_OF_POINTS[1:])}
        self._point = self.samples
        vars(self).update(self._points.get(self._point) or fresh)

    def _draw_surfaces(self, frame: Frame) -> list[SurfaceLayer]:
        """The layers, surfaces and glass, with G-buffers and horizons; drawn again if anything has changed."""
        has_glass, is_drawn = frame.mirror.has_glass, same_state(frame.surfaces, self._drawn)
        self._has_glass = has_glass
        if not is_drawn:
            self._drawn = None
            # Points of pixels add up to a picture only with lobes as narrow as they are.
            points = 1 if self.step > 1 else math.inf
            self._surfaces.draw(frame.mirror, frame.view, frame.size, points)
            if has_glass:
                if self._glass is None:
                    self._glass, self._veil = SurfaceLayer(self._surfaces), VeilPass()
                self._glass.draw(frame.mirror, frame.view, frame.size, points)
            self._drawn = frame.surfaces
        self._upload_lights(frame)
        is_lit, self._horizons_of = self._horizons_of is self._lights, self._lights
        layers = [self._surfaces, self._glass] if has_glass else [self._surfaces]
        for layer in layers:
            layer.threshold = (0.5 + self.samples * GOLDEN) % 1.0
            if not (is_drawn and is_lit and layer.is_ready):
                layer.choose_horizons(frame.mirror, frame.view, self._lights)
        return layers

    def _trace(self, layers: list[SurfaceLayer], frame: Frame) -> bool:
        """Give the layers the visibility of the lights that all their lobes use; False if it is not ready."""
        for layer in layers:
            layer.visibility = None
            if self.shadows is not None and not self.shadows.traces_lobes:
                first = layer.lobe(0, frame.mirror, frame.view, self._lights)
                layer.visibility = self._visibility(layer, first, frame)
                if self.shadows.waits:
                    return False
        return True

    def _upload_sky(self, mirror) -> None:
        """Upload the world's light and background if they have changed."""
        if self._sky is mirror.sky:
            return
        self._sky = sky = mirror.sky
        self._sky_light = float_texture(sky_texels(sky)) if sky.sides else None
        self._background = float_texture(background_texels(sky))

    def _upload_lights(self, frame: Frame) -> None:
        """Upload the lights if they have changed."""
        lights = frame.mirror.lights if frame.world else frame.mirror.lights_without_world
        sky = self._sky_light if frame.world else None
        if self._uploaded[0] is not lights or self._uploaded[1] is not sky:
            self._lights, self._uploaded = upload_lights(lights, sky), (lights, sky)

    def _visibility(self, layer: SurfaceLayer, gbuffer: GBufferTextures, frame: Frame) -> VisibilityGrid | None:
        """The visibility of the lights from the lobe `gbuffer` of a layer."""
        shadows = self.shadows.of_glass if layer is self._glass else self.shadows
        sides = () if self._lights.sky is None else frame.mirror.sky.sides
        gbuffer = replace(gbuffer, smooth_normal=layer.smooth_normal)
        return shadows.visibility(gbuffer, frame.view, self._lights.lights, sides, self.samples)

    def _light_surfaces(self, frame: Frame, targets: list[SampleSum], state: tuple | None) -> None:
        """Light the surfaces as `_light` does; with a `state` (see `_draw_sample`) perhaps only by what has changed."""
        layer, lights = self._surfaces, self._lights.lights
        self._is_split = False
        is_further = self.samples > 0 and not self.keeps_points
        if state is None or is_further or (self.shadows is not None and self.shadows.traces_lobes):
            self._light(layer, frame, targets)
            return
        grid = layer.visibility
        sources = () if grid is None else grid.sources or ((grid, None),) * (len(lights) + 1)
        before, self._lighting_state = self._lighting_state, LightingState(state, lights, sources)
        if self._static is None or not self._static.fits(self._lighting_state):
            moving, self._static = None if before is None else before.changes(self._lighting_state), None
            if not moving or len(moving) == len(lights):
                self._light(layer, frame, targets)
                return
            static = [SampleSum(layer.size) for _ in frame.pictures]
            self._light(layer, frame, static, numbers=frozenset(range(len(lights) + 1)) - moving)
            self._static = StaticLighting(self._lighting_state, moving, static)
        for static, target in zip(self._static.pictures, targets, strict=True):
            copy(self._copy_shader, static.texture, target.within(), "ADDITIVE_PREMULT")
        self._light(layer, frame, targets, "ADDITIVE", self._static.moving)
        self._is_split = True

    def _light(
        self,
        layer: SurfaceLayer,
        frame: Frame,
        targets: list[SampleSum],
        first: str = "ADDITIVE_PREMULT",
        numbers: Collection[int] | None = None,
    ) -> None:
        """Add the light of all lobes of a layer to `targets`, one a picture of the frame.

        The first lobe is blended by `first`. `numbers` are those of the lights, None: all.
        """
        shares = _shares(frame.pictures)
        lightings, sums = [self._lighting_of(technique) for technique, _ in shares], targets
        if tuple(shares) != frame.pictures:
            sums = self._parts = _cleared(self._parts, replace(frame, pictures=tuple(shares)), True)
        for lighting in lightings:
            lighting.number = self.samples
        traces = self.shadows is not None and self.shadows.traces_lobes
        for number in range(max(frame.mirror.most_lobes, 1)):
            gbuffer = layer.lobe(number, frame.mirror, frame.view, self._lights)
            visibility = self._visibility(layer, gbuffer, frame) if traces else layer.visibility
            gbuffer = replace(gbuffer, visibility=visibility)
            opaque = first if sums is targets else "ADDITIVE_PREMULT"
            blend, view = opaque if number == 0 else "ADDITIVE", frame.view.homogeneous_eye
            for lighting, target, (_, passes) in zip(lightings, sums, shares, strict=True):
                buffer = target.within(gbuffer.mask)
                lighting.draw(gbuffer, buffer, passes, view=view, blend=blend, numbers=numbers)
        begun = set()
        for part, pictures in zip(sums, shares.values(), strict=True) if sums is not targets else ():
            for number in pictures:
                blend = "ADDITIVE" if number in begun else first
                copy(self._copy_shader, part.texture, targets[number].within(), blend)
                begun.add(number)

    @cached_property
    def _copy_shader(self) -> PixelShader:
        return copy_shader()

    @staticmethod
    def _add_emission(layer: SurfaceLayer, frame: Frame, targets: list[SampleSum]) -> None:
        for (_, passes), target in zip(frame.pictures, targets, strict=True):
            if frame.with_emission and passes == "combined":
                layer.add_emission(frame.mirror.instances, frame.view, target.within())

    def _lighting_of(self, technique: str) -> LightingPass:
        if technique not in self._lighting:
            self._lighting[technique] = LightingPass(technique)
        lighting = self._lighting[technique]
        lighting.set_lights(self._lights)
        return lighting

    def read(self, number: int = 0) -> np.ndarray:
        """The last picture `number` (H, W, 4): the techniques, then those of `also`; row 0 at the bottom."""
        return read_texture(self._sums[number].texture) / np.float32(self.samples)

    def free(self) -> None:
        """Free all textures and shaders: the renderer cannot draw any more."""
        vars(self).clear()


def _shares(pictures: tuple[tuple[str, str], ...]) -> dict[tuple[str, str], list[int]]:
    """What to draw, techniques and passes, and the numbers of the `pictures` that are sums of it.

    A combined picture is the sum of both passes, and diffuse light is the same with all techniques.
    """
    shares: dict[tuple[str, str], list[int]] = {}
    for number, (technique, passes) in enumerate(pictures):
        for one in PASSES if passes == "combined" else (passes,):
            shares.setdefault((pictures[0][0] if one == "diffuse" else technique, one), []).append(number)
    if len(shares) <= len(pictures):
        return shares
    return {picture: [number] for number, picture in enumerate(pictures)}


def _cleared(sums: list[SampleSum], frame: Frame, is_new: bool) -> list[SampleSum]:
    """The sums for the pictures of a frame, reused if they have its size; cleared if `is_new`."""
    sums = [each for each in sums if each.size == frame.size]
    sums += [SampleSum(frame.size) for _ in range(len(frame.pictures) - len(sums))]
    for each in sums if is_new else ():
        each.clear()
    return sums[: len(frame.pictures)]
