"""Color spaces, tone, the colors of signed errors, and 8-bit RGB PNG files.

PNG specification, third edition (W3C 2025), with an sRGB chunk.
"""

import os
import struct
import zlib

import numpy as np

from ..files import write_bytes
from ..scene import ColorSpace

# xy of red, green, blue and white. Sources: ITU-R BT.709 and BT.2020; SMPTE ST 2065-1 and Academy S-2014-004 (ACEScg).
CHROMATICITIES = {
    "Linear Rec.709": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "Linear Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "ACES2065-1": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
}
# BRADFORD: from XYZ to the cone responses in which white points are adapted (Lam 1985).
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# SAME_MATRIX: matrices to Rec.709 are the same if no entry differs by more. White points are published with 4 or 5
# digits.
SAME_MATRIX = 2e-3


def rgb_to_xyz(chromaticities) -> np.ndarray:
    """Matrix (3, 3) from linear RGB with these `chromaticities` (8,) to CIE XYZ, white at Y = 1 (SMPTE RP 177-1993)."""
    xyz = np.stack([_xyz(*chromaticities[index : index + 2]) for index in (0, 2, 4)], axis=1)
    return xyz * np.linalg.solve(xyz, _xyz(*chromaticities[6:]))


def _xyz(x: float, y: float) -> np.ndarray:
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


def matrix_to_rec709(chromaticities) -> np.ndarray:
    """Matrix (3, 3) from linear RGB with these `chromaticities` (8,) to linear Rec.709; white stays white."""
    rec709 = CHROMATICITIES["Linear Rec.709"]
    gains = (BRADFORD @ _xyz(*rec709[6:])) / (BRADFORD @ _xyz(*chromaticities[6:]))
    adapted = np.linalg.solve(BRADFORD, gains[:, None] * BRADFORD)
    return np.linalg.solve(rgb_to_xyz(rec709), adapted @ rgb_to_xyz(chromaticities))


def identified(matrix, name: str = "") -> ColorSpace:
    """The color space with this `matrix` (3, 3) to linear Rec.709, named after a known space with the same matrix.

    For other matrices it has the `name` from the file.
    """
    for known, chromaticities in CHROMATICITIES.items():
        if np.abs(np.asarray(matrix) - matrix_to_rec709(chromaticities)).max() < SAME_MATRIX:
            return ColorSpace(known, matrix)
    return ColorSpace(name or "a space of a custom OpenColorIO configuration", matrix)


def chromaticities(space: ColorSpace) -> tuple[float, ...]:
    """xy of red, green, blue and white (8,): the published ones, else those of the matrix and the white of Rec.709."""
    if space.name in CHROMATICITIES:
        return CHROMATICITIES[space.name]
    rec709 = CHROMATICITIES["Linear Rec.709"]
    xyz = rgb_to_xyz(rec709) @ space.to_rec709
    xy = xyz[:2] / xyz.sum(axis=0)
    return (*(float(value) for value in xy.T.ravel()), *rec709[6:])


LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # linear Rec.709, ITU-R BT.709
_WHITE = 0.9  # value to which the bright end of the reference is scaled
_BRIGHT_PERCENTILE = 99.0


def luminance(color: np.ndarray) -> np.ndarray:
    """Rec.709 luminance (...) of linear color (..., 3)."""
    return np.asarray(color, dtype=np.float64) @ LUMINANCE_WEIGHTS


def exposure_factor(reference: np.ndarray) -> float:
    """Factor that scales the 99th percentile of the luminance of lit pixels of `reference` (..., 3) to 0.9.

    It is 1 if no pixel is lit. NaN and Inf are left out.
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
    """sRGB colors (H, W, 3) in [0, 1] of errors (H, W), or (H, W, 3) by their luminance; clamped to +-scale.

    NaN and Inf are magenta, a color that no error has.
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


_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write `image` (H, W, 3) uint8, sRGB, row 0 on top, atomically.

    Raises ValueError for another shape or type, OSError if the file cannot be written.
    """
    write_bytes(path, encode_png(image))


def encode_png(image: np.ndarray) -> bytes:
    """The bytes of a PNG file of `image` (H, W, 3) uint8, or (H, W, 4) with alpha and numbers that are no colors."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8 or not 0 < min(image.shape[:2]):
        raise ValueError(
            f"PNG: expected an image (height, width, 3 or 4) of uint8, found {image.shape} of {image.dtype}"
        )
    height, width = image.shape[:2]
    # 8 bits, RGB or RGBA, deflate, adaptive, not interlaced
    header = struct.pack(">IIBBBBB", width, height, 8, 2 if image.shape[2] == 3 else 6, 0, 0, 0)
    pixels = zlib.compress(_filtered(image).tobytes(), 6)
    perceptual = b"\0"
    color = [(b"sRGB", perceptual)] if image.shape[2] == 3 else []
    file, chunks = _SIGNATURE, [(b"IHDR", header), *color, (b"IDAT", pixels), (b"IEND", b"")]
    for kind, data in chunks:
        file += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return file


def _filtered(image: np.ndarray) -> np.ndarray:
    """Rows (H, 1 + C W) of PNG's filter 1: its number, then differences from the pixel to the left, modulo 256.

    Choosing a filter for every row would make photographs 2 % smaller and sheets 2 % larger.
    """
    height, width, channels = image.shape
    rows = np.ones((height, 1 + channels * width), dtype=np.uint8)
    rows[:, 1:] = np.diff(image, axis=1, prepend=np.zeros((height, 1, channels), np.uint8)).reshape(height, -1)
    return rows


# Lobes of the CIE 1931 color matching functions: rows of a height, a wavelength in nm, and the widths below and above.
_X = ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2))
_Y = ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1))
_Z = ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8))
# HOTTEST: in K. Hotter bodies have the same color in Cycles.
HOTTEST = 12000.0


def blackbody(temperature: float) -> np.ndarray:
    """The color (3,) of a black body of so many K, linear Rec.709 of luminance 1, within 2 % of Cycles' from 2000 K on.

    The color matching functions are sums of lobes (Wyman, Sloan and Shirley 2013, JCGT 2(2)).
    """
    wavelength = np.arange(380.0, 780.0, 5.0)
    exponent = 1.4387769e7 / (wavelength * min(max(temperature, 100.0), HOTTEST))  # that of Planck's law
    spectrum = wavelength**-5.0 * np.exp(-exponent) / -np.expm1(-exponent)
    weights = [
        sum(
            height * np.exp(-0.5 * ((wavelength - at) / np.where(wavelength < at, below, above)) ** 2)
            for height, at, below, above in lobes
        )
        for lobes in (_X, _Y, _Z)
    ]
    xyz = np.array(weights) @ spectrum
    return np.maximum(np.linalg.solve(rgb_to_xyz(CHROMATICITIES["Linear Rec.709"]), xyz / xyz[1]), 0.0)
