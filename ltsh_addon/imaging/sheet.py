"""The comparison sheet, after Figure 1 of Allmenroeder and Peters 2021: renderings on top, signed errors below."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from .color import color_bar, exposure_factor, luminance, signed_error_colors, to_srgb8

COLUMNS = 5
TILE_WIDTHS = (240, 480)  # tiny images are enlarged to the first, large ones reduced to the second
_PAPER, _INK, _FAINT, _FRAME = (250, 250, 249), (28, 28, 30), (106, 106, 112), (198, 198, 202)
_GRAY = (128, 128, 128)  # pixels without values
_MARGIN, _GUTTER, _BAR = 28, 16, 18
_TITLE, _LABEL, _TEXT = 26.0, 18.0, 14.0
_SCALE_PERCENTILE = 99.5


@dataclass(frozen=True)
class Tile:
    """One technique on the sheet."""

    label: str
    image: np.ndarray  # (H, W, 3) linear
    error: np.ndarray  # (H, W, 3) signed
    caption: Sequence[str] = field(default=())  # lines of text
    missing: np.ndarray | None = None  # mask (H, W) of pixels without values, which become gray; None: there are none


def comparison_sheet(
    title: str, reference: tuple[str, np.ndarray], techniques: Sequence[Tile], *, notes: Sequence[str] = ()
) -> np.ndarray:
    """The sheet (H, W, 3), 8-bit sRGB.

    `reference` is a label and a linear image (H, W, 3); all images have its size. One exposure and one error scale
    (`common_error_scale`) serve all tiles; both are printed.
    """
    label, image = reference
    for tile in techniques:
        for pixels in (tile.image, tile.error):
            if pixels.shape != image.shape:
                raise ValueError(f"tile {tile.label!r} has shape {pixels.shape}, expected {image.shape} as {label!r}")
    exposure = exposure_factor(image)
    scale = common_error_scale([tile.error for tile in techniques], image)
    first = to_srgb8(exposure * _resized(image))
    height, width = first.shape[:2]
    meaning = "signed error: technique \u2212 Cycles, in radiance; red is too bright, blue too dark"
    legend = _wrapped((meaning, *notes, f"exposure {np.log2(exposure):+.1f} EV"), width)
    captions = [_wrapped(tile.caption, width) for tile in techniques]
    lines = max(map(len, captions), default=0)
    sheet = _Sheet(title, width, height, count=1 + len(techniques), lines=(len(legend), lines))
    sheet.draw_tile(0, label, first, None, ())
    sheet.legend(legend, scale)
    for index, (tile, caption) in enumerate(zip(techniques, captions, strict=True), start=1):
        picture = _with_gray(to_srgb8(exposure * _known(tile.image, tile.missing)), tile.missing)
        error = _to_8bit(signed_error_colors(_known(tile.error, tile.missing), scale))
        sheet.draw_tile(index, tile.label, picture, _with_gray(error, tile.missing), caption)
    return sheet.pixels


def _wrapped(texts: Sequence[str], width: int) -> list[str]:
    return [line for text in texts for line in wrap(text, width, _TEXT)]


def _known(image: np.ndarray, missing: np.ndarray | None) -> np.ndarray:
    """`image` resized; reduced images are means over the pixels that are not `missing`."""
    if missing is None:
        return _resized(image)
    known = np.where(missing, 0.0, 1.0)[..., None]
    share = _resized(known)
    return np.divide(
        _resized(np.where(known, image, 0.0)), share, out=np.zeros((*share.shape[:2], 3)), where=share > 0.0
    )


def _with_gray(pixels: np.ndarray, missing: np.ndarray | None) -> np.ndarray:
    """8-bit `pixels` (H, W, 3) of a resized picture, gray where all pixels of the picture are `missing`."""
    if missing is None:
        return pixels
    share = _resized((~missing[..., None]).astype(np.float64))
    return np.where(share > 0.0, pixels, _GRAY).astype(np.uint8)


def common_error_scale(errors, image) -> float:
    """A round number near the 99.5th percentile of the luminance of all `errors` (H, W, 3) that are not 0.

    Without errors it is the largest value of the `image`, at least 1.
    """
    values = [np.abs(luminance(error[np.isfinite(error).all(axis=-1)])) for error in errors]
    values = np.concatenate([magnitudes[magnitudes > 0.0] for magnitudes in values]) if values else np.empty(0)
    if not values.size:
        return max(float(np.nanmax(np.where(np.isfinite(image), image, 0.0), initial=0.0)), 1.0)
    value = float(np.percentile(values, _SCALE_PERCENTILE))
    power = 10.0 ** np.floor(np.log10(value))
    return float(min((step * power for step in (1.0, 2.0, 5.0, 10.0)), key=lambda step: abs(np.log(step / value))))


def _resized(image: np.ndarray) -> np.ndarray:
    """`image` enlarged by a whole factor (nearest), or reduced by a box filter, to a width within TILE_WIDTHS."""
    smallest, largest = TILE_WIDTHS
    height, width = image.shape[:2]
    if width < smallest:
        factor = -(-smallest // width)
        return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)
    if width <= largest:
        return image
    new_width = largest
    new_height = max(round(height * new_width / width), 1)
    return _box_filtered(_box_filtered(image, new_height).swapaxes(0, 1), new_width).swapaxes(0, 1)


def _box_filtered(image: np.ndarray, rows: int) -> np.ndarray:
    """`image` with its rows averaged over `rows` equal intervals; rows on a border are shared by overlap."""
    sums = np.concatenate([np.zeros_like(image[:1], dtype=np.float64), np.cumsum(image, axis=0, dtype=np.float64)])
    borders = np.linspace(0.0, image.shape[0], rows + 1)
    whole = np.minimum(borders.astype(int), image.shape[0] - 1)
    at_border = sums[whole] + (borders - whole)[:, None, None] * image[whole]
    return np.diff(at_border, axis=0) * (rows / image.shape[0])


def _to_8bit(colors: np.ndarray) -> np.ndarray:
    return np.rint(255.0 * colors).astype(np.uint8)


class _Sheet:
    """The pixels of a sheet, and the layout."""

    def __init__(self, title: str, width: int, height: int, *, count: int, lines: tuple[int, int]):
        legend_lines, caption_lines = lines
        self.width, self.height = width, height
        self.rows = -(-count // COLUMNS)
        self.columns = -(-count // self.rows)
        self.line = text_size("Ag", _TEXT)[1] + 4
        self.label_height = text_size("Ag", _LABEL, bold=True)[1] + 8
        self.caption_height = caption_lines * self.line + 10
        below = 2 * height + 10 + self.caption_height
        legend = height + 10 + _BAR + 12 + (1 + legend_lines) * self.line
        # The first row has the legend, which may need more room than the errors beside it.
        self.heights = [self.label_height + max(below, legend) + 18]
        self.heights += (self.rows - 1) * [self.label_height + below + 18]
        page_width = 2 * _MARGIN + self.columns * width + (self.columns - 1) * _GUTTER
        heading = wrap(title, page_width - 2 * _MARGIN, _TITLE, bold=True)
        title_line = text_size("Ag", _TITLE, bold=True)[1]
        self.top = _MARGIN + len(heading) * title_line + 18
        page_height = self.top + sum(self.heights) + _MARGIN - 18
        self.pixels = np.full((page_height, page_width, 3), _PAPER, dtype=np.uint8)
        for number, text in enumerate(heading):
            draw_text(self.pixels, (_MARGIN, _MARGIN + number * title_line), text, _INK, _TITLE, bold=True)

    def _corner(self, index: int) -> tuple[int, int]:
        row, column = divmod(index, self.columns)
        return _MARGIN + column * (self.width + _GUTTER), self.top + sum(self.heights[:row])

    def draw_tile(self, index: int, label: str, picture: np.ndarray, error: np.ndarray | None, caption) -> None:
        """Draw label, picture, error and caption into cell `index`."""
        x, y = self._corner(index)
        draw_text(self.pixels, (x, y), shorten(label, self.width, _LABEL, bold=True), _INK, _LABEL, bold=True)
        y += self.label_height
        self._picture(x, y, picture)
        y += self.height + 10
        if error is not None:
            self._picture(x, y, error)
        y += self.height + 8
        for line in caption:
            draw_text(self.pixels, (x, y), line, _FAINT, _TEXT)
            y += self.line

    def _picture(self, x: int, y: int, picture: np.ndarray) -> None:
        height, width = picture.shape[:2]
        self.pixels[y - 1 : y + height + 1, x - 1 : x + width + 1] = _FRAME
        self.pixels[y : y + height, x : x + width] = picture

    def legend(self, lines: Sequence[str], scale: float) -> None:
        """Draw the color bar with its numbers and the `lines` below the reference."""
        x, y = self._corner(0)
        y += self.label_height + self.height + 10
        self._picture(x, y + 1, _to_8bit(color_bar(self.width, _BAR)))
        y += _BAR + 6
        for text, align in ((f"\u2212{scale:g}", 0.0), ("0", 0.5), (f"+{scale:g}", 1.0)):
            width = text_size(text, _TEXT)[0]
            draw_text(self.pixels, (x + round(align * (self.width - width)), y), text, _INK, _TEXT)
        y += self.line + 6
        for line in lines:
            draw_text(self.pixels, (x, y), line, _FAINT, _TEXT)
            y += self.line


ASCENT = 16.0  # highest stroke center: brackets
DESCENT = 4.4  # lowest stroke center: g, p, q
DIGIT_WIDTH = 8.4  # of all digits, so that numbers form columns
SPACE_WIDTH = 3.0

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
    image: np.ndarray, corner: tuple[int, int], text: str, color=(0, 0, 0), size: float = 14.0, *, bold: bool = False
) -> int:
    """Draw one line of `text` into `image` (H, W, 3) uint8 and return the x where it ends.

    `corner` (x, y) is the top left one of the box of `text_size`; what falls outside of the image is cut off. Accents
    are dropped, characters without a glyph become a crossed box.
    """
    x, y = corner
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


def wrap(text: str, width: int, size: float = 14.0, *, bold: bool = False) -> list[str]:
    """`text` broken between words into lines that fit into `width` pixels; a longer single word is shortened."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_size(f"{lines[-1]} {word}", size, bold=bold)[0] <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return [shorten(line, width, size, bold=bold) for line in lines]


@cache
def _paths() -> dict[str, str]:
    """Paths of characters, as letters.txt describes them; the one for all others is "replacement"."""
    lines = Path(__file__).with_name("letters.txt").read_text(encoding="utf-8").split("\n\n", 1)[1].splitlines()
    return dict(line.split(" ", 1) for line in lines)


def _drawable(text: str) -> str:
    paths, characters = _paths(), []
    for character in str(text):
        if character not in paths:
            base = "".join(
                letter for letter in unicodedata.normalize("NFKD", character) if not unicodedata.combining(letter)
            )
            character = base if len(base) == 1 else character
        characters.append(" " if character.isspace() else character)
    return "".join(characters)


def _extent(size: float, bold: bool) -> tuple[int, int]:
    """Pixels above and below the baseline that hold all ink, anti-aliasing included."""
    unit = size / _UNITS_PER_EM
    margin = _STROKE_WIDTH[bold] * unit / 2.0 + 1.0
    return int(np.ceil(ASCENT * unit + margin)), int(np.ceil(DESCENT * unit + margin))


@lru_cache(maxsize=2048)
def _glyph(character: str, size: float, bold: bool) -> tuple[np.ndarray, int]:
    """Coverage (H, A) in [0, 1] and the advance A in pixels."""
    unit = size / _UNITS_PER_EM
    stroke_width = _STROKE_WIDTH[bold] * unit
    ascent, descent = _extent(size, bold)
    if character == " ":
        advance = max(1, round((SPACE_WIDTH + 2.0 * _BEARING) * unit))
        return np.zeros((ascent + descent, advance)), advance
    segments = _segments(_paths().get(character, _paths()["replacement"]))
    digit = character.isdigit() and character.isascii()
    low, high = (0.0, DIGIT_WIDTH) if digit else (segments[..., 0].min(), segments[..., 0].max())
    advance = int(np.ceil((high - low + 2.0 * _BEARING) * unit + stroke_width))
    x = (segments[..., 0] - 0.5 * (low + high)) * unit + 0.5 * advance
    y = ascent - segments[..., 1] * unit
    return _coverage(np.stack([x, y], axis=-1), (ascent + descent, advance), stroke_width), advance


def _coverage(segments: np.ndarray, shape: tuple[int, int], stroke_width: float) -> np.ndarray:
    """Share of each pixel, estimated from its distance, that lies within half a stroke of a segment (S, 2, 2)."""
    rows, columns = np.indices(shape) + 0.5
    pixels = np.stack([columns, rows], axis=-1)[..., None, :]
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length_squared = np.maximum((along**2).sum(axis=-1), 1e-12)
    position = np.clip(((pixels - start) * along).sum(axis=-1) / length_squared, 0.0, 1.0)
    distance = np.sqrt(((pixels - start - position[..., None] * along) ** 2).sum(axis=-1)).min(axis=-1)
    return np.clip(max(stroke_width, 1.0) / 2.0 + 0.5 - distance, 0.0, 1.0)


def _blend(image: np.ndarray, x: int, y: int, coverage: np.ndarray, color) -> None:
    first_y, first_x = max(0, -y), max(0, -x)
    end_y, end_x = min(coverage.shape[0], image.shape[0] - y), min(coverage.shape[1], image.shape[1] - x)
    if first_y >= end_y or first_x >= end_x:
        return
    target = image[y + first_y : y + end_y, x + first_x : x + end_x]
    share = coverage[first_y:end_y, first_x:end_x, None]
    target[:] = np.rint(target * (1.0 - share) + np.asarray(color, dtype=np.float64) * share).astype(np.uint8)


@lru_cache(maxsize=512)
def _segments(path: str) -> np.ndarray:
    """Line segments (S, 2, 2) of a stroke path."""
    segments, pen = [], np.zeros(2)
    for command, rest in re.findall(r"([MLhvC])([^MLhvC]*)", path):
        points = np.array([float(number) for number in re.findall(r"-?[\d.]+", rest)]).reshape(-1, 2)
        end = points[-1]
        if command == "L":
            segments.append((pen, end))
        elif command != "M":
            curve = _curve(pen, _controls(command, pen, points), end)
            segments.extend(zip(curve[:-1], curve[1:], strict=True))
        pen = end
    return np.array(segments)


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
