"""One frame of a view: G-buffer, lighting, picture. What has not changed is not drawn again, but may be refined: every
further frame then adds other points of the pixels, and the picture is their mean."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gpu
import numpy as np

from ...shading.header import definitions
from ..extract.origin import new_origin
from ..materials.values import Value
from .lighting import HorizonPass, LightingPass
from .mirror import SceneMirror
from .shaders import glsl, pixel_shader
from .shadows import LiveShadows, ShadowRays
from .sky import background_texels, sky_texels
from .surfaces import SurfacePass, View, has_bent_lobes
from .textures import GBufferTextures, ShareGrid, UploadedLights, float_texture, read_texture, upload_lights

MODES = ("single", "split", "difference")
# The lighting pass is fast for so many indices of refraction, and exact for all.
MOST_IORS = 6
# Of pixels: right and up by half of the picture, and its center.
RAYS = ("ray_x", "ray_y", "ray_center")
# Of pixels: where they are seen, right and up of their centers.
CENTERS = np.zeros((1, 2))


@dataclass(frozen=True)
class ShownPicture:
    """What of the lighting is shown, and how."""

    technique: str
    passes: str  # combined, specular or diffuse
    mode: str  # of MODES
    second_technique: str
    split: float  # place of the line between 0 and 1
    difference_scale: float
    exposure: float
    transparent: bool
    line_width: float = 1.0
    second_picture: gpu.types.GPUTexture | None = None  # in the place of the second technique's; without emission
    white: float = 1.0  # brightness of no difference, before the scene's own exposure
    also: tuple[tuple[str, str], ...] = ()  # techniques and passes that are drawn beside, for `read`
    world: bool = True  # its light is shown


def _origin_of(lights, view: View) -> np.ndarray:
    """Near what is seen: single precision tells places far from the origin badly apart."""
    places = np.array([light.center for light in lights if not light.is_distant])
    if len(places) == 0:
        return np.zeros(3)
    return new_origin(places, places.mean(axis=0) if view.is_parallel else view.eye)


class PicturePass:
    """Draws one or two pictures into what is bound; needs an active GPU context."""

    def __init__(self):
        constants = {"mode": "INT", "scales": "VEC4", "opacity": "FLOAT", "white": "FLOAT", "weights": "VEC2"}
        constants |= dict.fromkeys(RAYS, "VEC4")
        modes = definitions({mode.upper(): number for number, mode in enumerate(MODES)})
        source = modes + glsl("octahedron") + glsl("picture")
        self._shader, self._batch = pixel_shader(source, ("first_picture", "second_picture", "sky"), constants)

    def draw(self, pictures, weights, view: View, shown: ShownPicture, background) -> None:
        """Fill what is bound, scene-linear, from one or two textures RGBA times their `weights`, whose alpha then is
        the share of a pixel that shows a surface. `background` is a picture of what is behind, as of `sky`."""
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


class VeilPass:
    """Draws what is seen through glass; needs an active GPU context."""

    def __init__(self):
        constants = {"is_seen": "FLOAT", **dict.fromkeys(RAYS, "VEC4")}
        samplers = ("behind", "left", "glass", "sky")
        self._shader, self._batch = pixel_shader(glsl("octahedron") + glsl("veil"), samplers, constants)

    def draw(self, textures, target, view: View, is_seen: bool, blend: str) -> None:
        """Draw a picture RGBA of what is behind into `target`, where there is glass times what is `left` of it, and
        over the background. What is behind `is_seen`, or black. `textures` are these, positions of the glass and the
        background."""
        shader = self._shader
        with target.bind():
            gpu.state.viewport_set(0, 0, textures[0].width, textures[0].height)
            gpu.state.blend_set(blend)
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


class _Layer:
    """The G-buffer of some surfaces, and which horizons end their lobes."""

    def __init__(self, before: _Layer | None = None):
        self._surfaces = SurfacePass(None if before is None else before._surfaces)
        self._horizons: HorizonPass | None = None
        self._lobe_horizons: HorizonPass | None = None
        self._gbuffer: GBufferTextures | None = None
        self._lit: GBufferTextures | None = None
        self.smooth_normal: gpu.types.GPUTexture | None = None  # of the surfaces that are lit
        self.shares: ShareGrid | None = None  # those that all lobes have
        self.through, self.add_emission = self._surfaces.through, self._surfaces.add_emission

    def draw(self, mirror, view: View, size) -> None:
        """Draw the surfaces."""
        self._lit = None
        self._gbuffer = self._surfaces.draw(mirror.instances, view, size)

    def choose_horizons(self, mirror, view: View, lights: UploadedLights) -> None:
        """End specular lobes where Cycles does, and let only those diffuse lobes have two horizons that need them."""
        self._lit = None
        if self._horizons is None and self._gbuffer.geometric_normal is not None:
            self._horizons = HorizonPass()
        self._lit = self._with_horizons(self._gbuffer, self._horizons, mirror, view, lights)

    @property
    def is_ready(self) -> bool:
        """Have the horizons been chosen?"""
        return self._lit is not None

    def lobe(self, number: int, mirror, view: View, lights: UploadedLights) -> GBufferTextures:
        """What is to be lit of the lobes `number`; valid until the next call."""
        if number == 0:
            self.smooth_normal = self._gbuffer.smooth_normal
            return self._lit
        gbuffer = self._surfaces.draw_lobe(number, mirror.instances, view)
        if self._lobe_horizons is None and gbuffer.geometric_normal is not None:
            self._lobe_horizons = HorizonPass()
        return self._with_horizons(gbuffer, self._lobe_horizons, mirror, view, lights)

    def _with_horizons(self, gbuffer, horizons, mirror, view: View, lights) -> GBufferTextures:
        self.smooth_normal = gbuffer.smooth_normal
        if gbuffer.geometric_normal is None:
            return gbuffer
        horizon = horizons.draw(gbuffer, lights, view.homogeneous_eye)
        smooth_normal = gbuffer.smooth_normal if has_bent_lobes(mirror.instances) else None
        return replace(gbuffer, geometric_normal=horizon, smooth_normal=smooth_normal)

    def free(self) -> None:
        """Let go of everything."""
        self._surfaces.free()
        for horizons in (self._horizons, self._lobe_horizons):
            if horizons is not None:
                horizons.free()
        self._gbuffer = self._lit = self.smooth_normal = self._horizons = self._lobe_horizons = None


class ViewRenderer:
    """The GPU's side of one view; needs an active GPU context."""

    def __init__(self):
        self._surfaces = _Layer()
        self._glass: _Layer | None = None
        self._picture = PicturePass()
        self._veil: VeilPass | None = None
        self._lighting: dict[str, LightingPass] = {}
        self._targets: list = []
        self._behind: list = []  # what is lit behind glass
        self._lights: UploadedLights | None = None
        self._drawn, self._uploaded = None, (None, None, None)
        self._still, self.samples = None, 0
        self._sky, self._sky_light, self._background = None, None, None
        self.shadows: ShadowRays | LiveShadows | None = None

    def draw(
        self, mirror: SceneMirror, view: View, size: tuple[int, int], shown: ShownPicture, frame_buffer, points=CENTERS
    ) -> None:
        """Draw the scene into `frame_buffer`, which has `size` pixels.

        Pixels are first seen at the first of `points` (N, 2), in pixels right and up of their centers, then, as long as
        nothing changes, at one more with every call. The picture is their mean; `samples` is their number.
        """
        view = view.around(_origin_of(mirror.lights, view))
        wanted = [(shown.technique, shown.passes)]
        if shown.mode != "single" and shown.second_picture is None:
            wanted.append((shown.second_technique, shown.passes))
        pictures = len(wanted)
        wanted += shown.also
        asked = wanted, shown.second_picture is None, shown.world
        self._upload_sky(mirror)
        traced = None
        if self.shadows is not None:
            self.shadows.take_news()
            traced = self.shadows.version
        things = mirror, mirror.lights, mirror.sky, self.shadows
        still = things, (mirror.surfaces_version, *_key(view, size), asked, traced)
        if not _same(still, self._still):
            self.samples = 0
        if self.samples < len(points):
            self._still = None  # until all of the sample is there
            is_drawn = self._draw_sample(mirror, view.shifted(points[self.samples], size), size, *asked)
            self._still, self.samples = still, self.samples + is_drawn
        self._show([self._targets[number][0] for number in range(pictures)], view, shown, frame_buffer)

    def show(self, number: int, view: View, shown: ShownPicture, frame_buffer) -> None:
        """Draw the picture of one of the techniques that were drawn last, as `draw` does; `shown` has its passes."""
        self._show([self._targets[number][0]], view, shown, frame_buffer)

    def _show(self, pictures, view, shown, frame_buffer) -> None:
        weights = [1.0 / self.samples] * len(pictures)
        if shown.mode != "single" and shown.second_picture is not None:
            pictures, weights = [*pictures, shown.second_picture], [*weights, 1.0]
        # Drawing elsewhere has bound other buffers, and what is bound need not be what is bound in Python.
        with frame_buffer.bind():
            self._picture.draw(pictures, weights, view, shown, self._background)

    def _draw_sample(
        self, mirror, view: View, size, wanted: list[tuple[str, str]], with_emission: bool, world: bool
    ) -> bool:
        """Add one point of every pixel to the targets of `wanted` techniques and passes; the first one replaces all.

        False: it was not drawn, since its shadows are on their way.
        """
        surfaces_changed = self._draw_surfaces(mirror, view, size)
        lights_changed = self._upload_lights(mirror, view, world)
        layers = [self._surfaces, self._glass] if mirror.has_glass else [self._surfaces]
        for layer in layers:
            if surfaces_changed or lights_changed or not layer.is_ready:
                layer.choose_horizons(mirror, view, self._lights)
            layer.shares = None
            if self.shadows is not None and not self.shadows.traces_lobes:
                layer.shares = self._shares(layer, layer.lobe(0, mirror, view, self._lights), mirror, view)
                if self.shadows.waits:
                    return False
        targets = [self._target(self._targets, number, size) for number in range(len(wanted))]
        first = "NONE" if self.samples == 0 else "ADDITIVE_PREMULT"
        if not mirror.has_glass:
            self._light(self._surfaces, wanted, targets, (mirror, view), first)
            self._add_emission(self._surfaces, wanted, targets, (mirror, view, size), with_emission)
            return True
        behind = [self._target(self._behind, number, size) for number in range(len(wanted))]
        self._light(self._surfaces, wanted, behind, (mirror, view), "NONE")
        self._add_emission(self._surfaces, wanted, behind, (mirror, view, size), with_emission)
        through = self._glass.through(mirror.instances, view)
        glass = self._glass.lobe(0, mirror, view, self._lights).position
        for (texture, _, _), target, (_, passes) in zip(self._behind, targets, wanted, strict=False):
            is_seen = passes == "combined" and with_emission
            self._veil.draw((texture, through, glass, self._background), target, view, is_seen, first)
        self._light(self._glass, wanted, targets, (mirror, view), "ADDITIVE")
        self._add_emission(self._glass, wanted, targets, (mirror, view, size), with_emission)
        return True

    def _draw_surfaces(self, mirror, view: View, size) -> bool:
        """Draw the G-buffers if anything has changed, and tell that."""
        drawn = (mirror,), (mirror.surfaces_version, *_key(view, size))
        if _same(drawn, self._drawn):
            return False
        self._drawn = None
        self._surfaces.draw(mirror, view, size)
        if mirror.has_glass:
            if self._glass is None:
                self._glass, self._veil = _Layer(self._surfaces), VeilPass()
            self._glass.draw(mirror, view, size)
        self._drawn = drawn
        return True

    def _upload_sky(self, mirror) -> None:
        """Upload the world's light and background if they have changed."""
        if self._sky is mirror.sky:
            return
        self._sky = sky = mirror.sky
        self._sky_light = float_texture(sky_texels(sky)) if sky.sides else None
        self._background = float_texture(background_texels(sky))

    def _upload_lights(self, mirror, view: View, world: bool) -> bool:
        """Upload the lights if they, or the origin of the view, have changed, and tell that."""
        lights = mirror.lights if world else mirror.own_lights
        known, sky, origin = self._uploaded
        wanted = self._sky_light if world else None
        if known is lights and sky is wanted and np.array_equal(origin, view.origin):
            return False
        is_moved = view.origin.any()
        self._lights = upload_lights([light.moved(-view.origin) for light in lights] if is_moved else lights, wanted)
        self._uploaded = lights, wanted, view.origin
        return True

    def _shares(self, layer: _Layer, gbuffer: GBufferTextures, mirror, view: View) -> ShareGrid | None:
        """Which shares of the lights lobes of a layer see."""
        shadows = self.shadows.of_glass if layer is self._glass else self.shadows
        sides = () if self._lights.sky is None else mirror.sky.sides
        whole = replace(gbuffer, smooth_normal=layer.smooth_normal)
        return shadows.shares(whole, view, self._lights.lights, sides, self.samples)

    def _light(self, layer: _Layer, wanted: list[tuple[str, str]], buffers: list, seen: tuple, first: str) -> None:
        """Light a layer into the buffers of techniques and passes, with the blending `first`, as of a `seen` mirror and
        view; surfaces of a lobe are those of all."""
        mirror, view = seen
        lightings = [self._lighting_of(technique, mirror) for technique, _ in wanted]
        for lighting in lightings:
            lighting.number = self.samples
        traces = self.shadows is not None and self.shadows.traces_lobes
        for number in range(max(mirror.most_lobes, 1)):
            gbuffer = layer.lobe(number, mirror, view, self._lights)
            shares = self._shares(layer, gbuffer, mirror, view) if traces else layer.shares
            gbuffer = replace(gbuffer, shares=shares)
            for lighting, buffer, (_, passes) in zip(lightings, buffers, wanted, strict=True):
                lighting.draw(
                    gbuffer, buffer, passes, view=view.homogeneous_eye, blend=first if number == 0 else "ADDITIVE"
                )

    def _add_emission(self, layer: _Layer, wanted, buffers, seen: tuple, with_emission: bool) -> None:
        mirror, view, size = seen
        for (_, passes), buffer in zip(wanted, buffers, strict=True):
            if with_emission and passes == "combined":
                layer.add_emission(mirror.instances, view, size, buffer)

    def _lighting_of(self, technique: str, mirror) -> LightingPass:
        if technique not in self._lighting:
            self._lighting[technique] = LightingPass(technique)
        lighting = self._lighting[technique]
        lighting.set_iors(common_iors(mirror))
        lighting.set_lights(self._lights)
        return lighting

    @staticmethod
    def _target(targets: list, number: int, size):
        """The frame buffer `number` of `targets`; those that a technique is drawn into have the sum of its samples."""
        while len(targets) <= number:
            targets.append(None)
        if targets[number] is None or targets[number][2] != size:
            texture = gpu.types.GPUTexture(size, format="RGBA32F")
            targets[number] = texture, gpu.types.GPUFrameBuffer(color_slots=[texture]), size
        return targets[number][1]

    def read(self, number: int = 0) -> np.ndarray:
        """The last picture (H, W, 4) of the first technique, the second, or one beside; row 0 at the bottom."""
        return read_texture(self._targets[number][0]) / np.float32(self.samples)

    def free(self) -> None:
        """Let go of everything."""
        for part in (*self._lighting.values(), self._surfaces, *([self._glass] if self._glass else [])):
            part.free()
        self._lighting.clear()
        self._targets.clear()
        self._behind.clear()
        self._lights = self._glass = self._veil = None
        self._drawn, self._uploaded = None, (None, None, None)
        self._sky = self._sky_light = self._background = None
        self._still, self.samples = None, 0


def _key(view: View, size) -> tuple:
    return view.projection.tobytes(), view.eye.tobytes(), view.is_parallel, view.origin.tobytes(), size


def _same(new, old) -> bool:
    """Do two states have the same things of the scene, their first part, and equal values, their second one?"""
    return old is not None and new[1] == old[1] and all(a is b for a, b in zip(new[0], old[0], strict=True))


def common_iors(mirror: SceneMirror) -> tuple[float, ...]:
    """The constant indices of refraction of most instances, as the lighting pass takes them."""
    counts: dict[float, int] = {}
    for instance in mirror.instances:
        for lobe in (lobe for shown in instance.looks for lobe in shown.look.lobes):
            value: Value = lobe.value("ior")
            ior = round(200.0 * float(value.offset[0])) / 200.0
            if value.is_constant and ior > 1.0:
                counts[ior] = counts.get(ior, 0) + 1
    return tuple(sorted(counts, key=counts.get, reverse=True)[:MOST_IORS]) or (1.5,)
