"""The engine's class, and final renders (F12), which take the same way as the command line."""

from __future__ import annotations

import logging
import math
import queue
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ...pipeline.lighting import shade_lights, trace_shadows
from ...pipeline.mixer import LightPictures, light_pictures
from ...pipeline.options import RenderOptions
from ...pipeline.relight_data import RelightData
from ...pipeline.render import finish
from ...scene import PASSES, SHIPPED_TABLES, TECHNIQUES, Cancelled, Progress, SceneError, error_line
from ...shading import TableError
from ..materials.looks import world_radiance
from ..process import client
from ..render_settings import pass_names as names_in_files
from ..render_settings import picture_size
from ..saving import save_working_copy
from ..ui import comparison
from ..ui.job import (
    START_SECONDS,
    STARTING,
    Plan,
    Step,
    finished_steps,
    progress_text,
    seen,
    shading_steps,
    stage_title,
)
from ..ui.preview import ENGINE
from . import view
from .view import EngineView

PASS_LABELS = {"specular": "Specular", "diffuse": "Diffuse"}
# Passes from the samples themselves, by Blender's names: their channels and type, and their settings of the view layer.
DEPTH, NORMAL, POSITION = "Depth", "Normal", "Position"
DATA_PASSES = {DEPTH: ("Z", "VALUE"), NORMAL: ("XYZ", "VECTOR"), POSITION: ("XYZ", "VECTOR")}
DATA_SETTINGS = {DEPTH: "use_pass_z", NORMAL: "use_pass_normal", POSITION: "use_pass_position"}
# Passes that Cycles writes with the samples, by the keys of `names_in_files`.
INDICES = ("object_index", "material_index")
BEHIND = 1e10  # depth of the background, as in Cycles
EMISSION = "LTSH Emission"
ASK_SECONDS = 0.05  # between two calls of `progress` in `stoppable`
REPORT_SECONDS = 1.0  # between two status texts, each a line in the console
_logger = logging.getLogger(__name__)


class LTSH_RenderEngine(bpy.types.RenderEngine):
    """Area lights with linearly transformed spherical harmonics."""

    bl_idname = ENGINE
    bl_label = "LTSH"
    bl_use_preview = False
    bl_use_shading_nodes_custom = False
    bl_use_spherical_stereo = False
    # Material Preview stays EEVEE's.
    bl_use_eevee_viewport = True
    # With a GPU context Blender's window would freeze during a final render.
    bl_use_gpu_context = False

    # Viewport:

    def view_update(self, context, depsgraph):
        """Take over what has changed in the scene."""
        self._engine_view().update(context, depsgraph)

    def view_draw(self, context, depsgraph):
        """Draw the view."""
        self._engine_view().draw(context, depsgraph)

    def _engine_view(self) -> EngineView:
        if self._view is None:
            self._view = EngineView()
        return self._view

    # Final render:

    def __init__(self, *arguments, **keywords):
        super().__init__(*arguments, **keywords)
        self._view = None

    def update_render_passes(self, scene=None, renderlayer=None):
        """Tell Blender the passes, which the compositor then has as sockets."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        for name, channels, kind in _passes_of(scene, renderlayer):
            self.register_pass(scene, renderlayer, name, len(channels), channels, kind)

    def render(self, depsgraph):
        """Render one view layer of one frame."""
        # Blender only prints exceptions of this method, and saves the picture as if all were well.
        try:
            self._render(depsgraph)
        except Cancelled:
            pass
        except (SceneError, TableError, OSError, ValueError, ImportError, MemoryError) as error:
            self._fail(error)
        except Exception as error:
            _logger.exception("unexpected error in a final render")
            self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, error) -> None:
        message = f"LTSH: {error_line(error)}"
        self.error_set(message)
        # Only a reported error makes bpy.ops.render.render fail.
        self.report({"ERROR"}, message)

    def _render(self, depsgraph) -> None:
        job = _job_of(self, depsgraph)
        scene_file = saved_copy()
        for name, channels, _ in _passes_of(depsgraph.scene, depsgraph.view_layer):
            self.add_pass(name, len(channels), channels, layer=job.view_layer)
        pictures: queue.SimpleQueue = queue.SimpleQueue()

        def show_new() -> None:
            while not pictures.empty():
                self._show(pictures.get(), job.view_layer)

        plan = Plan(job.steps(), seen=seen)
        progress = self._progress(plan, show_new)
        picture = stoppable(lambda report: final_picture(job, scene_file, report, pictures.put), progress)
        plan.end(seen)
        for problem in picture.problems:
            self.report({"ERROR"}, f"LTSH: {problem}")
        for warning in picture.warnings:
            self.report({"WARNING"}, warning)
        self._show(picture, job.view_layer)
        if picture.lights is not None:
            comparison.mix_render(job.scene, picture.lights, picture.relight_data)

    def _show(self, picture: FinalPicture, view_layer: str) -> None:
        """Give Blender the picture; the last one stays."""
        height, width = picture.combined.shape[:2]
        result = self.begin_result(0, 0, width, height, layer=view_layer)
        passes = result.layers[0].passes
        passes["Combined"].rect.foreach_set(blender_pixels(picture.combined))
        for name, image in picture.passes.items():
            if name in passes:
                passes[name].rect.foreach_set(blender_pixels(image))
        self.end_result(result)

    def _progress(self, plan: Plan, show_new: Callable[[], None]):
        """A progress callback that shows the progress of the render, and stops it if the user cancels."""
        began, told, last = time.monotonic(), [float("-inf")], [("", 0.0)]

        def progress(stage: str, fraction: float) -> bool:
            if (stage, fraction) != last[0]:
                last[0] = stage, fraction
                plan.report(stage, fraction)
            show_new()
            self.update_progress(plan.share())
            now = time.monotonic()
            if now - told[0] >= REPORT_SECONDS:
                told[0] = now
                self.update_stats("", f"LTSH: {stage_title(stage)}  {progress_text(plan, now - began)}")
            return not self.test_break()

        return progress


def _passes_of(scene, layer) -> list[tuple[str, str, str]]:
    """Name, channels and type of all passes except Combined."""
    settings = scene.ltsh_view
    if not settings.complete:
        own = [(name, "RGB", "COLOR") for name in pass_names(_prefixes(settings))]
        own += [(name, *kind) for name, kind in DATA_PASSES.items() if getattr(layer, DATA_SETTINGS[name])]
        return own + [(names_in_files()[key], "X", "VALUE") for key in _indices_of(layer)]
    own = [(name, "RGB", "COLOR") for name in pass_names(["LTSH"])[: len(PASSES)]]
    return own + [one for one in _passes_of_cycles(scene, layer) if one[0] != "Combined"]


def _indices_of(layer) -> tuple[str, ...]:
    """The passes of `INDICES` that `layer` has."""
    return tuple(key for key in INDICES if getattr(layer, f"use_pass_{key}"))


def _passes_of_cycles(scene, layer) -> list[tuple[str, str, str]]:
    """The passes that `layer` has with Cycles; none if its add-on is off."""
    if not hasattr(layer, "cycles"):
        return []
    from cycles.engine import list_render_passes

    unwritten = ("Noisy ", "Guiding ", "Render Time")
    return [one for one in list_render_passes(scene, layer) if not one[0].startswith(unwritten)]


def _prefixes(settings) -> list[str]:
    others = SHIPPED_TABLES if settings.technique_passes else ()
    return ["LTSH", *(TECHNIQUES[name].label for name in others)]


def _job_of(engine, depsgraph) -> FinalJob:
    scene = depsgraph.scene
    settings = scene.ltsh_view
    camera = None if scene.camera is None else scene.camera.matrix_world.normalized().inverted()
    return FinalJob(
        scene=scene.name,
        view_layer=depsgraph.view_layer.name,
        frame=scene.frame_current if engine.is_animation else None,
        sub_samples=scene.ltsh.anti_aliasing,
        technique=settings.technique,
        shown=settings.shown,
        other_techniques=SHIPPED_TABLES if settings.technique_passes else (),
        shadows="on" if scene.ltsh.shadows else "off",
        shadow_rays=scene.ltsh.shadow_rays,
        background=None if scene.render.film_transparent else world_radiance(scene.world)[0],
        cycles_samples=scene.ltsh.cycles_samples if settings.complete else 0,
        cycles_passes=tuple(one[:2] for one in _passes_of_cycles(scene, depsgraph.view_layer)),
        keeps_lights=scene.ltsh.keep_lights and not engine.is_animation,
        resolution=picture_size(scene),
        data_passes=any(getattr(depsgraph.view_layer, name) for name in DATA_SETTINGS.values()),
        indices=_indices_of(depsgraph.view_layer),
        to_camera=None if camera is None else np.array(camera),
    )


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
    options = client.ExtractOptions(
        scene=scene_file,
        sub_samples=job.sub_samples,
        frame=job.frame,
        scene_name=job.scene,
        view_layer=job.view_layer,
        rest=True,
        indices=job.indices,
        shadows=job.shadows,
    )
    extraction = client.extract(options, progress=progress)
    emission = extraction.exposure * extraction.emission
    shown = PASSES if job.shown == "combined" else (job.shown,)
    rest = extraction.rest
    if job.shown != "combined":
        rest[..., :3] = extraction.exposure * extraction.background[..., :3]
    passes, warnings = {EMISSION: inside_border(emission, extraction.border)}, extraction.warnings
    if job.data_passes:
        passes |= data_passes(extraction, job.to_camera)
    indices = extraction.indices.items()
    passes |= {name: inside_border(plane[..., None], extraction.border) for name, plane in indices}

    def picture() -> FinalPicture:
        """The picture so far."""
        combined = inside_border(rest, extraction.border).copy()
        for part in shown:
            combined[..., :3] += passes.get(f"LTSH {PASS_LABELS[part]}", 0.0)
        return FinalPicture(combined, dict(passes), warnings, extraction.problems)

    show(picture())
    shadows = None
    if extraction.occluders is not None:
        shadows = trace_shadows(extraction, PASSES, job.shadow_rays, progress)
    for technique in dict.fromkeys(job.shaded_as().values()):
        for number, part in enumerate(PASSES):
            image = _image(extraction, technique, part, shadows, _part(progress, number / len(PASSES), 1 / len(PASSES)))
            prefixes = [prefix for prefix, name in job.shaded_as().items() if name == technique]
            passes.update({f"{prefix} {PASS_LABELS[part]}": image for prefix in prefixes})
            show(picture())
    if not job.keeps_lights:
        return picture()
    relight_data = RelightData(extraction, shadows, _kept_options(job, shown), False, {"": rest})
    return replace(picture(), lights=light_pictures(relight_data, progress), relight_data=relight_data)


def _kept_options(job: FinalJob, passes) -> dict:
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
    found = {NORMAL: normal, POSITION: position.reshape(film.height, film.width, 3)}
    if to_camera is not None:
        depth = np.full(film.width * film.height, BEHIND)
        depth[pixel] = -(samples.position[first] @ to_camera[2, :3] + to_camera[2, 3])
        found[DEPTH] = depth.reshape(film.height, film.width, 1)
    return {name: inside_border(image, extraction.border) for name, image in found.items()}


def _direct_light(job: FinalJob, comparison) -> FinalPicture:
    """The preliminary picture of a complete one before Cycles begins: its direct light."""
    extraction = comparison.extraction
    images = {f"LTSH {PASS_LABELS[part]}": image for (_, part), image in comparison.images.items()}
    coverage = extraction.film.coverage()
    combined = _over_background(
        sum(images.values(), np.zeros((*coverage.shape, 3))), coverage, job.background, extraction.exposure
    )
    passes = {name: inside_border(image, extraction.border) for name, image in images.items()}
    return FinalPicture(inside_border(combined, extraction.border), passes, ())


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
    border = made.comparison.extraction.border
    zero = np.zeros_like(made.combined[..., :3])
    passes = {f"LTSH {label}": made.ours.get(f"{job.technique}.{part}", zero) for part, label in PASS_LABELS.items()}
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
            ours.extraction, ours.shadows, _kept_options(job, PASSES), False, **made.relight_data
        )
        lights = light_pictures(relight_data, progress)
    warnings = tuple(made.report["warnings"])
    return FinalPicture(
        inside_border(made.combined, border), passes, warnings, lights=lights, relight_data=relight_data
    )


def _part(progress: Progress, start: float, share: float) -> Progress:
    """A progress callback for a part of a stage: the `share` of it from `start` on."""
    return lambda stage, fraction: progress(stage, start + share * fraction)


def _image(extraction, technique: str, part: str, shadows, progress: Progress) -> np.ndarray:
    """Radiance (H, W, 3) of a pass times the film's exposure."""
    (lit,) = shade_lights(
        extraction.samples,
        extraction.lights,
        technique,
        (part,),
        (shadows,),
        progress=lambda fraction: progress(TECHNIQUES[technique].title, fraction),
    )
    return inside_border(extraction.film.image(extraction.exposure * lit.combined), extraction.border)


def _over_background(color: np.ndarray, coverage: np.ndarray, background, exposure: float) -> np.ndarray:
    """RGBA (H, W, 4) of `color` over the radiance `background` (3,) behind the surfaces; None: transparent."""
    if background is None:
        return np.concatenate([color, coverage[..., None]], axis=-1)
    seen = background * (1.0 - coverage)[..., None]
    return np.concatenate([color + exposure * seen, np.ones((*coverage.shape, 1))], axis=-1)


def inside_border(image: np.ndarray, border) -> np.ndarray:
    """The part of `image` (H, W, ...) inside the render region, which Blender expects of engines, cropped or not."""
    if border is None or border.cropped:
        return image
    return image[border.top : border.top + border.height, border.left : border.left + border.width]


def blender_pixels(image: np.ndarray) -> np.ndarray:
    """`image` (H, W, C), row 0 on top, as a flat float32 array that starts at the bottom left, for Blender."""
    return np.ascontiguousarray(image[::-1], dtype=np.float32).ravel()


def stoppable(work: Callable[[Progress], object], progress: Progress):
    """Run `work(report)` in a thread of its own, and return its result. The work must not use bpy.

    `progress(stage, fraction)` is called regularly in the caller's thread with the last report of the work. When it
    returns False, Cancelled is raised at once, and the work ends at its next report. Exceptions of the work are raised
    here.
    """
    state: dict = {"last": ("", 0.0)}
    stop = threading.Event()

    def report(stage: str, fraction: float) -> bool:
        state["last"] = stage, fraction
        return not stop.is_set()

    def run() -> None:
        try:
            state["result"] = work(report)
        except BaseException as error:
            state["error"] = error

    thread = threading.Thread(target=run, name="LTSH work", daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            if progress(*state["last"]) is False:
                raise Cancelled(f"cancelled at {state['last'][0] or 'the start'}")
            thread.join(ASK_SECONDS)
    finally:
        stop.set()
    if "error" in state:
        raise state["error"]
    return state["result"]


_copy: dict = {}


@persistent
def _save_copy(*_) -> None:
    """Save a copy of the file if any of its scenes has our engine."""
    _delete_copy()
    if all(scene.render.engine != ENGINE for scene in bpy.data.scenes):
        return
    folder = tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True)
    _copy["folder"] = folder
    path = Path(folder.name) / "scene.blend"
    try:
        save_working_copy(path, keep_engine=True)
    except RuntimeError as error:
        _copy["error"] = error_line(error).removeprefix("Error: ")


@persistent
def _delete_copy(*_) -> None:
    """Delete the copy."""
    folder = _copy.pop("folder", None)
    _copy.clear()
    if folder is not None:
        folder.cleanup()


def saved_copy() -> Path:
    """The copy of the file that was saved when the render started. Raises SceneError."""
    if "error" in _copy:
        raise SceneError(f"a copy of the open file could not be saved for the render: {_copy['error']}")
    if "folder" not in _copy:
        raise SceneError("no copy of the open file was saved for the render; start the render again")
    return Path(_copy["folder"].name) / "scene.blend"


HANDLERS = (("render_init", _save_copy), ("render_complete", _delete_copy), ("render_cancel", _delete_copy))


def register() -> None:
    """Add the engine and the handlers of its renders and views."""
    bpy.utils.register_class(LTSH_RenderEngine)
    for name, function in HANDLERS:
        getattr(bpy.app.handlers, name).append(function)
    view.register()


def unregister() -> None:
    """Remove what `register` added."""
    view.unregister()
    for name, function in HANDLERS:
        functions = getattr(bpy.app.handlers, name)
        if function in functions:
            functions.remove(function)
    _delete_copy()
    bpy.utils.unregister_class(LTSH_RenderEngine)
