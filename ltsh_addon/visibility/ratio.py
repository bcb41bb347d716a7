"""The share of each light that each sample sees: `trace_visibility`.

The ratio estimator (Heitz, Hill and McGuire 2018, "Combining analytic direct illumination and stochastic shadows",
doi:10.1145/3190834.3190852): shadowed radiance = closed form x sum(w V) / sum(w). V is the transmittance of a ray to
the light. w is what the pass reflects of the light along the ray, divided by the probability density of the ray. Both
passes use the same rays.

Every pair of a sample and a light gets a few probe rays. If all arrive, or all are blocked, the pair is settled, unless
a neighbor in the picture found otherwise. The other pairs get more rays, the more light they reflect.
The result for a sample depends on its neighbors, but not on its place in the picture or in a block.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np

from ..emitters.facing import FacingDisk, emission, ray_length
from ..emitters.light_polygons import LEAST_COSINE, LOBE_WIDTH, has_lobe, may_reach, off_plane
from ..lobes.brdf import dielectric_reflectance, schlick_curve, stretch
from ..lobes.diffuse import diffuse_factor
from ..scene import FARTHEST, PASSES, Cancelled, Film, Light, PolygonLight, Progress, SurfaceSamples, round_outline
from ..workers.pool import WorkerPool
from .directions import (
    Emitter,
    LightCluster,
    LightSelection,
    LobeBound,
    Sky,
    SphericalQuads,
    Warps,
    dot,
    emitters_of,
    frames,
    seeds_of,
    unit_points,
)
from .shadow_terminator import RayOrigins

# Number of rays of the first look at a pair. More rays come in multiples of it.
PROBES = 8
MOST_RAYS = 1024
# Rays of a block, few enough for its arrays to stay in the cache.
BLOCK_RAYS = 1 << 15
# Samples that one process takes at a time.
BLOCK_SAMPLES = 1 << 14
# Processor seconds for the probes of all pairs, and number of samples whose rays' origins are looked for, from which on
# workers are worth their start.
SECONDS_WORTH_A_WORKER, SAMPLES_WORTH_A_WORKER = 1.0, 1 << 17
# How many of PROBES rays are spread evenly over the light; the specular lobe chooses the others. Rows: pairs with both
# lobes, with a diffuse lobe only, with a specular lobe only. Columns: both lobes count alike (always so for the
# probes), the specular lobe counts more, the diffuse lobe counts more.
LIGHT_SAMPLED = np.array([[4, 2, 6], [8, 8, 8], [2, 2, 2]])
# A pair gets rays in proportion to this power of its light relative to that of a typical sample. The reason: the square
# root of the variance of stratified rays falls with their number to the power -0.8.
WORTH_POWER = 0.75
# Rays of a pair as bright as a typical sample, as a share of the most rays of a pair.
TYPICAL_SHARE = 0.4
# Numbers of rays that a pair may get, besides the probes and the most rays.
LEVELS = (16, 32, 64, 128, 256, 512)
# The brightest pairs may get this many times the most rays of a pair: where lobes are narrow and lights half visible, a
# few pixels cause most of the noise of a picture.
BRIGHTEST = 4
# Most samples, and most pairs of a sample and a light, that are traced to find the typical radiance.
TYPICAL_SAMPLES, TYPICAL_PAIRS = 2048, 1 << 20
# Rounds in which neighbors of mixed pairs get more rays. Neighbors that turn out mixed pass this on in the next round.
ROUNDS = 4
# Rays end at this share of their distance to the light, just before it.
END = np.float32(1.0 - 1e-4)
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
_MIN_ALPHA = np.float32(1e-5)
# OUTLINE: points of the unit disk to aim at. SQUARE: corners of the square around it. Both are for lights that face the
# points.
OUTLINE = 0.99 * round_outline(16)
SQUARE = np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])
_FARTHEST = np.float32(FARTHEST)
# Least and greatest length of a unit vector after a warp.
_LENGTHS = np.float32(1e-11), np.float32(4.0)


@dataclass(frozen=True)
class Visibility:
    """Shares of E emitters that P samples see by pass, in [0, 1]; None for a pass that was not asked for.

    An emitter is one light, or several lights that share their rays; `numbers` lists them.

    The share is exactly 1 where nothing is in the way and where no light would arrive anyway. It is exactly 0 where
    everything is blocked.
    """

    specular: np.ndarray | None  # (E, P) float32
    diffuse: np.ndarray | None
    # By pass, over all lights: the approximate radiance (P,) that each sample reflects, and its standard deviation
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
    blocks, mixed = _blocks(shape[1]), np.zeros(shape, bool)
    traced = np.zeros(len(blocks), np.int64)

    def job(number):
        return tuple(None if one is None else one.take(blocks[number]) for one in (samples, film, ray_origins))

    def store(number, traced_block):
        block = blocks[number]
        for name in passes:
            visibility[name][:, block] = getattr(traced_block, name)
            radiance[name][block], deviation[name][block] = traced_block.radiance[name], traced_block.deviation[name]
        mixed[:, block], traced[number] = traced_block.mixed, traced_block.rays

    with ExitStack() as stack:
        pool = workers if isinstance(workers, WorkerPool) else stack.enter_context(WorkerPool(tracer, workers))
        for done in pool.run(task, len(blocks), job, store, seconds > SECONDS_WORTH_A_WORKER):
            if progress is not None and progress("shadows", done / len(blocks)) is False:
                raise Cancelled("shadows were stopped")
    by_pass = visibility.get("specular"), visibility.get("diffuse")
    return Visibility(*by_pass, radiance, deviation, int(traced.sum()), mixed, numbers)


def trace_ray_origins(samples: SurfaceSamples, pool: WorkerPool) -> RayOrigins:
    """Where rays from P samples start, found by the processes of `pool`, whose context is a tracer."""
    blocks, ray_origins = _blocks(len(samples)), RayOrigins.empty(len(samples))
    for _ in pool.run(
        OriginTask(),
        len(blocks),
        lambda number: samples.take(blocks[number]),
        lambda number, origins: ray_origins.put(blocks[number], origins),
        len(samples) >= SAMPLES_WORTH_A_WORKER,
    ):
        pass
    return ray_origins


def _blocks(count: int) -> list[slice]:
    return [slice(start, min(start + BLOCK_SAMPLES, count)) for start in range(0, count, BLOCK_SAMPLES)]


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
        shape = len(self.emitters), len(samples)
        visibility = {name: np.ones(shape, np.float32) for name in self.passes}
        radiance, variance = ({name: np.zeros(shape[1], np.float32) for name in self.passes} for _ in range(2))
        mixed, traced = np.zeros(shape, bool), 0
        surface, neighbors = SampleRows(samples, self.passes, tracer, ray_origins), PixelNeighbors.of(film, shape[1])
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
                unshadowed = estimator.unshadowed(name)
                visibility[name][number, index] = ratio
                radiance[name][index] += unshadowed * ratio
                variance[name][index] += np.square(unshadowed * noise)
        deviation = {name: np.sqrt(values) for name, values in variance.items()}
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


def shadow_task(
    samples: SurfaceSamples, lights: Sequence[Light], tracer, passes: Sequence[str], rays: int
) -> ShadowTask:
    """The task that finds the shares of `lights` with at most `rays` per pair, as `trace_visibility` does."""
    (emitters, _), passes = emitters_of(lights, tracer), tuple(passes)
    task = ShadowTask(emitters, passes, rays // PROBES * PROBES, dict.fromkeys(passes, 1.0), False)
    return replace(task, typical=typical_radiance(samples, task, tracer)[0])


@dataclass(frozen=True)
class PixelNeighbors:
    """Which samples are close to each other: those in the same pixel and in the eight pixels around it."""

    pixel: np.ndarray  # (P,)
    width: int
    height: int

    @classmethod
    def of(cls, film: Film | None, count: int) -> PixelNeighbors:
        """The neighbors in `film`; without one, each sample is close to those before and after it."""
        if film is None:
            return cls(np.arange(count), count, 1)
        # The film may hold a part of a picture: count only its rows.
        top = int(film.pixel.min(initial=film.width * film.height)) // film.width
        height = int(film.pixel.max(initial=0)) // film.width + 1 - top
        return cls(film.pixel - top * film.width, film.width, max(height, 0))

    def any_around(self, index: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Mask (Q,) of the samples `index` (Q,): is `mask` (Q,) true for at least one of the samples around?"""
        pixel = self.pixel[index]
        marked = np.zeros(self.width * self.height, bool)
        marked[pixel[mask]] = True
        grid = np.pad(marked.reshape(self.height, self.width), 1)
        grid = grid[1:-1] | grid[:-2] | grid[2:]
        return (grid[:, 1:-1] | grid[:, :-2] | grid[:, 2:]).ravel()[pixel]


class SampleRows:
    """Samples in single precision with components first: vectors are (3, P)."""

    def __init__(self, samples: SurfaceSamples, passes: Sequence[str], tracer, ray_origins: RayOrigins | None = None):
        self.tracer, self.ray_origins = tracer, tracer.ray_origins(samples) if ray_origins is None else ray_origins
        self.position = np.ascontiguousarray(samples.position.T)
        self.receiver = samples.receiver
        self.seeds = seeds_of(samples.position)
        self._known: list[np.ndarray] = []
        self.normal, self.view = self._rows(samples.normal), self._rows(samples.view)
        self.geometric_normal = self._rows(samples.geometric_normal)
        self.diffuse_normal, self.smooth_normal = self._rows(samples.diffuse_normal), self._rows(samples.smooth_normal)
        self.bump_alpha2 = samples.bump_alpha2.astype(np.float32)
        self.shapes = None
        if samples.sheen_a.any() or samples.diffuse_roughness.any():
            names = ("diffuse_roughness", "sheen_a", "sheen_b")
            rebound = samples.diffuse_rebound.mean(axis=1, dtype=np.float32)
            self.shapes = np.stack([*(getattr(samples, name).astype(np.float32) for name in names), rebound])
        self.alpha = np.maximum(np.square(samples.roughness.astype(np.float32)), _MIN_ALPHA)
        self.tangent, self.anisotropy = None, samples.anisotropy.astype(np.float32)
        if samples.anisotropy.any():
            self.tangent = self._rows(samples.tangent)
        names = ("specular_f0", "specular_f90", "specular_dip", "dielectric", "diffuse_albedo")
        terms = [getattr(samples, name).mean(axis=1, dtype=np.float32) for name in names]
        self.f0, f90, self.f82_term, self.dielectric, self.albedo = terms
        self.f90_minus_f0 = f90 - self.f0
        self.ior = samples.ior.astype(np.float32)
        diffuse, specular = has_lobe(samples)
        specular &= dot(self.normal, self.view) > 0.0
        self.lobes = {"specular": specular & ("specular" in passes), "diffuse": diffuse & ("diffuse" in passes)}

    def _rows(self, vectors):
        # Equal normals share one array, so that identity tells whether they differ.
        rows = np.ascontiguousarray(vectors.T, dtype=np.float32)
        equal = next((known for known in self._known if np.array_equal(known, rows)), None)
        if equal is None:
            self._known.append(rows)
        return rows if equal is None else equal

    def horizons(self, name: str) -> tuple[np.ndarray, ...]:
        """The normals (3, P) whose horizons bound the lobe of pass `name`: below any of them it is 0."""
        if name == "diffuse":
            return _different(self.diffuse_normal, self.smooth_normal)
        return _different(self.normal, self.geometric_normal)


def _different(first, second):
    return (first,) if first is second else (first, second)


@dataclass(frozen=True)
class RaysOfSurface:
    """Rays (R,) that meet different things depending on who chooses them: the surface or the light."""

    flat: np.ndarray  # in the flattened (S, Q) of all rays
    visibility: np.ndarray  # transmittance of the ray that the surface chooses
    index: np.ndarray  # number of the sample
    directions: np.ndarray  # (3, R)
    solid_angle: np.ndarray  # of the light, sr
    is_alone: np.ndarray  # True where the light never chooses this direction


class RatioEstimator:
    """The samples that an emitter may reach, and what their rays have found so far. `number` is the emitter's number in
    `selection`."""

    def __init__(self, surface: SampleRows, emitter: Emitter | LightCluster, number: int, selection: LightSelection):
        light = emitter.light
        self.surface, self.emitter, self.light = surface, emitter, light
        self.mask = np.uint32(surface.tracer.mask_of(light.name))
        self.surface_mask = np.uint32(surface.tracer.surface_mask_of(light.name))
        # The faces of a mesh light block rays to the mesh itself.
        self.at_surface = isinstance(emitter, LightCluster) or isinstance(light, PolygonLight)
        self.chosen_by, self.number, self.selection = surface.tracer.chosen_by(light.name), number, selection
        origins = light.viewpoint(surface.position)
        offset = (light.center[:, None] - origins).astype(np.float32)
        ahead = np.ones(offset.shape[1], bool)
        if not light.is_facing and not isinstance(emitter, LightCluster):
            ahead = dot(light.direction.astype(np.float32), offset) < -off_plane(
                light.center, np.abs(origins).sum(axis=0)
            )
        if light.has_spread or light.is_facing:
            ahead &= may_reach(light, surface.position)
        if light.receivers is not None:
            ahead &= light.receives(surface.receiver)
        radius, self.wanted, above = np.float32(1.001 * light.radius), {}, {}
        for name, lobe in surface.lobes.items():
            self.wanted[name] = lobe & ahead & getattr(light, f"affects_{name}")
            for normal in surface.horizons(name):
                if id(normal) not in above:
                    above[id(normal)] = dot(normal, offset) > -radius
                self.wanted[name] &= above[id(normal)]
        self.index = np.flatnonzero(self.wanted["specular"] | self.wanted["diffuse"])
        self.wanted = {name: wanted[self.index] for name, wanted in self.wanted.items()}
        count = len(self.index)
        # Sums of all weights, and of the weights times transmittance, by pass and half of the rays
        self.sum_w, self.sum_wv = np.zeros((2, 2, 2, count), np.float32)
        self.visible, self.blocked = np.zeros(count, bool), np.zeros(count, bool)
        self.count = np.zeros(count, np.int32)
        self.traced = 0

    def trace(self, rays: int, neighbors: PixelNeighbors, typical: dict[str, float], importance: np.ndarray) -> None:
        """Trace the probes of all pairs, then up to `rays` rays for pairs that need them. How many depends on the light
        and the `importance` (P,) of the sample. `typical` comes from `typical_radiance`."""
        if self.mask == 0 or not self.light.area_vector.any():
            return
        self._add_rays(np.arange(len(self.index)), 0, PROBES, 0)
        self._leave_out_unlit()
        number, choice = self._plan(rays, typical, importance[self.index])
        for _ in range(ROUNDS):
            chosen = neighbors.any_around(self.index, self.visible) & neighbors.any_around(self.index, self.blocked)
            chosen |= self._unmet()
            chosen &= self.count < number
            if not chosen.any():
                break
            for last in np.unique(number[chosen]):
                for split in range(3):
                    members = np.flatnonzero(chosen & (number == last) & (choice == split))
                    self._add_rays(members, PROBES, int(last), split)
        self._aim_at_corners()

    def _plan(self, rays, typical, importance):
        """Number of rays (Q,) that each pair is worth, and its column (Q,) of EVENLY. Both depend on the unshadowed
        light that the pair reflects, the number also on its `importance` (Q,)."""
        worth = {name: self.unshadowed(name) / max(typical.get(name, 0.0), 1e-30) for name in PASSES}
        most = importance * np.maximum(worth["specular"], worth["diffuse"])
        # A sky or a cluster stands for many lights and gets the rays of all of them.
        share = 1.0 if isinstance(self.emitter, Sky | LightCluster) else TYPICAL_SHARE
        wanted = rays * share * most**WORTH_POWER
        limit = rays
        if share < 1.0 and rays > PROBES:
            limit = min(BRIGHTEST * rays, MOST_RAYS)
        if isinstance(self.emitter, Sky):
            # Points lit by the sky alone are dark beside those lit by a sun in it: do not let them go short.
            wanted = np.maximum(wanted, 0.25 * rays * importance)
        levels = [level for level in LEVELS if level < limit] + [limit]
        number = np.take(levels, np.searchsorted(levels, np.minimum(wanted, limit)))
        choice = np.where(worth["specular"] > 2.0 * worth["diffuse"], 1, 0)
        choice[worth["diffuse"] > 2.0 * worth["specular"]] = 2
        return number, choice

    def _unmet(self):
        """Mask (Q,) of the pairs with a lobe that no ray has met so far."""
        unmet = np.zeros(len(self.index), bool)
        for number, name in enumerate(PASSES):
            unmet |= self.wanted[name] & (self.sum_w[number].sum(axis=0) == 0.0)
        return unmet

    def _corner_heights(self, name, members):
        """Least height (V, M) of the light's corners over the horizons of a lobe, and the offsets (3, V, M) from the
        samples to the corners."""
        surface, index = self.surface, self.index[members]
        if isinstance(self.emitter, LightCluster):
            return RaySampler(surface, index, self.emitter, (name,)).corner_heights(surface.horizons(name))
        center = self.light.center[:, None] - self.light.viewpoint(surface.position[:, index])
        if self.light.is_facing:
            normal = surface.horizons(name)[0][:, index]
            offset = FacingDisk.of(self.light, center.astype(np.float32), normal).corners(OUTLINE)
        else:
            offset = (self.emitter.outline.T[:, :, None] + center[:, None]).astype(np.float32)
        heights = [dot(offset, normal[:, None, index]) for normal in surface.horizons(name)]
        return np.minimum.reduce(heights), offset

    def _leave_out_unlit(self):
        """Drop lobes for which the whole light is below the horizon."""
        for number, name in enumerate(PASSES):
            unmet = np.flatnonzero(self.wanted[name] & (self.sum_w[number].sum(axis=0) == 0.0))
            self.wanted[name][unmet] = self._corner_heights(name, unmet)[0].max(axis=0) > 0.0

    def _aim_at_corners(self):
        """Trace one ray to the highest corner of the light for each lobe that no ray met so far: such a lobe sees only
        a corner of the light."""
        for number, name in enumerate(PASSES):
            unmet = np.flatnonzero(self.wanted[name] & (self.sum_w[number].sum(axis=0) == 0.0))
            if len(unmet) == 0:
                continue
            heights, offset = self._corner_heights(name, unmet)
            toward = np.take_along_axis(offset, heights.argmax(axis=0)[None, None], axis=1)[:, 0]
            distance = np.sqrt(dot(toward, toward))
            toward /= np.maximum(distance, _TINY)
            if self.light.is_distant:
                distance[:] = _FARTHEST
            aimed = self.surface.ray_origins.aimed(self.index[unmet], toward[:, None], distance[None], self.at_surface)
            visibility = (
                self._transmittance(self.mask, *(rows[..., 0, :] for rows in aimed)) if self.chosen_by.light else _ONE
            )
            # Next to nothing, so that it does not count in sums over samples.
            self.sum_w[number][:, unmet] = _TINY
            self.sum_wv[number][:, unmet] = visibility * _TINY

    def _transmittance(self, mask, origins, directions, distances):
        """Transmittance (R,) of rays with a mask, `origins` and `directions` (3, R) and `distances` (R,)."""
        self.traced += len(distances)
        masks = np.broadcast_to(mask, distances.shape)
        return self.surface.tracer.transmittance(origins.T, directions.T, distances * END, masks)

    def _add_rays(self, members, first, last, split):
        """Trace the rays `first` to `last` of the pairs `members` (M,). `split` is a column of EVENLY."""
        diffuse, specular = (self.wanted[name][members] for name in ("diffuse", "specular"))
        for kind, chosen in enumerate((diffuse & specular, diffuse & ~specular, ~diffuse & specular)):
            chosen = members[chosen]
            for start in range(0, len(chosen), BLOCK_RAYS // PROBES):
                block = chosen[start : start + BLOCK_RAYS // PROBES]
                lobes = tuple(name for name in PASSES if self.wanted[name][block[0]])
                sampler = RaySampler(self.surface, self.index[block], self.emitter, lobes)
                step = BLOCK_RAYS // (PROBES * len(block)) * PROBES
                for number in range(first, last, step):
                    light_sampled = LIGHT_SAMPLED[kind, 0], LIGHT_SAMPLED[kind, split]
                    batch = RayBatch(number, min(number + step, last), max(last, 2 * PROBES), *light_sampled)
                    self._add_block(block, sampler, batch)
        self.count[members] = last

    def _add_block(self, block, sampler, batch):
        """Trace some `batch` of the pairs `block` (B,) of a view."""
        directions, distance, weights = sampler.sample(batch)
        visibility, others = np.zeros(distance.shape, np.float32), None
        met = np.logical_or.reduce([weight > 0.0 for weight in weights.values()])
        flat = np.flatnonzero(met)
        aimed = self.surface.ray_origins.aimed(sampler.index, directions, distance, self.at_surface)
        origins, *rest = (_taken(rows, flat) for rows in aimed)
        visibility.ravel()[flat] = self._transmittance(self.mask, origins, *rest) if self.chosen_by.light else _ONE
        if self.chosen_by.surface:
            others = self._chosen_by_surface(sampler, (directions, distance), flat, origins, visibility)
        least, most = visibility, visibility
        if others is not None:
            least, most = visibility.copy(), visibility.copy()
            least.ravel()[others.flat] = np.minimum(others.visibility, visibility.ravel()[others.flat])
            most.ravel()[others.flat] = np.maximum(others.visibility, visibility.ravel()[others.flat])
        self.visible[block] |= most.sum(axis=0) > 0.0
        self.blocked[block] |= least.sum(axis=0) < met.sum(axis=0)
        for name, weight in weights.items():
            number, passing = PASSES.index(name), visibility
            if others is not None:
                passing = visibility.copy()
                rays = others.index, others.directions, others.solid_angle
                share = self.selection.bsdf_share(name, self.number, *rays)
                share[others.is_alone] = 1.0
                passing.ravel()[others.flat] += share * (others.visibility - visibility.ravel()[others.flat])
            for sums in (self.sum_w[number], self.sum_wv[number]):
                halves = sums[:, block]
                batch.add_to(halves, weight)
                sums[:, block] = halves
                weight *= passing

    def _chosen_by_surface(self, sampler, rays, flat, origins, light_visibility):
        """The rays at the places `flat` (R,) that the surface would choose and that then meet something else than the
        light's rays did; None if there are none. The light's rays start at `origins` (3, R), with
        `light_visibility` (S, Q)."""
        ray_origins = self.surface.ray_origins
        meet_the_same = self.chosen_by.light and self.mask == self.surface_mask
        if meet_the_same and not ray_origins.terminator[sampler.index].any():
            return None
        directions, distance = (_taken(rows, flat) for rows in rays)
        column = flat % light_visibility.shape[1]
        index = sampler.index[column]
        start, toward, distance = ray_origins.from_surface(index, directions, distance)
        # The light chooses directions above the smooth horizon; the surface chooses directions above the mesh's.
        smooth, flat_facing = (
            dot(np.take(normal, index, axis=0).T, directions)
            for normal in (ray_origins.smooth_normal, ray_origins.geometric_normal)
        )
        is_alone = (smooth <= 0.0) & (flat_facing > 0.0)
        chosen = (smooth <= 0.0) | (flat_facing > 0.0)
        if meet_the_same:
            chosen &= (start != origins).any(axis=0)
        chosen = np.flatnonzero(chosen)
        visibility = self._transmittance(self.surface_mask, start[:, chosen], toward[:, chosen], distance[chosen])
        differ = np.flatnonzero(visibility != light_visibility.ravel()[flat[chosen]])
        if len(differ) == 0:
            return None
        chosen, visibility = chosen[differ], visibility[differ]
        angle = sampler.solid_angles(flat[chosen])
        return RaysOfSurface(flat[chosen], visibility, index[chosen], directions[:, chosen], angle, is_alone[chosen])

    def unshadowed(self, name: str) -> np.ndarray:
        """Approximate radiance (Q,) that a pass reflects without shadows; 0 for pairs without that lobe."""
        scale = self.surface.albedo[self.index] if name == "diffuse" else np.float32(0.5)
        scale = scale * np.float32(np.abs(self.light.radiance).mean() / np.pi) / np.maximum(self.count, 1)
        return self.sum_w[PASSES.index(name)].sum(axis=0) * scale * self.wanted[name]

    def visibility_ratio(self, name: str):
        """Shares (Q,) of a pass, and their approximate standard deviations (Q,)."""
        sum_w, sum_wv = self.sum_w[PASSES.index(name)], self.sum_wv[PASSES.index(name)]
        total = sum_w.sum(axis=0)
        ratio = np.divide(sum_wv.sum(axis=0), total, out=np.ones_like(total), where=total > 0.0)
        halves = np.divide(sum_wv, sum_w, out=np.stack([ratio, ratio]), where=sum_w > 0.0)
        # Pairs with probes only have no second half of rays: take the deviation of independent rays.
        usual = np.sqrt(ratio * (_ONE - ratio) / np.maximum(self.count, 1).astype(np.float32))
        return ratio, np.where((sum_w > 0.0).all(axis=0), 0.5 * np.abs(halves[0] - halves[1]), usual)


def _taken(rows, flat):
    """Values (3, R) or (R,) at the places `flat` of the flattened last two axes of `rows`, (3, S, Q) or (S, Q)."""
    return np.take(rows.reshape(*rows.shape[:-2], -1), flat, axis=-1)


@dataclass(frozen=True)
class RayBatch:
    """The rays `first` to `last` of each pair, in looks of PROBES rays. In each look the lobe chooses some of the rays.

    `probes` is how many rays of the first look are chosen evenly, `later` the same for each later look.
    """

    first: int
    last: int
    total: int
    probes: int
    later: int

    @property
    def groups(self) -> int:
        """Number of looks of PROBES rays each."""
        return (self.last - self.first) // PROBES

    @property
    def light_points(self) -> tuple[int, int]:
        """First and last number of the points that choose directions evenly over the light."""
        return tuple(self.probes + self.later * (n // PROBES - 1) if n else 0 for n in (self.first, self.last))

    @property
    def bsdf_points(self) -> tuple[int, int]:
        """First and last number of the points that choose directions by the lobe."""
        return tuple(n - even for n, even in zip((self.first, self.last), self.light_points, strict=True))

    def add_to(self, halves, weight):
        """Add weights (S, Q) to the sums (2, Q) of the first and of the second half of all rays."""
        start, stop = self.light_points
        batch_sums = np.zeros((self.groups, weight.shape[1]), np.float32)
        for rows in (weight[: stop - start], weight[stop - start :]):
            if len(rows):
                batch_sums += rows.reshape(self.groups, -1, weight.shape[1]).sum(axis=1)
        for number, batch_sum in enumerate(batch_sums, self.first // PROBES):
            halves[int(2 * number * PROBES >= self.total)] += batch_sum


class RaySampler:
    """A light seen from a block of samples: arrays (Q,) and (3, Q)."""

    def __init__(self, surface: SampleRows, index: np.ndarray, emitter: Emitter | LightCluster, lobes: tuple[str, ...]):
        self.index, self.emitter, self.lobes = index, emitter, lobes
        light = emitter.light
        offset = light.center[:, None] - light.viewpoint(np.take(surface.position, index, axis=1))
        self.height = (-dot(light.direction, offset)).astype(np.float32)
        self.offset = offset.astype(np.float32)
        self.disk, is_quad = None, not isinstance(emitter, LightCluster)
        if light.is_facing:
            normal = surface.normal if "specular" in lobes else surface.diffuse_normal
            self.disk = FacingDisk.of(light, self.offset, np.take(normal, index, axis=1))
            corners = self.disk.corners(SQUARE)
        elif is_quad:
            corners = emitter.corners_from(self.offset, self.height)
        else:
            position = np.take(surface.position, index, axis=1)
            self.least_height = off_plane(light.center + light.radius, np.abs(position).sum(axis=0)).astype(np.float32)
        if is_quad:
            self.quads = SphericalQuads(corners)
            self.has_solid_angle, self.solid_angle = self.quads.has_solid_angle, self.quads.solid_angle
        if isinstance(emitter, Sky):
            # The solid angle of one side: `LightSelection` knows the sides one by one.
            self.solid_angle = np.full(len(index), 4.0 * np.pi / 6.0, np.float32)
        self.seeds = surface.seeds[index]
        if "diffuse" in lobes:
            self.horizons = [np.take(normal, index, axis=1) for normal in surface.horizons("diffuse")]
            self.bump_alpha2 = surface.bump_alpha2[index]
            self.shape = None
            if surface.shapes is not None:
                axes = (surface.diffuse_normal, surface.view)
                self.shape = (*(np.take(axis, index, axis=1) for axis in axes), surface.shapes[:, index])
        if "specular" in lobes:
            normal, view = np.take(surface.normal, index, axis=1), np.take(surface.view, index, axis=1)
            self.geometric_normal = np.take(surface.geometric_normal, index, axis=1)
            self.has_own_horizon = surface.geometric_normal is not surface.normal
            self.cosine, self.sine, rows = frames(normal, view)
            self.view = view
            self.alpha, self.stretch = surface.alpha[index], None
            if surface.tangent is not None:
                along = [dot(row, np.take(surface.tangent, index, axis=1)) for row in rows[:2]]
                self.stretch = stretch(*along, surface.anisotropy[index])
                self.alpha = self.alpha * np.sqrt(self.stretch[0])
            self.warps = Warps(rows, self.cosine, self.sine, self.alpha)
            if is_quad:
                self.warped_quads = SphericalQuads(self.warps.warped(self.warps.local(corners)))
                self.has_solid_angle = self.has_solid_angle & self.warped_quads.has_solid_angle
            self.f0, self.f90_minus_f0 = surface.f0[index], surface.f90_minus_f0[index]
            self.f82_term = surface.f82_term[index]
            self.dielectric, self.ior = surface.dielectric[index], surface.ior[index]

    def sample(self, batch: RayBatch):
        """Unit directions (3, S, Q) of `batch`, distances to the light (S, Q), and weights (S, Q) by lobe."""
        if isinstance(self.emitter, Sky):
            return self._sample_sky(batch)
        if isinstance(self.emitter, LightCluster):
            return self._sample_cluster(batch)
        light_count, bsdf_count = (last - first for first, last in (batch.light_points, batch.bsdf_points))
        shape = (light_count + bsdf_count, len(self.index))
        directions = np.empty((3, *shape), np.float32)
        if light_count:
            points = unit_points(self.seeds, 0, *batch.light_points)
            self.quads.directions(*points, out=directions[:, :light_count])
        density = np.float32(light_count / shape[0]) / self.quads.solid_angle
        if bsdf_count:
            local = np.empty((3, *shape), np.float32)
            self.warped_quads.directions(*unit_points(self.seeds, 1, *batch.bsdf_points), out=local[:, light_count:])
            length = self._unwarped(directions, local, light_count)
            scale = np.float32(bsdf_count / shape[0]) * self.warps.determinant / self.warped_quads.solid_angle
            scale *= self.has_solid_angle
            density = density + scale / (length * length * length)
        light = self.emitter.light
        falling = dot(directions, -light.direction.astype(np.float32) if self.disk is None else self._axis())
        height = self.height if self.disk is None else self.disk.length
        distance = np.minimum(height / np.maximum(falling, _TINY), _FARTHEST)
        falls = falling > 0.0
        falls &= self.has_solid_angle
        factor = falls / density
        if self.disk is None:
            brightness = self.emitter.brightness(directions, distance, self.offset, self.height)
        else:
            brightness, distance = self._of_disk(directions, distance)
        if brightness is not None:
            factor *= brightness
        if light.is_distant:
            distance[:] = _FARTHEST
        return directions, distance, self._weights(directions, local if bsdf_count else None, factor)

    def _unwarped(self, directions, local, light_count):
        """Complete the directions (3, S, Q) in the world and in the local frames. The first `light_count` are known in
        the world, the others in the local frames after the warp. Returns their lengths (S, Q) after the warp."""
        length = np.empty(directions.shape[1:], np.float32)
        length[light_count:] = self.warps.unwarped(local[:, light_count:])
        self.warps.world(local[:, light_count:], out=directions[:, light_count:])
        self.warps.local(directions[:, :light_count], out=local[:, :light_count])
        length[:light_count] = self.warps.lengths(local[:, :light_count])
        return np.clip(length, *_LENGTHS, out=length)

    def _weights(self, directions, local, factor):
        weights = {}
        if "specular" in self.lobes:
            weights["specular"] = self._specular(directions, local)
            weights["specular"] *= factor
        if "diffuse" in self.lobes:
            weights["diffuse"] = self._diffuse(directions)
            weights["diffuse"] *= factor
        return weights

    def _sample_sky(self, batch: RayBatch):
        """As `sample`, for a sky: by its picture and cosine, and by the cosine after the warp of the lobe."""
        light_count, bsdf_count = (last - first for first, last in (batch.light_points, batch.bsdf_points))
        shape, local = (light_count + bsdf_count, len(self.index)), None
        normal = self.horizons[0] if "diffuse" in self.lobes else self.geometric_normal
        directions = np.empty((3, *shape), np.float32)
        if light_count:
            points = unit_points(self.seeds, 0, *batch.light_points)
            directions[:, :light_count] = self.emitter.directions(*points, normal)
        if bsdf_count:
            local = np.empty((3, *shape), np.float32)
            x, y = unit_points(self.seeds, 1, *batch.bsdf_points)
            radius, angle = np.sqrt(x), np.float32(2.0 * np.pi) * y
            chosen = (radius * np.cos(angle), radius * np.sin(angle), np.sqrt(_ONE - x))
            local[:, light_count:] = chosen
            length = self._unwarped(directions, local, light_count)
        density = np.float32(light_count / shape[0]) * self.emitter.density(directions, normal)
        if bsdf_count:
            cosine = np.maximum(self.warps.zz * local[2] / length, _ZERO)
            scale = np.float32(bsdf_count / shape[0] / np.pi) * self.warps.determinant
            density += scale * cosine / (length * length * length)
        factor = self.emitter.brightness_along(directions) / np.maximum(density, _TINY)
        distance = np.full(shape, _FARTHEST, np.float32)
        return directions, distance, self._weights(directions, local, factor)

    def solid_angles(self, flat):
        """Approximate solid angles (R,): the inverse density, in sr, of the rays that the light chooses at the places
        `flat` (R,) of the flattened (S, Q)."""
        return self.solid_angle.ravel()[flat % self.solid_angle.size]

    def _sample_cluster(self, batch: RayBatch):
        """As `sample`, for a cluster: each ray goes to a leaf of its own."""
        even, sharp = (
            unit_points(self.seeds, stream, *numbers)
            for stream, numbers in enumerate((batch.light_points, batch.bsdf_points))
        )
        light_count, shape = len(even[0]), (len(even[0]) + len(sharp[0]), len(self.index))
        leaf, pmf, x = self._leaves(np.concatenate([even[0], sharp[0]]), light_count)
        y, emitter = np.concatenate([even[1], sharp[1]]), self.emitter
        corners = emitter.corners[:, :, leaf] + self.offset[:, None, None]
        quads, directions = SphericalQuads(corners), np.empty((3, *shape), np.float32)
        has_solid_angle, local = quads.has_solid_angle, None
        rows = slice(None, light_count)
        quads.take_rows(rows).directions(x[rows], y[rows], out=directions[:, rows])
        self.solid_angle = quads.solid_angle / np.maximum(pmf[0], np.float32(1e-12))
        density = np.float32(light_count / shape[0]) * pmf[0] / quads.solid_angle
        if light_count < shape[0]:
            local = np.empty((3, *shape), np.float32)
            warped = SphericalQuads(self.warps.warped(self.warps.local(corners)))
            has_solid_angle = has_solid_angle & warped.has_solid_angle
            rows = slice(light_count, None)
            warped.take_rows(rows).directions(x[rows], y[rows], out=local[:, rows])
            length = self._unwarped(directions, local, light_count)
            scale = np.float32(1.0 - light_count / shape[0]) * pmf[-1] * self.warps.determinant / warped.solid_angle
            density = density + scale / (length * length * length)
        normal = emitter.normal[:, leaf]
        falling, height = -dot(directions, normal), np.maximum(-dot(corners[:, 0], normal), _ZERO)
        distance = np.minimum(height / np.maximum(falling, _TINY), _FARTHEST)
        factor = has_solid_angle & (falling > 0.0) & (height > self.least_height) & (density > 0.0)
        if emitter.is_round is not None:
            factor &= self._inside_round(leaf, corners, directions * np.where(factor, distance, _ZERO))
        factor = factor * emitter.brightness[leaf] / np.maximum(density, _TINY)
        return directions, distance, self._weights(directions, local, factor)

    def _inside_round(self, leaf, corners, points):
        """Mask (S, Q): False for places (3, S, Q) outside the ellipse in the parallelogram of a round light."""
        u, v = 0.5 * (corners[:, 1] - corners[:, 0]), 0.5 * (corners[:, 3] - corners[:, 0])
        offset = points - 0.5 * (corners[:, 0] + corners[:, 2])
        uu, uv, vv, us, vs = dot(u, u), dot(u, v), dot(v, v), dot(u, offset), dot(v, offset)
        whole = np.maximum(uu * vv - uv * uv, _TINY)
        s, t = (vv * us - uv * vs) / whole, (uu * vs - uv * us) / whole
        return (s * s + t * t <= _ONE) | ~self.emitter.is_round[leaf]

    def _leaves(self, x, light_count):
        """The leaves (S, Q) that rays go to, by lobe their probabilities, and the numbers x (S, Q) rescaled for reuse.
        x chooses the leaves: the first `light_count` rays by the diffuse lobe if there is one, the others by the
        specular lobe."""
        columns = np.tile(np.arange(len(self.index)), len(x))
        lobes, lobe_of_ray = [], np.zeros(x.shape, np.intp)
        if "diffuse" in self.lobes:
            lobes.append(LobeBound(self.offset[:, columns], self.horizons[0][:, columns]))
        if "specular" in self.lobes:
            normal = self.warps.rows[2]
            mirrored = np.float32(2.0) * self.cosine * normal - self.view
            width = np.maximum(LOBE_WIDTH * self.alpha * np.maximum(self.cosine, LEAST_COSINE), np.float32(1e-4))
            rows = (self.geometric_normal[:, columns], mirrored[:, columns], width[columns].astype(np.float32))
            lobes.append(LobeBound(self.offset[:, columns], *rows))
            lobe_of_ray[light_count:] = len(lobes) - 1
        leaf, pmf, rest = self.emitter.pick(x.ravel(), lobes, lobe_of_ray.ravel())
        return leaf.reshape(x.shape), pmf.reshape(len(lobes), *x.shape), rest.reshape(x.shape)

    def corner_heights(self, horizons):
        """As `Pairs._corner_heights`, for the corners of the leaves that the probes go to. Leaves that face away have
        height -1."""
        x = unit_points(self.seeds, 0, 0, PROBES)[0]
        leaf, pmf, _ = self._leaves(x, PROBES)
        corners = self.emitter.corners[:, :, leaf] + self.offset[:, None, None]
        is_lit = (pmf[0] > 0.0) & (dot(corners[:, 0], self.emitter.normal[:, leaf]) < -self.least_height)
        corners, is_lit = corners.reshape(3, 4 * PROBES, len(self.index)), np.tile(is_lit, (4, 1))
        heights = np.minimum.reduce([dot(corners, normal[:, None, self.index]) for normal in horizons])
        return np.where(is_lit, heights, -_ONE), corners

    def _axis(self):
        """Unit vectors (3, 1, Q) to the center of the light."""
        return (self.disk.offset / self.disk.length)[:, None]

    def _of_disk(self, directions, distance):
        """Brightness (S, Q) of a light that faces the points, and distances (S, Q) to it, along directions (3, S, Q)
        that meet its plane at `distance`."""
        disk, offset = self.disk, np.broadcast_to(self.offset[:, None], directions.shape)
        from_center = directions * distance - disk.offset[:, None]
        inside = dot(from_center, from_center) <= disk.radius * disk.radius
        length = ray_length(self.emitter.light, offset, directions)
        factor = inside * disk.gain * np.asarray(emission(self.emitter.light, offset, directions), np.float32)
        return factor, np.where(inside, length, distance).astype(np.float32)

    def _diffuse(self, directions):
        """Diffuse lobe times cosine (S, Q): a plain cosine for most surfaces, with the shadowing of a bump map where
        the smooth normal has another horizon."""
        cosine = dot(directions, self.horizons[0])
        np.maximum(cosine, _ZERO, out=cosine)
        if self.shape is not None:
            cosine *= diffuse_factor(directions, cosine, *self.shape)
        if len(self.horizons) == 1:
            return cosine
        above = dot(directions, self.horizons[1])
        np.maximum(above, _ZERO, out=above)
        squared = above * above
        slope = np.sqrt(squared + self.bump_alpha2 * (_ONE - squared))
        slope += above
        np.maximum(slope, _TINY, out=slope)
        above /= slope
        above *= np.float32(2.0)
        cosine *= above
        return cosine

    def _specular(self, directions, local):
        """GGX BRDF with its Fresnel factor times cosine times 2 pi (S, Q); see `shading.brdf.ggx_brdf_cosine`."""
        half_x, half_z = local[0] + self.sine, local[2] + self.cosine
        alpha2 = self.alpha * self.alpha
        across = None
        if self.stretch is not None:
            across = self.stretch[1] * half_x + self.stretch[0] * local[1]
        half_x *= half_x
        if across is not None:
            across *= across
            across += half_x
        half_x += local[1] * local[1]
        half_z *= half_z
        squared = half_x + half_z
        if across is not None:
            half_x = across
        half_z *= alpha2
        half_x += half_z
        ratio = np.divide(squared, half_x, out=half_x)
        mu = np.maximum(local[2], _ZERO, out=half_z)
        slope = mu * mu
        if self.stretch is None:
            slope *= _ONE - alpha2
            slope += alpha2
        else:
            beside = local[1] / self.stretch[0]
            slope += alpha2 * (np.square(local[0] - self.stretch[1] * beside) + np.square(beside))
        np.sqrt(slope, out=slope)
        slope *= self.cosine
        slope += mu * np.sqrt(self.cosine * self.cosine * (_ONE - alpha2) + alpha2)
        ratio *= ratio
        ratio *= alpha2 if self.stretch is None else alpha2 * self.stretch[0]
        ratio *= mu
        ratio /= slope
        ratio *= self._reflectance(squared)
        if self.has_own_horizon:
            ratio *= dot(directions, self.geometric_normal) > 0.0
        return ratio

    def _reflectance(self, squared):
        """Fresnel factor (S, Q) by the `squared` lengths (S, Q) of unit view plus unit light, which are overwritten."""
        cosine = np.sqrt(squared, out=squared)
        cosine *= np.float32(0.5)
        np.minimum(cosine, _ONE, out=cosine)
        result = schlick_curve(cosine)
        if self.f82_term.any():
            result *= self.f90_minus_f0 - self.f82_term * (cosine * (_ONE - cosine))
        else:
            result *= self.f90_minus_f0
        result += self.f0
        if self.dielectric.any():
            result += self.dielectric * dielectric_reflectance(cosine, self.ior)
        return np.maximum(result, _ZERO, out=result)
