"""The jobs of a bake: what there is to bake, its texels, and objects that show textures. Imports no bpy."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ...files import replacing_by_copy, temporary_folder
from ...scene import Progress
from .blender_process import run_job, run_scene_job


@dataclass(frozen=True)
class BakeJob:
    """What to extract from which file for a bake; None means as in the file."""

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
    look_up_images: bool = True  # False: everything that varies is a map
    following: tuple[str, ...] = ()  # objects of the same file that later jobs need
    scripts: bool = False  # run the scripts in the file
    tile: int | None = None  # the only UDIM tile to extract; None: all
    sub_samples: int = 1  # points of a texel that need maps
    shadows: str = "off"  # see `pixels.PixelJob`
    atlas: int | None = None  # all objects share a texture with so many texels a side; without `uv` its map is made
    texels_per_metre: float | None = None  # of the atlas; None: as many as fit
    unwrap: str = "smart"  # "faces": every edge is a seam
    bounces: str = "off"  # "on": also Cycles' indirect light, and Cycles' bake has it too
    rest_samples: int = 64  # of Cycles for the indirect light
    rest_passes: tuple[str, ...] = ()  # with bounces: of the indirect light; the diffuse one has no color
    rest_rows: int = 1  # rows of texels of which it is baked at a time
    per_light: bool = False  # each light by itself: its group is its own name, if it has none


def extract_bake(job: BakeJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Write meshes, materials, maps and Cycles' bake of a .blend as files into `folder`; returns the manifest.

    Raises as `pixels.extract_pixels` does.
    """
    return run_scene_job(job, folder, progress)


@dataclass(frozen=True)
class BakedTextures:
    """The baked textures of an object, or of those that share an atlas."""

    objects: list[str]
    uv: str  # the UV map on which they lie
    name: str  # of the image in Blender
    files: list[dict]  # {"path", "tile"} each


@dataclass(frozen=True)
class ApplyJob:
    """Save a copy of `scene` as `path`, in which objects show `textures`."""

    scene: Path
    path: Path
    textures: list[BakedTextures]  # in the child their fields
    frame: int | None = None
    atlas: dict | None = None  # arguments of `extract.atlas.make_atlas`, the "objects" by name


@dataclass(frozen=True)
class ExportJob:
    """Export objects of `scene` as the .glb `path`."""

    scene: Path
    path: Path
    uv_names: dict[str, str]  # the UV map of each object, by its name
    frame: int | None = None
    atlas: dict | None = None  # as in `ApplyJob`


def export_objects(job: ExportJob, *, progress: Progress | None = None) -> dict[str, int]:
    """Export objects with all modifiers applied; returns the number of the UV map of each in glTF, by its name.

    Raises as `pixels.extract_pixels` does.
    """
    with temporary_folder() as folder:
        return run_job(job, folder, progress)["coordinates"]


def apply_bake(job: ApplyJob, *, progress: Progress | None = None) -> list[str]:
    """Save a copy of the scene as job.path, in which objects show baked textures; returns warnings.

    The copy appears complete or not at all. Raises as `pixels.extract_pixels` does.
    """
    with replacing_by_copy(Path(job.path).absolute()) as unfinished, temporary_folder() as folder:
        textures = [asdict(entry) for entry in job.textures]
        job = replace(job, scene=Path(job.scene).absolute(), path=unfinished, textures=textures)
        return run_job(job, folder, progress)["warnings"]


@dataclass(frozen=True)
class BakeFactsJob:
    """What there is to find out about a bake of `objects`: names, "selected", "all", or None for none.

    `uv` is a UV map; None: the active ones. `scripts`: run those in the file. `view` and `bounces` are as in `BakeJob`.
    """

    scene: Path
    frames: list[int | None]  # None: the file's own
    objects: tuple[str, ...] | str | None = None
    uv: str | None = None
    scripts: bool = False
    view: tuple[float, float, float] | str = "camera"
    bounces: str = "off"


def scene_facts(job: BakeFactsJob, *, progress: Progress | None = None) -> list[dict]:
    """What there is to bake in each frame of the `job`.

    Each entry has "frame", "camera" (name or None), "objects" (names of objects to bake), "tiles" (the UDIM tiles by
    object, for objects with several), "lights" (about how many rows of lights `per_light` makes), and for a single
    frame "digests" (by object, see `extract.dependencies`) or "not_judged" (why there are none).
    Raises as `pixels.extract_pixels` does.
    """
    with temporary_folder() as folder:
        return run_scene_job(job, folder, progress)["facts"]
