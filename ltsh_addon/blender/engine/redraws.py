"""When views are drawn again: while they are refined, and when shadows, worlds or lights have new results."""

import contextlib
import ctypes
import math
import sys
import time
import weakref

import bpy

from ..ui.preview import ENGINE
from ..viewport.live_cycles import LiveNodeLights
from ..viewport.pictures import same_state
from ..viewport.second_blender import end_spare, spare

# Points of a pixel of which a view at rest is the mean.
REFINEMENTS = 64
# For so long nothing may change before a view is refined; and drawing that takes longer makes pauses.
REST_SECONDS, LONGEST_REST = 0.25, 1.0
QUICK_SECONDS = 0.03
POLL_SECONDS = 0.05
# After so long without new shadows the processes end that help to trace them.
IDLE_SECONDS = 60.0
# FREEING_SECONDS: after a view is left, until Blender has freed its textures. SPARE_SECONDS: until its second Blender
# ends, if no other view takes it; looked at every LOOK_SECONDS.
FREEING_SECONDS, SPARE_SECONDS, LOOK_SECONDS = 0.3, 60.0, 0.05
# Pictures of a view that changes take about FRAME_SECONDS, with a pixel for each of 1, 2 x 2 or 4 x 4. A view that has
# not changed for MOVING_SECONDS gets all its pixels. Slow ones come SHADOWS_SECONDS or BOUNCES_SECONDS later while they
# would delay the first of these. They come, or are refined, HELD_SECONDS later while that delays all pixels of bounces,
# or a better picture of Cycles that is shown meanwhile.
FRAME_SECONDS, STEPS, MOVING_SECONDS = 0.1, (1, 2, 4), 0.5
SHADOWS_SECONDS, BOUNCES_SECONDS, HELD_SECONDS = 1.5, 4.0, 20.0
# All views, their shadows, and what they know of lights with nodes.
open_views: weakref.WeakSet = weakref.WeakSet()
live_shadows: weakref.WeakSet = weakref.WeakSet()
node_lights = LiveNodeLights()
# Moments as `time.monotonic` has them: the next redraw of views at rest, the end of their last one, and the end of the
# last drawing of any view.
moments = {"next": 0.0, "refined": 0.0, "drawn": 0.0}


class PixelSize:
    """How many pixels in either direction share one of the picture, as by Blender's *Pixel Size*: the more while a view
    changes, the longer its pictures take."""

    # Seconds that a whole picture of the last view took, which a new view takes for its own at first.
    last_seconds = 0.0

    def __init__(self):
        self._state, self._seconds, self._changed = None, PixelSize.last_seconds, -MOVING_SECONDS
        self.step, self.is_new = 1, False  # is_new: its picture is not drawn yet

    def follow(self, state: tuple, wait: float = 0.0) -> int:
        """The `step` of a view whose camera, surfaces and lights have this state, see `same_state`. A whole picture,
        which would hold up others, waits for so many seconds more."""
        before, has_changed, self._state = self.step, not same_state(state, self._state), state
        if has_changed:
            quick = next((one for one in STEPS if self._seconds <= FRAME_SECONDS * one**2), STEPS[-1])
            self.step, self._changed = quick, math.inf  # until it is drawn
        elif time.monotonic() >= self.end + (wait if self.step > 1 else 0.0):
            self.step = 1
        self.is_new |= has_changed or self.step != before
        return self.step

    def note(self, seconds: float) -> None:
        """Take note of how long a new picture took."""
        self._seconds, self.is_new = seconds * self.step**2, False
        PixelSize.last_seconds = self._seconds
        if self._changed == math.inf:
            self._changed = time.monotonic()

    def begin_small(self) -> None:
        """The first picture is not there yet, and should be drawn with few pixels."""
        self._state, self._seconds = None, math.inf

    @property
    def is_slow(self) -> bool:
        """True if a picture with all pixels takes longer than a frame should."""
        return self._seconds > FRAME_SECONDS

    @property
    def end(self) -> float:
        """The moment from which the view is at rest, if it does not change any more."""
        return self._changed + MOVING_SECONDS


def redraw_later(start: float, samples: int) -> None:
    """Let all views be drawn again that can be refined. The drawing began at `start`; where it took long, the window
    answers as long before the next one, and a view must have come to rest first."""
    now = time.monotonic()
    took = now - start
    if samples > 1:
        # What the card did after the call is in the time by which this one came late.
        took = max(took, start - max(moments["next"], moments["refined"]))
        wait = took if took > QUICK_SECONDS else 0.0
    else:
        # The first one of all compiles shaders.
        wait = min(max(REST_SECONDS, 2.0 * took), LONGEST_REST)
    moments["refined"] = now
    redraw_at(now + wait)


def redraw_at(moment: float) -> None:
    """Let all views be drawn again at the `moment`."""
    if moment < moments["next"] and bpy.app.timers.is_registered(redraw):  # it sleeps until a later one
        bpy.app.timers.unregister(redraw)
    moments["next"] = moment
    _start(redraw, max(moment - time.monotonic(), 0.0))


def redraw() -> float | None:
    """The timer of `redraw_at`: the seconds until it must be called again."""
    remaining = moments["next"] - time.monotonic()
    if remaining > 0.0:
        return remaining
    tag_views()
    return None


def watch() -> None:
    """Draw views again when results come in that are on their way now."""
    if any(shadows.is_busy for shadows in live_shadows):
        _start(_watch_shadows, POLL_SECONDS)
    if node_lights.is_busy or any(view.waits_for_world or view.rest.is_busy for view in open_views):
        _start(_watch_cycles, POLL_SECONDS)


def _start(timer, seconds: float) -> None:
    """Call the function `timer` after `seconds`, unless it is going to be called already."""
    if not bpy.app.timers.is_registered(timer):
        bpy.app.timers.register(timer, first_interval=seconds)


def _watch_shadows() -> float | None:
    """Draw the views again for which there are new shadows; look again while any are on their way."""
    if any(view.has_new_shadows for view in open_views):
        # What moves is drawn soon in any case.
        if time.monotonic() - moments["drawn"] < REST_SECONDS:
            return POLL_SECONDS
        tag_views()
        if bpy.app.timers.is_registered(_end_helpers):
            bpy.app.timers.unregister(_end_helpers)
        _start(_end_helpers, IDLE_SECONDS)
        return None
    return POLL_SECONDS if any(shadows.is_busy for shadows in live_shadows) else None


def _end_helpers() -> None:
    """End the processes that help to trace shadows."""
    for shadows in list(live_shadows):
        shadows.rest()


def _watch_cycles() -> float | None:
    """Show worlds and lights in the views when Cycles has rendered them; look again while any is on its way."""
    views = list(open_views)
    news = [view.take_world() for view in views] + [view.rest.step() for view in views]
    if views and node_lights.step(bpy.context.scene.frame_current):
        news.append(True)
        for view in views:
            view.mirror.has_old_lights = True
    if any(news):
        tag_views()
    is_busy = node_lights.is_busy or any(view.waits_for_world or view.rest.is_busy for view in views)
    return POLL_SECONDS if views and is_busy else None


def tag_views() -> None:
    """Let Blender draw all rendered views again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED":
                area.tag_redraw()


def view_left() -> None:
    """Take note that a view is freed: once its textures are too, the system gets their memory back."""
    if sys.platform == "linux":
        _start(_give_back_memory, FREEING_SECONDS)
    if spare and not bpy.app.timers.is_registered(_watch_spare):
        bpy.app.timers.register(_watch_spare, persistent=True)


def _watch_spare() -> float | None:
    """End the second Blenders of views that were left, once no scene has the engine any more, or after a while."""
    is_left = all(scene.render.engine != ENGINE for scene in bpy.data.scenes)
    if is_left or any(time.monotonic() - blender.left > SPARE_SECONDS for blender in spare):
        end_spare()
    return LOOK_SECONDS if spare else None


def _give_back_memory() -> None:
    """Let glibc give back what is free: it keeps megabytes of freed textures and samples, the more with each view."""
    with contextlib.suppress(OSError, AttributeError):  # of other libraries
        ctypes.CDLL(None).malloc_trim(0)


def stop() -> None:
    """End all timers, and all work for views."""
    for timer in (redraw, _watch_shadows, _end_helpers, _watch_cycles, _give_back_memory, _watch_spare):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    for shadows in live_shadows:
        shadows.stop()
    for view in open_views:
        view.rest.stop()
    end_spare()
    node_lights.stop()
