"""The jobs of views: pictures as the viewport draws them, and worlds and node lights that Cycles renders for a view.

Imports no bpy.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ...cycles.lobes import read_layer
from ...imaging.color import srgb_encode
from ...imaging.denoise import FARTHEST, NoDenoiser, open_denoiser, smoothed
from ...scene import Light, Progress, SceneError, light_of
from ...workers.pool import cores
from .blender_process import denoiser_libraries, run_job, run_scene_job
from .pixels import rendered_channels

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
    rest: Path | None = None  # the file of what Cycles adds, see `RestSum.picture`
    is_everything: bool = False  # it is the whole picture
    scripts: bool = False  # run the scripts in the file
    is_playblast: bool = False  # one of several frames


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


# REST_RENDER: what Cycles renders for a RestJob. REST_PICTURE: the picture of that.
REST_RENDER, REST_PICTURE = "rest.exr", "rest.npy"


@dataclass(frozen=True)
class RestView:
    """What a rest is of: a state of a scene, and a view of it; None means as in the file."""

    scene: str | None = None
    view_layer: str | None = None
    version: tuple[int, int] = (0, 0)  # of the scene, and of all in it but lights
    frame: int | None = None
    hidden: tuple[str, ...] = ()  # names of objects that its local view hides
    world: bool = True  # with the light of the world
    matrices: tuple | None = None  # of a region: from the world to the view, and to clip space, (4, 4) each
    size: tuple[int, int] | tuple[None, None] = (None, None)


@dataclass(frozen=True)
class RestJob:
    """Render what Cycles adds to the direct light of a view, and add it to the sum of samples that the child has."""

    scene: Path | None  # None: the one that the last job has opened
    view: RestView  # in the child a dict
    samples: int
    done: int = 0  # the samples that the sum has in all rows
    shrink: int = 1  # pixels of the view in either direction that share one
    rows: tuple[float, float] = (0.0, 1.0)  # the shares of the height between which it is rendered
    camera: str | None = None  # where the view has no matrices
    changes: dict | None = None  # of the scene that the last job has opened, see `viewport.second_blender.RestChanges`
    continues: bool = False  # the sum of the last job; else it is begun anew
    scripts: bool = False  # run the scripts in the file

    @property
    def total(self) -> int:
        """The samples that the sum has in all rows after it."""
        return self.done + (self.samples if self.rows[1] == 1.0 else 0)


@dataclass(frozen=True)
class LiveRestJob:
    """Render the rest of a view in steps, and write one picture after another, each with more samples or pixels."""

    scene: Path | None  # as those of a RestJob
    view: RestView  # in the child a dict
    changes: dict | None
    work: float  # samples of single pixels that a step takes
    has_whole: bool  # also Cycles' whole picture, where it errs less than the view's own


NEAR = 0.05  # depths that differ by this share are those of different surfaces


def marked_depth(depth: np.ndarray) -> np.ndarray:
    """Depths (H, W) of surfaces in m, negative where pixels beside are of other surfaces, whose light they share."""
    low = high = np.pad(depth, 1, mode="edge")
    for axis in (0, 1):
        rows = [np.take(each, range(n, n + depth.shape[axis]), axis) for each in (low, high) for n in range(3)]
        low, high = np.min(rows[:3], axis=0), np.max(rows[3:], axis=0)
    return np.where((low < depth * (1.0 - NEAR)) | (high > depth * (1.0 + NEAR)), -depth, depth)


@dataclass
class RestSum:
    """The sum of the samples of one view, row 0 on top."""

    light: np.ndarray  # (H, W, 3) Combined without what the view draws itself
    whole: np.ndarray  # (H, W, 3) Combined
    guides: np.ndarray  # (H, W, 6) albedo and normal
    mixed: np.ndarray  # (H, W, 7) of the first steps, of one sample each: see `_lost`
    depth: np.ndarray  # (H, W) of the first sample: Cycles writes no other
    samples: int = 0
    singles: int = 0  # the number of these steps
    merged: int = 0  # the samples that came with another in a later step
    is_everything: bool = False  # no light of the view itself remains
    problem: str = ""  # of the denoiser

    @property
    def ambient(self) -> tuple[float, ...]:
        """The mean (3,) over that of the albedo."""
        albedo = np.mean(self.guides[..., :3], axis=(0, 1), dtype=np.float64)
        light = np.mean(self.light, axis=(0, 1), dtype=np.float64)
        return tuple(np.nan_to_num(light / np.maximum(albedo, 0.05 * self.samples)).tolist())

    def add(self, path: Path, row: int, job: RestJob, names: dict[str, str]) -> None:
        """Add the samples of `job` in the EXR `path`, rows from `row` on.

        `names` are those of passes by our keys, and of the AOV "mask".
        """
        channels = rendered_channels(path)
        light = whole = read_layer(channels, "Combined", "RGB")
        if not self.is_everything:
            keys = "specular_light", "specular_color", "diffuse_light", "diffuse_color", "background"
            specular, specular_color, diffuse, diffuse_color, background = (
                read_layer(channels, names[key], "RGB") for key in keys
            )
            mask = np.minimum(read_layer(channels, names["mask"], "X"), 1.0)[..., None]
            drawn = specular * specular_color + diffuse * diffuse_color + background
            light = light - (1.0 - mask) * drawn
            if job.samples == 1 and self.merged == 0:
                self.mixed[row : row + len(light)] += np.concatenate([mask, drawn, mask * drawn], axis=-1)
                self.singles = job.total
            self.merged += job.samples - 1
        guides = [read_layer(channels, *name) for name in (("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ"))]
        rows, count = slice(row, row + len(light)), np.float32(job.samples)
        self.light[rows] += count * light
        self.whole[rows] += count * whole
        self.guides[rows] += count * np.concatenate(guides, axis=-1)
        if job.done == 0:
            # Cycles' denoising depth is that of what a mirror shows.
            self.depth[rows] = np.minimum(read_layer(channels, "Depth", "Z"), FARTHEST)
        self.samples = job.total

    def picture(self) -> np.ndarray:
        """The denoised mean (H, W, 4); alpha is `marked_depth`."""
        light = self.light + (self._lost() if self.merged and self.singles > 1 else 0.0)
        return np.concatenate([self._denoised(light), marked_depth(self.depth)[..., None]], axis=-1)

    def _lost(self) -> np.ndarray:
        """What `light` lacks (H, W, 3) at outlines of what is Cycles' alone. Of several samples in a step it has the
        product of mean share and mean direct light, not that of each: their covariance, which the first steps tell."""
        share, drawn, both = np.split(self.mixed / np.float32(self.singles), (1, 4), axis=-1)
        return self.merged * self.singles / (self.singles - 1) * (both - share * drawn)

    def whole_picture(self) -> np.ndarray:
        """The denoised mean (H, W, 3) with what the view draws itself."""
        return self._denoised(self.whole)

    def _denoised(self, light: np.ndarray) -> np.ndarray:
        light, guides = (each / np.float32(self.samples) for each in (light, self.guides))
        try:
            with open_denoiser(denoiser_libraries(), cores()) as denoiser:
                return denoiser.quickly_denoised(light, guides[..., :3], guides[..., 3:])
        except NoDenoiser:
            self.problem = "Bounces are smoothed, not denoised: this Blender has no denoiser"
            return smoothed(light, np.concatenate([guides, self.depth[..., None]], axis=-1), self.samples)


# OWN_ERROR: of a view's own picture with few points of pixels and coarse shadows, on a screen, without the noise of its
# rest: 2.7 % in the product shot. FALL: squared errors of denoised pictures fall by samples to the power -.6 to -.85.
OWN_ERROR, FALL = 0.025, 0.6


@dataclass
class WholePictureError:
    """The error of Cycles' whole picture of a scene, on a screen: by how much its square exceeds that of the rest.

    A denoised picture of one sample errs sqrt(2) times as much as it differs from that of two.
    """

    excess: float | None = None  # of one sample; None: not known yet
    is_old: bool = False  # it should be measured again
    first: tuple[np.ndarray, np.ndarray] | None = None  # rest and whole picture of one sample

    def lacks(self, samples: float) -> bool:
        """True if pictures of so many samples are needed, see `add`."""
        return (self.excess is None or self.is_old) and samples in (1.0, 2.0)

    def add(self, samples: float, rest: np.ndarray, whole: np.ndarray, exposure: float) -> None:
        """Take denoised pictures (H, W, 3) of one sample, then of these and another one."""
        if samples == 1.0:
            self.first = rest, whole
        elif self.first is not None:
            plain = srgb_encode(exposure * whole)
            changed = [whole + first - second for first, second in zip(self.first, (rest, whole), strict=True)]
            of_rest, of_whole = (2.0 * float(np.mean((srgb_encode(exposure * one) - plain) ** 2)) for one in changed)
            self.excess, self.is_old, self.first = of_whole - of_rest, False, None

    def is_small(self, samples: float) -> bool:
        """True if the whole picture of so many samples is known to err less than the view's own."""
        return self.excess is not None and self.excess < samples**FALL * OWN_ERROR**2


def render_rest(job: RestJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Write what Cycles adds to the view of `job` as REST_PICTURE into `folder`: the denoised mean (H, W, 4), row 0 on
    top, whose alpha is `marked_depth`. Returns its manifest: "is_everything", "problem" and "ambient" as of `RestSum`.
    Raises as `pixels.extract_pixels` does."""
    return run_scene_job(job, folder, progress)
