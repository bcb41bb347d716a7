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
from .textures import GBufferTextures, UploadedLights, float_texture, read_texture, upload_lights

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


class ViewRenderer:
    """The GPU's side of one view; needs an active GPU context."""

    def __init__(self):
        self._surfaces = SurfacePass()
        self._picture = PicturePass()
        self._lighting: dict[str, LightingPass] = {}
        self._targets: list = []
        self._horizons: HorizonPass | None = None
        self._lobe_horizons: HorizonPass | None = None
        self._gbuffer: GBufferTextures | None = None
        self._lit_gbuffer: GBufferTextures | None = None
        self._smooth_normal: gpu.types.GPUTexture | None = None  # of the surfaces that are lit
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
            self._draw_sample(mirror, view.shifted(points[self.samples], size), size, *asked)
            self._still, self.samples = still, self.samples + 1
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
    ) -> None:
        """Add one point of every pixel to the targets of `wanted` techniques and passes; the first one replaces all."""
        surfaces_changed = self._draw_surfaces(mirror, view, size)
        lights_changed = self._upload_lights(mirror, view, world)
        if surfaces_changed or lights_changed or self._lit_gbuffer is None:
            self._choose_horizons(mirror, view)
        buffers = self._light(wanted, mirror, view, size)
        for (_, passes), buffer in zip(wanted, buffers, strict=True):
            if with_emission and passes == "combined":
                self._surfaces.add_emission(mirror.instances, view, size, buffer)

    def _draw_surfaces(self, mirror, view: View, size) -> bool:
        """Draw the G-buffer if anything has changed, and tell that."""
        drawn = (mirror,), (mirror.surfaces_version, *_key(view, size))
        if _same(drawn, self._drawn):
            return False
        self._drawn = None
        self._gbuffer = self._surfaces.draw(mirror.instances, view, size)
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

    def _choose_horizons(self, mirror, view: View) -> None:
        """End specular lobes where Cycles does, and let only those diffuse lobes have two horizons that need them."""
        self._lit_gbuffer = None
        if self._horizons is None and self._gbuffer.geometric_normal is not None:
            self._horizons = HorizonPass()
        self._lit_gbuffer = self._with_horizons(self._gbuffer, self._horizons, mirror, view)

    def _with_horizons(self, gbuffer, horizons, mirror, view: View) -> GBufferTextures:
        self._smooth_normal = gbuffer.smooth_normal
        if gbuffer.geometric_normal is None:
            return gbuffer
        horizon = horizons.draw(gbuffer, self._lights, view.homogeneous_eye)
        smooth_normal = gbuffer.smooth_normal if has_bent_lobes(mirror.instances) else None
        return replace(gbuffer, geometric_normal=horizon, smooth_normal=smooth_normal)

    def _light(self, wanted: list[tuple[str, str]], mirror, view: View, size) -> list:
        """The buffers that techniques and passes are drawn into; surfaces and shadows of a lobe are those of all."""
        lightings = [self._lighting_of(technique, mirror) for technique, _ in wanted]
        buffers = [self._target(number, size) for number in range(len(wanted))]
        place = {"view_direction" if view.is_parallel else "view_position": tuple(view.eye)}
        for number in range(max(mirror.most_lobes, 1)):
            gbuffer = self._lit_gbuffer if number == 0 else self._further_lobe(number, mirror, view)
            if self.shadows is not None:
                whole = replace(gbuffer, smooth_normal=self._smooth_normal)
                sides = () if self._lights.sky is None else mirror.sky.sides
                shares = self.shadows.shares(whole, view, self._lights.lights, sides, self.samples)
                gbuffer = replace(gbuffer, shares=shares)
            first = "NONE" if self.samples == 0 else "ADDITIVE_PREMULT"
            for lighting in lightings:
                lighting.number = self.samples
            for lighting, buffer, (_, passes) in zip(lightings, buffers, wanted, strict=True):
                lighting.draw(gbuffer, buffer, passes, **place, blend=first if number == 0 else "ADDITIVE")
        return buffers

    def _lighting_of(self, technique: str, mirror) -> LightingPass:
        if technique not in self._lighting:
            self._lighting[technique] = LightingPass(technique)
        lighting = self._lighting[technique]
        lighting.set_iors(common_iors(mirror))
        lighting.set_lights(self._lights)
        return lighting

    def _further_lobe(self, number: int, mirror, view: View) -> GBufferTextures:
        gbuffer = self._surfaces.draw_lobe(number, mirror.instances, view)
        if self._lobe_horizons is None and gbuffer.geometric_normal is not None:
            self._lobe_horizons = HorizonPass()
        return self._with_horizons(gbuffer, self._lobe_horizons, mirror, view)

    def _target(self, number: int, size):
        """The frame buffer that the technique `number` is drawn into: the sum of its samples."""
        while len(self._targets) <= number:
            self._targets.append(None)
        if self._targets[number] is None or self._targets[number][2] != size:
            texture = gpu.types.GPUTexture(size, format="RGBA32F")
            self._targets[number] = texture, gpu.types.GPUFrameBuffer(color_slots=[texture]), size
        return self._targets[number][1]

    def read(self, number: int = 0) -> np.ndarray:
        """The last picture (H, W, 4) of the first technique, the second, or one beside; row 0 at the bottom."""
        return read_texture(self._targets[number][0]) / np.float32(self.samples)

    def free(self) -> None:
        """Let go of everything."""
        for lighting in self._lighting.values():
            lighting.free()
        self._lighting.clear()
        self._targets.clear()
        self._surfaces.free()
        for horizons in (self._horizons, self._lobe_horizons):
            if horizons is not None:
                horizons.free()
        self._smooth_normal = self._gbuffer = self._lit_gbuffer = self._lights = self._horizons = (
            self._lobe_horizons
        ) = None
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
