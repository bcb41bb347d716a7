"""From samples, lights and occluders to radiance: what pictures and bakes have in common.

radiance = closed form x the share of the light that the sample sees. The shares are the same for every technique.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import shading, visibility
from ..scene import AreaLight, Cancelled, Progress, SurfaceSamples

# Pairs of a sample and a light whose radiance is kept at a time.
MOST_PAIRS = 1 << 25
# Of one sample, however many a pixel has.
FEWEST_RAYS = 8


@dataclass(frozen=True)
class Shadows:
    """The shares of the lights that samples see, and how they were found."""

    shares: dict[str, np.ndarray]  # (L, P) by pass, in [0, 1]
    noise: dict[str, float]  # estimated, relative to the pass
    rays: int
    tracer: str  # what traced them
    seconds: float = 0.0

    def shares_of(self, index: np.ndarray | None) -> dict[str, np.ndarray]:
        """Those (L, Q) of the samples at `index` (Q,); None: of all."""
        return self.shares if index is None else {name: values[:, index] for name, values in self.shares.items()}

    def report(self) -> dict:
        """For report.json."""
        return {"rays": self.rays, "noise": self.noise, "tracer": self.tracer}


class ShadowTracer:
    """Finds which shares of `lights` samples see past `occluders`, both around `origin` (3,) in m."""

    def __init__(self, occluders: visibility.Occluders, lights: Sequence[AreaLight], origin: np.ndarray):
        self._origin, self._lights = origin, [light.moved(-origin) for light in lights]
        self._tracer = visibility.open_tracer(occluders)

    def __enter__(self):
        self._tracer.__enter__()
        return self

    def __exit__(self, *error):
        return self._tracer.__exit__(*error)

    def trace(self, samples: SurfaceSamples, passes: Sequence[str], rays: int, points: int, progress=None) -> Shadows:
        """The shares of all lights that `samples` see; `rays` are shared by the `points` of a pixel or texel."""
        start = time.perf_counter()
        samples = replace(samples, position=samples.position - self._origin)
        rays = max(FEWEST_RAYS, rays // points)
        found = visibility.visible_shares(
            samples, self._lights, self._tracer, passes=passes, rays=rays, progress=progress
        )
        shares = {name: getattr(found, name) for name in passes}
        return Shadows(shares, found.noise, found.rays, self._tracer.description, time.perf_counter() - start)


def trace_shadows(extraction, passes: Sequence[str], rays: int, progress: Progress | None) -> Shadows:
    """The shares of the lights of an `Extraction` that its samples see."""

    def report(fraction):
        if progress is not None and progress("shadows", fraction) is False:
            raise Cancelled("stopped while shadows were traced")

    with ShadowTracer(extraction.occluders, extraction.lights, extraction.origin) as tracer:
        points = extraction.film.sub_samples
        return tracer.trace(extraction.samples, passes, rays, points, report)


@dataclass(frozen=True)
class Lit:
    """Radiance of one technique with shadows, and without where there are any."""

    shading: shading.Shading
    unshadowed: shading.Shading | None = None


def shade_lights(
    samples: SurfaceSamples,
    lights: Sequence[AreaLight],
    table: str | shading.LookupTable,
    passes: Sequence[str],
    shares: dict[str, np.ndarray] | None = None,
    *,
    workers: int | None = None,
    progress: Callable[[float], bool | None] | None = None,
) -> Lit:
    """Radiance of `samples` (P) under `lights` (L), of which they see `shares` (L, P) by pass; None: everything.

    Light by light, so that a sample that sees all of its lights gets the same bits as without shadows.
    """
    groups = tuple(dict.fromkeys(light.group for light in lights)) or ("",)
    shape = len(groups), len(samples), 3
    plain = {name: np.zeros(shape, np.float32) for name in passes}
    seen = {name: np.zeros(shape, np.float32) for name in passes} if shares is not None else {}
    error, most = None, max(1, MOST_PAIRS // max(1, len(samples)))
    for first in range(0, len(lights), most):
        part = lights[first : first + most]

        def report(fraction, done=first, count=len(part)):
            return None if progress is None else progress((done + fraction * count) / len(lights))

        own = tuple(_in_group(light, str(number)) for number, light in enumerate(part))
        found = shading.shade(samples, own, table, passes=tuple(passes), workers=workers, progress=report)
        if found.quadrature_error is not None:
            error = found.quadrature_error if error is None else error + found.quadrature_error
        for number, light in enumerate(part):
            group = groups.index(light.group)
            for name in passes:
                radiance = getattr(found, name)[number]
                plain[name][group] += radiance
                if shares is not None:
                    seen[name][group] += shares[name][first + number][:, None] * radiance
    unshadowed = _shading(groups, plain, error)
    return Lit(unshadowed) if shares is None else Lit(_shading(groups, seen, error), unshadowed)


def _in_group(light: AreaLight, group: str) -> AreaLight:
    return replace(light, group=group, detail=tuple(_in_group(part, group) for part in light.detail))


def _shading(groups, radiance, error) -> shading.Shading:
    return shading.Shading(groups, radiance.get("specular"), radiance.get("diffuse"), error)
