"""The real, orthonormal spherical harmonics that are even in y: THE convention of this package.

Y_lm = K_lm * P_l^(m)(z) * Re((x + i y)^m), m = 0..l, where P_l^(m) is the m-th derivative of the Legendre polynomial
(no Condon-Shortley phase) and K_lm = sqrt((2 - [m = 0]) (2 l + 1) (l - m)! / (4 pi (l + m)!)). Coefficients are ordered
(0,0), (1,0), (1,1), (2,0), (2,1), (2,2), ... The BRDF is mirror-symmetric in y, so sine terms never appear.
"""

from functools import cache
from math import factorial, isqrt, pi, sqrt

import numpy as np


def coefficient_count(degree: int) -> int:
    """Number of basis functions (l, m) with 0 <= m <= l <= degree."""
    return (degree + 1) * (degree + 2) // 2


def degree_of(count: int) -> int:
    """The degree that has `count` basis functions."""
    return (isqrt(8 * count + 1) - 3) // 2


def coefficient_index(l: int, m: int) -> int:  # noqa: E741 (the field's letter)
    """Position of (l, m) in a coefficient vector."""
    return l * (l + 1) // 2 + m


def normalization(l: int, m: int) -> float:  # noqa: E741
    """K_lm of the module's formula."""
    return sqrt((1 if m == 0 else 2) * (2 * l + 1) * factorial(l - m) / (4.0 * pi * factorial(l + m)))


def evaluate(degree: int, directions: np.ndarray) -> np.ndarray:
    """Values (K, ...) of all basis functions up to `degree` at unit directions (..., 3).

    Allmenroeder and Peters 2021, section 2, without the odd functions.
    """
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    basis = np.empty((coefficient_count(degree), *x.shape), dtype=directions.dtype)
    real, imaginary = np.ones_like(x), np.zeros_like(x)
    for m in range(degree + 1):
        if m > 0:
            real, imaginary = x * real - y * imaginary, x * imaginary + y * real
        double_factorial = float(np.prod(np.arange(2 * m - 1, 0, -2)))
        previous, legendre = np.zeros_like(x), np.full_like(x, double_factorial)
        for l in range(m, degree + 1):  # noqa: E741
            if l > m:
                # (l - m) Q_l = (2 l - 1) z Q_{l-1} - (l + m - 1) Q_{l-2} for Q_l = P_l^(m)
                previous, legendre = legendre, ((2 * l - 1) * z * legendre - (l + m - 1) * previous) / (l - m)
            basis[coefficient_index(l, m)] = normalization(l, m) * legendre * real
    return basis


@cache
def hemisphere_integrals(degree: int) -> np.ndarray:
    """Integrals (K,) of the basis functions over the hemisphere z >= 0: the albedo of a unit coefficient."""
    nodes, weights = np.polynomial.legendre.leggauss(degree + 1)
    z, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    directions = np.stack([np.sqrt(1.0 - z * z), np.zeros_like(z), z], axis=-1)
    values = evaluate(degree, directions) @ weights * 2.0 * pi
    zonal = np.array([m == 0 for l in range(degree + 1) for m in range(l + 1)])  # noqa: E741
    return np.where(zonal, values, 0.0)
