"""Pictures of techniques: shaded, beside Cycles, or as the viewport draws them; and the lines about them.

A baseline is the report of an earlier comparison: what got worse since, and where.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from .. import imaging
from ..files import save_array, temporary_folder, write_bytes
from ..imaging.color import identified
from ..imaging.exr import COVERAGE, layer_name, metadata
from ..reading import NUMBER, Malformed, check, read_json, some
from ..scene import PASSES, SHIPPED_TABLES, Progress
from . import lighting
from .comparison import Comparison, most_accurate, percent, unbiased
from .lighting import check_named, evaluated, prepare
from .options import PictureOptions, ViewOptions, child_job
from .relight import RELIGHT_SUFFIX, write_relight_data
from .tasks import TaskResult, check_before_writing, versions, write_reports

SHOWN = "shown.png"  # temporary
# Facts that two comparisons must share for their errors to be comparable.
_SAME = ("resolution", "sub_samples", "cycles_samples", "surface_samples", "reference")
_CLASSES = ("metals", "dielectrics")


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
    from ..blender.process.blender_process import shared_blender

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
            stack.enter_context(shared_blender(folder))
        extraction = _extracted(options, with_cycles, tables, progress)
        shadows = lighting.trace_shadows(extraction, options.passes, options.shadow_rays, progress)
        results = evaluated(tables, extraction, shadows, options, progress)
        comparison = Comparison(
            options, extraction, results, shadows, _transmitted(tables, extraction, options, progress)
        )
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
        written = write_relight_data(comparison.with_still_glass(), shadows, options, path)
        files += [path.relative_to(output).as_posix() for path in written]
    return TaskResult(report, {**comparison.seconds(), "total": time.perf_counter() - start}, tuple(files))


def _transmitted(tables, extraction, options: PictureOptions, progress) -> Comparison | None:
    """What glass shows of the surfaces behind it, shaded; None without glass."""
    behind = extraction.behind
    if behind is None:
        return None
    shadows = lighting.trace_shadows(behind, options.passes, options.shadow_rays, progress)
    return Comparison(options, behind, evaluated(tables, behind, shadows, options, progress), shadows)


def _extracted(options: PictureOptions, with_cycles: bool, tables, progress):
    """The `Extraction` of a scene: samples and lights, with Cycles' picture where asked for."""
    from ..blender.process.pixels import PixelJob, extract_pixels

    width, height = options.resolution or (None, None)
    samples = options.cycles_samples if with_cycles else 0
    rest = set(PASSES) <= set(options.passes)
    job = child_job(PixelJob, options, width=width, height=height, cycles_samples=samples, rest=rest)
    expected = {"passes": options.passes, "rays": options.shadow_rays, "progress": progress}
    return extract_pixels(job, progress=progress, look=partial(lighting.tell_expected, tables=tables, **expected))


def view_transformed(pixels: np.ndarray, options, folder: Path, progress) -> bytes:
    """PNG bytes of `pixels` (H, W, 4) through the view transform of the scene; `folder` is temporary."""
    from ..blender.process.finished import PICTURE, show_finished

    save_array(folder / PICTURE, pixels.astype(np.float32))
    show_finished(Path(options.scene), None, options.frame, folder, SHOWN, progress=progress)
    return (folder / SHOWN).read_bytes()


def draw_view(options: ViewOptions, progress: Progress | None = None, is_playblast: bool = False) -> TaskResult:
    """Draw a scene as the viewport does and write its EXR and PNG; `is_playblast`: it is one of several frames.

    Raises SceneError, TableError, OSError, Cancelled.
    """
    from ..blender.process import view
    from ..blender.process.blender_process import second_blender, shared_blender

    start = time.perf_counter()
    tables = prepare(options)
    width, height = options.resolution or (None, None)
    given = tuple(name if name in SHIPPED_TABLES else str(Path(name).absolute()) for name in options.techniques)
    more = {"techniques": given, "is_playblast": is_playblast}
    job = child_job(view.ViewJob, options, width=width, height=height, **more)
    problems, rest_seconds = [], 0.0
    with temporary_folder() as folder, shared_blender(folder):
        if options.bounces == "on":
            of_camera = view.RestView(frame=options.frame, size=(width, height))
            rest_job = child_job(view.RestJob, options, view=of_camera, samples=options.rest_samples)
            with second_blender() if is_playblast else nullcontext():
                rest = view.render_rest(rest_job, folder, progress=progress)
            job = replace(job, rest=folder / view.REST_PICTURE, is_everything=rest["is_everything"])
            problems, rest_seconds = [rest["problem"]] * bool(rest["problem"]), time.perf_counter() - start
        manifest = view.draw_view(job, folder, progress=progress)
        manifest["warnings"] += problems
        layers = {
            layer_name(technique, pass_name): np.load(folder / f"{number}_{pass_name}.npy")
            for number, technique in enumerate(tables)
            for pass_name in manifest["passes"]
        }
        shown = (folder / view.VIEW_PNG).read_bytes()
    check_before_writing(progress)
    coverage = layers[layer_name(next(iter(tables)), "diffuse")][..., 3]
    report = _view_report(options, tables, manifest, coverage)
    if options.bounces == "on":
        times = {"direct_s": manifest["seconds"], "rest_s": rest_seconds}
        report |= {"rest_samples": options.rest_samples, **{name: round(value, 3) for name, value in times.items()}}
    name = options.name or "view"
    layers = {name: image[..., :3] for name, image in layers.items()} | {COVERAGE: imaging.Layer(coverage, "V")}
    path = options.output / f"{name}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    color_space = identified(manifest["color_space"]["to_rec709"], manifest["color_space"]["name"])
    facts = manifest["frame"], manifest["camera"], color_space.name
    described = metadata(options.scene, *facts, exposure=repr(manifest["exposure"]))
    imaging.write_layers(path, layers, described, imaging.chromaticities(color_space), manifest["pixel_aspect"])
    write_bytes(path.with_suffix(".png"), shown)
    seconds = {"blender": manifest["seconds"], "shadows": (manifest["shadows"] or {"seconds": 0.0})["seconds"]}
    return TaskResult(report, {**seconds, "total": time.perf_counter() - start}, (f"{name}.exr", f"{name}.png"))


def _view_report(options: ViewOptions, tables, manifest: dict, coverage: np.ndarray) -> dict:
    """The report of a view: the entries of a picture's report that a view has, and "graphics"."""
    shadows = manifest["shadows"]
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
        "versions": versions(manifest["blender_version"]),
        "graphics": manifest["graphics"],
        "tables": dict(zip(tables, options.techniques, strict=True)),
        "reference": None,
        "shadows": shadows and {name: shadows[name] for name in ("rays", "noise", "tracer")},
        "passes": {
            name: {"techniques": {table: {} for table in tables}} for name in ("combined", "specular", "diffuse")
        },
        "problems": [],
        "warnings": imaging.grouped(manifest["warnings"]),
    }


def view_summary(report: dict, seconds: dict) -> list[str]:
    """One line about a view."""
    return [f"{report['resolution'][0]}x{report['resolution'][1]} on {report['graphics']}"]


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


@dataclass(frozen=True)
class Tolerance:
    """By how much an error may grow: an absolute number, 0.01 for one percent, or a `relative` share of the error."""

    value: float = 0.001
    relative: bool = False

    def allows(self, before: float, now: float) -> bool:
        """True where `now` is not worse."""
        return now <= before + (self.value * before if self.relative else self.value)

    def __str__(self):
        return f"{100.0 * self.value:g} % of it" if self.relative else percent(self.value)


@dataclass(frozen=True)
class Baseline:
    """The report.json of an earlier comparison."""

    path: Path
    pictures: dict[tuple, dict]  # by scene, camera and frame

    @classmethod
    def read(cls, path: Path) -> "Baseline":
        """Raises OSError where the file is missing, ValueError where it is no report of a comparison."""
        try:
            document = read_json(path)
            check(document, {"reports": [REPORT]} if "reports" in document else REPORT)
        except OSError as error:
            raise OSError(f"baseline {path}: cannot be read ({error.strerror})") from error
        except Malformed as error:
            reason = f"is not the report of a comparison ({error})"
            raise ValueError(f"baseline {path}: {reason}, expected report.json of `ltsh compare`") from None
        pictures = _pictures(document)
        if not pictures:
            raise ValueError(f"baseline {path}: has no errors against Cycles, expected report.json of `ltsh compare`")
        return cls(path, pictures)

    def worse(self, report: dict, tolerance: Tolerance) -> list[str]:
        """A line for each error of `report` that is larger than here by more than the tolerance.

        Raises ValueError where the two cannot be compared: other pictures, sizes, samples, passes or techniques.
        """
        lines = []
        for key, now in _pictures(report).items():
            scene, camera, frame = key
            picture = f"{scene}, camera {camera!r}, frame {frame}"
            before = self.pictures.get(key)
            if before is None:
                raise ValueError(f"baseline {self.path}: has no picture of {picture}; make a baseline of the same job")
            for name in _SAME:
                if not _is_same(name, before[name], now[name]):
                    raise ValueError(
                        f"baseline {self.path}: {name} is {before[name]} for {picture}, but {now[name]} now; "
                        "use the same options, or make a new baseline"
                    )
            earlier = dict(_errors(before))
            for what, error in _errors(now):
                if what not in earlier:
                    raise ValueError(f"baseline {self.path}: has no {what} for {picture}; make a new baseline")
                if error is None or earlier[what] is None:
                    continue  # nothing was lit: there is no error
                if not tolerance.allows(earlier[what], error):
                    lines.append(
                        f"{picture}: {what}: error {percent(error)}, baseline {percent(earlier[what])}, "
                        f"tolerance {tolerance}"
                    )
        return lines


def _pictures(document: dict) -> dict[tuple, dict]:
    """The pictures of a report, of one or many, that were compared with Cycles; by scene, camera and frame."""
    reports = document.get("reports", [document])
    pictures = {}
    for report in reports:
        techniques = [row for figures in report["passes"].values() for row in figures["techniques"].values()]
        if any("against_cycles" in row for row in techniques):
            key = Path(report["scene"]).name, report["camera"], report["frame"]
            pictures[key] = {"passes": report["passes"], **{name: report[name] for name in _SAME}}
    return pictures


def _is_same(name, before, now) -> bool:
    if name == "reference":
        # Only its presence and number of samples must agree; its error estimate is a result.
        return (before or {}).get("of") == (now or {}).get("of") and (before is None) == (now is None)
    return before == now


def _errors(picture: dict) -> Iterator[tuple[str, float | None]]:
    """Label and value of each error of a picture; None where nothing was lit."""
    for pass_name, figures in picture["passes"].items():
        for technique, row in figures["techniques"].items():
            label = f"{pass_name} of {technique}"
            yield f"{label} against Cycles", row.get("against_cycles", {}).get("unbiased_relative_error")
            reference = row.get("against_reference", {})
            yield f"{label} against the reference", reference.get("relative_l2")
            for material in _CLASSES:
                yield f"{label} against the reference on {material}", reference.get(material, {}).get("relative_l2")
