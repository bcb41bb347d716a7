"""The techniques of one scene beside each other and beside Cycles: error figures, EXR layers, sheet and report."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging
from ..imaging import exr
from ..imaging.exr import COMBINED, TRANSMITTED, layer_name
from ..scene import CYCLES, PASSES, REFERENCE, SCALAR_FIELDS, Film, SurfaceSamples
from . import lighting
from .lighting import REFERENCE_SEED, TechniqueResult, described, technique_names, title
from .options import PictureOptions
from .tasks import check_before_writing, versions

# MOST_VISIBILITY_LAYERS: with more lights the EXR has no visibility layers.
MOST_VISIBILITY_LAYERS = 64
# Layers of the G-buffer: field of SurfaceSamples and its channel letters.
_COLORS = "specular_f0", "specular_f90", "specular_dip", "dielectric", "diffuse_albedo", "diffuse_rebound"
SAMPLE_LAYERS = {
    field.name: "V" if field.name in SCALAR_FIELDS else "RGB" if field.name in _COLORS else "XYZ"
    for field in fields(SurfaceSamples)
}


@dataclass(frozen=True)
class Comparison:
    """The results of one scene, ready to be measured and written."""

    options: PictureOptions
    extraction: Any  # blender.process.pixels.Extraction, which the core does not import
    results: dict[str, TechniqueResult]
    shadows: lighting.Shadows | None = None
    transmitted: "Comparison | None" = None  # what is seen through glass

    @property
    def film(self) -> Film:
        return self.extraction.film

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
        whole = self._with_rest(sum(self.images[name, pass_name] for pass_name in self.options.passes))
        if self.transmitted is not None:
            whole[..., :3] += self.transmitted.whole(name)[..., :3]
        return whole

    def with_still_glass(self):
        """The extraction, with what is seen through glass as if it shone by itself."""
        extraction = self.extraction
        if self.transmitted is None:
            return extraction
        light = self.transmitted.whole(most_accurate(self.results))[..., :3] / extraction.picture.exposure
        cycles = replace(extraction.cycles, emission=extraction.cycles.emission + light)
        return replace(extraction, cycles=cycles, behind=None)

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

    def _radiance(self, result, pass_name, of: str = "shading") -> np.ndarray:
        return self.extraction.picture.exposure * getattr(getattr(result, of), pass_name)

    def _image(self, result, values) -> np.ndarray:
        return self._film_of(result).image(values)

    def _film_of(self, result) -> Film:
        return self.film if result.subset is None else self.film.take(result.subset)

    def _mask(self, result) -> np.ndarray:
        """Mask (H, W) of the pixels whose surfaces the technique has shaded."""
        return self._film_of(result).coverage() > 0.0

    def seconds(self) -> dict:
        """The seconds of the extraction, the shadows and the techniques."""
        seconds = {
            **self.extraction.times.stages,
            "techniques": {name: one.seconds for name, one in self.results.items()},
        }
        return seconds if self.shadows is None else {**seconds, "shadows": self.shadows.seconds}

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
            "tables": {name: described(given) for name, given in technique_names(options.techniques).items()},
            "reference": self._reference_facts(),
            "shadows": None if self.shadows is None else self.shadows.report(),
            "passes": {name: self._pass_report(name) for name in options.passes},
            "problems": list(extraction.problems),
            "warnings": imaging.grouped([*extraction.warnings, *(self.shadows.warnings() if self.shadows else ())]),
        }

    def _reference_facts(self) -> dict | None:
        if (result := self.results.get(REFERENCE)) is None:
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
        check_before_writing(progress)
        name, extraction, more = self.options.name or ("compare" if with_cycles else "shade"), self.extraction, {}
        if extraction.picture.border is not None:
            more["border"] = str(extraction.picture.border)
        if notice := self._subset_notice():
            more["reference"] = f"{notice}; elsewhere zero"
        metadata = exr.metadata_of(extraction, self.options.scene, **more)
        planes, (sheet, legend) = self.layers(), self.sheet() if with_cycles else (None, [])
        chromaticities = imaging.chromaticities(extraction.picture.color_space)
        files = [f"{name}.exr", *([f"{name}.png", self.options.page] if with_cycles else [])]
        (output / files[0]).parent.mkdir(parents=True, exist_ok=True)
        imaging.write_layers(output / files[0], planes, metadata, chromaticities, extraction.picture.pixel_aspect)
        if with_cycles:
            imaging.write_png(output / files[1], sheet)
            labels = ["Cycles", *map(title, self.results)]
            imaging.write_html(output, self.options.page, files[:2], (labels, legend), document)
        if progress is not None:
            progress("write", 1.0)
        return files

    def layers(self) -> dict[str, np.ndarray | imaging.Layer]:
        """All layers of the EXR by name."""
        planes, groups = {}, lighting.light_groups(self.extraction.lights)
        for (name, pass_name), image in self.images.items():
            layer, result = layer_name(name, pass_name), self.results[name]
            images = (self._image(result, values) for values in self._radiance(result, pass_name))
            planes |= {layer: image, **exr.by_group(layer, groups, images)}
            if result.unshadowed is not None:
                values = self._radiance(result, pass_name, "unshadowed").sum(axis=0)
                planes[layer_name(f"{name}{exr.UNSHADOWED}", pass_name)] = self._image(result, values)
        for pass_name, halves in self.cycles.items():
            if pass_name not in self.options.passes:
                continue
            for name, pixels in zip(exr.CYCLES_LAYERS, (halves.mean(axis=0), *halves), strict=True):
                planes[layer_name(name, pass_name)] = pixels
            for name in self.results:
                planes[layer_name(f"{exr.ERROR}{name}", pass_name)] = self._error(name, pass_name)
        planes |= self._whole_layers() | self._visibility_layers()
        # A surface with several lobes shows the first of them.
        first = slice(None) if self.film.first is None else np.nonzero(self.film.first)[0]
        film = self.film.take(first)
        for field, letters in SAMPLE_LAYERS.items():
            values = getattr(self.extraction.samples, field)[first]
            planes[layer_name("samples", field)] = imaging.Layer(film.image(values), letters)
        if self.extraction.glass is not None:
            planes[exr.GLASS] = imaging.Layer(self.extraction.glass, "V")
        planes[exr.COVERAGE] = imaging.Layer(self.film.coverage(), "V")
        return planes

    def _whole_layers(self) -> dict[str, np.ndarray]:
        """Layers of the whole pictures of the techniques and of Cycles' direct light, and their errors.

        Empty where `rest` is not known: then the passes are not all of the light.
        """
        if self.rest is None:
            return {}
        planes, is_surface = {}, self.film.coverage() > 0.0
        cycles = sum(self.cycles[name].mean(axis=0) for name in PASSES) if self.cycles else None
        for name, result in self.results.items():
            missing = is_surface & ~self._mask(result)
            planes[layer_name(name, COMBINED)] = np.where(missing[..., None], 0.0, self.whole(name))
            if self.transmitted is not None:
                planes[layer_name(name, TRANSMITTED)] = self.transmitted.whole(name)[..., :3]
            if cycles is not None:
                error = sum(self._error(name, pass_name) for pass_name in PASSES)
                planes[layer_name(f"{exr.ERROR}{name}", COMBINED)] = error
        if cycles is not None:
            planes[layer_name(CYCLES, COMBINED)] = self._with_rest(cycles)
        return planes

    def _error(self, name: str, pass_name: str) -> np.ndarray:
        """Technique minus Cycles (H, W, 3); 0 where the technique did not shade."""
        error = self.images[name, pass_name] - self.cycles[pass_name].mean(axis=0)
        return np.where(self._mask(self.results[name])[..., None], error, 0.0)

    def _visibility_layers(self) -> dict[str, imaging.Layer]:
        """Layers of the share of each light that is seen, 1 where there is no surface; none for very many lights.

        Lights that share their rays have one layer, named after the first of them.
        """
        shadows, planes = self.shadows, {}
        if shadows is None or len(shadows.numbers) > MOST_VISIBILITY_LAYERS:
            return planes
        names = exr.unique_names(self.extraction.lights[numbers[0]].name for numbers in shadows.numbers)
        nothing = 1.0 - self.film.coverage()
        first = slice(None) if self.film.first is None else np.nonzero(self.film.first)[0]
        film = self.film.take(first)
        for pass_name in self.options.passes:
            for name, share in zip(names, shadows.shares[pass_name], strict=True):
                image = imaging.Layer(film.image(share[first]) + nothing, "V")
                planes[layer_name("visibility", pass_name, name)] = image
        return planes

    def sheet(self) -> tuple[np.ndarray, list[str]]:
        """The comparison sheet (H, W, 3), 8 bit, and a line about each of its rows: both passes together where both
        were shaded, then each pass."""
        wanted = [name for name in PASSES if name in self.options.passes]
        rows = [(name,) for name in wanted] if len(wanted) == 1 else [PASSES, *((name,) for name in wanted)]
        sheets, legend = zip(*map(self._sheet_of, rows), strict=True)
        return np.concatenate(sheets), list(legend)

    def _sheet_of(self, passes: tuple[str, ...]) -> tuple[np.ndarray, str]:
        """The sheet of the sum of `passes`, and a line about it."""
        halves = sum(self.cycles[name] for name in passes)
        mean, rec709 = halves.mean(axis=0), self.extraction.picture.color_space.rec709
        hit, tiles, errors = self.film.coverage() > 0.0, [], []
        # The picture of all passes also shows the background and lights in sight. Its errors are those of the light.
        behind = 0.0 if self.rest is None or len(passes) == 1 else self.rest[..., :3]
        for name, result in self.results.items():
            image, missing = sum(self.images[name, one] for one in passes) + behind, None
            if result.subset is not None:
                missing = hit & ~self._mask(result)
            error = rec709(sum(self._error(name, one) for one in passes))
            tiles.append(imaging.Tile(title(name), rec709(image), error, missing))
            image = sum(self.images[name, one] for one in passes)
            beside = imaging.noisy_error_statistics(image, *halves, self._mask(result)).to_dict()
            errors.append(f"{title(name)} {unbiased(beside)}")
        sheet, scales = imaging.comparison_sheet(rec709(mean + behind), tiles)
        light = passes[0] if len(passes) == 1 else COMBINED
        line = f"{light} radiance: errors against Cycles {', '.join(errors)}; {scales}"
        if self.shadows is not None and len(passes) == 1:
            line += f"; noise of our shadows {percent(self.shadows.noise[passes[0]])}"
        if notice := self._subset_notice():
            line += f"; {notice}, elsewhere gray"
        return sheet, line


def most_accurate(names) -> str:
    """The last of the technique names, by convention the most accurate. The reference comes only if it is alone,
    because it may cover some of the pixels only."""
    names = list(names)
    return next((name for name in reversed(names) if name != REFERENCE), names[-1])


def against_cycles(image, halves, mask, rec709=np.asarray) -> dict:
    """Error figures of an image (H, W, 3) against the halves (2, H, W, 3) of Cycles, in the shaded `mask` (H, W)."""
    statistics, mean = imaging.noisy_error_statistics(image, *halves, mask), halves.mean(axis=0)
    shaded = np.where(mask[..., None], image, mean)
    return {**statistics.to_dict(), "flip": imaging.mean_flip(rec709(mean), rec709(shaded), mask)}


def _light_reports(lights) -> list[dict]:
    """Entries of report.json for `lights`. The faces of a mesh light are one entry, with their mean radiance."""
    entries = []
    for kind, same in itertools.groupby(lights, lambda light: (light.name, light.shape, light.group)):
        same = list(same)
        # Polygons of one name are faces of one light. Other lights of one name are instances.
        for faces in [same] if kind[1] == "POLYGON" else [[light] for light in same]:
            radiance = faces[0].radiance
            if len(faces) > 1:
                areas = np.array([np.linalg.norm(light.area_vector) for light in faces])
                radiance = areas @ np.array([light.radiance for light in faces]) / areas.sum()
            patches = sum(len(light.leaves) for light in faces)
            entry = dict(zip(("name", "shape", "group"), kind, strict=True))
            entries.append({**entry, "radiance": radiance.tolist(), "patches": patches})
    return entries


def material_classes(samples: SurfaceSamples) -> dict[str, np.ndarray]:
    """Masks (P,) of the samples whose specular lobe is mostly a metal's, or mostly a dielectric's."""
    metal = samples.specular_f90.max(axis=1, initial=0.0)
    dielectric = samples.dielectric.max(axis=1, initial=0.0)
    return {"metals": (metal > dielectric) & (metal > 0.0), "dielectrics": (dielectric >= metal) & (dielectric > 0.0)}


def percent(value) -> str:
    """A share as text."""
    return "-" if value is None else f"{100.0 * value:.2f} %"


def unbiased(figures: dict) -> str:
    """The error against two noisy halves as text; "in noise" where the unbiased square of the error is negative."""
    squared = figures.get("unbiased_squared_error")
    return "in noise" if squared is not None and squared < 0.0 else percent(figures.get("unbiased_relative_error"))
