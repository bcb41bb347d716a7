"""The spherical harmonics basis: orthonormal, signed and ordered as its module says."""

import numpy as np
import pytest
from scipy.special import sph_harm_y

from ltsh_addon.lobes import spherical_harmonics

DEGREE = 8
PAIRS = [(degree, order) for degree in range(DEGREE + 1) for order in range(degree + 1)]


def hemisphere_rule(degree):
    """Directions (Q, 3) and weights (Q,) exact for polynomials up to `degree` on the upper half of the sphere."""
    nodes, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    azimuth = 2.0 * np.pi * np.arange(degree + 1) / (degree + 1)
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, azimuth, indexing="ij"))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    return directions, np.repeat(weights, degree + 1) * 2.0 * np.pi / (degree + 1)


def random_directions(count, seed=3):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_basis_is_the_even_half_of_the_usual_one():
    """sqrt(2) Re Y_l^m of scipy without its Condon-Shortley sign (-1)^m; scipy's own error is below 1e-13."""
    directions = random_directions(200)
    polar = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    basis = spherical_harmonics.evaluate(DEGREE, directions)
    indices = [spherical_harmonics.coefficient_index(*pair) for pair in PAIRS]
    assert indices == list(range(spherical_harmonics.coefficient_count(DEGREE)))
    for degree, order in PAIRS:
        usual = sph_harm_y(degree, order, polar, azimuth).real * (-1) ** order * (np.sqrt(2.0) if order else 1.0)
        row = basis[spherical_harmonics.coefficient_index(degree, order)]
        assert np.abs(row - usual).max() < 2e-13, (degree, order)


@pytest.mark.parametrize("degree", range(DEGREE + 1))
def test_hemisphere_integrals(degree):
    directions, weights = hemisphere_rule(DEGREE)
    expected = spherical_harmonics.evaluate(degree, directions) @ weights
    assert np.abs(spherical_harmonics.hemisphere_integrals(degree) - expected).max() < 1e-13
