"""The jobs of `match`: reading a target picture, and a copy of the scene with changed lights. Imports no bpy."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...files import replacing_by_copy, temporary_folder
from ...scene import Progress
from .blender_process import run_scene_job

TARGET = "target.npz"


@dataclass(frozen=True)
class TargetJob:
    """Read the pictures `target` and `mask` as the light of a scene; None means as in the file."""

    scene: Path
    target: Path
    mask: Path | None
    target_view: str | None
    frame: int | None
    scripts: bool = False


@dataclass(frozen=True)
class LightsJob:
    """Save a copy of `scene` as `path`, whose lights have `factors` (3,) times their radiance, by light group.

    The groups are those of `lights` by `own_light_groups`. `moves` are records of `LightMove` by group,
    `added` is the record of a light to add.
    """

    scene: Path
    path: Path
    factors: dict[str, list[float]]
    lights: tuple[str, ...]
    moves: dict[str, dict]
    added: dict | None = None
    scripts: bool = False


def read_target(job: TargetJob, folder: Path, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray, dict]:
    """The target (H, W, 3), row 0 on top, in scene-referred radiance; and the weights (H, W) of its pixels, 0 where it
    is clipped or outside of the mask; by light object, why it may not move. Raises as `pixels.extract_pixels` does."""
    reasons = run_scene_job(job, folder, progress)["reasons"]
    with np.load(folder / TARGET) as arrays:
        return arrays["target"].astype(np.float64), arrays["weights"].astype(np.float64), reasons


def save_lights(job: LightsJob, progress: Progress | None = None) -> list[dict]:
    """Do the `job`; the copy appears complete or not at all. Returns of each light "name", "group" ("": it is new),
    "color", and "power_before", "power_after" and so on. Raises as `pixels.extract_pixels` does."""
    with replacing_by_copy(Path(job.path).absolute()) as unfinished, temporary_folder() as folder:
        return run_scene_job(replace(job, path=unfinished), folder, progress)["lights"]
