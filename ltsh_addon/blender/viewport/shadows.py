"""Shadows of a view: the share of each light that its pixels see, by the rays and the occluders of pictures."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gpu
import numpy as np

from ...scene import PASSES, AreaLight, Cancelled, Film, SurfaceSamples, error_line
from ...visibility import Occluders, Tracer, open_tracer, visible_shares
from ..process.blender_process import embree_libraries
from .surfaces import View
from .textures import GBufferTextures, ShareGrid, float_texture, read_texture

Lights = Sequence[AreaLight]
# Of the shares of all lights, in half precision, on the card.
MOST_BYTES = 1 << 30
_SHARE_BYTES = 4


class _Tracing:
    """A tracer of occluders around an origin, which changes rarely: single precision is best near it."""

    def __init__(self, occluders: Occluders):
        self._occluders = occluders
        self._tracer: Tracer | None = None
        self._origin = np.zeros(3)

    def around(self, origin: np.ndarray) -> Tracer:
        """The tracer around `origin` (3,). Raises SceneError where Embree is not there."""
        if self._tracer is None or not np.array_equal(origin, self._origin):
            matrices = np.array(self._occluders.matrices, np.float64)
            matrices[:, :, 3] -= origin
            self._tracer = open_tracer(replace(self._occluders, matrices=matrices), embree_libraries())
            self._origin = np.array(origin)
        return self._tracer


class ShadowRays:
    """Traces the shares of lights that the pixels of G-buffers see past `occluders`, with at most `rays` for each."""

    version, waits, traces_lobes = 0, False, True

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
        found = visible_shares(samples, (*lights, *sides), tracer, rays=self._rays, film=film)
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


# What is traced one after another while nothing changes: pixels between points in either direction (None: so many that
# there are `COARSE_POINTS`), and rays of a light and a point.
LEVELS = ((None, 8), (1, 32))
COARSE_POINTS = 8000
# Edges become smooth at once by the first points of pixels. The others wait for rays of their own, so many points
# together: new rays from new places.
FIRST_POINTS, GROUP, GROUP_RAYS = 8, 4, 64
# Occluders that take longer to collect are collected when no object moves any more.
QUICK_SECONDS = 0.03


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
    samples: SurfaceSamples
    film: Film
    rays: int
    tracing: _Tracing
    origin: np.ndarray

    def shares(self, progress: Callable) -> np.ndarray:
        """(L, H, W, 2), row 0 at the bottom."""
        first = np.cumsum([0, *map(len, self.lights)])[:-1]
        found = visible_shares(
            self.samples,
            [light for lights in self.lights for light in lights],
            self.tracing.around(self.origin),
            rays=self.rays,
            film=self.film,
            workers=1,
            progress=progress,
        )
        values = np.ones((len(self.lights), self.film.height * self.film.width, len(PASSES)), np.float32)
        for index, name in enumerate(PASSES):
            values[:, self.film.pixel, index] = found.of_lights(name)[first]
        return values.reshape(len(self.lights), self.film.height, self.film.width, len(PASSES))


class LiveShadows:
    """Shadows while an artist works: a thread traces them, coarse at first, finer while nothing changes.

    Until new ones are there, the old ones are seen where the same surfaces are. Recoloring a light traces nothing but
    what refines the view at rest.
    """

    traces_lobes = False  # all lobes have the shadows of the first

    def __init__(self):
        self.version, self.problem = 0, ""
        self.waits = False  # for the thread: the picture for which shares were asked last cannot be drawn yet
        self._own: tuple[int, ShareGrid | None] = (0, None)  # of a group of further points
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._request: _Request | None = None
        self._outcome: np.ndarray | Exception | None = None
        self._scene, self._collect, self._collected, self._scene_before = None, None, None, None
        self._tracing: _Tracing | None = None
        self._collect_seconds = 0.0
        # The lights, those of a sky as one, and what was given.
        self._lights, self._keys, self._given = (), (), None
        self._wanted: tuple = ()
        # Of the state that was traced last: shares (H, W, 2) by the key of a light and level, and by whether they are
        # coarse the positions and the projection of their points.
        self._state: tuple = ()
        self._known: dict[tuple, dict[int, np.ndarray]] = {}
        self._points: dict[bool, tuple[np.ndarray, np.ndarray]] = {}
        self._latest: dict[int, dict[int, np.ndarray]] = {}  # by the number of a light
        self._layers = np.ones((0, 0, 0, 2), np.float32)  # of the grid
        self._grid: ShareGrid | None = None
        self._origin = np.zeros(3)

    def follow(self, scene: tuple, collect: Callable[[], Occluders]) -> None:
        """To be told before a picture is drawn: `collect()` gives the occluders of `scene`, which compares."""
        if scene != self._scene:
            self.problem = ""
        self._scene, self._collect = scene, collect

    @property
    def is_busy(self) -> bool:
        """Does the thread work, or has it found something that no picture shows yet?"""
        return self._thread is not None

    @property
    def has_news(self) -> bool:
        """Has the thread ended?"""
        return self._thread is not None and not self._thread.is_alive()

    def stop(self) -> None:
        """Let the thread end soon."""
        self._stop.set()

    def take_news(self) -> None:
        """Take over what the thread has found; pictures are to be drawn anew where `version` is another one then."""
        if not self.has_news:
            return
        request, outcome, self._thread = self._request, self._outcome, None
        is_own = request.level == len(LEVELS)
        if is_own and not isinstance(outcome, Exception):
            if (request.state, request.keys) == (self._wanted, self._keys):
                height, width = outcome.shape[1:3]
                positions, projection = self._new_points
                grid = ShareGrid(_upload(outcome, (width, height)), float_texture(positions), projection)
                self._own = request.group, grid
            return
        self.version += not (is_own and isinstance(outcome, Cancelled))
        if isinstance(outcome, Exception):
            self.problem = "" if isinstance(outcome, Cancelled) else f"shadows: {error_line(outcome)}"
            return
        if request.state != self._state:
            self._state, self._known, self._points, self._latest = request.state, {}, {}, {}
        self._points[request.level == 0] = self._new_points
        self._known = {key: levels for key, levels in self._known.items() if key in self._keys}
        for number, key, values in zip(request.numbers, request.keys, outcome, strict=True):
            self._known.setdefault(key, {})[request.level] = values
            self._latest[number] = {request.level: values}
        self._origin = request.origin
        self._show()

    def shares(
        self, gbuffer: GBufferTextures, view: View, lights: Lights, sides: Lights = (), number: int = 0
    ) -> ShareGrid | None:
        """The shares as far as they are known, as of `ShadowRays.shares`; `number` counts the pictures of a view at
        rest."""
        if self._given is None or lights is not self._given[0] or sides is not self._given[1]:
            self._given = lights, sides
            self._lights = (*((light,) for light in lights), *((sides,) if sides else ()))
            self._keys = (*map(_shape_of, lights), *((_shape_of_sky(sides),) if sides else ()))
            if self._grid is not None and len(self._keys) != len(self._layers):
                self._latest = {}
                self._show()
        if number == 0:
            self._wanted = (self._scene, view.projection.tobytes(), view.origin.tobytes(), gbuffer.size)
            self._own = (0, None)
        self.waits = False
        level = self._next_level()
        if self._thread is None and level is not None and self._may_begin(level, number):
            try:
                self._begin(level, gbuffer, view)
            except Exception as error:
                self.problem = f"shadows: {error_line(error)}"
        elif self._thread is not None and self._request.level > 0 and self._request.state != self._wanted:
            self._stop.set()
        if number > 0 and not self._is_off:
            if number // GROUP == self._own[0] and self._own[1] is not None:
                return self._own[1]
            if self._thread is None and level is None and number >= FIRST_POINTS:
                self._begin_own(number // GROUP, gbuffer, view)
            self.waits = self._thread is not None
        fits = len(self._layers) == len(self._keys) and np.array_equal(self._origin, view.origin)
        return self._grid if fits else None

    @property
    def _is_off(self) -> bool:
        return not self._keys or bool(self.problem) or bool(too_many(len(self._keys), self._wanted[-1]))

    def _next_level(self) -> int | None:
        """The coarsest level that a light does not have for what is wanted; None: all is there."""
        if self._is_off:
            return None
        if self._state != self._wanted:
            return 0
        best = min(max(self._known.get(key, (-1,))) for key in self._keys)
        return None if best == len(LEVELS) - 1 else best + 1

    def _may_begin(self, level: int, number: int) -> bool:
        """The points of finer levels must be those of the first picture, and while objects move the window must not
        wait for occluders."""
        is_slow = self._collected != self._scene and self._collect_seconds > QUICK_SECONDS
        if is_slow and self._scene != self._scene_before:
            self._scene_before = self._scene
            return False
        return number == 0 or level == 0

    def _begin(self, level: int, gbuffer: GBufferTextures, view: View) -> None:
        if self._collected != self._scene:
            start = time.perf_counter()
            self._tracing, self._collected = _Tracing(self._collect()), self._scene
            self._collect_seconds = time.perf_counter() - start
        known = self._known if self._wanted == self._state else {}
        numbers = tuple(n for n, key in enumerate(self._keys) if max(known.get(key, (-1,))) < level)
        step, rays = LEVELS[level]
        self._start(level, numbers, (step or coarse_step(gbuffer.size), rays), gbuffer, view)

    def _begin_own(self, group: int, gbuffer: GBufferTextures, view: View) -> None:
        self._start(len(LEVELS), tuple(range(len(self._keys))), (1, GROUP_RAYS), gbuffer, view, group)

    def _start(self, level: int, numbers: tuple, effort: tuple[int, int], gbuffer, view: View, group: int = 0) -> None:
        """Let the thread trace lights with an effort: every so many pixels, so many rays."""
        step, rays = effort
        samples, film, self._new_points = _every(step, gbuffer, view)
        self._request = _Request(
            state=self._wanted,
            level=level,
            group=group,
            numbers=numbers,
            keys=tuple(self._keys[n] for n in numbers),
            lights=tuple(self._lights[n] for n in numbers),
            samples=samples,
            film=film,
            rays=rays,
            tracing=self._tracing,
            origin=view.origin.copy(),
        )
        self._stop.clear()
        self._thread = threading.Thread(target=self._trace, args=(self._request,), name="LTSH shadows", daemon=True)
        self._thread.start()

    def _trace(self, request: _Request) -> None:
        try:
            self._outcome = request.shares(lambda stage, fraction: not self._stop.is_set())
        except Exception as error:
            self._outcome = error

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


def _every(step: int, gbuffer: GBufferTextures, view: View):
    """Samples of every `step`-th pixel in either direction, their film, and the grid that these pixels are: positions
    (H, W, 4) and projection."""
    samples, texel = gbuffer_samples(gbuffer, view, step)
    width, height = gbuffer.size
    first = step // 2
    columns, rows = len(range(first, width, step)), len(range(first, height, step))
    positions = read_texture(gbuffer.position)[first::step, first::step]
    stretch = np.eye(4)
    for axis, (whole, part) in enumerate(((width, columns), (height, rows))):
        stretch[axis, axis] = whole / (part * step)
        stretch[axis, 3] = 2.0 / part * ((0.5 * whole - 0.5 - first) / step + 0.5) - 1.0
    return samples, Film(columns, rows, texel), (positions, stretch @ view.projection)


def too_many(lights: int, size: tuple[int, int]) -> str:
    """What to say where the shares of so many lights do not fit; empty where they do."""
    needed = lights * size[0] * size[1] * _SHARE_BYTES
    if needed <= MOST_BYTES:
        return ""
    return f"shadows are not drawn: those of {lights} lights need {needed / 2**30:.1f} GiB of graphics memory"


def gbuffer_samples(gbuffer: GBufferTextures, view: View, step: int = 1) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples (P) that every `step`-th texel of a G-buffer holds, around the origin of `view`, and their numbers
    among all of those texels, from the lower left."""

    def texels(texture: gpu.types.GPUTexture) -> np.ndarray:
        return read_texture(texture)[step // 2 :: step, step // 2 :: step].reshape(-1, 4).astype(np.float64)

    position = texels(gbuffer.position)
    pixel = np.flatnonzero(position[:, 3] > 0.0)
    position = position[pixel]
    normal, base, f0, f90, dielectric = (
        texels(texture)[pixel]
        for texture in (gbuffer.normal, gbuffer.base, gbuffer.f0, gbuffer.f90, gbuffer.dielectric)
    )
    further = {
        name: None if getattr(gbuffer, name) is None else texels(getattr(gbuffer, name))[pixel]
        for name in ("diffuse_normal", "smooth_normal", "geometric_normal", "tangent", "rebound")
    }
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
        sheen_a=np.where(fuzzy, -base[:, 3], 0.0),
        sheen_b=np.where(fuzzy, normal[:, 3], 0.0),
        diffuse_albedo=base[:, :3],
        diffuse_roughness=None if rebound is None else rebound[:, 3],
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
