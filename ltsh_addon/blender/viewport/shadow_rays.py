"""The visibility of each light at the pixels of a view, traced as for pictures, with the same occluders."""

import time
from collections.abc import Callable, Sequence
from functools import cached_property

import gpu
import numpy as np

from ...scene import PASSES, Film, Light
from ...visibility import Occluders, ShadowSampling, Tracer, open_tracer, trace_visibility
from ...workers.pool import WorkerPool, cores
from ..extract.occluders import collect_occluders
from ..lights.meshes import StandInLight
from ..lights.world import blocks_nothing
from ..process.blender_process import embree_libraries
from .drawing import GBufferTextures, ViewCamera, VisibilityGrid, float_buffer, gbuffer_texels, samples_of_texels
from .pictures import is_equal

Lights = Sequence[Light]
# MOST_BYTES: graphics memory for the visibility of all lights. _LIGHT_BYTES: of a light and a pixel, two half floats.
MOST_BYTES = 1 << 30
_LIGHT_BYTES = 4
# QUICK_SECONDS: occluders that take longer to collect are only collected once no object moves any more.
QUICK_SECONDS = 0.03


class ViewTracer:
    """A tracer of occluders, and the pool of this process and workers, at most `processes`, that trace with it."""

    def __init__(self, occluders: Occluders, processes: int = 2):
        self.occluders, self._processes = occluders, processes
        self.pool: WorkerPool | None = None
        self.rays = 0  # traced by requests

    @cached_property
    def tracer(self) -> Tracer:
        """The tracer. Raises SceneError where Embree is missing."""
        tracer = open_tracer(self.occluders, embree_libraries())
        self.pool = WorkerPool(tracer, min(cores(), self._processes), background=True)
        return tracer

    def close(self) -> None:
        """End the worker."""
        if self.pool is not None:
            self.pool.close()


class TracedScene:
    """The scene whose shadows are shown, and its tracer, which stays while only colors change."""

    def __init__(self):
        self.scene, self.collect, self.collected, self.before = None, None, None, None
        self.tracing: ViewTracer | None = None
        self.collect_seconds, self.version = 0.0, 0  # version: of the occluders

    def may_collect(self) -> bool:
        """True if the occluders are known or quick to collect, or if nothing has moved since the last call."""
        if self.collected == self.scene or self.collect_seconds <= QUICK_SECONDS or self.scene == self.before:
            return True
        self.before = self.scene
        return False

    def collect_now(self) -> None:
        """Collect the occluders, unless they are known."""
        if self.collected == self.scene:
            return
        start, occluders = time.perf_counter(), self.collect()
        if self.tracing is None or not is_equal(occluders, self.tracing.occluders):
            self.close()
            self.tracing, self.version = ViewTracer(occluders), self.version + 1
        self.collected, self.collect_seconds = self.scene, time.perf_counter() - start

    def close(self) -> None:
        """End the process that helps the tracer."""
        if self.tracing is not None:
            self.tracing.close()


class ShadowRays:
    """Traces, at once, the visibility of lights from the pixels of G-buffers.

    A pixel takes at most `rays` rays per light.
    """

    version, waits, is_fine, traces_lobes = 0, False, True, True

    @property
    def of_glass(self) -> "ShadowRays":
        """The tracer for the glass in front of the surfaces: the same."""
        return self

    def take_news(self) -> None:
        """Do nothing: there is never news, because everything is traced at once."""

    def __init__(self, tracing: ViewTracer, rays: int):
        self._tracing, self._rays = tracing, rays
        self.seconds, self.traced, self.description = 0.0, 0, ""
        # By pass, summed over all calls: squares of the reflected light of pixels, and of its standard deviation.
        self._power = {name: np.zeros(2) for name in PASSES}

    def visibility(
        self, gbuffer: GBufferTextures, view: ViewCamera, lights: Lights, sides: Lights = (), number: int = 0
    ) -> VisibilityGrid | None:
        """The visibility of `lights`, and last that of the `sides` of a sky if there are any; None without surfaces or
        lights. Raises SceneError."""
        start = time.perf_counter()
        samples, pixel = samples_of_texels(gbuffer_texels(gbuffer), view)
        if not len(samples) or not (lights or sides):
            return None
        width, height = gbuffer.size
        tracer = self._tracing.tracer
        film = Film(width, height, pixel)
        sampling, pool = ShadowSampling(rays=self._rays, film=film), self._tracing.pool
        traced_lights, first = rays_to(shadowed_lights(lights, sides))
        traced = trace_visibility(samples, traced_lights, tracer, sampling, workers=pool)
        values = np.ones((len(first), height * width, len(PASSES)), np.float32)
        for index, name in enumerate(PASSES):
            values[:, pixel, index] = traced.of_lights(name)[first]
            for row, of_passes in enumerate((traced.radiance, traced.deviation)):
                self._power[name][row] += np.square(of_passes[name], dtype=np.float64).sum()
        self.seconds += time.perf_counter() - start
        self.traced, self.description = self.traced + traced.rays, tracer.description
        return VisibilityGrid(visibility_texture(values, gbuffer.size), gbuffer.position, view.projection)

    def facts(self, samples: int) -> dict:
        """Those of `pipeline.lighting.Shadows.report`, and the seconds; the noise is the estimated relative L2 error by
        pass of the shadows in the mean of `samples` pictures."""
        noise = {
            name: float(np.sqrt(variance / max(power, 1e-30) / samples))
            for name, (power, variance) in self._power.items()
        }
        return {"rays": self.traced, "noise": noise, "tracer": self.description, "seconds": self.seconds}


def shadowed_lights(lights: Lights, sides: Lights) -> tuple[Lights, ...]:
    """Where rays to each of `lights` go, and last to the `sides` of a sky, if any: to the lights themselves, to all
    faces for which they stand, or to the sides together."""
    alone = (light.faces if isinstance(light, StandInLight) else (light,) for light in lights)
    return (*alone, *((sides,) if sides else ()))


def rays_to(shadowed: Sequence[Lights]) -> tuple[Lights, list[int]]:
    """The lights of all tuples of `shadowed`, each tuple once, and the number of the first light of each tuple."""
    once = {id(lights): lights for lights in shadowed}
    first = dict(zip(once, np.cumsum([0, *map(len, once.values())]).tolist(), strict=False))
    return [light for lights in once.values() for light in lights], [first[id(lights)] for lights in shadowed]


def view_occluders(depsgraph, note: Callable[[str], None], unread: list | None = None) -> Occluders:
    """What casts shadows in a view; `note` gets what is approximated. `unread`: see `collect_occluders`."""
    override = depsgraph.view_layer_eval.material_override
    return blocks_nothing(collect_occluders(depsgraph, override, note, unread=unread), depsgraph.scene.world)


def visibility_texture(values: np.ndarray, size: tuple[int, int]) -> gpu.types.GPUTexture:
    """Array texture of visibility (L, H W, 2) on pictures of `size`."""
    return gpu.types.GPUTexture(size, layers=len(values), format="RG16F", data=float_buffer(values))


def too_many(lights: int, size: tuple[int, int]) -> str:
    """Note that the visibility of so many lights does not fit into memory; empty where it does."""
    needed = lights * size[0] * size[1] * _LIGHT_BYTES
    if needed <= MOST_BYTES:
        return ""
    return f"shadows are not drawn: those of {lights} lights need {needed / 2**30:.1f} GiB of graphics memory"
