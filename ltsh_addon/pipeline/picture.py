"""Pictures of techniques, alone or beside Cycles: from a .blend to the files, and the lines about them."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ..files import save_array, temporary_folder, write_bytes
from ..reading import NUMBER, check, some
from ..scene import PASSES, Progress
from . import lighting
from .comparison import Comparison, most_accurate, percent, unbiased
from .lighting import check_named, evaluated, prepare
from .options import PictureOptions, child_job
from .relight import RELIGHT_SUFFIX, write_relight_data
from .tasks import TaskResult, write_reports

SHOWN = "shown.png"  # temporary


def shade_scene(options: PictureOptions, progress: Progress | None = None) -> dict:
    """Shade a scene per pixel and write shade.exr, shade.png, report.json and timing.json.

    Returns the report, with the times under "seconds". Raises SceneError, TableError, OSError, Cancelled.
    """
    return write_reports(make_picture(options, False, progress), options.output)


def compare_scene(options: PictureOptions, progress: Progress | None = None) -> dict:
    """As `shade_scene`, with Cycles beside the techniques: writes compare.exr, compare.png and report.html."""
    return write_reports(make_picture(options, True, progress), options.output)


def make_picture(options: PictureOptions, with_cycles: bool, progress: Progress | None = None) -> TaskResult:
    """Shade one picture, beside Cycles where asked for, and write all its files except report.json.

    Raises as `shade_scene` does.
    """
    from ..blender.process.blender_process import kept_blender

    if with_cycles and options.cycles_samples < 2:
        raise ValueError(f"cycles_samples is {options.cycles_samples}, expected at least 2: one for each half")
    if options.keep_visibility:
        check_named(options.techniques, "with keep_visibility, relight")
    start = time.perf_counter()
    tables = prepare(options)
    with ExitStack() as stack:
        folder = None
        if not with_cycles:
            # One Blender for both: it extracts the samples and makes the PNG of the picture.
            folder = stack.enter_context(temporary_folder())
            stack.enter_context(kept_blender(folder))
        extraction = _extracted(options, with_cycles, progress)
        shadows = None
        if extraction.occluders is not None:
            shadows = lighting.trace_shadows(extraction, options.passes, options.shadow_rays, progress)
        results = evaluated(tables, extraction, shadows, options, progress)
        comparison = Comparison(options, extraction, results, shadows)
        png = None
        if folder is not None:
            pixels = comparison.whole(most_accurate(comparison.results))
            png = view_transformed(pixels, options, folder, progress)
    report, output = comparison.report(), Path(options.output)
    files = comparison.write(output, report, with_cycles, progress)
    if png is not None:
        files.append(Path(files[0]).with_suffix(".png").as_posix())
        write_bytes(output / files[-1], png)
    if options.keep_visibility:
        path = (output / files[0]).with_suffix(RELIGHT_SUFFIX)
        written = write_relight_data(extraction, shadows, options, path)
        files += [path.relative_to(output).as_posix() for path in written]
    return TaskResult(report, {**comparison.seconds(), "total": time.perf_counter() - start}, tuple(files))


def _extracted(options: PictureOptions, with_cycles: bool, progress):
    """The `Extraction` of a scene: samples and lights, with Cycles' picture where asked for."""
    from ..blender.process import client

    width, height = options.resolution or (None, None)
    samples = options.cycles_samples if with_cycles else 0
    rest = set(PASSES) <= set(options.passes)
    job = child_job(client.ExtractOptions, options, width=width, height=height, cycles_samples=samples, rest=rest)
    return client.extract(job, progress=progress)


def view_transformed(pixels: np.ndarray, options, folder: Path, progress) -> bytes:
    """PNG bytes of `pixels` (H, W, 4) through the view transform of the scene; `folder` is temporary."""
    from ..blender.process import client

    save_array(folder / client.PICTURE, pixels.astype(np.float32))
    client.show_finished(Path(options.scene), (None, options.frame), folder, SHOWN, progress=progress)
    return (folder / SHOWN).read_bytes()


_ERRORS = {"relative_l2?": NUMBER | None}
_ROW = {
    "against_cycles?": {"unbiased_relative_error?": NUMBER | None, "unbiased_squared_error?": NUMBER | None},
    "against_reference?": {**_ERRORS, "metals?": _ERRORS, "dielectrics?": _ERRORS},
}


def _shadows(value, name) -> None:
    """Check for the document of `Shadows.report`, or null."""
    if value is not None:
        check(value, {"noise": {str: NUMBER}}, name)


# What `merge`, a baseline and a summary need in a report (see `reading.check`).
REPORT = {
    "scene": str,
    "camera": str | None,
    "frame": int,
    "reference": dict | None,
    "resolution": list,
    **dict.fromkeys(("warnings", "problems?"), [str]),
    **dict.fromkeys(("sub_samples", "cycles_samples", "surface_samples"), int),
    "versions": dict,
    "shadows?": _shadows,
    "passes": some({str: {"noise?": NUMBER | None, "techniques": {str: _ROW}}}),
}


def _seconds(value, name) -> None:
    """Check for a number, or nested dicts of numbers."""
    check(value, {str: _seconds} if isinstance(value, dict) else NUMBER, name)


# The seconds of a picture or a bake (see `reading.check`).
SECONDS = {"techniques?": {str: {str: NUMBER}}, str: _seconds}


def summary(report: dict, seconds: dict) -> list[str]:
    """Lines of text about one picture: errors and seconds per pass and technique."""
    lines, shadows = [], report.get("shadows")
    for pass_name, figures in report["passes"].items():
        noise = f", noise of Cycles {percent(figures['noise'])}" if "noise" in figures else ""
        noise += f", of our shadows {percent(shadows['noise'].get(pass_name))}" if shadows else ""
        lines.append(f"{pass_name}{noise}")
        heads = f"{'vs Cycles':>12}{'vs reference':>14}{'metals':>10}{'dielectrics':>13}{'s':>8}"
        lines.append(f"  {'technique':<12}{heads}")
        for name, row in figures["techniques"].items():
            reference = row.get("against_reference", {})
            classes = [percent(reference.get(label, {}).get("relative_l2")) for label in ("metals", "dielectrics")]
            cycles, truth = unbiased(row.get("against_cycles", {})), percent(reference.get("relative_l2"))
            errors = f"{cycles:>12}{truth:>14}{classes[0]:>10}{classes[1]:>13}"
            took = seconds.get("techniques", {}).get(name, {}).get(pass_name)
            lines.append(f"  {name:<12}{errors}" + (f"{took:>8.2f}" if took is not None else f"{'-':>8}"))
    return lines


def brief(report: dict) -> list[str]:
    """One line about a picture: the errors of one pass, against Cycles where possible, else the reference."""
    passes = report["passes"]
    pass_name = "specular" if "specular" in passes else next(iter(passes))
    errors = []
    for name, row in passes[pass_name]["techniques"].items():
        if "against_cycles" in row:
            errors.append(f"{name} {unbiased(row['against_cycles'])}")
        elif "against_reference" in row:
            errors.append(f"{name} {percent(row['against_reference'].get('relative_l2'))}")
    return [f"{report['name']:<32}" + (f" {pass_name}: " + ", ".join(errors) if errors else "")]
