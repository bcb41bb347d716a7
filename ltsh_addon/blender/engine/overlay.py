"""What is drawn over a view: notes, captions, the line about what is left out, and the handle of a split view."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import blf
import bpy

from ...scene import CYCLES, TECHNIQUES
from ..ui.overlay import PLATE, covered, draw_handle, draw_rectangle
from ..ui.preview import ENGINE

MOST_NOTES = 4
TEXT_SIZE, LINE = 11.0, 1.4  # and from line to line
CAPTION_SIZE = 13.0
MARGIN = 12.0
ERROR_COLOR = (1.0, 0.35, 0.3, 1.0)
NOTE_COLOR = (0.95, 0.85, 0.45, 0.95)
QUIET_COLOR, POINTED_COLOR = (0.7, 0.7, 0.7, 0.95), (1.0, 1.0, 1.0, 1.0)
CAPTION_COLOR = (1.0, 1.0, 1.0, 0.95)
BRIGHTER_COLOR, DARKER_COLOR = (1.0, 0.45, 0.4, 1.0), (0.5, 0.6, 1.0, 1.0)


def captions_of(settings, mode: str) -> "Captions":
    """What stands at the upper end of the view."""
    first = TECHNIQUES[settings.technique].label
    second = "Cycles" if settings.second_technique == CYCLES else TECHNIQUES[settings.second_technique].label
    if mode == "split":
        return Captions(first, second, settings.split_position)
    if mode == "difference":
        return Captions(middle=f"{first} − {second}", scale=settings.difference_scale)
    return Captions()


# Panels that say more of what is left out.
MATERIALS_PANEL, LIGHTS_PANEL = "LTSH_PT_VIEW3D_materials", "LTSH_PT_VIEW3D_lights"
# The region whose quiet line the mouse points at.
_pointed: dict[str, int | None] = {}
Rectangle = tuple[float, float, float, float]  # left, bottom, right, top in pixels of the region


@dataclass(frozen=True)
class Captions:
    """What stands at the upper end of a view: left and right of the line at `split`, or in the middle."""

    left: str = ""
    right: str = ""
    split: float = 0.5
    middle: str = ""
    scale: float = 0.0  # difference of radiance that has the full color


@dataclass(frozen=True)
class QuietLine:
    """What a view leaves out, and the panel that says more."""

    text: str = ""
    panel: str = MATERIALS_PANEL


def left_out(mirror, scene, rest=None, shows_whole: bool = False) -> QuietLine:
    """What no view of this scene shows, but its Cycles pictures do; or when the `rest` of a view that has one comes.

    With `shows_whole` the view shows Cycles' picture meanwhile.
    """
    if rest is None:
        parts = ["No bounces", *["glass without refraction"] * mirror.has_glass]
    else:
        coming = "Bounces are coming" if rest.seconds is None else f"Bounces: {max(rest.seconds, 1.0):.0f} s"
        parts = ["Cycles' picture for now"] * shows_whole + [coming] * rest.is_busy
    if not scene.ltsh.shadows:
        parts.append("no shadows")
    if not scene.ltsh_view.world and mirror.sky.sides:
        parts.append("no light of the world")
    is_about_lights = len(mirror.notes) > len(set(mirror.material_notes)) and not mirror.material_notes
    return QuietLine("; ".join(parts), LIGHTS_PANEL if is_about_lights else MATERIALS_PANEL)


@dataclass(frozen=True)
class ViewTexts:
    """All that a view says."""

    error: str = ""
    notes: tuple[str, ...] = ()
    captions: Captions = field(default_factory=Captions)
    quiet: QuietLine = field(default_factory=QuietLine)


# The texts of regions, and where their quiet lines are, by the pointers of regions.
_texts: dict[int, ViewTexts] = {}
_quiet_lines: dict[int, Rectangle] = {}
_draw_handlers = []


def show(region, texts: ViewTexts) -> None:
    """What `region` says from now on."""
    _texts[region.as_pointer()] = texts


def lines_of(error: str, notes: Sequence[str]) -> list[tuple[str, tuple]]:
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
    texts = _texts.get(region.as_pointer(), ViewTexts())
    scale = context.preferences.system.ui_scale
    sides, font = covered(context.area, region), 0
    _draw_lines(font, texts, region, sides, scale)
    blf.size(font, CAPTION_SIZE * scale)
    _draw_captions(font, texts.captions, region, sides, scale)


def _draw_lines(font: int, texts: ViewTexts, region, sides: dict[str, int], scale: float) -> None:
    """The notes and below them the quiet line, at the lower right: Blender's own boxes are at the left and above."""

    def width_of(text: str) -> float:
        return blf.dimensions(font, text)[0]

    pointer, notes, quiet = region.as_pointer(), lines_of(texts.error, texts.notes), texts.quiet.text
    last = [(quiet, POINTED_COLOR if _pointed.get("region") == pointer else QUIET_COLOR)] if quiet else []
    size, margin = TEXT_SIZE * scale, MARGIN * scale
    blf.size(font, size)
    free = region.width - sides["RIGHT"] - max(sides["LEFT"], sides["FLOAT"]) - 2.0 * margin
    # Better no line than one of broken words, but for errors.
    last, notes = (
        [line for line in some if line[1] == ERROR_COLOR or all(width_of(word) <= free for word in line[0].split())]
        for some in (last, notes)
    )
    last = wrapped(last, free, width_of)
    right, bottom = region.width - sides["RIGHT"] - margin, sides["BOTTOM"] + margin
    most = int((region.height - sides["TOP"] - bottom) / (LINE * size)) - len(last)
    lines = [*(wrapped(notes, free, width_of)[: max(most, 0)] if free > size else []), *last]
    widths = [width_of(line) for line, _ in lines]
    _quiet_lines.pop(pointer, None)
    if last:
        x = right - max(widths[-len(last) :]) - 0.5 * size
        top = bottom + (LINE * (len(last) - 1) + 1.05) * size
        _quiet_lines[pointer] = x, bottom - 0.35 * size, right, top
    for number, ((line, color), width) in enumerate(zip(reversed(lines), reversed(widths), strict=True)):
        _write(font, line, right - width, bottom + number * LINE * size, size, color)


def _draw_captions(font: int, captions: Captions, region, sides: dict[str, int], scale: float) -> None:
    line = CAPTION_SIZE * scale
    top = region.height - sides["TOP"] - MARGIN * scale - line
    x = captions.split * region.width
    width, _ = blf.dimensions(font, captions.left)
    _write(font, captions.left, x - width - MARGIN * scale, top, line, CAPTION_COLOR)
    _write(font, captions.right, x + MARGIN * scale, top, line, CAPTION_COLOR)
    if not captions.middle:
        return
    words = (
        (captions.middle, CAPTION_COLOR),
        (f"red: brighter by {captions.scale:.3g}", BRIGHTER_COLOR),
        (f"blue: darker by {captions.scale:.3g}", DARKER_COLOR),
    )
    gap = 1.5 * line
    x = 0.5 * (region.width - sum(blf.dimensions(font, text)[0] + gap for text, _ in words) + gap)
    for text, color in words:
        _write(font, text, x, top, line, color)
        x += blf.dimensions(font, text)[0] + gap


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
        left, bottom, right, top = _quiet_lines.get(context.region.as_pointer(), (0.0, 0.0, 0.0, 0.0))
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
        self.line.target_set_operator("wm.call_panel").name = MATERIALS_PANEL if texts is None else texts.quiet.panel


REACH = 8.0  # pixels of an unscaled interface


class LTSH_GT_split(bpy.types.Gizmo):
    """A vertical line that moves sideways."""

    bl_idname = "LTSH_GT_split"

    def test_select(self, context, location):
        reach = REACH * context.preferences.system.ui_scale
        return 0 if abs(location[0] - context.scene.ltsh_view.split_position * context.region.width) <= reach else -1

    def draw(self, context):
        """Draw the handle; the line is part of the picture."""
        region, scale = context.region, context.preferences.system.ui_scale * (1.25 if self.is_highlight else 1.0)
        draw_handle(context.scene.ltsh_view.split_position * region.width, 0.5 * region.height, scale)

    def invoke(self, context, event):
        self.start = context.scene.ltsh_view.split_position
        return {"RUNNING_MODAL"}

    def modal(self, context, event, tweak):
        width = max(context.region.width, 1)
        context.scene.ltsh_view.split_position = min(max(event.mouse_region_x / width, 0.0), 1.0)
        return {"RUNNING_MODAL"}

    def exit(self, context, cancel):
        if cancel:
            context.scene.ltsh_view.split_position = self.start


class LTSH_GGT_split(bpy.types.GizmoGroup):
    """The line in every 3D view that is split."""

    bl_idname = "LTSH_GGT_split"
    bl_label = "LTSH split view"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context):
        return is_drawn(context) and context.scene.ltsh_view.mode == "split"

    def setup(self, context):
        self.line = self.gizmos.new(LTSH_GT_split.bl_idname)
        self.line.use_draw_modal = True


def register() -> None:
    """Add the drawing to all 3D views."""
    if not bpy.app.background:
        _draw_handlers.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Remove it."""
    while _draw_handlers:
        bpy.types.SpaceView3D.draw_handler_remove(_draw_handlers.pop(), "WINDOW")
    _texts.clear()
    _quiet_lines.clear()
