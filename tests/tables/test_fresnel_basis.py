"""The Fresnel curves of the tables reproduce the reflectance of dielectrics."""

import numpy as np
import pytest
import textbook

from ltsh_addon.shading import SHIPPED_TABLES, load_table
from tables.projection import COSINES, TABULATED_IOR, combine, fresnel_basis


@pytest.fixture(scope="module")
def basis():
    """(curves, weights) with few sweeps: the iteration starts from a singular value decomposition, which is close."""
    return fresnel_basis(sweeps=30)


def relative_error(curves, weights, ior, lowest, highest):
    chosen = (ior >= lowest) & (ior <= highest)
    exact = textbook.dielectric_fresnel(COSINES, ior[chosen][:, None])
    return np.abs(weights[chosen] @ curves / exact - 1.0).max()


def test_dielectrics_are_within_one_percent_at_every_angle(basis):
    assert relative_error(*basis, TABULATED_IOR, 1.1, 3.0) < 0.01
    assert relative_error(*basis, TABULATED_IOR, 3.0, 4.0) < 0.02


@pytest.mark.parametrize("name", SHIPPED_TABLES)
def test_shipped_tables_are_within_one_percent_at_every_angle(name):
    table = load_table(name)
    assert relative_error(table.fresnel_curves, table.fresnel_weights, table.fresnel_ior, 1.1, 3.0) < 0.01


def test_all_shipped_tables_have_the_same_curves():
    first, *others = (load_table(name) for name in SHIPPED_TABLES)
    for other in others:
        for field in ("fresnel_curves", "fresnel_ior", "fresnel_weights"):
            # Fitted on several machines, which round differently.
            assert np.allclose(getattr(first, field), getattr(other, field), rtol=0.0, atol=1e-6), field


def test_a_combination_of_the_curves_is_found_again(basis):
    curves, _ = basis
    wanted = np.array([[0.3, 0.4, 0.0, 0.0, 0.0], [0.05, 0.95, 0.1, -0.02, 0.01]])
    # The damping of 1e-12 times the trace moves weights along directions that hardly matter for the reflectance.
    assert np.abs(combine(curves, wanted @ curves) @ curves - wanted @ curves).max() < 1e-6


def test_metals_with_an_f82_tint_are_exact(basis):
    """Reflectance 1 - B at c = 1/7, that is 82 degrees, F0 = 1: the definition of the tint (Kutz et al. 2021)."""
    curves, _ = basis
    cosine, tint = 1.0 / 7.0, 0.3
    curve = np.array([np.interp(cosine, COSINES, values) for values in curves[:3]])
    b = (1.0 - tint) / (cosine * (1.0 - cosine) ** 6)
    assert curve @ [1.0, 0.0, -b] == pytest.approx(tint, abs=2e-3)
    for f0 in (0.2, 0.9):
        wanted = f0 + (1.0 - f0) * (1.0 - COSINES) ** 5 - 0.4 * COSINES * (1.0 - COSINES) ** 6
        assert np.abs(np.array([f0, 1.0 - f0, -0.4]) @ curves[:3] - wanted).max() < 1e-15


def test_an_ior_of_one_reflects_nothing(basis):
    curves, weights = basis
    assert TABULATED_IOR[0] == 1.0
    assert np.abs(weights[0] @ curves).max() < 1e-12
