"""Anti-aliased text of any size from the strokes of `glyphs`, drawn into 8-bit images."""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache

import numpy as np

from . import glyphs

_UNITS_PER_EM = 20.0
_STROKE_WIDTH = {False: 1.45, True: 2.35}  # units; regular, bold
_BEARING = 1.35  # units of air on each side of a glyph, from the stroke's edge
_CURVE_STEPS = 8
_SQUARENESS = 0.60  # 0.5523 would be a true ellipse


def text_size(text: str, size: float = 14.0, *, bold: bool = False) -> tuple[int, int]:
    """Width and height in pixels of the box that `draw_text` fills; `size` is the em in pixels, capitals are 0.7 em."""
    ascent, descent = _extent(size, bold)
    return sum(_glyph(character, size, bold)[1] for character in _drawable(text)), ascent + descent


def draw_text(
    image: np.ndarray, x: int, y: int, text: str, color=(0, 0, 0), size: float = 14.0, *, bold: bool = False
) -> int:
    """Draw one line of `text` into `image` (H, W, 3) uint8 and return the x where it ends.

    (x, y) is the top left corner of the box of `text_size`; whatever falls outside of the image is cut off. Accents
    are dropped, characters without a glyph become a crossed box.
    """
    for character in _drawable(text):
        coverage, advance = _glyph(character, size, bold)
        _blend(image, int(x), int(y), coverage, color)
        x += advance
    return int(x)


def shorten(text: str, width: int, size: float = 14.0, *, bold: bool = False) -> str:
    """`text`, or as much of it as fits into `width` pixels followed by an ellipsis."""
    if text_size(text, size, bold=bold)[0] <= width:
        return text
    while text and text_size(text + "\u2026", size, bold=bold)[0] > width:
        text = text[:-1].rstrip()
    return text + "\u2026"


def wrap(text: str, width: int, size: float = 14.0) -> list[str]:
    """`text` broken between words into lines that fit into `width` pixels; a longer single word is shortened."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_size(f"{lines[-1]} {word}", size)[0] <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return [shorten(line, width, size) for line in lines]


def _drawable(text: str) -> str:
    characters = []
    for character in str(text):
        if character not in glyphs.STROKES:
            base = "".join(part for part in unicodedata.normalize("NFKD", character) if not unicodedata.combining(part))
            character = base if len(base) == 1 else character
        characters.append(" " if character.isspace() else character)
    return "".join(characters)


def _extent(size: float, bold: bool) -> tuple[int, int]:
    """Pixels above and below the baseline that hold all ink, anti-aliasing included."""
    unit = size / _UNITS_PER_EM
    margin = _STROKE_WIDTH[bold] * unit / 2.0 + 1.0  # rounding to the pixel grid moves a stroke by half a pixel
    return int(np.ceil(glyphs.ASCENT * unit + margin)), int(np.ceil(glyphs.DESCENT * unit + margin))


@lru_cache(maxsize=2048)
def _glyph(character: str, size: float, bold: bool) -> tuple[np.ndarray, int]:
    """Coverage (H, A) in [0, 1] and the advance A in pixels."""
    unit = size / _UNITS_PER_EM
    stroke_width = _STROKE_WIDTH[bold] * unit
    ascent, descent = _extent(size, bold)
    if character == " ":
        advance = max(1, round((glyphs.SPACE_WIDTH + 2.0 * _BEARING) * unit))
        return np.zeros((ascent + descent, advance)), advance
    segments, horizontal, vertical = _segments(glyphs.STROKES.get(character, glyphs.REPLACEMENT))
    digit = character.isdigit() and character.isascii()
    low, high = (0.0, glyphs.DIGIT_WIDTH) if digit else (segments[..., 0].min(), segments[..., 0].max())
    bearing = _BEARING * unit + stroke_width / 2.0
    advance = int(np.ceil((high - low) * unit + 2.0 * bearing))
    segments = segments * unit
    x_keys = np.unique(np.array([low, high, *vertical])) * unit
    y_keys = np.unique(np.array([-glyphs.DESCENT, 0.0, glyphs.X_HEIGHT, glyphs.CAP_HEIGHT, *horizontal])) * unit
    slack = (advance - (high - low) * unit) / 2.0 - low * unit  # the glyph stands in the middle of its advance
    x = _fitted(segments[..., 0], x_keys, slack, stroke_width)
    y = ascent - _fitted(segments[..., 1], y_keys, 0.0, stroke_width)
    return _coverage(np.stack([x, y], axis=-1), (ascent + descent, advance), stroke_width), advance


def _fitted(values: np.ndarray, keys: np.ndarray, offset: float, stroke_width: float) -> np.ndarray:
    """`values` + `offset`, bent so that strokes centered at `keys` fill whole pixels instead of straddling them."""
    center = 0.5 if round(stroke_width) % 2 else 0.0
    snapped = np.floor(keys + offset - center + 0.5) + center
    inside = np.interp(values, keys, snapped)
    return inside + np.minimum(values - keys[0], 0.0) + np.maximum(values - keys[-1], 0.0)


def _coverage(segments: np.ndarray, shape: tuple[int, int], stroke_width: float) -> np.ndarray:
    """Share of each pixel that lies within half a stroke of one of the `segments` (S, 2, 2), from the distance."""
    rows, columns = np.indices(shape) + 0.5
    pixels = np.stack([columns, rows], axis=-1)[..., None, :]
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length_squared = np.maximum((along**2).sum(axis=-1), 1e-12)
    position = np.clip(((pixels - start) * along).sum(axis=-1) / length_squared, 0.0, 1.0)
    distance = np.sqrt(((pixels - start - position[..., None] * along) ** 2).sum(axis=-1)).min(axis=-1)
    return np.clip(max(stroke_width, 1.0) / 2.0 + 0.5 - distance, 0.0, 1.0)


def _blend(image: np.ndarray, x: int, y: int, coverage: np.ndarray, color) -> None:
    top, left = max(0, -y), max(0, -x)
    bottom, right = min(coverage.shape[0], image.shape[0] - y), min(coverage.shape[1], image.shape[1] - x)
    if top >= bottom or left >= right:
        return
    target = image[y + top : y + bottom, x + left : x + right]
    share = coverage[top:bottom, left:right, None]
    target[:] = np.rint(target * (1.0 - share) + np.asarray(color, dtype=np.float64) * share).astype(np.uint8)


@lru_cache(maxsize=512)
def _segments(path: str) -> tuple[np.ndarray, tuple[float, ...], tuple[float, ...]]:
    """Line segments (S, 2, 2) of a stroke path, the y of its horizontal and the x of its vertical lines."""
    segments, horizontal, vertical = [], [], []
    pen = np.zeros(2)
    for command, rest in re.findall(r"([MLhvC])([^MLhvC]*)", path):
        points = np.array([float(number) for number in re.findall(r"-?[\d.]+", rest)]).reshape(-1, 2)
        end = points[-1]
        if command == "L":
            segments.append((pen, end))
            if pen[1] == end[1]:
                horizontal.append(float(end[1]))
            if pen[0] == end[0]:
                vertical.append(float(end[0]))
        elif command != "M":
            curve = _curve(pen, _controls(command, pen, points), end)
            segments.extend(zip(curve[:-1], curve[1:], strict=True))
        pen = end
    return np.array(segments), tuple(horizontal), tuple(vertical)


def _controls(command: str, start: np.ndarray, points: np.ndarray) -> np.ndarray:
    if command == "C":
        return points[:2]
    x, y = (1.0, 0.0) if command == "h" else (0.0, 1.0)
    reach = (points[0] - start) * _SQUARENESS
    return np.array([start + reach * (x, y), points[0] - reach * (y, x)])


def _curve(start: np.ndarray, controls: np.ndarray, end: np.ndarray) -> np.ndarray:
    t = np.linspace(0.0, 1.0, _CURVE_STEPS + 1)[:, None]
    s = 1.0 - t
    return s**3 * start + 3.0 * s**2 * t * controls[0] + 3.0 * s * t**2 * controls[1] + t**3 * end
