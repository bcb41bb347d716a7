"""`shade`: takes samples and lights, returns radiance in rows of lights, block by block.

A `Task` shades each block. It is the same in this process and in worker processes.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..emitters import light_profile
from ..emitters.light_polygons import fitting_patches
from ..emitters.light_tree import FEWEST, is_special
from ..lobes import moments32
from ..lobes.lobe_integrals import FLOAT64_CHUNK
from ..lobes.lookup_table import LookupTable, load_table
from ..scene import DEFAULT_TECHNIQUE, PASSES, REFERENCE, Cancelled, Light, SurfaceSamples
from ..workers.pool import WorkerPool, opened
from . import float32, float64

# Least and greatest number of samples of a block, one or two chunks. One process takes a block at a time, and calls of
# `progress` come between blocks. Towards the end blocks get shorter, so that all processes end at about the same time.
BLOCK_LIMITS = (24592, 49184)
REFERENCE_BLOCK_LIMITS = (256, 2048)
# Nanoseconds per sample and pass, for each light and for each of its corners. They are rough; they tell short tasks
# from long ones. _SINGLE_COST: in single precision for degree 0. _COST_PER_DEGREE: what each degree adds to that.
_SINGLE_COST, _COST_PER_DEGREE = (20.0, 15.0), (10.0, 7.0)
_DOUBLE_COST, _REFERENCE_COST = (100.0, 120.0), (20_000.0, 1000.0)
# A worker takes about 0.2 s to start, so shorter tasks are done in this process alone.
SECONDS_WORTH_A_WORKER = 0.5
# An anisotropic sample takes about as long as this many isotropic ones.
ANISOTROPIC_COST = 6
# Up to so many lights, each has a row of the result unless the caller says otherwise.
MOST_SINGLE_ROWS = 64
# Number of lights of which all are looked at for an estimate of time.
MANY = 256
# Estimate of the most patches of a light that a sample takes.
PATCHES = 60
# Distant lights with a smaller half side, in units of their distance, are too small for a `SkyMap`.
SPOT = 0.3


@dataclass(frozen=True)
class Task:
    """The lights, table and passes with which to shade every block of samples."""

    lights: tuple[Light, ...]  # L
    rows: tuple[int, ...]  # (L,) the row of the result to which each light is added
    row_count: int  # R
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
        """True if the result comes with an estimate of its error."""
        return self.is_reference and "specular" in self.passes

    def seconds(self, count: int) -> float:
        """Estimated time in s that one process needs for `count` samples."""
        per_light, per_corner = _REFERENCE_COST if self.is_reference else _DOUBLE_COST
        if self.single:
            degree = self.table.degree if "specular" in self.passes else 0
            per_light, per_corner = (
                base + degree * more for base, more in zip(_SINGLE_COST, _COST_PER_DEGREE, strict=True)
            )
        # Of many lights, some stand for all.
        some = self.lights[:: max(1, len(self.lights) // MANY)]
        corners = sum(_corners_integrated(light, self.is_reference) for light in some)
        corners *= len(self.lights) / max(len(some), 1)
        return 1e-9 * count * len(self.passes) * (per_light * len(self.lights) + per_corner * corners)

    @cached_property
    def _scratch(self) -> moments32.Scratch:
        return moments32.Scratch()

    def do(self, samples: SurfaceSamples, context=None) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Radiance (R, B, 3) by pass of a block of B samples, and the error (B,) of the reference, else None."""
        radiance = {name: np.zeros((self.row_count, len(samples), 3), self.dtype) for name in self.passes}
        error = np.zeros(len(samples)) if self.has_error else None
        in_float64 = self._add(samples, self._plain, radiance, error)
        if self._with_patches is not None and self.single:
            float32.shade_skies(samples, self._with_patches, self.table, radiance)
        elif self._with_patches is not None:
            self._add(samples, self._with_patches, radiance, error)
        for light, row in self._rows_of_lights:
            if light.children and not float64.has_patches(light):
                for name in self.passes:
                    index = in_float64[name] if self._has_tree(light) else np.arange(len(samples))
                    self._add_detailed((samples, index), light, name, radiance[name][row : row + 1], error)
        return radiance, error

    @property
    def _rows_of_lights(self):
        return zip(self.lights, self.rows, strict=True)

    @cached_property
    def _plain(self) -> dict[str, float32.Lights]:
        """The lights without children, then the leaves of those with a tree, by pass."""
        trees = [(light, row) for light, row in self._rows_of_lights if self._has_tree(light)]
        leaves = [(leaf, row) for light, row in trees for leaf in light.leaves]
        return self._by_pass((one for one in self._rows_of_lights if not one[0].children), leaves)

    def _has_tree(self, light) -> bool:
        """True for a textured light whose leaves are shaded as a tree of many lights."""
        return self.single and len(light.leaves) >= FEWEST and not any(map(is_special, light.leaves))

    @cached_property
    def _with_patches(self) -> dict[str, float32.Lights] | None:
        lights = [one for one in self._rows_of_lights if float64.has_patches(one[0])]
        return self._by_pass(lights) if lights else None

    def prepare(self) -> None:
        """Compute now what all processes need."""
        if self.single:
            for lights in (self._with_patches or {}).values():
                _ = lights.skies
            for lights in self._plain.values():
                _ = lights.trees, lights.alike

    def _by_pass(self, lights, leaves=()):
        lights, leaves = _prepared(lights), _prepared(leaves)
        lights_by_pass = {name: float32.Lights.of(lights, name, leaves) for name in self.passes}
        # If the same lights affect both passes, these share their trees.
        if len({tuple(id(light) for light, _, _ in of_pass) for of_pass in lights_by_pass.values()}) > 1:
            return lights_by_pass
        return dict.fromkeys(lights_by_pass, lights_by_pass[self.passes[0]])

    def _add_detailed(self, among, light, name, radiance, error) -> None:
        """Add a light with children to its row (1, B, 3) of one pass, for samples and the numbers of some of them."""
        samples, chosen = among
        for index, patches in fitting_patches(light, samples.take(chosen), name == "specular"):
            index = chosen[index]
            patch_radiance = {name: np.zeros((1, len(index), 3), self.dtype)}
            own_error = None if error is None else np.zeros(len(index))
            prepared = float32.Lights(_prepared((patch, 0) for patch in patches))
            self._add(samples.take(index), {name: prepared}, patch_radiance, own_error)
            radiance[:, index] += patch_radiance[name]
            if error is not None:
                error[index] += own_error

    def _add(self, samples, prepared, radiance, error) -> dict[str, np.ndarray]:
        """Add the light of the `prepared` lights by pass to `radiance`. Returns, by pass, the numbers of the samples
        that took no leaves of textured lights."""
        in_float64 = {}
        if self.single:
            scratch = self._scratch
            if "diffuse" in radiance:
                in_float64["diffuse"] = float32.shade_diffuse(
                    samples, prepared["diffuse"], radiance["diffuse"], scratch
                )
            if "specular" in radiance:
                in_float64["specular"] = float32.shade_specular(
                    samples, prepared["specular"], self.table, radiance["specular"], scratch
                )
            return in_float64
        for start in range(0, len(samples), FLOAT64_CHUNK):
            chunk = slice(start, start + FLOAT64_CHUNK)
            batch = samples.take(chunk)
            views = {name: values[:, chunk] for name, values in radiance.items()}
            if "diffuse" in views:
                float64.shade_diffuse(batch, prepared["diffuse"], views["diffuse"])
            if "specular" in views:
                estimates = None if error is None else error[chunk]
                float64.shade_specular(batch, prepared["specular"], self.table, views["specular"], estimates)
        return in_float64


def _prepared(lights):
    """(light, row, corners) of lights with their rows."""
    return [(light, row, light.polygon()) for light, row in lights]


def _corners_integrated(light, is_reference):
    """Estimated number of corners in the integrals over a light."""
    count = len(light.polygon()) * min(len(light.leaves), PATCHES)
    if light.has_profile:
        effort = light_profile.DISK_LAYERS[1]
        count *= (2 * effort.chords + 1) * (1 if is_reference else effort.layers)
    return count


@dataclass(frozen=True)
class Shading:
    """Reflected radiance in W m^-2 sr^-1, in rows of lights. A pass that was not asked for is None."""

    specular: np.ndarray | None = None  # (R, P, 3)
    diffuse: np.ndarray | None = None  # (R, P, 3)
    quadrature_error: np.ndarray | None = None  # (P,) estimate for F = 1 and unit radiance; "reference" only

    @property
    def combined(self) -> np.ndarray:
        """Sum (P, 3) over the passes and rows."""
        return sum(radiance.sum(axis=0) for radiance in (self.specular, self.diffuse) if radiance is not None)


class OwnTechnique(Protocol):
    """A technique of the user: anything with this method. An attribute `name` replaces the name of its class."""

    def evaluate(self, samples: SurfaceSamples, lights: tuple[Light, ...]) -> Shading:
        """Radiance of `samples` (P) under all `lights` together; its rows are added up.

        The lights have no children. The caller takes care of samples that a light's passes or receivers leave out. If
        the diffuse pass is None, the caller uses the exact one.
        """
        ...


def is_own(technique: Any) -> bool:
    """True for an `OwnTechnique`."""
    return callable(getattr(technique, "evaluate", None))


def shade(
    samples: SurfaceSamples,
    lights: Iterable[Light],
    technique: str | Path | LookupTable | OwnTechnique = DEFAULT_TECHNIQUE,
    *,
    passes: Sequence[str] = PASSES,
    workers: int | WorkerPool | None = None,
    progress: Callable[[float], bool | None] | None = None,
    dtype=np.float32,
    rows: Sequence[int] | None = None,
) -> Shading:
    """Direct, unoccluded reflected radiance of `samples` (P) under `lights` (L).

    `rows` (L,) are integers from 0 on: the row of the result to which each light is added. By default each of up to 64
    lights has a row; more are added to one. Many lights of one row may be merged where a sample cannot tell them apart.

    `technique` is "reference" (quadrature of the true BRDF), a shipped table, a table's path, a LookupTable or an
    OwnTechnique. Diffuse light is exact for polygons in all techniques except the last. `workers` processes (default:
    all cores), or those of a pool, give the same result bit for bit; this process shades few samples alone.
    `progress(fraction)` may return False to stop: Cancelled is raised. Also raises TableError and ValueError.

    With `dtype` float32, radiance is float32 and within 2e-5 of that with float64, per unit of the lights' radiance;
    for lights with a spread, of their radiance straight ahead. Spreads are accurate to 0.3 % (see `light_profile`).
    Points for which single precision does not suffice are computed in double. So are lights a thousand times as long as
    wide, whose error in single precision is 4e-4 of their light, and always "reference" and degrees above 4. A sky of
    one radiance is the exception: of lobes with one horizon it gives their albedo in single precision alone.
    """
    if is_own(technique):
        return _shade_with(technique, samples, tuple(lights), tuple(passes), (workers, progress, dtype, rows))
    task = _task(tuple(lights), technique, passes, dtype, rows)
    task.prepare()
    blocks = _blocks(len(samples), *(REFERENCE_BLOCK_LIMITS if task.is_reference else BLOCK_LIMITS))
    result = {name: np.zeros((task.row_count, len(samples), 3), dtype) for name in task.passes}
    quadrature_error = np.zeros(len(samples)) if task.has_error else None
    is_worth = (
        task.seconds(len(samples) + ANISOTROPIC_COST * np.count_nonzero(samples.anisotropy)) >= SECONDS_WORTH_A_WORKER
    )

    def store(number, shaded):
        radiance, error = shaded
        for name, values in radiance.items():
            result[name][:, blocks[number]] = values
        if error is not None:
            quadrature_error[blocks[number]] = error

    with opened(workers) as pool:
        for done in pool.run(task, len(blocks), lambda number: samples.take(blocks[number]), store, is_worth):
            if progress is not None and progress(done / len(blocks)) is False:
                raise Cancelled("shading was stopped")
    return Shading(result.get("specular"), result.get("diffuse"), quadrature_error)


def _shade_with(technique, samples, lights, passes, how) -> Shading:
    """The result of an OwnTechnique, computed light by light."""
    _check_passes(passes)
    workers, progress, dtype, rows = how
    rows = _rows(rows, len(lights))
    radiance = {name: np.zeros((1 + max(rows, default=0), len(samples), 3), dtype) for name in passes}
    for number, (light, row) in enumerate(zip(lights, rows, strict=True)):
        shaded = technique.evaluate(samples, light.leaves) if light.area_vector.any() else None
        for name in passes if shaded is not None else ():
            if not getattr(light, f"affects_{name}"):
                continue
            reflected = _own_pass(technique, shaded, name, len(samples))
            if reflected is None:
                reflected = shade(samples, [light], passes=(name,), workers=workers, dtype=dtype).diffuse
            received = light.receives(samples.receiver)
            reflected = np.asarray(reflected).sum(axis=0)
            radiance[name][row] += reflected if received is None else reflected * received[:, None]
        if progress is not None and progress((number + 1) / len(lights)) is False:
            raise Cancelled("shading was stopped")
    return Shading(radiance.get("specular"), radiance.get("diffuse"))


def _own_pass(technique, shaded, name, count) -> np.ndarray | None:
    """A pass (R, P, 3) of what an OwnTechnique returned. Raises ValueError if it is not usable."""
    subject = f"technique {type(technique).__name__}: evaluate"
    if not isinstance(shaded, Shading):
        raise ValueError(f"{subject} returned {type(shaded).__name__}, expected a ltsh_addon.shading.Shading")
    values = getattr(shaded, name)
    if values is None and name == "diffuse":
        return None
    shape = np.shape(values)
    if len(shape) != 3 or shape[1:] != (count, 3):
        raise ValueError(f"{subject} returned {name} of shape {shape}, expected (rows, {count}, 3)")
    return values


def _blocks(count: int, least: int, most: int) -> list[slice]:
    """Slices that make up `count` samples. They are `most` long; when fewer than four such blocks are left, their
    length is halved, down to `least`. They do not depend on the number of processes."""
    blocks, start, size = [], 0, most
    while start < count:
        while size // 2 >= least and 4 * size > count - start:
            size //= 2
        blocks.append(slice(start, min(start + size, count)))
        start += size
    return blocks


def _check_passes(passes) -> None:
    if not passes or not set(passes) <= set(PASSES):
        raise ValueError(f"passes are {list(passes)}, expected some of {', '.join(PASSES)}")


def _parts(light) -> tuple[Light, ...]:
    """The parts of a light that get an integral each: the patches of a small distant light; else the light itself."""
    is_spot = float64.has_patches(light) and np.linalg.norm(light.half_u) < SPOT * np.linalg.norm(light.center)
    return light.leaves if is_spot else (light,)


def _rows(rows, count: int) -> list[int]:
    """The rows of `count` lights; see `shade`. Raises ValueError."""
    if rows is None:
        return list(range(count)) if count <= MOST_SINGLE_ROWS else [0] * count
    rows = np.asarray(rows)
    if rows.shape != (count,) or (count and (rows.dtype.kind not in "iu" or rows.min() < 0)):
        raise ValueError(
            f"rows are {rows.dtype} of shape {rows.shape}, expected {count} integers from 0 on, one a light"
        )
    return rows.tolist()


def _task(lights, technique, passes, dtype, rows) -> Task:
    _check_passes(passes)
    if np.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(f"dtype is {np.dtype(dtype)}, expected float32 or float64")
    table = technique
    if isinstance(technique, str | Path) and technique != REFERENCE:
        table = load_table(technique)
    if not isinstance(table, str) and table.family == "ltsh":
        # Workers get this matrix with the table, because LAPACK need not give the same last bits in every process.
        _ = table.ridge_weights
    rows = _rows(rows, len(lights))
    pairs = [pair for pair in zip(lights, rows, strict=True) if any(pair[0].area_vector.tolist())]
    pairs = [(one, row) for light, row in pairs for one in _parts(light)]
    count = 1 + max(rows, default=0)
    lights, rows = (tuple(values) for values in zip(*pairs, strict=True)) if pairs else ((), ())
    fast = not isinstance(table, str) and table.degree <= moments32.MAX_DEGREE
    return Task(lights, rows, count, table, tuple(passes), fast and np.dtype(dtype) == np.float32)
