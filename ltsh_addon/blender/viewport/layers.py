"""The G-buffer of surfaces or glass, with the horizons that end its lobes."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import gpu

from .camera import ViewCamera
from .gbuffer import GBufferTextures, VisibilityGrid
from .light_texels import UploadedLights
from .lighting import HorizonPass
from .surfaces import SurfacePass, has_bent_lobes


class SurfaceLayer:
    """The G-buffer of one layer, surfaces or glass, and the horizons that end its lobes."""

    def __init__(self, before: SurfaceLayer | None = None):
        self._surfaces = SurfacePass(None if before is None else before._surfaces)
        self._horizons = defaultdict(HorizonPass)  # of the first lobes (False), which stay, and of further ones (True)
        self._gbuffer: GBufferTextures | None = None
        self._first_lobe: GBufferTextures | None = None
        self.smooth_normal: gpu.types.GPUTexture | None = None  # of the lobe that is lit
        self.visibility: VisibilityGrid | None = None  # of the lights from all lobes
        self.threshold = 0.5  # see `HorizonPass.draw`
        self.through, self.add_emission = self._surfaces.through, self._surfaces.add_emission

    def draw(self, mirror, view: ViewCamera, size) -> None:
        """Draw the surfaces."""
        self._first_lobe = None
        self._gbuffer = self._surfaces.draw(mirror.instances, view, size)

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
        gbuffer = self._surfaces.draw_lobe(number, mirror.instances, view)
        return self._with_horizons(gbuffer, True, mirror, view, lights)

    def _with_horizons(self, gbuffer, is_further: bool, mirror, view: ViewCamera, lights) -> GBufferTextures:
        self.smooth_normal = gbuffer.smooth_normal
        if gbuffer.geometric_normal is None:
            return gbuffer
        horizon = self._horizons[is_further].draw(gbuffer, lights, view.homogeneous_eye, self.threshold)
        smooth_normal = gbuffer.smooth_normal if has_bent_lobes(mirror.instances) else None
        return replace(gbuffer, geometric_normal=horizon, smooth_normal=smooth_normal)
