"""The viewport's side of the render engine: what goes wrong is said in the view."""

from __future__ import annotations

import logging

import gpu

from .viewport import view_text
from .viewport.scene_mirror import SceneMirror
from .viewport.surface_pass import View
from .viewport.view_renderer import ShownPicture, ViewRenderer

_logger = logging.getLogger(__name__)
# Width of the line of the split view in pixels of an unscaled interface.
LINE_WIDTH = 2.0


class EngineView:
    """One 3D view with the engine."""

    def __init__(self):
        self.mirror = SceneMirror()
        self._renderer: ViewRenderer | None = None
        self._error = ""

    def update(self, context, depsgraph) -> None:
        """Take over what has changed in the scene."""
        try:
            self.mirror.sync(depsgraph, context.space_data)
            self._error = ""
        except Exception as error:
            self._note(error)
            # What was taken over half is read again as a whole.
            self.mirror = SceneMirror()

    def draw(self, context, depsgraph) -> None:
        """Draw into the region of `context`."""
        frame_buffer = gpu.state.active_framebuffer_get()
        region = context.region
        error = self._error
        try:
            if self._renderer is None:
                self._renderer = ViewRenderer()
            region_data = context.region_data
            view = View.of(region_data.view_matrix, region_data.window_matrix, not region_data.is_perspective)
            shown = _shown(depsgraph.scene, context.preferences.system.ui_scale)
            self._renderer.draw(self.mirror, view, (region.width, region.height), shown, frame_buffer)
        except Exception as problem:
            error = self._note(problem)
            with frame_buffer.bind():
                frame_buffer.clear(color=(0.05, 0.05, 0.05, 1.0))
        view_text.show(region, error, self.mirror.notes)

    def _note(self, error: Exception) -> str:
        """Keep what went wrong for the view; the console gets it once."""
        text = " ".join(str(error).split()) or type(error).__name__
        if text != self._error:
            _logger.exception("the viewport could not be drawn")
        self._error = text
        return text


def _shown(scene, ui_scale: float) -> ShownPicture:
    settings = scene.ltsh_view
    return ShownPicture(
        technique=settings.technique,
        passes=settings.shown,
        mode="single" if settings.mode == "cycles" else settings.mode,
        second_technique=settings.second_technique,
        split=settings.split_position,
        difference_scale=settings.difference_scale,
        exposure=scene.cycles.film_exposure,
        transparent=scene.render.film_transparent,
        line_width=LINE_WIDTH * ui_scale,
    )
