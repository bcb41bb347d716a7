"""The jobs of views: pictures as the viewport draws them, and worlds and node lights that Cycles renders for a view.

Imports no bpy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ...scene import Light, Progress, SceneError, light_of
from .blender_process import run_job, run_scene_job

# VIEW_PASSES: the pictures that are drawn of a view. VIEW_PNG: the file of the first. GRAPHICS: the stage that the
# child reports before it asks for a graphics card; on a machine without one it may crash there.
VIEW_PASSES = ("combined", "specular", "diffuse")
VIEW_PNG = "view.png"
GRAPHICS = "graphics"
NO_GRAPHICS = (
    "Blender finds no graphics card here, nor a program in its place: install OpenGL (on Linux libegl1 and "
    "libgl1-mesa-dri draw without a card), or use shade, which needs none"
)


@dataclass(frozen=True)
class ViewJob:
    """What to draw as the viewport draws it; None means as in the file."""

    scene: Path
    techniques: tuple[str, ...]  # names or absolute paths of tables
    refine: int
    width: int | None
    height: int | None
    frame: int | None
    camera: str | None
    shadows: str  # "on" or "off"
    shadow_rays: int  # per light and pixel
    scripts: bool = False  # run the scripts in the file


def draw_view(job: ViewJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Write pictures of a .blend into `folder`; returns the manifest.

    The files are `VIEW_PNG` and "<number of the technique>_<pass>.npy", RGBA with row 0 on top, times the exposure.
    Raises as `pixels.extract_pixels` does.
    """
    stages = [""]

    def watched(stage: str, fraction: float) -> bool | None:
        stages.append(stage)
        return None if progress is None else progress(stage, fraction)

    try:
        return run_scene_job(job, folder, watched)
    except SceneError as error:
        if stages[-1] == GRAPHICS:
            raise SceneError(NO_GRAPHICS) from error
        raise


@dataclass(frozen=True)
class WorldJob:
    """Render the `world` in the .blend `path` at a frame."""

    path: Path
    world: str
    frame: int


@dataclass(frozen=True)
class WorldPicture:
    """A world as Cycles renders it."""

    light: np.ndarray  # (6, N, N, 3), see `cycles.environment.CUBE`; empty if it gives no light
    lights: tuple[Light, ...]  # its small, bright spots
    background: np.ndarray  # (M, M, 3), see `viewport.light_texels`
    warnings: list[str]


def render_world(job: WorldJob, folder: Path, progress: Progress | None = None) -> WorldPicture:
    """The world of `job`; files go to `folder`. Raises as `pixels.extract_pixels` does."""
    manifest = run_job(job, folder, progress)
    light, background = (np.load(folder / f"{name}.npy") for name in ("light", "background"))
    lights = tuple(light_of(record) for record in manifest["lights"])
    return WorldPicture(light, lights, background, manifest["warnings"])


NODE_LIGHTS = "look at lights"  # a stage; its fraction is the share of the lights that have files


@dataclass(frozen=True)
class NodeLightFile:
    """A light's data block in a .blend, whose nodes Cycles should render, and fields of its `NodeLight`."""

    path: str
    name: str
    matrix: list  # (4, 4)
    flags: dict
    facts: dict


@dataclass(frozen=True)
class NodeLightJob:
    """Render the nodes of `lights` at a frame, one after another."""

    lights: list[dict]  # fields of `NodeLightFile`
    frame: int


def render_node_lights(lights: list[NodeLightFile], frame: int, folder: Path, take: Callable[..., bool]) -> None:
    """Let Cycles render the nodes of `lights` at a frame, one after another.

    Calls `take(number, factor, traits)` for each, with the values of a `lights.textures.NodeEmission`, until it returns
    False. Files go to `folder`. Raises as `pixels.extract_pixels` does.
    """

    def watched(stage: str, fraction: float) -> bool | None:
        number = round(fraction * len(lights)) - 1
        if stage != NODE_LIGHTS:
            return None
        return take(number, np.load(folder / f"{number}.npy"), np.load(folder / f"{number}_traits.npy").tolist())

    run_job(NodeLightJob([asdict(light) for light in lights], frame), folder, watched)
