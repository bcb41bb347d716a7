"""The comparison sheet, after Figure 1 of Allmenroeder and Peters 2021: renderings on top, signed errors below."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

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

_BOWL_RIGHT = "M0 5v3.8 10h7.6 5v3.8 0h0 5"
_BOWL_LEFT = "M7.6 5v3.8 10h0 5v3.8 0h7.6 5"
_S = "M8.6 11.5C8 13.1 6.4 14 4.6 14h.4 10.5C.4 8.3 2.4 7.8 4.6 7.2C7.2 6.5 9 5.9 9 3.7v4.5 0C2.4 0 .7 .9 0 2.7"
_P = "M0 0L0 14L4.6 14h8.6 10.2v4.6 6.4L0 6.4"

STROKES = {
    "A": "M0 0L5 14L10 0M1.7 4.6L8.3 4.6",
    "B": "M0 7.4L4.8 7.4h8.2 10.7v4.8 14L0 14L0 0L4.9 0h8.9 3.7v4.9 7.4",
    "C": "M9.5 11.2C8.7 12.9 7.1 14 5.2 14h0 7v5.2 0C7.1 0 8.7 1.1 9.5 2.8",
    "D": "M0 0L0 14L3.8 14h9.4 7v3.8 0L0 0",
    "E": "M7.6 14L0 14L0 0L7.6 0M0 7.2L6.6 7.2",
    "F": "M7.6 14L0 14L0 0M0 6.8L6.6 6.8",
    "G": "M9.5 11.4C8.7 13 7.1 14 5.2 14h0 7v5.2 0C7.3 0 9 .9 9.8 2L9.8 6.6L5.8 6.6",
    "H": "M0 0L0 14M9 0L9 14M0 7.2L9 7.2",
    "I": "M0 0L0 14",
    "J": "M5.8 14L5.8 4v2.9 0h0 3.2",
    "K": "M0 0L0 14M8.6 14L0 5.2M3.3 8.6L9.2 0",
    "L": "M0 14L0 0L7.2 0",
    "M": "M0 0L0 14L5.6 4.2L11.2 14L11.2 0",
    "N": "M0 0L0 14L9.2 0L9.2 14",
    "O": "M5.3 14h0 7v5.3 0h10.6 7v5.3 14",
    "P": _P,
    "Q": "M5.3 14h0 7v5.3 0h10.6 7v5.3 14M6.8 3.2L10.4 -.8",
    "R": _P + "M4.6 6.4L9.2 0",
    "S": _S,
    "T": "M0 14L9.2 14M4.6 14L4.6 0",
    "U": "M0 14L0 4.8v4.6 0h9.2 4.8L9.2 14",
    "V": "M0 14L4.9 0L9.8 14",
    "W": "M0 14L3.5 0L7 12L10.5 0L14 14",
    "X": "M0 0L9 14M0 14L9 0",
    "Y": "M0 14L4.7 6.6L9.4 14M4.7 6.6L4.7 0",
    "Z": "M.2 14L8.6 14L0 0L8.8 0",
    "a": "M.6 7.9C1.1 9.2 2.3 10 3.8 10h7 6.8L7 0M7 5.8L3.2 5.8h0 2.9v3 0C4.9 0 6.4 1 7 2.7",
    "b": "M0 14L0 0" + _BOWL_RIGHT,
    "c": "M7.1 7.8C6.5 9.2 5.3 10 3.9 10h0 5v3.9 0C5.3 0 6.5 .8 7.1 2.2",
    "d": "M7.6 14L7.6 0" + _BOWL_LEFT,
    "e": "M0 5.2L7.6 5.2v3.9 10h0 5v4 0C5.4 0 6.5 .6 7.2 1.7",
    "f": "M5.2 13.9C3 14.4 2 13.4 2 11.2L2 0M0 10L4.8 10",
    "g": "M7.6 10L7.6 -.6v3.7 -4.4C2.2 -4.4 1.1 -3.9 .4 -3" + _BOWL_LEFT,
    "h": "M0 14L0 0M0 5.6v3.8 10h7 6.4L7 0",
    "i": "M0 10L0 0M0 13.8L0 13.6",
    "j": "M2 10L2 -1.8C2 -3.7 1.2 -4.5 -.4 -4.3M2 13.8L2 13.6",
    "k": "M0 14L0 0M6.6 10L0 3.6M2.5 6L7 0",
    "l": "M0 14L0 2.4C0 .6 .7 -.1 2.2 0",
    "m": "M0 10L0 0M0 5.8v3.3 10h5.9 6.6L5.9 0M5.9 5.8v9.2 10h11.8 6.6L11.8 0",
    "n": "M0 10L0 0M0 5.6v3.8 10h7 6.4L7 0",
    "o": "M4 10h0 5v4 0h8 5v4 10",
    "p": "M0 10L0 -4.4" + _BOWL_RIGHT,
    "q": "M7.6 10L7.6 -4.4" + _BOWL_LEFT,
    "r": "M0 10L0 0M0 5.4C0 8.4 1.6 10.3 4.4 9.9",
    "s": "M6.3 8.2C5.9 9.4 4.8 10 3.4 10h.3 7.5C.3 6 1.8 5.6 3.4 5.2C5.1 4.8 6.7 4.2 6.7 2.6v3.4 0C1.8 0 .5 .7 0 1.9",
    "t": "M2 13L2 2.8C2 .7 3 -.2 4.9 .1M0 10L4.8 10",
    "u": "M0 10L0 3.8v3.4 0h7 4.4M7 10L7 0",
    "v": "M0 10L3.7 0L7.4 10",
    "w": "M0 10L2.9 0L5.8 9L8.7 0L11.6 10",
    "x": "M0 0L6.8 10M0 10L6.8 0",
    "y": "M0 10L3.9 .2M7.6 10L3.2 -2.2C2.6 -3.8 1.6 -4.6 .2 -4.3",
    "z": "M.2 10L6.4 10L0 0L6.6 0",
    "0": "M4.2 14h0 7v4.2 0h8.4 7v4.2 14",
    "1": "M1 11.2L4.8 14L4.8 0",
    "2": "M.4 10.3C.4 12.6 2 14 4.2 14h8 10.3C8 7.7 5 5.6 .2 0L8.4 0",
    "3": "M.6 11.7C1.2 13.2 2.6 14 4.1 14h7.8 10.7v4.2 7.4L3 7.4M4.2 7.4h8.3 3.7v4.1 0C2.2 0 .7 .9 .1 2.7",
    "4": "M6.4 0L6.4 14L0 4L8.6 4",
    "5": "M7.6 14L1.5 14L.9 7.5C1.8 8.4 3 8.9 4.3 8.9h8.4 4.5v4.2 0C2.3 0 .8 .9 .1 2.5",
    "6": "M7.4 12.4C6.8 13.4 5.8 14 4.6 14h.1 6.4L.1 4.4v4.2 0h8.3 4.4v4.2 8.8h.1 4.4",
    "7": "M0 14L8.2 14L3 0",
    "8": "M4.2 7.5h.5 10.8v4.2 14h7.9 10.8v4.2 7.5h0 3.8v4.2 0h8.4 3.8v4.2 7.5",
    "9": "M1 1.6C1.6 .6 2.6 0 3.8 0h8.3 7.6L8.3 9.6v4.2 14h.1 9.6v4.2 5.2h8.3 9.6",
    "!": "M0 14L0 4.4M0 .3L0 0",
    '"': "M0 14L0 10.4M3 14L3 10.4",
    "#": "M3.4 14L1.4 0M8 14L6 0M.6 9.6L9.4 9.6M0 4.4L8.8 4.4",
    "$": _S + "M4.5 15.8L4.5 -1.8",
    "%": "M2.7 14h0 10.8v2.7 7.6h5.4 10.8v2.7 14M10.5 6.4h7.8 3.2v10.5 0h13.2 3.2v10.5 6.4M10.4 14L2.8 0",
    "&": "M10.2 0L2.2 9C1.4 10 1.2 10.6 1.2 11.4v3.8 14h6.4 11.6C6.4 9.8 5 8.8 3.4 7.8C1.2 6.4 0 5.4 0 3.6v4 0"
    "C6.8 0 9 2.4 9.6 6",
    "'": "M0 14L0 10.4",
    "(": "M3 15.6C-1 10.4 -1 3 3 -2.6",
    ")": "M0 15.6C4 10.4 4 3 0 -2.6",
    "*": "M3.2 14L3.2 7.6M.4 12.4L6 9.2M6 12.4L.4 9.2",
    "+": "M0 6L8 6M4 10L4 2",
    ",": "M.8 .2L0 -2.6",
    "-": "M0 5.4L4.4 5.4",
    ".": "M0 .3L0 0",
    "/": "M0 -1.6L5.6 15",
    ":": "M0 .3L0 0M0 9.3L0 9",
    ";": "M.8 .2L0 -2.6M.8 9.3L.8 9",
    "<": "M7.6 10.4L0 6L7.6 1.6",
    "=": "M0 8L8 8M0 4L8 4",
    ">": "M0 10.4L7.6 6L0 1.6",
    "?": "M0 11C.4 13 1.9 14 3.7 14h7.2 10.8C7.2 8 3.6 7.9 3.6 4.4M3.6 .3L3.6 0",
    "@": "M9.6 5.4v6.6 8.8h3.6 5.4v6.6 2h9.6 5.4M9.6 8.8L9.6 4.2C9.6 1.2 13.2 1.4 13.2 5.6v6.8 12h0 5v6.8 -2.6"
    "C8.4 -2.6 9.8 -2.2 10.8 -1.6",
    "[": "M2.8 15.6L0 15.6L0 -2.6L2.8 -2.6",
    "\\": "M0 15L5.6 -1.6",
    "]": "M0 15.6L2.8 15.6L2.8 -2.6L0 -2.6",
    "^": "M0 8.6L3.6 14L7.2 8.6",
    "_": "M0 -2.4L8 -2.4",
    "`": "M0 14.4L2 11.8",
    "{": "M3.6 15.6h1.6 13.4L1.6 9v0 6.5h1.6 4L1.6 -.4v3.6 -2.6",
    "|": "M0 16L0 -3",
    "}": "M0 15.6h2 13.4L2 9v3.6 6.5h2 4L2 -.4v0 -2.6",
    "~": "M0 5C1.4 8 3.2 7.4 4.2 6.2C5.2 5 7 4.4 8.4 7.2",
    "\u2212": "M0 6L8 6",  # minus
    "\u2013": "M0 5.4L7 5.4",  # en dash
    "\u2014": "M0 5.4L11 5.4",  # em dash
    "\u2026": "M0 .3L0 0M4 .3L4 0M8 .3L8 0",  # ellipsis
}

REPLACEMENT = "M0 0L0 14L7 14L7 0L0 0M0 0L7 14"  # for every character that is not above

_UNITS_PER_EM = 20.0
# The letters of the sheet: a single-weight sans serif drawn as strokes.
#
# Units: capitals are 14 high, small letters 10, the baseline is y = 0, y points up, x = 0 is the center of the leftmost
# stroke. A glyph is a path of absolute coordinates:
#
#     M x y                    lift the pen
#     L x y                    straight line
#     h x y, v x y             quarter of a (slightly squarish) ellipse that leaves horizontally or vertically
#     C x1 y1 x2 y2 x y        cubic Bezier curve
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


def _drawable(text: str) -> str:
    characters = []
    for character in str(text):
        if character not in STROKES:
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
    segments = _segments(STROKES.get(character, REPLACEMENT))
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
