"""GGX microfacet reflection and Fresnel curves, in the local frame (see the package's conventions)."""

from __future__ import annotations

import numpy as np


def ggx_brdf_cosine(cos_theta_o, alpha, directions):
    """Single-scatter GGX BRDF times cosine with F = 1, in sr^-1; 0 below the horizon.

    cos_theta_o (...), alpha = roughness^2 (...), directions (..., S, 3) unit -> (..., S). Height-correlated Smith
    masking-shadowing (Heitz 2014, "Understanding the Masking-Shadowing Function", eq. 99; Walter et al. 2007, eq. 33).
    Written with S(mu) = sqrt(mu^2 + alpha^2 (1 - mu^2)), so that nothing is divided by a vanishing cosine:
    f cos = D(h) mu_i / (2 (mu_o S(mu_i) + mu_i S(mu_o))).
    """
    mu_o = np.asarray(cos_theta_o)[..., None]
    alpha = np.asarray(alpha)[..., None]
    alpha_squared = alpha * alpha
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    half_x = x + np.sqrt(np.maximum(1.0 - mu_o * mu_o, 0.0))
    half_z = z + mu_o
    distribution = ggx_distribution(half_x * half_x + y * y, half_z * half_z, alpha_squared)
    mu_i = np.maximum(z, 0.0)
    return distribution * mu_i / (2.0 * np.maximum(masking(mu_o, mu_i, alpha_squared), 1e-300))


def masking(mu_o, mu_i, alpha_squared):
    """mu_o S(mu_i) + mu_i S(mu_o), see `ggx_brdf_cosine`; broadcasts."""
    return mu_o * _slope_length(mu_i, alpha_squared) + mu_i * _slope_length(mu_o, alpha_squared)


def ggx_distribution(horizontal, vertical, alpha_squared):
    """D(h) of GGX in sr^-1 for half vectors of any length (Walter et al. 2007, eq. 33); broadcasts.

    horizontal = h_x^2 + h_y^2 and vertical = h_z^2: D = alpha^2 |h|^4 / (pi (horizontal + alpha^2 vertical)^2).
    """
    ratio = (horizontal + vertical) / np.maximum(horizontal + alpha_squared * vertical, 1e-30)
    return alpha_squared / np.pi * ratio * ratio


def visible_normal_density(cos_theta_o, horizontal, vertical, alpha_squared):
    """Density in sr^-1 with which directions are chosen by reflection at visible normals: G1(o) D(h) / (4 cos theta_o).

    Heitz 2018, "Sampling the GGX Distribution of Visible Normals", eq. 17 and 18; cos_theta_o > 0, the half vectors as
    for `ggx_distribution`; broadcasts.
    """
    distribution = ggx_distribution(horizontal, vertical, alpha_squared)
    return distribution / (2.0 * (cos_theta_o + _slope_length(cos_theta_o, alpha_squared)))


def _slope_length(mu, alpha_squared):
    return np.sqrt(mu * mu + alpha_squared * (1.0 - mu * mu))


def half_angle_cosine(cos_theta_o, directions):
    """Cosine (..., S) of the angle between the half vector and either direction; arguments as `ggx_brdf_cosine`."""
    mu_o = np.asarray(cos_theta_o)[..., None]
    sin_o = np.sqrt(np.maximum(1.0 - mu_o * mu_o, 0.0))
    cosine = directions[..., 0] * sin_o + directions[..., 2] * mu_o
    return np.sqrt(np.clip(0.5 * (1.0 + cosine), 0.0, 1.0))


def schlick_curve(cosine):
    """(1 - c)^5 (Schlick 1994): the reflectance is f0 + (f90 - f0) (1 - c)^5."""
    complement = 1.0 - cosine
    squared = complement * complement
    return squared * squared * complement


def f82_reflectance(cosine, f0, f90, dip):
    """f0 + (f90 - f0) (1 - c)^5 - dip c (1 - c)^6, which may be negative; broadcasts."""
    return f0 + schlick_curve(cosine) * (f90 - f0 - dip * cosine * (1.0 - cosine))


def clipped_metals(samples):
    """Mask (P,) of the samples that are F82 metals alone, and clipped at 0 where their reflectance falls below."""
    if not samples.specular_dip.any():
        return np.zeros(len(samples), bool)
    return is_clipped(samples.specular_f0, samples.specular_f90, samples.specular_dip) & ~samples.dielectric.any(axis=1)


def is_clipped(f0, f90, dip):
    """Where (P,) the reflectance of F82 metals, each (P, 3), falls below 0 at some angle."""
    found = np.zeros(len(f0), bool)
    at = np.nonzero((dip > 0.0).any(axis=-1))[0]
    cosines = np.linspace(0.0, 1.0, 33)[:, None, None]
    if len(at):
        found[at] = f82_reflectance(cosines, f0[at], f90[at], dip[at]).min(axis=(0, 2)) < 0.0
    return found


def dielectric_reflectance(cosine, ior):
    """Exact unpolarized Fresnel reflectance of a dielectric of relative `ior`, with total reflection below 1;
    broadcasts."""
    cosine = np.asarray(cosine)
    g = np.sqrt(np.maximum(ior * ior - 1.0 + cosine * cosine, 0.0))
    # At cosine 0 without refraction (ior 1) the quotient is 0 / 0; its limit along cosine -> 0 is 0.
    perpendicular = (g - cosine) / np.maximum(g + cosine, 1e-30)
    plus, minus = cosine * (g + cosine) - 1.0, cosine * (g - cosine) + 1.0
    return 0.5 * perpendicular * perpendicular * (1.0 + (plus / minus) ** 2)
