"""Signed errors as colors: white is zero, red too bright, blue too dark."""

from __future__ import annotations

import numpy as np

from .tone import luminance

# sRGB display colors from -1 (too dark) to 1 (too bright). Lightness falls alike on both sides (CIE L* of about 97, 76,
# 50, 26), so that equal errors of either sign look equally strong.
_STOPS = np.array([-1.0, -0.6, -0.25, 0.0, 0.25, 0.6, 1.0])
_COLORS = np.array(
    [
        [0.02, 0.19, 0.42],
        [0.13, 0.45, 0.75],
        [0.60, 0.78, 0.91],
        [0.97, 0.97, 0.97],
        [0.98, 0.70, 0.58],
        [0.80, 0.22, 0.21],
        [0.42, 0.00, 0.10],
    ]
)
NOT_FINITE_COLOR = (1.0, 0.0, 1.0)


def signed_error_colors(error: np.ndarray, scale: float) -> np.ndarray:
    """sRGB colors (H, W, 3) in [0, 1] of errors (H, W), or (H, W, 3) by their luminance; saturated beyond +-scale.

    NaN and Inf are magenta, which no error is.
    """
    if not scale > 0.0:
        raise ValueError(f"scale of the error colors is {scale}, expected a positive number")
    error = np.asarray(error, dtype=np.float64)
    finite = np.isfinite(error) if error.ndim == 2 else np.isfinite(error).all(axis=-1)
    if error.ndim == 3:
        error = luminance(np.where(finite[..., None], error, 0.0))
    position = np.clip(np.where(finite, error, 0.0) / scale, -1.0, 1.0)
    colors = np.stack([np.interp(position, _STOPS, channel) for channel in _COLORS.T], axis=-1)
    return np.where(finite[..., None], colors, NOT_FINITE_COLOR)


def color_bar(width: int, height: int) -> np.ndarray:
    """sRGB colors (height, width, 3) of the scale from -1 on the left to 1 on the right."""
    return np.broadcast_to(signed_error_colors(np.linspace(-1.0, 1.0, width)[None], 1.0), (height, width, 3)).copy()
