"""Finished pictures in another light: `relight` writes them anew, a `Mixer` changes their lights while one looks.

Radiance is linear in that of each light: a picture is the sum of the pictures of its lights, each times a factor per
color. No ray is traced, but by `MovedLights` for those that have moved.
"""

from __future__ import annotations

import json
import threading
import weakref
import zipfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from .. import imaging
from ..cycles.gbuffer import with_one_shadow
from ..files import replacing, temporary_folder
from ..scene import REFERENCE, AreaLight, Progress, SurfaceSamples, error_line, listed
from ..visibility import BLOCK_SAMPLES, Company, Occluders, Setting, task_of_light
from . import picture
from .lighting import KEPT_SUFFIX, OCCLUDERS_SUFFIX, KeptPicture, Shadows, rays_of_samples, shade_lights
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
    """What becomes of the lights called `name`."""

    name: str
    power: float = 1.0  # factor
    color: tuple[float, float, float] | None = None  # in place of its own, whose brightest channel counts as 1
    exposure: float = 0.0  # each step doubles the power
    muted: bool = False

    @property
    def factor(self) -> float:
        """Of the power."""
        return 0.0 if self.muted else self.power * 2.0**self.exposure


def relight(
    folder: Path,
    changes: Sequence[LightChange],
    output: Path,
    progress: Progress | None = None,
    *,
    solo: Sequence[str] = (),
) -> dict:
    """Write the pictures that `folder` has kept samples of with changed lights into `output`; where there are `solo`
    lights, all others are dark.

    Files and layers have the same names, but for those of Cycles. Returns report.json of the only picture, else
    {"reports": [...]}. Raises ValueError for an unknown light or where nothing was kept, OSError, TableError.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(folder.rglob(f"*{KEPT_SUFFIX}"))
    if not files:
        raise ValueError(f"{folder}: no picture kept its samples there; run shade or compare with --keep-visibility")
    reports = [_relit(path, path.relative_to(folder), (changes, solo), output, progress) for path in files]
    report = reports[0] if len(reports) == 1 else {"reports": reports}
    imaging.write_json(output / "report.json", report)
    return report


def _relit(path: Path, place: Path, wanted, output: Path, progress) -> dict:
    """The report of the picture that kept its samples in `path`; its files are at the same `place` below `output`."""
    kept = KeptPicture.load(path)
    changes = [*wanted[0], *others_muted(kept.extraction.lights, wanted[1])]
    lights = changed_lights(kept.extraction.lights, changes)
    if kept.shadows is not None:
        _check_shared(kept, lights)
    name = place.as_posix().removesuffix(KEPT_SUFFIX)
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
        warnings += (GRAIN,) if kept.extraction.has_lens else ()
        name = technique_of(kept)
        rest = _changed_rest(kept, lights, tables[name], results[name].shading, progress)
        extraction = replace(extraction, warnings=warnings)
        comparison = _Finished(options, extraction, results, kept.shadows, kept, rest)
    changed = [{"light": change.name, **{key: value for key, value in asdict(change).items() if key != "name"}}
               for change in changes]  # fmt: skip
    report = {**comparison.report(), "relit": changed}
    return {"files": comparison.write(output, report, False, progress), **report}


@dataclass(frozen=True)
class _Finished(picture.Comparison):
    """A finished picture, of which the `rest` (H, W, 4) is not ours."""

    kept: KeptPicture | None = None
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
            combined[..., :3] += found[f"{technique_of(self.kept)}.{pass_name}"]
        return {"combined": combined, **found, "rest": self.rest}


def _changed_rest(kept: KeptPicture, lights: Sequence[AreaLight], table, shaded, progress) -> np.ndarray:
    """What is not ours (H, W, 4) with changed lights: what a light group bounces follows its direct light, which is
    `shaded` with them by `table`."""
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


def _light_of_group(kept: KeptPicture, shaded, group: str) -> np.ndarray:
    """The light (3,) of a light group in the whole picture."""
    number, film = shaded.groups.index(group), kept.extraction.film
    images = {name: film.image(getattr(shaded, name)[number]) for name in kept.options["passes"]}
    return sum((kept.shown(name) * image).sum(axis=(0, 1)) for name, image in images.items())


def others_muted(lights: Sequence[AreaLight], solo: Sequence[str]) -> list[LightChange]:
    """What makes all lights dark but those called `solo`; nothing where there are none. Raises ValueError for a light
    that is not there."""
    names = dict.fromkeys(light.name for light in lights)
    for name in solo:
        _check_known(name, names)
    return [LightChange(name, muted=True) for name in names if solo and name not in solo]


def _check_known(name: str, names) -> None:
    if name not in names:
        raise ValueError(f"light {name!r} is not in the picture; lights there: {listed(map(repr, names))}")


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
        _check_known(change.name, names)
        own = [light for light in lights if light.name == change.name]
        factor = change.factor * _tint(own, change)
        found = [_scaled(light, factor) if light.name == change.name else light for light in found]
    return tuple(found)


def _tint(own: list[AreaLight], change: LightChange) -> np.ndarray:
    """By what the radiance of a light of several parts is multiplied to get the color."""
    if change.color is None:
        return np.ones(3)
    color = own_color(own)
    missing = [channel for channel, value in zip(("red", "green", "blue"), color, strict=True) if value == 0.0]
    if missing and any(change.color[("red", "green", "blue").index(channel)] for channel in missing):
        raise ValueError(f"light {change.name!r} has no {' and no '.join(missing)}: render it anew to give it some")
    return tint(color, change.color)


def own_color(lights: Sequence[AreaLight]) -> np.ndarray:
    """The color (3,) of `lights` together, its brightest channel 1; white where they are dark."""
    weights = [np.linalg.norm(light.area_vector) for light in lights]
    mean = np.average([light.radiance for light in lights], axis=0, weights=weights)
    return mean / np.max(np.abs(mean)) if mean.any() else np.ones(3)


def tint(own: np.ndarray, color: Sequence[float]) -> np.ndarray:
    """By what light of the color `own` (3,) is multiplied to get another; nothing where it has nothing."""
    return np.divide(color, own, out=np.zeros(3), where=np.asarray(own) != 0.0)


def _scaled(light: AreaLight, factor: np.ndarray) -> AreaLight:
    detail = tuple(_scaled(part, factor) for part in light.detail)
    return replace(light, radiance=light.radiance * factor, detail=detail)


# The mixer:

MIXER_FILE = "lights.npz"
# Rows of a mixer, and of large pictures: of more lights the weakest are one. Values of all of its pictures.
MOST_ROWS, FEWEST_ROWS, MOST_VALUES = 64, 8, 1 << 28
REST = "Everything else"
# Pairs of a sample and a row whose radiance is kept at a time.
MOST_PAIRS = 1 << 23
# Of pictures, that are summed at a time: as many as stay in the processor's cache.
LINES = 16
SHARED = "they share their shadow rays, so they change together"
WEAKEST = "the weakest lights of the picture, which change together"
NOT_OF_LIGHTS = (
    "the background, what glows, and in finished pictures what lights in no light group bounce: they do not follow the "
    "lights"
)
SHARED_OUT = "bounced light of light group {!r} is shared out among {} by their direct light"
NOT_SHADED = "Cycles' light of a light group none of whose lights is shaded here"


@dataclass(frozen=True)
class Row:
    """What a mixer changes as one: the lights called `lights`, or what hangs on no light where there are none."""

    name: str
    lights: tuple[str, ...]
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of their light, the brightest channel 1
    settings: dict[str, list[float]] = field(default_factory=dict)  # of those that are lights in Blender
    light: dict | None = None  # record of the only one, where it is plain
    note: str = ""
    group: str = ""  # whose bounced light it has this share of
    share: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LightPictures:
    """A picture as the sum of one for each row."""

    rows: tuple[Row, ...]
    layers: np.ndarray  # (R, H, W, 3) float32, row 0 on top
    alpha: np.ndarray  # (H, W) float32
    facts: dict  # "camera", "frame", "technique", "notes"

    def save(self, path: Path) -> None:
        """Write what `load` reads, at once or not at all. Raises OSError."""
        document = {**self.facts, "rows": [asdict(row) for row in self.rows]}
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, document=json.dumps(document), layers=self.layers, alpha=self.alpha)

    @classmethod
    def load(cls, path: Path) -> LightPictures:
        """Raises OSError, and ValueError where the file is not what `save` writes."""
        try:
            with Path(path).open("rb") as file, np.load(file) as data:
                facts, layers, alpha = json.loads(str(data["document"])), data["layers"], data["alpha"]
            rows = tuple(
                Row(**{**row, **{name: tuple(row[name]) for name in ("lights", "color", "share")}})
                for row in facts.pop("rows")
            )
            if layers.ndim != 4 or layers.shape != (len(rows), *alpha.shape, 3):
                raise ValueError(f"{len(rows)} rows, layers {layers.shape}, alpha {alpha.shape}")
        except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: is no file of the light mixer, or not whole ({error_line(error)})") from error
        return cls(rows, layers, alpha, facts)


def light_pictures(kept: KeptPicture, progress: Progress | None = None) -> LightPictures:
    """The pictures of the lights of `kept`, shaded anew by its most accurate table. Raises TableError, Cancelled."""
    extraction, shadows = kept.extraction, kept.shadows
    shape, technique = (extraction.film.height, extraction.film.width), technique_of(kept)
    most = min(max(MOST_VALUES // (4 * shape[0] * shape[1]), FEWEST_ROWS), MOST_ROWS)
    members = _members(extraction.lights, shadows, most)
    layers = np.zeros((len(members), *shape, 3), np.float32)
    (table,) = picture.load_tables((technique,)).values()
    most = max(1, MOST_PAIRS // max(1, len(extraction.samples)))
    for first in range(0, len(members), most):
        part = members[first : first + most]
        share = first / len(members), len(part) / len(members)

        def report(fraction, share=share):
            return None if progress is None else progress("lights", share[0] + fraction * share[1])

        layers[first : first + most] = _layers(kept, table, part, report)
    rows = _with_bounces(kept, [_row(extraction, own) for own in members], members, layers)
    for row, layer in zip(rows, layers, strict=True):
        layer += bounced_light(kept, row)
    for group, values in kept.rest.items():
        if group and values.any() and all(row.group != group for row in rows):
            rows.append(Row(f"Light group {group}", (), note=NOT_SHADED))
            layers = np.concatenate([layers, values[None, ..., :3].astype(np.float32)])
    notes = [GRAIN] * bool(kept.rest and kept.extraction.has_lens) + [
        SHARED_OUT.format(group, listed(repr(row.name) for row in own))
        for group in kept.rest
        if group and len(own := [row for row in rows if row.group == group]) > 1
    ]
    rest = kept.rest.get("")
    if rest is not None:
        rows.append(Row(REST, (), note=NOT_OF_LIGHTS))
        layers = np.concatenate([layers, rest[None, ..., :3].astype(np.float32)])
    alpha = np.ones(shape, np.float32) if rest is None or rest.shape[-1] < 4 else rest[..., 3].astype(np.float32)
    facts = {"camera": extraction.camera, "frame": extraction.frame, "technique": technique, "notes": notes}
    return LightPictures(tuple(rows), layers, alpha, facts)


def technique_of(kept: KeptPicture) -> str:
    """The most accurate of those that `kept` was made with."""
    names = [name for name in kept.options["techniques"] if name != REFERENCE]
    return names[-1] if names else "ltsh4"


def _members(lights: Sequence[AreaLight], shadows: Shadows | None, most: int = MOST_ROWS) -> list[list[int]]:
    """Numbers of the lights of each of at most `most` rows: those of one name, and those that share their rays."""
    root = {light.name: light.name for light in lights}

    def first(name):
        while root[name] != name:
            root[name] = root[root[name]]
            name = root[name]
        return name

    for own in shadows.numbers if shadows is not None else ():
        for number in own[1:]:
            root[first(lights[number].name)] = first(lights[own[0]].name)
    members: dict[str, list[int]] = {}
    for number, light in enumerate(lights):
        members.setdefault(first(light.name), []).append(number)
    rows = list(members.values())
    if len(rows) <= most:
        return rows
    power = [sum(np.linalg.norm(lights[n].area_vector) * lights[n].radiance.sum() for n in own) for own in rows]
    strong = set(np.argsort(power)[::-1][: most - 1].tolist())
    weak = [number for row, own in enumerate(rows) if row not in strong for number in own]
    return [*(own for row, own in enumerate(rows) if row in strong), weak]


def _row(extraction, own: list[int]) -> Row:
    """The row of the lights with the numbers `own`."""
    lights = [extraction.lights[number] for number in own]
    names, color = tuple(dict.fromkeys(light.name for light in lights)), tuple(own_color(lights).tolist())
    known = extraction.light_settings
    settings = {name: known[name] for name in names if name in known}
    if len(names) > 1:
        note = WEAKEST if len({tuple(light.radiance) for light in lights}) > 1 else SHARED
        return Row(f"{names[0]} and {len(names) - 1} more", names, color, settings, note=note)
    plain = len(lights) == 1 and not lights[0].detail and lights[0].pattern is None
    return Row(names[0], names, color, settings, lights[0].record() if plain else None)


def _layers(kept: KeptPicture, table, members: list[list[int]], report) -> np.ndarray:
    """Radiance (R, H, W, 3) of rows of lights times the exposure."""
    extraction = kept.extraction
    numbers = sorted(number for own in members for number in own)
    row_of = {number: row for row, own in enumerate(members) for number in own}
    lights = [replace(extraction.lights[number], group=str(row_of[number])) for number in numbers]
    shadows = None if kept.shadows is None else kept.shadows.of_lights(numbers)
    passes = kept.options["passes"]
    (lit,) = shade_lights(extraction.samples, lights, table, passes, (shadows,), progress=report)
    layers = np.zeros((len(members), extraction.film.height, extraction.film.width, 3), np.float32)
    for name in passes:
        for group, values in zip(lit.groups, getattr(lit, name), strict=True):
            image = extraction.film.image(extraction.exposure * values)
            layers[int(group)] += kept.shown(name) * image
    return layers


def _with_bounces(kept: KeptPicture, rows: list[Row], members, layers) -> list[Row]:
    """The rows with their shares of what their light groups bounce, by their `layers` of direct light."""
    found = list(rows)
    for group in filter(None, kept.rest):
        own = [row for row, (first, *_) in enumerate(members) if kept.extraction.lights[first].group == group]
        weights = layers[own].sum(axis=(1, 2), dtype=np.float64)
        whole = weights.sum(axis=0)
        for row, weight in zip(own, weights, strict=True):
            share = np.divide(weight, whole, out=np.full(3, 1.0 / len(own)), where=whole > 0.0)
            found[row] = replace(rows[row], group=group, share=tuple(share.tolist()))
    return found


def bounced_light(kept: KeptPicture, row: Row) -> np.ndarray:
    """The part (H, W, 3) of the picture of a row that is bounced light; 0.0 where it has none."""
    return (np.array(row.share) * kept.rest[row.group][..., :3]).astype(np.float32) if row.group else np.float32(0.0)


class Mixer:
    """The pictures of the lights, ready to be mixed: a change of one row costs one multiplication and one addition per
    pixel and channel, because the sum of the others is kept."""

    def __init__(self, pictures: LightPictures):
        count, height, width, _ = pictures.layers.shape
        self.rows, self.facts, self._width = pictures.rows, pictures.facts, width
        # As images of Blender are: row 0 below, four channels one after another.
        self._layers = np.zeros((count, height, width, 4), np.float32)
        self._layers[..., :3] = pictures.layers[:, ::-1]
        self._background = np.zeros((height, width, 4), np.float32)
        self._background[..., 3] = pictures.alpha[::-1]
        self._whole, self._others = self._background.copy(), np.empty_like(self._background)
        self._factors = np.zeros((count, 3))
        self._changing: int | None = None  # the row that changed last: `_others` is the sum of all others

    @property
    def pictures(self) -> LightPictures:
        """What was given, and what came in its place since."""
        layers, alpha = self._layers[:, ::-1, :, :3], self._background[::-1, :, 3]
        return LightPictures(self.rows, layers, alpha, self.facts)

    def replace(self, number: int, row: Row, layer: np.ndarray) -> None:
        """Put another row, and its picture (H, W, 3), in the place of one."""
        self.rows = (*self.rows[:number], row, *self.rows[number + 1 :])
        self._layers[number, ..., :3] = layer[::-1]
        self._factors[:], self._changing = np.nan, None

    def mixed(self, factors: np.ndarray) -> np.ndarray:
        """The sum (H, W, 4) of all rows times `factors` (R, 3), row 0 below; the next call overwrites it."""
        factors = np.array(factors, dtype=float)
        changed = np.flatnonzero((self._factors != factors).any(axis=1))
        self._factors = factors
        if len(changed) > 1:
            self._changing = None
            self._sum(self._whole, self._background, range(len(factors)))
        elif len(changed) == 1:
            (row,) = changed.tolist()
            if row != self._changing:
                self._changing = row
                self._sum(self._others, self._background, [other for other in range(len(factors)) if other != row])
            self._sum(self._whole, self._others, [row])
        return self._whole

    def _sum(self, out: np.ndarray, start: np.ndarray, rows: Sequence[int]) -> None:
        """Set `out` to `start` and the `rows` times their factors."""
        tiles = [np.tile(np.append(self._factors[row], 0.0).astype(np.float32), (self._width, 1)) for row in rows]
        term = np.empty((LINES, self._width, 4), np.float32)
        for first in range(0, len(out), LINES):
            lines = slice(first, first + LINES)
            out[lines] = start[lines]
            for row, tile in zip(rows, tiles, strict=True):
                if tile.any():
                    out[lines] += np.multiply(self._layers[row, lines], tile, out=term[: len(out[lines])])


# Lights that have moved:

# So many, that all processes take about as long; with fewer samples a block costs more than they do.
BLOCKS, FEWEST_OF_BLOCK = 16, 1 << 11


class MovedLights:
    """Pictures of lights of a kept picture where they are now, by their own rays and lobes alone.

    With the first of them processes start that keep the samples, so that others take half a second; `close` ends them.
    Threads may share it.
    """

    def __init__(self, read: Callable[[], tuple[KeptPicture, Occluders | None]]):
        """`read` is called when the first picture is asked for, which raises what it raises."""
        self._read, self._kept, self._occluders = read, None, None
        self._company, self._ending = None, ExitStack()
        # Also for who forgets to, and where Python ends.
        weakref.finalize(self, self._ending.close)
        self._lock, self._is_ready = threading.Lock(), False

    @classmethod
    def load(cls, path: Path) -> MovedLights:
        """Those of the picture that kept its samples in `path`: OSError and ValueError where that cannot be read."""

        def read():
            kept, occluders = KeptPicture.load(path), None
            if kept.shadows is not None:
                occluders = Occluders.load(path.with_name(path.name.removesuffix(KEPT_SUFFIX) + OCCLUDERS_SUFFIX))
            return kept, occluders

        return cls(read)

    def get_ready(self, light: AreaLight) -> None:
        """Begin, once and in a thread, with what the first picture takes; `light` is any of those that there are."""
        if not self._is_ready:
            self._is_ready = True
            threading.Thread(target=self._try, args=(light,), name="LTSH lights", daemon=True).start()

    def _try(self, light: AreaLight) -> None:
        with suppress(Exception):  # who asks for a picture gets to know
            self.picture(light)

    def picture(self, light: AreaLight, row: Row | None = None) -> np.ndarray:
        """The picture (H, W, 3) of one light, with what the `row` of it bounced before. Raises SceneError."""
        with self._lock:
            return self._picture(light, row)

    def _picture(self, light: AreaLight, row: Row | None) -> np.ndarray:
        if self._company is None:
            self._start()
        kept, film, task = self._kept, self._kept.extraction.film, None
        light = light.moved(-kept.extraction.origin)
        if self._tracer is not None:
            rays = rays_of_samples(kept.options["shadow_rays"], film)
            task = task_of_light(self._starting, light, self._tracer, kept.options["passes"], rays)
        found = self._company.lit(light, task)
        image = np.zeros((film.height, film.width, 3), np.float32)
        for name in kept.options["passes"]:
            own = np.zeros((len(film.pixel), 3), np.float32)
            own[self._order] = np.concatenate([radiance[name] for radiance in found])
            image += kept.shown(name, moved=True) * film.image(kept.extraction.exposure * own)
        return image if row is None else image + bounced_light(kept, row)

    def close(self) -> None:
        """End the processes; the next light starts others."""
        with self._lock:
            self._company = None
            self._ending.close()

    def _start(self) -> None:
        from ..blender.process.blender_rays import open_rays

        if self._kept is None:
            self._kept, self._occluders = self._read()
        kept, film = self._kept, self._kept.extraction.film
        samples = kept.extraction.samples
        samples = replace(samples, position=samples.position - kept.extraction.origin)
        starting, place = samples, np.arange(len(samples))
        if film.count is not None:
            starting, film, place = with_one_shadow(samples, film)
        self._starting, self._order = starting, np.argsort(place, kind="stable")
        # Which samples are neighbors is all that rays ask of their film.
        film, blocks = film.unspread(), []
        size = min(BLOCK_SAMPLES, max(len(starting) // BLOCKS, FEWEST_OF_BLOCK))
        for first in range(0, max(len(starting), 1), size):
            begin, end = np.searchsorted(place[self._order], (first, first + size))
            own, part = self._order[begin:end], slice(first, first + size)
            blocks.append((samples.take(own), starting.take(part), film.take(part), place[own] - first))
        (table,) = picture.load_tables((technique_of(kept),)).values()
        with ExitStack() as stack:
            self._tracer = None
            if self._occluders is not None:
                folder = stack.enter_context(temporary_folder())
                self._tracer = stack.enter_context(open_rays(self._occluders, folder, lambda warning: None))
            self._company = Company(Setting(tuple(blocks), table, tuple(kept.options["passes"])), self._tracer)
            stack.callback(self._company.close)
            self._ending.callback(stack.pop_all().close)
