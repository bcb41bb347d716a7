"""`MovedLights`: pictures of the lights of a kept picture at new places, by rays of these lights alone.

A draft comes first: it shades every second pixel of every second row, and all samples that differ from these; the
others are interpolated. Then all samples are shaded, block after block, the brightest blocks first.
"""

from __future__ import annotations

import itertools
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..cycles.gbuffer import SHADOW_LOOSENESS, one_shading, with_one_shadow
from ..emitters.light_polygons import has_lobe
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
# STEP: distance of the pixels of a draft. DRAFT_RAYS: the most rays of one of its samples.
STEP, DRAFT_RAYS = 2, 32
# MOST_LIKE: a similar sample is looked for among so many of a grid pixel. LEAST_WEIGHT: a sample is interpolated if the
# weights of the similar samples around it add up to at least this.
MOST_LIKE, LEAST_WEIGHT = 4, 0.5
# SECONDS: time between two pictures that are yielded.
SECONDS = 1.0


@dataclass(frozen=True)
class Draft:
    """Q of P samples, from which the radiance of all P is interpolated: radiance over color, times the own color."""

    index: np.ndarray  # (Q,) of the samples of the draft
    sources: np.ndarray  # (4, P) numbers of samples of the draft, 0 to Q - 1
    weights: np.ndarray  # (4, P) of the sources
    colors: dict[str, np.ndarray]  # by pass, (P, 3)

    @classmethod
    def of(cls, samples: SurfaceSamples, film: Film) -> Draft:
        """The draft with the samples of a grid of pixels, and all samples that differ from the grid's around them."""
        lobes, pixels = has_lobe(samples), film.width * film.height
        order = np.argsort(film.pixel, kind="stable")
        count = np.bincount(film.pixel, minlength=pixels)
        first = np.cumsum(count) - count
        x, y = film.pixel % film.width, film.pixel // film.width
        is_own = (x % STEP == 0) & (y % STEP == 0)
        shape = 4, len(samples)
        like, weights = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
        for corner, (right, below) in enumerate(itertools.product((0, 1), repeat=2)):
            column, row = (STEP * (coordinate // STEP + step) for coordinate, step in ((x, right), (y, below)))
            weight = (1.0 - np.abs(column - x) / STEP) * (1.0 - np.abs(row - y) / STEP)
            there = ~is_own & (weight > 0.0) & (column < film.width) & (row < film.height)
            pixel = np.where(there, row * film.width + column, 0)
            for slot in range(MOST_LIKE):
                one = np.flatnonzero(there & (count[pixel] > slot))
                other = order[first[pixel[one]] + slot]
                same = one_shading(samples, lobes[1], one, other, SHADOW_LOOSENESS)
                same &= (lobes[:, one] == lobes[:, other]).all(axis=0)
                like[corner, one[same]], weights[corner, one[same]] = other[same], weight[one[same]]
                there[one[same]] = False
        whole = weights.sum(axis=0)
        is_own |= whole < LEAST_WEIGHT
        weights /= np.maximum(whole, LEAST_WEIGHT)
        weights[:, is_own] = np.array([1.0, 0.0, 0.0, 0.0])[:, None]
        like[0, is_own] = index = np.flatnonzero(is_own)
        number = np.zeros(len(samples), np.int32)
        number[index] = np.arange(len(index))
        specular = samples.specular_f0 + 0.05 * samples.specular_f90 + 0.05 * samples.dielectric
        colors = {"specular": specular.astype(np.float32), "diffuse": samples.diffuse_albedo.astype(np.float32)}
        return cls(index, number[like], weights, colors)

    def all_samples(self, name: str, radiance: np.ndarray) -> np.ndarray:
        """Radiance (P, 3) of all samples in the pass `name`, from the `radiance` (Q, 3) of the draft's."""
        color = self.colors[name]
        light = np.divide(radiance, color[self.index], out=np.zeros_like(radiance), where=color[self.index] > 0.0)
        interpolated = np.zeros_like(color)
        for source, weight in zip(self.sources, self.weights, strict=True):
            interpolated += weight[:, None] * light[source]
        return interpolated * color


def _coarse(film: Film) -> Film:
    """The same samples on a film with pixels STEP times as wide and high."""
    width, height = (-(-size // STEP) for size in (film.width, film.height))
    x, y = film.pixel % film.width, film.pixel // film.width
    return replace(film, width=width, height=height, pixel=y // STEP * width + x // STEP)


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
        turn = self._next_turn()
        with self._lock:
            task = self._prepared(light, turn)
            radiance = self._black(self._whole)
            for _ in self._lit(task, self._whole, range(len(self._whole.blocks)), radiance, turn):
                pass
            return self._image(radiance, row)

    def pictures(self, light: Light, row: MixerRow | None = None) -> Iterator[tuple[np.ndarray, float]]:
        """Yield the result of `picture`, first as a draft and at last complete, and the fraction that is done."""
        self._is_ready = True
        return self._pictures(light, row, self._next_turn())

    def _pictures(self, light, row, turn):
        with self._lock:
            task, draft = self._prepared(light, turn), self._black(self._drafted)
            quick, blocks = task, self._whole.blocks
            if task.shadows is not None:
                quick = replace(task, shadows=replace(task.shadows, rays=min(task.shadows.rays, DRAFT_RAYS)))
            for _ in self._lit(quick, self._drafted, range(len(self._drafted.blocks)), draft, turn):
                pass
            radiance = {name: self._draft.all_samples(name, values) for name, values in draft.items()}
            yield self._image(radiance, row), 0.0
            light_of = [sum(values[index].sum() for values in radiance.values()) for index, _ in blocks]
            shown, order = time.monotonic(), sorted(range(len(blocks)), key=light_of.__getitem__, reverse=True)
            for done in self._lit(task, self._whole, order, radiance, turn):
                if done == len(order) or time.monotonic() - shown > SECONDS:
                    yield self._image(radiance, row), done / len(order)
                    shown = time.monotonic()

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
        shadows = shadow_task(self._whole.shadowed, (light,), self._tracer, self._passes, rays)
        # The light gets as many rays as it would get in a new picture, beside the other lights.
        typical = {name: max(value, self._typical[name]) for name, value in shadows.typical.items()}
        return MovedLightTask(light, replace(shadows, typical=typical), self._table, self._passes)

    def _black(self, lit: LitSamples) -> dict[str, np.ndarray]:
        return {name: np.zeros((len(lit.samples), 3), np.float32) for name in self._passes}

    def _lit(self, task: MovedLightTask, lit: LitSamples, order: Sequence[int], radiance, turn: int) -> Iterator[int]:
        """Put what the blocks of `lit` reflect into `radiance`, (P, 3) by pass; yields how many are done."""

        def store(number, by_pass):
            for name, values in by_pass.items():
                radiance[name][lit.blocks[order[number]][0]] = values

        is_worth = len(self._whole.samples) >= SAMPLES_WORTH_A_WORKER
        for done in self._pool.run(task, len(order), lambda number: lit.job(order[number]), store, is_worth):
            self._check(turn)
            yield done

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
        self._draft = draft = Draft.of(samples, film)
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
                self._typical = shadow_task(shadowed, lights, self._tracer, self._passes, DRAFT_RAYS).typical
                origins = trace_ray_origins(shadowed, pool)
            self._whole = LitSamples.of(samples, shadowed, film, shadow, origins)
            index, shadow = np.unique(shadow[draft.index], return_inverse=True)
            quick = samples.take(draft.index), shadowed.take(index), _coarse(film.take(index))
            self._drafted = LitSamples.of(*quick, shadow, origins and origins.take(index))
            self._pool = pool
            self._ending.callback(stack.pop_all().close)
