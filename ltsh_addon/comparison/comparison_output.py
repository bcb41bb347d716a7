"""What a comparison writes: images by layer, statistics, the sheet, the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging, shading
from ..scene import Cancelled, Film
from . import compare
from .comparison_summary import percent, unbiased

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
    "receiver": "V",
}


@dataclass(frozen=True)
class Comparison:
    """The results of one scene, ready to be measured and written."""

    options: compare.Options
    extraction: Any  # blender.child.Extraction, which the core does not import
    results: dict[str, compare.Result]

    @property
    def film(self) -> Film:
        return self.extraction.film

    @property
    def cycles(self) -> dict[str, np.ndarray]:
        """Halves (2, H, W, 3) per pass; empty without a Cycles reference."""
        return self.extraction.reference or {}

    @cached_property
    def images(self) -> dict[tuple[str, str], np.ndarray]:
        """Image (H, W, 3) per technique and pass, summed over light groups."""
        return {
            (name, pass_name): self._image(result, self._radiance(result, pass_name).sum(axis=0))
            for name, result in self.results.items()
            for pass_name in self.options.passes
        }

    def _radiance(self, result, pass_name) -> np.ndarray:
        return self.extraction.exposure * getattr(result.shading, pass_name)

    def _image(self, result, values) -> np.ndarray:
        return self._film_of(result).image(values)

    def _film_of(self, result) -> Film:
        if result.subset is None:
            return self.film
        return self.film.take(result.subset)

    def _mask(self, result) -> np.ndarray:
        """Pixels (H, W) that see a surface and, for a subset, were evaluated."""
        return self._film_of(result).coverage() > 0.0

    # -- figures ------------------------------------------------------------------------------------------------------

    def report(self) -> dict:
        """The report as a JSON-able document."""
        extraction, options = self.extraction, self.options
        return {
            "scene": str(options.scene),
            "camera": extraction.camera,
            "frame": extraction.frame,
            "resolution": [self.film.width, self.film.height],
            "border": None if extraction.border is None else vars(extraction.border),
            "pixel_aspect": extraction.pixel_aspect,
            "pixel_filter": extraction.pixel_filter if self.film.sub_samples > 1 else "pixel centers",
            "exposure": extraction.exposure,
            "color_space": extraction.color_space.name,
            "sub_samples": self.film.sub_samples,
            "surface_samples": len(extraction.samples) if self.film.first is None else int(self.film.first.sum()),
            "cycles_samples": options.cycles_samples if self.cycles else 0,
            "lights": [_light_report(light) for light in extraction.lights],
            "versions": compare.versions(extraction.blender_version),
            "tables": dict(zip(self.results, options.techniques, strict=True)),
            "reference": self._reference_facts(),
            "passes": {name: self._pass_report(name) for name in options.passes},
            "warnings": list(extraction.warnings),
        }

    def _reference_facts(self) -> dict | None:
        result = self.results.get(shading.REFERENCE)
        if result is None:
            return None
        count = len(self.extraction.samples) if result.subset is None else len(result.subset)
        error = result.shading.quadrature_error
        return {
            "samples": count,
            "of": len(self.extraction.samples),
            "seed": None if result.subset is None else compare.REFERENCE_SEED,
            "largest_error_estimate": None if error is None or not len(error) else float(error.max()),
        }

    def _subset_notice(self) -> str:
        """What to know about the reference where it stands for a part of the samples only, else nothing."""
        facts = self._reference_facts()
        if facts is None or facts["samples"] == facts["of"]:
            return ""
        return f"reference on {facts['samples']} of {facts['of']} samples, randomly chosen pixels; elsewhere zero"

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
            halves = self.cycles[pass_name]
            statistics = imaging.noisy_error_statistics(
                self.images[name, pass_name], halves[0], halves[1], self._mask(result)
            )
            # Only pixels that the technique has shaded may differ.
            shaded = np.where(self._mask(result)[..., None], self.images[name, pass_name], halves.mean(axis=0))
            rec709, mask = self.extraction.color_space.rec709, self._mask(result)
            difference = imaging.mean_flip(rec709(halves.mean(axis=0)), rec709(shaded), mask)
            report["against_cycles"] = {**statistics.to_dict(), "flip": difference}
        reference = self.results.get(shading.REFERENCE)
        if reference is not None and name != shading.REFERENCE:
            report["against_reference"] = self._against_reference(result, reference, pass_name)
        return report

    def _against_reference(self, result, reference, pass_name) -> dict:
        """Statistics per sample, over all samples and over those of each class of material."""
        index = slice(None) if reference.subset is None else reference.subset
        values = self._radiance(result, pass_name).sum(axis=0)[index]
        truth = self._radiance(reference, pass_name).sum(axis=0)
        report = imaging.error_statistics(values, truth).to_dict()
        for label, mask in compare.material_classes(self.extraction.samples.take(index)).items():
            report[label] = imaging.error_statistics(values, truth, mask).to_dict()
        return report

    # -- files --------------------------------------------------------------------------------------------------------

    def write(self, output: Path, document: dict, with_cycles: bool, progress: Callable | None) -> list[str]:
        """Write all files into the folder `output`, once all that goes into them is there; their names."""
        if progress is not None and progress("write", 0.0) is False:
            raise Cancelled("stopped before the files were written")
        name = self.options.name or ("compare" if with_cycles else "shade")
        metadata = {
            "ltsh:scene": Path(self.options.scene).name,
            "ltsh:frame": str(self.extraction.frame),
            "ltsh:camera": self.extraction.camera,
            "ltsh:version": document["versions"]["ltsh"],
            "ltsh:exposure": repr(self.extraction.exposure),
            "ltsh:color_space": self.extraction.color_space.name,
        }
        if self.extraction.border is not None:
            metadata["ltsh:border"] = str(self.extraction.border)
        if notice := self._subset_notice():
            metadata["ltsh:reference"] = notice
        layers, sheet = self.layers(), self.sheet() if with_cycles else None
        chromaticities = imaging.chromaticities(self.extraction.color_space)
        files = [f"{name}.exr", *([f"{name}.png", self.options.page] if with_cycles else [])]
        (output / files[0]).parent.mkdir(parents=True, exist_ok=True)
        imaging.write_layers(output / files[0], layers, metadata, chromaticities, self.extraction.pixel_aspect)
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
                for group, values in zip(_group_names(groups), self._radiance(result, pass_name), strict=True):
                    layers[f"{name}.{pass_name}@{group}"] = self._image(result, values)
        for pass_name, halves in self.cycles.items():
            if pass_name not in self.options.passes:
                continue
            mean = halves.mean(axis=0)
            layers[f"cycles.{pass_name}"] = mean
            for half, pixels in zip("AB", halves, strict=True):
                layers[f"cycles_{half}.{pass_name}"] = pixels
            for name, result in self.results.items():
                error = self.images[name, pass_name] - mean
                layers[f"error_{name}.{pass_name}"] = np.where(self._mask(result)[..., None], error, 0.0)
        # Of a surface with several lobes its first.
        first = slice(None) if self.film.first is None else np.nonzero(self.film.first)[0]
        film = self.film.take(first)
        for field, letters in SAMPLE_LAYERS.items():
            values = getattr(self.extraction.samples, field)[first]
            layers[f"samples.{field}"] = imaging.Layer(film.image(values), letters)
        layers["coverage.hit"] = imaging.Layer(self.film.coverage(), "V")
        return layers

    def sheet(self) -> np.ndarray:
        """The comparison sheet (H, W, 3), 8 bit: the specular pass where there is one."""
        pass_name = "specular" if "specular" in self.options.passes else self.options.passes[0]
        halves = self.cycles[pass_name]
        mean, rec709 = halves.mean(axis=0), self.extraction.color_space.rec709
        hit = self.film.coverage() > 0.0
        noise = imaging.reference_noise(halves[0], halves[1], hit)
        tiles = []
        for name, result in self.results.items():
            report = self._technique_report(name, pass_name)
            error = np.where(self._mask(result)[..., None], self.images[name, pass_name] - mean, 0.0)
            label = compare.LABELS.get(name, name)
            image = self.images[name, pass_name]
            tiles.append(imaging.Tile(label, rec709(image), rec709(error), _caption(report)))
        title = f"{Path(self.options.scene).stem}: {pass_name} radiance beside Cycles"
        notes = [
            f"{self.film.width} x {self.film.height}, {self.options.cycles_samples} Cycles samples",
            f"noise of the Cycles reference {percent(noise)}",
        ]
        if notice := self._subset_notice():
            notes.append(notice)
        return imaging.comparison_sheet(title, ("Cycles", rec709(mean)), tiles, notes=notes)


def _group_names(groups) -> list[str]:
    """Names of the light groups for layers; lights without a group get one that no group has."""
    ungrouped = "ungrouped"
    while ungrouped in groups:
        ungrouped += "_"
    return [group or ungrouped for group in groups]


def _caption(report: dict) -> list[str]:
    lines = [f"against Cycles {unbiased(report['against_cycles'])}"]
    if "against_reference" in report:
        lines.append(f"against reference {percent(report['against_reference']['relative_l2'])}")
    return lines


def _light_report(light) -> dict:
    """What report.json says about `light`; `radiance` is the mean of its patches."""
    return {
        "name": light.name,
        "shape": light.shape,
        "group": light.group,
        "radiance": light.radiance.tolist(),
        "patches": len(light.patches),
    }
