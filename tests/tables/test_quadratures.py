"""The quadratures of the fit and of the validation agree with exact integrals and with each other."""

import numpy as np
import pytest

from ltsh_addon.shading import brdf
from tables.brdfs import polar_samples
from tables.validate import hemisphere_samples

COSINE = np.array([1.0, 0.7, 0.4, 0.2, 0.05])
ALPHA = np.array([0.3, 0.04, 1.0, 0.36, 0.1])
# Relative errors: the fit's rule is Gauss-Legendre along rays; the other one mixes two sets, midpoint in azimuth.
RULES = [(polar_samples, 3e-4), (hemisphere_samples, 3e-3)]

rules = pytest.mark.parametrize("rule, tolerance", RULES, ids=["fit", "validation"])


@rules
def test_moments_of_the_hemisphere(rule, tolerance):
    directions, weights = rule(COSINE, ALPHA)
    x, y, z = np.moveaxis(directions, -1, 0)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1.0, abs=1e-12)
    assert (weights >= 0.0).all() and y.min() >= 0.0 and z[weights > 0.0].min() >= 0.0
    for values, exact in [(1.0, 2.0 * np.pi), (z, np.pi), (z * z, 2.0 * np.pi / 3.0), (x * x, 2.0 * np.pi / 3.0)]:
        assert (weights * values).sum(axis=1) == pytest.approx(exact, rel=tolerance)


@rules
def test_directional_albedo_of_ggx(rule, tolerance):
    """Against a tensor rule that knows nothing of the lobe, on surfaces rough enough for it."""
    nodes, node_weights = np.polynomial.legendre.leggauss(300)
    z, phi = (grid.ravel() for grid in np.meshgrid(0.5 * (nodes + 1.0), 0.5 * np.pi * (nodes + 1.0), indexing="ij"))
    radius = np.sqrt(1.0 - z * z)
    tensor = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    tensor_weights = np.outer(node_weights, node_weights).ravel() * 0.5 * np.pi
    cosine, alpha = np.array([1.0, 0.7, 0.4, 0.2]), np.array([0.3, 0.2, 1.0, 0.36])
    directions, weights = rule(cosine, alpha)
    found = (weights * brdf.ggx_brdf_cosine(cosine, alpha, directions)).sum(axis=1)
    expected = [brdf.ggx_brdf_cosine(mu, a, tensor) @ tensor_weights for mu, a in zip(cosine, alpha, strict=True)]
    assert found == pytest.approx(expected, rel=tolerance)


def test_the_fit_sees_needles_under_the_view():
    """A lobe that wraps around to a needle at the horizon below the view direction: against ten times the points."""
    cosine, alpha = np.array([np.cos(np.radians(86.4))]), np.array([0.06])
    norms = []
    for counts in [(28, 28), (90, 120)]:
        directions, weights = polar_samples(cosine, alpha, *counts)
        x, y, z = np.moveaxis(directions, -1, 0)
        needle = np.exp(-((y / 0.05) ** 2) - (z / 0.03) ** 2) * (x > 0.0)
        norms.append((weights * needle**2).sum())
    assert norms[0] == pytest.approx(norms[1], rel=0.02)


def test_sharp_lobes_are_integrated_too():
    """Both rules, from roughness 0.03 on; smooth surfaces seen from above reflect nearly everything."""
    cosine, alpha = np.array([0.9, 0.5, 0.3]), np.array([1e-3, 1e-3, 3e-3])
    albedos = []
    for rule, _ in RULES:
        directions, weights = rule(cosine, alpha)
        albedos.append((weights * brdf.ggx_brdf_cosine(cosine, alpha, directions)).sum(axis=1))
    assert albedos[0] == pytest.approx(albedos[1], rel=3e-3)
    assert albedos[0] == pytest.approx(1.0, abs=3e-3)
