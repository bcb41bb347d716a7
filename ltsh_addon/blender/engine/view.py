"""A 3D view with the engine: takes over the changes of the scene and draws its picture."""

import logging
import math
import time
from dataclasses import replace

import bpy
import gpu

from ...scene import CYCLES, error_line
from ..evaluated import visibility
from ..render_settings import cycles_setting, sub_pixel_offsets
from ..viewport.drawing import ShadersMissing, ViewCamera, new_shaders_until
from ..viewport.live_cycles import LiveWorld
from ..viewport.mirror import SceneMirror
from ..viewport.pictures import ShownPicture
from ..viewport.renderer import ViewRenderer
from ..viewport.rest import WHOLE_SAMPLES, LiveRest
from ..viewport.shadow_rays import too_many, view_occluders
from ..viewport.shadows import LiveShadows
from . import redraws
from .cycles_picture import ReferenceTexture, content, is_outdated, reference_of
from .overlay import ViewTexts, captions_of, left_out, show

# Width of the line of the split view in pixels of an unscaled interface.
LINE_WIDTH = 2.0
COMPILING = "Compiling shaders"
NO_LIGHTS = "No light and no glowing mesh shines here: add a light"
COMPILE_SECONDS = 0.05  # of a drawing, after which no more shaders are compiled
EMPTY_COLOR = (0.05, 0.05, 0.05, 1.0)
_logger = logging.getLogger(__name__)


class EngineView:
    """One 3D view with the engine."""

    def __init__(self):
        self.region = 0  # the pointer of the one that it was drawn in last
        self._world = LiveWorld()
        self.mirror = self._new_mirror()
        self._renderer: ViewRenderer | None = None
        self._reference = ReferenceTexture()
        self._error = ""
        self._content: tuple[tuple, str] | None = None
        self._shadows = LiveShadows()
        self._pixel_size = redraws.PixelSize()
        self.rest = LiveRest()
        self._occluder_notes: list[str] = []
        self._shown: tuple[ViewCamera, ShownPicture] | None = None  # what was drawn last
        redraws.live_shadows.add(self._shadows)
        redraws.open_views.add(self)

    def __del__(self):
        # Blender lets go of a view that shows something else, or is closed: nothing here may be part of a circle.
        self._shadows.stop()
        self._world.stop()
        self.rest.stop(keeps=True)
        redraws.open_views.discard(self)
        redraws.view_left()
        if not redraws.open_views:
            redraws.node_lights.stop()

    def _new_mirror(self) -> SceneMirror:
        return SceneMirror(self._world.look, redraws.node_lights.pattern)

    def update(self, context, depsgraph) -> None:
        """Take over what has changed in the scene."""
        if any(isinstance(update.id, bpy.types.Image) for update in depsgraph.updates):
            redraws.node_lights.note_images()
        self.rest.note(depsgraph)
        try:
            self.mirror.sync(depsgraph, context.space_data)
            self._error = ""
        except Exception as error:
            self._note(error)
            # What was taken over half is read again as a whole.
            self.mirror = self._new_mirror()
        redraws.watch()

    def take_world(self) -> bool:
        """Show what has been found out about the world; False: there is nothing new."""
        outcome = self._world.step(bpy.context.scene.frame_current)
        if outcome is None:
            return False
        sky, notes = outcome
        self.mirror.take_sky(self.mirror.sky if sky is None else sky, *notes)
        return True

    @property
    def waits_for_world(self) -> bool:
        """Is anything of the world not known yet?"""
        return self._world.is_busy

    def draw(self, context, depsgraph) -> None:
        """Draw into the region of `context`, and ask to be drawn again while the picture can be refined."""
        self._shown = None
        start, target, self.region = time.monotonic(), gpu.state.active_framebuffer_get(), context.region.as_pointer()
        if not _has_drawn[0]:
            _has_drawn[0] = True
            _clear(target)
            show(context.region, ViewTexts(notes=(COMPILING,)))
            redraws.redraw_at(start)
            return
        texts = ViewTexts(self._error)
        try:
            with new_shaders_until(start + COMPILE_SECONDS):
                texts = self._draw_picture(context, depsgraph, target)
        except ShadersMissing:
            # Drawings that compile draw all before that shader again.
            self._pixel_size.begin_small()
            if self._shown is None or not self._renderer.show_whole(*self._shown, target):
                _clear(target)
            show(context.region, ViewTexts(notes=(COMPILING,)))
            redraws.redraw_at(time.monotonic() + redraws.POLL_SECONDS)
            return
        except Exception as error:
            texts = ViewTexts(self._note(error))
            _clear(target)
        has_rest = self._renderer is not None and self._renderer.rest is not None
        of_scene = self.mirror.notes_with_rest(self._renderer.rest.is_everything) if has_rest else self.mirror.notes
        notes = [*texts.notes, *of_scene, *self._shadow_notes(context.region)]
        notes += self.rest.notes
        if not texts.error and not self.mirror.lights and not self.mirror.sky.sides:
            notes.insert(0, NO_LIGHTS)
        rest = self.rest if has_rest or self.rest.is_busy else None
        quiet = left_out(self.mirror, depsgraph.scene, rest, has_rest and self._renderer.shows_whole)
        show(context.region, replace(texts, notes=tuple(dict.fromkeys(notes)), quiet=quiet))
        self._redraw_later(start, bool(texts.error))
        redraws.moments["drawn"] = time.monotonic()
        redraws.watch()

    def _redraw_later(self, start: float, has_failed: bool) -> None:
        """Ask for the next picture after the one that began at `start`. News of shadows and bounces come before."""
        size = self._pixel_size
        moment = self._held_until if size.step == 1 else size.end + self._wait
        if has_failed:
            return
        if size.step > 1 or time.monotonic() < moment:
            redraws.redraw_at(max(moment, time.monotonic() + redraws.POLL_SECONDS))
        elif self._renderer.samples < redraws.REFINEMENTS and not (self._draws_shadows and self._shadows.waits):
            redraws.redraw_later(start, self._renderer.samples)

    def _draw_picture(self, context, depsgraph, target) -> ViewTexts:
        """Draw the picture into the frame buffer `target`; returns what there is to say about it."""
        if self._renderer is None:
            self._renderer = ViewRenderer()
        if self.mirror.has_old_lights:
            self.mirror.read_lights(depsgraph, visibility(depsgraph, context.space_data))
        scene, region, region_data = depsgraph.scene, context.region, context.region_data
        camera = ViewCamera.of(region_data.view_matrix, region_data.window_matrix, not region_data.is_perspective)
        mode, reference, notes = scene.ltsh_view.mode, None, ()
        if mode != "single" and scene.ltsh_view.second_technique == CYCLES:
            mode, reference, notes = self._beside_cycles(context, depsgraph, camera, mode)
        shown, has_news = _shown(scene, mode, reference, context.preferences.system.ui_scale), self.rest.has_news
        self._follow_shadows(depsgraph)
        self._follow_rest(context, depsgraph, shown)
        points = sub_pixel_offsets(scene, redraws.REFINEMENTS)
        if has_news:  # it is shown at once, with the points that there are
            points = points[: max(self._renderer.samples, 1)]
        size, started = (region.width, region.height), time.monotonic()
        wait = math.inf if has_news else self._wait
        self._renderer.step = self._pixel_size.follow(_state_of(self.mirror, camera, size), wait)
        self._shadows.hold(time.monotonic() < self._held_until)
        self._shown = camera, shown
        self._renderer.draw(self.mirror, camera, size, shown, target, points)
        if self._pixel_size.is_new:
            self._renderer.wait()
            self._pixel_size.note(time.monotonic() - started)
        if self._renderer.rest is not None:
            self.rest.keep_light(self._renderer.mean_light)
        return ViewTexts(self._error, tuple(notes), captions_of(scene.ltsh_view, mode))

    def _follow_rest(self, context, depsgraph, shown: ShownPicture) -> None:
        """Let the renderer add what Cycles has rendered, if the scene wants it and the picture takes it."""
        renderer, is_wanted = self._renderer, depsgraph.scene.ltsh_view.bounces and shown.takes_rest
        renderer.has_bounces = is_wanted
        if is_wanted:
            self.rest.follow(context, depsgraph, shown.world, self._draws_shadows and shown.may_be_whole)
        elif depsgraph.scene.ltsh_view.bounces:
            self.rest.pause()
        else:
            self.rest.stop()
        renderer.rest = self.rest.shown() if is_wanted else None

    @property
    def _wait(self) -> float:
        """How many seconds a whole picture waits for the first shadows and bounces, which it would hold up."""
        if self.rest.is_new:
            return redraws.BOUNCES_SECONDS
        if self._has_better_to_come and self._renderer.shows_whole:
            return redraws.HELD_SECONDS
        return redraws.SHADOWS_SECONDS if self._shadows.is_busy else 0.0

    @property
    def _held_until(self) -> float:
        """The moment until which bounces come before further points of pixels and the last shadows. All share the
        processor where pictures take long."""
        is_held = self._pixel_size.is_slow and self._has_better_to_come
        return self._pixel_size.end + redraws.HELD_SECONDS if is_held else 0.0

    @property
    def _has_better_to_come(self) -> bool:
        """True while bounces are to come that improve the picture more than anything else."""
        return self.rest.lacks(WHOLE_SAMPLES if self._renderer.shows_whole else 1)

    @property
    def has_new_shadows(self) -> bool:
        """True if a picture with new shadows is due. Whole ones that take long wait a while for bounces."""
        now, drawn = time.monotonic(), redraws.moments["drawn"]
        waits = self._pixel_size.step == 1 and now < min(self._held_until, drawn + redraws.BOUNCES_SECONDS)
        return self._shadows.has_news and not waits

    @property
    def _draws_shadows(self) -> bool:
        return self._renderer is not None and self._renderer.shadows is not None

    def _follow_shadows(self, depsgraph) -> None:
        """Let the renderer draw shadows, if the scene has them."""
        self._renderer.shadows = self._shadows if depsgraph.scene.ltsh.shadows else None
        notes = self._occluder_notes

        def collect():
            notes.clear()
            return view_occluders(depsgraph, notes.append)

        self._shadows.follow((id(self.mirror), self.mirror.surfaces_version), collect)

    def _shadow_notes(self, region) -> list[str]:
        """What is to be said about shadows."""
        if not self._draws_shadows:
            return []
        problem = too_many(len(self.mirror.lights), (region.width, region.height))
        return [note for note in (problem, self._shadows.problem, *self._occluder_notes) if note]

    def _beside_cycles(self, context, depsgraph, view: ViewCamera, mode: str):
        """The mode that is possible, the texture of the Cycles picture, and what there is to say about it."""
        # What is asked of the original scene may read files and results.
        scene = depsgraph.scene.original
        reference = reference_of(context, scene, depsgraph.scene.ltsh_view.shown, view.projection)
        if isinstance(reference, str):
            return "single", None, [reference]
        region = context.region
        texture = self._reference.of(reference, (region.width, region.height))
        changed = "The scene has changed since the Cycles picture was made: press Compare with Cycles"
        # What Cycles tells about worlds and lights is no change.
        is_known = not (self.waits_for_world or redraws.node_lights.is_busy)
        return mode, texture, [changed] if is_known and is_outdated(reference, self._current_content()) else []

    def _current_content(self) -> str:
        """The `content` of the mirror, taken again when that has changed."""
        mirror = self.mirror
        state = mirror, mirror.surfaces_version, mirror.lights
        if self._content is None or any(new is not old for new, old in zip(state, self._content[0], strict=True)):
            self._content = state, content(mirror)
        return self._content[1]

    def _note(self, error: Exception) -> str:
        """Keep what went wrong for the view; the console gets it once."""
        text = error_line(error)
        if text != self._error:
            _logger.exception("the viewport could not be drawn")
        self._error = text
        return text


def _state_of(mirror: SceneMirror, camera: ViewCamera, size: tuple[int, int]) -> tuple:
    """The state that changes while a view moves, see `same_state`."""
    return (mirror.lights, mirror.sky), (camera.projection.tobytes(), size, mirror.surfaces_version)


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
        world=settings.world,
        line_width=LINE_WIDTH * ui_scale,
        white=2.0**-scene.view_settings.exposure,
    )


# The first view of a session says that shaders are compiled, which holds up the window, before they are.
_has_drawn = [bpy.app.background]


def _clear(target: gpu.types.GPUFrameBuffer) -> None:
    with target.bind():
        target.clear(color=EMPTY_COLOR)
