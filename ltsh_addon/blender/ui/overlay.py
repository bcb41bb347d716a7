"""Text and shapes drawn over an image or a view."""

import blf
import gpu
from gpu_extras.batch import batch_for_shader

# Sizes in pixels of the region at the interface's scale.
FONT = 0
TEXT_SIZE, ROW = 11.0, 26.0  # ROW: from label to label
# Colors that are readable on any picture in any theme. The plate is nearly opaque: Blender blends linear colors, so a
# more transparent one would be pale on a white picture.
INK, PLATE = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.97)
PAPER, LINE = (0.0, 0.0, 0.0, 0.6), (1.0, 1.0, 1.0, 0.9)


def draw_rectangle(left: float, bottom: float, right: float, top: float, color) -> None:
    """Draw a filled rectangle."""
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "TRIS", {"pos": corners}, indices=[(0, 1, 2), (0, 2, 3)])
    gpu.state.blend_set("ALPHA")
    shader.uniform_float("color", color)
    batch.draw(shader)
    gpu.state.blend_set("NONE")


def covered(area, region) -> dict[str, int]:
    """Pixels of `region` that other regions of its area lie over, by their side; FLOAT: at the left, too."""
    sides = {"LEFT": 0, "RIGHT": 0, "BOTTOM": 0, "TOP": 0, "FLOAT": 0}
    x, y, width, height = region.x, region.y, region.width, region.height
    for other in area.regions:
        is_over = (
            other.x < x + width and x < other.x + other.width and other.y < y + height and y < other.y + other.height
        )
        if other.type == "WINDOW" or not is_over or min(other.width, other.height) <= 1:
            continue
        reach = {"LEFT": other.x + other.width - x, "RIGHT": x + width - other.x, "BOTTOM": other.y + other.height - y,
                 "TOP": y + height - other.y, "FLOAT": other.x + other.width - x}  # fmt: skip
        if other.alignment in sides:
            sides[other.alignment] = max(sides[other.alignment], reach[other.alignment])
    return sides


def draw_gradient(left: float, bottom: float, right: float, top: float, colors) -> None:
    """Draw colors (N, 3), display values, from left to right."""
    count = len(colors)
    steps = [left + (right - left) * index / (count - 1) for index in range(count)]
    positions = [(x, y) for x in steps for y in (bottom, top)]
    values = [(*map(float, color), 1.0) for color in colors for _ in range(2)]
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    batch_for_shader(shader, "TRI_STRIP", {"pos": positions, "color": values}).draw(shader)


def draw_handle(x: float, y: float, scale: float) -> None:
    """Draw the handle of a vertical line that can be dragged sideways, with its middle at (x, y)."""
    half, handle = 0.75 * scale, 9.0 * scale
    draw_rectangle(x - handle, y - handle, x + handle, y + handle, PAPER)
    for offset in (-3.0 * scale, 3.0 * scale):
        draw_rectangle(x + offset - half, y - 0.6 * handle, x + offset + half, y + 0.6 * handle, LINE)


def text_width(text: str, scale: float) -> float:
    """Width of `text` in pixels."""
    blf.size(FONT, TEXT_SIZE * scale)
    return blf.dimensions(FONT, text)[0]


def draw_text(x: float, y: float, text: str, scale: float, color=INK) -> None:
    """Draw `text`, with the left end of its base line at (x, y)."""
    blf.size(FONT, TEXT_SIZE * scale)
    blf.color(FONT, *color)
    blf.position(FONT, x, y, 0.0)
    blf.draw(FONT, text)


def label_places(corners, area, region, scale: float, rows: int) -> tuple[float, float, float, float]:
    """Where labels of a picture begin and end from left to right, and the lower ends of the first of `rows` below it
    and of the one above it: beside what is seen of it, on it where there is no room. `corners` of the picture are left,
    bottom, right and top in pixels of `region`."""
    left, bottom, right, top = corners
    sides, gap = covered(area, region), 6.0 * scale
    start, end = max(left, sides["LEFT"] + gap), min(right, region.width - sides["RIGHT"] - gap)
    below = max(bottom - ROW * scale, sides["BOTTOM"] + gap + (rows - 1) * ROW * scale)
    return start, end, below, min(top + gap, region.height - sides["TOP"] - ROW * scale)


def draw_label(x: float, y: float, text: str, scale: float, align: float = 0.0) -> None:
    """Draw `text` on a dark plate whose lower left (`align` 0) or lower right (1) corner is at (x, y)."""
    pad, height = 6.0 * scale, 20.0 * scale
    width = text_width(text, scale) + 2.0 * pad
    left = x - align * width
    draw_rectangle(left, y, left + width, y + height, PLATE)
    draw_text(left + pad, y + 6.0 * scale, text, scale)
