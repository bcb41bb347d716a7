"""Linear RGB spaces: which one a matrix belongs to, and the chromaticities that an EXR header states."""

from __future__ import annotations

import numpy as np

from ..scene import ColorSpace

# xy of red, green, blue and white. Sources: ITU-R BT.709 and BT.2020; SMPTE ST 2065-1 and Academy S-2014-004 (ACEScg).
CHROMATICITIES = {
    "Linear Rec.709": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "Linear Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "ACES2065-1": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
}
# The cone responses of Bradford (Lam 1985), in which white points are made equal.
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# Entries of a matrix to Rec.709 that differ by less are the same: white points are published with 4 or 5 digits.
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
    """The color space whose `matrix` (3, 3) to linear Rec.709 is known: named after the matrix where that is known too.

    `name` is what the file calls it, used for other matrices.
    """
    for known, chromaticities in CHROMATICITIES.items():
        if np.abs(np.asarray(matrix) - matrix_to_rec709(chromaticities)).max() < SAME_MATRIX:
            return ColorSpace(known, matrix)
    return ColorSpace(name or "a space of a custom OpenColorIO configuration", matrix)


def chromaticities(space: ColorSpace) -> tuple[float, ...]:
    """xy of red, green, blue and white (8,): the published ones, or what the matrix says with the white of Rec.709."""
    if space.name in CHROMATICITIES:
        return CHROMATICITIES[space.name]
    rec709 = CHROMATICITIES["Linear Rec.709"]
    xyz = rgb_to_xyz(rec709) @ space.to_rec709
    xy = xyz[:2] / xyz.sum(axis=0)
    return (*(float(value) for value in xy.T.ravel()), *rec709[6:])
