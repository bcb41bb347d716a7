"""The job of a finished picture: the unchanged scene as Cycles renders it, and its PNG. Imports no bpy."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...cycles.lobes import read_layer
from ...scene import Progress
from .blender_process import run_job, run_scene_job
from .pixels import rendered_channels

PICTURE = "picture.npy"
# HALVED: the keys of passes that the halves of a picture have too.
HALVED = ("diffuse_light", "specular_light", "emission", "background")


@dataclass(frozen=True)
class FinishedJob:
    """What Cycles should render of an unchanged scene; None means as in the file."""

    scene: Path
    frame: int | None
    camera: str | None
    scene_name: str | None
    view_layer: str | None
    width: int | None
    height: int | None
    cycles_samples: int | None
    seconds: float | None  # processor time, in place of samples
    scripts: bool = False  # run the scripts in the file
    own_groups: tuple[str, ...] | None = None  # lights, () for all, that get light groups of their own
    edges: bool = True  # also render what emits in sight separately, with smooth edges
    begins: bool = False  # only the first files
    begun: dict | None = None  # the `CyclesPicture.begun` that another job has begun in the same folder, to go on with


@dataclass(frozen=True)
class CyclesHalf:
    """What about half of the samples show."""

    channels: dict[str, np.ndarray]  # (H, W) each, those of Combined and of the passes in HALVED
    samples: int


@dataclass(frozen=True)
class CyclesPicture:
    """What Cycles rendered, row 0 on top."""

    channels: dict[str, np.ndarray]  # (H, W) each, by name without that of the view layer
    guides: dict[str, np.ndarray]  # the channels for the denoiser
    to_camera: np.ndarray  # (3, 3) turns directions, as columns, into the space of the normals among them
    names: dict[str, str]  # of passes, as in `pass_names`
    samples: int
    halves: tuple[CyclesHalf, ...]  # of its samples, with noise of their own; () if there is one file
    shining: tuple[str, ...]  # the keys of the passes with what emits in sight, as far as Combined has it
    smooth_emission: dict[str, np.ndarray]  # (H, W, 3) what emits in sight, with smooth edges, by the key of its pass
    everything: tuple[str, ...]  # reasons why all direct light is left to Cycles
    warnings: tuple[str, ...]
    camera: str
    frame: int
    processor_seconds: float
    begun: dict  # its files, and processor seconds: `each` of a sample, the `least` that every picture of it takes
    pixels: dict  # the manifest of a `PixelJob` of it without samples


def render_finished(job: FinishedJob, folder: Path, *, progress: Progress | None = None) -> CyclesPicture:
    """The unchanged scene as Cycles renders it. Raises as `pixels.extract_pixels` does."""
    manifest = run_scene_job(job, folder, progress)
    channels, halves = _mean_of_chunks(manifest, folder)
    samples = sum(count for _, count in manifest["files"])
    shining = ("emission",) if manifest["film_transparent"] else ("emission", "background")
    dropped = tuple(f"{name}." for name in manifest["dropped"])
    return CyclesPicture(
        channels={name: plane for name, plane in channels.items() if not name.startswith(dropped)},
        guides={name: plane for name, plane in channels.items() if name.startswith("Denoising ")},
        to_camera=np.array(manifest["to_camera"]),
        names=manifest["passes"],
        samples=samples,
        halves=halves,
        shining=shining,
        smooth_emission=_smooth_emission(manifest, folder, channels, shining, samples),
        everything=tuple(manifest["everything"]),
        warnings=tuple(manifest["warnings"]),
        begun={name: manifest[name] for name in ("files", "each", "least")},
        **{name: manifest[name] for name in ("camera", "frame", "processor_seconds", "pixels")},
    )


def _smooth_emission(manifest: dict, folder: Path, channels: dict[str, np.ndarray], shining, samples: int) -> dict:
    """`CyclesPicture.smooth_emission`: means over the samples of the whole scene and of EDGES; {} without EDGES."""
    if manifest["edges"] is None:
        return {}
    name, most = manifest["edges"]
    edges = _without_layer(rendered_channels(folder / name), manifest["layer"])
    count = most * edges["Debug Sample Count.X"][..., None]
    names = {key: manifest["passes"][key] for key in shining}
    return {
        key: (count * read_layer(edges, name, "RGB") + samples * read_layer(channels, name, "RGB")) / (count + samples)
        for key, name in names.items()
    }


def _mean_of_chunks(manifest: dict, folder: Path) -> tuple[dict[str, np.ndarray], tuple[CyclesHalf, ...]]:
    """The channels: those of light are means over all chunks, all others come from the largest chunk. And the halves,
    () for one chunk."""
    files = sorted(manifest["files"], key=lambda item: -item[1])
    total, channels, halves, counts = sum(count for _, count in files), {}, ({}, {}), [0, 0]
    halved = tuple(f"{name}." for name in ("Combined", *(manifest["passes"][key] for key in HALVED)))
    for name, count in files:
        chunk = _without_layer(rendered_channels(folder / name), manifest["layer"])
        if not channels:
            channels = dict(chunk)
            light = [key for key in chunk if key[-2:] in (".R", ".G", ".B", ".A") or key.startswith("Denoising ")]
            channels |= {key: np.zeros_like(chunk[key]) for key in light}
        for key in light:
            channels[key] += count / total * chunk[key]
        smaller = int(np.argmin(counts))
        half, counts[smaller] = halves[smaller], counts[smaller] + count
        for key in chunk:
            if key.startswith(halved):
                half[key] = half.get(key, 0.0) + np.float32(count) * chunk[key]
    if len(files) < 2:
        return channels, ()
    return channels, tuple(
        CyclesHalf({key: plane / np.float32(count) for key, plane in half.items()}, count)
        for half, count in zip(halves, counts, strict=True)
    )


def _without_layer(channels: dict[str, np.ndarray], layer: str) -> dict[str, np.ndarray]:
    """`channels` by their names without that of the view `layer`."""
    return {key.removeprefix(f"{layer}."): plane for key, plane in channels.items()}


@dataclass(frozen=True)
class ShowJob:
    """Write the array `pixels` (H, W, 4) as the PNG `name`, through the view transform of a scene."""

    scene: Path
    scene_name: str | None  # None: the file's own
    frame: int | None
    pixels: Path
    name: str


def show_finished(
    scene: Path, scene_name: str | None, frame: int | None, folder: Path, name: str, *, progress: Progress | None = None
) -> None:
    """Write `PICTURE` (H, W, 4) in `folder` as the PNG `name` beside it; see `ShowJob`."""
    run_job(ShowJob(Path(scene).absolute(), scene_name, frame, folder / PICTURE, name), folder, progress)
