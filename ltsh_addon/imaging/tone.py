"""From scene-referred radiance to display values: exposure and the sRGB curve."""

from __future__ import annotations

import numpy as np

LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # linear Rec.709, ITU-R BT.709
_WHITE = 0.9  # display value that the bright end of the reference is brought to
_BRIGHT_PERCENTILE = 99.0


def luminance(color: np.ndarray) -> np.ndarray:
    """Rec.709 luminance (...) of linear color (..., 3)."""
    return np.asarray(color, dtype=np.float64) @ LUMINANCE_WEIGHTS


def exposure_factor(reference: np.ndarray) -> float:
    """Factor that brings the 99th percentile of the luminance of lit pixels of `reference` (..., 3) to 0.9.

    1 when nothing is lit. NaN and Inf are left out.
    """
    lit = luminance(np.where(np.isfinite(reference), reference, 0.0))
    lit = lit[lit > 0.0]
    bright = float(np.percentile(lit, _BRIGHT_PERCENTILE)) if lit.size else 0.0
    factor = _WHITE / bright if bright > 0.0 else 1.0
    return factor if np.isfinite(factor) else 1.0


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """sRGB display values in [0, 1] of linear values, clipped to [0, 1]; NaN becomes 0. Source: IEC 61966-2-1."""
    linear = np.asarray(linear, dtype=np.float64)
    linear = np.clip(np.where(np.isnan(linear), 0.0, linear), 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1.0 / 2.4) - 0.055)


def to_srgb8(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear values, clipped to [0, 1]; NaN becomes 0."""
    return np.rint(255.0 * srgb_encode(linear)).astype(np.uint8)
