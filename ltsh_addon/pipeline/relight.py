"""`relight`: kept pictures with changed powers and colors of their lights, without tracing a ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from .. import imaging
from ..scene import AreaLight, Progress, SurfaceSamples, listed
from . import picture
from .lighting import RELIGHT_SUFFIX, RelightData, shade_lights
from .options import PictureOptions

NO_CYCLES = "Cycles' picture and the errors beside it are left out: they show the lights as they were"
SAME_REST = "bounced light{}, and all else that Cycles has rendered, is as the lights were; there is no PNG"
BUT_GROUPS = ", but for that of light groups {}"
GRAIN = (
    "with depth of field finished pictures are denoised as a whole: light that changes shows its grain again; render "
    "the picture anew to be rid of it"
)
SAME_GLOW = "what glows, lights in sight and the background are seen as the lights were; there is no PNG"
KEPT_WEIGHTS = (
    "{} of {} samples, between the horizons of their face and of its smooth normal, weigh both as the lights were; "
    "render the picture again for the last digits there"
)


@dataclass(frozen=True)
class LightChange:
    """How the lights called `name` are changed."""

    name: str
    power: float = 1.0  # factor
    color: tuple[float, float, float] | None = None  # replaces its color, whose brightest channel counts as 1
    exposure: float = 0.0  # each step doubles the power
    muted: bool = False

    @property
    def factor(self) -> float:
        """Factor of the power by `power`, `exposure` and `muted`."""
        return 0.0 if self.muted else self.power * 2.0**self.exposure


def relight(
    folder: Path,
    changes: Sequence[LightChange],
    output: Path,
    progress: Progress | None = None,
    *,
    solo: Sequence[str] = (),
) -> dict:
    """Write the pictures whose samples are kept in `folder` into `output`, with changed lights.

    Where there are `solo` lights, all others are dark. Files and layers keep their names; those of Cycles are left
    out. Returns the report of the only picture, else {"reports": [...]}. Raises ValueError for an unknown light or
    where nothing was kept, OSError, TableError.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(folder.rglob(f"*{RELIGHT_SUFFIX}"))
    if not files:
        fix = "run shade, compare or render with --keep-visibility"
        raise ValueError(f"{folder}: no picture kept its samples there; {fix}")
    reports = [_relit(path, path.relative_to(folder), (changes, solo), output, progress) for path in files]
    report = reports[0] if len(reports) == 1 else {"reports": reports}
    imaging.write_json(output / "report.json", report)
    return report


def _relit(path: Path, place: Path, wanted, output: Path, progress) -> dict:
    """Write the picture whose samples are in `path`, at the same `place` below `output`; returns its report."""
    kept = RelightData.load(path)
    changes = [*wanted[0], *others_muted(kept.extraction.lights, wanted[1])]
    lights = changed_lights(kept.extraction.lights, changes)
    if kept.shadows is not None:
        _check_shared(kept, lights)
    name = place.as_posix().removesuffix(RELIGHT_SUFFIX)
    options = PictureOptions(output=output, name=name, **kept.options)
    tables = picture.prepare(options)
    warnings = kept.extraction.warnings + ((SAME_GLOW,) if kept.extraction.rest is not None else ())
    warnings += (NO_CYCLES,) if kept.had_cycles else ()
    if split := _split_at_horizons(kept.extraction.samples):
        warnings += (KEPT_WEIGHTS.format(split, len(kept.extraction.samples)),)
    extraction = replace(kept.extraction, lights=lights, warnings=warnings)
    results = picture.evaluated(tables, extraction, kept.shadows, options, progress)
    comparison = picture.Comparison(options, extraction, results, kept.shadows)
    if kept.rest:
        groups = [repr(group) for group in kept.rest if group]
        warnings += (SAME_REST.format(BUT_GROUPS.format(listed(groups)) if groups else ""),)
        warnings += (GRAIN,) if kept.extraction.picture.has_lens else ()
        name = kept.technique
        rest = _changed_rest(kept, lights, tables[name], results[name].shading, progress)
        extraction = replace(extraction, warnings=warnings)
        comparison = _Finished(options, extraction, results, kept.shadows, kept, rest)
    changed = [{"light": change.name, **{key: value for key, value in asdict(change).items() if key != "name"}}
               for change in changes]  # fmt: skip
    report = {**comparison.report(), "relit": changed}
    return {"files": comparison.write(output, report, False, progress), **report}


@dataclass(frozen=True)
class _Finished(picture.Comparison):
    """A finished picture: our passes, and Cycles' `rest` (H, W, 4)."""

    kept: RelightData | None = None
    rest: np.ndarray | None = None

    def layers(self) -> dict[str, np.ndarray | imaging.Layer]:
        found = {}
        for name, pixels in super().layers().items():
            technique, _, part = name.partition(".")
            pass_name = part.partition("@")[0]
            if technique in self.results and pass_name in self.options.passes:
                found[name] = pixels * self.kept.shown(pass_name)
        combined = self.rest.copy()
        for pass_name in self.options.passes:
            combined[..., :3] += found[f"{self.kept.technique}.{pass_name}"]
        return {"combined": combined, **found, "rest": self.rest}


def _changed_rest(kept: RelightData, lights: Sequence[AreaLight], table, shaded, progress) -> np.ndarray:
    """Cycles' rest (H, W, 4) under the changed `lights`: the bounced light of a group scales with its direct light.

    `shaded` is the direct light of the changed lights by `table`.
    """
    rest, before = kept.rest[""].copy(), None
    for group, bounced in kept.rest.items():
        pairs = [pair for pair in zip(kept.extraction.lights, lights, strict=True) if pair[0].group == group]
        if group == "" or not pairs:
            rest[..., :3] += 0.0 if group == "" else bounced[..., :3]
            continue
        factors = np.array([tint(old.radiance, new.radiance) for old, new in pairs])
        factor = factors.mean(axis=0)
        if np.ptp(factors, axis=0).any():
            if before is None:
                report = None if progress is None else (lambda fraction: progress("lights", fraction))
                own = kept.extraction.samples, kept.extraction.lights, table, kept.options["passes"]
                (before,) = shade_lights(*own, (kept.shadows,), progress=report)
            now, then = (_light_of_group(kept, one, group) for one in (shaded, before))
            factor = np.divide(now, then, out=factor, where=then > 0.0)
        rest[..., :3] += factor * bounced[..., :3]
    return rest


def _light_of_group(kept: RelightData, shaded, group: str) -> np.ndarray:
    """Direct light (3,) of a light group, summed over the picture."""
    number, film = shaded.groups.index(group), kept.extraction.film
    images = {name: film.image(getattr(shaded, name)[number]) for name in kept.options["passes"]}
    return sum((kept.shown(name) * image).sum(axis=(0, 1)) for name, image in images.items())


def others_muted(lights: Sequence[AreaLight], solo: Sequence[str]) -> list[LightChange]:
    """Changes that mute all lights except those called `solo`; none where `solo` is empty.

    Raises ValueError for an unknown light.
    """
    names = dict.fromkeys(light.name for light in lights)
    for name in solo:
        _check_known(name, names)
    return [LightChange(name, muted=True) for name in names if solo and name not in solo]


def _check_known(name: str, names) -> None:
    if name not in names:
        raise ValueError(f"light {name!r} is not in the picture; lights there: {listed(map(repr, names))}")


def _split_at_horizons(samples: SurfaceSamples) -> int:
    """How many samples `cycles.horizons` has split in two, by the chances of the lights."""
    same = [
        (getattr(samples, name)[1:] == getattr(samples, name)[:-1]).all(axis=1)
        for name in ("position", "normal", "smooth_normal", "geometric_normal")
    ]
    return int((same[0] & same[1] & same[2] & ~same[3]).sum())


def _check_shared(kept: RelightData, lights: Sequence[AreaLight]) -> None:
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
    """`lights` with all `changes`. Raises ValueError for an unknown light."""
    names = list(dict.fromkeys(light.name for light in lights))
    found = list(lights)
    for change in changes:
        _check_known(change.name, names)
        own = [light for light in lights if light.name == change.name]
        factor = change.factor * _tint(own, change)
        found = [_scaled(light, factor) if light.name == change.name else light for light in found]
    return tuple(found)


def _tint(own: list[AreaLight], change: LightChange) -> np.ndarray:
    """Factor (3,) of the radiance that gives the lights `own` the color of `change`. Raises ValueError."""
    if change.color is None:
        return np.ones(3)
    color = own_color(own)
    missing = [channel for channel, value in zip(("red", "green", "blue"), color, strict=True) if value == 0.0]
    if missing and any(change.color[("red", "green", "blue").index(channel)] for channel in missing):
        raise ValueError(f"light {change.name!r} has no {' and no '.join(missing)}: render it anew to give it some")
    return tint(color, change.color)


def own_color(lights: Sequence[AreaLight]) -> np.ndarray:
    """The color (3,) of the mean radiance of `lights`, its brightest channel 1; white where they are dark."""
    weights = [np.linalg.norm(light.area_vector) for light in lights]
    mean = np.average([light.radiance for light in lights], axis=0, weights=weights)
    return mean / np.max(np.abs(mean)) if mean.any() else np.ones(3)


def tint(own: np.ndarray, color: Sequence[float]) -> np.ndarray:
    """Factor (3,) from the color `own` to `color`; 0 in channels where `own` is 0."""
    return np.divide(color, own, out=np.zeros(3), where=np.asarray(own) != 0.0)


def _scaled(light: AreaLight, factor: np.ndarray) -> AreaLight:
    detail = tuple(_scaled(part, factor) for part in light.detail)
    return replace(light, radiance=light.radiance * factor, detail=detail)
