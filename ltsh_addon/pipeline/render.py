"""Finished pictures: our direct light, and everything else by Cycles, denoised.

    combined = ours + rest,  rest = denoised(Combined of Cycles - its direct light where ours takes its place)

The same is done with the Combined pass of each light group of the view layer, of which Cycles writes no direct light:
that of all lights is shared out as ours is. So what a light group bounces can change with its lights.

With depth of field, of which few points of the lens leave noise in ours too, the sum is denoised as a whole.

Ours, a specular and a diffuse picture, takes the place of Cycles' direct light pixel by pixel. Where something is not
shaded as in Cycles, ours is black and Cycles keeps its own: nothing is there twice, and nothing is lost.

What shines in sight, lamps and the world, has no noise but that of jagged edges, of which a denoiser makes nothing
better. It stays out of it, and is rendered apart, with many samples where it has edges.
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
from ..shading.parallel import cores
from ..visibility import ShadowSampling
from . import lighting, picture
from .options import EDGE_POINTS, SHADOW_RAYS, PictureOptions, RenderOptions, child_job

# Names of the passes of Cycles in `pass_names`: light and color of each pass of ours.
DIRECT = {"specular": ("specular_light", "specular_color"), "diffuse": ("diffuse_light", "diffuse_color")}
ALBEDO, NORMAL = ("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ")
# A pass of Cycles, followed by the name of a light group.
OF_GROUP = "Combined_"
REST = "rest"
# Points of a pixel: without a budget; of a budget those of the first look, and at most.
SUB_SAMPLES, FIRST_SUB_SAMPLES, MOST_SUB_SAMPLES = 9, 3, 17
# Processor seconds that denoising and writing take at least, for a million pixels, and those of each further denoising.
START_SECONDS, LAST_SECONDS, MORE_SECONDS = 0.25, 12.0, 4.0
# Of a budget: what the shadows may take; what a shadow ray takes, and how many of those of a pixel soft shadows need.
SHADOWS_SHARE, RAY_SECONDS, SOFT_SHARE = 0.02, 6e-7, 0.1
# Direct light with more noise than this is left to Cycles and the denoiser, with twice as much all of it; noise is told
# from so many pixels around each.
MOST_NOISE, AROUND = 0.06, 4
# At edges of diffuse light, which our few points and the samples of Cycles place apart from each other, half of each is
# nearer than either. Of how much light bends from pixel to pixel so much is the error of an edge, where that is more
# than a share of the light; the mean of so many pixels around each.
EDGE_ERROR, LEAST_BEND, AROUND_EDGE = 0.2, 0.1, 1
# Where our points have so much of the variance of both pictures, Cycles keeps its own; of the squared slope from pixel
# to pixel the variance in a pixel, twice what it is.
FEW_POINTS, SLOPE = (0.5, 0.75), 1.0 / 6.0
# Points that a pixel with an edge gets at least. Of all samples so many more for such pixels, and less where these
# would take more than a share of what is left of a budget. Where more than a share of the pixels has edges they are the
# detail of surfaces, and the samples of Cycles that the time buys are worth more.
FEWEST_POINTS, MOST_FINER, FINER_SHARE, MOST_EDGES = 8, 1.0, 0.3, 0.3
MOST_OF_EDGE = 3.0  # of ours, that Cycles' part of an edge is
MOST_OVER = 1.1  # of a budget, before a warning
# How long direct light will take is told from squares of the picture, SQUARE pixels on a side. PROBES: the share of the
# samples that these have, and the power of the number of samples with which the time grows from there: from the first
# squares at least 0.45, from the second 0.49 to 0.7 in six scenes of 32,400 pixels, and 0.84 with nine times as many.
SQUARE, PROBES = 8, ((0.01, 0.45), (0.04, 0.6))
# Of what is left of a budget: the share that direct light may take with the points of the first look, and with more
# points. More of it is worth less than more samples of Cycles. Light that is left to Cycles for its noise counts less.
DIRECT_SHARE, MORE_SHARE = 0.5, 0.25
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
    channels: dict[str, np.ndarray]  # (H, W) of Cycles, with ours in place of its direct light
    report: dict
    seconds: dict[str, Any]
    kept: dict[str, dict[str, np.ndarray]]  # `rest`, `taken` and `edges` of a KeptPicture
    comparison: picture.Comparison
    cycles: Any  # blender.process.client.CyclesPicture


def render_scene(options: RenderOptions, progress: Progress | None = None) -> dict:
    """Write render.exr, render.png, report.json and timing.json of a scene; the report with times as "seconds".

    Raises SceneError, TableError, OSError, Cancelled.
    """
    made = make_finished(options, progress)
    imaging.write_json(Path(options.output) / "report.json", made.report)
    imaging.write_json(Path(options.output) / "timing.json", {"seconds": made.seconds})
    return {**made.report, "seconds": made.seconds}


def make_finished(options: RenderOptions, progress: Progress | None = None) -> picture.TaskResult:
    """Finish one picture and write its files but report.json. Raises as `render_scene` does."""
    from ..blender.process import client
    from ..blender.process.blender_process import kept_blender

    with temporary_folder() as folder, kept_blender(folder):
        made = finish(options, progress)
        save_array(folder / client.PICTURE, made.combined.astype(np.float32))
        client.show_finished(Path(options.scene), (None, options.frame), folder, picture.SHOWN, progress=progress)
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
        path, parts = path.with_name(f"{path.stem}{lighting.KEPT_SUFFIX}"), made.comparison
        kept = parts.extraction, parts.shadows, parts.options, path
        written = lighting.keep_picture(*kept, **made.kept)
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
    """The finished picture of a scene and view layer, by default those of the file; `shaded` gets the direct light
    before Cycles begins. Raises as `render_scene` does."""
    from ..blender.process import client
    from ..blender.process.blender_process import kept_blender

    start, clock = time.perf_counter(), _ProcessorClock()
    where = {"scene_name": scene_name, "view_layer": view_layer}
    with temporary_folder() as folder, kept_blender(folder):
        comparison = _ours(options, where, clock, progress)
        shaded(comparison)
        seconds = _left(options, comparison.extraction, clock)
        width, height = options.resolution or (None, None)
        edges = not (comparison.extraction.has_lens or comparison.extraction.kept.everything)
        own = {"width": width, "height": height, "seconds": seconds, "edges": edges}
        job = child_job(client.FinishedJob, options, **where, **own)
        cycles = client.render_finished(job, folder, progress=progress)
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
            **comparison.extraction.seconds,
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
    """Processor seconds of a budget that are left until denoising, None without a budget."""
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
    # Starting Blender, opening the file, a few samples of Cycles, denoising.
    least = extraction.processor_seconds - extraction.direct_seconds + cycles.least_seconds + clock.stages["denoise"]
    if least > options.budget:
        found = f"takes at least {least:.1f} s of processor time, however few samples, and took {took:.1f} s"
    else:
        found = f"took {took:.1f} s of processor time, of at least {least:.1f} s with nothing but a few samples"
    return [f"the picture {found}; the budget is {options.budget:g} s: give it more, or fewer pixels"]


def _denoisings(extraction) -> int:
    """How many pictures `_rest` denoises at most: two for each way to take passes, and one for each light group."""
    if extraction.kept.everything:
        return 1
    ways = np.unique([mask.ravel() for mask in extraction.kept.by_pass.values()], axis=1)
    return 2 * ways.shape[1] + len({light.group for light in extraction.lights if light.group})


class _ProcessorClock:
    """Processor seconds of this process and of children that have ended, from now on."""

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
        """A stage has ended, for which a child, which has not, took so many seconds."""
        self._others += of_child
        self.stages[stage] = self.stages.get(stage, 0.0) + self.seconds() - sum(self.stages.values())

    def seconds(self) -> float:
        return self._now() - self._start + self._others


def _ours(options: RenderOptions, where: dict, clock: _ProcessorClock, progress) -> picture.Comparison:
    """The direct light by the technique, with shadows."""
    from ..blender.process import client

    tables = picture.load_tables(options.techniques)
    width, height = options.resolution or (None, None)
    most = options.sub_samples or (SUB_SAMPLES if options.budget is None else MOST_SUB_SAMPLES)
    # Depth of field takes all points or none.
    first = most if options.budget is None or most > MOST_SUB_SAMPLES else min(FIRST_SUB_SAMPLES, most)
    own = child_job(PictureOptions, options, passes=PASSES, sub_samples=most, shadows="on", cycles_samples=2)
    size = {"width": width, "height": height, "seconds": options.budget, "sub_samples": first}
    size |= {"reserve": LAST_SECONDS / 1e6}
    size |= {"cycles_samples": 0, "for_finished": True, "edge_points": EDGE_POINTS}
    job = child_job(client.ExtractOptions, own, **where, **size)
    extraction = client.extract(job, progress=progress)
    clock.end("extraction", extraction.processor_seconds)
    if not extraction.lights or extraction.kept.everything:
        return picture.Comparison(own, extraction, {}, None)
    with lighting.ShadowTracer(extraction.occluders, extraction.lights, extraction.origin) as tracer:
        how = _How(options, own, tables, tracer)
        looked = clock.seconds() - (extraction.processor_seconds - extraction.direct_seconds)
        number, reason = how.affordable(extraction, _left(options, extraction, clock), looked)
        clock.end("choice")
        if reason:
            kept = replace(extraction.kept, everything=(*extraction.kept.everything, reason))
            return picture.Comparison(own, replace(extraction, kept=kept), {}, None)
        if number > extraction.film.sub_samples:
            extraction = client.extract(replace(job, sub_samples=number, seconds=None), progress=progress)
            clock.end("extraction", extraction.processor_seconds)
        extraction = client.ended(client.with_points(extraction, number))
        clock.end("extraction")
        shadows = how.shadows(extraction, progress)
        clock.end("shadows")
        results = picture.evaluated(tables, extraction, shadows, own, progress)
        clock.end("shading")
        comparison = picture.Comparison(own, extraction, results, shadows)
        if extraction.finer is not None:
            left, took = _left(options, extraction, clock), clock.stages["shadows"] + clock.stages["shading"]
            more = MOST_FINER if left is None else min(FINER_SHARE * left / took, MOST_FINER)
            comparison = how.with_fine_edges(comparison, more, progress)
            clock.end("edges")
    return comparison


@dataclass(frozen=True)
class _How:
    """How direct light is made."""

    options: RenderOptions
    own: PictureOptions
    tables: dict
    tracer: lighting.ShadowTracer

    def shadows(self, extraction, progress=None) -> lighting.Shadows:
        """The shares of the lights that the samples see: points of a pixel that see about the same share their rays."""
        samples, film, place = extraction.samples, extraction.film, slice(None)
        if not extraction.has_lens:
            samples, film, place = with_one_shadow(samples, film)
        rays = lighting.rays_of_samples(_rays(self.options, replace(extraction, samples=samples, film=film)), film)
        return self.tracer.trace(samples, ShadowSampling(PASSES, rays, film), progress=progress).take(place)

    def affordable(self, look, seconds: float | None, looked: float) -> tuple[int, str]:
        """The points of a pixel that processor `seconds` allow (None: any), after a `look` at the first of them for
        which it took `looked`; or why Cycles does better with that time."""
        from ..blender.process import client

        points, most = look.film.sub_samples, self.own.sub_samples
        whole = client.with_points(look, points)
        if seconds is None or len(whole.samples) == 0:
            return points, ""
        reason = client.too_small(self.options.budget)
        # Cycles will look at the scene half as long as was done here, and render what shines in sight.
        seconds -= 0.5 * look.direct_seconds + client.EDGE_SECONDS * look.film.width * look.film.height / 1e6
        if seconds <= 0.0:
            return 0, reason
        one = np.count_nonzero(look.point == 0)
        # Each point that a pixel gets beside its first makes about as many samples.
        counts = np.arange(1, max(points, most) + 1) if not look.has_lens else np.array([points])
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
        return (0, client.TOO_THIN) if thin > THIN else (int(fits[-1]), "")

    def _probe(self, extraction, share: float) -> tuple[int, float, float, float]:
        """Of a few squares of the picture: how many samples there are, the processor seconds that they take, by how
        much of their light specular light differs from point to point of a pixel, and the share of their light that is
        not too noisy."""
        from ..blender.process import client

        film, start = extraction.film, time.process_time()
        row, column = np.divmod(film.pixel, film.width)
        square = row // SQUARE * film.width + column // SQUARE
        chosen = np.random.default_rng(round(1.0 / share)).permutation(film.width * film.height)
        count = np.cumsum(np.bincount(square, minlength=len(chosen))[chosen])
        there = np.isin(square, chosen[: 1 + np.searchsorted(count, share * len(square))])
        part = client.ended(replace(extraction, samples=extraction.samples.take(there), film=film.take(there)))
        shadows = self.shadows(part)
        results = picture.evaluated(self.tables, part, shadows, self.own, None)
        images = picture.Comparison(self.own, part, results, shadows).images
        (technique, result), *_ = results.items()
        variance, _ = _of_points(part.film, _seen(part, result, "specular"))
        variance = variance[~part.kept.by_pass["specular"]].sum()
        light = {name: images[technique, name].mean(axis=-1) for name in PASSES}
        whole, squared = sum(light.values()).sum(), np.square(sum(light.values())).sum()
        number, took = int(np.count_nonzero(there)), time.process_time() - start
        if not whole > 0.0:
            return number, took, 0.0, 1.0
        certain = sum((_certain(shadows, name) * light[name]).sum() for name in PASSES)
        return number, took, float(np.sqrt(variance / squared)), float(certain / whole)

    def with_fine_edges(self, comparison: picture.Comparison, more: float, progress) -> picture.Comparison:
        """The same with more points of the pixels that edges of diffuse light run through: those of shadows, and of
        what is seen; at most `more` times as many as there are."""
        extraction, film = comparison.extraction, comparison.film
        light = comparison.images[next(iter(comparison.results)), "diffuse"].mean(axis=-1)
        bend = (_bend(light) * _certain(comparison.shadows, "diffuse")).ravel()
        covered = np.minimum(film.coverage(), 1.0).ravel()
        pixel = np.flatnonzero((bend > 0.0) & ~extraction.kept.by_pass["diffuse"].ravel() & (covered > 0.0))
        if len(pixel) > MOST_EDGES * len(bend):
            return comparison
        number = _numbers_of_points(bend[pixel], covered[pixel], more * len(film.pixel))
        chosen = number > film.sub_samples
        if not chosen.any():
            return comparison
        pixels = {"pixel": pixel[chosen], "number": number[chosen]}
        samples, own, replaced = self.tracer.finer(extraction.samples, film, extraction.finer, pixels)
        if len(samples) == 0:
            return comparison
        fine = replace(extraction, samples=samples, film=own)
        shadows = self.tracer.trace(samples, ShadowSampling(PASSES, SHADOW_RAYS[0], own), progress=progress)
        results = picture.evaluated(self.tables, fine, shadows, self.own, progress)
        return comparison.with_more(~replaced, picture.Comparison(self.own, fine, results, shadows))


def _numbers_of_points(bend: np.ndarray, covered: np.ndarray, most: float) -> np.ndarray:
    """How many points (Q,) pixels get, by how much light bends there and what share of them is `covered` (Q,), at most
    so many together: the error of an edge falls with their number to the power -0.75."""
    worth = bend**0.8
    least, largest = 0.0, EDGE_POINTS / max(worth.max(initial=0.0), 1e-30) * 1e3
    for _ in range(40):
        middle = 0.5 * (least + largest)
        number = _whole_numbers(middle * worth)
        least, largest = (middle, largest) if (number * covered).sum() <= most else (least, middle)
    return _whole_numbers(least * worth)


def _whole_numbers(wanted: np.ndarray) -> np.ndarray:
    """At most EDGE_POINTS, 0 where it is too few."""
    return np.where(wanted >= FEWEST_POINTS, np.minimum(wanted, EDGE_POINTS), 0.0).astype(int)


def _bend(light: np.ndarray) -> np.ndarray:
    """How much (H, W) light bends from pixel to pixel, 0 where that is little of it."""
    grid, (height, width) = np.pad(light, 1, mode="edge"), light.shape
    rows = [grid[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    # Opposite neighbors of the nine.
    bend = np.max([np.abs(one + other - 2.0 * light) for one, other in zip(rows[:4], rows[:4:-1], strict=True)], axis=0)
    bend[bend < LEAST_BEND * _around(light, AROUND_EDGE)] = 0.0
    return bend


def _rays(options: RenderOptions, extraction) -> int:
    """At most so many shadow rays for a light and a pixel, as the options and the budget allow."""
    if options.budget is None:
        return options.shadow_rays
    # Lights of one name, such as the sides of a sky, share their rays.
    pairs = extraction.film.coverage().sum() * len({light.name for light in extraction.lights})
    affordable = SHADOWS_SHARE * options.budget / max(SOFT_SHARE * RAY_SECONDS * pairs, 1e-9)
    return int(np.clip(affordable, SHADOW_RAYS[0], options.shadow_rays))


@dataclass(frozen=True)
class _Part:
    """One pass of ours, and where it takes the place of Cycles' direct light, which is `light` times `color`."""

    image: np.ndarray  # (H, W, 3), black elsewhere
    groups: dict[str, np.ndarray]  # the same by light group
    is_taken: np.ndarray  # (H, W) bool
    certain: np.ndarray  # (H, W) smooth share of Cycles' direct light that it takes the place of there
    light: np.ndarray  # (H, W, 3)
    color: np.ndarray  # (H, W, 3)
    weight: np.ndarray | float = 1.0  # (H, W) beside the picture with Cycles' direct light in its place, denoised

    @property
    def share(self) -> np.ndarray:
        """What share (H, W) of Cycles' direct light it takes the place of."""
        return np.where(self.is_taken, self.certain * self.weight, 0.0)

    @property
    def direct(self) -> np.ndarray:
        """The share of Cycles' direct light (H, W, 3) that it takes the place of, or would where it does not."""
        return _share_of(self.certain, self.light.astype(np.float64) * self.color)

    @property
    def replaced(self) -> np.ndarray:
        """What of Cycles (H, W, 3) it takes the place of."""
        return np.where(self.is_taken[..., None], self.direct, 0.0)

    def share_of_group(self, group: str) -> np.ndarray:
        """What share (H, W, 3) of it is the light of a light group."""
        return np.divide(self.groups[group], self.image, out=np.zeros_like(self.image), where=self.image != 0.0)


def _share_of(share: np.ndarray, image: np.ndarray) -> np.ndarray:
    """A share (H, W) of an image (H, W, 3), black where it is 0, whatever is there."""
    return np.where(share[..., None] > 0.0, share[..., None] * image, 0.0)


def _certain(shadows: lighting.Shadows, name: str) -> np.ndarray:
    """Share (H, W) of a pass that is not left to the denoiser for the noise of its shadows, smooth over the picture."""
    light, variance = (_around(image) for image in (np.square(shadows.light[name]), shadows.variance[name]))
    noise = np.sqrt(np.divide(variance, light, out=np.zeros_like(light), where=light > 0.0))
    return _around(np.clip(2.0 - noise / MOST_NOISE, 0.0, 1.0))


def _beside_points(film, radiance: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The weight (H, W) of our `radiance` (P,) beside Cycles' own (H, W): 0 where its samples tell more.

    Highlights thinner than a pixel need many. The variance of ours is that of the points of a pixel, by their number,
    but for a slope, of which even few points find the mean; that of both is how much the pictures differ.
    """
    whole, (variance, mean) = film.image(radiance), _of_points(film, radiance)
    slope = sum(np.square(one) for one in np.gradient(mean)) if min(mean.shape) > 1 else 0.0
    variance = np.maximum(variance - SLOPE * slope, 0.0) / max(film.sub_samples - 1, 1)
    variance = _around(np.where(film.has_more(), 0.0, variance))
    both = _around(np.square(direct.astype(np.float64) - whole))
    share = np.divide(variance, both, out=np.zeros_like(both), where=both > 0.0)
    least, most = FEW_POINTS
    return _around(((most - share) / (most - least)).clip(0.0, 1.0))


def _of_points(film, radiance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variance and mean (H, W) of the `radiance` (P,) of the points of each pixel."""
    hits = film.unspread()
    if film.first is not None:
        radiance, hits = np.bincount(np.cumsum(film.first) - 1, radiance), hits.take(film.first)
    mean = hits.image(radiance)
    return np.maximum(hits.image(np.square(radiance)) - np.square(mean), 0.0), mean


def _seen(extraction, result, name: str) -> np.ndarray:
    """The light (P,) of a pass, of all lights and colors, that the samples show."""
    return extraction.exposure * getattr(result.shading, name).sum(axis=0).mean(axis=-1)


def _around(image: np.ndarray, around: int = AROUND) -> np.ndarray:
    """Means (H, W) over squares of 2 `around` + 1 pixels."""
    side = 2 * around + 1
    sums = np.pad(image, ((around + 1, around), (around + 1, around)), mode="edge").cumsum(axis=0).cumsum(axis=1)
    whole = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return np.maximum(whole, 0.0) / side**2


def _beside(ours: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The weight (H, W) of a pass of ours (H, W, 3) beside Cycles' own: half of it at edges, but where much more than
    those is between both, which is noise of Cycles."""
    bend = _bend(ours.mean(axis=-1))
    between = _around(np.square((ours - direct).mean(axis=-1)), AROUND_EDGE)
    edge = _around(np.square(EDGE_ERROR * bend), AROUND_EDGE)
    return 1.0 - 0.5 * np.minimum(np.divide(edge, between, out=np.zeros_like(edge), where=between > 0.0), 1.0)


def _taken(comparison: picture.Comparison, cycles, is_denoised: bool) -> dict[str, _Part]:
    """Ours by pass; where all else is denoised, what is too noisy is left to that."""
    kept, found = comparison.extraction.kept, {}
    shape = comparison.film.height, comparison.film.width
    keeps_all = bool(cycles.everything or kept.everything)
    result = next(iter(comparison.results.values()), None)
    for name, (light, color) in DIRECT.items():
        image, groups = np.zeros((*shape, 3)), {}
        is_taken, certain, weight = np.zeros(shape, bool), np.ones(shape), 1.0
        light, color = (read_layer(cycles.channels, cycles.names[key], "RGB") for key in (light, color))
        if result is not None and not keeps_all:
            is_taken = ~kept.by_pass[name]
            # With depth of field ours is denoised as well.
            if is_denoised and not comparison.extraction.has_lens:
                certain = _certain(comparison.shadows, name)
            image = comparison.images[next(iter(comparison.results)), name]
            if is_denoised and not comparison.extraction.has_lens and name == "specular":
                radiance = _seen(comparison.extraction, result, name)
                certain = certain * _beside_points(comparison.film, radiance, (light * color).mean(axis=-1))
            elif is_denoised and not comparison.extraction.has_lens:
                of_cycles = _share_of(certain, light.astype(np.float64) * color)
                weight = _beside(certain[..., None] * image, of_cycles)
                weight = np.where(comparison.film.has_more(), 1.0, weight)
            share = np.where(is_taken, certain * weight, 0.0)
            values = comparison.extraction.exposure * getattr(result.shading, name)
            own = map(comparison.film.image, values) if len(values) > 1 else (image,)
            groups = {group: _share_of(share, one) for group, one in zip(result.shading.groups, own, strict=True)}
            image = _share_of(share, image)
        found[name] = _Part(image, groups, is_taken, certain, light, color, weight)
    return found


def _rest(
    cycles, ours: dict[str, _Part], extraction, denoise: str, progress
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], str, list[str]]:
    """What is not ours (H, W, 4), denoised; of that Cycles' diffuse light at edges (H, W, 3); all of it by light group,
    and by "" of what is in none; the name of the denoiser ("" for none), and what was wrong with it."""
    from ..blender.process.blender_process import denoiser_libraries

    if progress is not None and progress("denoise", 0.0) is False:
        raise Cancelled("stopped before the picture was denoised")
    rest, is_noisy = read_layer(cycles.channels, "Combined", "RGBA").astype(np.float64), extraction.has_lens
    shining = _shining(cycles, extraction)
    # Second, with the diffuse light of Cycles, of which edges have a part.
    taken = np.stack([ours["specular"].is_taken, ours["diffuse"].is_taken, shining.is_taken], axis=-1)
    taken = np.stack([taken, taken & [True, np.ndim(ours["diffuse"].weight) == 0, True]])
    ways, way = np.unique(taken.reshape(-1, taken.shape[-1]), axis=0, return_inverse=True)
    groups = sorted(
        {key.rpartition(".")[0].removeprefix(OF_GROUP) for key in cycles.channels if key.startswith(OF_GROUP)}
    )
    # Each way to take passes for the whole picture: denoised together, one would bleed into another at its borders.
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
    # What of ours went through the denoiser too.
    rest[..., :3] -= sum(part.image for part in ours.values()) if is_noisy else 0.0
    of_groups = dict(zip(groups, found[len(ways) :], strict=True))
    for group in of_groups.keys() & ours["diffuse"].groups.keys():
        of_groups[group] = of_groups[group] + ours["diffuse"].share_of_group(group) * left
    return rest, left, _shared_out(rest, of_groups, is_clean=bool(name)), name, problems


def _shining(cycles, extraction) -> _Part:
    """What shines in sight, where no noise is in the way of it: that of surfaces that some light passes."""
    names = {key: cycles.names[key] for key in cycles.shining}
    own = sum((read_layer(cycles.channels, name, "RGB") for name in names.values()), np.zeros((1, 1, 3)))
    kept = extraction.kept
    is_hidden = np.logical_and.reduce([*kept.by_pass.values()])
    if not names or extraction.has_lens or cycles.everything or kept.everything:
        is_hidden = np.ones_like(is_hidden)
    image = sum(cycles.shining.values(), np.zeros_like(own))
    image = np.where(is_hidden[..., None], 0.0, image)
    return _Part(image, {}, ~is_hidden, np.ones(is_hidden.shape), own, np.ones(3))


def _without_taken(combined: np.ndarray, parts: list[_Part], way: np.ndarray, is_noisy: bool) -> np.ndarray:
    """Cycles' picture (H, W, 3) without its light of the `parts` that are taken one `way`, on all pixels; with
    ours in its place, where that is noisy and there."""
    left = combined.copy()
    for part, is_taken in zip(parts, way, strict=True):
        if is_taken and is_noisy:
            left += np.where(part.is_taken[..., None], part.image - part.direct, 0.0)
        elif is_taken:
            left -= part.direct
    return left


def _rest_of_group(cycles, ours: dict[str, _Part], group: str) -> np.ndarray:
    """What is not ours (H, W, 3) of the light of a light group."""
    found = read_layer(cycles.channels, f"{OF_GROUP}{group}", "RGB").astype(np.float64)
    for part in ours.values():
        if group in part.groups:
            found -= part.share_of_group(group) * part.replaced
    return found


def _shared_out(rest: np.ndarray, groups: dict[str, np.ndarray], is_clean: bool) -> dict[str, np.ndarray]:
    """`groups` (H, W, 3), and by "" what they leave of `rest` (H, W, 4): of what is clean never more than there is."""
    if is_clean and groups:
        whole = np.maximum(sum(groups.values()), 1e-30)
        groups = {name: one * np.clip(rest[..., :3] / whole, 0.0, 1.0) for name, one in groups.items()}
    left = rest.copy()
    for one in groups.values():
        left[..., :3] -= one
    return {"": left, **groups}


def _kept(ours: dict[str, _Part], rests: dict[str, np.ndarray], of_edges: np.ndarray) -> dict:
    """`rest`, `taken` and `edges` of a KeptPicture: Cycles' part of an edge depends on the lights as ours does."""
    taken = {name: np.where(part.is_taken, part.certain, 0.0) for name, part in ours.items()}
    part = ours["diffuse"]
    if np.ndim(part.weight) == 0:
        return {"rest": rests, "taken": taken, "edges": {}}
    light = part.image.mean(axis=-1)
    more = np.divide(of_edges.mean(axis=-1), light, out=np.zeros_like(light), where=light > 0.0)
    more = np.clip(more, 0.0, MOST_OF_EDGE)
    # What is left in the rest stays as it is: of other colors, or where ours is dark.
    of_lights, rest = more[..., None] * part.image, {group: one.copy() for group, one in rests.items()}
    for group in rest.keys() & part.groups.keys() - {""}:
        own = part.share_of_group(group) * of_lights
        rest[group] -= own
        rest[""][..., :3] += own
    rest[""][..., :3] -= of_lights
    return {"rest": rest, "taken": taken, "edges": {"diffuse": part.weight * (1.0 + more)}}


def _layers(comparison: picture.Comparison, ours: dict[str, _Part]) -> dict[str, np.ndarray]:
    """Ours by the names of layers, also by light group where there are several."""
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


def _replaced(cycles, ours: dict[str, _Part], rests: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The channels of Cycles, but for its noisy Combined, with ours in place of its direct light."""
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


def _report(comparison: picture.Comparison, cycles, ours: dict[str, _Part], problems: list[str]) -> dict:
    """That of a picture, and under "finished" what came from where."""
    kept = comparison.extraction.kept
    everything = [*cycles.everything, *kept.everything]
    warnings = [*cycles.warnings, *kept.warnings, *problems]
    if comparison.shadows is not None:
        warnings += comparison.shadows.warnings
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
        "ltsh:frame": str(extraction.frame),
        "ltsh:camera": extraction.camera,
        "ltsh:version": made.report["versions"]["ltsh"],
        "ltsh:exposure": repr(extraction.exposure),
        "ltsh:color_space": extraction.color_space.name,
    }
    planes = {}
    for name, pixels in {picture.COMBINED: made.combined, **made.ours, REST: made.rest}.items():
        planes |= imaging.Layer(pixels).planes(name)
    planes |= made.channels
    write_channels(path, planes, metadata, imaging.chromaticities(extraction.color_space), extraction.pixel_aspect)


def summary(report: dict, seconds: dict) -> list[str]:
    """What one picture is made of, and how long it took."""
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
    """A line for one picture of several."""
    return [f"{report['name']:<32} frame {report['frame']}, camera {report['camera']}"]
