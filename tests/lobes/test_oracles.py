"""The oracles of this folder, checked where the answer is known in closed form."""

import numpy as np
import polygon_quadrature
import pytest
import textbook

OCTANT = np.eye(3)


def powers(directions):
    """1, z, z^2, x z."""
    x, z = directions[..., 0], directions[..., 2]
    return np.stack([np.ones_like(z), z, z * z, x * z])


@pytest.mark.parametrize("apex", [(0.0, 0.0, 1.0), (0.6, 0.48, 0.64), (0.6, 0.0, 0.8), (0.8, 0.0, 0.6)])
def test_quadrature_over_an_octant_is_exact_for_any_apex(apex):
    expected = [np.pi / 2.0, np.pi / 4.0, np.pi / 6.0, 1.0 / 3.0]
    assert polygon_quadrature.integral(OCTANT, powers, apex) == pytest.approx(expected, abs=1e-13)
    assert polygon_quadrature.integral(OCTANT[::-1], powers, apex) == pytest.approx(-np.array(expected), abs=1e-13)


def test_adaptive_quadrature_meets_its_bound_on_a_narrow_peak():
    """A peak exp(-k (1 - z)) over a cap-like polygon around it: the mass outside the polygon is below 1e-12."""
    angle = 2.0 * np.pi * np.arange(7) / 7
    polygon = np.stack([np.cos(angle), np.sin(angle), np.ones(7)], axis=1)
    k = 2000.0

    def peak(directions):
        return np.exp(-k * (1.0 - directions[..., 2]))

    exact = 2.0 * np.pi / k
    for apex in [(0.0, 0.0, 1.0), (0.28, 0.0, 0.96)]:
        value, bound = polygon_quadrature.adaptive_integral(polygon, peak, apex, tolerance=1e-11)
        assert abs(value - exact) <= bound + 1e-12
        assert bound < 1e-6 * exact


def test_lhuilier_knows_the_octant_and_small_triangles():
    assert textbook.lhuilier(*OCTANT) == pytest.approx(np.pi / 2.0, rel=1e-14)
    small = np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0], [0.0, 1e-3, 1.0]])
    small /= np.linalg.norm(small, axis=1, keepdims=True)
    # The flat area is 5e-7; projection and curvature change it by less than a millionth of itself times a few.
    assert textbook.lhuilier(*small) == pytest.approx(5e-7, rel=3e-6)


def test_form_factor_formulas_agree_with_each_other():
    rectangle = np.array([[0.0, 0.0, 1.3], [2.0, 0.0, 1.3], [2.0, 0.7, 1.3], [0.0, 0.7, 1.3]])
    expected = textbook.parallel_rectangle_form_factor(2.0, 0.7, 1.3)
    assert textbook.lambert_form_factor(rectangle) == pytest.approx(expected, rel=1e-13)
    angle = 2.0 * np.pi * np.arange(2000) / 2000
    disk = np.stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), np.full(2000, 0.8)], axis=1)
    # An inscribed polygon of n corners has 2/3 (pi / n)^2 = 1.6e-6 less area.
    assert textbook.lambert_form_factor(disk) == pytest.approx(textbook.coaxial_disk_form_factor(1.5, 0.8), rel=4e-6)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_the_textbook_distribution_has_projected_area_one(alpha):
    nodes, weights = np.polynomial.legendre.leggauss(200)
    # tan(theta) = alpha t / (1 - t) spreads the peak evenly
    t, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    theta = np.arctan(alpha * t / (1.0 - t))
    step = alpha / (1.0 - t) ** 2 * np.cos(theta) ** 2
    density = textbook.ggx_distribution(np.cos(theta), alpha) * np.cos(theta) * np.sin(theta)
    area = 2.0 * np.pi * (density * step) @ weights
    assert area == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("cosine", [0.1, 0.6, 1.0])
def test_the_textbook_masking_passes_the_weak_furnace(alpha, cosine):
    """Visible normals are distributed: int D(h) G1(o) max(0, o.h) / cos_o dh = 1 (Heitz 2014, eq. 19)."""
    u = (np.arange(600) + 0.5) / 600
    tangent = alpha * np.sqrt(u / (1.0 - u))
    azimuth = np.pi * (np.arange(300) + 0.5) / 300
    cos_h = 1.0 / np.sqrt(1.0 + tangent**2)
    height = cosine + np.sqrt(1.0 - cosine**2) * tangent[:, None] * np.cos(azimuth)
    visible = np.maximum(height, 0.0)  # (o.h) / cos_h
    masking = 1.0 / (1.0 + textbook.smith_lambda(cosine, alpha))
    assert cos_h.min() > 0.0
    # The midpoint rule in u has a square root singularity at u = 1: error of about n^-1/2 of the last cell's share.
    assert (visible * masking).mean() / cosine == pytest.approx(1.0, abs=0.04 * alpha / cosine + 1e-3)
