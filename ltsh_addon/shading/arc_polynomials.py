"""Factors of the edges of spherical polygons that depend on their length theta alone, in single precision."""

from __future__ import annotations

from functools import cache

import numpy as np

_PHI_DEGREE, _PSI_DEGREE = 7, 8


@cache
def _arc_polynomials() -> tuple[np.ndarray, np.ndarray]:
    """Coefficients in s = sqrt(1 + cos theta), highest power first, of s theta / sin(theta) and of s psi.

    psi = (theta / sin(theta) - 1) / (1 - cos theta). Interpolated at Chebyshev points; relative errors 8e-7 and 6e-7.
    """

    def phi(s):
        return s * _phi(s)

    def psi(s):
        rest = 2.0 - s * s
        small = rest < 1e-3
        return s * np.where(small, 1.0 / 3.0 + 2.0 / 15.0 * rest, (_phi(s) - 1.0) / np.where(small, 1.0, rest))

    domain = [0.0, np.sqrt(2.0)]
    fits = [
        np.polynomial.Chebyshev.interpolate(function, degree, domain=domain).convert(kind=np.polynomial.Polynomial)
        for function, degree in ((phi, _PHI_DEGREE), (psi, _PSI_DEGREE))
    ]
    return tuple(fit.coef[::-1].astype(np.float32) for fit in fits)


def _phi(s):
    cosine = np.clip(s * s - 1.0, -1.0, 1.0)
    theta = 2.0 * np.arctan2(np.sqrt(1.0 - cosine), np.sqrt(1.0 + cosine))
    return np.where(theta > 0.0, theta / np.where(theta > 0.0, np.sin(theta), 1.0), 1.0)


def _horner(coefficients, variable, out):
    np.multiply(variable, coefficients[0], out=out)
    for coefficient in coefficients[1:-1]:
        out += coefficient
        out *= variable
    out += coefficients[-1]
    return out


def phi_of(shifted, scratch):
    """theta / sin(theta) of edges with 1 + cos(theta) in `shifted` (V, P)."""
    root = np.sqrt(shifted, out=scratch("root", shifted.shape))
    phi = _horner(_arc_polynomials()[0], root, scratch("phi", shifted.shape))
    phi /= root
    return phi


class ArcFactors:
    """What all ridges share: phi, q = 1 / (1 + cos), psi, q (1 + psi) / 2 and (q + 1) / 3; None where unused."""

    def __init__(self, degree, shifted, scratch):
        shape = shifted.shape
        self.q = self.psi = self.square = self.cube = None
        if degree < 3:
            self.phi = phi_of(shifted, scratch)
        else:
            root = np.sqrt(shifted, out=scratch("root", shape))
            self.psi = _horner(_arc_polynomials()[1], root, scratch("psi", shape))
            self.psi /= root
            self.phi = np.subtract(np.float32(2.0), shifted, out=scratch("phi", shape))
            self.phi *= self.psi
            self.phi += np.float32(1.0)
        if degree > 1:
            self.q = np.divide(np.float32(1.0), shifted, out=scratch("q", shape))
        if degree > 2:
            self.square = np.add(self.psi, np.float32(1.0), out=scratch("square", shape))
            self.square *= self.q
            self.square *= np.float32(0.5)
        if degree > 3:
            self.cube = np.add(self.q, np.float32(1.0), out=scratch("cube", shape))
            self.cube *= np.float32(1.0 / 3.0)
