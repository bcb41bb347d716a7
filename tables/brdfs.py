"""BRDFs that tables can be fitted to. One is two functions: its values, and quadrature points that see its peak."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from ltsh_addon.shading import brdf

from .hemisphere_quadrature import polar_samples


@dataclass(frozen=True)
class Brdf:
    """An isotropic reflection lobe of one parameter, alpha = roughness^2, with F = 1."""

    name: str
    description: str
    # BRDF times cosine: cos_theta_o (P,), alpha (P,), unit directions (P, S, 3) -> (P, S) in sr^-1
    value: Callable
    # cos_theta_o (P,), alpha (P,), counts -> directions (P, S, 3) with y > 0, weights (P, S): `hemisphere_quadrature`
    samples: Callable
    # GGX times cosine becomes a warped clamped cosine as alpha -> 0: A = B = C = 1 is then the known limit.
    cosine_limit: bool = False


def beckmann_cosine(cos_theta_o, alpha, directions):
    """Beckmann BRDF times cosine with F = 1, height-correlated Smith masking-shadowing; as `brdf.ggx_brdf_cosine`.

    Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces", eq. 25; the masking is Heitz 2014,
    "Understanding the Masking-Shadowing Function", eq. 72 and 99, with the error function instead of its rational fit.
    """
    mu_o, alpha = np.asarray(cos_theta_o)[..., None], np.asarray(alpha)[..., None]
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    half_x, half_z = x + np.sqrt(np.maximum(1.0 - mu_o * mu_o, 0.0)), z + mu_o
    horizontal, vertical = half_x * half_x + y * y, np.maximum(half_z * half_z, 1e-300)
    slope = horizontal / (vertical * alpha * alpha)
    distribution = np.exp(-slope) * ((horizontal + vertical) / (vertical * alpha)) ** 2 / np.pi
    mu_i = np.maximum(z, 1e-12)
    masking = 1.0 / (1.0 + _beckmann_lambda(mu_i, alpha) + _beckmann_lambda(mu_o, alpha))
    return np.where(z > 0.0, distribution * masking / (4.0 * np.maximum(mu_o, 1e-12)), 0.0)


def _beckmann_lambda(mu, alpha):
    slope = mu / (alpha * np.sqrt(np.maximum(1.0 - mu * mu, 1e-30)))
    return 0.5 * (erf(slope) - 1.0) + np.exp(-slope * slope) / (2.0 * np.sqrt(np.pi) * slope)


GGX = Brdf(
    "ggx",
    "GGX, height-correlated Smith masking-shadowing, alpha = roughness^2, times cosine",
    brdf.ggx_brdf_cosine,
    polar_samples,
    cosine_limit=True,
)
BECKMANN = Brdf(
    "beckmann",
    "Beckmann, height-correlated Smith masking-shadowing, alpha = roughness^2, times cosine",
    beckmann_cosine,
    polar_samples,
)
BRDFS = {model.name: model for model in (GGX, BECKMANN)}
