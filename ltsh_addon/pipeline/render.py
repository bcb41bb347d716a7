"""Finished pictures: LTSH's direct light, and everything else by Cycles, denoised. `compositing` joins them.

LTSH's light is a specular and a diffuse picture, which replace Cycles' direct light pixel by pixel. Where LTSH does not
shade as Cycles does, they are black and Cycles' light stays: no light counts twice, and none is lost.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging
from ..files import temporary_folder, write_bytes
from ..imaging.exr import write_channels
from ..scene import Progress, listed
from . import compositing, layers, plan
from .comparison import Comparison
from .direct_light import shade_direct_light
from .options import RenderOptions, child_job
from .picture import view_transformed
from .relight import RELIGHT_SUFFIX, write_relight_data
from .tasks import TaskResult, check_before_writing, write_reports

NAMED = 8  # of what is left to Cycles, in a warning


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
    cycles: Any  # blender.process.client.CyclesPicture


def render_scene(options: RenderOptions, progress: Progress | None = None) -> dict:
    """Write render.exr, render.png, report.json and timing.json of a scene.

    Returns the report, with times as "seconds". Raises SceneError, TableError, OSError, Cancelled.
    """
    return write_reports(make_finished(options, progress), options.output)


def make_finished(options: RenderOptions, progress: Progress | None = None) -> TaskResult:
    """Finish one picture and write its files but report.json. Raises as `render_scene` does."""
    from ..blender.process.blender_process import kept_blender

    with temporary_folder() as folder, kept_blender(folder):
        picture = finish(options, progress)
        png = view_transformed(picture.combined, options, folder, progress)
    check_before_writing(progress)
    name, extraction = options.name or "render", picture.comparison.extraction
    path = Path(options.output) / f"{name}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = {}
    for layer, pixels in {layers.COMBINED: picture.combined, **picture.ours, layers.REST: picture.rest}.items():
        planes |= imaging.Layer(pixels).planes(layer)
    metadata = layers.metadata_of(extraction, options.scene)
    chromaticities = imaging.chromaticities(extraction.color_space)
    write_channels(path, planes | picture.channels, metadata, chromaticities, extraction.pixel_aspect)
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
    from ..blender.process import client
    from ..blender.process.blender_process import kept_blender

    start, clock = time.perf_counter(), _ProcessorClock()
    scene_and_layer = {"scene_name": scene_name, "view_layer": view_layer}

    def seconds_left(extraction) -> float | None:
        pixels, denoisings = extraction.film.width * extraction.film.height, compositing.most_denoisings(extraction)
        return plan.seconds_before_denoising(options.budget, clock.seconds(), pixels, denoisings)

    with temporary_folder() as folder, kept_blender(folder):
        comparison = shade_direct_light(options, scene_and_layer, clock, seconds_left, progress)
        extraction = comparison.extraction
        shaded(comparison)
        width, height = options.resolution or (None, None)
        edges = not (extraction.has_lens or extraction.left_to_cycles.everything)
        size = {"width": width, "height": height, "seconds": seconds_left(extraction), "edges": edges}
        job = child_job(client.FinishedJob, options, **scene_and_layer, **size)
        cycles = client.render_finished(job, folder, progress=progress)
        clock.end("cycles", cycles.processor_seconds)
        passes = compositing.direct_passes(comparison, cycles, options.denoise == "on")
        rest = compositing.denoised_rest(cycles, passes, extraction, options.denoise, progress)
        combined = rest.image.copy()
        for one in passes.values():
            combined[..., :3] += one.image
        clock.end("denoise")
        report = _report(comparison, cycles, passes, rest.problems)
        report["finished"] |= {"denoiser": rest.denoiser, "budget_s": options.budget}
        if not np.any(combined[..., :3]):
            report["warnings"].append(
                f"camera {cycles.camera!r} sees no light at all, by Cycles neither: the picture is black; add a light, "
                "or let the world shine"
            )
        # The least is to start Blender, open the file, render the first samples of Cycles, and denoise.
        opening = extraction.processor_seconds - extraction.direct_seconds
        least = opening + cycles.least_seconds + clock.stages["denoise"]
        report["warnings"] += plan.over_budget(options.budget, clock.seconds(), least)
        seconds = {
            **comparison.seconds(),
            "processor": {**clock.stages, "total": clock.seconds()},
            "total": time.perf_counter() - start,
        }
    ours = compositing.direct_layers(comparison, passes)
    channels = compositing.cycles_channels(cycles, passes, rest)
    relight_fields = compositing.relight_fields(passes, rest)
    return Finished(combined, rest.image, ours, channels, report, seconds, relight_fields, comparison, cycles)


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


def _report(comparison: Comparison, cycles, passes: dict, problems: list[str]) -> dict:
    """The report of a picture, and under "finished" what is LTSH's and what is Cycles'."""
    left_to_cycles = comparison.extraction.left_to_cycles
    everything = [*cycles.everything, *left_to_cycles.everything]
    warnings = [*cycles.warnings, *left_to_cycles.warnings, *problems]
    if everything:
        why = listed(everything, NAMED, "; ")
        warnings.append(f"all direct light is Cycles' own and denoised, because LTSH does not shade: {why}")
    if left_to_cycles.materials and not everything:
        why = listed(left_to_cycles.materials, NAMED, "; ")
        warnings.append(f"direct light on some surfaces is Cycles' own and denoised: {why}")
    shares = {name: np.where(one.is_replaced, one.clean_share, 0.0).mean() for name, one in passes.items()}
    return {
        **comparison.report(),
        "camera": cycles.camera,
        "cycles_samples": cycles.samples,
        "problems": [],
        "warnings": list(dict.fromkeys(warnings)),
        "finished": {
            "share_of_ours": {name: float(share) for name, share in shares.items()},
            "all_by_cycles": everything,
            "materials_by_cycles": list(left_to_cycles.materials),
        },
    }


def summary(report: dict, seconds: dict) -> list[str]:
    """Lines about what a picture is made of, and how long it took."""
    finished, (width, height) = report["finished"], report["resolution"]
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in finished["share_of_ours"].items())
    took = f", {seconds['processor']['total']:.1f} s of processor time" if "processor" in seconds else ""
    denoised = f"denoised by {finished['denoiser']}" if finished["denoiser"] else "not denoised"
    return [
        f"{width}x{height}, {report['sub_samples']} points per pixel, {report['cycles_samples']} samples of Cycles, "
        f"{denoised}{took}",
        f"direct light by LTSH on: {shares} of the pixels",
    ]


def brief(report: dict) -> list[str]:
    """The line for one of several pictures or views."""
    return [f"{report['name']:<32} frame {report['frame']}, camera {report['camera']}"]
