"""A bake's part in Blender through a child process, as `child` does it. Imports no bpy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from ...imaging.atomic import replacing_by_copy
from ..processes import child


@dataclass(frozen=True)
class BakeJob:
    """What to take from which file for a bake; None means as in the file."""

    scene: Path
    objects: tuple[str, ...] | str  # names, "selected" or "all"
    uv: str | None
    width: int
    height: int
    block_rows: int
    view: tuple[float, float, float] | str  # a position, "camera" or "above"
    camera: str | None
    frame: int | None
    cycles_samples: int
    passes: tuple[str, ...]  # of Cycles
    finished: tuple[tuple[str, int], ...] = ()  # (object, tile): of these no maps are needed
    look_up_images: bool = True  # False: everything that varies is a map
    following: tuple[str, ...] = ()  # objects that jobs after this one will want of the same file
    scripts: bool = False  # run those of the file
    tile: int | None = None  # the UDIM tile that is wanted, None for all


def extract_bake(job: BakeJob, folder: Path, *, progress: child.Progress | None = None) -> dict:
    """Meshes, materials, maps and Cycles' bake of a .blend as files in `folder`; the manifest.

    Raises as `extract` does.
    """
    scene = Path(job.scene).absolute()
    child.check_readable(scene)
    with child.termination_as_exception():
        return child.run_child({"task": "bake", **asdict(job), "scene": str(scene)}, folder, progress)


def apply_bake(scene: Path, path: Path, textures: list[dict], *, progress: child.Progress | None = None) -> list[str]:
    """Save a copy of `scene` as the .blend `path` in which objects show baked textures; the warnings.

    Each of `textures` has "object", "uv", "name" and "files", a list of {"path", "tile"}. The copy appears complete or
    not at all. Raises as `extract` does.
    """
    with replacing_by_copy(Path(path).absolute()) as unfinished, child.temporary_folder() as folder:
        job = {"task": "apply", "scene": str(Path(scene).absolute()), "path": str(unfinished), "textures": textures}
        return child.run_child(job, folder, progress)["warnings"]
