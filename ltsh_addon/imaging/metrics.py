"""Error figures of an image against a reference: noise-free, or known as two independent noisy halves; FLIP.

Radiance arrays are (..., 3); a `mask` (...) picks pixels. Sums run over all picked pixels and the three channels;
nothing is trimmed. NaN and Inf of the technique are counted and left out of every sum.

FLIP tells how different two pictures look to somebody who alternates between them (0: not at all, 1: completely).
Andersson, Nilsson, Akenine-Moeller, Oskarsson, Aastroem and Fairchild, "FLIP: A Difference Evaluator for Alternating
Images", Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020, DOI 10.1145/3406183; equation numbers are theirs. The
low-dynamic-range version, for which radiance is brought to display values by one exposure for both pictures.
"""

from dataclasses import asdict, dataclass

import numpy as np

from .color import exposure_factor, luminance

# LIT_SHARE: pixels are lit, and have relative errors, if the reference's luminance is above this share of its maximum.
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
    return noisy_error_statistics(technique, reference, reference, mask)


def noisy_error_statistics(technique, half_a, half_b, mask=None) -> ErrorStatistics:
    """Figures against the mean of two independent halves; only the unbiased figures are free of the halves' noise."""
    technique, half_a, half_b = (_picked(values, mask) for values in (technique, half_a, half_b))
    not_finite = int(np.count_nonzero(~np.isfinite(technique)))
    pixels = len(technique)
    technique, half_a, half_b = _where_finite(technique, half_a, half_b)
    reference = 0.5 * (half_a + half_b)
    difference = technique - reference
    unbiased, squared = unbiased_relative_error(technique, half_a, half_b)
    norm, total = np.linalg.norm(reference), reference.sum()
    brightness = luminance(reference)
    lit = brightness > LIT_SHARE * brightness.max(initial=0.0)  # |T - R| / |R| of the lit pixels
    relative = np.linalg.norm(difference[lit], axis=1) / np.linalg.norm(reference[lit], axis=1)
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


def _picked(values, mask):
    values = np.asarray(values, dtype=np.float64)
    if values.shape[-1:] != (3,):
        raise ValueError(f"radiance has shape {values.shape}, expected (..., 3)")
    return values.reshape(-1, 3) if mask is None else values[mask]


def _where_finite(technique, *others):
    finite = np.isfinite(technique).all(axis=1)
    return technique[finite], *(values[finite] for values in others)


# A monitor 0.7 m wide with 3840 pixels, seen from 0.7 m: the paper's own choice.
PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180.0
# Contrast sensitivity of the achromatic and the two opponent channels as sums of Gaussians: (a, b) each, Table 1.
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_WIDEST = 0.04
_FEATURE_WIDTH = 0.082  # degrees
_COLOR_EXPONENT, _FEATURE_EXPONENT = 0.7, 0.5
_BEND, _BENT = 0.4, 0.95  # p_c and p_t: errors up to _BEND of the largest take _BENT of the range
_HUNT = 0.01
_COLUMNS = 64

_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)  # linear sRGB, D65
_TO_RATIO = (_TO_XYZ / _TO_XYZ.sum(axis=1)[:, None]).T  # to XYZ as shares of those of white


def flip(reference: np.ndarray, test: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> np.ndarray:
    """FLIP (H, W) of two pictures (H, W, 3) in linear sRGB, clipped to [0, 1].

    Within 1e-5 of the authors' own program. Raises ValueError for pictures of different or wrong shape.
    """
    reference, test = (np.clip(np.asarray(image, dtype=np.float32), 0.0, 1.0) for image in (reference, test))
    if reference.shape != test.shape or reference.ndim != 3 or reference.shape[2] != 3:
        raise ValueError(f"pictures of shape {reference.shape} and {test.shape}, expected both (height, width, 3)")
    # In opponent colors the filters for contrast sensitivity are linear.
    opponents = [_opponents(image @ _TO_RATIO.astype(np.float32)) for image in (reference, test)]
    color = _color_difference(*(_filtered(image, pixels_per_degree) for image in opponents))
    lightness = [(image[..., 0] + 16.0) / 116.0 for image in opponents]
    feature = _feature_difference(*lightness, pixels_per_degree)
    return color ** (1.0 - feature)  # (1)


def mean_flip(reference: np.ndarray, test: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Mean FLIP of two radiance pictures (H, W, 3) over the pixels of `mask`; None without pixels.

    Both are exposed so that the 99th percentile of the reference is nearly white. NaN and Inf count as black.
    """
    factor = exposure_factor(reference)
    shown = [factor * np.where(np.isfinite(image), image, 0.0) for image in (reference, test)]
    values = flip(*shown)
    values = values if mask is None else values[mask]
    return float(values.mean(dtype=np.float64)) if values.size else None


def _opponents(ratio: np.ndarray) -> np.ndarray:
    """Y Cx Cz from XYZ relative to white; CIELAB if the nonlinearity of CIELAB has been applied to `ratio` before."""
    x, y, z = np.moveaxis(ratio, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _filtered(opponent: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """The picture as far as the eye resolves it (Section 4.1), in CIELAB with the Hunt effect."""
    radius = int(np.ceil(3.0 * np.sqrt(_WIDEST / (2.0 * np.pi**2)) * pixels_per_degree))
    distance = np.arange(-radius, radius + 1) / pixels_per_degree
    planes = []
    for channel, terms in enumerate(_SENSITIVITY):
        kernels = [np.exp(-(np.pi**2) * distance**2 / b) for _, b in terms]
        weights = np.array([a * np.sqrt(np.pi / b) for a, b in terms])
        total = sum(weight * kernel.sum() ** 2 for weight, kernel in zip(weights, kernels, strict=True))
        parts = (
            float(weight / total) * _convolved(opponent[..., channel], kernel, kernel)
            for weight, kernel in zip(weights, kernels, strict=True)
        )
        planes.append(sum(parts))
    y = (planes[0] + 16.0) / 116.0
    ratio = np.stack([planes[1] / 500.0 + y, y, y - planes[2] / 200.0], axis=-1)
    linear = ratio @ np.linalg.inv(_TO_RATIO).astype(np.float32)
    return _hunt(_lab(np.clip(linear, 0.0, 1.0)))


def _lab(linear: np.ndarray) -> np.ndarray:
    """CIELAB of linear sRGB, white point D65 (CIE 15)."""
    ratio = linear @ _TO_RATIO.astype(np.float32)
    delta = 6.0 / 29.0
    return _opponents(np.where(ratio > delta**3, np.cbrt(ratio), ratio / (3.0 * delta**2) + 4.0 / 29.0))


def _hunt(lab: np.ndarray) -> np.ndarray:
    """CIELAB with the Hunt effect (4): colors seem stronger where it is bright."""
    return np.concatenate([lab[..., :1], _HUNT * lab[..., :1] * lab[..., 1:]], axis=-1)


def _hyab(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance of large color differences (5): city block in lightness, Euclidean in chroma."""
    difference = first - second
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


def _color_difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Color error in [0, 1]: small differences take most of the range (7)."""
    green, blue = (_hunt(_lab(np.array(color, dtype=np.float64))) for color in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    largest = float(_hyab(green, blue)) ** _COLOR_EXPONENT
    error = _hyab(first, second) ** _COLOR_EXPONENT
    bend = _BEND * largest
    above = _BENT + (error - bend) / (largest - bend) * (1.0 - _BENT)
    return np.where(error < bend, _BENT / bend * error, above)


def _feature_difference(first: np.ndarray, second: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """How much edges and points differ (Section 4.2), in [0, 1]."""
    deviation = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = int(np.ceil(3.0 * deviation))
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = np.exp(-(x**2) / (2.0 * deviation**2))
    edge, point = -x * smooth, (x**2 / deviation**2 - 1.0) * smooth
    largest = 0.0
    for kernel in (edge, point):
        strengths = [_feature_strength(image, kernel, smooth) for image in (first, second)]
        largest = np.maximum(largest, np.abs(strengths[0] - strengths[1]))
    return (largest / np.sqrt(2.0)) ** _FEATURE_EXPONENT  # (10)


def _feature_strength(image: np.ndarray, kernel: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Magnitude of the filter's responses along both axes; its positive and negative weights sum to 1 each."""
    smooth = smooth / smooth.sum()
    kernel = np.where(kernel > 0.0, kernel / kernel[kernel > 0.0].sum(), -kernel / kernel[kernel < 0.0].sum())
    return np.hypot(_convolved(image, kernel, smooth), _convolved(image, smooth, kernel))


def _convolved(image: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """`image` (H, W) convolved with kernels of odd size along x and y; values at the borders are repeated outside."""
    return _convolved_rows(np.ascontiguousarray(_convolved_rows(np.ascontiguousarray(image.T), along_x).T), along_y)


def _convolved_rows(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """`image` convolved with `kernel` along the first axis."""
    radius = len(kernel) // 2
    padded = np.pad(image, ((radius, radius), (0, 0)), mode="edge")
    result = np.zeros(image.shape, dtype=image.dtype)
    weights = kernel.astype(image.dtype)
    for start in range(0, image.shape[1], _COLUMNS):  # so few that the sums stay in the cache
        columns = slice(start, start + _COLUMNS)
        scratch = np.empty_like(result[:, columns])
        for offset, weight in enumerate(weights):
            result[:, columns] += np.multiply(padded[offset : offset + len(image), columns], weight, out=scratch)
    return result
