"""The second pass: reflected radiance of a G-buffer under lights. Before it, the choice of the horizons of its lobes.

Lights, tables and integrals are those of `shading.shade`, in float32 throughout.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import gpu
import numpy as np
from mathutils import Matrix

from ...cycles import horizons
from ...lobes.lookup_table import LookupTable
from ...scene import PASSES, Light, PolygonLight
from ...shading import load_table
from .drawing import (
    SAMPLERS,
    VISIBILITY_SAMPLERS,
    WITHIN_MASK,
    GBufferTextures,
    drawing,
    empty_texture,
    float_texture,
    frame_buffer,
)
from .light_texels import UploadedLights, dielectric_texels, draw_ranges, table_texels, upload_lights
from .shaders import BOUNDS, CHOICE, EXCESS, HORIZON_SAMPLERS, Features, horizon_shader, lighting_shader

_RESULTS = {BOUNDS: "light_bounds", EXCESS: "excesses", CHOICE: "horizons"}
_SHOWN_PASSES = (*PASSES, "combined")
# From one picture to the next, the points at which lobes sample the world shift by GOLDEN steps and turn by TURN rad.
GOLDEN, TURN = 0.618034, 2.0


class HorizonPass:
    """Chooses per pixel which horizon ends the specular lobe, as `cycles.horizons` does for samples.

    Needs an active GPU context.
    """

    def __init__(self):
        self._shaders = {step: horizon_shader(step) for step in _RESULTS}
        self._size, self._mask, self._textures, self._buffers = None, None, {}, {}

    def draw(
        self, gbuffer: GBufferTextures, lights: UploadedLights, view: Sequence[float], threshold: float = 0.5
    ) -> gpu.types.GPUTexture:
        """Normals of the horizons (RGB) of a G-buffer with smooth and geometric normals; valid until the next call.

        Pixels take the smooth horizon where its share is at least `threshold`. `view` is the camera's place and 1, or
        for parallel views the unit direction toward it and 0.
        """
        if gbuffer.size != self._size or gbuffer.mask is not self._mask:
            self._size, self._mask = gbuffer.size, gbuffer.mask
            self._textures = {name: empty_texture(self._size) for name in _RESULTS.values()}
            self._buffers = {step: frame_buffer(self._textures[name], self._mask) for step, name in _RESULTS.items()}
        corners = [len(light.corners) if isinstance(light, PolygonLight) else 1 for light in lights.lights]
        self._run(BOUNDS, gbuffer, lights, draw_ranges([1] * len(corners)))
        self._run(EXCESS, gbuffer, lights, draw_ranges([horizons.AROUND * count for count in corners]), view=view)
        self._run(CHOICE, gbuffer, lights, [(0, 0)], threshold=threshold)
        return self._textures[_RESULTS[CHOICE]]

    def _run(self, step, gbuffer, lights, ranges, **constants) -> None:
        shader, uploaded = self._shaders[step], {**self._textures, "lights": lights.texture}
        textures = {name: uploaded.get(name) or getattr(gbuffer, SAMPLERS[name]) for name in HORIZON_SAMPLERS[step]}
        with drawing(self._buffers[step], (0, 0, *self._size), depth=WITHIN_MASK[gbuffer.mask is not None]):
            shader.bind(textures, constants)
            for draw_range in ranges:
                shader.draw(**({} if step == CHOICE else {"draw_range": draw_range}))
                gpu.state.blend_set("ADDITIVE_PREMULT")


class LightingPass:
    """One technique, ready to draw. Needs an active GPU context, and must be dropped before that goes."""

    def __init__(self, technique: str | LookupTable):
        """`technique` is "ltc", "ltsh2", "ltsh4", "ltsh4c", the path of a table, or a table of degree up to 4.

        Raises TableError and ValueError.
        """
        self.table = technique if isinstance(technique, LookupTable) else load_table(technique)
        self._shaders: dict[Features, tuple] = {}
        self.number = 0  # of the picture: selects the directions in which lobes sample the world
        self._table = float_texture(table_texels(self.table))
        self._dielectrics = float_texture(dielectric_texels(self.table))
        self._sky = None
        self.set_lights(())

    def set_lights(self, lights: Iterable[Light] | UploadedLights) -> None:
        """Set the lights. Light groups are added up."""
        uploaded = lights if isinstance(lights, UploadedLights) else upload_lights(lights)
        self._lights, self._sky = uploaded.texture, uploaded.sky
        self._loops = [_loops(light) for light in uploaded.lights]
        self._has_focused = any(light.has_profile for light in uploaded.lights)
        self._has_facing = any(light.is_facing for light in uploaded.lights)
        self._has_patterns = any(light.pattern is not None for light in uploaded.lights)

    def draw(
        self,
        gbuffer: GBufferTextures,
        target: gpu.types.GPUOffScreen | gpu.types.GPUFrameBuffer,
        passes: str = "combined",
        *,
        view: Sequence[float],
        blend: str = "NONE",
        numbers: Collection[int] | None = None,
    ) -> None:
        """Write RGB radiance in W m^-2 sr^-1 and alpha 1 where the G-buffer has a surface, 0 elsewhere.

        `passes` is "specular", "diffuse" or "combined"; `view` is that of `HorizonPass.draw`. `target` has the size of
        the G-buffer. Of a G-buffer with a mask only surfaces are written; the mask must be the target's depth buffer.
        `blend` is "NONE", "ADDITIVE" to add the radiance (a further lobe of the same surfaces), or "ADDITIVE_PREMULT"
        to add radiance and alpha. `numbers` are those of the lights to draw, with that of the world's light after
        the others; None: all.
        """
        if passes not in _SHOWN_PASSES:
            raise ValueError(f"lighting pass: passes is {passes!r}, expected one of {', '.join(_SHOWN_PASSES)}")
        features = Features(
            specular=passes != "diffuse",
            diffuse=passes != "specular",
            geometric=passes != "diffuse" and gbuffer.geometric_normal is not None,
            bumped=passes != "specular" and gbuffer.smooth_normal is not None,
            focused=self._has_focused,
            turned=passes != "specular" and gbuffer.diffuse_normal is not None,
            shadowed=gbuffer.visibility is not None,
            facing=self._has_facing,
            patterned=self._has_patterns,
            sky=self._sky is not None,
            sheen=passes != "specular" and gbuffer.has_sheen,
            rough=passes != "specular" and gbuffer.rebound is not None,
            velvet=passes != "specular" and gbuffer.has_velvet,
            bent=passes != "diffuse" and gbuffer.has_bent,
        )
        shaders = [features]
        if features.specular and gbuffer.tangent is not None:
            # Anisotropic lobes have a shader of their own, which integrates Fresnel's factor with them.
            shaders = [replace(features, brushing=True), replace(features, brushing=True, brushed=True, bent=False)]
        if features.specular and features.rough:
            # Draw the rough diffuse lobe by itself: both lobes together may read too many textures.
            none = {"diffuse": False, "bumped": False, "turned": False, "sheen": False, "rough": False, "velvet": False}
            alone = replace(features, specular=False, geometric=False, bent=False)
            shaders = [*(replace(shader, **none) for shader in shaders), alone]
        with drawing(target, (0, 0, *gbuffer.size), blend, WITHIN_MASK[gbuffer.mask is not None]):
            for features in shaders:
                self._draw(features, gbuffer, view, numbers)

    def _ranges(self, numbers: Collection[int] | None) -> list[tuple[int, int]]:
        """The lights (first, end) of each draw call."""
        if numbers is None:
            return draw_ranges(self._loops)
        chosen = np.array(sorted(set(numbers) - {len(self._loops)}), int)
        runs = np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1) if len(chosen) else ()
        return [
            (int(run[0]) + first, int(run[0]) + end)
            for run in runs
            for first, end in draw_ranges(self._loops[run[0] : run[-1] + 1])
        ] or [(0, 0)]

    def _draw(self, features: Features, gbuffer: GBufferTextures, view, numbers) -> None:
        if features not in self._shaders:
            self._shaders[features] = lighting_shader(self.table, features)
        shader = self._shaders[features]
        constants = {
            "view": view,
            "jitter": ((0.5 + self.number * GOLDEN) % 1.0, self.number * TURN),
            "grid": Matrix(gbuffer.visibility.projection.tolist()) if features.shadowed else None,
        }
        textures = {name: self._texture(name, gbuffer) for name in features.samplers}
        shader.bind(textures, {name: constants[name] for name in features.constants if name in constants})
        has_sky = {"has_sky": numbers is None or len(self._loops) in numbers} if features.sky else {}
        for draw_range in self._ranges(numbers):
            shader.draw(draw_range=draw_range, **has_sky)
            has_sky = dict.fromkeys(has_sky, False)
            gpu.state.blend_set("ADDITIVE")

    def _texture(self, name, gbuffer):
        uploaded = {"lights": self._lights, "table": self._table, "dielectrics": self._dielectrics, "sky": self._sky}
        if name in uploaded:
            return uploaded[name]
        if name in VISIBILITY_SAMPLERS:
            return getattr(gbuffer.visibility, VISIBILITY_SAMPLERS[name])
        return getattr(gbuffer, SAMPLERS[name])


def _loops(light: Light) -> int:
    """Approximate upper limit of the iterations of the loops over a light's corners."""
    if light.has_profile:
        return 16000 if light.is_round else 2000
    return 1200 if light.is_round else 10 * len(light.polygon())
