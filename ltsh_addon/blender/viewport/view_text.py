"""Text in the corner of a view: errors, and what is not shown as Cycles has it."""

from __future__ import annotations

import blf
import bpy

from ..view_properties import ENGINE

MOST_NOTES = 4
TEXT_SIZE = 11.0
MARGIN = 12.0
ERROR_COLOR = (1.0, 0.35, 0.3, 1.0)
NOTE_COLOR = (0.95, 0.85, 0.45, 0.95)

# Region -> (error, notes, caption).
_texts: dict[int, tuple[str, list[str]]] = {}
_handle = []


def show(region, error: str, notes: list[str]) -> None:
    """What `region` says from now on."""
    _texts[region.as_pointer()] = (error, notes)


def forget(region_pointer: int) -> None:
    """Forget a region that is gone."""
    _texts.pop(region_pointer, None)


def lines_of(error: str, notes: list[str]) -> list[tuple[str, tuple]]:
    """Lines of text and their colors, the top one first."""
    lines = [(f"LTSH: {error}", ERROR_COLOR)] if error else []
    lines += [(note, NOTE_COLOR) for note in notes[:MOST_NOTES]]
    if len(notes) > MOST_NOTES:
        lines.append((f"and {len(notes) - MOST_NOTES} more", NOTE_COLOR))
    return lines


def _draw() -> None:
    context = bpy.context
    space, region = context.space_data, context.region
    if context.engine != ENGINE or space is None or space.shading.type != "RENDERED":
        return
    lines = lines_of(*_texts.get(region.as_pointer(), ("", [])))
    if not lines:
        return
    scale = context.preferences.system.ui_scale
    font, size = 0, TEXT_SIZE * scale
    blf.size(font, size)
    blf.enable(font, blf.SHADOW)
    blf.shadow(font, 3, 0.0, 0.0, 0.0, 0.8)
    left = MARGIN * scale + sum(part.width for part in context.area.regions if part.type == "TOOLS")
    for number, (line, color) in enumerate(reversed(lines)):
        blf.color(font, *color)
        blf.position(font, left, MARGIN * scale + number * 1.4 * size, 0.0)
        blf.draw(font, line)
    blf.disable(font, blf.SHADOW)


def register() -> None:
    """Add the drawing to all 3D views."""
    if not bpy.app.background:
        _handle.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Remove it."""
    while _handle:
        bpy.types.SpaceView3D.draw_handler_remove(_handle.pop(), "WINDOW")
    _texts.clear()
