"""Lines, boxes and text over an image, in pixels of the region, at the interface's scale."""

from __future__ import annotations

import blf
import gpu
from gpu_extras.batch import batch_for_shader

FONT = 0
TEXT_SIZE = 11.0
# Readable on any picture and in any theme. Blender blends linear colors: a thinner plate is pale on a white picture.
INK, PLATE = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.97)
PAPER, LINE = (0.0, 0.0, 0.0, 0.6), (1.0, 1.0, 1.0, 0.9)


def draw_rectangle(left: float, bottom: float, right: float, top: float, color) -> None:
    """A filled rectangle."""
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "TRIS", {"pos": corners}, indices=[(0, 1, 2), (0, 2, 3)])
    gpu.state.blend_set("ALPHA")
    shader.uniform_float("color", color)
    batch.draw(shader)
    gpu.state.blend_set("NONE")


def draw_gradient(left: float, bottom: float, right: float, top: float, colors) -> None:
    """Colors (N, 3) in display values from left to right."""
    count = len(colors)
    steps = [left + (right - left) * index / (count - 1) for index in range(count)]
    positions = [(x, y) for x in steps for y in (bottom, top)]
    values = [(*map(float, color), 1.0) for color in colors for _ in range(2)]
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    batch_for_shader(shader, "TRI_STRIP", {"pos": positions, "color": values}).draw(shader)


def text_width(text: str, scale: float) -> float:
    """Pixels that `text` takes."""
    blf.size(FONT, TEXT_SIZE * scale)
    return blf.dimensions(FONT, text)[0]


def draw_text(x: float, y: float, text: str, scale: float, color=INK) -> None:
    """`text` from the left end of its base line."""
    blf.size(FONT, TEXT_SIZE * scale)
    blf.color(FONT, *color)
    blf.position(FONT, x, y, 0.0)
    blf.draw(FONT, text)


def draw_label(x: float, y: float, text: str, scale: float, align: float = 0.0) -> None:
    """`text` on a dark plate whose left (`align` 0) or right (1) lower corner is at (x, y)."""
    pad, height = 6.0 * scale, 20.0 * scale
    width = text_width(text, scale) + 2.0 * pad
    left = x - align * width
    draw_rectangle(left, y, left + width, y + height, PLATE)
    draw_text(left + pad, y + 6.0 * scale, text, scale)
