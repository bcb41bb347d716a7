"""Finished pictures: our direct light, and everything else by Cycles, denoised.

    combined = ours + rest,  rest = denoised(Combined of Cycles - its direct light where ours takes its place)

Ours is a specular and a diffuse picture. It takes the place of Cycles' direct light pixel by pixel. Where LTSH does not
shade as Cycles does, ours is black and Cycles keeps its own: nothing is there twice, and nothing is lost.

The Combined pass of each light group of the view layer is treated in the same way. Cycles writes no direct light of a
group, so its direct light of all lights is shared out as ours is. What a group bounces can then change with its lights.

With depth of field ours is noisy too, since it has few points of the lens. Then the sum is denoised as a whole.

What shines in sight, lamps and the world, has no noise, only jagged edges, which a denoiser makes worse. It stays out
of the denoiser. Cycles renders it once more by itself, with many samples at its edges.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging
from ..cycles.gbuffer import with_one_shadow
from ..cycles.lobes import read_layer
from ..files import save_array, temporary_folder, write_bytes
from ..imaging.denoise import NoDenoiser, open_denoiser
from ..imaging.exr import write_channels
from ..scene import PASSES, Cancelled, Progress, listed
from ..visibility import ShadowSampling
from ..workers.pool import cores
from . import lighting, picture
from .options import EDGE_POINTS, SHADOW_RAYS, PictureOptions, RenderOptions, child_job

# DIRECT: for each pass of ours, the keys of Cycles' light and color in `pass_names`.
DIRECT = {"specular": ("specular_light", "specular_color"), "diffuse": ("diffuse_light", "diffuse_color")}
ALBEDO, NORMAL = ("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ")
# OF_GROUP: how the name of a light group's pass begins.
OF_GROUP = "Combined_"
REST = "rest"
# Points of a pixel. SUB_SAMPLES: without a budget. With one, FIRST_SUB_SAMPLES: of the first look at the scene, and
# MOST_SUB_SAMPLES: at most.
SUB_SAMPLES, FIRST_SUB_SAMPLES, MOST_SUB_SAMPLES = 9, 3, 17
# Processor seconds of denoising. START_SECONDS: always. LAST_SECONDS: for a picture of a million pixels. MORE_SECONDS:
# for each further picture of that size.
START_SECONDS, LAST_SECONDS, MORE_SECONDS = 0.25, 12.0, 4.0
# SHADOWS_SHARE: the share of a budget that goes to the rays of soft shadows. RAY_SECONDS: processor time of a ray.
# SOFT_SHARE: the share of the pairs of a pixel and a light that lie in soft shadows.
SHADOWS_SHARE, RAY_SECONDS, SOFT_SHARE = 0.02, 6e-7, 0.1
# Noisy direct light is left to Cycles and the denoiser: a part of it from this relative noise on, all of it from twice
# as much on. The noise is told from the pixels that are at most AROUND away.
MOST_NOISE, AROUND = 0.06, 4
# Our few points and the samples of Cycles place an edge of diffuse light differently, so the mean of both is nearer
# than either. LEAST_BEND: how much the light must bend from pixel to pixel, relative to the light, to count as an edge.
# EDGE_ERROR: the error of an edge relative to that bend. AROUND_EDGE: the pixels on each side that are averaged.
EDGE_ERROR, LEAST_BEND, AROUND_EDGE = 0.2, 0.1, 1
# FEW_POINTS: Cycles keeps its own specular light where the variance of our points is a larger part of the difference to
# Cycles than this; it begins to do so at the first number. SLOPE: the variance within a pixel, relative to the squared
# slope from pixel to pixel; it is twice the true one, to be safe. SHARED: points that pixels share are worth so many.
FEW_POINTS, SLOPE, SHARED = (0.5, 0.75), 1.0 / 6.0, 2.25
# More points for pixels with an edge. FEWEST_POINTS: what such a pixel gets at least. MOST_FINER: how many samples more
# they may take, relative to all. FINER_SHARE: the share of what is left of a budget that they may take. MOST_EDGES:
# where a larger share of the pixels has edges, these are the detail of surfaces, and samples of Cycles are worth more.
FEWEST_POINTS, MOST_FINER, FINER_SHARE, MOST_EDGES = 8, 1.0, 0.3, 0.3
MOST_OF_EDGE = 3.0  # Cycles' part of an edge is at most this many times ours
MOST_OVER = 1.1  # how many times the budget a picture may take without a warning
# How long direct light will take is told from squares of the picture, SQUARE pixels on a side. PROBES: the share of the
# samples that these have, and the power of the number of samples with which the time grows from there: from the first
# squares at least 0.45, from the second 0.49 to 0.7 in six scenes of 32,400 pixels, and 0.84 with nine times as many.
SQUARE, PROBES = 8, ((0.01, 0.45), (0.04, 0.6))
# Of what is left of a budget: the share that direct light may take with the points of the first look, and with more
# points. More of it is worth less than more samples of Cycles. Light that is left to Cycles for its noise counts less.
DIRECT_SHARE, MORE_SHARE = 0.5, 0.2
# Where the points of a pixel differ from their mean by more than this share of the light of the picture, both as root
# mean squares, its highlights are thinner than pixels, and time tells more as samples of Cycles. In five scenes at most
# 0.18, on the example scene 0.9, and 0.4 with 1280 x 720 pixels.
THIN = 0.35
NAMED = 8  # of what Cycles keeps, in a warning


@dataclass(frozen=True)
class Finished:
    """A finished picture, row 0 on top, in scene-referred radiance times the exposure."""

    combined: np.ndarray  # (H, W, 4)
    rest: np.ndarray  # (H, W, 4), what is not ours
    ours: dict[str, np.ndarray]  # (H, W, 3) by layer: ltsh4.specular, ltsh4.specular@Key, ...
    channels: dict[str, np.ndarray]  # (H, W) of Cycles' passes, with ours in place of its direct light
    report: dict
    seconds: dict[str, Any]
    relight_data: dict[str, dict[str, np.ndarray]]  # `rest`, `taken` and `edges` of a RelightData
    comparison: picture.Comparison
    cycles: Any  # blender.process.finished.CyclesPicture


def render_scene(options: RenderOptions, progress: Progress | None = None) -> dict:
    """Write render.exr, render.png, report.json and timing.json of a scene.

    Returns the report, with times as "seconds". Raises SceneError, TableError, OSError, Cancelled.
    """
    made = make_finished(options, progress)
    imaging.write_json(Path(options.output) / "report.json", made.report)
    imaging.write_json(Path(options.output) / "timing.json", {"seconds": made.seconds})
    return {**made.report, "seconds": made.seconds}


def make_finished(options: RenderOptions, progress: Progress | None = None) -> picture.TaskResult:
    """Finish one picture and write its files but report.json. Raises as `render_scene` does."""
    from ..blender.process.blender_process import shared_blender
    from ..blender.process.finished import PICTURE, show_finished

    with temporary_folder() as folder, shared_blender(folder):
        made = finish(options, progress)
        save_array(folder / PICTURE, made.combined.astype(np.float32))
        show_finished(Path(options.scene), None, options.frame, folder, picture.SHOWN, progress=progress)
        shown = (folder / picture.SHOWN).read_bytes()
    if progress is not None and progress("write", 0.0) is False:
        raise Cancelled("stopped before the files were written")
    name = options.name or "render"
    path = Path(options.output) / f"{name}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_exr(path, made, options)
    write_bytes(path.with_suffix(".png"), shown)
    files = [f"{name}.exr", f"{name}.png"]
    if options.keep_visibility:
        path, parts = path.with_name(f"{path.stem}{lighting.RELIGHT_SUFFIX}"), made.comparison
        kept = parts.extraction, parts.shadows, parts.options, path
        written = lighting.write_relight_data(*kept, **made.relight_data)
        files += [one.relative_to(options.output).as_posix() for one in written]
    return picture.TaskResult(made.report, made.seconds, tuple(files))


def finish(
    options: RenderOptions,
    progress: Progress | None = None,
    *,
    scene_name: str | None = None,
    view_layer: str | None = None,
    shaded: Callable[[picture.Comparison], None] = lambda comparison: None,
) -> Finished:
    """The finished picture of a scene and view layer, by default those of the file. Raises as `render_scene` does.

    `shaded` is called with the direct light before Cycles begins.
    """
    from ..blender.process.blender_process import shared_blender
    from ..blender.process.finished import FinishedJob, render_finished

    start, clock = time.perf_counter(), _ProcessorClock()
    where = {"scene_name": scene_name, "view_layer": view_layer}
    with temporary_folder() as folder, shared_blender(folder):
        comparison = _ours(options, where, clock, progress)
        shaded(comparison)
        seconds = _left(options, comparison.extraction, clock)
        width, height = options.resolution or (None, None)
        edges = not (comparison.extraction.picture.has_lens or comparison.extraction.left_to_cycles.everything)
        own = {"width": width, "height": height, "seconds": seconds, "edges": edges}
        job = child_job(FinishedJob, options, **where, **own)
        cycles = render_finished(job, folder, progress=progress)
        clock.end("cycles", cycles.processor_seconds)
        ours = _taken(comparison, cycles, options.denoise == "on")
        rest, of_edges, rests, denoiser, problems = _rest(
            cycles, ours, comparison.extraction, options.denoise, progress
        )
        combined = rest.copy()
        for part in ours.values():
            combined[..., :3] += part.image
        clock.end("denoise")
        report = _report(comparison, cycles, ours, problems)
        report["finished"] |= {"denoiser": denoiser, "budget_s": options.budget}
        if not np.any(combined[..., :3]):
            report["warnings"].append(
                f"camera {cycles.camera!r} sees no light at all, by Cycles neither: the picture is black; add a light, "
                "or let the world shine"
            )
        report["warnings"] += _too_long(options, comparison.extraction, cycles, clock)
        seconds = {
            **comparison.extraction.times.stages,
            "techniques": {name: result.seconds for name, result in comparison.results.items()},
            "processor": {**clock.stages, "total": clock.seconds()},
            "total": time.perf_counter() - start,
        }
        if comparison.shadows is not None:
            seconds["shadows"] = comparison.shadows.seconds
    layers, channels = _layers(comparison, ours), _replaced(cycles, ours, rests)
    kept = _kept(ours, rests, of_edges)
    return Finished(combined, rest, layers, channels, report, seconds, kept, comparison, cycles)


def _left(options: RenderOptions, extraction, clock: _ProcessorClock) -> float | None:
    """Processor seconds of the budget that are left before denoising; None without a budget."""
    if options.budget is None:
        return None
    million = extraction.film.width * extraction.film.height / 1e6
    reserve = (LAST_SECONDS + MORE_SECONDS * (_denoisings(extraction) - 1)) * million
    return max(options.budget - clock.seconds() - START_SECONDS - reserve, 0.0)


def _too_long(options: RenderOptions, extraction, cycles, clock: _ProcessorClock) -> list[str]:
    """The warning about a picture that took longer than its budget."""
    took = clock.seconds()
    if options.budget is None or took <= MOST_OVER * options.budget:
        return []
    # The least is to start Blender, open the file, render the first samples of Cycles, and denoise.
    least = extraction.times.processor - extraction.times.direct + cycles.least_seconds + clock.stages["denoise"]
    if least > options.budget:
        found = f"takes at least {least:.1f} s of processor time, however few samples, and took {took:.1f} s"
    else:
        found = f"took {took:.1f} s of processor time, of at least {least:.1f} s with nothing but a few samples"
    return [f"the picture {found}; the budget is {options.budget:g} s: give it more, or fewer pixels"]


def _denoisings(extraction) -> int:
    """How many pictures `_rest` denoises at most: two for each combination of passes that are ours, and one for each
    light group."""
    if extraction.left_to_cycles.everything:
        return 1
    ways = np.unique([mask.ravel() for mask in extraction.left_to_cycles.by_pass.values()], axis=1)
    return 2 * ways.shape[1] + len({light.group for light in extraction.lights if light.group})


class _ProcessorClock:
    """Counts processor seconds of this process, and of children that have ended, from its creation on."""

    def __init__(self):
        self._start, self._others, self.stages = self._now(), 0.0, {}

    @staticmethod
    def _now() -> float:
        seconds = time.process_time()
        with suppress(ImportError):
            import resource

            usage = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds += usage.ru_utime + usage.ru_stime
        return seconds

    def end(self, stage: str, of_child: float = 0.0) -> None:
        """Note that a stage has ended; `of_child` are its seconds in a child that goes on."""
        self._others += of_child
        self.stages[stage] = self.stages.get(stage, 0.0) + self.seconds() - sum(self.stages.values())

    def seconds(self) -> float:
        return self._now() - self._start + self._others


def _ours(options: RenderOptions, where: dict, clock: _ProcessorClock, progress) -> picture.Comparison:
    """The direct light by the technique, with shadows; without results where all of it is left to Cycles."""
    from ..blender.process.pixels import PixelJob, ended_at_horizons, extract_pixels, with_points

    tables = picture.load_tables(options.techniques)
    width, height = options.resolution or (None, None)
    most = options.sub_samples or (SUB_SAMPLES if options.budget is None else MOST_SUB_SAMPLES)
    # Depth of field needs all of its points from the start.
    first = most if options.budget is None or most > MOST_SUB_SAMPLES else min(FIRST_SUB_SAMPLES, most)
    own = child_job(PictureOptions, options, passes=PASSES, sub_samples=most, shadows="on", cycles_samples=2)
    size = {"width": width, "height": height, "seconds": options.budget, "sub_samples": first}
    size |= {"reserve": LAST_SECONDS / 1e6}
    size |= {"cycles_samples": 0, "for_finished": True, "edge_points": EDGE_POINTS}
    job = child_job(PixelJob, own, **where, **size)
    extraction = extract_pixels(job, progress=progress)
    clock.end("extraction", extraction.times.processor)
    if not extraction.lights or extraction.left_to_cycles.everything:
        return picture.Comparison(own, extraction, {}, None)
    with lighting.ShadowTracer(extraction.occluders, extraction.lights, extraction.origin) as tracer:
        how = _How(options, own, tables, tracer)
        looked = clock.seconds() - (extraction.times.processor - extraction.times.direct)
        number, reason = how.affordable(extraction, _left(options, extraction, clock), looked)
        clock.end("choice")
        if reason:
            kept = replace(extraction.left_to_cycles, everything=(*extraction.left_to_cycles.everything, reason))
            return picture.Comparison(own, replace(extraction, left_to_cycles=kept), {}, None)
        if number > extraction.film.sub_samples:
            extraction = extract_pixels(replace(job, sub_samples=number, seconds=None), progress=progress)
            clock.end("extraction", extraction.times.processor)
        extraction = ended_at_horizons(with_points(extraction, number))
        clock.end("extraction")
        shadows = how.shadows(extraction, progress)
        clock.end("shadows")
        results = picture.evaluated(tables, extraction, shadows, own, progress)
        clock.end("shading")
        comparison = picture.Comparison(own, extraction, results, shadows)
        if extraction.points.finer is not None:
            left, took = _left(options, extraction, clock), clock.stages["shadows"] + clock.stages["shading"]
            more = MOST_FINER if left is None else min(FINER_SHARE * left / took, MOST_FINER)
            comparison = how.with_fine_edges(comparison, more, progress)
            clock.end("edges")
    return comparison


@dataclass(frozen=True)
class _How:
    """What direct light is made with."""

    options: RenderOptions
    own: PictureOptions
    tables: dict
    tracer: lighting.ShadowTracer

    def shadows(self, extraction, progress=None) -> lighting.Shadows:
        """The shares of the lights that the samples see. Points of a pixel that see about the same have common rays."""
        samples, film, place = extraction.samples, extraction.film, slice(None)
        if not extraction.picture.has_lens:
            samples, film, place = with_one_shadow(samples, film)
        rays = lighting.rays_of_samples(_rays(self.options, replace(extraction, samples=samples, film=film)), film)
        return self.tracer.trace(samples, ShadowSampling(PASSES, rays, film), progress=progress).take(place)

    def affordable(self, look, seconds: float | None, looked: float) -> tuple[int, str]:
        """How many points of a pixel processor `seconds` (None: without limit) allow, and ""; or 0, and why Cycles does
        better with that time.

        `look` has the first points, for which it took `looked` seconds.
        """
        from ..blender.process.pixels import EDGE_SECONDS, TOO_THIN, too_small, with_points

        points, most = look.film.sub_samples, self.own.sub_samples
        whole = with_points(look, points)
        if seconds is None or len(whole.samples) == 0:
            return points, ""
        reason = too_small(self.options.budget)
        # Cycles will look at the scene half as long as was done here, and render what shines in sight.
        seconds -= 0.5 * look.times.direct + EDGE_SECONDS * look.film.width * look.film.height / 1e6
        if seconds <= 0.0:
            return 0, reason
        one = np.count_nonzero(look.points.number == 0)
        # All points of a pixel but the first make about equally many samples.
        counts = np.arange(1, max(points, most) + 1) if not look.picture.has_lens else np.array([points])
        samples = one + (counts - 1) * (len(whole.samples) - one) / max(points - 1, 1)
        again = np.where(counts > points, looked * (1.0 + counts / points), 0.0)
        allowed = np.where(counts > points, MORE_SHARE, DIRECT_SHARE) * seconds - again
        (some, least), (more, power) = PROBES
        number, took, *_ = self._probe(whole, some)
        if took * (samples[0] / number) ** least > allowed[0]:
            return 0, reason
        number, took, thin, share = self._probe(whole, more)
        fits = counts[took * (samples / number) ** power <= share * allowed]
        if len(fits) == 0:
            return 0, reason
        return (0, TOO_THIN) if thin > THIN else (int(fits[-1]), "")

    def _probe(self, extraction, share: float) -> tuple[int, float, float, float]:
        """Shades a few squares of the picture that have a `share` of its samples. Returns

        - how many samples these are, and the processor seconds that they took,
        - by how much specular light differs among the points of a pixel, relative to the light (root mean squares),
        - the share of the light that is not too noisy.
        """
        from ..blender.process.pixels import ended_at_horizons

        film, start = extraction.film, time.process_time()
        row, column = np.divmod(film.pixel, film.width)
        square = row // SQUARE * film.width + column // SQUARE
        chosen = np.random.default_rng(round(1.0 / share)).permutation(film.width * film.height)
        count = np.cumsum(np.bincount(square, minlength=len(chosen))[chosen])
        there = np.isin(square, chosen[: 1 + np.searchsorted(count, share * len(square))])
        part = ended_at_horizons(replace(extraction, samples=extraction.samples.take(there), film=film.take(there)))
        shadows = self.shadows(part)
        results = picture.evaluated(self.tables, part, shadows, self.own, None)
        images = picture.Comparison(self.own, part, results, shadows).images
        (technique, result), *_ = results.items()
        variance, _ = _of_points(part.film, _seen(part, result, "specular"))
        variance = variance[~part.left_to_cycles.by_pass["specular"]].sum()
        light = {name: images[technique, name].mean(axis=-1) for name in PASSES}
        whole, squared = sum(light.values()).sum(), np.square(sum(light.values())).sum()
        number, took = int(np.count_nonzero(there)), time.process_time() - start
        if not whole > 0.0:
            return number, took, 0.0, 1.0
        certain = sum((_certain(shadows, name) * light[name]).sum() for name in PASSES)
        return number, took, float(np.sqrt(variance / squared)), float(certain / whole)

    def with_fine_edges(self, comparison: picture.Comparison, more: float, progress) -> picture.Comparison:
        """The same with more points for the pixels that edges of diffuse light run through, of shadows or of objects.

        There are at most `more` times as many new samples as samples.
        """
        extraction, film = comparison.extraction, comparison.film
        light = comparison.images[next(iter(comparison.results)), "diffuse"].mean(axis=-1)
        bend = (_bend(light) * _certain(comparison.shadows, "diffuse")).ravel()
        covered = np.minimum(film.coverage(), 1.0).ravel()
        pixel = np.flatnonzero((bend > 0.0) & ~extraction.left_to_cycles.by_pass["diffuse"].ravel() & (covered > 0.0))
        if len(pixel) > MOST_EDGES * len(bend):
            return comparison
        number = _numbers_of_points(bend[pixel], covered[pixel], more * len(film.pixel))
        chosen = number > film.sub_samples
        if not chosen.any():
            return comparison
        pixels = {"pixel": pixel[chosen], "number": number[chosen]}
        samples, own, replaced = self.tracer.finer(extraction.samples, film, extraction.points.finer, pixels)
        if len(samples) == 0:
            return comparison
        fine = replace(extraction, samples=samples, film=own)
        shadows = self.tracer.trace(samples, ShadowSampling(PASSES, SHADOW_RAYS[0], own), progress=progress)
        results = picture.evaluated(self.tables, fine, shadows, self.own, progress)
        return comparison.with_more(~replaced, picture.Comparison(self.own, fine, results, shadows))


def _numbers_of_points(bend: np.ndarray, covered: np.ndarray, most: float) -> np.ndarray:
    """How many points pixels (Q,) get, at most `most` together, by how much the light bends there, `bend` (Q,).

    `covered` (Q,) is the share of a pixel that has a surface. The error of an edge falls with the number of points to
    the power -0.75.
    """
    worth = bend**0.8
    least, largest = 0.0, EDGE_POINTS / max(worth.max(initial=0.0), 1e-30) * 1e3
    for _ in range(40):
        middle = 0.5 * (least + largest)
        number = _whole_numbers(middle * worth)
        least, largest = (middle, largest) if (number * covered).sum() <= most else (least, middle)
    return _whole_numbers(least * worth)


def _whole_numbers(wanted: np.ndarray) -> np.ndarray:
    """The `wanted` numbers of points as integers: at most EDGE_POINTS, and 0 below FEWEST_POINTS."""
    return np.where(wanted >= FEWEST_POINTS, np.minimum(wanted, EDGE_POINTS), 0.0).astype(int)


def _bend(light: np.ndarray) -> np.ndarray:
    """How much `light` (H, W) bends from pixel to pixel, (H, W); 0 where that is below LEAST_BEND of the light."""
    grid, (height, width) = np.pad(light, 1, mode="edge"), light.shape
    rows = [grid[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    # The pairs of opposite neighbors of a pixel.
    bend = np.max([np.abs(one + other - 2.0 * light) for one, other in zip(rows[:4], rows[:4:-1], strict=True)], axis=0)
    bend[bend < LEAST_BEND * _around(light, AROUND_EDGE)] = 0.0
    return bend


def _rays(options: RenderOptions, extraction) -> int:
    """The most shadow rays for a light and a pixel, by the options and the budget."""
    if options.budget is None:
        return options.shadow_rays
    # Lights of one name, such as the sides of a sky, have common rays.
    pairs = extraction.film.coverage().sum() * len({light.name for light in extraction.lights})
    affordable = SHADOWS_SHARE * options.budget / max(SOFT_SHARE * RAY_SECONDS * pairs, 1e-9)
    return int(np.clip(affordable, SHADOW_RAYS[0], options.shadow_rays))


@dataclass(frozen=True)
class _DirectPass:
    """One pass of ours, and where it takes the place of Cycles' direct light, which is `light` times `color`."""

    image: np.ndarray  # (H, W, 3), black elsewhere
    groups: dict[str, np.ndarray]  # the same by light group
    is_taken: np.ndarray  # (H, W) bool, where ours takes its place
    certain: np.ndarray  # (H, W) the share of Cycles' direct light whose place it takes there, smooth
    light: np.ndarray  # (H, W, 3)
    color: np.ndarray  # (H, W, 3)
    weight: np.ndarray | float = 1.0  # (H, W) of ours; the rest of 1 is Cycles' direct light, denoised

    @property
    def share(self) -> np.ndarray:
        """The share (H, W) of Cycles' direct light whose place it takes."""
        return np.where(self.is_taken, self.certain * self.weight, 0.0)

    @property
    def direct(self) -> np.ndarray:
        """Cycles' direct light (H, W, 3) whose place it takes, or would take where `is_taken` is false."""
        return _share_of(self.certain, self.light.astype(np.float64) * self.color)

    @property
    def replaced(self) -> np.ndarray:
        """Cycles' direct light (H, W, 3) whose place it takes."""
        return np.where(self.is_taken[..., None], self.direct, 0.0)

    def share_of_group(self, group: str) -> np.ndarray:
        """The share (H, W, 3) of it that is light of a light group."""
        return np.divide(self.groups[group], self.image, out=np.zeros_like(self.image), where=self.image != 0.0)


def _share_of(share: np.ndarray, image: np.ndarray) -> np.ndarray:
    """`share` (H, W) times `image` (H, W, 3); 0 where the share is 0, even if the image is not finite there."""
    return np.where(share[..., None] > 0.0, share[..., None] * image, 0.0)


def _certain(shadows: lighting.Shadows, name: str) -> np.ndarray:
    """The share (H, W) of a pass that is kept in spite of the noise of its shadows, smooth over the picture."""
    light, variance = (_around(image) for image in (np.square(shadows.light[name]), shadows.variance[name]))
    noise = np.sqrt(np.divide(variance, light, out=np.zeros_like(light), where=light > 0.0))
    return _around(np.clip(2.0 - noise / MOST_NOISE, 0.0, 1.0))


def _beside_points(film, radiance: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The weight (H, W) of our specular `radiance` (P,) beside Cycles' `direct` (H, W): 0 where its samples tell more.

    Highlights thinner than a pixel need many points. The variance of ours is that of the points of a pixel, divided by
    their number. What a slope adds to it does not count: even few points find the mean of a slope. The variance of both
    pictures together is their squared difference.
    """
    whole, (variance, mean) = film.image(radiance), _of_points(film, radiance)
    slope = sum(np.square(one) for one in np.gradient(mean)) if min(mean.shape) > 1 else 0.0
    variance = np.maximum(variance - SLOPE * slope, 0.0) / max(film.sub_samples - 1, 1)
    variance /= 1.0 if film.spread is None else SHARED
    variance = _around(np.where(film.has_more(), 0.0, variance))
    both = _around(np.square(direct.astype(np.float64) - whole))
    share = np.divide(variance, both, out=np.zeros_like(both), where=both > 0.0)
    least, most = FEW_POINTS
    return _around(((most - share) / (most - least)).clip(0.0, 1.0))


def _of_points(film, radiance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The variance and the mean (H, W) of the `radiance` (P,) of the points of each pixel."""
    hits = film.unspread()
    if film.first is not None:
        radiance, hits = np.bincount(np.cumsum(film.first) - 1, radiance), hits.take(film.first)
    mean = hits.image(radiance)
    return np.maximum(hits.image(np.square(radiance)) - np.square(mean), 0.0), mean


def _seen(extraction, result, name: str) -> np.ndarray:
    """The exposed radiance (P,) of a pass: the sum over light groups, the mean over color channels."""
    return extraction.picture.exposure * getattr(result.shading, name).sum(axis=0).mean(axis=-1)


def _around(image: np.ndarray, around: int = AROUND) -> np.ndarray:
    """Means (H, W) over squares with sides of 2 `around` + 1 pixels."""
    side = 2 * around + 1
    sums = np.pad(image, ((around + 1, around), (around + 1, around)), mode="edge").cumsum(axis=0).cumsum(axis=1)
    whole = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return np.maximum(whole, 0.0) / side**2


def _beside(ours: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The weight (H, W) of a pass of ours (H, W, 3) beside Cycles' own: 1 away from edges, down to 1/2 at edges.

    Where both differ by much more than an edge explains, the difference is noise of Cycles, and the weight is near 1.
    """
    bend = _bend(ours.mean(axis=-1))
    between = _around(np.square((ours - direct).mean(axis=-1)), AROUND_EDGE)
    edge = _around(np.square(EDGE_ERROR * bend), AROUND_EDGE)
    return 1.0 - 0.5 * np.minimum(np.divide(edge, between, out=np.zeros_like(edge), where=between > 0.0), 1.0)


def _taken(comparison: picture.Comparison, cycles, is_denoised: bool) -> dict[str, _DirectPass]:
    """Ours by pass. Where Cycles' part is denoised, what is too noisy of ours is left to it."""
    kept, found = comparison.extraction.left_to_cycles, {}
    shape = comparison.film.height, comparison.film.width
    keeps_all = bool(cycles.everything or kept.everything)
    result = next(iter(comparison.results.values()), None)
    for name, (light, color) in DIRECT.items():
        image, groups = np.zeros((*shape, 3)), {}
        is_taken, certain, weight = np.zeros(shape, bool), np.ones(shape), 1.0
        light, color = (read_layer(cycles.channels, cycles.names[key], "RGB") for key in (light, color))
        if result is not None and not keeps_all:
            is_taken = ~kept.by_pass[name]
            # With depth of field ours is denoised too, so its noise does not matter.
            if is_denoised and not comparison.extraction.picture.has_lens:
                certain = _certain(comparison.shadows, name)
            image = comparison.images[next(iter(comparison.results)), name]
            if is_denoised and not comparison.extraction.picture.has_lens and name == "specular":
                radiance = _seen(comparison.extraction, result, name)
                certain = certain * _beside_points(comparison.film, radiance, (light * color).mean(axis=-1))
            elif is_denoised and not comparison.extraction.picture.has_lens:
                of_cycles = _share_of(certain, light.astype(np.float64) * color)
                weight = _beside(certain[..., None] * image, of_cycles)
                weight = np.where(comparison.film.has_more(), 1.0, weight)
            share = np.where(is_taken, certain * weight, 0.0)
            values = comparison.extraction.picture.exposure * getattr(result.shading, name)
            own = map(comparison.film.image, values) if len(values) > 1 else (image,)
            groups = {group: _share_of(share, one) for group, one in zip(result.shading.groups, own, strict=True)}
            image = _share_of(share, image)
        found[name] = _DirectPass(image, groups, is_taken, certain, light, color, weight)
    return found


def _rest(
    cycles, ours: dict[str, _DirectPass], extraction, denoise: str, progress
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], str, list[str]]:
    """What is not ours, denoised. Returns

    - all of it (H, W, 4),
    - the part of it that is Cycles' direct diffuse light at edges (H, W, 3),
    - all of it by light group, with "" for what is in none,
    - the name of the denoiser, "" for none, and what was wrong with it.
    """
    from ..blender.process.blender_process import denoiser_libraries

    if progress is not None and progress("denoise", 0.0) is False:
        raise Cancelled("stopped before the picture was denoised")
    rest, is_noisy = read_layer(cycles.channels, "Combined", "RGBA").astype(np.float64), extraction.picture.has_lens
    shining = _shining(cycles, extraction)
    # Once without and once with Cycles' direct diffuse light, of which edges need a part.
    taken = np.stack([ours["specular"].is_taken, ours["diffuse"].is_taken, shining.is_taken], axis=-1)
    taken = np.stack([taken, taken & [True, np.ndim(ours["diffuse"].weight) == 0, True]])
    ways, way = np.unique(taken.reshape(-1, taken.shape[-1]), axis=0, return_inverse=True)
    groups = sorted(
        {key.rpartition(".")[0].removeprefix(OF_GROUP) for key in cycles.channels if key.startswith(OF_GROUP)}
    )
    # Each combination of passes that are ours is denoised for the whole picture: in one picture, they would bleed into
    # each other at their borders.
    found = [_without_taken(rest[..., :3], [*ours.values(), shining], one, is_noisy) for one in ways]
    found += [_rest_of_group(cycles, ours, group) for group in groups]
    name, problems = "", []
    if denoise == "on":
        guides = [read_layer(cycles.guides, *guide) for guide in (ALBEDO, NORMAL)]
        try:
            with open_denoiser(denoiser_libraries(), cores()) as denoiser:
                found, name = denoiser.all_denoised(found, *guides), denoiser.name
        except NoDenoiser as error:
            problems = [f"{error}; the picture is not denoised"]
    without, within = np.choose(way.reshape(taken.shape[:3])[..., None], found[: len(ways)])
    left = (1.0 - np.broadcast_to(ours["diffuse"].weight, without.shape[:2]))[..., None] * (within - without)
    rest[..., :3] = without + left + shining.image
    # With depth of field ours went through the denoiser too.
    rest[..., :3] -= sum(part.image for part in ours.values()) if is_noisy else 0.0
    of_groups = dict(zip(groups, found[len(ways) :], strict=True))
    for group in of_groups.keys() & ours["diffuse"].groups.keys():
        of_groups[group] = of_groups[group] + ours["diffuse"].share_of_group(group) * left
    return rest, left, _shared_out(rest, of_groups, is_clean=bool(name)), name, problems


def _shining(cycles, extraction) -> _DirectPass:
    """What shines in sight, on the pixels where it can stay out of the denoiser: not behind surfaces that light passes,
    where it is noisy."""
    names = {key: cycles.names[key] for key in cycles.smooth_emission}
    own = sum((read_layer(cycles.channels, name, "RGB") for name in names.values()), np.zeros((1, 1, 3)))
    kept = extraction.left_to_cycles
    is_hidden = np.logical_and.reduce([*kept.by_pass.values()])
    if not names or extraction.picture.has_lens or cycles.everything or kept.everything:
        is_hidden = np.ones_like(is_hidden)
    image = sum(cycles.smooth_emission.values(), np.zeros_like(own))
    image = np.where(is_hidden[..., None], 0.0, image)
    return _DirectPass(image, {}, ~is_hidden, np.ones(is_hidden.shape), own, np.ones(3))


def _without_taken(combined: np.ndarray, parts: list[_DirectPass], way: np.ndarray, is_noisy: bool) -> np.ndarray:
    """Cycles' picture (H, W, 3) without its light of those of the `parts` that `way` names, on all pixels; where
    ours `is_noisy`, with ours in its place."""
    left = combined.copy()
    for part, is_taken in zip(parts, way, strict=True):
        if is_taken and is_noisy:
            left += np.where(part.is_taken[..., None], part.image - part.direct, 0.0)
        elif is_taken:
            left -= part.direct
    return left


def _rest_of_group(cycles, ours: dict[str, _DirectPass], group: str) -> np.ndarray:
    """The light (H, W, 3) of a light group that is not ours."""
    found = read_layer(cycles.channels, f"{OF_GROUP}{group}", "RGB").astype(np.float64)
    for part in ours.values():
        if group in part.groups:
            found -= part.share_of_group(group) * part.replaced
    return found


def _shared_out(rest: np.ndarray, groups: dict[str, np.ndarray], is_clean: bool) -> dict[str, np.ndarray]:
    """`groups` (H, W, 3), and as "" what they leave of `rest` (H, W, 4); of one that `is_clean` no more than all."""
    if is_clean and groups:
        whole = np.maximum(sum(groups.values()), 1e-30)
        groups = {name: one * np.clip(rest[..., :3] / whole, 0.0, 1.0) for name, one in groups.items()}
    left = rest.copy()
    for one in groups.values():
        left[..., :3] -= one
    return {"": left, **groups}


def _kept(ours: dict[str, _DirectPass], rests: dict[str, np.ndarray], of_edges: np.ndarray) -> dict:
    """`rest`, `taken` and `edges` of a RelightData. Cycles' part of an edge is kept as a factor of our light, so that
    it changes with the lights as ours does."""
    taken = {name: np.where(part.is_taken, part.certain, 0.0) for name, part in ours.items()}
    part = ours["diffuse"]
    if np.ndim(part.weight) == 0:
        return {"rest": rests, "taken": taken, "edges": {}}
    light = part.image.mean(axis=-1)
    more = np.divide(of_edges.mean(axis=-1), light, out=np.zeros_like(light), where=light > 0.0)
    more = np.clip(more, 0.0, MOST_OF_EDGE)
    # What this factor cannot hold stays in the rest: light of other colors, and light where ours is dark.
    of_lights, rest = more[..., None] * part.image, {group: one.copy() for group, one in rests.items()}
    for group in rest.keys() & part.groups.keys() - {""}:
        own = part.share_of_group(group) * of_lights
        rest[group] -= own
        rest[""][..., :3] += own
    rest[""][..., :3] -= of_lights
    return {"rest": rest, "taken": taken, "edges": {"diffuse": part.weight * (1.0 + more)}}


def _layers(comparison: picture.Comparison, ours: dict[str, _DirectPass]) -> dict[str, np.ndarray]:
    """Ours by the names of the layers, and also by light group where there are several."""
    if not comparison.results:
        return {}
    name, layers = next(iter(comparison.results)), {}
    for pass_name, part in ours.items():
        layers[f"{name}.{pass_name}"] = part.image
        if len(part.groups) > 1:
            names = lighting.group_names(part.groups)
            layers |= {
                f"{name}.{pass_name}@{group}": one for group, one in zip(names, part.groups.values(), strict=True)
            }
    return layers


def _replaced(cycles, ours: dict[str, _DirectPass], rests: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Cycles' channels with ours in place of its direct light, without its noisy Combined."""
    channels = {name: plane for name, plane in cycles.channels.items() if not name.startswith("Combined.")}
    for name, (light, _) in DIRECT.items():
        part = ours[name]
        own = np.divide(part.image, part.color, out=np.zeros_like(part.image), where=part.color > 0.0)
        for index, letter in enumerate("RGB"):
            key = f"{cycles.names[light]}.{letter}"
            channels[key] = own[..., index] + (1.0 - part.share) * channels[key]
    for group, rest in rests.items():
        if group:
            whole = rest + sum(part.groups.get(group, 0.0) for part in ours.values())
            channels |= imaging.Layer(whole).planes(f"{OF_GROUP}{group}")
    return channels


def _report(comparison: picture.Comparison, cycles, ours: dict[str, _DirectPass], problems: list[str]) -> dict:
    """The report of a picture, and under "finished" what is ours and what is Cycles'."""
    kept = comparison.extraction.left_to_cycles
    everything = [*cycles.everything, *kept.everything]
    warnings = [*cycles.warnings, *kept.warnings, *problems]
    if everything:
        why = listed(everything, NAMED, "; ")
        warnings.append(f"all direct light is Cycles' own and denoised, because LTSH does not shade: {why}")
    if kept.materials and not everything:
        why = listed(kept.materials, NAMED, "; ")
        warnings.append(f"direct light on some surfaces is Cycles' own and denoised: {why}")
    return {
        **comparison.report(),
        "camera": cycles.camera,
        "cycles_samples": cycles.samples,
        "problems": [],
        "warnings": list(dict.fromkeys(warnings)),
        "finished": {
            "share_of_ours": {
                name: float(np.where(part.is_taken, part.certain, 0.0).mean()) for name, part in ours.items()
            },
            "all_by_cycles": everything,
            "materials_by_cycles": list(kept.materials),
        },
    }


def _write_exr(path: Path, made: Finished, options: RenderOptions) -> None:
    extraction = made.comparison.extraction
    metadata = {
        "ltsh:scene": Path(options.scene).name,
        "ltsh:frame": str(extraction.picture.frame),
        "ltsh:camera": extraction.picture.camera,
        "ltsh:version": made.report["versions"]["ltsh"],
        "ltsh:exposure": repr(extraction.picture.exposure),
        "ltsh:color_space": extraction.picture.color_space.name,
    }
    planes = {}
    for name, pixels in {picture.COMBINED: made.combined, **made.ours, REST: made.rest}.items():
        planes |= imaging.Layer(pixels).planes(name)
    planes |= made.channels
    write_channels(
        path, planes, metadata, imaging.chromaticities(extraction.picture.color_space), extraction.picture.pixel_aspect
    )


def summary(report: dict, seconds: dict) -> list[str]:
    """Lines about what a picture is made of, and how long it took."""
    found, (width, height) = report["finished"], report["resolution"]
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in found["share_of_ours"].items())
    took = f", {seconds['processor']['total']:.1f} s of processor time" if "processor" in seconds else ""
    denoised = f"denoised by {found['denoiser']}" if found["denoiser"] else "not denoised"
    return [
        f"{width}x{height}, {report['sub_samples']} points per pixel, {report['cycles_samples']} samples of Cycles, "
        f"{denoised}{took}",
        f"direct light by LTSH on: {shares} of the pixels",
    ]


def brief(report: dict) -> list[str]:
    """The line for one of several pictures."""
    return [f"{report['name']:<32} frame {report['frame']}, camera {report['camera']}"]
