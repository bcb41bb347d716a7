"""The comparison sheet, after Figure 1 of Allmenroeder and Peters 2021: renderings on top, signed errors below.

It has no text: report.html labels it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .color import color_bar, exposure_factor, luminance, signed_error_colors, to_srgb8

TILE_WIDTH = 480  # wider pictures are reduced to at most this
_PAPER, _GRAY = 250, 128  # between the tiles; pixels without values
_GUTTER, _BAR = 16, 18
_SCALE_PERCENTILE = 99.5


@dataclass(frozen=True)
class Tile:
    """One technique on the sheet."""

    label: str
    image: np.ndarray  # (H, W, 3) linear
    error: np.ndarray  # (H, W, 3) signed
    missing: np.ndarray | None = None  # mask (H, W) of pixels without values, which become gray; None: there are none


def comparison_sheet(reference: np.ndarray, techniques: Sequence[Tile]) -> tuple[np.ndarray, str]:
    """The sheet (H, W, 3), 8-bit sRGB, and its exposure and error scale as text.

    The `reference` is a linear image (H, W, 3); all images have its size. It is the first column, above the scale of
    colors. One exposure and one error scale (`common_error_scale`) serve all tiles.
    """
    for tile in techniques:
        for pixels in (tile.image, tile.error):
            if pixels.shape != reference.shape:
                raise ValueError(f"tile {tile.label!r} has shape {pixels.shape}, expected {reference.shape} as Cycles")
    exposure = exposure_factor(reference)
    scale = common_error_scale([tile.error for tile in techniques], reference)
    first = to_srgb8(exposure * _reduced(reference))
    bar = np.full_like(first, _PAPER)
    bar[:_BAR] = _to_8bit(color_bar(first.shape[1], _BAR))[: len(first)]
    columns = [(first, bar)]
    for tile in techniques:
        image, error = _known(tile.image, tile.missing), _known(tile.error, tile.missing)
        pair = to_srgb8(exposure * image), _to_8bit(signed_error_colors(error, scale))
        if tile.missing is not None:
            is_gray = _reduced(~tile.missing[..., None]) == 0.0
            pair = tuple(np.where(is_gray, np.uint8(_GRAY), pixels) for pixels in pair)
        columns.append(pair)
    rows = [np.concatenate([_framed(picture) for picture in row], axis=1) for row in zip(*columns, strict=True)]
    text = f"exposure {np.log2(exposure):+.1f} EV, colors of errors from \u2212{scale:g} to +{scale:g}"
    return np.concatenate(rows), text


def _framed(picture: np.ndarray) -> np.ndarray:
    height, width, _ = picture.shape
    framed = np.full((height + _GUTTER, width + _GUTTER, 3), _PAPER, np.uint8)
    framed[_GUTTER // 2 :, _GUTTER // 2 :][:height, :width] = picture
    return framed


def _known(image: np.ndarray, missing: np.ndarray | None) -> np.ndarray:
    """`image` reduced; its pixels are means over the pixels that are not `missing`, 0 where all are."""
    if missing is None:
        return _reduced(image)
    known = ~missing[..., None]
    share = _reduced(known)
    return _reduced(np.where(known, image, 0.0)) / np.where(share > 0.0, share, 1.0)


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


def _reduced(image: np.ndarray) -> np.ndarray:
    """`image` (H, W, C) as means over squares of pixels, with a width within TILE_WIDTH.

    Incomplete squares at the right and lower edge are cut off.
    """
    step = min(-(-image.shape[1] // TILE_WIDTH), image.shape[0])
    height, width = image.shape[0] // step, image.shape[1] // step
    return image[: height * step, : width * step].reshape(height, step, width, step, -1).mean(axis=(1, 3))


def _to_8bit(colors: np.ndarray) -> np.ndarray:
    return np.rint(255.0 * colors).astype(np.uint8)
