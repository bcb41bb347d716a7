"""Measures a lookup table where a renderer uses it, between the nodes: `python -m ltsh_addon tables validate`.

The quadrature shares nothing with the fit. Two sets of points are combined by the balance heuristic (Veach 1997):
visible normals of GGX (Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"), and points that
crowd at the horizon and at the plane of incidence. The second set matters: a linearly transformed lobe can hide a
needle at the horizon that samples of the BRDF alone never see.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from ltsh_addon.shading import brdf, evaluate_lobe
from ltsh_addon.shading.lookup_table import LookupTable


@dataclass(frozen=True)
class TableStatistics:
    """Relative L2 error over the upper hemisphere, relative albedo error and relative negative mass."""

    mean: float
    median: float
    percentile_90: float
    maximum: float
    albedo_mean: float
    albedo_maximum: float
    negative_mass_mean: float
    negative_mass_maximum: float

    def to_dict(self) -> dict:
        return asdict(self)


def validate(table: LookupTable, count: int = 28, roughness=(0.1, 1.0), max_theta=88.0) -> TableStatistics:
    """Statistics over count x count cell-centered points of (roughness, theta_o in degrees)."""
    center = (np.arange(count) + 0.5) / count
    rough = roughness[0] + center * (roughness[1] - roughness[0])
    cosine = np.cos(np.radians(center * max_theta))
    errors, albedo, negative = [], [], []
    for value in rough:
        for mu in cosine:
            directions, weights = (part[0] for part in hemisphere_samples(np.array([mu]), np.array([value**2])))
            lobe = brdf.ggx_brdf_cosine(mu, value**2, directions)
            fitted = evaluate_lobe(table, np.array([mu]), np.array([value]), directions[None])[0]
            errors.append(np.sqrt((weights * (fitted - lobe) ** 2).sum() / (weights * lobe**2).sum()))
            mass = (weights * lobe).sum()
            albedo.append(abs((weights * fitted).sum() / mass - 1.0))
            negative.append((weights * np.maximum(-fitted, 0.0)).sum() / mass)
    errors, albedo, negative = (np.array(values) for values in (errors, albedo, negative))
    return TableStatistics(
        float(errors.mean()),
        float(np.median(errors)),
        float(np.quantile(errors, 0.9)),
        float(errors.max()),
        float(albedo.mean()),
        float(albedo.max()),
        float(negative.mean()),
        float(negative.max()),
    )


def hemisphere_samples(cos_theta_o, alpha, radial: int = 56, angular: int = 56, horizon: int = 40):
    """Directions (P, S, 3) with y > 0 and weights (P, S), for cos_theta_o (P,) and alpha (P,).

    The weighted sum of a function that is even in y is its integral over the upper hemisphere; S = radial * angular +
    horizon * (3 horizon / 2). Directions below the horizon have weight 0.
    """
    visible, visible_share = _visible_normal_samples(cos_theta_o, alpha, radial, angular)
    low, low_share = _horizon_samples(horizon)
    count = len(cos_theta_o)
    directions = np.concatenate([visible, np.broadcast_to(low, (count, *low.shape))], axis=1)
    share = np.concatenate([visible_share, low_share])
    density = _visible_normal_density(cos_theta_o, alpha, directions) + _horizon_density(directions)
    return directions, np.where(directions[..., 2] > 0.0, share / density, 0.0)


def _unit_interval(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def _visible_normal_samples(cos_theta_o, alpha, radial, angular):
    u, u_weights = _unit_interval(radial)
    azimuth = (np.arange(angular) + 0.5) / angular * np.pi
    u, azimuth = (grid.ravel() for grid in np.meshgrid(u, azimuth, indexing="ij"))
    sin_o = np.sqrt(1.0 - cos_theta_o**2)
    stretched = np.stack([alpha * sin_o, cos_theta_o], axis=0) / np.hypot(alpha * sin_o, cos_theta_o)
    z = (1.0 - u) * (1.0 + stretched[1][:, None]) - stretched[1][:, None]
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    half = np.stack(
        [
            alpha[:, None] * (radius * np.cos(azimuth) + stretched[0][:, None]),
            alpha[:, None] * radius * np.sin(azimuth),
            z + stretched[1][:, None],
        ],
        axis=-1,
    )
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    view = np.stack([sin_o, np.zeros_like(sin_o), cos_theta_o], axis=-1)[:, None]
    directions = 2.0 * (half * view).sum(axis=-1, keepdims=True) * half - view
    return directions, np.repeat(u_weights, angular) / angular


def _visible_normal_density(cos_theta_o, alpha, directions):
    """Density of the reflected direction: G1(o) D(h) / (4 cos_theta_o), Walter et al. 2007 and Heitz 2018."""
    mu, alpha_squared = cos_theta_o[:, None], (alpha**2)[:, None]
    view = np.stack([np.sqrt(1.0 - cos_theta_o**2), np.zeros_like(cos_theta_o), cos_theta_o], axis=-1)[:, None]
    half = directions + view
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    slope = half[..., 0] ** 2 + half[..., 1] ** 2 + alpha_squared * half[..., 2] ** 2
    return alpha_squared / np.pi / slope**2 / (2.0 * (mu + np.sqrt(mu**2 + alpha_squared * (1.0 - mu**2))))


def _horizon_samples(count):
    u, weights = _unit_interval(count)
    azimuths = count + count // 2
    azimuth = 0.5 * np.pi * (1.0 - np.cos(np.pi * (np.arange(azimuths) + 0.5) / azimuths))
    z, azimuth = (grid.ravel() for grid in np.meshgrid(u * u, azimuth, indexing="ij"))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    return directions, np.repeat(weights, azimuths) / azimuths


def _horizon_density(directions):
    z = np.maximum(directions[..., 2], 1e-12)
    azimuth = np.arctan2(np.abs(directions[..., 1]), directions[..., 0])
    # azimuth = pi/2 (1 - cos(pi s)), s uniform; half of the density for either sign of y
    crowding = np.maximum(2.0 / np.pi * np.sqrt(np.maximum(azimuth * (np.pi - azimuth), 0.0)), 1e-9)
    return 0.5 / (2.0 * np.sqrt(z)) / (0.5 * np.pi**2 * crowding)
