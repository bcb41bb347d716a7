"""Techniques by name, and their radiance of all samples of a picture."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from .. import shading
from ..files import check_takes_files
from ..scene import CYCLES, REFERENCE, SHIPPED_TABLES, TECHNIQUES, Cancelled, Film
from . import lighting
from .layers import unique_names

REFERENCE_SEED = 20160725
# Limits of the reference: MOST_PAIRS pairs of a sample and a light, some 30 us each, but always FEWEST_SAMPLES samples.
MOST_PAIRS, FEWEST_SAMPLES = 3_000_000, 32

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
        is_own = shading.is_own(given)
        name = str(getattr(given, "name", type(given).__name__)) if is_own else Path(given).stem
        if is_own or given not in TECHNIQUES:
            name = unique_names([*dict.fromkeys((*TECHNIQUES, CYCLES, *names)), name])[-1]
        names[name] = given
    return names


def check_named(techniques: Sequence, what: str) -> None:
    """Raise ValueError where a technique is a user's own, which `what` could not call later."""
    if unnamed := [described(given) for given in techniques if shading.is_own(given)]:
        raise ValueError(
            f"technique {unnamed[0]}: {what} cannot call it later, expected {', '.join(TECHNIQUES)} or the path of a "
            "table (.npz); leave it out"
        )


def described(given) -> str:
    """How report.json names a technique: its name, the path of its table, or the class of a user's own."""
    return f"{type(given).__module__}.{type(given).__qualname__}" if shading.is_own(given) else str(given)


def title(name: str) -> str:
    """The title of a technique on sheets and in progress; for a user's table its name."""
    return TECHNIQUES[name].title if name in TECHNIQUES else name


@dataclass(frozen=True)
class TechniqueResult:
    """Radiance of one technique on all samples, or on a subset (Q,) of them."""

    shading: shading.Shading  # radiance (G, Q, 3) per pass
    seconds: dict[str, float]  # per pass
    subset: np.ndarray | None  # (Q,) sorted indices of the samples that were evaluated, None for all
    unshadowed: shading.Shading | None = None  # the same without shadows, where `shading` has shadows

    def with_more(self, mask: np.ndarray, more: TechniqueResult) -> TechniqueResult:
        """The samples in `mask` (P,), then those of `more`; both results must be without a subset."""
        seconds = {name: value + more.seconds[name] for name, value in self.seconds.items()}
        unshadowed = None if self.unshadowed is None else self.unshadowed.with_more(mask, more.unshadowed)
        return TechniqueResult(self.shading.with_more(mask, more.shading), seconds, None, unshadowed)


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
            return None if progress is None else progress(title(name), whole)

        if report(0.0) is False:
            raise Cancelled(f"stopped before {name} shaded the {pass_name} pass")
        start = time.perf_counter()
        shadings = lighting.shade_lights(samples, extraction.lights, table, (pass_name,), wanted, progress=report)
        for of_pass, shaded in zip(lit, shadings, strict=True):
            of_pass[pass_name] = shaded
        seconds[pass_name] = time.perf_counter() - start
    shaded, *unshadowed = map(_joined, lit)
    return TechniqueResult(shaded, seconds, subset, *unshadowed)


def _joined(shaded: dict[str, shading.Shading]) -> shading.Shading:
    """Several Shadings of one pass each as one Shading."""
    first = next(iter(shaded.values()))
    passes = {name: getattr(one, name) for name, one in shaded.items()}
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
