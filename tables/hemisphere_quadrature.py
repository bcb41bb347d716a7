"""Quadrature over the upper hemisphere for functions that peak at the mirror direction."""

from __future__ import annotations

import numpy as np


def polar_samples(cos_theta_o, alpha, radial: int = 28, angular: int = 28):
    """Directions (P, S, 3) with y > 0 and weights (P, S) for cos_theta_o (P,) and alpha (P,).

    The weighted sum of a function that is even in y is its integral over the upper hemisphere. The plane x = 0 cuts it
    in two; each half has polar coordinates of its own, around the mirror direction and around the view direction: at
    grazing angles a warped lobe can wrap around, and what it then does near the horizon under the view must be seen.
    The angle r to the pole crowds there like sinh on the scale of the lobe. Every ray ends at the horizon or at the
    plane between the halves, on either side of azimuth 90 degrees, so that the integrand is smooth on it.
    The half of the view direction has a third of the S points, about radial * angular * 3 / 2.
    """
    mirror = _half(cos_theta_o, alpha, radial, angular // 2)
    view = _half(cos_theta_o, alpha, (2 * radial + 2) // 3, (3 * angular + 4) // 8)
    view[0][..., 0] *= -1.0
    return tuple(np.concatenate(parts, axis=1) for parts in zip(mirror, view, strict=True))


def _half(cos_theta_o, alpha, radial, angular):
    """Points of the half x < 0: `radial` on each ray, `angular` rays toward x = 0 and as many toward the horizon."""
    sin_o = np.sqrt(1.0 - cos_theta_o**2)
    zero = np.zeros_like(sin_o)
    axis = np.stack([-sin_o, zero, cos_theta_o], axis=-1)[:, None, None]
    up = np.stack([cos_theta_o, zero, sin_o], axis=-1)[:, None, None]
    quarter, quarter_weights = gauss_legendre(angular, 0.5 * np.pi)
    azimuth = np.concatenate([quarter, np.pi - quarter])
    azimuth_weights = np.concatenate([quarter_weights, quarter_weights])
    cosine, mu, sine = np.abs(np.cos(azimuth)), cos_theta_o[:, None], sin_o[:, None]
    reach = np.where(azimuth < 0.5 * np.pi, np.arctan2(sine, cosine * mu), np.arctan2(mu, cosine * sine))
    nodes, weights = gauss_legendre(radial, 1.0)
    scale = (0.3 * alpha)[:, None, None]
    stretch = np.arcsinh(reach[..., None] / scale)
    r = scale * np.sinh(stretch * nodes)
    measure = 2.0 * np.sin(r) * scale * np.cosh(stretch * nodes) * stretch * weights * azimuth_weights[:, None]
    side = np.cos(azimuth)[:, None, None] * up + np.sin(azimuth)[:, None, None] * np.array([0.0, 1.0, 0.0])
    directions = np.cos(r)[..., None] * axis + np.sin(r)[..., None] * side
    count = len(alpha)
    return directions.reshape(count, -1, 3), measure.reshape(count, -1)


def gauss_legendre(count: int, length: float = 1.0):
    """Nodes and weights (count,) of the Gauss-Legendre rule on [0, length]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * length * (nodes + 1.0), 0.5 * length * weights
