"""Error figures of an image against a reference: noise-free, or known as two independent noisy halves.

Radiance arrays are (..., 3); a `mask` (...) picks pixels. Sums run over all picked pixels and the three channels;
nothing is trimmed. NaN and Inf of the technique are counted and left out of every sum.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from .color import luminance

# Relative errors of single pixels are taken where the reference's luminance is above this share of its maximum.
LIT_SHARE = 1e-4


@dataclass(frozen=True)
class ErrorStatistics:
    """Figures of T against R; None where no picked pixel (or no lit one) allows the figure."""

    relative_l2: float | None  # |T - R| / |R|
    unbiased_relative_error: float | None  # see `unbiased_relative_error`; equals relative_l2 without noise
    unbiased_squared_error: float | None  # signed: negative where the error drowns in the noise
    relative_rmse: float | None  # root mean square over lit pixels of |T - R| / |R|, norms over the channels
    bias: float | None  # sum T / sum R - 1
    median_relative_error: float | None  # over lit pixels
    percentile_95_relative_error: float | None
    max_relative_error: float | None
    max_absolute_error: float | None  # W m^-2 sr^-1
    not_finite: int  # values of T that are NaN or Inf
    pixels: int

    def to_dict(self) -> dict:
        """The figures by name."""
        return asdict(self)


def unbiased_relative_error(technique, half_a, half_b, mask=None) -> tuple[float | None, float | None]:
    """(e, e^2) with e^2 = sum (T - A)(T - B) / sum A B, e = sqrt(max(0, e^2)).

    A and B are independent renders of the same scene, so their noise is uncorrelated and cancels in both sums on
    average: unlike |T - (A + B) / 2|, e does not grow with the noise.
    """
    technique, half_a, half_b = (_picked(values, mask) for values in (technique, half_a, half_b))
    technique, half_a, half_b = _where_finite(technique, half_a, half_b)
    norm = float((half_a * half_b).sum())
    if not technique.size or norm <= 0.0:
        return None, None
    squared = float(((technique - half_a) * (technique - half_b)).sum()) / norm
    return float(np.sqrt(max(squared, 0.0))), squared


def reference_noise(half_a, half_b, mask=None) -> float | None:
    """|A - B| / |A + B|: the relative noise of the mean of two independent halves; None for a black reference."""
    half_a, half_b = _picked(half_a, mask), _picked(half_b, mask)
    total = np.linalg.norm(half_a + half_b)
    return float(np.linalg.norm(half_a - half_b) / total) if total > 0.0 else None


def error_statistics(technique, reference, mask=None) -> ErrorStatistics:
    """Figures against a noise-free `reference`; arrays (..., 3), for images or plain samples."""
    return _statistics(technique, reference, reference, mask)


def noisy_error_statistics(technique, half_a, half_b, mask=None) -> ErrorStatistics:
    """Figures against the mean of two independent halves; only the unbiased ones are free of their noise."""
    return _statistics(technique, half_a, half_b, mask)


def _statistics(technique, half_a, half_b, mask) -> ErrorStatistics:
    technique, half_a, half_b = (_picked(values, mask) for values in (technique, half_a, half_b))
    not_finite = int(np.count_nonzero(~np.isfinite(technique)))
    pixels = len(technique)
    technique, half_a, half_b = _where_finite(technique, half_a, half_b)
    reference = 0.5 * (half_a + half_b)
    difference = technique - reference
    unbiased, squared = unbiased_relative_error(technique, half_a, half_b)
    norm, total = np.linalg.norm(reference), reference.sum()
    relative = _pixel_errors(difference, reference)
    return ErrorStatistics(
        relative_l2=float(np.linalg.norm(difference) / norm) if norm > 0.0 else None,
        unbiased_relative_error=unbiased,
        unbiased_squared_error=squared,
        relative_rmse=float(np.sqrt(np.mean(relative**2))) if relative.size else None,
        bias=float(technique.sum() / total - 1.0) if total > 0.0 else None,
        median_relative_error=float(np.median(relative)) if relative.size else None,
        percentile_95_relative_error=float(np.percentile(relative, 95.0)) if relative.size else None,
        max_relative_error=float(relative.max()) if relative.size else None,
        max_absolute_error=float(np.abs(difference).max()) if difference.size else None,
        not_finite=not_finite,
        pixels=pixels,
    )


def _pixel_errors(difference, reference):
    """|T - R| / |R| (Q,) of the lit pixels."""
    brightness = luminance(reference)
    lit = brightness > LIT_SHARE * brightness.max(initial=0.0)
    lit &= brightness > 0.0
    return np.linalg.norm(difference[lit], axis=1) / np.linalg.norm(reference[lit], axis=1)


def _picked(values, mask):
    values = np.asarray(values, dtype=np.float64)
    if values.shape[-1:] != (3,):
        raise ValueError(f"radiance has shape {values.shape}, expected (..., 3)")
    return values.reshape(-1, 3) if mask is None else values[mask]


def _where_finite(technique, *others):
    finite = np.isfinite(technique).all(axis=1)
    return technique[finite], *(values[finite] for values in others)
