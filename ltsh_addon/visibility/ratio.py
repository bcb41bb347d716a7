"""The visibility of each light from each sample: `trace_visibility`.

The ratio estimator (Heitz, Hill and McGuire 2018, "Combining analytic direct illumination and stochastic shadows",
doi:10.1145/3190834.3190852): shadowed radiance = closed form x sum(w V) / sum(w). V is the transmittance of a ray to
the light. w is what the pass reflects of the light along the ray, divided by the probability density of the ray. Both
passes use the same rays.

Like samples of pixels beside each other share their rays to a sky or to many lights. They take directions in turns
(Ahmed and Wonka 2020, "Screen-space blue-noise diffusion of Monte Carlo sampling error via hierarchical ordering of
pixels", doi:10.1145/3414685.3417881), so that the result depends on the block. All else depends on neighbors alone.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..scene import PASSES, Cancelled, Film, Light, Progress, SurfaceSamples
from ..workers.pool import WorkerPool, opened
from .emitter import Emitter
from .estimator import MOST_RAYS, PixelNeighbors, RatioEstimator
from .light_cluster import LightCluster, emitters_of
from .light_selection import LightSelection
from .ray_sampler import PROBES, JoinedLobes, SampleRows
from .shadow_terminator import RayOrigins

# Samples that one process takes at a time, approximately.
BLOCK_SAMPLES = 1 << 15
# Processor seconds for the probes of all pairs, and number of samples whose rays' origins are looked for, from which on
# workers are worth their start.
SECONDS_WORTH_A_WORKER, SAMPLES_WORTH_A_WORKER = 1.0, 1 << 17
# Most samples, and most pairs of a sample and a light, that are traced to find the typical radiance.
TYPICAL_SAMPLES, TYPICAL_PAIRS = 2048, 1 << 20


@dataclass(frozen=True)
class Visibility:
    """Shares of E emitters that P samples see by pass, in [0, 1]; None for a pass that was not asked for.

    An emitter is one light, or several lights that share their rays; `numbers` lists them.

    The share is exactly 1 where nothing is in the way and where no light would arrive anyway. It is exactly 0 where
    everything is blocked.
    """

    specular: np.ndarray | None  # (E, P) float32
    diffuse: np.ndarray | None
    # By pass, over all lights: the approximate radiance (P,) that each sample reflects, and its standard deviation. Of
    # two samples that `JoinedLobes` joins, the first has both.
    radiance: dict[str, np.ndarray]
    deviation: dict[str, np.ndarray]
    rays: int  # number of rays traced
    mixed: np.ndarray  # (E, P) bool: pairs of which some rays arrived and some did not
    numbers: tuple[tuple[int, ...], ...] = ()  # the numbers of the lights of each emitter

    def of_lights(self, name: str) -> np.ndarray:
        """The shares (L, P) of pass `name` by light."""
        by_emitter = getattr(self, name)
        by_light = np.empty((sum(map(len, self.numbers)), by_emitter.shape[1]), np.float32)
        for numbers, visibility in zip(self.numbers, by_emitter, strict=True):
            by_light[list(numbers)] = visibility
        return by_light

    def noise(self, name: str, film: Film | None = None) -> float:
        """Relative L2 error of a pass, estimated from the two halves of the rays, over the samples, or over the pixels
        of `film`."""
        light, variance = self.radiance[name], np.square(self.deviation[name])
        if film is not None:
            # The errors of the samples of a pixel are independent.
            light, variance = film.image(light), film.variance(variance)
        power = np.square(light, dtype=np.float64).sum()
        return float(np.sqrt(variance.sum(dtype=np.float64) / max(power, 1e-30)))


@dataclass(frozen=True)
class ShadowSampling:
    """How to find the shares of samples. Raises ValueError for a number of `rays` out of range."""

    passes: Sequence[str] = PASSES
    # Most rays for a pair of a sample and a light: 8 to 1024, in eights. From 16 on, pairs that are much brighter than
    # the picture get up to four times as many, but never more than 1024.
    rays: int = 256
    film: Film | None = None  # tells which samples are neighbors; without it, consecutive samples are
    is_baked: bool = False  # True: each pass is baked by itself, so Cycles chooses rays by its lobes alone

    def __post_init__(self):
        if not PROBES <= self.rays <= MOST_RAYS:
            raise ValueError(f"shadow rays are {self.rays}, expected {PROBES} to {MOST_RAYS}")


def trace_visibility(
    samples: SurfaceSamples,
    lights: Sequence[Light],
    tracer,
    sampling: ShadowSampling = ShadowSampling(),
    *,
    workers: int | WorkerPool | None = None,
    ray_origins: RayOrigins | None = None,
    progress: Progress | None = None,
) -> Visibility:
    """The shares of `lights` that P samples see. `tracer` comes from `visibility.open_tracer`.

    `workers` is a number of processes (None: all cores) or a WorkerPool of the tracer; the result is the same bit for
    bit. If there are few samples, this process does them alone. `ray_origins` come from `trace_ray_origins` if they are
    known. `progress` may return False to stop: Cancelled is raised.
    """
    (emitters, numbers), passes = emitters_of(lights, tracer), tuple(sampling.passes)
    film = None if sampling.film is None else sampling.film.unspread()
    typical = dict.fromkeys(passes, 1.0)
    task = ShadowTask(emitters, passes, sampling.rays // PROBES * PROBES, typical, sampling.is_baked)
    start = time.thread_time()
    typical, probed = typical_radiance(samples, task, tracer)
    seconds = (time.thread_time() - start) * len(samples) / max(probed, 1)
    task = replace(task, typical=typical)
    shape = len(emitters), len(samples)
    visibility = {name: np.ones(shape, np.float32) for name in passes}
    radiance, deviation = ({name: np.zeros(shape[1], np.float32) for name in passes} for _ in range(2))
    blocks, mixed = _blocks(shape[1], film), np.zeros(shape, bool)
    traced = np.zeros(len(blocks), np.int64)

    def job(number):
        return tuple(None if one is None else one.take(blocks[number]) for one in (samples, film, ray_origins))

    def store(number, traced_block):
        block = blocks[number]
        for name in passes:
            visibility[name][:, block] = getattr(traced_block, name)
            radiance[name][block], deviation[name][block] = traced_block.radiance[name], traced_block.deviation[name]
        mixed[:, block], traced[number] = traced_block.mixed, traced_block.rays

    with opened(workers, tracer) as pool:
        for done in pool.run(task, len(blocks), job, store, seconds > SECONDS_WORTH_A_WORKER):
            _go_on(progress, done / len(blocks))
    by_pass = visibility.get("specular"), visibility.get("diffuse")
    return Visibility(*by_pass, radiance, deviation, int(traced.sum()), mixed, numbers)


def trace_ray_origins(samples: SurfaceSamples, pool: WorkerPool, progress: Progress | None = None) -> RayOrigins:
    """Where rays from P samples start, found by the processes of `pool`, whose context is a tracer.

    `progress` may stop it, as in `trace_visibility`.
    """
    blocks, ray_origins = _blocks(len(samples)), RayOrigins.empty(len(samples))
    for done in pool.run(
        OriginTask(),
        len(blocks),
        lambda number: samples.take(blocks[number]),
        lambda number, origins: ray_origins.put(blocks[number], origins),
        len(samples) >= SAMPLES_WORTH_A_WORKER,
    ):
        _go_on(progress, done / len(blocks))
    return ray_origins


def _go_on(progress: Progress | None, share: float) -> None:
    """Report the share that is done. Raises Cancelled if `progress` stops the work."""
    if progress is not None and progress("shadows", share) is False:
        raise Cancelled("shadows were stopped")


def _blocks(count: int, film: Film | None = None) -> list[slice] | list[np.ndarray]:
    """The indices of the samples of each block: with a film, those in a square of its pixels."""
    if film is None or count <= BLOCK_SAMPLES:
        return [slice(start, min(start + BLOCK_SAMPLES, count)) for start in range(0, count, BLOCK_SAMPLES)]
    y, x = np.divmod(film.pixel, film.width)
    area = (np.ptp(y) + 1) * (np.ptp(x) + 1)
    side = max(int(np.sqrt(area * BLOCK_SAMPLES / count)), 1)
    _, block = np.unique(y // side * film.width + x // side, return_inverse=True)
    return np.split(np.argsort(block, kind="stable"), np.cumsum(np.bincount(block))[:-1])


@dataclass(frozen=True)
class OriginTask:
    """The task of `ray_origins`."""

    def do(self, samples: SurfaceSamples, tracer) -> RayOrigins:
        """Where rays from the samples of a block start."""
        return tracer.ray_origins(samples)


@dataclass(frozen=True)
class ShadowTask:
    """The emitters and settings with which to find the shares of every block of samples."""

    emitters: tuple[Emitter | LightCluster, ...]
    passes: tuple[str, ...]
    rays: int
    typical: dict[str, float]
    is_baked: bool

    def do(self, job: tuple[SurfaceSamples, Film | None, RayOrigins | None], tracer) -> Visibility:
        """The visibility from a block of samples on a film; the third is `tracer.ray_origins(samples)` if that is known
        already."""
        samples, film, ray_origins = job
        joined = JoinedLobes(samples)
        if joined.share is not None:
            samples = joined.samples
            film, ray_origins = (None if one is None else one.take(joined.first) for one in (film, ray_origins))
        shape = len(self.emitters), len(samples)
        visibility = {name: np.ones(shape, np.float32) for name in self.passes}
        radiance, variance = ({name: np.zeros(shape[1], np.float32) for name in self.passes} for _ in range(2))
        mixed, traced = np.zeros(shape, bool), 0
        extent = None if film is None else film.extent
        surface = SampleRows(samples, self.passes, tracer, ray_origins, joined, extent)
        neighbors = PixelNeighbors(film, surface)
        # What each sample counts for its pixel.
        importance = np.ones(shape[1], np.float32)
        if film is not None and film.count is not None:
            importance = (film.count / film.sub_samples).astype(np.float32)
        lights = [light for emitter in self.emitters for light in emitter.selected_as]
        selection, first = LightSelection(samples, lights, self.is_baked), 0
        for number, emitter in enumerate(self.emitters):
            estimator = RatioEstimator(surface, emitter, first, selection)
            first += len(emitter.selected_as)
            estimator.trace(self.rays, neighbors, self.typical, importance)
            traced += estimator.traced
            index = estimator.index
            mixed[number, index] = estimator.visible & estimator.blocked
            for name in self.passes:
                ratio, noise = estimator.visibility_ratio(name)
                if self.is_baked and name == "diffuse" and film is not None and not estimator.is_shared.any():
                    ratio = estimator.smoothed(name, ratio, noise)
                unshadowed = estimator.unshadowed(name)
                visibility[name][number, index] = ratio
                radiance[name][index] += unshadowed * ratio
                variance[name][index] += np.square(unshadowed * noise)
        deviation = {name: np.sqrt(values) for name, values in variance.items()}
        if joined.share is not None:
            index, first = joined.index, joined.first
            visibility = {name: values[:, index] for name, values in visibility.items()}
            # The first of two samples has the light of both.
            radiance, deviation = (
                {name: values[index] * first for name, values in one.items()} for one in (radiance, deviation)
            )
            mixed = mixed[:, index]
        return Visibility(visibility.get("specular"), visibility.get("diffuse"), radiance, deviation, traced, mixed)


def typical_radiance(samples: SurfaceSamples, task: ShadowTask, tracer) -> tuple[dict[str, float], int]:
    """By pass, the root mean square radiance that samples reflect, estimated from the probes of some samples; and the
    number of these samples."""
    most = max(min(TYPICAL_SAMPLES, TYPICAL_PAIRS // max(len(task.emitters), 1)), 1)
    chosen = slice(None, None, -(-len(samples) // most) or 1)
    some = samples.take(chosen)
    traced = replace(task, rays=PROBES).do((some, None, None), tracer)
    squares = {name: np.square(traced.radiance[name]).mean() if len(some) else 0.0 for name in task.passes}
    return {name: float(np.sqrt(square)) for name, square in squares.items()}, len(some)
