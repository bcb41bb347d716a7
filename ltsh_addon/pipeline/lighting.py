"""Radiance of samples under lights and occluders, for pictures and bakes.

radiance = closed form x visibility of the light. The visibility is the same for every technique.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .. import shading, visibility
from ..cycles.gbuffer import finer
from ..emitters.light_tree import FEWEST
from ..scene import AreaLight, Film, Progress, SurfaceSamples

# MOST_PAIRS: how many pairs of a sample and a light have their radiance in memory at a time.
MOST_PAIRS = 1 << 25
# FEWEST_RAYS: a sample gets at least so many of the rays of its pixel, or all of them if they are fewer. The first
# eight only tell whether more are needed.
FEWEST_RAYS = 32


@dataclass(frozen=True)
class Shadows:
    """The share of each light that each sample sees. Lights that share their rays have one row of shares."""

    shares: dict[str, np.ndarray]  # (E, P) by pass, in [0, 1]
    numbers: tuple[tuple[int, ...], ...]  # E tuples: the numbers of the lights of each row
    noise: dict[str, float]  # by pass, estimated relative error of its shadows
    rays: int
    tracer: str  # name of the ray tracer
    seconds: float = 0.0
    # By pass, estimates (H, W) of the radiance on the film and of its variance; empty without a film.
    light: dict[str, np.ndarray] = field(default_factory=dict)
    variance: dict[str, np.ndarray] = field(default_factory=dict)

    def take(self, index: np.ndarray) -> Shadows:
        """The shadows of the samples at `index` (Q,)."""
        return replace(self, shares={name: values[:, index] for name, values in self.shares.items()})

    def with_more(self, mask: np.ndarray, more: Shadows) -> Shadows:
        """The shadows of the samples in `mask` (P,), then those of `more`; `light` and `variance` stay."""
        shares = {name: np.concatenate([one[:, mask], more.shares[name]], 1) for name, one in self.shares.items()}
        return replace(self, shares=shares, rays=self.rays + more.rays, seconds=self.seconds + more.seconds)

    def of_lights(self, numbers: Sequence[int]) -> Shadows:
        """The shadows of the lights with these sorted `numbers`, renumbered from 0.

        Of lights that share their rays, `numbers` must hold all or none.
        """
        index_of = {number: index for index, number in enumerate(numbers)}
        rows = [row for row, (first, *_) in enumerate(self.numbers) if first in index_of]
        renumbered = tuple(tuple(index_of[number] for number in self.numbers[row]) for row in rows)
        return replace(self, shares={name: one[rows] for name, one in self.shares.items()}, numbers=renumbered)

    def report(self) -> dict:
        """The entry of report.json."""
        return {"rays": self.rays, "noise": self.noise, "tracer": self.tracer}


def rays_of_point(rays: int, points: int) -> int:
    """Rays of one point, where the `points` of a pixel or texel share `rays`."""
    return max(min(FEWEST_RAYS, rays), rays // points)


def rays_of_samples(rays: int, film: Film) -> int:
    """The most rays that one sample may take, where the samples of a pixel share `rays`.

    On a film with counts that is all of `rays`: the tracer scales them by the count of each sample.
    """
    return rays if film.count is not None else rays_of_point(rays, film.sub_samples)


class ShadowTracer:
    """Context that finds the shares of `lights` that samples see past `occluders`.

    Positions of the occluders are relative to `origin` (3,) in m; lights and samples are in world space.
    """

    def __init__(self, occluders: visibility.Occluders, lights: Sequence[AreaLight], origin: np.ndarray):
        self._occluders, self._origin = occluders, origin
        self._lights = [light.moved(-origin) for light in lights]

    def __enter__(self):
        from ..blender.process.blender_process import embree_libraries

        self._tracer = visibility.open_tracer(self._occluders, embree_libraries())
        return self

    def __exit__(self, *error):
        self._tracer.close()

    def finer(self, samples: SurfaceSamples, film: Film, points, pixels: np.ndarray):
        """`gbuffer.finer` with this tracer's rays, for samples in world space."""
        samples = replace(samples, position=samples.position - self._origin)
        samples, film, replaced = finer(samples, film, points, pixels, self._tracer.first_met)
        return replace(samples, position=samples.position + self._origin), film, replaced

    def trace(
        self,
        samples: SurfaceSamples,
        sampling: visibility.ShadowSampling,
        *,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Shadows:
        """The shadows of `samples` under all lights; see `visibility.visible_shares` for the other arguments."""
        start = time.perf_counter()
        samples = replace(samples, position=samples.position - self._origin)
        estimate = visibility.visible_shares(
            samples, self._lights, self._tracer, sampling, workers=workers, progress=progress
        )
        passes, film = sampling.passes, sampling.film
        shares = {name: getattr(estimate, name) for name in passes}
        noise = {name: estimate.noise(name, film) for name in passes}
        seconds, tracer = time.perf_counter() - start, self._tracer.description
        light, variance = {}, {}
        if film is not None:
            light = {name: film.image(estimate.radiance[name]) for name in passes}
            variance = {name: film.variance(np.square(estimate.deviation[name])) for name in passes}
        return Shadows(shares, estimate.numbers, noise, estimate.rays, tracer, seconds, light, variance)


def trace_shadows(extraction, passes: Sequence[str], rays: int, progress: Progress | None) -> Shadows:
    """The shadows of the samples of an `Extraction`; the samples of a pixel share `rays` per light."""
    film = extraction.film
    sampling = visibility.ShadowSampling(passes, rays_of_samples(rays, film), film)
    with ShadowTracer(extraction.occluders, extraction.lights, extraction.origin) as tracer:
        return tracer.trace(extraction.samples, sampling, progress=progress)


def shade_lights(
    samples: SurfaceSamples,
    lights: Sequence[AreaLight],
    table: str | shading.LookupTable | shading.OwnTechnique,
    passes: Sequence[str],
    shadowing: Sequence[Shadows | None] = (None,),
    *,
    workers: int | None = None,
    progress: Callable[[float], bool | None] | None = None,
) -> list[shading.Shading]:
    """Radiance of `samples` (P) under `lights` (L): one Shading for each entry of `shadowing`.

    An entry is the shadows of the samples, or None for no shadows. All shadows must group the lights alike.

    Lights that share their rays are shaded together and then multiplied by their share, so that a sample that sees
    them whole gets the same bits as without shadows. Exception: many lights without any shadows go to `shade` at once,
    which then merges those that a sample cannot tell apart.
    """
    if lights and all(shadows is None for shadows in shadowing):
        if max(Counter(light.group for light in lights).values()) >= FEWEST:
            shaded = shading.shade(samples, lights, table, passes=tuple(passes), workers=workers, progress=progress)
            return [shaded] * len(shadowing)
    groups = tuple(dict.fromkeys(light.group for light in lights)) or ("",)
    shape = len(groups), len(samples), 3
    sums = [{name: np.zeros(shape, np.float32) for name in passes} for _ in shadowing]
    numbers = next((shadows.numbers for shadows in shadowing if shadows is not None), None)
    numbers = visibility.shared_numbers(lights) if numbers is None else numbers
    error, most = None, max(1, MOST_PAIRS // max(1, len(samples)))
    for first in range(0, len(numbers), most):
        rows = numbers[first : first + most]
        start, share = first / len(numbers), len(rows) / len(numbers)

        def report(fraction, start=start, share=share):
            return None if progress is None else progress(start + fraction * share)

        by_row = [lights[light].altered(group=str(row)) for row, one in enumerate(rows) for light in one]
        shaded = shading.shade(samples, by_row, table, passes=tuple(passes), workers=workers, progress=report)
        if shaded.quadrature_error is not None:
            error = shaded.quadrature_error if error is None else error + shaded.quadrature_error
        for row, one in enumerate(rows):
            group = groups.index(lights[one[0]].group)
            for name in passes:
                radiance = getattr(shaded, name)[row]
                for total, shadows in zip(sums, shadowing, strict=True):
                    if shadows is None:
                        total[name][group] += radiance
                    else:
                        total[name][group] += shadows.shares[name][first + row][:, None] * radiance
    return [shading.Shading(groups, total.get("specular"), total.get("diffuse"), error) for total in sums]
