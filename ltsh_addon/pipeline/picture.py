"""Pictures of techniques, beside each other and beside Cycles, and the files and figures of a comparison."""

from __future__ import annotations

import itertools
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging, shading
from ..files import check_takes_files, save_array, temporary_folder, write_bytes
from ..reading import NUMBER, check, some
from ..scene import (
    CYCLES,
    PASSES,
    REFERENCE,
    SHIPPED_TABLES,
    TECHNIQUES,
    VERSION,
    Cancelled,
    Film,
    Progress,
    SurfaceSamples,
)
from . import lighting
from .options import PictureOptions, child_job

REFERENCE_SEED = 20160725
# Limits of the reference: MOST_PAIRS pairs of a sample and a light, some 30 us each, but always FEWEST_SAMPLES samples.
MOST_PAIRS, FEWEST_SAMPLES = 3_000_000, 32
# MOST_VISIBILITY_LAYERS: with more lights the EXR has no visibility layers.
MOST_VISIBILITY_LAYERS = 64
# UNSHADOWED: suffix of a technique's name in the layers without shadows, where others have shadows.
UNSHADOWED = "_unshadowed"
# COMBINED: the layers of whole pictures. SHOWN: the temporary PNG of one, through the view transform of its scene.
COMBINED, SHOWN = "combined", "shown.png"
# Layers of the G-buffer: field of SurfaceSamples and its channel letters.
SAMPLE_LAYERS = {
    "position": "XYZ",
    "view": "XYZ",
    "normal": "XYZ",
    "diffuse_normal": "XYZ",
    "geometric_normal": "XYZ",
    "smooth_normal": "XYZ",
    "bump_alpha2": "V",
    "roughness": "V",
    "specular_f0": "RGB",
    "specular_f90": "RGB",
    "specular_dip": "RGB",
    "dielectric": "RGB",
    "ior": "V",
    "diffuse_albedo": "RGB",
    "diffuse_roughness": "V",
    "diffuse_rebound": "RGB",
    "sheen_a": "V",
    "sheen_b": "V",
    "receiver": "V",
    "anisotropy": "V",
    "tangent": "XYZ",
}


@dataclass(frozen=True)
class TaskResult:
    """The result of a task: its report, the seconds it took, and the names of its files below the output folder."""

    report: dict
    seconds: dict
    files: tuple[str, ...]


def shade_scene(options: PictureOptions, progress: Progress | None = None) -> dict:
    """Shade a scene per pixel and write shade.exr, shade.png, report.json and timing.json.

    Returns the report, with the times under "seconds". Raises SceneError, TableError, OSError, Cancelled.
    """
    return _with_report(options, False, progress)


def compare_scene(options: PictureOptions, progress: Progress | None = None) -> dict:
    """As `shade_scene`, with Cycles beside the techniques: writes compare.exr, compare.png and report.html."""
    return _with_report(options, True, progress)


def _with_report(options, with_cycles, progress):
    picture = make_picture(options, with_cycles, progress)
    imaging.write_json(Path(options.output) / "report.json", picture.report)
    imaging.write_json(Path(options.output) / "timing.json", {"seconds": picture.seconds})
    return {**picture.report, "seconds": picture.seconds}


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
    # Shipped tables are cached: a job of many frames loads them for each. A user's table may change meanwhile.
    return _shipped_table(given) if given in SHIPPED_TABLES else shading.load_table(given)


_shipped_table = cache(shading.load_table)


def technique_names(techniques: Sequence[str | shading.OwnTechnique]) -> dict[str, str | shading.OwnTechnique]:
    """The given techniques by their names in results; the name of a user's table is the stem of its path."""
    names = {}
    for given in techniques:
        own = shading.is_own(given)
        stem = str(getattr(given, "name", type(given).__name__)) if own else Path(given).stem
        names[given if not own and given in TECHNIQUES else _short_name(stem, names)] = given
    return names


def check_named(techniques: Sequence, what: str) -> None:
    """Raise ValueError where a technique is a user's own, which `what` could not call later."""
    if own := [_described(given) for given in techniques if shading.is_own(given)]:
        raise ValueError(
            f"technique {own[0]}: {what} cannot call it later, expected {', '.join(TECHNIQUES)} or the path of a table "
            "(.npz); leave it out"
        )


def _short_name(stem: str, taken) -> str:
    """A free name from `stem`, with _ for the dots that separate the parts of a layer's name."""
    stem = stem.replace(".", "_")
    candidates = (f"{stem}_{number}" if number > 1 else stem for number in itertools.count(1))
    reserved = {*TECHNIQUES, CYCLES, *taken}
    return next(name for name in candidates if name not in reserved)


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
        extraction = _extracted(options, with_cycles, progress)
        shadows = None
        if extraction.occluders is not None:
            shadows = lighting.trace_shadows(extraction, options.passes, options.shadow_rays, progress)
        results = evaluated(tables, extraction, shadows, options, progress)
        comparison = Comparison(options, extraction, results, shadows)
        shown = None if folder is None else _shown(comparison, folder, progress)
    report, output = comparison.report(), Path(options.output)
    files = comparison.write(output, report, with_cycles, progress)
    if shown is not None:
        files.append(Path(files[0]).with_suffix(".png").as_posix())
        write_bytes(output / files[-1], shown)
    if options.keep_visibility:
        path = (output / files[0]).with_suffix(lighting.RELIGHT_SUFFIX)
        kept = lighting.write_relight_data(extraction, shadows, options, path)
        files += [path.relative_to(output).as_posix() for path in kept]
    techniques = {name: result.seconds for name, result in results.items()}
    seconds = {**extraction.times.stages, "techniques": techniques, "total": time.perf_counter() - start}
    if shadows is not None:
        seconds["shadows"] = shadows.seconds
    return TaskResult(report, seconds, tuple(files))


def _extracted(options: PictureOptions, with_cycles: bool, progress):
    """The `Extraction` of a scene: samples and lights, with Cycles' picture where asked for."""
    from ..blender.process.pixels import PixelJob, extract_pixels

    width, height = options.resolution or (None, None)
    samples = options.cycles_samples if with_cycles else 0
    rest = set(PASSES) <= set(options.passes)
    job = child_job(PixelJob, options, width=width, height=height, cycles_samples=samples, rest=rest)
    return extract_pixels(job, progress=progress)


def _shown(comparison: Comparison, folder: Path, progress) -> bytes:
    """PNG bytes of the most accurate picture, through the view transform of its scene; `folder` is temporary."""
    from ..blender.process.finished import PICTURE, show_finished

    options = comparison.options
    pixels = comparison.whole(most_accurate(comparison.results))
    save_array(folder / PICTURE, pixels.astype(np.float32))
    show_finished(Path(options.scene), None, options.frame, folder, SHOWN, progress=progress)
    return (folder / SHOWN).read_bytes()


@dataclass(frozen=True)
class TechniqueResult:
    """Radiance of one technique on all samples, or on a subset (Q,) of them."""

    shading: shading.Shading  # radiance (G, Q, 3) per pass
    seconds: dict[str, float]  # per pass
    subset: np.ndarray | None  # (Q,) sorted indices of the samples that were evaluated, None for all
    unshadowed: shading.Shading | None = None  # the same without shadows, where `shading` has shadows

    def with_more(self, kept: np.ndarray, more: TechniqueResult) -> TechniqueResult:
        """The samples in the mask `kept` (P,), then those of `more`; both results must be without a subset."""
        seconds = {name: value + more.seconds[name] for name, value in self.seconds.items()}
        own = [(self.shading, more.shading), (self.unshadowed, more.unshadowed)]
        shaded = [None if one is None else one.with_more(kept, other) for one, other in own]
        return TechniqueResult(shaded[0], seconds, None, shaded[1])


def evaluated(tables, extraction, shadows, options, progress) -> dict[str, TechniqueResult]:
    """The results of all techniques in `tables` (see `prepare`), by name."""
    return {name: _evaluate(name, table, extraction, shadows, options, progress) for name, table in tables.items()}


def _evaluate(name, table, extraction, shadows, options, progress) -> TechniqueResult:
    """Shade all samples; the reference shades those of randomly chosen pixels where there are too many."""
    samples, subset = extraction.samples, None
    limit = min(options.reference_samples, max(FEWEST_SAMPLES, MOST_PAIRS // max(len(extraction.lights), 1)))
    if name == REFERENCE and len(samples) > limit:
        subset = _samples_of_random_pixels(extraction.film, limit)
        samples = samples.take(subset)
    wanted = (None,) if shadows is None else (shadows if subset is None else shadows.take(subset), None)
    lit, seconds = [{} for _ in wanted], {}
    for index, pass_name in enumerate(options.passes):

        def report(fraction, done=index):
            whole = (done + fraction) / len(options.passes)
            return None if progress is None else progress(_title(name), whole)

        if report(0.0) is False:
            raise Cancelled(f"stopped before {name} shaded the {pass_name} pass")
        start = time.perf_counter()
        found = lighting.shade_lights(samples, extraction.lights, table, (pass_name,), wanted, progress=report)
        for of_pass, shaded in zip(lit, found, strict=True):
            of_pass[pass_name] = shaded
        seconds[pass_name] = time.perf_counter() - start
    shaded, *unshadowed = map(_joined, lit)
    return TechniqueResult(shaded, seconds, subset, *unshadowed)


def _joined(shaded: dict[str, shading.Shading]) -> shading.Shading:
    """Several Shadings of one pass each as one Shading."""
    first = next(iter(shaded.values()))
    passes = {name: getattr(part, name) for name, part in shaded.items()}
    error = shaded["specular"].quadrature_error if "specular" in shaded else None
    return shading.Shading(first.groups, passes.get("specular"), passes.get("diffuse"), error)


def _samples_of_random_pixels(film: Film, limit: int) -> np.ndarray:
    """Sorted indices of at most `limit` samples: all samples of pixels that a seeded generator chooses."""
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
        "ltsh": VERSION,
        "blender": blender_version,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "OpenEXR": getattr(OpenEXR, "__version__", "unknown"),
    }


@dataclass(frozen=True)
class Comparison:
    """The results of one scene, ready to be measured and written."""

    options: PictureOptions
    extraction: Any  # blender.process.pixels.Extraction, which the core does not import
    results: dict[str, TechniqueResult]
    shadows: lighting.Shadows | None = None

    @property
    def film(self) -> Film:
        return self.extraction.film

    def with_more(self, kept: np.ndarray, more: Comparison) -> Comparison:
        """The samples in the mask `kept` (P,), then those of `more`, a comparison of the same scene and film."""
        one, other = self.extraction, more.extraction
        samples = SurfaceSamples.joined([one.samples.take(kept), other.samples])
        film = one.film.take(kept).with_more(other.film)
        results = {name: result.with_more(kept, more.results[name]) for name, result in self.results.items()}
        shadows = None if self.shadows is None else self.shadows.with_more(kept, more.shadows)
        return replace(self, extraction=replace(one, samples=samples, film=film), results=results, shadows=shadows)

    @property
    def cycles(self) -> dict[str, np.ndarray]:
        """The two halves (2, H, W, 3) of Cycles' picture per pass; empty without a Cycles reference."""
        return self.extraction.cycles.reference or {}

    @cached_property
    def rest(self) -> np.ndarray | None:
        """The picture (H, W, 4) without reflected light: emission, lights in sight, background; None if unknown."""
        return None if self.extraction.cycles.background is None else self.extraction.rest

    def whole(self, name: str) -> np.ndarray:
        """The whole picture (H, W, 4) of a technique: the sum of its passes, plus `rest` where that is known."""
        light = sum(self.images[name, pass_name] for pass_name in self.options.passes)
        return self._with_rest(light)

    def _with_rest(self, light: np.ndarray) -> np.ndarray:
        """The picture (H, W, 4) with this reflected `light` (H, W, 3); alpha is the coverage where `rest` is None."""
        if self.rest is None:
            return np.concatenate([light, self.film.coverage()[..., None]], axis=-1)
        return np.concatenate([self.rest[..., :3] + light, self.rest[..., 3:]], axis=-1)

    @cached_property
    def images(self) -> dict[tuple[str, str], np.ndarray]:
        """Image (H, W, 3) per technique and pass, summed over light groups."""
        return {
            (name, pass_name): self._image(result, self._radiance(result, pass_name).sum(axis=0))
            for name, result in self.results.items()
            for pass_name in self.options.passes
        }

    def _radiance(self, result, pass_name) -> np.ndarray:
        return self._exposed(result.shading, pass_name)

    def _exposed(self, shaded: shading.Shading, pass_name) -> np.ndarray:
        return self.extraction.picture.exposure * getattr(shaded, pass_name)

    def _image(self, result, values) -> np.ndarray:
        return self._film_of(result).image(values)

    def _film_of(self, result) -> Film:
        if result.subset is None:
            return self.film
        return self.film.take(result.subset)

    def _mask(self, result) -> np.ndarray:
        """Mask (H, W) of the pixels whose surfaces the technique has shaded."""
        return self._film_of(result).coverage() > 0.0

    # Figures:

    def report(self) -> dict:
        """The report as a JSON-able document."""
        extraction, options = self.extraction, self.options
        return {
            "scene": str(options.scene),
            "camera": extraction.picture.camera,
            "frame": extraction.picture.frame,
            "resolution": [self.film.width, self.film.height],
            "border": None if extraction.picture.border is None else vars(extraction.picture.border),
            "pixel_aspect": extraction.picture.pixel_aspect,
            "pixel_filter": extraction.picture.pixel_filter if self.film.sub_samples > 1 else "pixel centers",
            "exposure": extraction.picture.exposure,
            "color_space": extraction.picture.color_space.name,
            "sub_samples": self.film.sub_samples,
            "surface_samples": len(extraction.samples) if self.film.first is None else int(self.film.first.sum()),
            "cycles_samples": options.cycles_samples if self.cycles else 0,
            "lights": _light_reports(extraction.lights),
            "versions": versions(extraction.picture.blender_version),
            "tables": {name: _described(given) for name, given in technique_names(options.techniques).items()},
            "reference": self._reference_facts(),
            "shadows": None if self.shadows is None else self.shadows.report(),
            "passes": {name: self._pass_report(name) for name in options.passes},
            "problems": list(extraction.problems),
            "warnings": list(extraction.warnings),
        }

    def _reference_facts(self) -> dict | None:
        result = self.results.get(REFERENCE)
        if result is None:
            return None
        count = len(self.extraction.samples) if result.subset is None else len(result.subset)
        error = result.shading.quadrature_error
        return {
            "samples": count,
            "of": len(self.extraction.samples),
            "seed": None if result.subset is None else REFERENCE_SEED,
            "largest_error_estimate": None if error is None or not len(error) else float(error.max()),
        }

    def _subset_notice(self) -> str:
        """Note that the reference covers only some of the samples; empty where it covers all or is not there."""
        facts = self._reference_facts()
        if facts is None or facts["samples"] == facts["of"]:
            return ""
        return f"reference on {facts['samples']} of {facts['of']} samples, randomly chosen pixels"

    def _pass_report(self, pass_name: str) -> dict:
        report = {}
        if self.cycles:
            halves = self.cycles[pass_name]
            report["noise"] = imaging.reference_noise(halves[0], halves[1], self.film.coverage() > 0.0)
        report["techniques"] = {name: self._technique_report(name, pass_name) for name in self.results}
        return report

    def _technique_report(self, name: str, pass_name: str) -> dict:
        result = self.results[name]
        report = {}
        if self.cycles:
            image, rec709 = self.images[name, pass_name], self.extraction.picture.color_space.rec709
            report["against_cycles"] = against_cycles(image, self.cycles[pass_name], self._mask(result), rec709)
        reference = self.results.get(REFERENCE)
        if reference is not None and name != REFERENCE:
            report["against_reference"] = self._against_reference(result, reference, pass_name)
        return report

    def _against_reference(self, result, reference, pass_name) -> dict:
        """Statistics per sample, over all samples and over those of each class of material."""
        index = slice(None) if reference.subset is None else reference.subset
        values = self._radiance(result, pass_name).sum(axis=0)[index]
        truth = self._radiance(reference, pass_name).sum(axis=0)
        report = imaging.error_statistics(values, truth).to_dict()
        for label, mask in material_classes(self.extraction.samples.take(index)).items():
            report[label] = imaging.error_statistics(values, truth, mask).to_dict()
        return report

    # Files:

    def write(self, output: Path, document: dict, with_cycles: bool, progress: Callable | None) -> list[str]:
        """Write all files into the folder `output`; returns their names. All contents are computed first."""
        if progress is not None and progress("write", 0.0) is False:
            raise Cancelled("stopped before the files were written")
        name = self.options.name or ("compare" if with_cycles else "shade")
        metadata = {
            "ltsh:scene": Path(self.options.scene).name,
            "ltsh:frame": str(self.extraction.picture.frame),
            "ltsh:camera": self.extraction.picture.camera,
            "ltsh:version": document["versions"]["ltsh"],
            "ltsh:exposure": repr(self.extraction.picture.exposure),
            "ltsh:color_space": self.extraction.picture.color_space.name,
        }
        if self.extraction.picture.border is not None:
            metadata["ltsh:border"] = str(self.extraction.picture.border)
        if notice := self._subset_notice():
            metadata["ltsh:reference"] = f"{notice}; elsewhere zero"
        layers, sheet = self.layers(), self.sheet() if with_cycles else None
        chromaticities = imaging.chromaticities(self.extraction.picture.color_space)
        files = [f"{name}.exr", *([f"{name}.png", self.options.page] if with_cycles else [])]
        (output / files[0]).parent.mkdir(parents=True, exist_ok=True)
        imaging.write_layers(output / files[0], layers, metadata, chromaticities, self.extraction.picture.pixel_aspect)
        if with_cycles:
            imaging.write_png(output / files[1], sheet)
            imaging.write_html(output, self.options.page, files[1], files[0], document)
        if progress is not None:
            progress("write", 1.0)
        return files

    def layers(self) -> dict[str, np.ndarray | imaging.Layer]:
        """All layers of the EXR by name."""
        layers = {}
        for (name, pass_name), image in self.images.items():
            layers[f"{name}.{pass_name}"] = image
            result = self.results[name]
            groups = result.shading.groups
            if len(groups) > 1:
                for group, values in zip(lighting.group_names(groups), self._radiance(result, pass_name), strict=True):
                    layers[f"{name}.{pass_name}@{group}"] = self._image(result, values)
            if result.unshadowed is not None:
                values = self._exposed(result.unshadowed, pass_name).sum(axis=0)
                layers[f"{name}{UNSHADOWED}.{pass_name}"] = self._image(result, values)
        for pass_name, halves in self.cycles.items():
            if pass_name not in self.options.passes:
                continue
            mean = halves.mean(axis=0)
            layers[f"cycles.{pass_name}"] = mean
            for half, pixels in zip("AB", halves, strict=True):
                layers[f"cycles_{half}.{pass_name}"] = pixels
            for name in self.results:
                layers[f"error_{name}.{pass_name}"] = self._error(name, pass_name)
        layers |= self._whole_layers() | self._visibility_layers()
        # A surface with several lobes shows the first of them.
        first = slice(None) if self.film.first is None else np.nonzero(self.film.first)[0]
        film = self.film.take(first)
        for field, letters in SAMPLE_LAYERS.items():
            values = getattr(self.extraction.samples, field)[first]
            layers[f"samples.{field}"] = imaging.Layer(film.image(values), letters)
        layers["coverage.hit"] = imaging.Layer(self.film.coverage(), "V")
        return layers

    def _whole_layers(self) -> dict[str, np.ndarray]:
        """Layers of the whole pictures of the techniques and of Cycles' direct light, and their errors.

        Empty where `rest` is not known: then the passes are not all of the light.
        """
        if self.rest is None:
            return {}
        layers, is_surface = {}, self.film.coverage() > 0.0
        cycles = sum(self.cycles[name].mean(axis=0) for name in PASSES) if self.cycles else None
        for name, result in self.results.items():
            missing = is_surface & ~self._mask(result)
            layers[f"{name}.{COMBINED}"] = np.where(missing[..., None], 0.0, self.whole(name))
            if cycles is not None:
                layers[f"error_{name}.{COMBINED}"] = sum(self._error(name, part) for part in PASSES)
        if cycles is not None:
            layers[f"{CYCLES}.{COMBINED}"] = self._with_rest(cycles)
        return layers

    def _error(self, name: str, pass_name: str) -> np.ndarray:
        """Technique minus Cycles (H, W, 3); 0 where the technique did not shade."""
        error = self.images[name, pass_name] - self.cycles[pass_name].mean(axis=0)
        return np.where(self._mask(self.results[name])[..., None], error, 0.0)

    def _visibility_layers(self) -> dict[str, imaging.Layer]:
        """Layers of the share of each light that is seen, 1 where there is no surface; none for very many lights.

        Lights that share their rays have one layer, named after the first of them.
        """
        shadows, found = self.shadows, {}
        if shadows is None or len(shadows.numbers) > MOST_VISIBILITY_LAYERS:
            return found
        lights = [self.extraction.lights[own[0]] for own in shadows.numbers]
        nothing = 1.0 - self.film.coverage()
        first = slice(None) if self.film.first is None else np.nonzero(self.film.first)[0]
        film = self.film.take(first)
        for pass_name in self.options.passes:
            names = lighting.layer_names(light.name for light in lights)
            for name, share in zip(names, shadows.shares[pass_name], strict=True):
                found[f"visibility.{pass_name}@{name}"] = imaging.Layer(film.image(share[first]) + nothing, "V")
        return found

    def sheet(self) -> np.ndarray:
        """The comparison sheet (H, W, 3), 8 bit: both passes together where both were shaded, then each pass."""
        wanted = [name for name in PASSES if name in self.options.passes]
        parts = [(name,) for name in wanted] if len(wanted) == 1 else [PASSES, *((name,) for name in wanted)]
        return np.concatenate([self._sheet_of(passes) for passes in parts])

    def _sheet_of(self, passes: tuple[str, ...]) -> np.ndarray:
        """The sheet of the sum of `passes`."""
        halves = sum(self.cycles[name] for name in passes)
        mean, rec709 = halves.mean(axis=0), self.extraction.picture.color_space.rec709
        hit, tiles = self.film.coverage() > 0.0, []
        # The picture of all passes also shows the background and lights in sight. Its errors are those of the light.
        behind = 0.0 if self.rest is None or len(passes) == 1 else self.rest[..., :3]
        for name, result in self.results.items():
            image, missing = sum(self.images[name, part] for part in passes) + behind, None
            if result.subset is not None:
                missing = hit & ~self._mask(result)
            error = rec709(sum(self._error(name, part) for part in passes))
            tiles.append(imaging.Tile(_title(name), rec709(image), error, self._caption(name, passes), missing))
        title = passes[0] if len(passes) == 1 else "combined"
        notes = [
            f"{self.film.width} x {self.film.height}, {self.options.cycles_samples} Cycles samples",
            f"noise of the Cycles reference {percent(imaging.reference_noise(*halves, hit))}",
        ]
        if self.shadows is not None and len(passes) == 1:
            notes.append(f"noise of our shadows {percent(self.shadows.noise[passes[0]])}")
        if notice := self._subset_notice():
            notes.append(f"{notice}; elsewhere gray")
        title = f"{Path(self.options.scene).stem}: {title} radiance beside Cycles"
        return imaging.comparison_sheet(title, ("Cycles", rec709(mean + behind)), tiles, notes=notes)

    def _caption(self, name: str, passes: tuple[str, ...]) -> list[str]:
        """Caption lines: the errors of a technique in the sum of `passes`."""
        result, halves = self.results[name], sum(self.cycles[part] for part in passes)
        image = sum(self.images[name, part] for part in passes)
        beside = imaging.noisy_error_statistics(image, *halves, self._mask(result)).to_dict()
        lines, reference = [f"against Cycles {unbiased(beside)}"], self.results.get(REFERENCE)
        if reference is not None and name != REFERENCE:
            index = slice(None) if reference.subset is None else reference.subset
            values = sum(self._radiance(result, part).sum(axis=0)[index] for part in passes)
            truth = sum(self._radiance(reference, part).sum(axis=0) for part in passes)
            lines.append(f"against reference {percent(imaging.error_statistics(values, truth).relative_l2)}")
        return lines


def most_accurate(names) -> str:
    """The last of the technique names, by convention the most accurate. The reference comes only if it is alone,
    because it may cover a part of the pixels only."""
    names = list(names)
    return next((name for name in reversed(names) if name != REFERENCE), names[-1])


def against_cycles(image, halves, mask, rec709=np.asarray) -> dict:
    """Error figures of an image (H, W, 3) against the halves (2, H, W, 3) of Cycles, in the shaded `mask` (H, W)."""
    statistics, mean = imaging.noisy_error_statistics(image, *halves, mask), halves.mean(axis=0)
    shaded = np.where(mask[..., None], image, mean)
    return {**statistics.to_dict(), "flip": imaging.mean_flip(rec709(mean), rec709(shaded), mask)}


def _light_reports(lights) -> list[dict]:
    """Entries of report.json for `lights`. The faces of a mesh light are one entry, with their mean radiance."""
    found = []
    for kind, own in itertools.groupby(lights, lambda light: (light.name, light.shape, light.group)):
        own = list(own)
        # Polygons of one name are faces of one light. Other lights of one name are instances.
        for part in [own] if kind[1] == "POLYGON" else [[light] for light in own]:
            radiance = part[0].radiance
            if len(part) > 1:
                areas = np.array([np.linalg.norm(light.area_vector) for light in part])
                radiance = areas @ np.array([light.radiance for light in part]) / areas.sum()
            patches = sum(len(light.patches) for light in part)
            found.append(dict(zip(("name", "shape", "group"), kind, strict=True)))
            found[-1] |= {"radiance": radiance.tolist(), "patches": patches}
    return found


def _described(given) -> str:
    """How report.json names a technique: its name, the path of its table, or the class of a user's own."""
    return f"{type(given).__module__}.{type(given).__qualname__}" if shading.is_own(given) else str(given)


def _title(name: str) -> str:
    """The title of a technique on sheets and in progress; for a user's table its name."""
    return TECHNIQUES[name].title if name in TECHNIQUES else name


_ERRORS = {"relative_l2?": NUMBER | None}
_ROW = {
    "against_cycles?": {"unbiased_relative_error?": NUMBER | None, "unbiased_squared_error?": NUMBER | None},
    "against_reference?": {**_ERRORS, "metals?": _ERRORS, "dielectrics?": _ERRORS},
}


def _shadows(value, place) -> None:
    """Check for the document of `Shadows.report`, or null."""
    if value is not None:
        check(value, {"noise": {str: NUMBER}}, place)


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


def _seconds(value, place) -> None:
    """Check for a number, or nested dicts of numbers."""
    check(value, {str: _seconds} if isinstance(value, dict) else NUMBER, place)


# The seconds of a picture or a bake (see `reading.check`).
SECONDS = {"techniques?": {str: {str: NUMBER}}, str: _seconds}


def percent(value) -> str:
    """A share as text."""
    return "-" if value is None else f"{100.0 * value:.2f} %"


def unbiased(figures: dict) -> str:
    """The error against two noisy halves as text; "in noise" where the unbiased square of the error is negative."""
    squared = figures.get("unbiased_squared_error")
    return "in noise" if squared is not None and squared < 0.0 else percent(figures.get("unbiased_relative_error"))


def summary(report: dict, seconds: dict) -> list[str]:
    """Lines of text about one picture: errors and seconds per pass and technique."""
    found = []
    shadows = report.get("shadows")
    for pass_name, figures in report["passes"].items():
        noise = f", noise of Cycles {percent(figures['noise'])}" if "noise" in figures else ""
        noise += f", of our shadows {percent(shadows['noise'].get(pass_name))}" if shadows else ""
        found.append(f"{pass_name}{noise}")
        heads = f"{'vs Cycles':>12}{'vs reference':>14}{'metals':>10}{'dielectrics':>13}{'s':>8}"
        found.append(f"  {'technique':<12}{heads}")
        for name, row in figures["techniques"].items():
            reference = row.get("against_reference", {})
            classes = [percent(reference.get(label, {}).get("relative_l2")) for label in ("metals", "dielectrics")]
            cycles, truth = unbiased(row.get("against_cycles", {})), percent(reference.get("relative_l2"))
            errors = f"{cycles:>12}{truth:>14}{classes[0]:>10}{classes[1]:>13}"
            took = seconds.get("techniques", {}).get(name, {}).get(pass_name)
            found.append(f"  {name:<12}{errors}" + (f"{took:>8.2f}" if took is not None else f"{'-':>8}"))
    return found


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
