"""The engine's class, and how Blender's final renders (F12) call it."""

import logging
import queue
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ...imaging import MOST_SHOWN, grouped
from ...scene import PASSES, SHIPPED_TABLES, TECHNIQUES, Cancelled, Progress, SceneError, error_line
from ...shading import TableError
from ..materials.preview_material import world_radiance
from ..render_settings import pass_names as names_in_files
from ..render_settings import picture_size
from ..saving import keeps_engine, save_working_copy
from ..ui import comparison
from ..ui.job import Plan, progress_text, session_times, stage_title
from ..ui.preview import ENGINE, is_previewing
from ..viewport.drawing import forget_shaders
from . import redraws
from .final_picture import DEPTH, NORMAL, POSITION, FinalJob, FinalPicture, final_picture, pass_names
from .view import EngineView

DATA_PASSES = {DEPTH: ("Z", "VALUE"), NORMAL: ("XYZ", "VECTOR"), POSITION: ("XYZ", "VECTOR")}
DATA_SETTINGS = {DEPTH: "use_pass_z", NORMAL: "use_pass_normal", POSITION: "use_pass_position"}
# Passes that Cycles writes with the samples, by the keys of `names_in_files`.
INDICES = ("object_index", "material_index")
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
        self._engine_view(context).update(context, depsgraph)

    def view_draw(self, context, depsgraph):
        """Draw the view."""
        self._engine_view(context).draw(context, depsgraph)

    def _engine_view(self, context) -> EngineView:
        if self._view is None:
            self._view = _parked.pop(context.region.as_pointer(), None) or EngineView()
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

        plan = Plan(job.steps(), measured=session_times)
        progress = self._progress(plan, show_new)
        picture = stoppable(lambda report: final_picture(job, scene_file, report, pictures.put), progress)
        plan.end(session_times)
        for problem in picture.problems:
            self.report({"ERROR"}, f"LTSH: {problem}")
        for number, warning in enumerate(grouped(picture.warnings)):
            self.report({"WARNING"} if number < MOST_SHOWN else {"INFO"}, warning)
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

        progress.expect = plan.expect
        return progress


def _passes_of(scene, layer) -> list[tuple[str, str, str]]:
    """Name, channels and type of all passes except Combined."""
    settings = scene.ltsh_view
    if not settings.complete:
        labels = [TECHNIQUES[name].label for name in SHIPPED_TABLES] if settings.technique_passes else []
        passes = [(name, "RGB", "COLOR") for name in pass_names(["LTSH", *labels])]
        passes += [(name, *kind) for name, kind in DATA_PASSES.items() if getattr(layer, DATA_SETTINGS[name])]
        return passes + [(names_in_files()[key], "X", "VALUE") for key in _indices_of(layer)]
    passes = [(name, "RGB", "COLOR") for name in pass_names(["LTSH"])[: len(PASSES)]]
    return passes + [one for one in _passes_of_cycles(scene, layer) if one[0] != "Combined"]


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

    report.expect = getattr(progress, "expect", None)

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


# Views by their regions. Previews are saved with the artist's engine: Blender ends them, and begins them anew after it.
_parked: dict[int, EngineView] = {}
PARKED_SECONDS = 2.0


@persistent
def _park_views(*_) -> None:
    """Let the views of previews outlast the save that begins; then those end that nothing shows any more."""
    if not keeps_engine() and any(map(is_previewing, bpy.data.scenes)):
        _parked.update({view.region: view for view in redraws.open_views})
        bpy.app.timers.register(_parked.clear, first_interval=PARKED_SECONDS)


HANDLERS = (
    ("render_init", _save_copy),
    ("render_complete", _delete_copy),
    ("render_cancel", _delete_copy),
    ("save_pre", _park_views),
)
register = _delete_copy


def unregister() -> None:
    """End what goes on for views and renders."""
    _parked.clear()
    redraws.stop()
    forget_shaders()
    _delete_copy()
