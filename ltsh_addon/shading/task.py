"""What is to be done with every block of samples: the same in this process and in a worker process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene import AreaLight, SurfaceSamples
from . import double_precision, light_cone, single_precision
from .light_detail import fitting_patches
from .lookup_table import LookupTable

# Double precision arrays of this many samples stay in the cache.
DOUBLE_CHUNK = 4096
# Nanoseconds that a light, and a corner of it, takes per sample and pass: rough, to tell short tasks from long ones.
# In single precision for degree 0, and that for every degree more.
_SINGLE_COST, _COST_PER_DEGREE = (20.0, 15.0), (10.0, 7.0)
_DOUBLE_COST, _REFERENCE_COST = (100.0, 120.0), (20_000.0, 1000.0)
# About how many patches of a light a sample takes at most.
PATCHES = 60


@dataclass(frozen=True)
class Task:
    """What to do with every block of samples."""

    lights: tuple[AreaLight, ...]
    groups: tuple[str, ...]
    table: LookupTable | str  # or REFERENCE
    passes: tuple[str, ...]
    single: bool

    @property
    def dtype(self):
        """Type of the result."""
        return np.dtype(np.float32 if self.single else np.float64)

    @property
    def is_reference(self) -> bool:
        return isinstance(self.table, str)

    @property
    def has_error(self) -> bool:
        """True where the result comes with an estimate of its error."""
        return self.is_reference and "specular" in self.passes

    def seconds(self, count: int) -> float:
        """About how long `count` samples take one process."""
        per_light, per_corner = _REFERENCE_COST if self.is_reference else _DOUBLE_COST
        if self.single:
            degree = self.table.degree if "specular" in self.passes else 0
            per_light, per_corner = (
                base + degree * more for base, more in zip(_SINGLE_COST, _COST_PER_DEGREE, strict=True)
            )
        corners = sum(_corners_integrated(light, self.is_reference) for light in self.lights)
        return 1e-9 * count * len(self.passes) * (per_light * len(self.lights) + per_corner * corners)

    def shade(self, samples: SurfaceSamples, scratch) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Radiance (G, B, 3) by pass of one block of B samples, and the error (B,) of the reference."""
        radiance = {name: np.zeros((len(self.groups), len(samples), 3), self.dtype) for name in self.passes}
        error = np.zeros(len(samples)) if self.has_error else None
        plain = self._prepared(light for light in self.lights if not light.detail)
        self._add(samples, plain, radiance, error, scratch)
        for light in self.lights:
            if light.detail:
                for name in self.passes:
                    self._add_detailed(samples, light, name, radiance[name], error, scratch)
        return radiance, error

    def _prepared(self, lights):
        return [(light, self.groups.index(light.group), light.polygon()) for light in lights]

    def _add_detailed(self, samples, light, name, radiance, error, scratch) -> None:
        """Add the light of a light with a `detail` to one pass."""
        for index, patches in fitting_patches(light, samples, name == "specular"):
            own = {name: np.zeros((len(self.groups), len(index), 3), self.dtype)}
            own_error = None if error is None else np.zeros(len(index))
            self._add(samples.take(index), self._prepared(patches), own, own_error, scratch)
            radiance[:, index] += own[name]
            if error is not None:
                error[index] += own_error

    def _add(self, samples, prepared, radiance, error, scratch) -> None:
        """Add the light of the `prepared` lights to the passes in `radiance`."""
        if self.single:
            if "diffuse" in radiance:
                single_precision.shade_diffuse(samples, prepared, radiance["diffuse"], scratch)
            if "specular" in radiance:
                single_precision.shade_specular(samples, prepared, self.table, radiance["specular"], scratch)
            return
        for start in range(0, len(samples), DOUBLE_CHUNK):
            chunk = slice(start, start + DOUBLE_CHUNK)
            part = samples.take(chunk)
            views = {name: values[:, chunk] for name, values in radiance.items()}
            if "diffuse" in views:
                double_precision.shade_diffuse(part, prepared, views["diffuse"])
            if "specular" in views:
                estimates = None if error is None else error[chunk]
                double_precision.shade_specular(part, prepared, self.table, views["specular"], estimates)


def _corners_integrated(light, is_reference):
    """About how many corners the integrals over a light have."""
    count = len(light.polygon()) * min(len(light.patches), PATCHES)
    if light.is_focused:
        effort = light_cone.EFFORTS[1]
        count *= (2 * effort.chords + 1) * (1 if is_reference else effort.layers)
    return count
