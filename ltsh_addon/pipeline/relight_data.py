"""The file of `--keep-visibility`: the samples of a picture, with all that relighting needs."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..files import replacing
from ..scene import REFERENCE, Border, ColorSpace, Film, SurfaceSamples, error_line, light_records, lights_of
from .lighting import Shadows

# The two files of `write_relight_data`: the samples with all that shading needs, and the occluders.
RELIGHT_SUFFIX, OCCLUDERS_SUFFIX = ".samples.npz", ".occluders.npz"
RELIGHT_OPTIONS = ("techniques", "passes", "sub_samples", "reference_samples", "shadows", "shadow_rays")
FILM_ARRAYS = ("first", "count", "spread", "whole")  # the optional arrays of a film
NOT_REFLECTED = ("emission", "background")  # optional arrays of an Extraction
FINISHED = ("rest", "taken", "edges")  # fields of a RelightData that only finished pictures have


@dataclass(frozen=True)
class RelightData:
    """A picture with all that shading needs, without Blender and without rays.

    whole picture = sum over passes of `shown` x image of the samples, + sum of `rest`; all include the exposure.
    """

    extraction: Any  # blender.process.client.Extraction, without reference and occluders
    shadows: Shadows | None
    options: dict  # fields of PictureOptions
    had_cycles: bool
    # By light group: its bounced light (H, W, 3). By "": what depends on no light group (H, W, 3 or 4 with alpha).
    rest: dict[str, np.ndarray] = field(default_factory=dict)
    # By pass (H, W): the share of the pass that is LTSH's and not Cycles'; left out: 1.
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
        from ..blender.process.client import UNCHANGED, Extraction

        facts = document["extraction"]
        border, space = facts["border"], facts["color_space"]
        samples = {item.name: _compact(arrays[f"samples.{item.name}"]) for item in fields(SurfaceSamples)}
        of_film = {name: arrays.get(f"film.{name}") for name in FILM_ARRAYS}
        extraction = Extraction(
            **{name: facts[name] for name in UNCHANGED},
            lights=lights_of(facts["lights"]),
            samples=SurfaceSamples(**samples),
            film=Film(pixel=arrays["film.pixel"], **of_film, **facts["film"]),
            warnings=tuple(facts["warnings"]),
            problems=tuple(facts["problems"]),
            reference=None,
            origin=np.array(facts["origin"]),
            border=None if border is None else Border(**border),
            color_space=ColorSpace(space["name"], np.array(space["to_rec709"])),
            **{name: arrays.get(f"picture.{name}") for name in NOT_REFLECTED},
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
    from ..blender.process.client import UNCHANGED

    film, space = extraction.film, extraction.color_space
    document = {
        "extraction": {
            **{name: getattr(extraction, name) for name in UNCHANGED},
            "lights": light_records(extraction.lights),
            "film": {"width": film.width, "height": film.height, "sub_samples": film.sub_samples},
            "warnings": extraction.warnings,
            "problems": extraction.problems,
            "origin": np.asarray(extraction.origin).tolist(),
            "border": None if extraction.border is None else vars(extraction.border),
            "color_space": {"name": space.name, "to_rec709": space.to_rec709.tolist()},
        },
        "shadows": None if shadows is None else {**shadows.report(), "numbers": shadows.numbers},
        "options": {"scene": str(options.scene), **{name: getattr(options, name) for name in RELIGHT_OPTIONS}},
        "had_cycles": extraction.reference is not None,
        **{kind: list(finished.get(kind, ())) for kind in FINISHED},
    }
    arrays = {f"samples.{item.name}": getattr(extraction.samples, item.name) for item in fields(SurfaceSamples)}
    arrays["film.pixel"] = film.pixel
    arrays |= {f"film.{name}": getattr(film, name) for name in FILM_ARRAYS if getattr(film, name) is not None}
    if shadows is not None:
        arrays |= {f"shares.{name}": values for name, values in shadows.shares.items()}
    images = {name: getattr(extraction, name) for name in NOT_REFLECTED}
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
