"""`MovedLights`: pictures of the lights of a kept picture at new places, by rays of these lights alone."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..cycles.gbuffer import with_one_shadow
from ..lobes.lookup_table import LookupTable
from ..scene import Cancelled, Film, Light, SurfaceSamples
from ..shading import shade
from ..visibility import (
    BLOCK_SAMPLES,
    Occluders,
    RayOrigins,
    ShadowTask,
    Tracer,
    open_tracer,
    shadow_task,
    trace_ray_origins,
)
from ..workers.pool import WorkerPool
from .lighting import load_tables, rays_of_samples
from .mixer import MixerRow, bounced_light
from .relight import OCCLUDERS_SUFFIX, RELIGHT_SUFFIX, RelightData

# BLOCKS: enough that all processes end at about the same time. FEWEST_OF_BLOCK: the overhead of smaller blocks exceeds
# the cost of their samples.
BLOCKS, FEWEST_OF_BLOCK = 16, 1 << 11
# With fewer samples, starting a worker takes longer than its help saves.
SAMPLES_WORTH_A_WORKER = 1 << 13
# FEW_RAYS: the most rays of a sample where the light of a typical one is looked for.
FEW_RAYS = 32


@dataclass(frozen=True)
class LitSamples:
    """P samples to shade, and the Q samples from which their shadow rays start, in blocks."""

    samples: SurfaceSamples  # (P)
    shadowed: SurfaceSamples  # (Q)
    film: Film  # (Q)
    shadow: np.ndarray  # (P,) for each of `samples`, the number of the one of `shadowed` whose visibility it takes
    ray_origins: RayOrigins | None  # (Q)
    blocks: list[tuple[np.ndarray | slice, slice]]  # of each block, the indices of `samples` and of `shadowed`

    @classmethod
    def of(cls, samples, shadowed, film, shadow, ray_origins) -> LitSamples:
        """With blocks of about equal size."""
        order = np.argsort(shadow, kind="stable")
        size, blocks = min(BLOCK_SAMPLES, max(len(shadowed) // BLOCKS, FEWEST_OF_BLOCK)), []
        for first in range(0, max(len(shadowed), 1), size):
            begin, end = np.searchsorted(shadow[order], (first, first + size))
            block = slice(first, min(first + size, len(shadowed)))
            blocks.append((block if samples is shadowed else order[begin:end], block))
        return cls(samples, shadowed, film, shadow, ray_origins, blocks)

    def job(self, number: int) -> tuple:
        """The block that `MovedLightTask.do` shades."""
        (index, block), origins = self.blocks[number], self.ray_origins
        visibility_job = self.shadowed.take(block), self.film.take(block), origins and origins.take(block)
        return self.samples.take(index), self.shadow[index] - block.start, visibility_job


@dataclass(frozen=True)
class MovedLightTask:
    """Shades blocks of samples under one light."""

    light: Light
    shadows: ShadowTask | None  # None: nothing stands in the way
    table: LookupTable
    passes: tuple[str, ...]

    def do(self, job: tuple, tracer: Tracer | None) -> dict[str, np.ndarray]:
        """The radiance (B, 3) by pass of a block."""
        samples, shadow, visibility_job = job
        visibility = dict.fromkeys(self.passes, np.float32(1.0))
        if self.shadows is not None:
            traced = self.shadows.do(visibility_job, tracer)
            visibility = {name: getattr(traced, name)[0][shadow, None] for name in self.passes}
        if not any(values.any() for values in visibility.values()):
            return {name: np.zeros((len(samples), 3), np.float32) for name in self.passes}
        lit = shade(samples, [self.light], self.table, passes=self.passes, workers=1)
        return {name: visibility[name] * getattr(lit, name)[0] for name in self.passes}


class MovedLights:
    """Pictures of single lights of a kept picture at new places, by rays of the light alone.

    The first picture starts workers, so that later pictures take less; `close` ends them.
    Threads may share an object: a new request cancels the one in progress, which raises Cancelled.
    """

    def __init__(self, read: Callable[[], tuple[RelightData, Occluders | None]]):
        """`read` is called at the first picture; its exceptions are raised there."""
        self._read, self._relight_data, self._occluders = read, None, None
        self._pool, self._ending = None, ExitStack()
        # Without `close`, the workers end with this object or with Python.
        weakref.finalize(self, self._ending.close)
        self._lock, self._is_ready, self._turn = threading.Lock(), False, 0

    @classmethod
    def load(cls, path: Path) -> MovedLights:
        """The moved lights of the picture whose samples are in `path`.

        The first picture raises OSError or ValueError where the file cannot be read.
        """

        def read():
            relight_data, occluders = RelightData.load(path), None
            if relight_data.shadows is not None:
                occluders = Occluders.load(path.with_name(path.name.removesuffix(RELIGHT_SUFFIX) + OCCLUDERS_SUFFIX))
            return relight_data, occluders

        return cls(read)

    def get_ready(self, light: Light) -> None:
        """Start, once and in a thread, what the first picture needs; `light` is any light of the picture."""
        if not self._is_ready:
            pictures = self.pictures(light)
            threading.Thread(target=self._try, args=(pictures,), name="LTSH lights", daemon=True).start()

    def _try(self, pictures) -> None:
        # The next request for a picture raises the same error.
        with suppress(Exception), closing(pictures):
            next(pictures)

    def picture(self, light: Light, row: MixerRow | None = None) -> np.ndarray:
        """The picture (H, W, 3) of one light, plus the unchanged bounced light of its `row`. Raises SceneError."""
        *_, (picture, _) = self.pictures(light, row)
        return picture

    def pictures(self, light: Light, row: MixerRow | None = None) -> Iterator[tuple[np.ndarray | None, float]]:
        """Yield None and the fraction that is done, block after block, and at last the result of `picture` and 1."""
        self._is_ready = True
        return self._pictures(light, row, self._next_turn())

    def _pictures(self, light, row, turn):
        with self._lock:
            task, lit = self._prepared(light, turn), self._lit
            radiance = {name: np.zeros((len(lit.samples), 3), np.float32) for name in self._passes}

            def store(number, by_pass):
                for name, values in by_pass.items():
                    radiance[name][lit.blocks[number][0]] = values

            is_worth = len(lit.samples) >= SAMPLES_WORTH_A_WORKER
            for done in self._pool.run(task, len(lit.blocks), lit.job, store, is_worth):
                self._check(turn)
                yield None, done / len(lit.blocks)
            yield self._image(radiance, row), 1.0

    def stop(self) -> None:
        """Cancel the picture in progress: its request raises Cancelled."""
        self._next_turn()

    def _next_turn(self) -> int:
        self._turn += 1
        return self._turn

    def _check(self, turn: int) -> None:
        if turn != self._turn:
            raise Cancelled("the light has moved again, or the picture was stopped")

    def _prepared(self, light: Light, turn: int) -> MovedLightTask:
        """The task for a light."""
        self._check(turn)
        if self._pool is None:
            self._start()
        if self._tracer is None:
            return MovedLightTask(light, None, self._table, self._passes)
        relight_data = self._relight_data
        rays = rays_of_samples(relight_data.options["shadow_rays"], relight_data.extraction.film)
        shadows = shadow_task(self._lit.shadowed, (light,), self._tracer, self._passes, rays)
        # The light gets as many rays as it would get in a new picture, beside the other lights.
        typical = {name: max(value, self._typical[name]) for name, value in shadows.typical.items()}
        return MovedLightTask(light, replace(shadows, typical=typical), self._table, self._passes)

    def _image(self, values, row: MixerRow | None) -> np.ndarray:
        relight_data = self._relight_data
        image = np.zeros((relight_data.extraction.film.height, relight_data.extraction.film.width, 3), np.float32)
        for name, radiance in values.items():
            image += relight_data.shown(name, moved=True) * relight_data.extraction.film.image(
                relight_data.extraction.picture.exposure * radiance
            )
        return image if row is None else image + bounced_light(relight_data, row)

    def close(self) -> None:
        """End the processes; the next picture starts new ones."""
        self.stop()
        with self._lock:
            self._pool, self._is_ready = None, False
            self._ending.close()

    def _start(self) -> None:
        from ..blender.process.blender_process import embree_libraries

        if self._relight_data is None:
            self._relight_data, self._occluders = self._read()
        relight_data, film = self._relight_data, self._relight_data.extraction.film
        samples = shadowed = relight_data.extraction.samples
        shadow = np.arange(len(samples))
        # Rays use the film only to know which samples are neighbors.
        film = film.unspread()
        if film.count is not None:
            shadowed, film, shadow = with_one_shadow(samples, film)
        self._passes = tuple(relight_data.options["passes"])
        (self._table,) = load_tables((relight_data.technique,)).values()
        with ExitStack() as stack:
            self._tracer = origins = None
            if self._occluders is not None:
                self._tracer = stack.enter_context(open_tracer(self._occluders, embree_libraries()))
            pool = stack.enter_context(WorkerPool(self._tracer))
            if self._tracer is not None:
                lights = relight_data.extraction.lights
                self._typical = shadow_task(shadowed, lights, self._tracer, self._passes, FEW_RAYS).typical
                origins = trace_ray_origins(shadowed, pool)
            self._lit = LitSamples.of(samples, shadowed, film, shadow, origins)
            self._pool = pool
            self._ending.callback(stack.pop_all().close)
