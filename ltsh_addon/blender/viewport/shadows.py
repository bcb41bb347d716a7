"""Shadows of a view while an artist works: a thread traces the visibility of lights, coarse at first, then finer."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from ...imaging.denoise import means_of_neighbors
from ...scene import PASSES, Cancelled, Film, Light, SurfaceSamples, error_line
from ...visibility import Occluders, RayOrigins, ShadowSampling, shared_numbers, trace_ray_origins, trace_visibility
from ...workers.pool import WorkerPool
from .drawing import (
    GBufferTextures,
    ViewCamera,
    VisibilityGrid,
    every_texel,
    float_texture,
    gbuffer_texels,
    samples_of_texels,
    unit_xyz,
)
from .shadow_rays import Lights, TracedScene, ViewTracer, rays_to, shadowed_lights, too_many, visibility_texture


def _blank() -> VisibilityGrid:
    """A grid without surface points, with which every light is seen whole."""
    return VisibilityGrid(
        visibility_texture(np.ones((1, 2), np.float32)[None], (1, 1)), float_texture(np.zeros((1, 1, 4))), np.eye(4)
    )


# LEVELS: traced one after another while nothing changes. Each is the distance of the points in pixels, and the rays of
# a light and a point. None: the distance that gives COARSE_POINTS points.
LEVELS = ((None, 8), (1, 32))
COARSE_POINTS = 8000
# A picture of more than MANY_POINTS is traced at level QUICK before 1: at every QUICK_STEP-th pixel in either direction
# with QUICK_RAYS, and where these differ by more than noise, QUICK_DIFFERENCE, or are of other surfaces. In the product
# shot, 960 x 540, that takes a fifth of the time, and the picture is 2 % from that of level 1.
MANY_POINTS, QUICK, QUICK_STEP, QUICK_RAYS, QUICK_DIFFERENCE = 40000, 0.5, 4, 16, 0.4
# FIRST_POINTS: sub-pixel points that a view at rest draws with the shadows of its first picture, so that edges become
# smooth soon. The later points come in groups of GROUP, each group with new shadows of GROUP_RAYS rays.
FIRST_POINTS, GROUP, GROUP_RAYS = 8, 4, 64
# STAYING: the level of fine shadows of the same occluders, before a material was changed.
STAYING = 0.25
# BATCH: emitters that are traced together. Stopped work keeps finished batches.
BATCH = 4
# PAUSE_SECONDS: finer shadows follow the coarse ones of a light if it has stayed still for so long.
PAUSE_SECONDS = 0.15


class PixelGrid:
    """Every `step`-th pixel of a G-buffer in either direction, read by the window's thread. The tracing thread turns
    them into samples."""

    def __init__(self, step: int, gbuffer: GBufferTextures, view: ViewCamera):
        self._step, self._view, (width, height) = step, view, gbuffer.size
        self.gbuffer_texels, self._samples, self._normal = gbuffer_texels(gbuffer, step), None, None
        self._ray_origins: RayOrigins | None = None
        positions, first = self.gbuffer_texels["position"], step // 2
        rows, columns = positions.shape[:2]
        # The rows and columns of the pixels, as shares of the picture's height and width.
        sides = (rows, height), (columns, width)
        self.places = [(np.arange(count) * step + first + 0.5) / whole for count, whole in sides]
        stretch = np.eye(4)
        for axis, (whole, count) in enumerate(((width, columns), (height, rows))):
            stretch[axis, axis] = whole / (count * step)
            stretch[axis, 3] = 2.0 / count * ((0.5 * whole - 0.5 - first) / step + 0.5) - 1.0
        # The grid of these pixels: positions (H, W, 4), and the projection to its clip space.
        self.grid = positions, stretch @ view.projection

    def follow(self, gbuffer: GBufferTextures) -> None:
        """Read again what depends on the lights: the normals of the horizons."""
        if gbuffer.geometric_normal is not None:
            self._normal = every_texel(gbuffer.geometric_normal, self._step)

    def ray_origins(self, pool: WorkerPool, progress: Callable) -> RayOrigins:
        """Where rays from the samples start. They stay when only lights change. `progress` may stop the work."""
        if self._ray_origins is None:
            self._ray_origins = trace_ray_origins(self.samples()[0], pool, progress)
        return self._ray_origins

    def samples(self) -> tuple[SurfaceSamples, Film]:
        """The samples and their film."""
        if self._samples is None:
            self._samples, self.gbuffer_texels = samples_of_texels(self.gbuffer_texels, self._view), None
        samples, pixel = self._samples
        if self._normal is not None:
            normal = unit_xyz(self._normal.reshape(-1, 4)[pixel].astype(np.float64))
            samples = replace(samples, geometric_normal=normal)
        rows, columns = self.grid[0].shape[:2]
        return samples, Film(columns, rows, pixel)

    @cached_property
    def around(self) -> "CoarsePixels":
        """What level QUICK traces at first. It stays when only lights change."""
        return CoarsePixels.of(*self.samples())


@dataclass(frozen=True)
class CoarsePixels:
    """Every QUICK_STEP-th pixel of a picture in either direction, and how the P samples lie between these."""

    pixels: np.ndarray  # the samples in these pixels
    film: Film
    surface: tuple  # of these samples, see `_surface_of`
    index: np.ndarray  # (4, P) the pixels around each sample, their weights, and which are of another surface
    weights: np.ndarray
    is_far: np.ndarray

    @classmethod
    def of(cls, samples: SurfaceSamples, film: Film) -> "CoarsePixels":
        """Those of a picture."""
        row_and_column, first = np.stack(np.divmod(film.pixel, film.width)), QUICK_STEP // 2
        height, width = (-(-(side - first) // QUICK_STEP) for side in (film.height, film.width))
        few = np.flatnonzero((row_and_column % QUICK_STEP == first).all(axis=0))
        coarse = Film(width, height, (width, 1) @ (row_and_column[:, few] // QUICK_STEP))
        surface, normal = _surface_of(samples.take(few), coarse), _smooth_normal(samples)
        share, low = np.modf(np.maximum(row_and_column - first, 0) / QUICK_STEP)
        corners = np.array([*product((0, 1), repeat=2)])[..., None]  # (4, 2, 1) in rows and columns
        index = (width, 1) @ np.clip(low + corners, 0, [[height - 1], [width - 1]]).astype(int)
        points = surface[0].reshape(-1, 4)[index]
        near = _nearness(points[..., :3] - samples.position, normal) * points[..., 3]
        weights = near * (np.abs(1 - corners - share).prod(axis=1) + 1e-9)
        return cls(few, coarse, surface, index, weights / (weights.sum(axis=0) + 1e-15), near < 0.5)


@dataclass(frozen=True)
class ShadowRequest:
    """Work for the thread: the visibility of some lights at points of a picture. The sides of a sky are one light."""

    state: tuple  # of scene and view, see `LiveShadows._wanted`
    level: float  # number in LEVELS, or QUICK; len(LEVELS): for a group of further points
    group: int
    numbers: tuple  # of the lights in the view
    keys: tuple  # of the lights, see `shape_of`
    lights: tuple[Lights, ...]
    points: PixelGrid
    rays: int
    tracing: ViewTracer

    @property
    def is_for_group(self) -> bool:
        """True for a group of further points."""
        return self.level == len(LEVELS)

    def visibility(self, progress: Callable) -> dict[int, np.ndarray]:
        """Shares (H, W, 2), row 0 at the bottom, by the index of a light in `keys`; where `progress` stops the work,
        only those that are finished. Raises Cancelled where none is."""
        samples, film = self.points.samples()
        if self.level == QUICK:
            return self._quick(samples, film, progress)
        results = self._traced(samples, film, progress)
        if self.level > 0:
            return results
        surface = _surface_of(samples, film)
        return _once(lambda number: _smoothed(results[number], *surface), results)

    def _quick(self, samples: SurfaceSamples, film: Film, progress: Callable) -> dict[int, np.ndarray]:
        """The shares at some pixels, smoothed, and what lies between these or is traced where that does not do."""
        around = self.points.around
        results = self._traced(samples.take(around.pixels), around.film, progress)
        index, differs, skipped = around.index, around.is_far.all(axis=0), around.is_far[..., None]
        for values in {id(values): values for values in results.values()}.values():
            most, least = (np.where(skipped, one, values.reshape(-1, 2)[index]) for one in (0.0, 1.0))
            differs |= (most.max(axis=0) - least.min(axis=0) > QUICK_DIFFERENCE).any(axis=-1)
        traced = self._traced(samples.take(differs), film.take(differs), progress)

        def between(number):
            smooth = _smoothed(results[number], *around.surface).reshape(-1, 2)[index]
            whole = np.ones((film.height, film.width, 2), np.float32)
            whole.reshape(-1, 2)[film.pixel] = np.einsum("kp,kpc->pc", around.weights, smooth)
            if number in traced:
                whole.reshape(-1, 2)[film.pixel[differs]] = traced[number].reshape(-1, 2)[film.pixel[differs]]
            return whole

        return _once(between, results)

    def _traced(self, samples: SurfaceSamples, film: Film, progress: Callable) -> dict[int, np.ndarray]:
        """The shares of `samples`, as `visibility` returns them."""
        tracer, results = self.tracing.tracer, {}
        origins = self.points.ray_origins(self.tracing.pool, progress) if self.level == 1 else None
        lights, first = rays_to(self.lights)
        groups = shared_numbers(lights, tracer)
        step = BATCH if self.level == 1 else len(groups)
        sampling = ShadowSampling(rays=self.rays, film=film)
        options = {"workers": self.tracing.pool, "ray_origins": origins, "progress": progress}
        for start in range(0, len(groups), step):
            chosen = [number for group in groups[start : start + step] for number in group]
            try:
                traced = trace_visibility(samples, [lights[number] for number in chosen], tracer, sampling, **options)
            except Cancelled:
                if not results:
                    raise
                break
            self.tracing.rays += traced.rays
            by_pass = [traced.of_lights(name) for name in PASSES]
            for row, number in enumerate(chosen):
                if number in first:
                    values = np.ones((film.height, film.width, len(PASSES)), np.float32)
                    values.reshape(-1, len(PASSES))[film.pixel] = np.stack([one[row] for one in by_pass], axis=-1)
                    results |= {index: values for index, start in enumerate(first) if start == number}
        return results


def _once(function: Callable, results: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """What `function` makes of the numbers of `results`, once for those with one array."""
    made = {key: function(number) for key, number in {id(values): n for n, values in results.items()}.items()}
    return {number: made[id(values)] for number, values in results.items()}


def _surface_of(samples: SurfaceSamples, film: Film) -> tuple[np.ndarray, np.ndarray]:
    """Positions (H, W, 4), w = 0 where there are no samples, and normals (H, W, 3) in the pixels of a film."""
    values = np.zeros((film.height, film.width, 7))
    values.reshape(-1, 7)[film.pixel] = np.c_[samples.position, np.ones(len(samples)), _smooth_normal(samples)]
    return values[..., :4], values[..., 4:]


def _smooth_normal(samples: SurfaceSamples) -> np.ndarray:
    """The normals (P, 3) without bumps; those of horizons depend on lights."""
    return samples.normal if samples.smooth_normal is None else samples.smooth_normal


def _nearness(way: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How far points that are `way` (..., 3) off lie in the plane of a normal: 1 to 0, as in lighting.glsl."""
    off = np.abs((way * normal).sum(axis=-1)) / np.maximum(0.2 * np.linalg.norm(way, axis=-1), 1e-6)
    return np.exp(-(off**2))


def _smoothed(values: np.ndarray, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Shares (H, W, 2) as weighted means of 3 x 3 pixels of the same surface, see `_surface_of`."""

    def weight(surface: np.ndarray, shares: np.ndarray) -> np.ndarray:
        near = _nearness(surface[..., :3] - position[..., :3], normal) * surface[..., 3]
        alike = np.clip((normal * surface[..., 4:]).sum(axis=-1), 0.0, 1.0)
        by_value = np.exp(-(((shares - values) / QUICK_DIFFERENCE) ** 2))
        return 0.5 * (near * alike**16)[..., None] * by_value

    return means_of_neighbors(values, np.concatenate([position, normal], axis=-1), weight).astype(np.float32)


class LiveShadows:
    """Shadows while an artist works: a thread traces them, coarse at first, finer while nothing changes.

    Until new shadows are there, the old ones are shown on the same surfaces. A recolored light keeps its shadows; only
    those of further points of a view at rest are traced again. The glass in front of the surfaces has an object of its
    own, `of_glass`: only `visibility` is called there, all else is asked and told here. Only one of the two traces at a
    time.
    """

    traces_lobes = False  # all lobes use the shadows of the first lobe

    def __init__(self, behind: "LiveShadows | None" = None):
        self._behind, self._glass = behind, None
        self._traced_scene = TracedScene() if behind is None else behind._traced_scene
        self._version, self._problem, self._traced = 0, "", 0  # _traced: the version of the occluders
        self._waits = False  # the picture whose shadows were asked for last must wait for the thread
        # Number and visibility of a group of further points.
        self._group_grid: tuple[int, VisibilityGrid | None] = (0, None)
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._request: ShadowRequest | None = None  # the current one of the thread, or its last
        self._outcomes: deque[tuple[ShadowRequest, dict[int, np.ndarray] | Exception]] = deque()
        self._is_abandoned = False
        # The lights, with those of a sky as one, their keys, and the arguments that they come from.
        self._lights, self._keys, self._given = (), (), None
        self._wanted: tuple = ()  # state of scene and view that is to be shown
        # The size of what is shown. Where pictures have fewer pixels, only coarse shadows are traced.
        self.shown: tuple[int, int] | None = None
        self._is_patient = False  # the last level waits, because something else is more urgent
        self._is_whole = True  # the picture has all pixels of what is shown
        # State and size of a picture, and points, by whether they are coarse.
        self._pixels: dict[bool, tuple[tuple, PixelGrid]] = {}
        self._state: tuple = ()  # state that was traced last; the next two and `_traced` belong to it
        self._known: dict[tuple, dict[int, np.ndarray]] = {}  # visibility (H, W, 2), by the key of a light and level
        self._points: dict[bool, PixelGrid] = {}  # by whether they are coarse
        self._latest: dict[int, dict[int, np.ndarray]] = {}  # latest visibility by the number of a light and level
        self._layers = np.ones((0, 0, 0, 2), np.float32)  # visibility in `_grid`
        self._sources: list[np.ndarray | None] = []  # what each was made from
        self._grid: VisibilityGrid | None = None
        self._blank: VisibilityGrid | None = None

    @property
    def of_glass(self) -> "LiveShadows":
        """The shadows of the glass in front of the surfaces."""
        if self._glass is None:
            self._glass = LiveShadows(self)
        return self._glass

    @property
    def _both(self) -> "tuple[LiveShadows, ...]":
        return (self,) if self._glass is None else (self, self._glass)

    @property
    def version(self) -> int:
        """A number that changes when pictures must be drawn anew."""
        return sum(one._version for one in self._both)

    @property
    def problem(self) -> str:
        """Why there are no shadows; empty where there are."""
        return next((one._problem for one in self._both if one._problem), "")

    @property
    def waits(self) -> bool:
        """True if the picture whose shadows were asked for last cannot be drawn yet."""
        return any(one._waits for one in self._both)

    def follow(self, scene: tuple, collect: Callable[[], Occluders]) -> None:
        """To be called before a picture is drawn. `scene` changes with its occluders; `collect()` returns them."""
        if scene != self._traced_scene.scene:
            for one in self._both:
                one._problem = ""
        self._traced_scene.scene, self._traced_scene.collect = scene, collect

    @property
    def is_busy(self) -> bool:
        """True if a thread works, or has results that no picture shows yet."""
        return any(one._thread is not None for one in self._both)

    @property
    def is_fine(self) -> bool:
        """True if the last level is there, or never comes."""
        return all(one._next_level() is None for one in self._both)

    @property
    def has_news(self) -> bool:
        """True if a thread has results or has ended."""
        return any(one._thread is not None and (one._outcomes or not one._thread.is_alive()) for one in self._both)

    def stop(self) -> None:
        """Make the thread and its helping process end soon, and free the textures and the glass at once."""
        for one in self._both:
            one._is_abandoned = True
            one._stop.set()
            one._grid = one._blank = None
            one._group_grid = (0, None)
        self.rest()
        self._glass = None

    def rest(self) -> None:
        """End the helping process unless the thread works. It is started again when it pays."""
        if all(one._thread is None or not one._thread.is_alive() for one in self._both):
            self._traced_scene.close()

    def hold(self, is_patient: bool) -> None:
        """Let the last level of large pictures wait, or not any more: then it begins with a new first picture."""
        if self._is_patient and not is_patient and any(one._best_level == QUICK for one in self._both if one._keys):
            self._version += 1
        self._is_patient = is_patient

    def take_news(self) -> None:
        """Take over the results of the thread. If `version` changes, pictures must be drawn anew."""
        for one in self._both:
            before, has_ended = one._version, one._thread is not None and not one._thread.is_alive()
            if has_ended:
                one._thread = None
            while one._outcomes:
                one._take(*one._outcomes.popleft())
            # Work that had to wait for the thread begins with a new first picture.
            if has_ended and one._version == before and any(other._next_level() is not None for other in self._both):
                one._version += 1

    def _take(self, request: ShadowRequest, outcome: dict[int, np.ndarray] | Exception) -> None:
        if request.is_for_group and not isinstance(outcome, Exception):
            if (request.state, request.keys) == (self._wanted, self._keys):
                positions, projection = request.points.grid
                values = np.stack([outcome[index] for index in range(len(request.keys))])
                grid = VisibilityGrid(
                    visibility_texture(values, positions.shape[1::-1]), float_texture(positions), projection
                )
                self._group_grid = request.group, grid
            return
        self._version += not (request.is_for_group and isinstance(outcome, Cancelled))
        if isinstance(outcome, Exception):
            self._problem = "" if isinstance(outcome, Cancelled) else f"shadows: {error_line(outcome)}"
            return
        if request.state != self._state:
            self._state, self._known, self._points, self._latest = request.state, {}, {}, {}
            self._traced = self._traced_scene.version
        self._points[request.level == 0] = request.points
        self._known = {key: levels for key, levels in self._known.items() if key in self._keys}
        for index, values in outcome.items():
            self._known.setdefault(request.keys[index], {})[request.level] = values
            self._latest[request.numbers[index]] = {request.level: values}
        self._show()

    def visibility(
        self, gbuffer: GBufferTextures, view: ViewCamera, lights: Lights, sides: Lights = (), number: int = 0
    ) -> VisibilityGrid | None:
        """What is known so far, as `ShadowRays.visibility` returns it; `number` counts the pictures of a view at rest.

        Before any are known, a grid without points: with it the shader with shadows is compiled from the start.
        """
        if self._given is None or lights is not self._given[0] or sides is not self._given[1]:
            self._given = lights, sides
            self._lights = shadowed_lights(lights, sides)
            self._keys = (*map(shape_of, lights), *((shape_of_sky(sides),) if sides else ()))
            if self._grid is not None and len(self._keys) != len(self._layers):
                self._latest = {}
                self._show()
        if number == 0:
            size = (self._behind or self).shown or gbuffer.size
            self._wanted = (self._traced_scene.scene, view.projection.tobytes(), size)
            self._is_whole = size == gbuffer.size
            self._group_grid = (0, None)
        for one in self._both:
            one._waits = False
        level = self._next_level()
        if level is not None and self._may_begin(level, number):
            try:
                self._traced_scene.collect_now()
                if level > 0 or not self._keeps_fine():
                    self._begin(level, gbuffer, view)
                elif self._may_begin(1, number):
                    self._begin(1, gbuffer, view)
            except Exception as error:
                self._problem = f"shadows: {error_line(error)}"
        elif self._thread is not None and self._is_outdated:
            self._stop.set()
        if number > 0 and not self._is_off:
            if number // GROUP == self._group_grid[0] and self._group_grid[1] is not None:
                return self._group_grid[1]
            if level is None and number >= FIRST_POINTS and self._is_free and self._is_whole:
                numbers, points = tuple(range(len(self._keys))), PixelGrid(1, gbuffer, view)
                self._start([self._request_for(numbers, points, GROUP_RAYS, group=number // GROUP)])
            self._waits = self._thread is not None
        fits = len(self._layers) == len(self._keys)
        if fits or self._is_off:
            return self._grid if fits else None
        if self._blank is None:
            self._blank = _blank()
        return self._blank

    @property
    def _is_outdated(self) -> bool:
        """True if the thread refines shadows of an old view, or of a light that has moved."""
        request = self._request
        return request.level > 0 and (request.state != self._wanted or not set(request.keys) <= set(self._keys))

    @property
    def _is_off(self) -> bool:
        return not self._keys or bool(self._problem) or bool(too_many(len(self._keys), self._wanted[-1]))

    def _next_level(self) -> int | None:
        """The coarsest level that some light lacks in the wanted state; None: all are there."""
        if self._is_off:
            return None
        best = self._best_level
        return None if best == len(LEVELS) - 1 else int(best) + 1

    @property
    def _best_level(self) -> float:
        """The level that all lights have in the wanted state; -1: none."""
        known = self._known if self._state == self._wanted else {}
        return min(max(known.get(key, (-1,))) for key in self._keys)

    @property
    def _has_patience(self) -> bool:
        return (self._behind or self)._is_patient

    @property
    def _is_free(self) -> bool:
        """True if no thread works, here or for the other layer."""
        other = self._behind or self._glass
        return self._thread is None and (other is None or other._thread is None)

    def _may_begin(self, level: int, number: int) -> bool:
        """True if `level` may be traced now: no thread works, and occluders do not hold up a scene that moves.

        Finer levels need the points of the first picture, `number` 0.
        """
        if not self._is_free:
            if self._thread is None and self._glass is not None and self._glass._request.level > 0:
                self._glass._stop.set()
            return False
        is_finer = number == 0 and self._is_whole and not (self._has_patience and self._best_level == QUICK)
        return self._traced_scene.may_collect() and (level == 0 or is_finer)

    def _begin(self, level: int, gbuffer: GBufferTextures, view: ViewCamera) -> None:
        requests = [self._request_of(level, gbuffer, view)]
        if level == 0 and self._pixels.get(False, (None,))[0] == (self._wanted, gbuffer.size):
            requests.append(self._request_of(1, gbuffer, view))
        if requests[-1].level == 1 and np.prod(gbuffer.size) > MANY_POINTS:
            quick = self._request_of(QUICK, gbuffer, view)
            if quick.numbers:
                requests[-1:] = [quick] if self._has_patience else [quick, requests[-1]]
        self._start(requests)

    def _keeps_fine(self) -> bool:
        """Keep fine shadows where only materials have changed, until finer ones are there; False: there are none."""
        finest = {key: max(levels) for key, levels in self._known.items()}
        is_same = self._traced == self._traced_scene.version and self._state[1:] == self._wanted[1:]
        if not is_same or any(finest.get(key, -1) < STAYING for key in self._keys):
            return False
        self._state = self._wanted
        self._known = {key: {STAYING: self._known[key][finest[key]]} for key in self._keys}
        return True

    def _request_of(self, level: float, gbuffer: GBufferTextures, view: ViewCamera) -> ShadowRequest:
        """The request of `level` for the lights that lack it."""
        step, rays = (1, QUICK_RAYS) if level == QUICK else LEVELS[level]
        state, points = self._pixels.get(level == 0, (None, None))
        if state == (self._wanted, gbuffer.size):
            points.follow(gbuffer)
        else:
            points = PixelGrid(step or coarse_step(gbuffer.size), gbuffer, view)
            self._pixels[level == 0] = (self._wanted, gbuffer.size), points
        known = self._known if self._wanted == self._state else {}
        numbers = tuple(n for n, key in enumerate(self._keys) if max(known.get(key, (-1,))) < level)
        return self._request_for(numbers, points, rays, level)

    def _request_for(
        self, numbers: tuple, points: PixelGrid, rays: int, level: float = len(LEVELS), group: int = 0
    ) -> ShadowRequest:
        """The request for the lights with these `numbers`."""
        return ShadowRequest(
            state=self._wanted,
            level=level,
            group=group,
            numbers=numbers,
            keys=tuple(self._keys[n] for n in numbers),
            lights=tuple(self._lights[n] for n in numbers),
            points=points,
            rays=rays,
            tracing=self._traced_scene.tracing,
        )

    def _start(self, requests: list[ShadowRequest]) -> None:
        """Start the thread, which traces one request after another."""
        self._stop.clear()
        self._request, self._is_abandoned = requests[0], False
        self._thread = threading.Thread(target=self._trace, args=(requests,), name="LTSH shadows", daemon=True)
        self._thread.start()

    def _trace(self, requests: list[ShadowRequest]) -> None:
        start = time.monotonic()
        for number, request in enumerate(requests):
            if number > 0 and self._stop.wait(max(PAUSE_SECONDS - (time.monotonic() - start), 0.0)):
                break
            self._request = request
            try:
                outcome = request.visibility(lambda stage, fraction: not self._stop.is_set())
            except Exception as error:
                # Its traceback would make a reference cycle, which keeps the samples of the picture alive.
                outcome = error.with_traceback(None)
            self._outcomes.append((request, outcome))
            if isinstance(outcome, Exception):
                break
        if self._is_abandoned:
            requests[0].tracing.close()

    def _show(self) -> None:
        """Make the grid of all known visibility. A light without any keeps the latest of the light of its number."""
        known = [self._known.get(key) or self._latest.get(number, {}) for number, key in enumerate(self._keys)]
        if not any(known):
            return
        is_coarse = min(max(levels) for levels in known if levels) == 0
        positions, projection = self._points[is_coarse].grid
        height, width = positions.shape[:2]
        layers, sources = np.ones((len(known), height, width, 2), np.float32), [None] * len(known)
        for number, levels in enumerate(known):
            if levels:
                values = sources[number] = levels[max(levels)]
                if values.shape[:2] != (height, width):  # finer, or of a picture with more or fewer pixels
                    places = zip(self._points[is_coarse].places, values.shape, strict=False)
                    values = values[np.ix_(*((place * side).astype(int) for place, side in places))]
                layers[number] = values
            elif self._layers.shape == layers.shape:
                layers[number], sources[number] = self._layers[number], self._sources[number]
        self._layers, self._sources = layers, sources
        grid = visibility_texture(layers, (width, height)), float_texture(positions)
        self._grid = VisibilityGrid(*grid, projection, tuple((positions, source) for source in sources))


def coarse_step(size: tuple[int, int]) -> int:
    """Distance in pixels of the points of the coarsest level, in a picture of `size`."""
    return max(2, round((size[0] * size[1] / COARSE_POINTS) ** 0.5))


def shape_of(light: Light) -> str:
    """A key of all that the visibility of `light` depends on: everything but its brightness."""
    return repr({name: value for name, value in light.record().items() if name not in ("radiance", "detail")})


def shape_of_sky(sides: Lights) -> str:
    """A key of all that the visibility of a sky depends on: the relative, not absolute brightness of its patches."""
    values = np.array([patch.radiance.mean() for side in sides for patch in side.leaves])
    traits = sides[0].affects_diffuse, sides[0].affects_specular, sides[0].name
    return repr((traits, np.round(values / max(np.abs(values).mean(), 1e-30), 4).tobytes()))
