"""The render engine LTSH: Rendered shading in the viewport, F12, animations."""

from __future__ import annotations

import logging
import time

import bpy

from ...scene import Cancelled
from ...shading import TableError
from ..materials.world_look import world_radiance
from ..processes.child import SceneError
from ..viewport import view_text
from . import engine_snapshot
from .engine_final import FinalJob, blender_pixels, final_picture, pass_names
from .engine_snapshot import saved_copy
from .engine_view import EngineView
from .stoppable import stoppable
from .view_properties import ENGINE, TECHNIQUE_LABELS

# Blender redraws its status bar as often as it is told something.
REPORT_SECONDS = 0.1
_logger = logging.getLogger(__name__)


class LTSH_RenderEngine(bpy.types.RenderEngine):
    """Area lights with linearly transformed spherical harmonics."""

    bl_idname = ENGINE
    bl_label = "LTSH"
    bl_use_preview = False
    bl_use_shading_nodes_custom = False
    bl_use_spherical_stereo = False
    # With the GPU's context Blender's window would stand still during a final render.
    bl_use_gpu_context = False

    # -- viewport -----------------------------------------------------------------------------------------------------

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

    # -- final render -------------------------------------------------------------------------------------------------

    def __init__(self, *arguments, **keywords):
        super().__init__(*arguments, **keywords)
        self._view = None

    def update_render_passes(self, scene=None, renderlayer=None):
        """Tell Blender the passes, which the compositor then has as sockets."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        for name in pass_names(_prefixes(scene.ltsh_view)):
            self.register_pass(scene, renderlayer, name, 3, "RGB", "COLOR")

    def render(self, depsgraph):
        """Render one view layer of one frame."""
        # What is raised here would be printed and the picture saved as if all were well.
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
        message = f"LTSH: {' '.join(str(error).split()) or type(error).__name__}"
        self.error_set(message)
        # Only a reported error makes bpy.ops.render.render fail.
        self.report({"ERROR"}, message)

    def _render(self, depsgraph) -> None:
        job = _job_of(self, depsgraph)
        scene_file = saved_copy()
        picture = stoppable(lambda report: final_picture(job, scene_file, report), self._progress())
        for warning in picture.warnings:
            self.report({"WARNING"}, warning)
        for name in picture.passes:
            self.add_pass(name, 3, "RGB", layer=job.view_layer)
        height, width = picture.combined.shape[:2]
        result = self.begin_result(0, 0, width, height, layer=job.view_layer)
        passes = result.layers[0].passes
        passes["Combined"].rect.foreach_set(blender_pixels(picture.combined))
        for name, image in picture.passes.items():
            passes[name].rect.foreach_set(blender_pixels(image))
        self.end_result(result)

    def _progress(self):
        """A progress callback that shows where the render stands, and stops it when the user does."""
        last = [0.0]

        def progress(stage: str, fraction: float) -> bool:
            now = time.monotonic()
            if now - last[0] >= REPORT_SECONDS:
                last[0] = now
                self.update_progress(min(max(fraction, 0.0), 1.0))
                self.update_stats("", f"LTSH: {stage}")
            return not self.test_break()

        return progress


def _prefixes(settings) -> list[str]:
    others = TECHNIQUE_LABELS.values() if settings.technique_passes else ()
    return ["LTSH", *others]


def _job_of(engine, depsgraph) -> FinalJob:
    scene = depsgraph.scene
    settings = scene.ltsh_view
    return FinalJob(
        scene=scene.name,
        view_layer=depsgraph.view_layer.name,
        frame=scene.frame_current if engine.is_animation else None,
        sub_samples=settings.render_samples,
        technique=settings.technique,
        shown=settings.shown,
        other_techniques=tuple(TECHNIQUE_LABELS) if settings.technique_passes else (),
        background=None if scene.render.film_transparent else world_radiance(scene.world)[0],
    )


def register() -> None:
    """Add the engine and what its final renders need."""
    bpy.utils.register_class(LTSH_RenderEngine)
    engine_snapshot.register()
    view_text.register()


def unregister() -> None:
    """Remove what `register` added."""
    view_text.unregister()
    engine_snapshot.unregister()
    bpy.utils.unregister_class(LTSH_RenderEngine)
