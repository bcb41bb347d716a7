"""Final renders of the engine LTSH: the samples that `ltsh shade` takes, in a child process, shaded by numpy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ... import shading
from ..processes import child
from .stoppable import Progress
from .view_properties import TECHNIQUE_LABELS

# Share of the progress bar that taking the samples gets.
EXTRACTION_SHARE = 0.7
PASS_LABELS = {"specular": "Specular", "diffuse": "Diffuse"}
EMISSION = "LTSH Emission"


@dataclass(frozen=True)
class FinalJob:
    """What the render of one view layer needs to know of the scene."""

    scene: str
    view_layer: str
    frame: int | None  # None: as in the copy of the file
    sub_samples: int
    technique: str
    shown: str  # combined, specular or diffuse
    other_techniques: tuple[str, ...] = ()  # with passes of their own
    background: np.ndarray | None = None  # (3,) radiance behind the surfaces, None: transparent

    def shaded_as(self) -> dict[str, str]:
        """Names of passes start with -> technique."""
        return {"LTSH": self.technique, **{TECHNIQUE_LABELS[name]: name for name in self.other_techniques}}


def pass_names(prefixes) -> list[str]:
    """Names of the render passes beside Combined."""
    return [*(f"{prefix} {label}" for prefix in prefixes for label in PASS_LABELS.values()), EMISSION]


@dataclass(frozen=True)
class FinalPicture:
    """Pictures with row 0 on top: RGBA (H, W, 4), passes (H, W, 3) by name."""

    combined: np.ndarray
    passes: dict[str, np.ndarray]
    warnings: tuple[str, ...]


def final_picture(job: FinalJob, scene_file: Path, progress: Progress) -> FinalPicture:
    """Take samples of the .blend `scene_file` and shade them. Uses no bpy.

    `progress(stage, fraction of the whole)` returns False to stop. Raises SceneError, TableError, Cancelled, OSError.
    """
    options = child.ExtractOptions(
        scene=scene_file,
        sub_samples=job.sub_samples,
        frame=job.frame,
        scene_name=job.scene,
        view_layer=job.view_layer,
        emission=True,
    )
    extraction = child.extract(options, progress=_part(progress, 0.0, EXTRACTION_SHARE))
    names = list(dict.fromkeys(job.shaded_as().values()))
    share = (1.0 - EXTRACTION_SHARE) / len(names)
    images = {
        name: _images(extraction, name, _part(progress, EXTRACTION_SHARE + index * share, share))
        for index, name in enumerate(names)
    }
    passes = {
        f"{prefix} {label}": images[name][part]
        for prefix, name in job.shaded_as().items()
        for part, label in PASS_LABELS.items()
    }
    emission = extraction.exposure * inside_border(extraction.emission, extraction.border)
    passes[EMISSION] = emission
    shown = shading.PASSES if job.shown == "combined" else (job.shown,)
    color = sum(images[job.technique][part] for part in shown)
    if job.shown == "combined":
        color = color + emission
    coverage = inside_border(extraction.film.coverage(), extraction.border)
    return FinalPicture(_over_background(color, coverage, job, extraction.exposure), passes, extraction.warnings)


def _part(progress: Progress, start: float, share: float) -> Progress:
    """A progress callback for a stage that takes `share` of the whole from `start` on."""
    return lambda stage, fraction: progress(stage, start + share * fraction)


def _images(extraction, technique: str, progress: Progress) -> dict[str, np.ndarray]:
    """Radiance (H, W, 3) of each pass times the film's exposure."""
    images = {}
    for index, name in enumerate(shading.PASSES):
        part = _part(progress, index / len(shading.PASSES), 1.0 / len(shading.PASSES))
        shaded = shading.shade(
            extraction.samples,
            extraction.lights,
            technique,
            passes=(name,),
            progress=lambda fraction, part=part: part(TECHNIQUE_LABELS[technique], fraction),
        )
        image = extraction.film.image(extraction.exposure * shaded.combined)
        images[name] = inside_border(image, extraction.border)
    return images


def _over_background(color: np.ndarray, coverage: np.ndarray, job: FinalJob, exposure: float) -> np.ndarray:
    """RGBA (H, W, 4) of `color`."""
    if job.background is None:
        return np.concatenate([color, coverage[..., None]], axis=-1)
    behind = exposure * job.background * (1.0 - coverage)[..., None]
    return np.concatenate([color + behind, np.ones((*coverage.shape, 1))], axis=-1)


def inside_border(image: np.ndarray, border) -> np.ndarray:
    """The part of `image` (H, W, ...) inside the render region: what Blender takes from engines, cropped or not."""
    if border is None or border.cropped:
        return image
    return image[border.top : border.top + border.height, border.left : border.left + border.width]


def blender_pixels(image: np.ndarray) -> np.ndarray:
    """`image` (H, W, C), row 0 on top, as Blender's flat float32 list that starts at the bottom left."""
    return np.ascontiguousarray(image[::-1], dtype=np.float32).ravel()
