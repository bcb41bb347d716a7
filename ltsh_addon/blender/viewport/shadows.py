"""Shadows of a view: the share of each light that its pixels see, by the rays and the occluders of pictures."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gpu
import numpy as np

from ...scene import PASSES, AreaLight, Cancelled, Film, SurfaceSamples, error_line
from ...visibility import Mate, Occluders, ShadowSampling, Tracer, open_tracer, shared_numbers, visible_shares
from ..process.blender_process import embree_libraries
from .surfaces import View
from .textures import GBufferTextures, ShareGrid, float_texture, read_texture

Lights = Sequence[AreaLight]
# Of the shares of all lights, in half precision, on the card.
MOST_BYTES = 1 << 30
_SHARE_BYTES = 4


class _Tracing:
    """A tracer of occluders around an origin, which changes rarely: single precision is best near it; and its mate."""

    def __init__(self, occluders: Occluders):
        self._occluders = occluders
        self._tracer: Tracer | None = None
        self.mate: Mate | None = None
        self._origin = np.zeros(3)

    def around(self, origin: np.ndarray) -> Tracer:
        """The tracer around `origin` (3,). Raises SceneError where Embree is not there."""
        if self._tracer is None or not np.array_equal(origin, self._origin):
            matrices = np.array(self._occluders.matrices, np.float64)
            matrices[:, :, 3] -= origin
            self._tracer = open_tracer(replace(self._occluders, matrices=matrices), embree_libraries())
            self.close()
            self.mate, self._origin = Mate(self._tracer), np.array(origin)
        return self._tracer

    def close(self) -> None:
        """End the process of the mate."""
        if self.mate is not None:
            self.mate.close()


class ShadowRays:
    """Traces the shares of lights that the pixels of G-buffers see past `occluders`, with at most `rays` for each."""

    version, waits, traces_lobes = 0, False, True

    @property
    def of_glass(self) -> ShadowRays:
        """What traces those of the glass before the surfaces."""
        return self

    def take_news(self) -> None:
        """There are none: all is traced at once."""

    def __init__(self, occluders: Occluders, rays: int):
        self._tracing, self._rays = _Tracing(occluders), rays
        self.seconds, self.traced, self.description = 0.0, 0, ""
        # By pass: squares of the light that pixels reflect and of its standard deviation, added up over all calls.
        self._power = {name: np.zeros(2) for name in PASSES}

    def shares(
        self, gbuffer: GBufferTextures, view: View, lights: Lights, sides: Lights = (), number: int = 0
    ) -> ShareGrid | None:
        """Those of `lights`, around the origin of `view`, then that of the `sides` of a sky, if there are any; None
        where there is nothing to see. Raises SceneError."""
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
        """Estimated relative L2 error by pass of the mean of `samples` pictures."""
        return {
            name: float(np.sqrt(variance / max(power, 1e-30) / samples))
            for name, (power, variance) in self._power.items()
        }


def _upload(values: np.ndarray, size: tuple[int, int]) -> gpu.types.GPUTexture:
    """The texture of shares (L, H W, 2)."""
    buffer = gpu.types.Buffer("FLOAT", values.size, np.ascontiguousarray(values, np.float32).reshape(-1))
    return gpu.types.GPUTexture(size, layers=len(values), format="RG16F", data=buffer)


def _blank() -> ShareGrid:
    """A grid without a point: every light is seen."""
    return ShareGrid(_upload(np.ones((1, 2), np.float32)[None], (1, 1)), float_texture(np.zeros((1, 1, 4))), np.eye(4))


# What is traced one after another while nothing changes: pixels between points in either direction (None: so many that
# there are `COARSE_POINTS`), and rays of a light and a point.
LEVELS = ((None, 8), (1, 32))
COARSE_POINTS = 8000
# Edges become smooth at once by the first points of pixels. The others wait for rays of their own, so many points
# together: new rays from new places.
FIRST_POINTS, GROUP, GROUP_RAYS = 8, 4, 64
# Occluders that take longer to collect are collected when no object moves any more.
QUICK_SECONDS = 0.03
# Emitters whose shares are kept where those of the next ones are stopped.
BATCH = 4
# Where a light does not move for so long after its coarse shadows, finer ones follow.
PAUSE_SECONDS = 0.15


class _Points:
    """Every `step`-th pixel of a G-buffer in either direction. The thread of the window reads them, the thread that
    traces makes samples of them."""

    def __init__(self, step: int, gbuffer: GBufferTextures, view: View):
        self._step, self._view, (width, height) = step, view, gbuffer.size
        self._texels, self._samples, self._normal = _texels(gbuffer, step), None, None
        positions, first = self._texels["position"], step // 2
        rows, columns = positions.shape[:2]
        stretch = np.eye(4)
        for axis, (whole, part) in enumerate(((width, columns), (height, rows))):
            stretch[axis, axis] = whole / (part * step)
            stretch[axis, 3] = 2.0 / part * ((0.5 * whole - 0.5 - first) / step + 0.5) - 1.0
        # The grid that these pixels are: positions (H, W, 4) and projection.
        self.grid = positions, stretch @ view.projection

    def follow(self, gbuffer: GBufferTextures) -> None:
        """Read again what depends on the lights."""
        if gbuffer.geometric_normal is not None:
            self._normal = _every(gbuffer.geometric_normal, self._step)

    def samples(self) -> tuple[SurfaceSamples, Film]:
        """The samples, and their film."""
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
    """What the thread is to trace: `lights`, which are those of some numbers, by `keys`, at points of a picture. What
    counts as one light are the sides of a sky."""

    state: tuple
    level: int  # of LEVELS, or the next one: for a group of points
    group: int
    numbers: tuple
    keys: tuple
    lights: tuple[Lights, ...]
    points: _Points
    rays: int
    tracing: _Tracing
    origin: np.ndarray
    layer: int  # 1: of glass

    @property
    def is_own(self) -> bool:
        """Is it for a group of points?"""
        return self.level == len(LEVELS)

    def shares(self, progress: Callable) -> dict[int, np.ndarray]:
        """(H, W, 2), row 0 at the bottom, by the place of a light in `keys`. Where they are stopped those of the first
        lights; Cancelled is raised where there are none, or not all for a group of points."""
        samples, film = self.points.samples()
        tracer, found = self.tracing.around(self.origin), {}
        self.tracing.mate.key = (self.state, self.layer) if self.level == 1 else None
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
                    workers=self.tracing.mate,
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
    """The scene whose shadows are seen, and what traces them."""

    def __init__(self):
        self.scene, self.collect, self.collected, self.before = None, None, None, None
        self.tracing: _Tracing | None = None
        self.collect_seconds = 0.0

    def may_collect(self) -> bool:
        """Are occluders known, or quick to collect, or did nothing move since the last call?"""
        if self.collected == self.scene or self.collect_seconds <= QUICK_SECONDS or self.scene == self.before:
            return True
        self.before = self.scene
        return False

    def collect_now(self) -> None:
        """Collect the occluders unless they are known."""
        if self.collected == self.scene:
            return
        start = time.perf_counter()
        self.close()
        self.tracing, self.collected = _Tracing(self.collect()), self.scene
        self.collect_seconds = time.perf_counter() - start

    def close(self) -> None:
        """End the process that helps to trace."""
        if self.tracing is not None:
            self.tracing.close()


class LiveShadows:
    """Shadows while an artist works: a thread traces them, coarse at first, finer while nothing changes.

    Until new ones are there, the old ones are seen where the same surfaces are. Recoloring a light traces nothing but
    what refines the view at rest. Those of the glass before the surfaces are of another one, `of_glass`, for whom all
    is told and asked here but the shares. One of both traces at a time.
    """

    traces_lobes = False  # all lobes have the shadows of the first

    def __init__(self, behind: LiveShadows | None = None):
        self._behind, self._glass = behind, None
        self._followed = _Followed() if behind is None else behind._followed
        self._version, self._problem = 0, ""
        self._waits = False  # for the thread: the picture for which shares were asked last cannot be drawn yet
        self._own: tuple[int, ShareGrid | None] = (0, None)  # of a group of further points
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._request: _Request | None = None  # that the thread does, or has done last
        self._outcomes: deque[tuple[_Request, dict[int, np.ndarray] | Exception]] = deque()
        self._is_left = False
        # The lights, those of a sky as one, and what was given.
        self._lights, self._keys, self._given = (), (), None
        self._wanted: tuple = ()
        # By whether they are coarse the points of a state.
        self._pixels: dict[bool, tuple[tuple, _Points]] = {}
        # Of the state that was traced last: shares (H, W, 2) by the key of a light and level, and by whether they are
        # coarse the positions and the projection of their points.
        self._state: tuple = ()
        self._known: dict[tuple, dict[int, np.ndarray]] = {}
        self._points: dict[bool, tuple[np.ndarray, np.ndarray]] = {}
        self._latest: dict[int, dict[int, np.ndarray]] = {}  # by the number of a light
        self._layers = np.ones((0, 0, 0, 2), np.float32)  # of the grid
        self._grid: ShareGrid | None = None
        self._blank: ShareGrid | None = None
        self._origin = np.zeros(3)

    @property
    def of_glass(self) -> LiveShadows:
        """Those of the glass before the surfaces."""
        if self._glass is None:
            self._glass = LiveShadows(self)
        return self._glass

    @property
    def _both(self) -> tuple[LiveShadows, ...]:
        return (self,) if self._glass is None else (self, self._glass)

    @property
    def version(self) -> int:
        """Another one where pictures are to be drawn anew."""
        return sum(one._version for one in self._both)

    @property
    def problem(self) -> str:
        """Why there are no shadows, or nothing."""
        return next((one._problem for one in self._both if one._problem), "")

    @property
    def waits(self) -> bool:
        """Can the picture for which shares were asked last not be drawn yet?"""
        return any(one._waits for one in self._both)

    def follow(self, scene: tuple, collect: Callable[[], Occluders]) -> None:
        """To be told before a picture is drawn: `collect()` gives the occluders of `scene`, which compares."""
        if scene != self._followed.scene:
            for one in self._both:
                one._problem = ""
        self._followed.scene, self._followed.collect = scene, collect

    @property
    def is_busy(self) -> bool:
        """Does a thread work, or has it found something that no picture shows yet?"""
        return any(one._thread is not None for one in self._both)

    @property
    def has_news(self) -> bool:
        """Has a thread found something, or ended?"""
        return any(one._thread is not None and (one._outcomes or not one._thread.is_alive()) for one in self._both)

    def stop(self) -> None:
        """Let the thread end soon, and what helps it; let go of the textures at once, and of the glass."""
        for one in self._both:
            one._is_left = True
            one._stop.set()
            one._grid = one._blank = None
            one._own = (0, None)
        self.rest()
        self._glass = None

    def rest(self) -> None:
        """End what helps the thread, unless that works: it is started again where it is worth it."""
        if all(one._thread is None or not one._thread.is_alive() for one in self._both):
            self._followed.close()

    def take_news(self) -> None:
        """Take over what has been found; pictures are to be drawn anew where `version` is another one then."""
        for one in self._both:
            before, has_ended = one._version, one._thread is not None and not one._thread.is_alive()
            if has_ended:
                one._thread = None
            while one._outcomes:
                one._take(*one._outcomes.popleft())
            # What could not begin beside the thread begins with the first picture.
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
        """The shares as far as they are known, as of `ShadowRays.shares`; `number` counts the pictures of a view at
        rest. Before they are there, a grid without a point: with another shader they would come when it is compiled."""
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
        """Does the thread refine shadows of another view, or of a light that has moved?"""
        request = self._request
        return request.level > 0 and (request.state != self._wanted or not set(request.keys) <= set(self._keys))

    @property
    def _is_off(self) -> bool:
        return not self._keys or bool(self._problem) or bool(too_many(len(self._keys), self._wanted[-1]))

    def _next_level(self) -> int | None:
        """The coarsest level that a light does not have for what is wanted; None: all is there."""
        if self._is_off:
            return None
        if self._state != self._wanted:
            return 0
        best = min(max(self._known.get(key, (-1,))) for key in self._keys)
        return None if best == len(LEVELS) - 1 else best + 1

    @property
    def _is_free(self) -> bool:
        """Does no thread work, here or for the other layer?"""
        other = self._behind or self._glass
        return self._thread is None and (other is None or other._thread is None)

    def _may_begin(self, level: int, number: int) -> bool:
        """The points of finer levels must be those of the first picture, and while objects move the window must not
        wait for occluders."""
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
        """For the lights that do not have a level yet."""
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
        """For the lights of some numbers."""
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
            layer=int(self._behind is not None),
        )

    def _start(self, requests: list[_Request]) -> None:
        """Let the thread trace, one request after another."""
        self._stop.clear()
        self._request, self._is_left = requests[0], False
        self._thread = threading.Thread(target=self._trace, args=(requests,), name="LTSH shadows", daemon=True)
        self._thread.start()

    def _trace(self, requests: list[_Request]) -> None:
        for number, request in enumerate(requests):
            if number > 0 and self._stop.wait(PAUSE_SECONDS):
                break
            self._request = request
            try:
                outcome = request.shares(lambda stage, fraction: not self._stop.is_set())
            except Exception as error:
                # With its traceback it is part of a circle, which keeps the samples of the picture.
                outcome = error.with_traceback(None)
            self._outcomes.append((request, outcome))
            if isinstance(outcome, Exception):
                break
        if self._is_left:
            requests[0].tracing.close()

    def _show(self) -> None:
        """Make the grid of what is known; a light of which nothing is known keeps what is known of its place."""
        known = [self._known.get(key) or self._latest.get(number, {}) for number, key in enumerate(self._keys)]
        if not any(known):
            return
        is_coarse = min(max(levels) for levels in known if levels) == 0
        positions, projection = self._points[is_coarse]
        height, width = positions.shape[:2]
        step = coarse_step(self._state[-1]) if is_coarse else 1
        layers = np.ones((len(known), height, width, 2), np.float32)
        for number, levels in enumerate(known):
            if levels:
                values = levels[max(levels)]
                layers[number] = values[step // 2 :: step, step // 2 :: step] if is_coarse and max(levels) else values
            elif self._layers.shape == layers.shape:
                layers[number] = self._layers[number]
        self._layers = layers
        self._grid = ShareGrid(_upload(layers, (width, height)), float_texture(positions), projection)


def coarse_step(size: tuple[int, int]) -> int:
    """Pixels between the points of the coarsest level, of a picture of `size`."""
    return max(2, round((size[0] * size[1] / COARSE_POINTS) ** 0.5))


def _shape_of(light: AreaLight) -> str:
    """What tells where and how `light` shines, but not how brightly."""
    return repr({name: value for name, value in light.record().items() if name not in ("radiance", "detail")})


def _shape_of_sky(sides: Lights) -> str:
    """What tells how a sky shines, but not how brightly."""
    values = np.array([patch.radiance.mean() for side in sides for patch in side.patches])
    seen = sides[0].affects_diffuse, sides[0].affects_specular, sides[0].name
    return repr((seen, np.round(values / max(np.abs(values).mean(), 1e-30), 4).tobytes()))


def _every(texture: gpu.types.GPUTexture, step: int) -> np.ndarray:
    """Every `step`-th texel (H, W, 4) in either direction."""
    return np.ascontiguousarray(read_texture(texture)[step // 2 :: step, step // 2 :: step])


def too_many(lights: int, size: tuple[int, int]) -> str:
    """What to say where the shares of so many lights do not fit; empty where they do."""
    needed = lights * size[0] * size[1] * _SHARE_BYTES
    if needed <= MOST_BYTES:
        return ""
    return f"shadows are not drawn: those of {lights} lights need {needed / 2**30:.1f} GiB of graphics memory"


def _texels(gbuffer: GBufferTextures, step: int = 1) -> dict[str, np.ndarray]:
    """What every `step`-th texel of a G-buffer holds, by name, (H, W, 4)."""
    textures = {name: getattr(gbuffer, name) for name in (*_ALWAYS, *_PERHAPS)}
    return {name: _every(texture, step) for name, texture in textures.items() if texture is not None}


_ALWAYS = ("position", "normal", "base", "f0", "f90", "dielectric")
_PERHAPS = ("diffuse_normal", "smooth_normal", "geometric_normal", "tangent", "rebound")


def gbuffer_samples(gbuffer: GBufferTextures, view: View) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples (P) that a G-buffer holds, around the origin of `view`, and the numbers of their texels from the
    lower left."""
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
    """Unit vectors of the first three columns; a zero vector stays one."""
    vectors = vectors[:, :3]
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def _unit_or_none(vectors: np.ndarray | None) -> np.ndarray | None:
    return None if vectors is None else _unit(vectors)
