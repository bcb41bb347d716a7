"""Pictures of the viewport without a window: `ltsh view`."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np

from .. import imaging
from ..files import temporary_folder, write_bytes
from ..imaging.color import identified
from ..scene import SHIPPED_TABLES, VERSION, Cancelled, Progress
from . import picture
from .options import ViewOptions, child_job

# Names of times in a report, and in the seconds of a task.
TIMES = {"draw_s": "draw", "refined_s": "refined"}


def draw_view(options: ViewOptions, progress: Progress | None = None) -> picture.TaskResult:
    """Draw a scene as the viewport does and write its EXR and PNG.

    The seconds have "draw": the median of a redraw with the first technique, without rays; "shadows": all rays; and
    "refined": all `refine` redraws and the rays. Raises SceneError, TableError, OSError, Cancelled.
    """
    from ..blender.process.view import VIEW_PASSES, VIEW_PNG, ViewJob, draw_view

    start = time.perf_counter()
    tables = picture.prepare(options)
    width, height = options.resolution or (None, None)
    given = tuple(name if name in SHIPPED_TABLES else str(Path(name).absolute()) for name in options.techniques)
    job = child_job(ViewJob, options, width=width, height=height, techniques=given)
    with temporary_folder() as folder:
        manifest = draw_view(job, folder, progress=progress)
        pictures = {
            name: {part: np.load(folder / f"{number}_{part}.npy") for part in VIEW_PASSES}
            for number, name in enumerate(tables)
        }
        shown = (folder / VIEW_PNG).read_bytes()
    if progress is not None and progress("write", 0.0) is False:
        raise Cancelled("stopped before the files were written")
    coverage = next(iter(pictures.values()))["diffuse"][..., 3]
    report = _report(options, tables, manifest, coverage)
    name = options.name or "view"
    layers = {f"{technique}.{part}": image[..., :3] for technique, found in pictures.items()
              for part, image in found.items()}  # fmt: skip
    layers["coverage.hit"] = imaging.Layer(coverage, "V")
    path = options.output / f"{name}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    color_space = identified(manifest["color_space"]["to_rec709"], manifest["color_space"]["name"])
    metadata = {
        "ltsh:scene": Path(options.scene).name,
        "ltsh:frame": str(manifest["frame"]),
        "ltsh:camera": manifest["camera"],
        "ltsh:version": VERSION,
        "ltsh:exposure": repr(manifest["exposure"]),
        "ltsh:color_space": color_space.name,
    }
    imaging.write_layers(path, layers, metadata, imaging.chromaticities(color_space), manifest["pixel_aspect"])
    write_bytes(path.with_suffix(".png"), shown)
    redraws = {name: statistics.median(times) for name, times in zip(tables, manifest["redraws"], strict=True)}
    draw, shadows = next(iter(redraws.values())), (manifest["shadows"] or {"seconds": 0.0})["seconds"]
    seconds = {
        "blender": manifest["seconds"],
        "draw": draw,
        "shadows": shadows,
        "refined": draw * options.refine + shadows,
        "techniques": {name: {"redraw": median} for name, median in redraws.items()},
        "total": time.perf_counter() - start,
    }
    return picture.TaskResult(report, seconds, (f"{name}.exr", f"{name}.png"))


def _report(options: ViewOptions, tables, manifest: dict, coverage: np.ndarray) -> dict:
    """The report of a view: the entries of a picture's report that a view has, and "graphics"."""
    return {
        "scene": str(options.scene),
        "camera": manifest["camera"],
        "frame": manifest["frame"],
        "resolution": [manifest["width"], manifest["height"]],
        "pixel_aspect": manifest["pixel_aspect"],
        "pixel_filter": manifest["pixel_filter"] if options.refine > 1 else "pixel centers",
        "exposure": manifest["exposure"],
        "color_space": manifest["color_space"]["name"],
        "sub_samples": options.refine,
        "surface_samples": int(np.count_nonzero(coverage)),
        "cycles_samples": 0,
        "lights": manifest["lights"],
        "versions": picture.versions(manifest["blender_version"]),
        "graphics": manifest["graphics"],
        "tables": dict(zip(tables, options.techniques, strict=True)),
        "reference": None,
        "shadows": _shadow_facts(manifest["shadows"]),
        "passes": {
            name: {"techniques": {table: {} for table in tables}} for name in ("combined", "specular", "diffuse")
        },
        "problems": [],
        "warnings": manifest["warnings"],
    }


def _shadow_facts(found: dict | None) -> dict | None:
    """The entry of the report about shadows."""
    return None if found is None else {name: found[name] for name in ("rays", "noise", "tracer")}


def with_times(report: dict, seconds: dict) -> dict:
    """The report of one view or of several, with "draw_s" and "refined_s" of each; `seconds` are those of `merge`."""
    if "reports" not in report:
        return {**report, **_times(seconds)}
    reports = [{**one, **_times(seconds.get(one["name"], {}))} for one in report["reports"]]
    drawn = [one["draw_s"] for one in reports if "draw_s" in one]
    return {**report, "reports": reports, **({"draw_s": statistics.median(drawn)} if drawn else {})}


def _times(seconds: dict) -> dict:
    return {name: seconds[key] for name, key in TIMES.items() if key in seconds}


def summary(report: dict, seconds: dict) -> list[str]:
    """One line about a view."""
    times = _times(seconds)
    took = (
        f": a redraw {times['draw_s']:.3f} s, all of {report['sub_samples']} {times['refined_s']:.2f} s"
        if times
        else ""
    )
    return [f"{report['resolution'][0]}x{report['resolution'][1]} on {report['graphics']}{took}"]


def brief(report: dict) -> list[str]:
    """One line about a view of several."""
    return [f"{report['name']:<32} frame {report['frame']}, camera {report['camera']}"]
