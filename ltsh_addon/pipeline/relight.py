"""Pictures made anew of the samples that they have kept: other powers and colors of lights, without a ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import imaging
from ..scene import AreaLight, Progress, SurfaceSamples, listed
from . import picture
from .lighting import KEPT_SUFFIX, KeptPicture
from .options import PictureOptions

NO_CYCLES = "Cycles' picture and the errors beside it are left out: they show the lights as they were"
KEPT_WEIGHTS = (
    "{} of {} samples, between the horizons of their face and of its smooth normal, weigh both as the lights were; "
    "render the picture again for the last digits there"
)


@dataclass(frozen=True)
class LightChange:
    """What becomes of the lights called `name`."""

    name: str
    power: float = 1.0  # factor
    color: tuple[float, float, float] | None = None  # in place of its own, whose brightest channel counts as 1


def relight(folder: Path, changes: Sequence[LightChange], output: Path, progress: Progress | None = None) -> dict:
    """Write the pictures that `folder` has kept samples of with changed lights into `output`.

    Files and layers have the same names, but for those of Cycles. Returns report.json of the only picture, else
    {"reports": [...]}. Raises ValueError for an unknown light or where nothing was kept, OSError, TableError.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(folder.rglob(f"*{KEPT_SUFFIX}"))
    if not files:
        raise ValueError(f"{folder}: no picture kept its samples there; run shade or compare with --keep-visibility")
    reports = [_relit(path, path.relative_to(folder), changes, output, progress) for path in files]
    report = reports[0] if len(reports) == 1 else {"reports": reports}
    imaging.write_json(output / "report.json", report)
    return report


def _relit(path: Path, place: Path, changes, output: Path, progress) -> dict:
    """The report of the picture that kept its samples in `path`; its files are at the same `place` below `output`."""
    kept = KeptPicture.load(path)
    lights = changed_lights(kept.extraction.lights, changes)
    if kept.shadows is not None:
        _check_shared(kept, lights)
    name = place.as_posix().removesuffix(KEPT_SUFFIX)
    options = PictureOptions(output=output, name=name, **kept.options)
    tables = picture.prepare(options)
    warnings = kept.extraction.warnings + ((NO_CYCLES,) if kept.had_cycles else ())
    if split := _split_at_horizons(kept.extraction.samples):
        warnings += (KEPT_WEIGHTS.format(split, len(kept.extraction.samples)),)
    extraction = replace(kept.extraction, lights=lights, warnings=warnings)
    results = picture.evaluated(tables, extraction, kept.shadows, options, progress)
    comparison = picture.Comparison(options, extraction, results, kept.shadows)
    changed = [{"light": change.name, "power": change.power, "color": change.color} for change in changes]
    report = {**comparison.report(), "relit": changed}
    return {"files": comparison.write(output, report, False, progress), **report}


def _split_at_horizons(samples: SurfaceSamples) -> int:
    """How many samples are the second part of what `cycles.horizons` has split by the chances of the lights."""
    same = [
        (getattr(samples, name)[1:] == getattr(samples, name)[:-1]).all(axis=1)
        for name in ("position", "normal", "smooth_normal", "geometric_normal")
    ]
    return int((same[0] & same[1] & same[2] & ~same[3]).sum())


def _check_shared(kept: KeptPicture, lights: Sequence[AreaLight]) -> None:
    """Raise ValueError where lights that share their shadow rays are changed differently."""
    before = kept.extraction.lights
    for own in kept.shadows.numbers:
        first = own[0]
        for number in own[1:] if not before[first].is_distant else ():
            expected = before[number].radiance.sum() * lights[first].radiance
            if not np.allclose(lights[number].radiance * before[first].radiance.sum(), expected, rtol=1e-2):
                names = " and ".join(repr(before[each].name) for each in (first, number))
                raise ValueError(
                    f"lights {names} are two of {len(own)} that share their shadow rays, expected the same change for "
                    "all of them: change them in Blender and run the picture again, or give them light groups first"
                )


def changed_lights(lights: Sequence[AreaLight], changes: Sequence[LightChange]) -> tuple[AreaLight, ...]:
    """`lights` with all `changes`. Raises ValueError for a light that is not there."""
    names = list(dict.fromkeys(light.name for light in lights))
    found = list(lights)
    for change in changes:
        if change.name not in names:
            raise ValueError(f"light {change.name!r} is not in the picture; lights there: {listed(map(repr, names))}")
        own = [light for light in lights if light.name == change.name]
        factor = change.power * _tint(own, change)
        found = [_scaled(light, factor) if light.name == change.name else light for light in found]
    return tuple(found)


def _tint(own: list[AreaLight], change: LightChange) -> np.ndarray:
    """By what the radiance of a light of several parts is multiplied to get the color."""
    if change.color is None:
        return np.ones(3)
    weights = [np.linalg.norm(light.area_vector) for light in own]
    mean = np.average([light.radiance for light in own], axis=0, weights=weights)
    missing = [channel for channel, value in zip(("red", "green", "blue"), mean, strict=True) if value == 0.0]
    if missing and any(change.color[("red", "green", "blue").index(channel)] for channel in missing):
        raise ValueError(f"light {change.name!r} has no {' and no '.join(missing)}: render it anew to give it some")
    own_color = mean / np.max(np.abs(mean), initial=0.0, where=mean != 0.0) if mean.any() else np.ones(3)
    return np.divide(change.color, own_color, out=np.zeros(3), where=own_color != 0.0)


def _scaled(light: AreaLight, factor: np.ndarray) -> AreaLight:
    detail = tuple(_scaled(part, factor) for part in light.detail)
    return replace(light, radiance=light.radiance * factor, detail=detail)
