"""Finished pictures: LTSH's direct light, and everything else by Cycles, denoised. `compositing` joins them.

LTSH's light is a specular and a diffuse picture, which replace Cycles' direct light pixel by pixel. Where LTSH does not
shade as Cycles does, they are black and Cycles' light stays: no light counts twice, and none is lost.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging
from ..cycles.gbuffer import with_one_shadow
from ..files import temporary_folder, write_bytes
from ..imaging import exr
from ..imaging.exr import write_channels
from ..scene import PASSES, Progress, listed
from ..visibility import ShadowSampling
from . import compositing, plan
from .comparison import Comparison
from .lighting import Shadows, ShadowTracer, evaluated, load_tables, rays_of_samples
from .options import PictureOptions, RenderOptions, child_job
from .picture import view_transformed
from .relight import RELIGHT_SUFFIX, write_relight_data
from .tasks import TaskResult, check_before_writing, write_reports

NAMED = 8  # of what is left to Cycles, in a warning
PROBE_SEED = 8


@dataclass(frozen=True)
class Finished:
    """A finished picture, row 0 on top, in scene-referred radiance times the exposure."""

    combined: np.ndarray  # (H, W, 4)
    rest: np.ndarray  # (H, W, 4), what is not LTSH's direct light
    ours: dict[str, np.ndarray]  # (H, W, 3) LTSH's direct light by layer: ltsh4.specular, ltsh4.specular@Key, ...
    channels: dict[str, np.ndarray]  # (H, W) of Cycles' passes, with LTSH's light in place of its direct light
    report: dict
    seconds: dict[str, Any]
    relight_data: dict[str, dict[str, np.ndarray]]  # `rest`, `taken` and `edges` of a RelightData
    comparison: Comparison
    cycles: Any  # blender.process.finished.CyclesPicture


def render_scene(options: RenderOptions, progress: Progress | None = None) -> dict:
    """Write render.exr, render.png, report.json and timing.json of a scene.

    Returns the report, with times as "seconds". Raises SceneError, TableError, OSError, Cancelled.
    """
    return write_reports(make_finished(options, progress), options.output)


def make_finished(options: RenderOptions, progress: Progress | None = None) -> TaskResult:
    """Finish one picture and write its files but report.json. Raises as `render_scene` does."""
    from ..blender.process.blender_process import shared_blender

    with temporary_folder() as folder, shared_blender(folder):
        picture = finish(options, progress)
        png = view_transformed(picture.combined, options, folder, progress)
    check_before_writing(progress)
    name, extraction = options.name or "render", picture.comparison.extraction
    path = Path(options.output) / f"{name}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = {}
    for layer, pixels in {exr.COMBINED: picture.combined, **picture.ours, exr.REST: picture.rest}.items():
        planes |= imaging.Layer(pixels).planes(layer)
    metadata = exr.metadata_of(extraction, options.scene)
    chromaticities = imaging.chromaticities(extraction.picture.color_space)
    write_channels(path, planes | picture.channels, metadata, chromaticities, extraction.picture.pixel_aspect)
    write_bytes(path.with_suffix(".png"), png)
    files = [f"{name}.exr", f"{name}.png"]
    if options.keep_visibility:
        path, comparison = path.with_name(f"{path.stem}{RELIGHT_SUFFIX}"), picture.comparison
        shaded = extraction, comparison.shadows, comparison.options
        written = write_relight_data(*shaded, path, **picture.relight_data)
        files += [one.relative_to(options.output).as_posix() for one in written]
    return TaskResult(picture.report, picture.seconds, tuple(files))


def finish(
    options: RenderOptions,
    progress: Progress | None = None,
    *,
    scene_name: str | None = None,
    view_layer: str | None = None,
    shaded: Callable[[Comparison], None] = lambda comparison: None,
) -> Finished:
    """The finished picture of a scene and view layer, by default those of the file. Raises as `render_scene` does.

    `shaded` is called with the direct light before Cycles begins.
    """
    from ..blender.process.blender_process import shared_blender

    start, clock = time.perf_counter(), _ProcessorClock()
    scene_and_layer = {"scene_name": scene_name, "view_layer": view_layer}
    with temporary_folder() as folder, shared_blender(folder):
        timed = _TimedCycles(options, scene_and_layer, folder, clock, progress)
        comparison = shade_direct_light(options, scene_and_layer, timed, progress)
        extraction = comparison.extraction
        shaded(comparison)
        cycles = timed.picture(extraction)
        passes = compositing.direct_passes(comparison, cycles)
        picture = compositing.composite(cycles, passes, extraction, options.denoise, progress)
        clock.end("denoise")
        report = _report(comparison, cycles, picture)
        report["finished"] |= {"denoiser": picture.denoiser, "budget_s": options.budget}
        report["finished"]["gain"] = _gain(picture)
        if not np.any(picture.combined[..., :3]):
            report["warnings"].append(
                f"camera {cycles.camera!r} sees no light at all, by Cycles neither: the picture is black; add a light, "
                "or let the world shine"
            )
        # The least is to start Blender, open the file, render the first samples of Cycles, and denoise.
        opening = extraction.times.processor - extraction.times.direct
        least = opening + cycles.begun["least"] + clock.stages["denoise"]
        report["warnings"] += plan.over_budget(options.budget, clock.seconds(), least)
        report["warnings"] = imaging.grouped(report["warnings"])
        seconds = {
            **comparison.seconds(),
            "processor": {**clock.stages, "total": clock.seconds()},
            "total": time.perf_counter() - start,
        }
    ours = compositing.direct_layers(comparison, picture.passes)
    channels = compositing.cycles_channels(cycles, picture)
    written = picture.combined, picture.rest, ours, channels, report, seconds, compositing.relight_fields(picture)
    return Finished(*written, comparison, cycles)


class _TimedCycles:
    """Cycles' part of one finished picture, in the processor time that is left of a budget."""

    def __init__(self, options: RenderOptions, scene_and_layer: dict, folder: Path, clock, progress):
        self._options, self._scene_and_layer, self._folder = options, scene_and_layer, folder
        self.clock, self._progress, self._begun = clock, progress, None

    def seconds_left(self, extraction=None) -> float | None:
        """The processor seconds of the budget before denoising; without an extraction, of the whole budget."""
        pixels = denoisings = 0
        if extraction is not None:
            pixels, denoisings = extraction.film.width * extraction.film.height, compositing.most_denoisings(extraction)
        return plan.seconds_before_denoising(self._options.budget, self.clock.seconds(), pixels, denoisings)

    @cached_property
    def first_samples(self):
        """The `CyclesPicture` of some samples, which `picture` goes on with."""
        picture = self._rendered(begins=True)
        self._begun = picture.begun
        return picture

    def measured(self, extraction, points: int, **more) -> plan.SceneMeasurements:
        """What the first samples tell of direct light with so many `points` per pixel."""
        from ..blender.process.pixels import EDGE_SECONDS

        cycles, film, by_pass = self.first_samples, extraction.film, extraction.left_to_cycles.by_pass
        errors = self._errors(by_pass) if any(mask.any() for mask in by_pass.values()) else self._errors_of_all
        return plan.SceneMeasurements(
            seconds_left=self.seconds_left(extraction),
            edge_seconds=EDGE_SECONDS * film.width * film.height / 1e6,
            points=points,
            has_lens=extraction.picture.has_lens,
            needs_all=self._options.needs_each_light,
            cycles_samples=cycles.samples,
            sample_seconds=cycles.begun["each"],
            squares=plan.Squares(errors) if errors else None,
            **more,
        )

    def _errors(self, by_pass) -> compositing.FirstErrors | None:
        return compositing.first_errors(self.first_samples, by_pass, self._options.denoise, self._progress)

    @cached_property
    def _errors_of_all(self) -> compositing.FirstErrors | None:
        """Where LTSH would replace all direct light: before a look at the lights, and often after it."""
        return self._errors(dict.fromkeys(PASSES, np.zeros((), bool)))

    def picture(self, extraction):
        """The whole `CyclesPicture`."""
        return self._rendered(extraction, begun=self._begun)

    def _rendered(self, extraction=None, **more):
        from ..blender.process.finished import FinishedJob, render_finished

        width, height = self._options.resolution or (None, None)
        edges = extraction and not (extraction.picture.has_lens or extraction.left_to_cycles.everything)
        size = {"width": width, "height": height, "seconds": self.seconds_left(extraction), "edges": bool(edges)}
        job = child_job(FinishedJob, self._options, **self._scene_and_layer, **size, **more)
        picture = render_finished(job, self._folder, progress=self._progress)
        self.clock.end("cycles", picture.processor_seconds)
        return picture


def shade_direct_light(options: RenderOptions, scene_and_layer: dict, timed: _TimedCycles, progress) -> Comparison:
    """The direct light by the technique, with shadows; without results where all of it is left to Cycles.

    `scene_and_layer` are fields of the child's job. With a budget Cycles' first samples tell whether it is worth a look
    at the lights.
    """
    from ..blender.process.pixels import PixelJob, RenderedPixels, ended_at_horizons, with_points

    tables, clock = load_tables(options.techniques), timed.clock
    width, height = options.resolution or (None, None)
    most = plan.most_points(options)
    picture = child_job(PictureOptions, options, passes=PASSES, sub_samples=most or 1, shadows="on", cycles_samples=2)
    job = child_job(
        PixelJob,
        picture,
        **scene_and_layer,
        width=width,
        height=height,
        sub_samples=most,
        cycles_samples=0,
        for_finished=True,
        own_groups=options.own_groups,
    )
    with temporary_folder() as folder:
        if options.budget is not None:
            extraction = RenderedPixels(job, folder, timed.first_samples.pixels).extraction()
            reasons = None if options.needs_each_light else _reasons_not_to_look(timed, extraction, options)
            clock.end("choice")
            if reasons is not None:
                return Comparison(picture, extraction.by_cycles(*reasons), {}, None)
            job = replace(job, seconds=timed.seconds_left(extraction))
        rendered = RenderedPixels.of(job, folder, progress)
        extraction = rendered.extraction(None if options.budget is None else 1)
        clock.end("extraction", extraction.times.processor)
        if not extraction.lights or extraction.left_to_cycles.everything:
            return Comparison(picture, extraction, {}, None)
        with ShadowTracer(extraction.occluders, extraction.lights) as tracer:
            shader = DirectLightShader(picture, options.budget, tables, tracer)
            if options.budget is None or not len(extraction.samples):
                extraction = with_points(extraction, extraction.film.sub_samples)
            else:
                extraction = shader.planned(rendered, extraction, timed)
            if extraction.left_to_cycles.everything:
                return Comparison(picture, extraction, {}, None)
            extraction = ended_at_horizons(extraction, progress)
            clock.end("extraction")
            shadows = shader.shadows(extraction, progress)
            clock.end("shadows")
            comparison = shader.shaded(extraction, shadows, progress)
            clock.end("shading")
    return comparison


def _reasons_not_to_look(timed: _TimedCycles, extraction, options: RenderOptions) -> tuple[str, ...] | None:
    """Why direct light is left to Cycles without a look at the lights, beside Cycles' own reasons; None: it is not."""
    from ..blender.process.pixels import START_SECONDS, TOO_LITTLE_TIME, affordable_points

    pixels = extraction.film.width * extraction.film.height
    points = min(affordable_points(timed.seconds_left(extraction), pixels, 1), plan.most_points(options))
    if timed.first_samples.everything or not points:
        return () if timed.first_samples.everything else (TOO_LITTLE_TIME,)
    reason = plan.direct_light_plan(timed.measured(extraction, points, look_seconds=START_SECONDS)).reason
    return (reason,) if reason else None


@dataclass(frozen=True)
class DirectLightShader:
    """Shades the direct light of one scene."""

    options: PictureOptions
    budget: float | None
    tables: dict
    tracer: ShadowTracer

    def shadows(self, extraction, progress=None) -> Shadows:
        """The visibility of the lights from the samples. Points of a pixel with about the same view share rays."""
        samples, film, index = extraction.samples, extraction.film, slice(None)
        if not extraction.picture.has_lens:
            samples, film, index = with_one_shadow(samples, film)
        # Lights of one name, such as the sides of a sky, have common rays.
        pairs = film.coverage().sum() * len({light.name for light in extraction.lights})
        rays = rays_of_samples(plan.shadow_rays(self.options.shadow_rays, self.budget, pairs), film)
        return self.tracer.trace(samples, ShadowSampling(PASSES, rays, film), progress=progress).take(index)

    def shaded(self, extraction, shadows: Shadows, progress=None) -> Comparison:
        """The samples of an extraction, shaded with these shadows."""
        results = evaluated(self.tables, extraction, shadows, self.options, progress, self.tracer.pool)
        return Comparison(self.options, extraction, results, shadows)

    def planned(self, rendered, first, timed: _TimedCycles):
        """The extraction of the points and squares of the `DirectLightPlan`, which may leave everything to Cycles.

        `first` is the extraction of the first point of each pixel.
        """
        from ..blender.process.pixels import in_pixels, with_points

        measured = timed.measured(first, len(rendered.manifest["samples"]))
        chosen = plan.direct_light_plan(measured)
        if chosen.needs_probe:
            # Warnings are about the whole picture.
            extraction = rendered.extraction(where=measured.squares.pixels(slice(chosen.squares)))
            extraction = replace(extraction, warnings=first.warnings, problems=first.problems)
            probe = self.probe(extraction, measured.points, measured.squares, chosen.squares)
            chosen = plan.direct_light_plan(replace(measured, probe=probe))
        timed.clock.end("choice")
        if chosen.reason:
            return first.by_cycles(chosen.reason)
        extraction = in_pixels(extraction, measured.squares.pixels(slice(chosen.squares)))
        return with_points(extraction, chosen.points_per_pixel)

    def probe(
        self, extraction, points: int, squares: plan.Squares, count: int, share: float = plan.PROBE_SHARE
    ) -> plan.Probe:
        """Shades squares that have a `share` of the samples, chosen at random by what LTSH wins there.

        `extraction` has all `points` per pixel of the first `count` of the squares.
        """
        from ..blender.process.pixels import ended_at_horizons, with_points

        of_one_point = squares.sums(pixels=extraction.film.pixel[extraction.points.number == 0])
        extraction = with_points(extraction, points)
        film = extraction.film
        samples = squares.sums(pixels=film.pixel)
        # By races whose rates are the weights (Efraimidis and Spirakis 2006).
        weight = np.where(samples > 0, np.maximum(squares.gain, plan.LEAST_WEIGHT * squares.whole), 0.0)
        race = np.random.default_rng(PROBE_SEED).exponential(size=len(weight))
        order = np.argsort(np.divide(race, weight, out=np.full(len(weight), np.inf), where=weight > 0.0))
        most = 1 + np.searchsorted(np.cumsum(samples[order]), share * len(film.pixel))
        order = order[: min(most, np.count_nonzero(weight))]
        if not len(order):
            return plan.Probe(0, 0.0, np.zeros(0), of_one_point[:count], samples[:count])
        # The first square makes what all others have, such as maps of skies.
        for chosen in order[:1], order:
            start = time.process_time()
            mask = squares.pixels(chosen).ravel()[film.pixel]
            some = replace(extraction, samples=extraction.samples.take(mask), film=film.take(mask))
            some = ended_at_horizons(some)
            comparison = self.shaded(some, self.shadows(some))
        seconds = time.process_time() - start
        variance = compositing.variance_of_points(some, next(iter(comparison.results.values())))
        variances = squares.sums(variance)[order] / weight[order]
        return plan.Probe(int(samples[order].sum()), seconds, variances, of_one_point[:count], samples[:count])


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


def _report(comparison: Comparison, cycles, picture: compositing.Composite) -> dict:
    """The report of a picture, and under "finished" what is LTSH's and what is Cycles'."""
    left_to_cycles = comparison.extraction.left_to_cycles
    everything = [*cycles.everything, *left_to_cycles.everything]
    warnings = [*cycles.warnings, *left_to_cycles.warnings, *picture.problems]
    theirs = "Cycles' own and denoised" if picture.denoiser else "Cycles' own"
    if everything:
        why = listed(everything, NAMED, "; ")
        warnings.append(f"all direct light is {theirs}, because LTSH does not shade: {why}")
    if left_to_cycles.materials and not everything:
        why = listed(left_to_cycles.materials, NAMED, "; ")
        warnings.append(f"direct light on some surfaces is {theirs}: {why}")
    shares = {name: np.where(one.is_replaced, picture.weight, 0.0).mean() for name, one in picture.passes.items()}
    return {
        **comparison.report(),
        "camera": cycles.camera,
        "cycles_samples": cycles.samples,
        "problems": [],
        "warnings": warnings,
        "finished": {
            "share_of_ours": {name: float(share) for name, share in shares.items()},
            "all_by_cycles": everything,
            "materials_by_cycles": list(left_to_cycles.materials),
        },
    }


def _gain(picture: compositing.Composite) -> dict:
    """LTSH's share of the light; the error with half of the samples, and that of Cycles and its denoiser with as many.

    All of them are the same in each run.
    """
    light = sum(one.image.sum() for one in picture.passes.values()) / max(picture.combined[..., :3].sum(), 1e-30)
    error, alone = picture.errors or (None, None)
    return {"share_of_light": float(light), "error": error, "error_of_cycles": alone}


def summary(report: dict, seconds: dict) -> list[str]:
    """Lines about what a picture is made of, and how long it took."""
    finished, (width, height) = report["finished"], report["resolution"]
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in finished["share_of_ours"].items())
    took = f", {seconds['processor']['total']:.1f} s of processor time" if "processor" in seconds else ""
    denoised = f"denoised by {finished['denoiser']}" if finished["denoiser"] else "not denoised"
    light, error, alone = finished["gain"].values()
    gained = ""
    if error is not None and "processor" in seconds:
        # Cycles alone could take all the time for samples.
        more_samples = seconds["processor"]["total"] / seconds["processor"]["cycles"]
        alone *= more_samples ** (0.5 * plan.SAMPLES_POWER)
        gained = f"; error of half the samples {100 * error:.1f} %, of Cycles alone in this time {100 * alone:.1f} %"
    return [
        f"{width}x{height}, {report['sub_samples']} points per pixel, {report['cycles_samples']} samples of Cycles, "
        f"{denoised}{took}",
        f"direct light by LTSH on: {shares} of the pixels, {100.0 * light:.0f} % of the light{gained}",
    ]


def brief(report: dict) -> list[str]:
    """The line for one of several pictures or views."""
    return [f"{report['name']:<32} frame {report['frame']}, camera {report['camera']}"]
