"""Radiance of samples by techniques, under lights and occluders, for pictures and bakes.

radiance = closed form x visibility of the light. The visibility is the same for every technique.
"""

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import shading, visibility
from ..cycles.gbuffer import with_one_shadow
from ..emitters.light_tree import FEWEST
from ..files import check_takes_files
from ..imaging.exr import unique_names
from ..scene import (
    CYCLES,
    REFERENCE,
    TECHNIQUES,
    Cancelled,
    Film,
    Light,
    Progress,
    SurfaceSamples,
    listed,
)
from ..workers.pool import WorkerPool, cores, opened

# MOST_PAIRS: how many pairs of a sample and a light have their radiance in memory at a time.
MOST_PAIRS = 1 << 25
# FEWEST_RAYS: a sample gets at least so many of the rays of its pixel, or all of them if they are fewer. The first
# eight only tell whether more are needed.
FEWEST_RAYS = 32
REFERENCE_SEED = 20160725
# LOOKS: shares of the samples by which the seconds of stages are foretold.
LOOKS = 0.003, 0.012
# SHARES_DONE: of the work of one or two passes after each. Diffuse light takes a third to a thirtieth of the other.
SHARES_DONE = {1: ((0, 1), (0.0, 1.0)), 2: ((0, 1, 2), (0.0, 0.8, 1.0))}
# Limits of the reference: MOST_REFERENCE_PAIRS pairs of a sample and a light, some 30 us each, but always
# FEWEST_SAMPLES samples.
MOST_REFERENCE_PAIRS, FEWEST_SAMPLES = 3_000_000, 32


# NOTED_NOISE: relative errors of shadows that a warning tells: as much light may be missing where few rays meet it.
NOTED_NOISE = 0.1
NOISY = "shadows: noise of {} light, of which as much may be missing: few rays meet it, as through a window; {}"


@dataclass(frozen=True)
class Shadows:
    """The share of each light that each sample sees. Lights that share their rays have one row of shares."""

    shares: dict[str, np.ndarray]  # (E, P) by pass, in [0, 1]
    numbers: tuple[tuple[int, ...], ...]  # E tuples: the numbers of the lights of each row
    noise: dict[str, float]  # by pass, estimated relative error of its shadows
    rays: int
    tracer: str  # name of the ray tracer
    seconds: float = 0.0

    def take(self, index: np.ndarray) -> "Shadows":
        """The shadows of the samples at `index` (Q,)."""
        return replace(self, shares={name: values[:, index] for name, values in self.shares.items()})

    def of_lights(self, numbers: Sequence[int]) -> "Shadows":
        """The shadows of the lights with these sorted `numbers`, renumbered from 0.

        Of lights that share their rays, `numbers` must hold all or none.
        """
        index_of = {number: index for index, number in enumerate(numbers)}
        rows = [row for row, (first, *_) in enumerate(self.numbers) if first in index_of]
        renumbered = tuple(tuple(index_of[number] for number in self.numbers[row]) for row in rows)
        return replace(self, shares={name: one[rows] for name, one in self.shares.items()}, numbers=renumbered)

    def warnings(self) -> list[str]:
        """What to say of much noise."""
        noisy = [f"{100.0 * noise:.0f} % of the {name}" for name, noise in self.noise.items() if noise > NOTED_NOISE]
        return [NOISY.format(listed(noisy), "raise --shadow-rays, or --aa")] if noisy else []

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
    """Context that finds the shares of `lights` that samples see past `occluders`, by the processes of its `pool`."""

    def __init__(self, occluders: visibility.Occluders, lights: Sequence[Light]):
        self._occluders, self._lights = occluders, lights

    def __enter__(self):
        from ..blender.process.blender_process import embree_libraries

        self._tracer = visibility.open_tracer(self._occluders, embree_libraries())
        self.pool = WorkerPool(self._tracer)
        return self

    def __exit__(self, *error):
        self.pool.close()
        self._tracer.close()

    def trace(
        self,
        samples: SurfaceSamples,
        sampling: visibility.ShadowSampling,
        *,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Shadows:
        """The shadows of `samples` under all lights; see `visibility.trace_visibility` for the other arguments."""
        start = time.perf_counter()
        estimate = visibility.trace_visibility(
            samples, self._lights, self._tracer, sampling, workers=workers or self.pool, progress=progress
        )
        shares = {name: getattr(estimate, name) for name in sampling.passes}
        noise = {name: estimate.noise(name, sampling.film) for name in sampling.passes}
        seconds, tracer = time.perf_counter() - start, self._tracer.description
        return Shadows(shares, estimate.numbers, noise, estimate.rays, tracer, seconds)


def trace_shadows(
    extraction, passes: Sequence[str], rays: int, progress: Progress | None, workers=None
) -> Shadows | None:
    """The shadows of the samples of an `Extraction`; the samples of a pixel share `rays` per light. None without
    occluders."""
    if extraction.occluders is None:
        return None
    samples, film, index = extraction.samples, extraction.film, slice(None)
    rays = rays_of_samples(rays, film)
    if film.count is not None:
        samples, film, index = with_one_shadow(samples, film)
    sampling = visibility.ShadowSampling(passes, rays, film)
    with ShadowTracer(extraction.occluders, extraction.lights) as tracer:
        return tracer.trace(samples, sampling, workers=workers, progress=progress).take(index)


def tell_expected(extraction, tables: "dict[str, Shader]", passes: Sequence[str], rays: int, progress) -> None:
    """Call `progress.expect`, if there is one, with the seconds of stages to come, measured on LOOKS of the samples."""
    from ..blender.process.pixels import ended_at_horizons

    tell, count, looks = getattr(progress, "expect", None), len(extraction.samples), []
    sizes, names = [int(share * count) for share in LOOKS], [name for name in tables if name != REFERENCE]
    if tell is None or sizes[0] < FEWEST_SAMPLES:
        return
    order = np.random.default_rng(0).permutation(count)
    for size in (sizes[0], *sizes):  # the first look also loads what all need
        chosen, times = np.sort(order[:size]), [time.perf_counter()]
        looked = replace(extraction, samples=extraction.samples.take(chosen), film=extraction.film.take(chosen))
        looked = ended_at_horizons(looked)
        times.append(time.perf_counter())
        shadows = trace_shadows(looked, passes, rays, None, workers=1)
        times.append(time.perf_counter())
        for name in names:
            shade_lights(looked.samples, looked.lights, tables[name], passes, (shadows, None), workers=1)
            times.append(time.perf_counter())
        looks.append(np.diff(times))
    # What every number of samples takes alike is not multiplied.
    _, less, more = looks
    seconds = more + (count - sizes[1]) / (sizes[1] - sizes[0]) * np.maximum(more - less, 0.0)
    seconds[1:] /= cores()
    tell(dict(zip(["horizons", "shadows", *map(title, names)], seconds.tolist(), strict=True)))


def shade_lights(
    samples: SurfaceSamples,
    lights: Sequence[Light],
    table: str | shading.LookupTable | shading.OwnTechnique,
    passes: Sequence[str],
    shadowing: Sequence[Shadows | None] = (None,),
    *,
    rows: Sequence[int] | None = None,
    workers: int | WorkerPool | None = None,
    progress: Callable[[float], bool | None] | None = None,
) -> list[shading.Shading]:
    """Radiance of `samples` (P) under `lights` (L): one Shading for each entry of `shadowing`.

    An entry is the shadows of the samples, or None for no shadows. All shadows must join the same lights, and only
    lights of one row. `rows` (L,) are as for `shade`; by default each of the `light_groups` has a row.

    Lights that share their rays are shaded together and then multiplied by their share, so that a sample that sees
    them whole gets the same bits as without shadows. Exception: many lights without any shadows go to `shade` at once,
    which then merges those that a sample cannot tell apart.
    """
    if rows is None:
        groups = light_groups(lights)
        rows = [groups.index(light.group) for light in lights]
    options = {"passes": tuple(passes), "workers": workers}
    if lights and all(shadows is None for shadows in shadowing):
        if max(Counter(rows).values()) >= FEWEST:
            shaded = shading.shade(samples, lights, table, rows=rows, progress=progress, **options)
            return [shaded] * len(shadowing)
    shape = 1 + max(rows, default=0), len(samples), 3
    sums = [{name: np.zeros(shape, np.float32) for name in passes} for _ in shadowing]
    joined = next((shadows.numbers for shadows in shadowing if shadows is not None), None)
    if joined is None:
        # Lights of several rows cannot be shaded together.
        alike = visibility.shared_numbers(lights)
        alike = [[one] if len({rows[n] for n in one}) == 1 else [(n,) for n in one] for one in alike]
        joined = sorted(itertools.chain.from_iterable(alike))
    error, most = None, max(1, MOST_PAIRS // max(1, len(samples)))
    for first in range(0, len(joined), most):
        block = joined[first : first + most]
        start, share = first / len(joined), len(block) / len(joined)

        def report(fraction, start=start, share=share):
            return None if progress is None else progress(start + fraction * share)

        of_block = [lights[number] for numbers in block for number in numbers]
        row_of = [row for row, numbers in enumerate(block) for _ in numbers]
        shaded = shading.shade(samples, of_block, table, rows=row_of, progress=report, **options)
        if shaded.quadrature_error is not None:
            error = shaded.quadrature_error if error is None else error + shaded.quadrature_error
        for number, lights_of_row in enumerate(block):
            row = rows[lights_of_row[0]]
            for name in passes:
                radiance = getattr(shaded, name)[number]
                for total, shadows in zip(sums, shadowing, strict=True):
                    if shadows is None:
                        total[name][row] += radiance
                    else:
                        total[name][row] += shadows.shares[name][first + number][:, None] * radiance
    return [shading.Shading(total.get("specular"), total.get("diffuse"), error) for total in sums]


def light_groups(lights: Iterable[Light]) -> tuple[str, ...]:
    """The names of the light groups of `lights` in the order of their first lights, "" for none; at least one name."""
    return tuple(dict.fromkeys(light.group for light in lights)) or ("",)


# A shader is the name of the reference, a table, or a technique that a script has given.
Shader = str | shading.LookupTable | shading.OwnTechnique


def prepare(options) -> dict[str, Shader]:
    """The shaders by the names of their techniques in results. Also checks that the output folder takes files.

    Call it before anything that takes long. Raises TableError, OSError.
    """
    tables = load_tables(options.techniques)
    try:
        check_takes_files(Path(options.output))
    except OSError as error:
        problem = f"cannot be written ({error.strerror}); choose another folder"
        raise OSError(f"output folder {options.output}: {problem}") from error
    return tables


def load_tables(techniques: Sequence[str | shading.OwnTechnique]) -> dict[str, Shader]:
    """The shaders by the names of their techniques in results. Raises TableError."""
    return {name: _table(given) for name, given in technique_names(techniques).items()}


def _table(given) -> Shader:
    if shading.is_own(given) or given == REFERENCE:
        return given
    return shading.load_table(given)


def technique_names(techniques: Sequence[str | shading.OwnTechnique]) -> dict[str, str | shading.OwnTechnique]:
    """The given techniques by their names in results; the name of a user's table is the stem of its path."""
    names = {}
    for given in techniques:
        is_own = shading.is_own(given)
        name = str(getattr(given, "name", type(given).__name__)) if is_own else Path(given).stem
        if is_own or given not in TECHNIQUES:
            name = unique_names([*dict.fromkeys((*TECHNIQUES, CYCLES, *names)), name])[-1]
        names[name] = given
    return names


def check_named(techniques: Sequence, what: str) -> None:
    """Raise ValueError where a technique is a user's own, which `what` could not call later."""
    if unnamed := [described(given) for given in techniques if shading.is_own(given)]:
        raise ValueError(
            f"technique {unnamed[0]}: {what} cannot call it later, expected {', '.join(TECHNIQUES)} or the path of a "
            "table (.npz); leave it out"
        )


def described(given) -> str:
    """How report.json names a technique: its name, the path of its table, or the class of a user's own."""
    return f"{type(given).__module__}.{type(given).__qualname__}" if shading.is_own(given) else str(given)


def title(name: str) -> str:
    """The title of a technique on sheets and in progress; for a user's table its name."""
    return TECHNIQUES[name].title if name in TECHNIQUES else name


@dataclass(frozen=True)
class TechniqueResult:
    """Radiance of one technique on all samples, or on a subset (Q,) of them."""

    shading: shading.Shading  # radiance (G, Q, 3) per pass, a row a light group
    seconds: dict[str, float]  # per pass
    subset: np.ndarray | None  # (Q,) sorted indices of the samples that were evaluated, None for all
    unshadowed: shading.Shading | None = None  # the same without shadows, where `shading` has shadows


def evaluated(tables, extraction, shadows, options, progress, workers=None) -> dict[str, TechniqueResult]:
    """The results of all techniques in `tables` (see `prepare`), by name; `workers` are as for `shade`."""
    given = extraction, shadows, options, progress
    with opened(workers) as pool:
        return {name: _evaluate(name, table, *given, pool) for name, table in tables.items()}


def _evaluate(name, table, extraction, shadows, options, progress, pool) -> TechniqueResult:
    """Shade all samples; the reference shades those of randomly chosen pixels where there are too many."""
    samples, subset = extraction.samples, None
    limit = min(options.reference_samples, max(FEWEST_SAMPLES, MOST_REFERENCE_PAIRS // max(len(extraction.lights), 1)))
    if name == REFERENCE and len(samples) > limit:
        subset = _samples_of_random_pixels(extraction.film, limit)
        samples = samples.take(subset)
    wanted = (None,) if shadows is None else (shadows if subset is None else shadows.take(subset), None)
    lit, seconds = [{} for _ in wanted], {}
    for index, pass_name in enumerate(options.passes):

        def report(fraction, done=index):
            whole = float(np.interp(done + fraction, *SHARES_DONE[len(options.passes)]))
            return None if progress is None else progress(title(name), whole)

        if report(0.0) is False:
            raise Cancelled(f"stopped before {name} shaded the {pass_name} pass")
        start = time.perf_counter()
        given = samples, extraction.lights, table, (pass_name,), wanted
        shadings = shade_lights(*given, workers=pool, progress=report)
        for of_pass, shaded in zip(lit, shadings, strict=True):
            of_pass[pass_name] = shaded
        seconds[pass_name] = time.perf_counter() - start
    shaded, *unshadowed = map(_joined, lit)
    return TechniqueResult(shaded, seconds, subset, *unshadowed)


def _joined(shaded: dict[str, shading.Shading]) -> shading.Shading:
    """Several Shadings of one pass each as one Shading."""
    passes = {name: getattr(one, name) for name, one in shaded.items()}
    error = shaded["specular"].quadrature_error if "specular" in shaded else None
    return shading.Shading(passes.get("specular"), passes.get("diffuse"), error)


def _samples_of_random_pixels(film: Film, limit: int) -> np.ndarray:
    """Sorted indices of at most `limit` samples: all samples of pixels that a seeded generator chooses."""
    generator = np.random.default_rng(REFERENCE_SEED)
    order = generator.permutation(film.width * film.height)
    count = np.bincount(film.pixel, minlength=len(order))[order]
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order[np.cumsum(count) <= limit]] = True
    return np.nonzero(chosen[film.pixel])[0]
