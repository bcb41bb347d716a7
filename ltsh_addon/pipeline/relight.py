"""`relight`: pictures with changed powers and colors of their lights, without tracing a ray.

`--keep-visibility` writes the samples of a picture with all that this needs, RelightData.
"""

import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import imaging
from ..files import replacing
from ..imaging.exr import COMBINED, REST, layer_name, parse_layer_name
from ..scene import (
    DEFAULT_TECHNIQUE,
    REFERENCE,
    Film,
    Light,
    Progress,
    SurfaceSamples,
    error_line,
    light_records,
    lights_of,
    listed,
)
from .comparison import Comparison
from .lighting import Shadows, evaluated, light_groups, prepare, shade_lights
from .options import PictureOptions

# The two files of `write_relight_data`: the samples with all that shading needs, and the occluders.
RELIGHT_SUFFIX, OCCLUDERS_SUFFIX = ".samples.npz", ".occluders.npz"
RELIGHT_OPTIONS = ("techniques", "passes", "sub_samples", "reference_samples", "shadows", "shadow_rays")
FILM_ARRAYS = ("first", "count", "extent", "spread", "whole")  # the optional arrays of a film
NOT_REFLECTED = ("emission", "background")  # optional arrays of `Extraction.cycles`
FINISHED = ("rest", "taken", "edges")  # fields of a RelightData that only finished pictures have
# Warnings:
NO_CYCLES = "Cycles' picture and the errors beside it are left out: they show the lights as they were"
SAME_REST = "bounced light{}, and all else that Cycles has rendered, is as the lights were; there is no PNG"
BUT_GROUPS = ", but for that of light groups {}"
GRAIN = (
    "with depth of field finished pictures are denoised as a whole: light that changes shows its grain again; render "
    "the picture anew to be rid of it"
)
SAME_GLOW = "what glows, is behind glass, lights in sight and the background look as the lights were; there is no PNG"
SAME_WEIGHTS = (
    "{} of {} samples, between the horizons of their face and of its smooth normal, weigh both as the lights were; "
    "render the picture again for the last digits there"
)


@dataclass(frozen=True)
class RelightData:
    """A picture with all that shading needs, without Blender and without rays.

    whole picture = sum over passes of `shown` x image of the samples, + sum of `rest`; all include the exposure.
    """

    extraction: Any  # blender.process.pixels.Extraction, without reference and occluders
    shadows: Shadows | None
    options: dict  # fields of PictureOptions
    had_cycles: bool
    # By light group: its bounced light (H, W, 3). By "": what depends on no light group (H, W, 3 or 4 with alpha).
    rest: dict[str, np.ndarray] = field(default_factory=dict)
    # By pass (H, W, 3), in old files (H, W): the share that is LTSH's and not Cycles', recolored; left out: 1.
    taken: dict[str, np.ndarray] = field(default_factory=dict)
    # By pass (H, W, 3), in old files (H, W): a factor of it by Cycles, valid while the lights stay where they were.
    edges: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def technique(self) -> str:
        """The last technique of the picture except the reference: by convention the most accurate."""
        names = [name for name in self.options["techniques"] if name != REFERENCE]
        return names[-1] if names else DEFAULT_TECHNIQUE

    def shown(self, name: str) -> np.ndarray | float:
        """Factor (H, W, 1 or 3) of the image of a pass of the samples."""
        taken = np.atleast_3d(self.taken[name]) if name in self.taken else 1.0
        return taken if name not in self.edges else taken * np.atleast_3d(self.edges[name])

    @classmethod
    def load(cls, path: Path) -> "RelightData":
        """Raises OSError, and ValueError where the file is not what `write_relight_data` writes."""
        try:
            with Path(path).open("rb") as file, np.load(file) as data:
                arrays = {name: data[name] for name in data.files}
            document = json.loads(str(arrays.pop("document")))
            return cls._of(document, arrays)
        except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            problem = f"is no file of --keep-visibility, or not whole ({error_line(error)})"
            raise ValueError(f"{path}: {problem}; run the picture again") from error

    @classmethod
    def _of(cls, document, arrays) -> "RelightData":
        from ..blender.process.pixels import CyclesPasses, Extraction, ExtractionTimes, PictureFacts

        facts = document["extraction"]
        samples = {item.name: _compact(arrays[f"samples.{item.name}"]) for item in fields(SurfaceSamples)}
        of_film = {name: arrays.get(f"film.{name}") for name in FILM_ARRAYS}
        extraction = Extraction(
            lights=lights_of(facts["lights"]),
            samples=SurfaceSamples(**samples),
            film=Film(pixel=arrays["film.pixel"], **of_film, **facts["film"]),
            picture=PictureFacts.of(facts),
            cycles=CyclesPasses(**{name: arrays.get(f"picture.{name}") for name in NOT_REFLECTED}),
            times=ExtractionTimes(facts["seconds"]),
            warnings=tuple(facts["warnings"]),
            problems=tuple(facts["problems"]),
            light_settings=facts["light_settings"],
        )
        shadows = document["shadows"]
        if shadows is not None:
            shares = {name: arrays[f"shares.{name}"] for name in shadows["noise"]}
            numbers = tuple(map(tuple, shadows["numbers"]))
            shadows = Shadows(shares, numbers, shadows["noise"], shadows["rays"], shadows["tracer"])
        options = document["options"]
        options = {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
        options["scene"] = Path(options["scene"])
        finished = {kind: {name: arrays[f"{kind}.{name}"] for name in document[kind]} for kind in FINISHED}
        return cls(extraction, shadows, options, document["had_cycles"], **finished)


def _compact(values: np.ndarray) -> np.ndarray:
    """`values`; a broadcast zero where all are zero."""
    return values if values.any() else np.broadcast_to(values.dtype.type(0), values.shape)


def write_relight_data(extraction, shadows: Shadows | None, options, path: Path, **finished) -> list[Path]:
    """Write the .npz that `RelightData.load` reads, atomically, and the occluders beside it; returns the paths.

    `finished` are the fields `rest`, `taken` and `edges` of the RelightData of a finished picture. Raises OSError.
    """
    film = extraction.film
    document = {
        "extraction": {
            **extraction.picture.record(),
            "seconds": extraction.times.stages,
            "light_settings": extraction.light_settings,
            "lights": light_records(extraction.lights),
            "film": {"width": film.width, "height": film.height, "sub_samples": film.sub_samples},
            "warnings": extraction.warnings,
            "problems": extraction.problems,
        },
        "shadows": None if shadows is None else {**shadows.report(), "numbers": shadows.numbers},
        "options": {"scene": str(options.scene), **{name: getattr(options, name) for name in RELIGHT_OPTIONS}},
        "had_cycles": extraction.cycles.reference is not None,
        **{kind: list(finished.get(kind, ())) for kind in FINISHED},
    }
    arrays = {f"samples.{item.name}": getattr(extraction.samples, item.name) for item in fields(SurfaceSamples)}
    arrays["film.pixel"] = film.pixel
    arrays |= {f"film.{name}": getattr(film, name) for name in FILM_ARRAYS if getattr(film, name) is not None}
    if shadows is not None:
        arrays |= {f"shares.{name}": values for name, values in shadows.shares.items()}
    images = {name: getattr(extraction.cycles, name) for name in NOT_REFLECTED}
    arrays |= {f"picture.{name}": image.astype(np.float32) for name, image in images.items() if image is not None}
    for kind, images in finished.items():
        arrays |= {f"{kind}.{name}": np.asarray(image, np.float32) for name, image in images.items()}
    arrays["document"] = np.array(json.dumps(document))
    # np.savez_compressed would take twice as long, for files 5 % smaller.
    with (
        replacing(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asarray(values), allow_pickle=False)
    if extraction.occluders is None:
        return [path]
    occluders = path.with_name(path.name.removesuffix(RELIGHT_SUFFIX) + OCCLUDERS_SUFFIX)
    extraction.occluders.save(occluders)
    return [path, occluders]


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
    """Write the pictures whose samples are in `folder` into `output`, with changed lights.

    Where there are `solo` lights, all others are dark. Files and layers keep their names; those of Cycles are left
    out. Returns the report of the only picture, else {"reports": [...]}. Raises ValueError for an unknown light or
    where there is no picture, OSError, TableError.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(folder.rglob(f"*{RELIGHT_SUFFIX}"))
    if not files:
        fix = "run shade, compare or render with --keep-visibility"
        raise ValueError(f"{folder}: no picture kept its samples there; {fix}")
    reports = []
    for path in files:
        data = RelightData.load(path)
        name = path.relative_to(folder).as_posix().removesuffix(RELIGHT_SUFFIX)
        changed = [*changes, *others_muted(data.extraction.lights, solo)]
        reports.append(_relit(data, changed, PictureOptions(output=output, name=name, **data.options), progress))
    report = reports[0] if len(reports) == 1 else {"reports": reports}
    imaging.write_json(output / "report.json", report)
    return report


def _relit(data: RelightData, changes: Sequence[LightChange], options: PictureOptions, progress) -> dict:
    """Write the picture of `data` with `changes` of its lights; returns its report."""
    extraction = data.extraction
    lights = changed_lights(extraction.lights, changes)
    if data.shadows is not None:
        _check_shared(data, lights)
    tables = prepare(options)
    warnings = extraction.warnings + ((SAME_GLOW,) if extraction.rest is not None else ())
    warnings += (NO_CYCLES,) if data.had_cycles else ()
    if split := _split_at_horizons(extraction.samples):
        warnings += (SAME_WEIGHTS.format(split, len(extraction.samples)),)
    extraction = replace(extraction, lights=lights, warnings=warnings)
    results = evaluated(tables, extraction, data.shadows, options, progress)
    comparison = Comparison(options, extraction, results, data.shadows)
    if data.rest:
        groups = [repr(group) for group in data.rest if group]
        warnings += (SAME_REST.format(BUT_GROUPS.format(listed(groups)) if groups else ""),)
        warnings += (GRAIN,) if extraction.picture.has_lens else ()
        rest = _changed_rest(data, lights, tables[data.technique], results[data.technique].shading, progress)
        extraction = replace(extraction, warnings=warnings)
        comparison = _FinishedComparison(options, extraction, results, data.shadows, data=data, rest=rest)
    changed = [{"light": change.name, **{key: value for key, value in asdict(change).items() if key != "name"}}
               for change in changes]  # fmt: skip
    report = {**comparison.report(), "relit": changed}
    return {"files": comparison.write(options.output, report, False, progress), **report}


@dataclass(frozen=True)
class _FinishedComparison(Comparison):
    """A finished picture: LTSH's passes, and Cycles' `rest` (H, W, 4)."""

    data: RelightData | None = None
    rest: np.ndarray | None = None

    def layers(self) -> dict[str, np.ndarray | imaging.Layer]:
        planes = {}
        for name, pixels in super().layers().items():
            technique, pass_name, _ = parse_layer_name(name)
            if technique in self.results and pass_name in self.options.passes:
                planes[name] = pixels * self.data.shown(pass_name)
        combined = self.rest.copy()
        for pass_name in self.options.passes:
            combined[..., :3] += planes[layer_name(self.data.technique, pass_name)]
        return {COMBINED: combined, **planes, REST: self.rest}


def _changed_rest(data: RelightData, lights: Sequence[Light], table, shaded, progress) -> np.ndarray:
    """Cycles' rest (H, W, 4) under the changed `lights`: the bounced light of a group scales with its direct light.

    `shaded` is the direct light of the changed lights by `table`.
    """
    rest, before = data.rest[""].copy(), None
    for group, bounced in data.rest.items():
        pairs = [pair for pair in zip(data.extraction.lights, lights, strict=True) if pair[0].group == group]
        if group == "" or not pairs:
            rest[..., :3] += 0.0 if group == "" else bounced[..., :3]
            continue
        factors = np.array([tint(old.radiance, new.radiance) for old, new in pairs])
        factor = factors.mean(axis=0)
        if np.ptp(factors, axis=0).any():
            if before is None:
                report = None if progress is None else (lambda fraction: progress("lights", fraction))
                unchanged = data.extraction.samples, data.extraction.lights, table, data.options["passes"]
                (before,) = shade_lights(*unchanged, (data.shadows,), progress=report)
            now, then = (_light_of_group(data, one, group) for one in (shaded, before))
            factor = np.divide(now, then, out=factor, where=then > 0.0)
        rest[..., :3] += factor * bounced[..., :3]
    return rest


def _light_of_group(data: RelightData, shaded, group: str) -> np.ndarray:
    """Direct light (3,) of a light group, summed over the picture."""
    number, film = light_groups(data.extraction.lights).index(group), data.extraction.film
    images = {name: film.image(getattr(shaded, name)[number]) for name in data.options["passes"]}
    return sum((data.shown(name) * image).sum(axis=(0, 1)) for name, image in images.items())


def others_muted(lights: Sequence[Light], solo: Sequence[str]) -> list[LightChange]:
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


def _check_shared(data: RelightData, lights: Sequence[Light]) -> None:
    """Raise ValueError where lights that share their shadow rays are changed differently."""
    before = data.extraction.lights
    for first, *others in data.shadows.numbers:
        for number in others if not before[first].is_distant else ():
            expected = before[number].radiance.sum() * lights[first].radiance
            if not np.allclose(lights[number].radiance * before[first].radiance.sum(), expected, rtol=1e-2):
                names = " and ".join(repr(before[each].name) for each in (first, number))
                raise ValueError(
                    f"lights {names} are two of {1 + len(others)} that share their shadow rays, expected the same "
                    "change for all of them: change them in Blender and run the picture again, or give them light "
                    "groups first"
                )


def changed_lights(lights: Sequence[Light], changes: Sequence[LightChange]) -> tuple[Light, ...]:
    """`lights` with all `changes`. Raises ValueError for an unknown light."""
    names = list(dict.fromkeys(light.name for light in lights))
    changed = list(lights)
    for change in changes:
        _check_known(change.name, names)
        factor = change.factor * _tint([light for light in lights if light.name == change.name], change)
        changed = [_scaled(light, factor) if light.name == change.name else light for light in changed]
    return tuple(changed)


def _tint(lights: list[Light], change: LightChange) -> np.ndarray:
    """Factor (3,) of the radiance that gives the `lights` the color of `change`. Raises ValueError."""
    if change.color is None:
        return np.ones(3)
    color = color_of(lights)
    missing = [channel for channel, value in zip(("red", "green", "blue"), color, strict=True) if value == 0.0]
    if missing and any(change.color[("red", "green", "blue").index(channel)] for channel in missing):
        raise ValueError(f"light {change.name!r} has no {' and no '.join(missing)}: render it anew to give it some")
    return tint(color, change.color)


def color_of(lights: Sequence[Light]) -> np.ndarray:
    """The color (3,) of the mean radiance of `lights`, its brightest channel 1; white where they are dark."""
    weights = [np.linalg.norm(light.area_vector) for light in lights]
    mean = np.average([light.radiance for light in lights], axis=0, weights=weights)
    return mean / np.max(np.abs(mean)) if mean.any() else np.ones(3)


def tint(before: np.ndarray, color: Sequence[float]) -> np.ndarray:
    """Factor (3,) from the color `before` to `color`; 0 in channels where `before` is 0."""
    return np.divide(color, before, out=np.zeros(3), where=np.asarray(before) != 0.0)


def _scaled(light: Light, factor: np.ndarray) -> Light:
    children = {"children": tuple(_scaled(child, factor) for child in light.children)} if light.children else {}
    return replace(light, radiance=light.radiance * factor, **children)
