"""Text in a view: errors, what is not shown as Cycles has it, and which picture is which."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import blf
import bpy

from ..engine.view_properties import ENGINE
from ..interface.drawing import PLATE, draw_rectangle

MOST_NOTES = 4
FEWEST_LETTERS = 20  # no line is broken into shorter ones
TEXT_SIZE = 11.0
CAPTION_SIZE = 13.0
MARGIN = 12.0
ERROR_COLOR = (1.0, 0.35, 0.3, 1.0)
NOTE_COLOR = (0.95, 0.85, 0.45, 0.95)

CAPTION_COLOR = (1.0, 1.0, 1.0, 0.95)
BRIGHTER_COLOR, DARKER_COLOR = (1.0, 0.45, 0.4, 1.0), (0.5, 0.6, 1.0, 1.0)


@dataclass(frozen=True)
class Captions:
    """What stands at the upper end of a view: left and right of the line at `split`, or in the middle."""

    left: str = ""
    right: str = ""
    split: float = 0.5
    middle: str = ""
    scale: float = 0.0  # difference of radiance that has the full color


# Region -> (error, notes, captions).
_texts: dict[int, tuple[str, list[str], Captions]] = {}
_handle = []


def show(region, error: str, notes: list[str], captions: Captions) -> None:
    """What `region` says from now on."""
    _texts[region.as_pointer()] = (error, list(dict.fromkeys(notes)), captions)


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
        letters = max(FEWEST_LETTERS, int(width * len(text) / max(width_of(text), 1.0)))
        broken += [(part, color) for part in textwrap.wrap(text, letters, subsequent_indent="  ")]
    return broken


def _draw() -> None:
    context = bpy.context
    space, region = context.space_data, context.region
    if context.engine != ENGINE or space is None or space.shading.type != "RENDERED":
        return
    error, notes, captions = _texts.get(region.as_pointer(), ("", [], Captions()))
    lines = lines_of(error, notes)
    scale = context.preferences.system.ui_scale
    font, size = 0, TEXT_SIZE * scale
    blf.size(font, size)
    sides = _covered(context)
    free = region.width - sides["TOOLS"] - sides["UI"] - 2.0 * MARGIN * scale
    lines = wrapped(lines, free, lambda text: blf.dimensions(font, text)[0])
    for number, (line, color) in enumerate(reversed(lines)):
        _write(font, line, sides["TOOLS"] + MARGIN * scale, MARGIN * scale + number * 1.4 * size, size, color)
    blf.size(font, CAPTION_SIZE * scale)
    _draw_captions(font, captions, region, sides, scale)


def _covered(context) -> dict[str, int]:
    """Pixels that other regions of the area cover, by their type."""
    covered = {"TOOLS": 0, "UI": 0, "HEADER": 0, "TOOL_HEADER": 0}
    if context.preferences.system.use_region_overlap:
        for part in context.area.regions:
            if part.type in covered and part.width > 1 and part.height > 1:
                covered[part.type] = part.width if part.type in ("TOOLS", "UI") else part.height
    return covered


def _draw_captions(font: int, captions: Captions, region, sides: dict[str, int], scale: float) -> None:
    line = CAPTION_SIZE * scale
    top = region.height - sides["HEADER"] - sides["TOOL_HEADER"] - MARGIN * scale - line
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


def register() -> None:
    """Add the drawing to all 3D views."""
    if not bpy.app.background:
        _handle.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Remove it."""
    while _handle:
        bpy.types.SpaceView3D.draw_handler_remove(_handle.pop(), "WINDOW")
    _texts.clear()
