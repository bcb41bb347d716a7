"""The viewport's side of the render engine: what goes wrong is said in the view."""

from __future__ import annotations

import logging

import gpu

from ..pixels.cycles_settings import cycles_setting
from ..viewport import view_text
from ..viewport.scene_mirror import SceneMirror
from ..viewport.surface_pass import View
from ..viewport.view_renderer import ShownPicture, ViewRenderer
from .cycles_picture import ReferenceTexture, content, is_outdated, reference_of
from .view_properties import CYCLES, SECOND_LABELS, TECHNIQUE_LABELS

_logger = logging.getLogger(__name__)
# Width of the line of the split view in pixels of an unscaled interface.
LINE_WIDTH = 2.0
NO_LIGHTS = "No area light and no glowing mesh shines here: add an area light"


class EngineView:
    """One 3D view with the engine."""

    def __init__(self):
        self.mirror = SceneMirror()
        self._renderer: ViewRenderer | None = None
        self._reference = ReferenceTexture()
        self._error = ""
        self._content: tuple[tuple, str] | None = None

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
        error, notes, captions = self._error, [], view_text.Captions()
        try:
            if self._renderer is None:
                self._renderer = ViewRenderer()
            region_data = context.region_data
            view = View.of(region_data.view_matrix, region_data.window_matrix, not region_data.is_perspective)
            settings, size = depsgraph.scene.ltsh_view, (region.width, region.height)
            mode, reference = settings.mode, None
            if mode != "single" and settings.second_technique == CYCLES:
                mode, reference, notes = self._beside_cycles(context, depsgraph, view, mode)
            shown = _shown(depsgraph.scene, mode, reference, context.preferences.system.ui_scale)
            self._renderer.draw(self.mirror, view, size, shown, frame_buffer)
            captions = _captions(settings, mode)
        except Exception as problem:
            error = self._note(problem)
            with frame_buffer.bind():
                frame_buffer.clear(color=(0.05, 0.05, 0.05, 1.0))
        if not error and not self.mirror.lights:
            notes = [NO_LIGHTS, *notes]
        view_text.show(region, error, [*notes, *self.mirror.notes], captions)

    def _beside_cycles(self, context, depsgraph, view: View, mode: str):
        """The mode that is possible, the texture of the Cycles picture, and what there is to say about it."""
        # What is asked of the original scene may read files and results.
        scene = depsgraph.scene.original
        reference = reference_of(context, scene, depsgraph.scene.ltsh_view.shown, view.projection)
        if isinstance(reference, str):
            return "single", None, [reference]
        region = context.region
        texture = self._reference.of(reference, (region.width, region.height))
        changed = "The scene has changed since the Cycles picture was made: press Compare with Cycles"
        return mode, texture, [changed] if is_outdated(reference, self._current_content()) else []

    def _current_content(self) -> str:
        """The `content` of the mirror, taken again when that has changed."""
        mirror = self.mirror
        state = mirror, mirror.surfaces_version, mirror.lights
        if self._content is None or any(new is not old for new, old in zip(state, self._content[0], strict=True)):
            self._content = state, content(mirror)
        return self._content[1]

    def _note(self, error: Exception) -> str:
        """Keep what went wrong for the view; the console gets it once."""
        text = " ".join(str(error).split()) or type(error).__name__
        if text != self._error:
            _logger.exception("the viewport could not be drawn")
        self._error = text
        return text


def _shown(scene, mode: str, reference, ui_scale: float) -> ShownPicture:
    settings = scene.ltsh_view
    return ShownPicture(
        technique=settings.technique,
        passes=settings.shown,
        mode=mode,
        second_technique=settings.second_technique,
        second_picture=reference,
        split=settings.split_position,
        difference_scale=settings.difference_scale,
        exposure=cycles_setting(scene, "film_exposure"),
        transparent=scene.render.film_transparent,
        line_width=LINE_WIDTH * ui_scale,
        white=2.0**-scene.view_settings.exposure,
    )


def _captions(settings, mode: str) -> view_text.Captions:
    """What stands at the upper end of the view."""
    first, second = TECHNIQUE_LABELS[settings.technique], SECOND_LABELS[settings.second_technique]
    if mode == "split":
        return view_text.Captions(first, second, settings.split_position)
    if mode == "difference":
        return view_text.Captions(middle=f"{first} − {second}", scale=settings.difference_scale)
    return view_text.Captions()
