"""The light mixer: a picture as the sum of one picture per light, which a `Mixer` weights interactively.

Radiance is linear in that of each light: each picture is multiplied by a factor per color channel.
"""

import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ..files import replacing
from ..imaging.exr import COMBINED, group_names, layer_name, parse_layer_name
from ..scene import PASSES, Light, Progress, error_line, listed
from ..visibility import Occluders
from .lighting import Shadows, light_groups, load_tables, shade_lights, trace_shadows
from .relight import GRAIN, RelightData, color_of

MIXER_FILE = "lights.npz"
# MOST_VALUES: numbers in all pictures of a mixer together; they limit the rows to between FEWEST_ROWS and MOST_ROWS.
# Where there are more lights, the weakest share one row.
MOST_ROWS, FEWEST_ROWS, MOST_VALUES = 64, 8, 1 << 28
REST = "The rest"
# MOST_PAIRS: how many pairs of a sample and a row have their radiance in memory at a time.
MOST_PAIRS = 1 << 23
# LINES: lines of the pictures that are summed at a time: as many as stay in the processor's cache.
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
class MixerRow:
    """A row of the mixer: lights that change together, or what of the picture depends on no light."""

    name: str
    lights: tuple[str, ...]  # names; empty: depends on no light
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of their light, the brightest channel 1
    settings: dict[str, list[float]] = field(default_factory=dict)  # by name, of lights that are light objects
    light: dict | None = None  # record of the only light, without children and pattern; None: others
    note: str = ""
    group: str = ""  # light group of whose bounced light the row has a share
    share: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of this bounced light, per channel

    @classmethod
    def of(cls, record: dict) -> "MixerRow":
        """The row of a JSON record of its fields. Raises KeyError, TypeError."""
        return cls(**{**record, **{name: tuple(record[name]) for name in ("lights", "color", "share")}})


@dataclass(frozen=True)
class LightPictures:
    """A picture as the sum of one layer for each row."""

    rows: tuple[MixerRow, ...]
    layers: np.ndarray  # (R, H, W, 3) float32, row 0 on top
    alpha: np.ndarray  # (H, W) float32
    facts: dict  # "camera", "frame", "technique", "notes"

    def save(self, path: Path) -> None:
        """Write the file that `load` reads, atomically. Raises OSError."""
        document = {**self.facts, "rows": [asdict(row) for row in self.rows]}
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, document=json.dumps(document), layers=self.layers, alpha=self.alpha)

    @classmethod
    def load(cls, path: Path) -> "LightPictures":
        """Raises OSError, and ValueError where the file is not what `save` writes."""
        try:
            with Path(path).open("rb") as file, np.load(file) as data:
                facts, layers, alpha = json.loads(str(data["document"])), data["layers"], data["alpha"]
            rows = tuple(map(MixerRow.of, facts.pop("rows")))
            if layers.ndim != 4 or layers.shape != (len(rows), *alpha.shape, 3):
                raise ValueError(f"{len(rows)} rows, layers {layers.shape}, alpha {alpha.shape}")
        except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: is no file of the light mixer, or not whole ({error_line(error)})") from error
        return cls(rows, layers, alpha, facts)


def light_pictures(data: RelightData, progress: Progress | None = None) -> LightPictures:
    """The pictures of the lights of `data`, shaded by its most accurate table. Raises TableError, Cancelled."""
    extraction, shadows = data.extraction, data.shadows
    shape, technique = (extraction.film.height, extraction.film.width), data.technique
    most = min(max(MOST_VALUES // (4 * shape[0] * shape[1]), FEWEST_ROWS), MOST_ROWS)
    members = _members(extraction.lights, shadows, most)
    layers = np.zeros((len(members), *shape, 3), np.float32)
    (table,) = load_tables((technique,)).values()
    most = max(1, MOST_PAIRS // max(1, len(extraction.samples)))
    for first in range(0, len(members), most):
        some = members[first : first + most]

        def report(fraction, first=first, some=some):
            return None if progress is None else progress("lights", (first + fraction * len(some)) / len(members))

        layers[first : first + most] = _layers(data, table, some, report)
    rows = _with_bounces(data, [_row(extraction, numbers) for numbers in members], members, layers)
    for row, layer in zip(rows, layers, strict=True):
        layer += bounced_light(data, row)
    for group, values in data.rest.items():
        if group and values.any() and all(row.group != group for row in rows):
            rows.append(MixerRow(f"Light group {group}", (), note=NOT_SHADED))
            layers = np.concatenate([layers, values[None, ..., :3].astype(np.float32)])
    notes = [GRAIN] * bool(data.rest and extraction.picture.has_lens)
    for group in filter(None, data.rest):
        names = [repr(row.name) for row in rows if row.group == group]
        notes += [SHARED_OUT.format(group, listed(names))] if len(names) > 1 else []
    rest = data.rest.get("")
    if rest is not None:
        rows.append(MixerRow(REST, (), note=NOT_OF_LIGHTS))
        layers = np.concatenate([layers, rest[None, ..., :3].astype(np.float32)])
    alpha = np.ones(shape, np.float32) if rest is None or rest.shape[-1] < 4 else rest[..., 3].astype(np.float32)
    facts = {
        "camera": extraction.picture.camera,
        "frame": extraction.picture.frame,
        "technique": technique,
        "notes": notes,
    }
    return LightPictures(tuple(rows), layers, alpha, facts)


def _members(lights: Sequence[Light], shadows: Shadows | None, most: int = MOST_ROWS) -> list[list[int]]:
    """Numbers of the lights of each of at most `most` rows.

    Lights of one name share a row, and so do lights that share their rays. The weakest rows are merged where needed.
    """
    root = {light.name: light.name for light in lights}

    def first(name):
        while root[name] != name:
            root[name] = root[root[name]]
            name = root[name]
        return name

    for sharing in shadows.numbers if shadows is not None else ():
        for number in sharing[1:]:
            root[first(lights[number].name)] = first(lights[sharing[0]].name)
    members: dict[str, list[int]] = {}
    for number, light in enumerate(lights):
        members.setdefault(first(light.name), []).append(number)
    rows = list(members.values())
    if len(rows) <= most:
        return rows
    power = [sum(np.linalg.norm(lights[n].area_vector) * lights[n].radiance.sum() for n in row) for row in rows]
    strong = sorted(np.argsort(power)[::-1][: most - 1].tolist())
    weak = [number for row, numbers in enumerate(rows) if row not in strong for number in numbers]
    return [*(rows[row] for row in strong), weak]


def _row(extraction, numbers: list[int]) -> MixerRow:
    """The row of the lights with these `numbers`."""
    lights = [extraction.lights[number] for number in numbers]
    names, color = tuple(dict.fromkeys(light.name for light in lights)), tuple(color_of(lights).tolist())
    known = extraction.light_settings
    settings = {name: known[name] for name in names if name in known}
    if len(names) > 1:
        note = WEAKEST if len({tuple(light.radiance) for light in lights}) > 1 else SHARED
        return MixerRow(f"{names[0]} and {len(names) - 1} more", names, color, settings, note=note)
    plain = len(lights) == 1 and not lights[0].children and lights[0].pattern is None
    return MixerRow(names[0], names, color, settings, lights[0].record() if plain else None)


def _layers(data: RelightData, table, members: list[list[int]], report) -> np.ndarray:
    """Direct light (R, H, W, 3) of the rows with these `members`, times the exposure."""
    extraction = data.extraction
    row_of = {number: row for row, numbers in enumerate(members) for number in numbers}
    numbers = sorted(row_of)
    lights, rows = [extraction.lights[number] for number in numbers], [row_of[number] for number in numbers]
    shadows = None if data.shadows is None else data.shadows.of_lights(numbers)
    passes = data.options["passes"]
    (lit,) = shade_lights(extraction.samples, lights, table, passes, (shadows,), rows=rows, progress=report)
    layers = np.zeros((len(members), extraction.film.height, extraction.film.width, 3), np.float32)
    for name in passes:
        for layer, values in zip(layers, getattr(lit, name), strict=True):
            layer += data.shown(name) * extraction.film.image(extraction.picture.exposure * values)
    return layers


def _with_bounces(data: RelightData, rows: list[MixerRow], members, layers) -> list[MixerRow]:
    """The rows with their shares of the bounced light of their groups, in proportion to the direct light `layers`."""
    rows = list(rows)
    for group in filter(None, data.rest):
        of_group = [row for row, (first, *_) in enumerate(members) if data.extraction.lights[first].group == group]
        weights = layers[of_group].sum(axis=(1, 2), dtype=np.float64)
        total = weights.sum(axis=0)
        for row, weight in zip(of_group, weights, strict=True):
            share = np.divide(weight, total, out=np.full(3, 1.0 / len(of_group)), where=total > 0.0)
            rows[row] = replace(rows[row], group=group, share=tuple(share.tolist()))
    return rows


def bounced_light(data: RelightData, row: MixerRow) -> np.ndarray:
    """The bounced light (H, W, 3) of a row; 0.0 where it has none."""
    return (np.array(row.share) * data.rest[row.group][..., :3]).astype(np.float32) if row.group else np.float32(0.0)


RAYS_SHARE = 0.8  # of the time that a moved light takes


def moved_light(
    data: RelightData,
    occluders: Occluders | None,
    light: Light,
    row: MixerRow,
    progress: Callable[[float], bool | None],
) -> np.ndarray:
    """The picture (H, W, 3) of one light of `data` at a new place, by rays of it alone, plus the bounced light of its
    `row`. `progress(fraction)` returns False to stop. Raises SceneError, TableError, Cancelled."""
    extraction, rays = replace(data.extraction, lights=(light,), occluders=occluders), data.options["shadow_rays"]
    (table,) = load_tables((data.technique,)).values()
    shadows = trace_shadows(extraction, data.options["passes"], rays, lambda _, share: progress(RAYS_SHARE * share))
    start = 0.0 if shadows is None else RAYS_SHARE
    # The edges of light are other ones where it stands now.
    moved = replace(data, extraction=extraction, shadows=shadows, edges={})
    (layer,) = _layers(moved, table, [[0]], lambda share: progress(start + (1.0 - start) * share))
    return layer + bounced_light(data, row)


def mixer_file(group: str) -> str:
    """The name of the mixer's file of a group of pictures: of a baked texture, "" for the camera's picture."""
    return f"{group}.{MIXER_FILE}" if group else MIXER_FILE


def rows_of_groups(lights: Sequence[Light], settings: dict[str, list[float]]) -> list[MixerRow]:
    """A row for each light group of `lights`, named as its layers; `settings` are those of light objects by name."""
    groups = light_groups(lights)
    members = [[light for light in lights if light.group == group] for group in groups]
    rows = []
    for name, some in zip(group_names(groups), members, strict=True):
        names = tuple(dict.fromkeys(light.name for light in some))
        known = {light: settings[light] for light in names if light in settings}
        rows.append(MixerRow(name, names, tuple(color_of(some).tolist()), known))
    return rows


def baked_light_pictures(layers: dict[str, np.ndarray], rows: list[MixerRow], facts: dict) -> LightPictures:
    """The pictures of the lights of a baked texture, with its `layers` by name, that was baked for each light.

    They show all of its light, or the first of its passes where it has no such.
    """
    names = [parse_layer_name(name) for name in layers]
    technique, first, _ = next(name for name in names if name[2])
    passes = {pass_name for name, pass_name, group in names if group and name == technique}
    whole = next((one for one in ({COMBINED}, set(PASSES)) if one <= passes), {first})
    pictures = [sum(layers[layer_name(technique, name, row.name)].astype(np.float32) for name in whole) for row in rows]
    alpha = np.ones(pictures[0].shape[:2], np.float32)
    return LightPictures(tuple(rows), np.array(pictures), alpha, {**facts, "technique": technique, "notes": []})


class Mixer:
    """The weighted sum of the pictures of lights.

    A change of one row costs one multiplication and one addition per pixel and channel, because the sum of the others
    is cached.
    """

    def __init__(self, pictures: LightPictures):
        count, height, width, _ = pictures.layers.shape
        self.rows, self.facts, self._width = pictures.rows, pictures.facts, width
        # The layout of Blender's images: row 0 at the bottom, four interleaved channels.
        self._layers = np.zeros((count, height, width, 4), np.float32)
        self._layers[..., :3] = pictures.layers[:, ::-1]
        self._background = np.zeros((height, width, 4), np.float32)
        self._background[..., 3] = pictures.alpha[::-1]
        self._whole, self._others = self._background.copy(), np.empty_like(self._background)
        self._factors = np.zeros((count, 3))
        self._changing: int | None = None  # the row that changed last: `_others` is the sum of all others

    @property
    def pictures(self) -> LightPictures:
        """The current pictures: those given, with the rows that `replace` has changed."""
        layers, alpha = self._layers[:, ::-1, :, :3], self._background[::-1, :, 3]
        return LightPictures(self.rows, layers, alpha, self.facts)

    def replace(self, number: int, row: MixerRow, layer: np.ndarray) -> None:
        """Replace row `number` by `row` with the picture `layer` (H, W, 3), row 0 on top."""
        self.rows = (*self.rows[:number], row, *self.rows[number + 1 :])
        self._layers[number, ..., :3] = layer[::-1]
        self._factors[:], self._changing = np.nan, None

    def mixed(self, factors: np.ndarray) -> np.ndarray:
        """The sum (H, W, 4) of all rows times `factors` (R, 3), row 0 at the bottom; the next call overwrites it."""
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
        """Set `out` to `start` plus the `rows` times their factors."""
        tiles = [np.tile(np.append(self._factors[row], 0.0).astype(np.float32), (self._width, 1)) for row in rows]
        term = np.empty((LINES, self._width, 4), np.float32)
        for first in range(0, len(out), LINES):
            lines = slice(first, first + LINES)
            out[lines] = start[lines]
            for row, tile in zip(rows, tiles, strict=True):
                if tile.any():
                    out[lines] += np.multiply(self._layers[row, lines], tile, out=term[: len(out[lines])])
