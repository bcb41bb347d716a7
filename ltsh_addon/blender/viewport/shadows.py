"""Shadows of a view: the share of each light that its pixels see, traced as for pictures, with the same occluders."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gpu
import numpy as np

from ...scene import PASSES, AreaLight, Cancelled, Film, SurfaceSamples, error_line
from ...visibility import Occluders, ShadowSampling, Starts, Tracer, open_tracer, ray_origins, shared_numbers, visible_shares
from ...workers.pool import WorkerPool, cores
from ..process.blender_process import embree_libraries
from .surfaces import View
from .textures import GBufferTextures, ShareGrid, float_texture, read_texture

Lights = Sequence[AreaLight]
# MOST_BYTES: graphics memory for the shares of all lights. _SHARE_BYTES: of a light and a pixel, two half floats.
MOST_BYTES = 1 << 30
_SHARE_BYTES = 4


class _Tracing:
    """A tracer of occluders, and the pool of this process and a worker that trace with it.

    Positions are relative to an origin near the view, where single precision is best. The origin changes rarely.
    """

    def __init__(self, occluders: Occluders):
        self._occluders = occluders
        self._tracer: Tracer | None = None
        self.pool: WorkerPool | None = None
        self._origin = np.zeros(3)

    def around(self, origin: np.ndarray) -> Tracer:
        """The tracer with positions relative to `origin` (3,). Raises SceneError where Embree is missing."""
        if self._tracer is None or not np.array_equal(origin, self._origin):
            matrices = np.array(self._occluders.matrices, np.float64)
            matrices[:, :, 3] -= origin
            self._tracer = open_tracer(replace(self._occluders, matrices=matrices), embree_libraries())
            self.close()
            self.pool, self._origin = WorkerPool(self._tracer, min(cores(), 2)), np.array(origin)
        return self._tracer

    def close(self) -> None:
        """End the worker."""
        if self.pool is not None:
            self.pool.close()


class ShadowRays:
    """Traces, at once, the shares of lights that the pixels of G-buffers see past `occluders`.

    A pixel takes at most `rays` rays per light.
    """

    version, waits, traces_lobes = 0, False, True

    @property
    def of_glass(self) -> ShadowRays:
        """The tracer for the glass in front of the surfaces: the same."""
        return self

    def take_news(self) -> None:
        """Do nothing: there is never news, because everything is traced at once."""

    def __init__(self, occluders: Occluders, rays: int):
        self._tracing, self._rays = _Tracing(occluders), rays
        self.seconds, self.traced, self.description = 0.0, 0, ""
        # By pass, summed over all calls: squares of the reflected light of pixels, and of its standard deviation.
        self._power = {name: np.zeros(2) for name in PASSES}

    def shares(
        self, gbuffer: GBufferTextures, view: View, lights: Lights, sides: Lights = (), number: int = 0
    ) -> ShareGrid | None:
        """The shares of `lights`, and last that of the `sides` of a sky if there are any; None without surfaces or
        lights. Positions are relative to the origin of `view`. Raises SceneError."""
        start = time.perf_counter()
        samples, pixel = gbuffer_samples(gbuffer, view)
        if not len(samples) or not (lights or sides):
            return None
        width, height = gbuffer.size
        tracer = self._tracing.around(view.origin)
        film = Film(width, height, pixel)
        found = visible_shares(samples, (*lights, *sides), tracer, ShadowSampling(rays=self._rays, film=film))
        count = len(lights) + bool(sides)
        values = np.ones((count, height * width, len(PASSES)), np.float32)
        for index, name in enumerate(PASSES):
            values[:, pixel, index] = found.of_lights(name)[:count]
            power = (np.square(part[name], dtype=np.float64).sum() for part in (found.radiance, found.deviation))
            self._power[name] += list(power)
        self.seconds += time.perf_counter() - start
        self.traced, self.description = self.traced + found.rays, tracer.description
        return ShareGrid(_upload(values, gbuffer.size), gbuffer.position, view.projection)

    def noise(self, samples: int) -> dict[str, float]:
        """Estimated relative L2 error by pass of the shadows in the mean of `samples` pictures."""
        return {
            name: float(np.sqrt(variance / max(power, 1e-30) / samples))
            for name, (power, variance) in self._power.items()
        }


def _upload(values: np.ndarray, size: tuple[int, int]) -> gpu.types.GPUTexture:
    """Array texture of shares (L, H W, 2) on pictures of `size`."""
    buffer = gpu.types.Buffer("FLOAT", values.size, np.ascontiguousarray(values, np.float32).reshape(-1))
    return gpu.types.GPUTexture(size, layers=len(values), format="RG16F", data=buffer)


def _blank() -> ShareGrid:
    """A grid without surface points, with which every light is seen whole."""
    return ShareGrid(_upload(np.ones((1, 2), np.float32)[None], (1, 1)), float_texture(np.zeros((1, 1, 4))), np.eye(4))


# LEVELS: traced one after another while nothing changes. Each is the distance of the points in pixels, and the rays of
# a light and a point. None: the distance that gives COARSE_POINTS points.
LEVELS = ((None, 8), (1, 32))
COARSE_POINTS = 8000
# FIRST_POINTS: sub-pixel points that a view at rest draws with the shares of its first picture, so that edges become
# smooth soon. The later points come in groups of GROUP, each group with new shares of GROUP_RAYS rays.
FIRST_POINTS, GROUP, GROUP_RAYS = 8, 4, 64
# QUICK_SECONDS: occluders that take longer to collect are only collected once no object moves any more.
QUICK_SECONDS = 0.03
# BATCH: emitters that are traced together. The shares of finished batches are kept when the rest is stopped.
BATCH = 4
# PAUSE_SECONDS: finer shadows follow the coarse ones of a light if it has stayed still for so long.
PAUSE_SECONDS = 0.15


class _Points:
    """Every `step`-th pixel of a G-buffer in either direction.

    The window's thread reads the pixels; the tracing thread turns them into samples.
    """

    def __init__(self, step: int, gbuffer: GBufferTextures, view: View):
        self._step, self._view, (width, height) = step, view, gbuffer.size
        self._texels, self._samples, self._normal = _texels(gbuffer, step), None, None
        self._starts: Starts | None = None
        positions, first = self._texels["position"], step // 2
        rows, columns = positions.shape[:2]
        stretch = np.eye(4)
        for axis, (whole, part) in enumerate(((width, columns), (height, rows))):
            stretch[axis, axis] = whole / (part * step)
            stretch[axis, 3] = 2.0 / part * ((0.5 * whole - 0.5 - first) / step + 0.5) - 1.0
        # The grid of these pixels: positions (H, W, 4), and the projection to its clip space.
        self.grid = positions, stretch @ view.projection

    def follow(self, gbuffer: GBufferTextures) -> None:
        """Read again what depends on the lights: the normals of the horizons."""
        if gbuffer.geometric_normal is not None:
            self._normal = _every(gbuffer.geometric_normal, self._step)

    def starts(self, pool: WorkerPool) -> Starts:
        """Where rays from the samples start."""
        if self._starts is None:
            self._starts = ray_origins(self.samples()[0], pool)
        return self._starts

    def samples(self) -> tuple[SurfaceSamples, Film]:
        """The samples and their film."""
        if self._samples is None:
            self._samples, self._texels = _samples_of(self._texels, self._view), None
        samples, pixel = self._samples
        if self._normal is not None:
            normal = _unit(self._normal.reshape(-1, 4)[pixel].astype(np.float64))
            samples = replace(samples, geometric_normal=normal)
        rows, columns = self.grid[0].shape[:2]
        return samples, Film(columns, rows, pixel)


@dataclass(frozen=True)
class _Request:
    """Work for the thread: the shares of some lights at points of a picture. The sides of a sky are one light."""

    state: tuple  # of scene and view, see `LiveShadows._wanted`
    level: int  # number in LEVELS; len(LEVELS): for a group of further points
    group: int
    numbers: tuple  # of the lights in the view
    keys: tuple  # of the lights, see `_shape_of`
    lights: tuple[Lights, ...]
    points: _Points
    rays: int
    tracing: _Tracing
    origin: np.ndarray

    @property
    def is_own(self) -> bool:
        """True for a group of further points."""
        return self.level == len(LEVELS)

    def shares(self, progress: Callable) -> dict[int, np.ndarray]:
        """Shares (H, W, 2), row 0 at the bottom, by the index of a light in `keys`.

        If `progress` stops the work, the result has only the lights that are finished; without any, Cancelled is
        raised.
        """
        samples, film = self.points.samples()
        tracer, found = self.tracing.around(self.origin), {}
        starts = self.points.starts(self.tracing.pool) if self.level == 1 else None
        lights = [light for lights in self.lights for light in lights]
        starts = np.cumsum([0, *map(len, self.lights)])[:-1]
        place_of = dict(zip(starts.tolist(), range(len(starts)), strict=True))
        groups = shared_numbers(lights, tracer)
        step = BATCH if self.level == 1 else len(groups)
        sampling = ShadowSampling(rays=self.rays, film=film)
        for start in range(0, len(groups), step):
            chosen = [number for group in groups[start : start + step] for number in group]
            try:
                seen = visible_shares(
                    samples,
                    [lights[number] for number in chosen],
                    tracer,
                    sampling,
                    workers=self.tracing.pool,
                    starts=starts,
                    progress=progress,
                )
            except Cancelled:
                if not found:
                    raise
                break
            by_pass = [seen.of_lights(name) for name in PASSES]
            for row, number in enumerate(chosen):
                if number in place_of:
                    values = np.ones((film.height * film.width, len(PASSES)), np.float32)
                    values[film.pixel] = np.stack([shares[row] for shares in by_pass], axis=-1)
                    found[place_of[number]] = values.reshape(film.height, film.width, len(PASSES))
        return found


class _Followed:
    """The scene whose shadows are shown, and its tracer."""

    def __init__(self):
        self.scene, self.collect, self.collected, self.before = None, None, None, None
        self.tracing: _Tracing | None = None
        self.collect_seconds = 0.0

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
        start = time.perf_counter()
        self.close()
        self.tracing, self.collected = _Tracing(self.collect()), self.scene
        self.collect_seconds = time.perf_counter() - start

    def close(self) -> None:
        """End the process that helps the tracer."""
        if self.tracing is not None:
            self.tracing.close()


class LiveShadows:
    """Shadows while an artist works: a thread traces them, coarse at first, finer while nothing changes.

    Until new shares are there, the old ones are shown on the same surfaces. A recolored light keeps its shares; only
    those of further points of a view at rest are traced again. The glass in front of the surfaces has an object of its
    own, `of_glass`: only `shares` is called there, all else is asked and told here. Only one of the two traces at a
    time.
    """

    traces_lobes = False  # all lobes use the shadows of the first lobe

    def __init__(self, behind: LiveShadows | None = None):
        self._behind, self._glass = behind, None
        self._followed = _Followed() if behind is None else behind._followed
        self._version, self._problem = 0, ""
        self._waits = False  # the picture whose shares were asked for last must wait for the thread
        self._own: tuple[int, ShareGrid | None] = (0, None)  # number and shares of a group of further points
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._request: _Request | None = None  # the current one of the thread, or its last
        self._outcomes: deque[tuple[_Request, dict[int, np.ndarray] | Exception]] = deque()
        self._is_left = False
        # The lights, with those of a sky as one, their keys, and the arguments that they come from.
        self._lights, self._keys, self._given = (), (), None
        self._wanted: tuple = ()  # state of scene and view that is to be shown
        self._pixels: dict[bool, tuple[tuple, _Points]] = {}  # state and points, by whether they are coarse
        self._state: tuple = ()  # state that was traced last; the next two belong to it
        self._known: dict[tuple, dict[int, np.ndarray]] = {}  # shares (H, W, 2), by the key of a light and level
        self._points: dict[bool, tuple[np.ndarray, np.ndarray]] = {}  # grids of points, by whether they are coarse
        self._latest: dict[int, dict[int, np.ndarray]] = {}  # latest shares by the number of a light and level
        self._layers = np.ones((0, 0, 0, 2), np.float32)  # shares in `_grid`
        self._sources: list[np.ndarray | None] = []  # what each was made from
        self._grid: ShareGrid | None = None
        self._blank: ShareGrid | None = None
        self._origin = np.zeros(3)

    @property
    def of_glass(self) -> LiveShadows:
        """The shadows of the glass in front of the surfaces."""
        if self._glass is None:
            self._glass = LiveShadows(self)
        return self._glass

    @property
    def _both(self) -> tuple[LiveShadows, ...]:
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
        """True if the picture whose shares were asked for last cannot be drawn yet."""
        return any(one._waits for one in self._both)

    def follow(self, scene: tuple, collect: Callable[[], Occluders]) -> None:
        """To be called before a picture is drawn. `scene` changes with its occluders; `collect()` returns them."""
        if scene != self._followed.scene:
            for one in self._both:
                one._problem = ""
        self._followed.scene, self._followed.collect = scene, collect

    @property
    def is_busy(self) -> bool:
        """True if a thread works, or has results that no picture shows yet."""
        return any(one._thread is not None for one in self._both)

    @property
    def has_news(self) -> bool:
        """True if a thread has results or has ended."""
        return any(one._thread is not None and (one._outcomes or not one._thread.is_alive()) for one in self._both)

    def stop(self) -> None:
        """Make the thread and its helping process end soon, and free the textures and the glass at once."""
        for one in self._both:
            one._is_left = True
            one._stop.set()
            one._grid = one._blank = None
            one._own = (0, None)
        self.rest()
        self._glass = None

    def rest(self) -> None:
        """End the helping process unless the thread works. It is started again when it pays."""
        if all(one._thread is None or not one._thread.is_alive() for one in self._both):
            self._followed.close()

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

    def _take(self, request: _Request, outcome: dict[int, np.ndarray] | Exception) -> None:
        if request.is_own and not isinstance(outcome, Exception):
            if (request.state, request.keys) == (self._wanted, self._keys):
                positions, projection = request.points.grid
                values = np.stack([outcome[place] for place in range(len(request.keys))])
                grid = ShareGrid(_upload(values, positions.shape[1::-1]), float_texture(positions), projection)
                self._own = request.group, grid
            return
        self._version += not (request.is_own and isinstance(outcome, Cancelled))
        if isinstance(outcome, Exception):
            self._problem = "" if isinstance(outcome, Cancelled) else f"shadows: {error_line(outcome)}"
            return
        if request.state != self._state:
            self._state, self._known, self._points, self._latest = request.state, {}, {}, {}
        self._points[request.level == 0] = request.points.grid
        self._known = {key: levels for key, levels in self._known.items() if key in self._keys}
        for place, values in outcome.items():
            self._known.setdefault(request.keys[place], {})[request.level] = values
            self._latest[request.numbers[place]] = {request.level: values}
        self._origin = request.origin
        self._show()

    def shares(
        self, gbuffer: GBufferTextures, view: View, lights: Lights, sides: Lights = (), number: int = 0
    ) -> ShareGrid | None:
        """The shares known so far, as `ShadowRays.shares` returns them; `number` counts the pictures of a view at rest.

        Before any are known, a grid without points: with it the shader with shadows is compiled from the start.
        """
        if self._given is None or lights is not self._given[0] or sides is not self._given[1]:
            self._given = lights, sides
            self._lights = (*((light,) for light in lights), *((sides,) if sides else ()))
            self._keys = (*map(_shape_of, lights), *((_shape_of_sky(sides),) if sides else ()))
            if self._grid is not None and len(self._keys) != len(self._layers):
                self._latest = {}
                self._show()
        if number == 0:
            self._wanted = (self._followed.scene, view.projection.tobytes(), view.origin.tobytes(), gbuffer.size)
            self._own = (0, None)
        for one in self._both:
            one._waits = False
        level = self._next_level()
        if level is not None and self._may_begin(level, number):
            try:
                self._begin(level, gbuffer, view)
            except Exception as error:
                self._problem = f"shadows: {error_line(error)}"
        elif self._thread is not None and self._is_outdated:
            self._stop.set()
        if number > 0 and not self._is_off:
            if number // GROUP == self._own[0] and self._own[1] is not None:
                return self._own[1]
            if level is None and number >= FIRST_POINTS and self._is_free:
                self._begin_own(number // GROUP, gbuffer, view)
            self._waits = self._thread is not None
        fits = len(self._layers) == len(self._keys) and np.array_equal(self._origin, view.origin)
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
        if self._state != self._wanted:
            return 0
        best = min(max(self._known.get(key, (-1,))) for key in self._keys)
        return None if best == len(LEVELS) - 1 else best + 1

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
        return self._followed.may_collect() and (number == 0 or level == 0)

    def _begin(self, level: int, gbuffer: GBufferTextures, view: View) -> None:
        self._followed.collect_now()
        requests = [self._request_of(level, gbuffer, view)]
        if level == 0 and self._pixels.get(False, (None,))[0] == self._wanted:
            requests.append(self._request_of(1, gbuffer, view))
        self._start(requests)

    def _request_of(self, level: int, gbuffer: GBufferTextures, view: View) -> _Request:
        """The request of `level` for the lights that lack it."""
        step, rays = LEVELS[level]
        state, points = self._pixels.get(level == 0, (None, None))
        if state == self._wanted:
            points.follow(gbuffer)
        else:
            points = _Points(step or coarse_step(gbuffer.size), gbuffer, view)
            self._pixels[level == 0] = self._wanted, points
        known = self._known if self._wanted == self._state else {}
        numbers = tuple(n for n, key in enumerate(self._keys) if max(known.get(key, (-1,))) < level)
        return self._request_for(numbers, points, rays, view, level)

    def _begin_own(self, group: int, gbuffer: GBufferTextures, view: View) -> None:
        points = _Points(1, gbuffer, view)
        request = self._request_for(tuple(range(len(self._keys))), points, GROUP_RAYS, view, len(LEVELS))
        self._start([replace(request, group=group)])

    def _request_for(self, numbers: tuple, points: _Points, rays: int, view: View, level: int) -> _Request:
        """The request for the lights with these `numbers`."""
        return _Request(
            state=self._wanted,
            level=level,
            group=0,
            numbers=numbers,
            keys=tuple(self._keys[n] for n in numbers),
            lights=tuple(self._lights[n] for n in numbers),
            points=points,
            rays=rays,
            tracing=self._followed.tracing,
            origin=view.origin.copy(),
        )

    def _start(self, requests: list[_Request]) -> None:
        """Start the thread, which traces one request after another."""
        self._stop.clear()
        self._request, self._is_left = requests[0], False
        self._thread = threading.Thread(target=self._trace, args=(requests,), name="LTSH shadows", daemon=True)
        self._thread.start()

    def _trace(self, requests: list[_Request]) -> None:
        start = time.monotonic()
        for number, request in enumerate(requests):
            if number > 0 and self._stop.wait(max(PAUSE_SECONDS - (time.monotonic() - start), 0.0)):
                break
            self._request = request
            try:
                outcome = request.shares(lambda stage, fraction: not self._stop.is_set())
            except Exception as error:
                # Its traceback would make a reference cycle, which keeps the samples of the picture alive.
                outcome = error.with_traceback(None)
            self._outcomes.append((request, outcome))
            if isinstance(outcome, Exception):
                break
        if self._is_left:
            requests[0].tracing.close()

    def _show(self) -> None:
        """Make the grid of all known shares. A light without any keeps the latest shares of the light of its number."""
        known = [self._known.get(key) or self._latest.get(number, {}) for number, key in enumerate(self._keys)]
        if not any(known):
            return
        is_coarse = min(max(levels) for levels in known if levels) == 0
        positions, projection = self._points[is_coarse]
        height, width = positions.shape[:2]
        step = coarse_step(self._state[-1]) if is_coarse else 1
        layers, sources = np.ones((len(known), height, width, 2), np.float32), [None] * len(known)
        for number, levels in enumerate(known):
            if levels:
                values = sources[number] = levels[max(levels)]
                layers[number] = values[step // 2 :: step, step // 2 :: step] if is_coarse and max(levels) else values
            elif self._layers.shape == layers.shape:
                layers[number], sources[number] = self._layers[number], self._sources[number]
        self._layers, self._sources = layers, sources
        grid = _upload(layers, (width, height)), float_texture(positions)
        self._grid = ShareGrid(*grid, projection, tuple((positions, source) for source in sources))


def coarse_step(size: tuple[int, int]) -> int:
    """Distance in pixels of the points of the coarsest level, in a picture of `size`."""
    return max(2, round((size[0] * size[1] / COARSE_POINTS) ** 0.5))


def _shape_of(light: AreaLight) -> str:
    """A key of all that the shares of `light` depend on: everything but its brightness."""
    return repr({name: value for name, value in light.record().items() if name not in ("radiance", "detail")})


def _shape_of_sky(sides: Lights) -> str:
    """A key of all that the share of a sky depends on: the relative, not the absolute brightness of its patches."""
    values = np.array([patch.radiance.mean() for side in sides for patch in side.patches])
    seen = sides[0].affects_diffuse, sides[0].affects_specular, sides[0].name
    return repr((seen, np.round(values / max(np.abs(values).mean(), 1e-30), 4).tobytes()))


def _every(texture: gpu.types.GPUTexture, step: int) -> np.ndarray:
    """Every `step`-th texel (H, W, 4) in either direction."""
    return np.ascontiguousarray(read_texture(texture)[step // 2 :: step, step // 2 :: step])


def too_many(lights: int, size: tuple[int, int]) -> str:
    """Note that the shares of so many lights do not fit into memory; empty where they do."""
    needed = lights * size[0] * size[1] * _SHARE_BYTES
    if needed <= MOST_BYTES:
        return ""
    return f"shadows are not drawn: those of {lights} lights need {needed / 2**30:.1f} GiB of graphics memory"


def _texels(gbuffer: GBufferTextures, step: int = 1) -> dict[str, np.ndarray]:
    """Every `step`-th texel of a G-buffer, (H, W, 4) by name of the texture."""
    textures = {name: getattr(gbuffer, name) for name in (*_ALWAYS, *_PERHAPS)}
    return {name: _every(texture, step) for name, texture in textures.items() if texture is not None}


_ALWAYS = ("position", "normal", "base", "f0", "f90", "dielectric")
_PERHAPS = ("diffuse_normal", "smooth_normal", "geometric_normal", "tangent", "rebound")


def gbuffer_samples(gbuffer: GBufferTextures, view: View) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples (P) of a G-buffer, relative to the origin of `view`, and their texels (P,), counted from the lower
    left."""
    return _samples_of(_texels(gbuffer), view)


def _samples_of(texels: dict[str, np.ndarray], view: View) -> tuple[SurfaceSamples, np.ndarray]:
    pixel = np.flatnonzero(texels["position"][:, :, 3] > 0.0)
    values = {name: rows.reshape(-1, 4)[pixel].astype(np.float64) for name, rows in texels.items()}
    position, normal, base, f0, f90, dielectric = (values[name] for name in _ALWAYS)
    further = {name: values.get(name) for name in _PERHAPS}
    bent, fuzzy = further["diffuse_normal"], base[:, 3] < 0.0
    tangent, rebound = further["tangent"], further["rebound"]
    return SurfaceSamples(
        position=position[:, :3],
        view=np.broadcast_to(view.eye, (len(pixel), 3)) if view.is_parallel else _unit(view.eye - position[:, :3]),
        normal=_unit(normal),
        diffuse_normal=_unit(normal if bent is None else bent),
        roughness=np.where(fuzzy, 1.0, normal[:, 3]),
        specular_f0=f0[:, :3],
        specular_f90=f90[:, :3],
        dielectric=dielectric[:, :3],
        ior=np.where(fuzzy, 1.5, base[:, 3]),
        sheen_a=np.where(fuzzy, -base[:, 3], 0.0 if rebound is None else np.minimum(rebound[:, 3], 0.0)),
        sheen_b=np.where(fuzzy, normal[:, 3], 0.0),
        diffuse_albedo=base[:, :3],
        diffuse_roughness=None if rebound is None else np.maximum(rebound[:, 3], 0.0),
        diffuse_rebound=None if rebound is None else rebound[:, :3],
        geometric_normal=_unit_or_none(further["geometric_normal"]),
        smooth_normal=_unit_or_none(further["smooth_normal"]),
        bump_alpha2=None if bent is None else bent[:, 3],
        specular_dip=np.stack([f0[:, 3], f90[:, 3], dielectric[:, 3]], axis=1),
        receiver=np.rint(position[:, 3]).astype(np.int64) - 1,
        anisotropy=None if tangent is None else tangent[:, 3],
        tangent=None if tangent is None else tangent[:, :3],
    ), pixel


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors of the first three columns; zero vectors stay zero."""
    vectors = vectors[:, :3]
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def _unit_or_none(vectors: np.ndarray | None) -> np.ndarray | None:
    return None if vectors is None else _unit(vectors)
