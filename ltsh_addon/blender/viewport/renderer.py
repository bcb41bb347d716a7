"""One frame of a view: G-buffer, lighting, picture.

Only what has changed is drawn again. While nothing changes, every further frame adds another point of each pixel, and
the picture is their mean.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import gpu
import numpy as np

from ..extract.origin import new_origin
from ..materials.values import Value
from .camera import ViewCamera
from .gbuffer import GBufferTextures, VisibilityGrid, float_texture, read_texture
from .light_texels import UploadedLights, upload_lights
from .lighting import GOLDEN, HorizonPass, LightingPass
from .mirror import SceneMirror
from .pictures import CopyPass, PicturePass, SampleSum, ShownPicture, VeilPass
from .shadow_rays import ShadowRays
from .shadows import LiveShadows
from .sky import background_texels, sky_texels
from .static_lighting import LightingState, StaticLighting, same_state
from .surfaces import SurfacePass, has_bent_lobes

# MOST_IORS: indices of refraction for which the lighting pass is fast. It is exact for all.
MOST_IORS = 6
# CENTERS: the points of pixels of a single frame, their centers, in pixels right and up of them.
CENTERS = np.zeros((1, 2))


def _origin_of(lights, view: ViewCamera) -> np.ndarray:
    """An origin near what is seen, because single precision is coarse far from the origin."""
    places = np.array([light.center for light in lights if not light.is_distant])
    if len(places) == 0:
        return np.zeros(3)
    return new_origin(places, places.mean(axis=0) if view.is_parallel else view.eye)


class SurfaceLayer:
    """The G-buffer of one layer, surfaces or glass, and the horizons that end its lobes."""

    def __init__(self, before: SurfaceLayer | None = None):
        self._surfaces = SurfacePass(None if before is None else before._surfaces)
        self._horizons: HorizonPass | None = None
        self._lobe_horizons: HorizonPass | None = None
        self._gbuffer: GBufferTextures | None = None
        self._lit: GBufferTextures | None = None
        self.smooth_normal: gpu.types.GPUTexture | None = None  # of the lobe that is lit
        self.shares: VisibilityGrid | None = None  # shares for all lobes
        self.threshold = 0.5  # see `HorizonPass.draw`
        self.through, self.add_emission = self._surfaces.through, self._surfaces.add_emission

    def draw(self, mirror, view: ViewCamera, size) -> None:
        """Draw the surfaces."""
        self._lit = None
        self._gbuffer = self._surfaces.draw(mirror.instances, view, size)

    def choose_horizons(self, mirror, view: ViewCamera, lights: UploadedLights) -> None:
        """Choose the horizons of specular lobes as Cycles does; diffuse lobes keep a second one only if they need it.

        Only bump-mapped and translucent looks need it.
        """
        self._lit = None
        if self._horizons is None and self._gbuffer.geometric_normal is not None:
            self._horizons = HorizonPass()
        self._lit = self._with_horizons(self._gbuffer, self._horizons, mirror, view, lights)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self._gbuffer.size

    @property
    def is_ready(self) -> bool:
        """True if the horizons are chosen."""
        return self._lit is not None

    def lobe(self, number: int, mirror, view: ViewCamera, lights: UploadedLights) -> GBufferTextures:
        """The G-buffer of the lobes `number`, with their horizons; valid until the next call."""
        if number == 0:
            self.smooth_normal = self._gbuffer.smooth_normal
            return self._lit
        gbuffer = self._surfaces.draw_lobe(number, mirror.instances, view)
        if self._lobe_horizons is None and gbuffer.geometric_normal is not None:
            self._lobe_horizons = HorizonPass()
        return self._with_horizons(gbuffer, self._lobe_horizons, mirror, view, lights)

    def _with_horizons(self, gbuffer, horizons, mirror, view: ViewCamera, lights) -> GBufferTextures:
        self.smooth_normal = gbuffer.smooth_normal
        if gbuffer.geometric_normal is None:
            return gbuffer
        horizon = horizons.draw(gbuffer, lights, view.homogeneous_eye, self.threshold)
        smooth_normal = gbuffer.smooth_normal if has_bent_lobes(mirror.instances) else None
        return replace(gbuffer, geometric_normal=horizon, smooth_normal=smooth_normal)

    def free(self) -> None:
        """Free all textures and shaders."""
        self._surfaces.free()
        for horizons in (self._horizons, self._lobe_horizons):
            if horizons is not None:
                horizons.free()
        self._gbuffer = self._lit = self.smooth_normal = self._horizons = self._lobe_horizons = None


class ViewRenderer:
    """The GPU's side of one view; needs an active GPU context."""

    def __init__(self):
        self._surfaces = SurfaceLayer()
        self._glass: SurfaceLayer | None = None
        self._picture = PicturePass()
        self._veil: VeilPass | None = None
        self._copy: CopyPass | None = None
        self._lighting: dict[str, LightingPass] = {}
        self._targets: list = []
        self._behind: list = []  # what is lit behind glass
        self._lights: UploadedLights | None = None
        self._drawn, self._uploaded = None, (None, None, None)
        self._still, self.samples = None, 0
        self._lit: LightingState | None = None
        self._held: StaticLighting | None = None
        self._is_split = False
        self._sky, self._sky_light, self._background = None, None, None
        self.shadows: ShadowRays | LiveShadows | None = None

    def draw(
        self,
        mirror: SceneMirror,
        view: ViewCamera,
        size: tuple[int, int],
        shown: ShownPicture,
        frame_buffer,
        points=CENTERS,
    ) -> None:
        """Draw the scene into `frame_buffer`, which has `size` pixels.

        The first call shows pixels at the first of `points` (N, 2), in pixels right and up of their centers. While
        nothing changes, every further call adds the next point. The picture is their mean; `samples` is their number.

        Where only some lights have changed, the others are not drawn again: their light keeps the horizons that were
        chosen before. The next call without a change begins anew with all lights.
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
        is_same = same_state(still, self._still)
        if not is_same or self._is_split:
            self.samples = 0
        if self.samples < len(points):
            self._still = None  # until the sample is complete
            state = (mirror, mirror.sky, self.shadows), (mirror.surfaces_version, *_key(view, size), asked)
            shifted = view.shifted(points[self.samples], size)
            is_drawn = self._draw_sample(mirror, shifted, size, *asked, None if is_same else state)
            self._still, self.samples = still, self.samples + is_drawn
        self._show([self._targets[number].texture for number in range(pictures)], view, shown, frame_buffer)

    def show(self, number: int, view: ViewCamera, shown: ShownPicture, frame_buffer) -> None:
        """Draw the picture `number` of those drawn last, as `draw` does; `shown` must have its passes."""
        self._show([self._targets[number].texture], view, shown, frame_buffer)

    def _show(self, pictures, view, shown, frame_buffer) -> None:
        weights = [1.0 / self.samples] * len(pictures)
        if shown.mode != "single" and shown.second_picture is not None:
            pictures, weights = [*pictures, shown.second_picture], [*weights, 1.0]
        # The sample has bound other buffers, and Blender's own binding is unknown to Python.
        with frame_buffer.bind():
            self._picture.draw(pictures, weights, view, shown, self._background)

    def _draw_sample(
        self, mirror, view: ViewCamera, size, wanted: list[tuple[str, str]], with_emission: bool, world: bool, state
    ) -> bool:
        """Add one point of every pixel to the targets of `wanted` techniques and passes; the first point replaces them.

        The first point may keep the light of lights that have not changed, in the same `state`; None: it may not.
        Returns False where nothing was drawn because its shadows are not ready.
        """
        surfaces_changed = self._draw_surfaces(mirror, view, size)
        lights_changed = self._upload_lights(mirror, view, world)
        layers = [self._surfaces, self._glass] if mirror.has_glass else [self._surfaces]
        for layer in layers:
            layer.threshold = (0.5 + self.samples * GOLDEN) % 1.0
            if surfaces_changed or lights_changed or not layer.is_ready:
                layer.choose_horizons(mirror, view, self._lights)
            layer.shares = None
            if self.shadows is not None and not self.shadows.traces_lobes:
                layer.shares = self._shares(layer, layer.lobe(0, mirror, view, self._lights), mirror, view)
                if self.shadows.waits:
                    return False
        targets = [self._target(self._targets, number, size) for number in range(len(wanted))]
        if self.samples == 0:
            for target in targets:
                target.clear()
        if not mirror.has_glass:
            self._light_surfaces(wanted, targets, (mirror, view), state)
            self._add_emission(self._surfaces, wanted, targets, (mirror, view, size), with_emission)
            return True
        behind = [self._target(self._behind, number, size) for number in range(len(wanted))]
        for target in behind:
            target.clear()
        self._light_surfaces(wanted, behind, (mirror, view), state)
        self._add_emission(self._surfaces, wanted, behind, (mirror, view, size), with_emission)
        through = self._glass.through(mirror.instances, view)
        glass = self._glass.lobe(0, mirror, view, self._lights).position
        for picture, target, (_, passes) in zip(behind, targets, wanted, strict=True):
            is_seen = passes == "combined" and with_emission
            self._veil.draw((picture.texture, through, glass, self._background), target.within(), view, is_seen)
        self._light(self._glass, wanted, targets, (mirror, view), "ADDITIVE")
        self._add_emission(self._glass, wanted, targets, (mirror, view, size), with_emission)
        return True

    def _draw_surfaces(self, mirror, view: ViewCamera, size) -> bool:
        """Draw the G-buffers if anything has changed; True if so."""
        drawn = (mirror,), (mirror.surfaces_version, *_key(view, size))
        if same_state(drawn, self._drawn):
            return False
        self._drawn = None
        self._surfaces.draw(mirror, view, size)
        if mirror.has_glass:
            if self._glass is None:
                self._glass, self._veil = SurfaceLayer(self._surfaces), VeilPass()
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

    def _upload_lights(self, mirror, view: ViewCamera, world: bool) -> bool:
        """Upload the lights if they or the origin of the view have changed; True if so."""
        lights = mirror.lights if world else mirror.own_lights
        known, sky, origin = self._uploaded
        wanted = self._sky_light if world else None
        if known is lights and sky is wanted and np.array_equal(origin, view.origin):
            return False
        is_moved = view.origin.any()
        self._lights = upload_lights([light.moved(-view.origin) for light in lights] if is_moved else lights, wanted)
        self._uploaded = lights, wanted, view.origin
        return True

    def _shares(self, layer: SurfaceLayer, gbuffer: GBufferTextures, mirror, view: ViewCamera) -> VisibilityGrid | None:
        """The shares of the lights that the lobe `gbuffer` of a layer sees."""
        shadows = self.shadows.of_glass if layer is self._glass else self.shadows
        sides = () if self._lights.sky is None else mirror.sky.sides
        whole = replace(gbuffer, smooth_normal=layer.smooth_normal)
        return shadows.shares(whole, view, self._lights.lights, sides, self.samples)

    def _light_surfaces(self, wanted, targets: list[SampleSum], seen: tuple, state: tuple | None) -> None:
        """Light the surfaces as `_light` does; with a `state` (see `_draw_sample`) perhaps only by what has changed."""
        layer, lights = self._surfaces, self._lights.lights
        self._is_split = False
        if state is None or self.samples > 0 or (self.shadows is not None and self.shadows.traces_lobes):
            self._light(layer, wanted, targets, seen)
            return
        shares = layer.shares
        sources = () if shares is None else shares.sources or ((shares, None),) * (len(lights) + 1)
        before, self._lit = self._lit, LightingState(state, lights, sources)
        if self._held is None or not self._held.fits(self._lit):
            moving, self._held = None if before is None else before.changes(self._lit), None
            if not moving or len(moving) == len(lights):
                self._light(layer, wanted, targets, seen)
                return
            held = [SampleSum(layer.size) for _ in wanted]
            self._light(layer, wanted, held, seen, numbers=frozenset(range(len(lights))) - moving)
            self._held = StaticLighting(self._lit, moving, held)
        if self._copy is None:
            self._copy = CopyPass()
        for held, target in zip(self._held.targets, targets, strict=True):
            self._copy.draw(held.texture, target.within())
        self._light(layer, wanted, targets, seen, first="ADDITIVE", numbers=self._held.moving)
        self._is_split = True

    def _light(
        self,
        layer: SurfaceLayer,
        wanted: list[tuple[str, str]],
        targets: list[SampleSum],
        seen: tuple,
        first: str = "ADDITIVE_PREMULT",
        numbers: Collection[int] | None = None,
    ) -> None:
        """Add the light of all lobes of a layer to the `targets` of `wanted` techniques and passes.

        The first lobe is blended by `first`. `seen` are mirror and view. `numbers` are those of the lights, None: all.
        """
        mirror, view = seen
        lightings = [self._lighting_of(technique, mirror) for technique, _ in wanted]
        for lighting in lightings:
            lighting.number = self.samples
        traces = self.shadows is not None and self.shadows.traces_lobes
        for number in range(max(mirror.most_lobes, 1)):
            gbuffer = layer.lobe(number, mirror, view, self._lights)
            shares = self._shares(layer, gbuffer, mirror, view) if traces else layer.shares
            gbuffer = replace(gbuffer, shares=shares)
            blend = first if number == 0 else "ADDITIVE"
            for lighting, target, (_, passes) in zip(lightings, targets, wanted, strict=True):
                buffer = target.within(gbuffer.mask)
                lighting.draw(gbuffer, buffer, passes, view=view.homogeneous_eye, blend=blend, numbers=numbers)

    def _add_emission(self, layer: SurfaceLayer, wanted, targets, seen: tuple, with_emission: bool) -> None:
        mirror, view, size = seen
        for (_, passes), target in zip(wanted, targets, strict=True):
            if with_emission and passes == "combined":
                layer.add_emission(mirror.instances, view, size, target.within())

    def _lighting_of(self, technique: str, mirror) -> LightingPass:
        if technique not in self._lighting:
            self._lighting[technique] = LightingPass(technique)
        lighting = self._lighting[technique]
        lighting.set_iors(common_iors(mirror))
        lighting.set_lights(self._lights)
        return lighting

    @staticmethod
    def _target(targets: list[SampleSum], number: int, size) -> SampleSum:
        """The picture `number` of `targets`, created if needed."""
        if len(targets) > number and (targets[number].texture.width, targets[number].texture.height) != size:
            targets.clear()
        while len(targets) <= number:
            targets.append(SampleSum(size))
        return targets[number]

    def read(self, number: int = 0) -> np.ndarray:
        """The last picture (H, W, 4) of target `number`: the techniques, then those of `also`; row 0 at the bottom."""
        return read_texture(self._targets[number].texture) / np.float32(self.samples)

    def free(self) -> None:
        """Free all textures and shaders."""
        for part in (*self._lighting.values(), self._surfaces, *([self._glass] if self._glass else [])):
            part.free()
        self._lighting.clear()
        self._targets.clear()
        self._behind.clear()
        self._lights = self._glass = self._veil = None
        self._drawn, self._uploaded = None, (None, None, None)
        self._sky = self._sky_light = self._background = None
        self._still, self.samples = None, 0
        self._lit = self._held = self._copy = None


def _key(view: ViewCamera, size) -> tuple:
    return view.projection.tobytes(), view.eye.tobytes(), view.is_parallel, view.origin.tobytes(), size


def common_iors(mirror: SceneMirror) -> tuple[float, ...]:
    """The most frequent constant indices of refraction, rounded to the steps of the lighting pass."""
    counts: dict[float, int] = {}
    for instance in mirror.instances:
        for lobe in (lobe for shown in instance.looks for lobe in shown.look.lobes):
            value: Value = lobe.value("ior")
            ior = round(200.0 * float(value.offset[0])) / 200.0
            if value.is_constant and ior > 1.0:
                counts[ior] = counts.get(ior, 0) + 1
    return tuple(sorted(counts, key=counts.get, reverse=True)[:MOST_IORS]) or (1.5,)
