"""The finished picture of one view layer and its passes, made as the command line makes it. Uses no bpy."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ...pipeline.lighting import SHARES_DONE, shade_lights, tell_expected, trace_shadows
from ...pipeline.mixer import LightPictures, light_pictures
from ...pipeline.options import RenderOptions
from ...pipeline.relight import RelightData
from ...pipeline.render import finish
from ...scene import PASSES, TECHNIQUES, Progress
from ..process.pixels import PixelJob, extract_pixels
from ..ui.job import START_SECONDS, STARTING, Step, finished_steps, shading_steps

PASS_LABELS = {"specular": "Specular", "diffuse": "Diffuse"}
# Passes from the samples themselves, by Blender's names: their channels and type, and their settings of the view layer.
DEPTH, NORMAL, POSITION = "Depth", "Normal", "Position"
BEHIND = 1e10  # depth of the background, as in Cycles
EMISSION = "LTSH Emission"


@dataclass(frozen=True)
class FinalJob:
    """The facts of the scene that the render of one view layer needs."""

    scene: str
    view_layer: str
    frame: int | None  # None: as in the copy of the file
    sub_samples: int
    technique: str
    shown: str  # combined, specular or diffuse
    other_techniques: tuple[str, ...] = ()  # with passes of their own
    shadows: str = "off"
    shadow_rays: int = 256  # see `PictureOptions`
    # (3,) radiance behind the surfaces until Cycles has rendered it; None: transparent
    background: np.ndarray | None = None
    cycles_samples: int = 0  # of Cycles' part, which is not direct light; 0: only direct light
    cycles_passes: tuple[tuple[str, str], ...] = ()  # name and channels of the view layer's passes of Cycles
    keeps_lights: bool = False  # for the light mixer
    resolution: tuple[int, int] = (1920, 1080)  # approximate, to estimate the time
    data_passes: bool = False  # make the passes of `DATA_PASSES`
    indices: tuple[str, ...] = ()  # passes of `INDICES` to make
    to_camera: np.ndarray | None = None  # (4, 4) from the world; None: no depth

    def steps(self) -> list[Step]:
        """The stages of the render."""
        pixels, techniques = 1e-6 * math.prod(self.resolution), dict.fromkeys(self.shaded_as().values())
        # Pictures with Cycles' part always have shadows.
        rays = self.shadow_rays if self.shadows == "on" or self.cycles_samples else 0
        sampling, shading = shading_steps(pixels * self.sub_samples, self.sub_samples, rays, techniques)
        rest = finished_steps(pixels, self.cycles_samples) if self.cycles_samples else []
        rest += [Step("lights", shading[-1].cost)] if self.keeps_lights else []
        return [Step(STARTING, START_SECONDS), *sampling, *shading, *rest]

    def shaded_as(self) -> dict[str, str]:
        """The techniques by the prefix of their passes' names."""
        return {"LTSH": self.technique, **{TECHNIQUES[name].label: name for name in self.other_techniques}}


def pass_names(prefixes) -> list[str]:
    """Names of the render passes beside Combined."""
    return [*(f"{prefix} {label}" for prefix in prefixes for label in PASS_LABELS.values()), EMISSION]


@dataclass(frozen=True)
class FinalPicture:
    """A final picture and its passes, row 0 on top."""

    combined: np.ndarray  # RGBA (H, W, 4)
    passes: dict[str, np.ndarray]  # (H, W, C) by name
    warnings: tuple[str, ...]
    problems: tuple[str, ...] = ()
    lights: LightPictures | None = None  # for the light mixer
    relight_data: RelightData | None = None  # the samples, for lights that move


def final_picture(
    job: FinalJob, scene_file: Path, progress: Progress, show: Callable[[FinalPicture], None] = lambda picture: None
) -> FinalPicture:
    """Extract samples of the .blend `scene_file` and shade them. Uses no bpy.

    `progress(stage, fraction of the stage)` returns False to stop. `show` gets every preliminary picture. Raises
    SceneError, TableError, Cancelled, OSError.
    """
    if job.cycles_samples:
        return _complete_picture(job, scene_file, progress, show)
    options = PixelJob(
        scene=scene_file,
        sub_samples=job.sub_samples,
        frame=job.frame,
        scene_name=job.scene,
        view_layer=job.view_layer,
        rest=True,
        indices=job.indices,
        shadows=job.shadows,
    )
    expected = {"passes": PASSES, "rays": job.shadow_rays, "progress": progress}
    techniques = {name: name for name in job.shaded_as().values()}
    extraction = extract_pixels(options, progress=progress, look=partial(tell_expected, tables=techniques, **expected))
    emission = extraction.picture.exposure * extraction.cycles.emission
    shown = PASSES if job.shown == "combined" else (job.shown,)
    rest = extraction.rest
    if job.shown != "combined":
        rest[..., :3] = extraction.picture.exposure * extraction.cycles.background[..., :3]
    passes, warnings = {EMISSION: inside_border(emission, extraction.picture.border)}, extraction.warnings
    if job.data_passes:
        passes |= data_passes(extraction, job.to_camera)
    indices = extraction.cycles.indices.items()
    passes |= {name: inside_border(plane[..., None], extraction.picture.border) for name, plane in indices}

    def picture() -> FinalPicture:
        """The picture so far."""
        combined = inside_border(rest, extraction.picture.border).copy()
        for lit_pass in shown:
            combined[..., :3] += passes.get(f"LTSH {PASS_LABELS[lit_pass]}", 0.0)
        return FinalPicture(combined, dict(passes), warnings, extraction.problems)

    show(picture())
    shadows = trace_shadows(extraction, PASSES, job.shadow_rays, progress)
    for technique in dict.fromkeys(job.shaded_as().values()):
        for number, lit_pass in enumerate(PASSES):
            lit = shade_lights(
                extraction.samples,
                extraction.lights,
                technique,
                (lit_pass,),
                (shadows,),
                progress=lambda fraction, first=number, title=TECHNIQUES[technique].title: progress(
                    title, float(np.interp(first + fraction, *SHARES_DONE[2]))
                ),
            )[0].combined
            image = inside_border(extraction.film.image(extraction.picture.exposure * lit), extraction.picture.border)
            prefixes = [prefix for prefix, name in job.shaded_as().items() if name == technique]
            passes.update({f"{prefix} {PASS_LABELS[lit_pass]}": image for prefix in prefixes})
            show(picture())
    if extraction.behind is not None and job.shown == "combined":
        rest[..., :3] += _behind_glass(job, extraction.behind, progress)
        show(picture())
    if not job.keeps_lights:
        return picture()
    relight_data = RelightData(extraction, shadows, _relight_options(job, shown), False, {"": rest})
    return replace(picture(), lights=light_pictures(relight_data, progress), relight_data=relight_data)


def _behind_glass(job: FinalJob, behind, progress: Progress) -> np.ndarray:
    """The light (H, W, 3) of what is seen through glass, with the exposure."""
    shadows = trace_shadows(behind, PASSES, job.shadow_rays, progress)
    lit = shade_lights(behind.samples, behind.lights, job.technique, PASSES, (shadows,))[0].combined
    return behind.film.image(behind.picture.exposure * lit) + behind.rest[..., :3]


def _relight_options(job: FinalJob, passes) -> dict:
    return {"techniques": (job.technique,), "passes": passes, "shadow_rays": job.shadow_rays}


def data_passes(extraction, to_camera: np.ndarray | None) -> dict[str, np.ndarray]:
    """Depth (H, W, 1), normal and position (H, W, 3) of the samples, as in Cycles.

    Depth and position are those of the first hit of a pixel, the normal is the mean. `to_camera` (4, 4) leads from the
    world to the camera of the depth.
    """
    film, samples = extraction.film, extraction.samples
    weight = np.ones(len(samples)) if film.first is None else film.first.astype(float)
    normal = film.image(samples.normal * weight[:, None])
    pixel, first = np.unique(film.pixel, return_index=True)
    position = np.zeros((film.width * film.height, 3))
    position[pixel] = samples.position[first]
    passes = {NORMAL: normal, POSITION: position.reshape(film.height, film.width, 3)}
    if to_camera is not None:
        depth = np.full(film.width * film.height, BEHIND)
        depth[pixel] = -(samples.position[first] @ to_camera[2, :3] + to_camera[2, 3])
        passes[DEPTH] = depth.reshape(film.height, film.width, 1)
    return {name: inside_border(image, extraction.picture.border) for name, image in passes.items()}


def _direct_light(job: FinalJob, comparison) -> FinalPicture:
    """The preliminary picture of a complete one before Cycles begins: its direct light."""
    extraction = comparison.extraction
    images = {f"LTSH {PASS_LABELS[lit_pass]}": image for (_, lit_pass), image in comparison.images.items()}
    coverage = extraction.film.coverage()
    combined = _over_background(
        sum(images.values(), np.zeros((*coverage.shape, 3))), coverage, job.background, extraction.picture.exposure
    )
    passes = {name: inside_border(image, extraction.picture.border) for name, image in images.items()}
    return FinalPicture(inside_border(combined, extraction.picture.border), passes, ())


def _complete_picture(job: FinalJob, scene_file: Path, progress: Progress, show) -> FinalPicture:
    """The final picture with everything that Cycles renders, and its passes."""
    options = RenderOptions(
        scene_file,
        frame=job.frame,
        output=scene_file.parent,
        techniques=(job.technique,),
        sub_samples=job.sub_samples,
        cycles_samples=job.cycles_samples,
        shadow_rays=job.shadow_rays,
    )
    where = {"scene_name": job.scene, "view_layer": job.view_layer}
    made = finish(options, progress, **where, shaded=lambda comparison: show(_direct_light(job, comparison)))
    border = made.comparison.extraction.picture.border
    zero = np.zeros_like(made.combined[..., :3])
    passes = {
        f"LTSH {label}": made.ours.get(f"{job.technique}.{lit_pass}", zero) for lit_pass, label in PASS_LABELS.items()
    }
    for name, channels in job.cycles_passes:
        planes = {key[-1].upper(): plane for key, plane in made.channels.items() if key.rpartition(".")[0] == name}
        # The letter of a single channel varies.
        letters = channels.upper() if len(channels) > 1 else tuple(planes)
        if planes and set(letters) <= set(planes):
            passes[name] = np.stack([planes[letter] for letter in letters], axis=-1)
    passes = {name: inside_border(image, border) for name, image in passes.items()}
    lights, relight_data, ours = None, None, made.comparison
    if job.keeps_lights:
        relight_data = RelightData(
            ours.extraction, ours.shadows, _relight_options(job, PASSES), False, **made.relight_data
        )
        lights = light_pictures(relight_data, progress)
    warnings = tuple(made.report["warnings"])
    return FinalPicture(
        inside_border(made.combined, border), passes, warnings, lights=lights, relight_data=relight_data
    )


def _over_background(color: np.ndarray, coverage: np.ndarray, background, exposure: float) -> np.ndarray:
    """RGBA (H, W, 4) of `color` over the radiance `background` (3,) behind the surfaces; None: transparent."""
    if background is None:
        return np.concatenate([color, coverage[..., None]], axis=-1)
    visible = background * (1.0 - coverage)[..., None]
    return np.concatenate([color + exposure * visible, np.ones((*coverage.shape, 1))], axis=-1)


def inside_border(image: np.ndarray, border) -> np.ndarray:
    """The part of `image` (H, W, ...) inside the render region, which Blender expects of engines, cropped or not."""
    if border is None or border.cropped:
        return image
    return image[border.top : border.top + border.height, border.left : border.left + border.width]
