"""Quadrature over the upper hemisphere for functions that peak at the mirror direction."""

from __future__ import annotations

import numpy as np


def polar_samples(cos_theta_o, alpha, radial: int = 28, angular: int = 40):
    """Directions (P, S, 3) with y > 0 and weights (P, S), S = radial * angular, for cos_theta_o (P,) and alpha (P,).

    The weighted sum of a function that is even in y is its integral over the upper hemisphere. Polar coordinates around
    the mirror direction: the angle r crowds at the peak like sinh on the scale of the lobe, and every ray ends at the
    horizon, so that the integrand is smooth on it. 48 x 96 points give the directional albedo of GGX to 5e-5.
    """
    sin_o = np.sqrt(1.0 - cos_theta_o**2)
    zero = np.zeros_like(sin_o)
    axis = np.stack([-sin_o, zero, cos_theta_o], axis=-1)[:, None, None]
    up = np.stack([cos_theta_o, zero, sin_o], axis=-1)[:, None, None]
    azimuth, azimuth_weights = _gauss_legendre(angular, np.pi)
    # cos(r) cos_theta_o + sin(r) cos(azimuth) sin_o is the height; it is positive up to `reach`.
    reach = np.arctan2(cos_theta_o[:, None], -np.cos(azimuth) * sin_o[:, None])
    nodes, weights = _gauss_legendre(radial, 1.0)
    scale = (0.3 * alpha)[:, None, None]
    stretch = np.arcsinh(reach[..., None] / scale)
    r = scale * np.sinh(stretch * nodes)
    measure = 2.0 * np.sin(r) * scale * np.cosh(stretch * nodes) * stretch * weights * azimuth_weights[:, None]
    side = np.cos(azimuth)[:, None, None] * up + np.sin(azimuth)[:, None, None] * np.array([0.0, 1.0, 0.0])
    directions = np.cos(r)[..., None] * axis + np.sin(r)[..., None] * side
    count = len(alpha)
    return directions.reshape(count, -1, 3), measure.reshape(count, -1)


def _gauss_legendre(count, length):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * length * (nodes + 1.0), 0.5 * length * weights
