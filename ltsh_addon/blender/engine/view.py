"""The rendered view: the renderer's picture, a Cycles picture beside it, notes and captions."""

from __future__ import annotations

import functools
import hashlib
import logging
import time
import weakref
from dataclasses import dataclass

import blf
import bpy
import gpu
import numpy as np

from ...imaging.exr import read_channels
from ...imaging.report import index_stamp
from ...scene import CYCLES, TECHNIQUES, error_line
from ..evaluated import visibility
from ..extract.occluders import collect_occluders
from ..lights.world import blocks_nothing
from ..render_settings import cycles_setting, sub_pixel_offsets
from ..ui import results
from ..ui.job import output_folder
from ..ui.overlay import PLATE, covered, draw_rectangle
from ..ui.preview import ENGINE
from ..viewport.mirror import LiveLamps, SceneMirror
from ..viewport.renderer import ShownPicture, ViewRenderer
from ..viewport.shadows import LiveShadows, too_many
from ..viewport.sky import LiveWorld
from ..viewport.surfaces import View
from ..viewport.textures import float_texture, look_values

# Points of a pixel of which a view at rest is the mean.
REFINEMENTS = 64
# For so long nothing may change before a view is refined; and drawing that takes longer makes pauses.
REST_SECONDS, LONGEST_REST = 0.25, 1.0
QUICK_SECONDS = 0.03
LOOK_SECONDS = 0.05
# After so long without new shadows the processes end that help to trace them.
IDLE_SECONDS = 60.0
# Width of the line of the split view in pixels of an unscaled interface.
LINE_WIDTH = 2.0
COMPILING = "Compiling shaders"
NO_LIGHTS = "No light and no glowing mesh shines here: add a light"
# Shares by which the shapes of two pictures may differ: sizes are whole pixels.
SAME_SHAPE = 0.01
MOST_NOTES = 4
TEXT_SIZE, LINE = 11.0, 1.4  # and from line to line
SHARES = 1.0, 0.9, 0.8, 0.7, 0.6  # of that size, for views that are narrower than a word
LONG_WORD = 20  # letters; longer ones are rather broken
CAPTION_SIZE = 13.0
MARGIN = 12.0
EMPTY_COLOR = (0.05, 0.05, 0.05, 1.0)
ERROR_COLOR = (1.0, 0.35, 0.3, 1.0)
NOTE_COLOR = (0.95, 0.85, 0.45, 0.95)
QUIET_COLOR, POINTED_COLOR = (0.7, 0.7, 0.7, 0.95), (1.0, 1.0, 1.0, 1.0)
CAPTION_COLOR = (1.0, 1.0, 1.0, 0.95)
BRIGHTER_COLOR, DARKER_COLOR = (1.0, 0.45, 0.4, 1.0), (0.5, 0.6, 1.0, 1.0)
_logger = logging.getLogger(__name__)


class EngineView:
    """One 3D view with the engine."""

    def __init__(self):
        self._world = LiveWorld()
        self.mirror = self._new_mirror()
        self._renderer: ViewRenderer | None = None
        self._reference = ReferenceTexture()
        self._error = ""
        self._content: tuple[tuple, str] | None = None
        self._shadows = LiveShadows()
        self._shadow_notes: list[str] = []
        _at_work.add(self._shadows)
        _views.add(self)

    def __del__(self):
        # Blender lets go of a view that shows something else, or is closed: nothing here may be part of a circle.
        self._shadows.stop()
        self._world.stop()
        _views.discard(self)
        if not _views:
            _lamps.stop()

    def _new_mirror(self) -> SceneMirror:
        return SceneMirror(self._world.look, _lamps.pattern)

    def update(self, context, depsgraph) -> None:
        """Take over what has changed in the scene."""
        if any(isinstance(update.id, bpy.types.Image) for update in depsgraph.updates):
            _lamps.note_images()
        try:
            self.mirror.sync(depsgraph, context.space_data)
            self._error = ""
        except Exception as error:
            self._note(error)
            # What was taken over half is read again as a whole.
            self.mirror = self._new_mirror()
        self._wait_for_cycles()

    def _wait_for_cycles(self) -> None:
        if (self._world.is_busy or _lamps.is_busy) and not bpy.app.timers.is_registered(_look_at_worlds):
            bpy.app.timers.register(_look_at_worlds, first_interval=LOOK_SECONDS)

    def look_at_world(self) -> bool:
        """Show what has been found out about the world; False: there is nothing new."""
        found = self._world.step(bpy.context.scene.frame_current)
        if found is None:
            return False
        sky, notes = found
        self.mirror.take_sky(self.mirror.sky if sky is None else sky, *notes)
        return True

    @property
    def waits_for_world(self) -> bool:
        """Is anything of the world not known yet?"""
        return self._world.is_busy

    def draw(self, context, depsgraph) -> None:
        """Draw into the region of `context`, and ask to be drawn again while the picture can be refined."""
        start = time.monotonic()
        frame_buffer = gpu.state.active_framebuffer_get()
        region = context.region
        if not _has_drawn[0]:
            _has_drawn[0] = True
            with frame_buffer.bind():
                frame_buffer.clear(color=EMPTY_COLOR)
            show(region, "", [COMPILING], Captions(), QuietLine())
            _redraw_at(start)
            return
        error, notes, captions = self._error, [], Captions()
        try:
            if self._renderer is None:
                self._renderer = ViewRenderer()
            if self.mirror.has_old_lights:
                self.mirror.read_lights(depsgraph, visibility(depsgraph, context.space_data))
                self._wait_for_cycles()
            region_data = context.region_data
            view = View.of(region_data.view_matrix, region_data.window_matrix, not region_data.is_perspective)
            settings, size = depsgraph.scene.ltsh_view, (region.width, region.height)
            mode, reference = settings.mode, None
            if mode != "single" and settings.second_technique == CYCLES:
                mode, reference, notes = self._beside_cycles(context, depsgraph, view, mode)
            shown = _shown(depsgraph.scene, mode, reference, context.preferences.system.ui_scale)
            self._follow_shadows(depsgraph)
            points = sub_pixel_offsets(depsgraph.scene, REFINEMENTS)
            self._renderer.draw(self.mirror, view, size, shown, frame_buffer, points)
            captions = _captions(settings, mode)
        except Exception as problem:
            error = self._note(problem)
            with frame_buffer.bind():
                frame_buffer.clear(color=EMPTY_COLOR)
        if not error and not self.mirror.lights and not self.mirror.sky.sides:
            notes = [NO_LIGHTS, *notes]
        lines = [*notes, *self.mirror.notes, *self._notes_of_shadows(size)]
        show(region, error, lines, captions, left_out(self.mirror, depsgraph.scene))
        is_waiting = self._renderer is not None and self._renderer.shadows is not None and self._shadows.waits
        if not error and self._renderer.samples < REFINEMENTS and not is_waiting:
            _redraw_later(start, self._renderer.samples)
        _drawn[0] = time.monotonic()
        if self._shadows.is_busy and not bpy.app.timers.is_registered(_look_for_shadows):
            bpy.app.timers.register(_look_for_shadows, first_interval=LOOK_SECONDS)

    def _follow_shadows(self, depsgraph) -> None:
        """Let the renderer draw shadows, if the scene has them."""
        self._renderer.shadows = self._shadows if depsgraph.scene.ltsh.shadows else None
        notes = self._shadow_notes

        def collect():
            notes.clear()
            override = depsgraph.view_layer_eval.material_override
            return blocks_nothing(collect_occluders(depsgraph, override, notes.append), depsgraph.scene.world)

        self._shadows.follow((id(self.mirror), self.mirror.surfaces_version), collect)

    def _notes_of_shadows(self, size) -> list[str]:
        """What is to be said about shadows."""
        if self._renderer is None or self._renderer.shadows is None:
            return []
        found = [too_many(len(self.mirror.lights), size), self._shadows.problem, *self._shadow_notes]
        return [note for note in found if note]

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
        # What Cycles tells about worlds and lights is no change.
        is_known = not (self.waits_for_world or _lamps.is_busy)
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


def _captions(settings, mode: str) -> Captions:
    """What stands at the upper end of the view."""
    first = TECHNIQUES[settings.technique].label
    second = "Cycles" if settings.second_technique == CYCLES else TECHNIQUES[settings.second_technique].label
    if mode == "split":
        return Captions(first, second, settings.split_position)
    if mode == "difference":
        return Captions(middle=f"{first} − {second}", scale=settings.difference_scale)
    return Captions()


# Panels that say more of what is left out.
MATERIALS, LIGHTS = "LTSH_PT_VIEW3D_materials", "LTSH_PT_VIEW3D_lights"
# The region whose quiet line the mouse points at.
_pointed: dict[str, int | None] = {}
Rectangle = tuple[float, float, float, float]  # left, bottom, right, top in pixels of the region


@dataclass(frozen=True)
class Reference:
    """A Cycles picture: `pixels` (H, W, 3) in W m^-2 sr^-1, row 0 on top, in `frame` of the region."""

    pixels: np.ndarray
    frame: Rectangle
    stamp: tuple  # changes when the picture is made again


def reference_of(context, scene, passes: str, projection: np.ndarray) -> Reference | str:
    """The Cycles picture of what the region of `context` shows, or why there is none."""
    result = _comparison_of(scene)
    if result is None:
        return "There is no Cycles picture of this scene: press Compare with Cycles"
    space, report = context.space_data, result.report
    camera = space.camera if space.use_local_camera else scene.camera
    if camera is None or context.region_data.view_perspective != "CAMERA":
        return "The Cycles picture is the camera's: look through the camera"
    if camera.name != report.get("camera"):
        return f"The Cycles picture is that of camera {report.get('camera')!r}, this is {camera.name!r}"
    if scene.frame_current != report.get("frame"):
        return f"The Cycles picture is that of frame {report.get('frame')}, this is {scene.frame_current}"
    files = result.groups[""]["files"]
    layer = f"{CYCLES}.{passes}"
    if layer not in files:
        return f"The Cycles picture has no {passes} pass: compare with that pass"
    region = context.region
    frame = camera_frame(camera, scene, projection, (region.width, region.height))
    width, height = report["resolution"]
    aspect = width * report["pixel_aspect"] / height
    if report["border"] is not None or abs(aspect * (frame[3] - frame[1]) / (frame[2] - frame[0]) - 1.0) > SAME_SHAPE:
        return "The Cycles picture does not fill the camera's frame: compare again without render region"
    path = result.folder / files[layer]
    pixels = _pixels(path, path.stat().st_mtime_ns, report["exposure"])
    return Reference(pixels, frame, (str(result.folder), *index_stamp(result.folder)))


def _comparison_of(scene) -> results.Result | None:
    """The results with a Cycles picture: those that are shown, or the last ones of the command."""
    last = str(output_folder(scene, "compare") / "images")
    for result in (results.result_of(scene), results.result_in(last)):
        if result is not None and "" in result.groups and CYCLES in result.groups[""]["names"]:
            return result
    return None


@functools.lru_cache(maxsize=1)
def _pixels(path, changed: int, exposure: float) -> np.ndarray:
    """The picture in the file `path`, last `changed` then, without the exposure. Raises OSError, ValueError."""
    channels = read_channels(path)
    return np.stack([channels[letter] for letter in "RGB"], axis=-1) / exposure


def camera_frame(camera, scene, projection: np.ndarray, size: tuple[int, int]) -> Rectangle:
    """Where what `camera` renders is seen in a region of `size` whose `projection` (4, 4) is from the world."""
    corners = [camera.matrix_world @ corner for corner in camera.data.view_frame(scene=scene)]
    clip = np.array([projection @ [*corner, 1.0] for corner in corners])
    x, y = ((0.5 + 0.5 * clip[:, axis] / clip[:, 3]) * size[axis] for axis in (0, 1))
    return x.min(), y.min(), x.max(), y.max()


def averaged(image: np.ndarray, frame: Rectangle, size: tuple[int, int]) -> np.ndarray:
    """`image` (H, W, C), row 0 on top, stretched over `frame`: (height, width, C + 1) of pixels of the size `size`
    (width, height), row 0 at the bottom.

    Each pixel has the mean of `image` over the pixel's area; the last channel is 1 inside the frame and 0 outside.
    """
    left, bottom, right, top = frame
    whole = np.concatenate([image[::-1], np.ones((*image.shape[:2], 1))], axis=-1)
    for axis, (start, end, count) in enumerate(((bottom, top, size[1]), (left, right, size[0]))):
        edges = (np.arange(count + 1) - start) / (end - start) * whole.shape[axis]
        whole = _mean_between(whole, edges, axis)
    # Pixels that the frame cuts would be too dark.
    whole[whole[..., -1] < 1.0 - 1e-6] = 0.0
    whole[..., -1] = np.rint(whole[..., -1])
    return whole


def _mean_between(values: np.ndarray, edges: np.ndarray, axis: int) -> np.ndarray:
    """Means of the steps `values` along `axis` between neighbors of `edges`; outside the values it is zero."""
    values = np.moveaxis(values, axis, 0)
    count = len(values)
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0, dtype=np.float64)])
    inside = np.clip(edges, 0.0, count)
    lower = np.minimum(inside.astype(int), count - 1)
    share = (inside - lower).reshape(-1, *([1] * (values.ndim - 1)))
    at_edges = sums[lower] + share * values[lower]
    width = np.diff(edges).reshape(-1, *([1] * (values.ndim - 1)))
    return np.moveaxis(np.diff(at_edges, axis=0) / width, 0, axis)


class ReferenceTexture:
    """The texture of a reference in one view; made again when view or picture change."""

    def __init__(self):
        self._pixels = self._place = self._texture = None

    def of(self, reference: Reference, size: tuple[int, int]) -> gpu.types.GPUTexture:
        """RGBA of `size` pixels, alpha 0 outside the camera's frame; needs an active GPU context."""
        place = reference.frame, size
        if reference.pixels is not self._pixels or place != self._place:
            self._texture = float_texture(averaged(reference.pixels, *place))
            self._pixels, self._place = reference.pixels, place
        return self._texture


# Stamp of a reference -> content of the scene when it was first shown.
_content: dict[tuple, str] = {}


def content(mirror) -> str:
    """A digest of what the scene mirror `mirror` shows: lights, places, sizes and materials."""
    digest = hashlib.blake2b(digest_size=16)
    for light in mirror.lights:
        digest.update(repr(light.record()).encode())
    for instance in mirror.instances:
        digest.update(np.array(instance.model).tobytes())
        digest.update(repr((instance.mesh.triangles, instance.receiver)).encode())
        digest.update(instance.mesh.middle.tobytes())
        for lobe in (lobe for shown in instance.looks for lobe in shown.look.lobes):
            digest.update(look_values(lobe).tobytes())
    return digest.hexdigest()


def is_outdated(reference: Reference, now: str) -> bool:
    """Is the `content` of the scene `now` another one than when `reference` was first shown?"""
    return _content.setdefault(reference.stamp, now) != now


@dataclass(frozen=True)
class Captions:
    """What stands at the upper end of a view: left and right of the line at `split`, or in the middle."""

    left: str = ""
    right: str = ""
    split: float = 0.5
    middle: str = ""
    scale: float = 0.0  # difference of radiance that has the full color


# When views at rest are drawn again, and when the last of them had been drawn.
_next = {"at": 0.0, "drawn": 0.0}


def _redraw_later(start: float, samples: int) -> None:
    """Let all views be drawn again that can be refined. The drawing began at `start`; where it took long, the window
    answers as long before the next one, and a view must have come to rest first."""
    now = time.monotonic()
    took = now - start
    if samples > 1:
        # What the card did after the call is in the time by which this one came late.
        took = max(took, start - max(_next["at"], _next["drawn"]))
        wait = took if took > QUICK_SECONDS else 0.0
    else:
        # The first one of all compiles shaders.
        wait = min(max(REST_SECONDS, 2.0 * took), LONGEST_REST)
    _next["drawn"] = now
    _redraw_at(now + wait)


def _redraw_at(moment: float) -> None:
    """Let all views be drawn again at the `moment`, as `time.monotonic` has it."""
    _next["at"] = moment
    if not bpy.app.timers.is_registered(_redraw):
        bpy.app.timers.register(_redraw, first_interval=max(moment - time.monotonic(), 0.0))


# The first view of a session says that shaders are compiled, which holds up the window, before they are.
_has_drawn = [bpy.app.background]
# When a view was drawn last, the shadows of all views, the views, and what they know of lights with nodes.
_drawn = [0.0]
_at_work: weakref.WeakSet = weakref.WeakSet()
_views: weakref.WeakSet = weakref.WeakSet()
_lamps = LiveLamps()


def _look_for_shadows() -> float | None:
    """Draw the views again for which there are new shadows; look again while any are on their way."""
    if any(shadows.has_news for shadows in _at_work):
        # What moves is drawn soon in any case.
        if time.monotonic() - _drawn[0] < REST_SECONDS:
            return LOOK_SECONDS
        _tag_views()
        if bpy.app.timers.is_registered(_let_rest):
            bpy.app.timers.unregister(_let_rest)
        bpy.app.timers.register(_let_rest, first_interval=IDLE_SECONDS)
        return None
    return LOOK_SECONDS if any(shadows.is_busy for shadows in _at_work) else None


def _let_rest() -> None:
    """End the processes that help to trace shadows."""
    for shadows in list(_at_work):
        shadows.rest()


def _look_at_worlds() -> float | None:
    """Show worlds and lights in the views when Cycles has looked at them; look again while any is on its way."""
    views = list(_views)
    news = [view.look_at_world() for view in views]
    if views and _lamps.step(bpy.context.scene.frame_current):
        news.append(True)
        for view in views:
            view.mirror.has_old_lights = True
    if any(news):
        _tag_views()
    return LOOK_SECONDS if any(view.waits_for_world for view in views) or (views and _lamps.is_busy) else None


def _redraw() -> float | None:
    left = _next["at"] - time.monotonic()
    if left > 0.0:
        return left
    _tag_views()
    return None


def _tag_views() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED":
                area.tag_redraw()


@dataclass(frozen=True)
class QuietLine:
    """What a view leaves out, and the panel that says more."""

    text: str = ""
    panel: str = MATERIALS


def left_out(mirror, scene) -> QuietLine:
    """What no view of this scene shows, but its Cycles pictures do."""
    parts = ["No bounces"]
    if mirror.has_glass:
        parts.append("glass without refraction")
    if not scene.ltsh.shadows:
        parts.append("no shadows")
    if not scene.ltsh_view.world and mirror.sky.sides:
        parts.append("no light of the world")
    is_about_lights = len(mirror.notes) > len(set(mirror.material_notes)) and not mirror.material_notes
    return QuietLine("; ".join(parts), LIGHTS if is_about_lights else MATERIALS)


# Region -> (error, notes, captions, quiet line), and where the last of these is: left, bottom, right, top.
_texts: dict[int, tuple[str, list[str], Captions, QuietLine]] = {}
_places: dict[int, Rectangle] = {}
_handle = []


def show(region, error: str, notes: list[str], captions: Captions, quiet: QuietLine) -> None:
    """What `region` says from now on."""
    _texts[region.as_pointer()] = (error, list(dict.fromkeys(notes)), captions, quiet)


def lines_of(error: str, notes: list[str]) -> list[tuple[str, tuple]]:
    """Lines of text and their colors, the top one first."""
    lines = [(f"LTSH: {error}", ERROR_COLOR)] if error else []
    lines += [(note, NOTE_COLOR) for note in notes[:MOST_NOTES]]
    if len(notes) > MOST_NOTES:
        lines.append((f"and {len(notes) - MOST_NOTES} more", NOTE_COLOR))
    return lines


def wrapped(lines: list[tuple[str, tuple]], width: float, width_of) -> list[tuple[str, tuple]]:
    """`lines` broken where they are wider than `width` pixels; `width_of(text)` says how wide one is."""
    broken = []
    for text, color in lines:
        line = ""
        for word in text.split():
            longer = f"{line} {word}" if line else word
            if line and width_of(longer) > width:
                broken.append((line, color))
                longer = word
            # A word that is too wide by itself.
            while width_of(longer) > width and len(longer) > 1:
                letters = next((n for n in range(len(longer) - 1, 1, -1) if width_of(longer[:n]) <= width), 1)
                broken.append((longer[:letters], color))
                longer = longer[letters:]
            line = longer
        broken.append((line, color))
    return broken


def share_of_size(lines: list[tuple[str, tuple]], width: float, margin: float, width_of) -> float:
    """The largest of `SHARES` at which all words of `lines` but long ones have room in `width` pixels, with a `margin`
    on both sides that shrinks with them; `width_of(text, share)` says how wide text is. The smallest where none is."""
    words = {word[:LONG_WORD] for text, _ in lines for word in text.split()}
    fitting = (s for s in SHARES if all(width_of(word, s) + 2.0 * s * margin <= width for word in words))
    return next(fitting, SHARES[-1])


def is_drawn(context) -> bool:
    """True in 3D views that show the picture of the engine."""
    space = context.space_data
    is_view = space is not None and space.type == "VIEW_3D"
    return is_view and context.engine == ENGINE and space.shading.type == "RENDERED"


def _draw() -> None:
    context = bpy.context
    region = context.region
    if not is_drawn(context):
        return
    error, notes, captions, quiet = _texts.get(region.as_pointer(), ("", [], Captions(), QuietLine()))
    scale = context.preferences.system.ui_scale
    sides, font = covered(context.area, region), 0
    _draw_lines(font, lines_of(error, notes), quiet.text, region, sides, scale)
    blf.size(font, CAPTION_SIZE * scale)
    _draw_captions(font, captions, region, sides, scale)


def _draw_lines(font: int, notes: list[tuple[str, tuple]], quiet: str, region, sides: dict[str, int], scale: float):
    """The notes and below them the quiet line, at the lower right: Blender's own boxes are at the left and above."""

    def width_of(text: str, share: float = 1.0) -> float:
        blf.size(font, share * size)
        return blf.dimensions(font, text)[0]

    pointer = region.as_pointer()
    last = [(quiet, POINTED_COLOR if _pointed.get("region") == pointer else QUIET_COLOR)] if quiet else []
    size, margin = TEXT_SIZE * scale, MARGIN * scale
    free = region.width - sides["RIGHT"] - max(sides["LEFT"], sides["FLOAT"])
    share = share_of_size([*notes, *last], free, margin, width_of)
    size, margin = share * size, share * margin
    free -= 2.0 * margin
    # Better no quiet line than one of broken words.
    last = wrapped(last, free, width_of) if all(width_of(word) <= free for word in quiet.split()) else []
    right, bottom = region.width - sides["RIGHT"] - margin, sides["BOTTOM"] + margin
    most = int((region.height - sides["TOP"] - bottom) / (LINE * size)) - len(last)
    lines = [*(wrapped(notes, free, width_of)[: max(most, 0)] if free > size else []), *last]
    widths = [width_of(line) for line, _ in lines]
    _places.pop(pointer, None)
    if last:
        left = right - max(widths[-len(last) :]) - 0.5 * size
        top = bottom + (LINE * (len(last) - 1) + 1.05) * size
        _places[pointer] = left, bottom - 0.35 * size, right, top
    for number, ((line, color), width) in enumerate(zip(reversed(lines), reversed(widths), strict=True)):
        _write(font, line, right - width, bottom + number * LINE * size, size, color)


def _draw_captions(font: int, captions: Captions, region, sides: dict[str, int], scale: float) -> None:
    line = CAPTION_SIZE * scale
    top = region.height - sides["TOP"] - MARGIN * scale - line
    place = captions.split * region.width
    width, _ = blf.dimensions(font, captions.left)
    _write(font, captions.left, place - width - MARGIN * scale, top, line, CAPTION_COLOR)
    _write(font, captions.right, place + MARGIN * scale, top, line, CAPTION_COLOR)
    if not captions.middle:
        return
    words = (
        (captions.middle, CAPTION_COLOR),
        (f"red: brighter by {captions.scale:.3g}", BRIGHTER_COLOR),
        (f"blue: darker by {captions.scale:.3g}", DARKER_COLOR),
    )
    gap = 1.5 * line
    place = 0.5 * (region.width - sum(blf.dimensions(font, text)[0] + gap for text, _ in words) + gap)
    for text, color in words:
        _write(font, text, place, top, line, color)
        place += blf.dimensions(font, text)[0] + gap


def _write(font: int, text: str, x: float, y: float, size: float, color) -> None:
    """`text` of `size` pixels on a dark plate, readable on any picture."""
    if not text:
        return
    width = blf.dimensions(font, text)[0]
    draw_rectangle(x - 0.5 * size, y - 0.35 * size, x + width + 0.5 * size, y + 1.05 * size, PLATE)
    blf.color(font, *color)
    blf.position(font, round(x), round(y), 0.0)
    blf.draw(font, text)


class LTSH_GT_left_out(bpy.types.Gizmo):
    """The quiet line as a button."""

    bl_idname = "LTSH_GT_left_out"

    def test_select(self, context, location):
        left, bottom, right, top = _places.get(context.region.as_pointer(), (0.0, 0.0, 0.0, 0.0))
        return 0 if left <= location[0] <= right and bottom <= location[1] <= top else -1

    def draw(self, context):
        """The text is drawn with the notes."""
        _pointed["region"] = context.region.as_pointer() if self.is_highlight else None


class LTSH_GGT_left_out(bpy.types.GizmoGroup):
    """The quiet line in every view that has one; a click shows the panel that says more."""

    bl_idname = "LTSH_GGT_left_out"
    bl_label = "LTSH what is left out"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"PERSISTENT"}

    @classmethod
    def poll(cls, context):
        return is_drawn(context)

    def setup(self, context):
        self.line = self.gizmos.new(LTSH_GT_left_out.bl_idname)

    def draw_prepare(self, context):
        texts = _texts.get(context.region.as_pointer())
        self.line.target_set_operator("wm.call_panel").name = MATERIALS if texts is None else texts[3].panel


CLASSES = (LTSH_GT_left_out, LTSH_GGT_left_out)
_add_classes, _remove_classes = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    """Add the drawing to all 3D views."""
    _add_classes()
    if not bpy.app.background:
        _handle.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Remove it."""
    for timer in (_redraw, _look_for_shadows, _let_rest, _look_at_worlds):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    for shadows in _at_work:
        shadows.stop()
    _lamps.stop()
    while _handle:
        bpy.types.SpaceView3D.draw_handler_remove(_handle.pop(), "WINDOW")
    _remove_classes()
    _texts.clear()
    _places.clear()
