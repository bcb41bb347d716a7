"""Shading of surface samples by area lights: light groups, blocks of samples, precision, progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..scene import AreaLight, SurfaceSamples
from . import edge_loop
from . import workers as worker_processes
from .double_precision import REFERENCE
from .lookup_table import LookupTable, load_table
from .task import Task

PASSES = ("specular", "diffuse")
# Samples of a block, which is what one process takes at a time, and what is shaded between two calls of `progress`:
# one or two chunks; towards the end they get shorter, so that all processes end at about the same time.
BLOCK_LIMITS = (24592, 49184)
REFERENCE_BLOCK_LIMITS = (256, 2048)


@dataclass(frozen=True)
class Shading:
    """Reflected radiance in W m^-2 sr^-1 per light group; a pass that was not asked for is None."""

    groups: tuple[str, ...]
    specular: np.ndarray | None  # (G, P, 3)
    diffuse: np.ndarray | None  # (G, P, 3)
    quadrature_error: np.ndarray | None = None  # (P,) estimate for F = 1 and unit radiance, of "reference" only

    @property
    def combined(self) -> np.ndarray:
        """Sum (P, 3) over the passes and light groups."""
        return sum(part.sum(axis=0) for part in (self.specular, self.diffuse) if part is not None)


def shade(
    samples: SurfaceSamples,
    lights: Iterable[AreaLight],
    technique: str | Path | LookupTable = "ltsh4",
    *,
    passes: Sequence[str] = PASSES,
    workers: int | None = None,
    progress: Callable[[float], bool | None] | None = None,
    dtype=np.float32,
) -> Shading:
    """Direct, unoccluded reflected radiance of `samples` (P) under `lights`.

    `technique` is "reference" (quadrature of the true BRDF), a shipped table, a table's path or a LookupTable. Diffuse
    is exact for polygons in every technique. `workers` processes (default: all cores) give the same result bit for bit;
    few samples are shaded in this process. `progress(fraction)` may return False to stop: Cancelled is raised.
    With `dtype` float32 radiance is float32 and within 2e-5 of that with float64, per unit of the lights' radiance,
    for lights with a spread of that straight ahead; their spread is exact to 0.3 % (see `light_cone`);
    points where single precision does not suffice are computed in double. "reference" and degrees above 4 always are.
    Raises TableError and ValueError.
    """
    task = _task(tuple(lights), technique, passes, dtype)
    count = len(samples)
    shape = (len(task.groups), count, 3)
    radiance = {name: np.zeros(shape, np.dtype(dtype)) for name in task.passes}
    error = np.zeros(count) if task.has_error else None

    def keep(block, found, estimates):
        for name, values in found.items():
            radiance[name][:, block] = values
        if error is not None:
            error[block] = estimates

    blocks = _blocks(count, *(REFERENCE_BLOCK_LIMITS if task.is_reference else BLOCK_LIMITS))
    worker_processes.run(task, samples, blocks, workers, keep, progress)
    return Shading(task.groups, radiance.get("specular"), radiance.get("diffuse"), error)


def _blocks(count: int, least: int, most: int) -> list[slice]:
    """Slices that make up `count` samples: `most` long, and half of that, down to `least`, where fewer than four such
    blocks are left. They do not depend on how many processes there are."""
    blocks, start, size = [], 0, most
    while start < count:
        while size // 2 >= least and 4 * size > count - start:
            size //= 2
        blocks.append(slice(start, min(start + size, count)))
        start += size
    return blocks


def _task(lights, technique, passes, dtype) -> Task:
    unknown = [name for name in passes if name not in PASSES]
    if unknown or not passes:
        raise ValueError(f"passes are {list(passes)}, expected some of {', '.join(PASSES)}")
    if np.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(f"dtype is {np.dtype(dtype)}, expected float32 or float64")
    table = technique
    if isinstance(technique, str | Path) and technique != REFERENCE:
        table = load_table(technique)
    if not isinstance(table, str) and table.family == "ltsh":
        # Workers get this matrix with the table: LAPACK need not give the same last bits in every process.
        _ = table.ridge_weights
    groups = tuple(dict.fromkeys(light.group for light in lights)) or ("",)
    lights = tuple(light for light in lights if light.area_vector.any())
    fast = not isinstance(table, str) and table.degree <= edge_loop.MAX_DEGREE
    return Task(lights, groups, table, tuple(passes), fast and np.dtype(dtype) == np.float32)
