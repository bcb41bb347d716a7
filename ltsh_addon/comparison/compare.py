"""The whole way: a .blend in, shaded images out, beside Cycles where asked for.

`shade_scene` writes OUT/shade.exr; `compare_scene` writes OUT/compare.exr, compare.png and report.html; both write
report.json, in which nothing depends on the machine's speed, and timing.json.
"""

from __future__ import annotations

import itertools
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from .. import __version__, shading
from ..scene import Cancelled, Film, SurfaceSamples

DEFAULT_TECHNIQUES = ("ltc", "ltsh2", "ltsh4", shading.REFERENCE)
REFERENCE_SEED = 20160725
LABELS = {"ltc": "LTC", "ltsh2": "LTSH N=2", "ltsh4": "LTSH N=4", shading.REFERENCE: "Reference quadrature"}

Progress = Callable[[str, float], "bool | None"]


@dataclass(frozen=True)
class Options:
    """What to shade and how; None means as in the file."""

    scene: Path
    output: Path
    techniques: tuple[str, ...] = DEFAULT_TECHNIQUES
    passes: tuple[str, ...] = shading.PASSES
    width: int | None = None
    height: int | None = None
    sub_samples: int = 1
    frame: int | None = None
    camera: str | None = None
    cycles_samples: int = 512  # of both halves together
    reference_samples: int = 150_000  # above this many, `reference` takes a random subset
    name: str | None = None  # stem of the files, below `output`; None: "shade" or "compare"
    page: str = "report.html"  # of a comparison
    scripts: bool = False  # run those of the file
    memory_mib: int = 0  # a picture that needs more is refused; 0: as the environment says, else what is free


@dataclass(frozen=True)
class Result:
    """One technique on the samples, or on a subset (Q,) of them: radiance per pass (G, Q, 3), time per pass."""

    shading: shading.Shading
    seconds: dict[str, float]
    subset: np.ndarray | None  # (Q,) sorted indices of the samples that were evaluated, None for all


@dataclass(frozen=True)
class Made:
    """What a task has done: its report, the seconds it took, and its files by their names below the output folder."""

    report: dict
    seconds: dict
    files: tuple[str, ...]


def shade_scene(options: Options, progress: Progress | None = None) -> dict:
    """Shade a scene per pixel, write shade.exr, report.json and timing.json; the report with times as "seconds".

    Raises SceneError, TableError, OSError, Cancelled.
    """
    return _with_report(options, False, progress)


def compare_scene(options: Options, progress: Progress | None = None) -> dict:
    """As `shade_scene`, beside Cycles: writes compare.exr, compare.png and report.html too."""
    return _with_report(options, True, progress)


def _with_report(options, with_cycles, progress):
    from .. import imaging

    picture = make_picture(options, with_cycles, progress)
    imaging.write_json(Path(options.output) / "report.json", picture.report)
    imaging.write_json(Path(options.output) / "timing.json", {"seconds": picture.seconds})
    return {**picture.report, "seconds": picture.seconds}


def prepare(options: Options) -> dict[str, str | shading.LookupTable]:
    """Tables by the names under which techniques appear in results; proves that the output folder takes files.

    Done before anything takes long. Raises TableError, OSError.
    """
    tables = load_tables(options.techniques)
    _make_writable(Path(options.output))
    return tables


def load_tables(techniques: Sequence[str]) -> dict[str, str | shading.LookupTable]:
    """The tables by the names of their techniques; the reference stands for itself. Raises TableError."""
    names = technique_names(techniques)
    return {name: given if given == shading.REFERENCE else _table(given) for name, given in names.items()}


def _table(given: str) -> shading.LookupTable:
    return _shipped_table(given) if given in shading.SHIPPED_TABLES else shading.load_table(given)


@cache
def _shipped_table(name: str) -> shading.LookupTable:
    """Read once: a job of many frames needs it for each."""
    return shading.load_table(name)


def technique_names(techniques: Sequence[str]) -> dict[str, str]:
    """What was given, by the names under which techniques appear in results: those of tables are short."""
    names = {}
    for given in techniques:
        name = given if given in (*shading.SHIPPED_TABLES, shading.REFERENCE) else _short_name(given, names)
        names[name] = given
    return names


def _short_name(path: str, taken) -> str:
    """The name of a table's file without folder and dots, which separate the parts of a layer's name."""
    stem = Path(path).stem.replace(".", "_")
    candidates = (f"{stem}_{number}" if number > 1 else stem for number in itertools.count(1))
    reserved = {*shading.SHIPPED_TABLES, shading.REFERENCE, "cycles", *taken}
    return next(name for name in candidates if name not in reserved)


def make_picture(options: Options, with_cycles: bool, progress: Progress | None = None) -> Made:
    """Shade one picture, beside Cycles where asked for, and write its files but report.json.

    Raises as `shade_scene` does.
    """
    from ..blender.processes import child

    if with_cycles and options.cycles_samples < 2:
        raise ValueError(f"cycles_samples is {options.cycles_samples}, expected at least 2: one for each half")
    start = time.perf_counter()
    tables = prepare(options)
    extraction = child.extract(
        child.ExtractOptions(
            scene=options.scene,
            width=options.width,
            height=options.height,
            sub_samples=options.sub_samples,
            cycles_samples=options.cycles_samples if with_cycles else 0,
            frame=options.frame,
            camera=options.camera,
            scripts=options.scripts,
            techniques=len(tables),
            memory_mib=options.memory_mib,
        ),
        progress=progress,
    )
    results = {name: _evaluate(name, table, extraction, options, progress) for name, table in tables.items()}
    from .comparison_output import Comparison

    comparison = Comparison(options, extraction, results)
    report = comparison.report()
    files = comparison.write(Path(options.output), report, with_cycles, progress)
    techniques = {name: result.seconds for name, result in results.items()}
    seconds = {**extraction.seconds, "techniques": techniques, "total": time.perf_counter() - start}
    return Made(report, seconds, tuple(files))


def _make_writable(path: Path) -> None:
    """Make the output folder and prove that it takes files."""
    from ..imaging.atomic import check_takes_files

    try:
        check_takes_files(path)
    except OSError as error:
        raise OSError(f"output folder {path}: cannot be written ({error.strerror}); choose another with -o") from error


def _evaluate(name, table, extraction, options, progress) -> Result:
    """Shade all samples, or for the reference those of randomly chosen pixels where the image is large."""
    samples, subset = extraction.samples, None
    if name == shading.REFERENCE and len(samples) > options.reference_samples:
        subset = _samples_of_random_pixels(extraction.film, options.reference_samples)
        samples = samples.take(subset)

    shaded, seconds = {}, {}
    for index, pass_name in enumerate(options.passes):

        def report(fraction, done=index):
            whole = (done + fraction) / len(options.passes)
            return None if progress is None else progress(LABELS.get(name, name), whole)

        if report(0.0) is False:
            raise Cancelled(f"stopped before {name} shaded the {pass_name} pass")
        start = time.perf_counter()
        shaded[pass_name] = shading.shade(samples, extraction.lights, table, passes=(pass_name,), progress=report)
        seconds[pass_name] = time.perf_counter() - start
    return Result(_joined(shaded), seconds, subset)


def _joined(shaded: dict[str, shading.Shading]) -> shading.Shading:
    """One Shading of those of single passes."""
    first = next(iter(shaded.values()))
    passes = {name: getattr(part, name) for name, part in shaded.items()}
    error = shaded["specular"].quadrature_error if "specular" in shaded else None
    return shading.Shading(first.groups, passes.get("specular"), passes.get("diffuse"), error)


def _samples_of_random_pixels(film: Film, limit: int) -> np.ndarray:
    """Sorted indices of at most `limit` samples: all those of some pixels, which a seeded generator chose."""
    generator = np.random.default_rng(REFERENCE_SEED)
    order = generator.permutation(film.width * film.height)
    count = np.bincount(film.pixel, minlength=len(order))[order]
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order[np.cumsum(count) <= limit]] = True
    return np.nonzero(chosen[film.pixel])[0]


def material_classes(samples: SurfaceSamples) -> dict[str, np.ndarray]:
    """Masks (P,) of the samples whose specular lobe is mostly a metal's, or mostly a dielectric's."""
    metal = samples.specular_f90.max(axis=1, initial=0.0)
    dielectric = samples.dielectric.max(axis=1, initial=0.0)
    return {
        "metals": (metal > dielectric) & (metal > 0.0),
        "dielectrics": (dielectric >= metal) & (dielectric > 0.0),
    }


def versions(blender_version: str) -> dict[str, str]:
    """Versions that a result depends on."""
    import OpenEXR

    return {
        "ltsh": __version__,
        "blender": blender_version,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "OpenEXR": getattr(OpenEXR, "__version__", "unknown"),
    }


def known_technique(name: str) -> bool:
    """True for shipped tables, "reference", and paths of .npz files."""
    names: Sequence[str] = (*shading.SHIPPED_TABLES, shading.REFERENCE)
    return name in names or name.endswith(".npz")
