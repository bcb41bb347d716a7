"""The whole way: a .blend in, shaded images out, beside Cycles where asked for.

`shade_scene` writes OUT/shade.exr; `compare_scene` writes OUT/compare.exr, compare.png, report.json and report.html.
"""

from __future__ import annotations

import itertools
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import __version__, shading
from .scene import Cancelled, Film, SurfaceSamples

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


@dataclass(frozen=True)
class Result:
    """One technique on the samples, or on a subset (Q,) of them: radiance per pass (G, Q, 3), time per pass."""

    shading: shading.Shading
    seconds: dict[str, float]
    subset: np.ndarray | None  # (Q,) sorted indices of the samples that were evaluated, None for all


def shade_scene(options: Options, progress: Progress | None = None) -> dict:
    """Shade a scene per pixel, write shade.exr, return the report.

    Raises SceneError, TableError, OSError, Cancelled.
    """
    return _run(options, False, progress)


def compare_scene(options: Options, progress: Progress | None = None) -> dict:
    """As `shade_scene`, beside Cycles: writes compare.exr, compare.png, report.json and report.html."""
    if options.cycles_samples < 2:
        raise ValueError(f"cycles_samples is {options.cycles_samples}, expected at least 2: one for each half")
    return _run(options, True, progress)


def prepare(options: Options) -> dict[str, str | shading.LookupTable]:
    """Tables by the names under which techniques appear in results; proves that the output folder takes files.

    Done before anything takes long. Raises TableError, OSError.
    """
    tables = {}
    for given in options.techniques:
        name = given if given in (*shading.SHIPPED_TABLES, shading.REFERENCE) else _short_name(given, tables)
        tables[name] = given if given == shading.REFERENCE else shading.load_table(given)
    _make_writable(Path(options.output))
    return tables


def _short_name(path: str, taken) -> str:
    """The name of a table's file without folder and dots, which separate the parts of a layer's name."""
    stem = Path(path).stem.replace(".", "_")
    candidates = (f"{stem}_{number}" if number > 1 else stem for number in itertools.count(1))
    reserved = {*shading.SHIPPED_TABLES, shading.REFERENCE, "cycles", *taken}
    return next(name for name in candidates if name not in reserved)


def _run(options, with_cycles, progress):
    from .blender import child

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
        ),
        progress=progress,
    )
    results = {name: _evaluate(name, table, extraction, options, progress) for name, table in tables.items()}
    from .comparison_output import Comparison

    comparison = Comparison(options, extraction, results)
    document = comparison.report()
    document["seconds"]["total"] = time.perf_counter() - start
    comparison.write(Path(options.output), document, with_cycles, progress)
    return document


def _make_writable(path: Path) -> None:
    """Make the output folder and prove that it takes files."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".ltsh-write-test"
        probe.write_bytes(b"")
        probe.unlink()
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
