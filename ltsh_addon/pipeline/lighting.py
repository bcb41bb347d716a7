"""Radiance of samples under lights and occluders, for pictures and bakes; and the file of a kept picture.

radiance = closed form x the share of the light that the sample sees. The shares are the same for every technique.
"""

from __future__ import annotations

import itertools
import json
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import shading, visibility
from ..cycles.gbuffer import finer
from ..emitters.light_tree import FEWEST
from ..files import replacing
from ..scene import (
    REFERENCE,
    AreaLight,
    Film,
    Progress,
    SurfaceSamples,
    error_line,
    light_records,
    lights_of,
)

FILM_ARRAYS = ("first", "count", "spread", "whole")  # the optional arrays of a film
# The two files of `write_relight_data`: the samples with all that shading needs, and the occluders.
RELIGHT_SUFFIX, OCCLUDERS_SUFFIX = ".samples.npz", ".occluders.npz"
# MOST_PAIRS: how many pairs of a sample and a light have their radiance in memory at a time.
MOST_PAIRS = 1 << 25
# FEWEST_RAYS: a sample gets at least so many of the rays of its pixel, or all of them if they are fewer. The first
# eight only tell whether more are needed.
FEWEST_RAYS = 32


@dataclass(frozen=True)
class Shadows:
    """The share of each light that each sample sees. Lights that share their rays have one row of shares."""

    shares: dict[str, np.ndarray]  # (E, P) by pass, in [0, 1]
    numbers: tuple[tuple[int, ...], ...]  # E tuples: the numbers of the lights of each row
    noise: dict[str, float]  # by pass, estimated relative error of its shadows
    rays: int
    tracer: str  # name of the ray tracer
    seconds: float = 0.0
    # By pass, estimates (H, W) of the radiance on the film and of its variance; empty without a film.
    light: dict[str, np.ndarray] = field(default_factory=dict)
    variance: dict[str, np.ndarray] = field(default_factory=dict)

    def take(self, index: np.ndarray) -> Shadows:
        """The shadows of the samples at `index` (Q,)."""
        return replace(self, shares={name: values[:, index] for name, values in self.shares.items()})

    def with_more(self, kept: np.ndarray, more: Shadows) -> Shadows:
        """The shadows of the samples in the mask `kept` (P,), then those of `more`; `light` and `variance` stay."""
        shares = {name: np.concatenate([one[:, kept], more.shares[name]], 1) for name, one in self.shares.items()}
        return replace(self, shares=shares, rays=self.rays + more.rays, seconds=self.seconds + more.seconds)

    def of_lights(self, numbers: Sequence[int]) -> Shadows:
        """The shadows of the lights with these sorted `numbers`, renumbered from 0.

        Of lights that share their rays, `numbers` must hold all or none.
        """
        place = {number: index for index, number in enumerate(numbers)}
        rows = [row for row, own in enumerate(self.numbers) if own[0] in place]
        shares = {name: values[rows] for name, values in self.shares.items()}
        return replace(self, shares=shares, numbers=tuple(tuple(place[n] for n in self.numbers[row]) for row in rows))

    def report(self) -> dict:
        """The entry of report.json."""
        return {"rays": self.rays, "noise": self.noise, "tracer": self.tracer}


def rays_of_point(rays: int, points: int) -> int:
    """Rays of one point, where the `points` of a pixel or texel share `rays`."""
    return max(min(FEWEST_RAYS, rays), rays // points)


def rays_of_samples(rays: int, film: Film) -> int:
    """The most rays that one sample may take, where the samples of a pixel share `rays`.

    On a film with counts that is all of `rays`: the tracer scales them by the count of each sample.
    """
    return rays if film.count is not None else rays_of_point(rays, film.sub_samples)


class ShadowTracer:
    """Context that finds the shares of `lights` that samples see past `occluders`.

    Positions of the occluders are relative to `origin` (3,) in m; lights and samples are in world space.
    """

    def __init__(self, occluders: visibility.Occluders, lights: Sequence[AreaLight], origin: np.ndarray):
        self._occluders, self._origin = occluders, origin
        self._lights = [light.moved(-origin) for light in lights]

    def __enter__(self):
        from ..blender.process.blender_process import embree_libraries

        self._tracer = visibility.open_tracer(self._occluders, embree_libraries())
        return self

    def __exit__(self, *error):
        self._tracer.close()

    def finer(self, samples: SurfaceSamples, film: Film, points, pixels: np.ndarray):
        """`gbuffer.finer` with this tracer's rays, for samples in world space."""
        samples = replace(samples, position=samples.position - self._origin)
        found, film, replaced = finer(samples, film, points, pixels, self._tracer.first_met)
        return replace(found, position=found.position + self._origin), film, replaced

    def trace(
        self,
        samples: SurfaceSamples,
        sampling: visibility.ShadowSampling,
        *,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Shadows:
        """The shadows of `samples` under all lights; see `visibility.visible_shares` for the other arguments."""
        start = time.perf_counter()
        samples = replace(samples, position=samples.position - self._origin)
        found = visibility.visible_shares(
            samples, self._lights, self._tracer, sampling, workers=workers, progress=progress
        )
        passes, film = sampling.passes, sampling.film
        shares = {name: getattr(found, name) for name in passes}
        noise = {name: found.noise(name, film) for name in passes}
        seconds, tracer = time.perf_counter() - start, self._tracer.description
        made = Shadows(shares, found.numbers, noise, found.rays, tracer, seconds)
        if film is None:
            return made
        light = {name: film.image(found.radiance[name]) for name in passes}
        variance = {name: film.variance(np.square(found.deviation[name])) for name in passes}
        return replace(made, light=light, variance=variance)


def trace_shadows(extraction, passes: Sequence[str], rays: int, progress: Progress | None) -> Shadows:
    """The shadows of the samples of an `Extraction`; the samples of a pixel share `rays` per light."""
    film = extraction.film
    sampling = visibility.ShadowSampling(passes, rays_of_samples(rays, film), film)
    with ShadowTracer(extraction.occluders, extraction.lights, extraction.origin) as tracer:
        return tracer.trace(extraction.samples, sampling, progress=progress)


def shade_lights(
    samples: SurfaceSamples,
    lights: Sequence[AreaLight],
    table: str | shading.LookupTable | shading.OwnTechnique,
    passes: Sequence[str],
    seen: Sequence[Shadows | None] = (None,),
    *,
    workers: int | None = None,
    progress: Callable[[float], bool | None] | None = None,
) -> list[shading.Shading]:
    """Radiance of `samples` (P) under `lights` (L): one Shading for each entry of `seen`.

    An entry is the shadows of the samples, or None for no shadows. All shadows must group the lights alike.

    Lights that share their rays are shaded together and then multiplied by their share, so that a sample that sees
    them whole gets the same bits as without shadows. Exception: many lights without any shadows go to `shade` at once,
    which then merges those that a sample cannot tell apart.
    """
    if lights and all(shares is None for shares in seen):
        if max(Counter(light.group for light in lights).values()) >= FEWEST:
            found = shading.shade(samples, lights, table, passes=tuple(passes), workers=workers, progress=progress)
            return [found] * len(seen)
    groups = tuple(dict.fromkeys(light.group for light in lights)) or ("",)
    shape = len(groups), len(samples), 3
    sums = [{name: np.zeros(shape, np.float32) for name in passes} for _ in seen]
    numbers = next((shadows.numbers for shadows in seen if shadows is not None), None)
    numbers = visibility.shared_numbers(lights) if numbers is None else numbers
    error, most = None, max(1, MOST_PAIRS // max(1, len(samples)))
    for first in range(0, len(numbers), most):
        part = numbers[first : first + most]
        start, share = first / len(numbers), len(part) / len(numbers)

        def report(fraction, start=start, share=share):
            return None if progress is None else progress(start + fraction * share)

        own = [lights[light].altered(group=str(number)) for number, one in enumerate(part) for light in one]
        found = shading.shade(samples, own, table, passes=tuple(passes), workers=workers, progress=report)
        if found.quadrature_error is not None:
            error = found.quadrature_error if error is None else error + found.quadrature_error
        for number, one in enumerate(part):
            group = groups.index(lights[one[0]].group)
            for name in passes:
                radiance = getattr(found, name)[number]
                for whole, shadows in zip(sums, seen, strict=True):
                    is_all = shadows is None
                    share = 1.0 if is_all else shadows.shares[name][first + number][:, None]
                    whole[name][group] += radiance if is_all else share * radiance
    return [shading.Shading(groups, whole.get("specular"), whole.get("diffuse"), error) for whole in sums]


def layer_names(names: Iterable[str]) -> list[str]:
    """`names` made unique for layers, with _ for the dots that separate the parts of a layer's name."""
    found: list[str] = []
    for name in names:
        plain = name.replace(".", "_")
        others = (f"{plain}_{number}" for number in itertools.count(2))
        found.append(next(other for other in itertools.chain([plain], others) if other not in found))
    return found


def group_names(groups: Sequence[str]) -> list[str]:
    """Layer names of light groups. The empty group becomes "ungrouped", or a longer name that is free."""
    ungrouped = "ungrouped"
    while ungrouped in groups:
        ungrouped += "_"
    return layer_names(group or ungrouped for group in groups)


@dataclass(frozen=True)
class RelightData:
    """A picture kept by `write_relight_data`: all that shading needs, without Blender and without rays.

    whole picture = sum over passes of `shown` x image of the samples, + sum of `rest`; all include the exposure.
    """

    extraction: Any  # blender.process.pixels.Extraction, without reference and occluders
    shadows: Shadows | None
    options: dict  # fields of PictureOptions
    had_cycles: bool
    # By light group: its bounced light (H, W, 3). By "": what depends on no light group (H, W, 3 or 4 with alpha).
    rest: dict[str, np.ndarray] = field(default_factory=dict)
    # By pass (H, W): the share of the pass that is ours and not Cycles'; left out: 1.
    taken: dict[str, np.ndarray] = field(default_factory=dict)
    # By pass (H, W): a factor of hard edges of light, valid only while the lights stay where they were; left out: 1.
    edges: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def technique(self) -> str:
        """The last technique of the picture except the reference: by convention the most accurate."""
        names = [name for name in self.options["techniques"] if name != REFERENCE]
        return names[-1] if names else "ltsh4"

    def shown(self, name: str, *, moved: bool = False) -> np.ndarray | float:
        """Factor (H, W, 1) of the image of a pass of the samples; without `edges` for `moved` lights."""
        taken = self.taken[name][..., None] if name in self.taken else 1.0
        return taken if moved or name not in self.edges else taken * self.edges[name][..., None]

    @classmethod
    def load(cls, path: Path) -> RelightData:
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
    def _of(cls, document, arrays) -> RelightData:
        from ..blender.process.pixels import CyclesPasses, Extraction, ExtractionTimes, PictureFacts

        record = document["extraction"]
        extraction = Extraction(
            lights=lights_of(record["lights"]),
            samples=SurfaceSamples(
                **{item.name: _compact(arrays[f"samples.{item.name}"]) for item in fields(SurfaceSamples)}
            ),
            film=Film(
                pixel=arrays["film.pixel"],
                **{name: arrays.get(f"film.{name}") for name in FILM_ARRAYS},
                **record["film"],
            ),
            picture=PictureFacts.of(record),
            cycles=CyclesPasses(**{name: arrays.get(f"picture.{name}") for name in NOT_REFLECTED}),
            times=ExtractionTimes(record["seconds"]),
            warnings=tuple(record["warnings"]),
            problems=tuple(record["problems"]),
            origin=np.array(record["origin"]),
            light_settings=record["light_settings"],
        )
        shadows = document["shadows"]
        if shadows is not None:
            shares = {name: arrays[f"shares.{name}"] for name in shadows["noise"]}
            numbers = tuple(map(tuple, shadows["numbers"]))
            shadows = Shadows(shares, numbers, shadows["noise"], shadows["rays"], shadows["tracer"])
        options = document["options"]
        options = {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
        options["scene"] = Path(options["scene"])
        rest = {name: arrays[f"rest.{name}"] for name in document["rest"]}
        taken, edges = ({name: arrays[f"{kind}.{name}"] for name in document[kind]} for kind in ("taken", "edges"))
        return cls(extraction, shadows, options, document["had_cycles"], rest, taken, edges)


def _compact(values: np.ndarray) -> np.ndarray:
    """`values`; a broadcast zero where all are zero."""
    return values if values.any() else np.broadcast_to(values.dtype.type(0), values.shape)


NOT_REFLECTED = ("emission", "background")  # optional arrays of `Extraction.cycles`
FINISHED = ("rest", "taken", "edges")  # fields of a RelightData that only finished pictures have
RELIGHT_OPTIONS = ("techniques", "passes", "sub_samples", "reference_samples", "shadows", "shadow_rays")


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
            "origin": np.asarray(extraction.origin).tolist(),
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
    seen = {name: getattr(extraction.cycles, name) for name in NOT_REFLECTED}
    arrays |= {f"picture.{name}": values.astype(np.float32) for name, values in seen.items() if values is not None}
    for kind, parts in finished.items():
        arrays |= {f"{kind}.{name}": np.asarray(values, np.float32) for name, values in parts.items()}
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
