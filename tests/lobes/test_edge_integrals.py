"""Arc factors against fifty-digit arithmetic, polygon moments against quadrature."""

from decimal import Decimal, localcontext

import numpy as np
import polygon_quadrature
import pytest

from ltsh_addon.lobes import edge_integrals, spherical_harmonics
from ltsh_addon.lobes.polygon import clip_to_horizon, one_plus_cosine

# In double precision: coefficients of psi sum to 58 in absolute value, psi is at least 1/3, so each of the two
# roundings, of the coefficients and of the sum, may cost 58 * 3 * 1.1e-16. Which of them it does differs by processor.
RELATIVE_ERROR = {np.float32: 1e-6, np.float64: 4e-14}


def decimal_sine_cosine(angle):
    """Taylor series of both, in the precision of the context."""
    sine, cosine, term = Decimal(0), Decimal(0), Decimal(1)
    for n in range(200):
        part = (1, 1, -1, -1)[n % 4] * term
        sine, cosine = (sine + part, cosine) if n % 2 else (sine, cosine + part)
        term *= angle / (n + 1)
        if abs(term) < Decimal(10) ** -60:
            break
    return sine, cosine


def exact_arc_factors(one_plus_cosine):
    """(phi, psi, q) of an angle in (0, pi), correct to 30 digits: Newton's method for the angle."""
    with localcontext() as context:
        context.prec = 60
        target = Decimal(float(one_plus_cosine)) - 1
        root = np.sqrt(0.5 * float(one_plus_cosine))
        theta = Decimal(float(2.0 * np.arctan2(np.sqrt(max(0.5 * float(1 - target), 1e-300)), root)))
        for _ in range(8):
            sine, value = decimal_sine_cosine(theta)
            theta += (value - target) / sine
        sine, _ = decimal_sine_cosine(theta)
        phi = theta / sine
        return float(phi), float((phi - 1) / (1 - target)), float(1 / (1 + target))


def test_the_decimal_oracle_knows_simple_angles():
    third = np.pi / 3.0 / np.sqrt(0.75)
    assert exact_arc_factors(1.0) == pytest.approx((np.pi / 2.0, np.pi / 2.0 - 1.0, 1.0), rel=1e-15)
    assert exact_arc_factors(1.5) == pytest.approx((third, 2.0 * (third - 1.0), 2.0 / 3.0), rel=1e-15)
    assert exact_arc_factors(0.5) == pytest.approx((2.0 * third, (2.0 * third - 1.0) / 1.5, 2.0), rel=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arc_factors_have_the_stated_relative_error(dtype):
    """From an angle of 1e-7 to 1e-6 short of a half circle; the angle of the oracle is that of the rounded input."""
    angles = np.concatenate([np.geomspace(1e-7, 0.5, 60), np.linspace(0.5, 3.1, 100)])
    shifted = np.concatenate([1.0 + np.cos(angles), 0.5 * np.geomspace(1e-6, 0.05, 30) ** 2]).astype(dtype)
    shifted = shifted[shifted < 2.0]
    exact = np.array([exact_arc_factors(value) for value in shifted]).T
    for name, found, expected in zip(("phi", "psi", "q"), edge_integrals.arc_factors(shifted), exact, strict=True):
        assert found.dtype == dtype
        error = np.abs(found / expected - 1.0)
        worst = error.argmax()
        assert error[worst] < RELATIVE_ERROR[dtype], (name, shifted[worst], error[worst])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arc_factors_are_finite_at_the_ends(dtype):
    shifted = np.array([2.0, 2.0 + 8 * np.finfo(dtype).eps, 0.0], dtype=dtype)
    phi, psi, q = edge_integrals.arc_factors(shifted)
    for values in (phi, psi, q):
        assert np.isfinite(values).all()
    assert phi[:2] == pytest.approx(1.0, rel=RELATIVE_ERROR[dtype])
    assert psi[:2] == pytest.approx(1.0 / 3.0, rel=RELATIVE_ERROR[dtype])
    assert q[:2] == pytest.approx(0.5, rel=RELATIVE_ERROR[dtype])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_plus_cosine_is_accurate_up_to_half_a_circle(dtype):
    """Unit vectors short of opposite by `gap`: rounding moves it by about eps, its square by a share of 2 eps / gap."""
    eps = float(np.finfo(dtype).eps)
    generator = np.random.default_rng(9)
    for gap in (1.0, 1e-2, 1e-4, 1e-5):
        start = generator.normal(size=(3, 200))
        start /= np.linalg.norm(start, axis=0)
        side = np.cross(start, generator.normal(size=(3, 200)), axis=0)
        side /= np.linalg.norm(side, axis=0)
        end = -np.cos(gap) * start + np.sin(gap) * side
        found = one_plus_cosine(start.astype(dtype) + end.astype(dtype))
        expected = 2.0 * np.sin(0.5 * gap) ** 2
        assert np.abs(found / expected - 1.0).max() < 8.0 * eps / gap, gap


def random_polygons(kind, count, seed):
    """Planar convex polygons (V, 3) above z = 0, some clipped, as a list."""
    generator = np.random.default_rng(seed)
    polygons = []
    while len(polygons) < count:
        corners = generator.integers(3, 7)
        center = generator.normal(size=3)
        center[2] = abs(center[2]) + 0.2
        axes = generator.normal(size=(2, 3))
        size = {"generic": 0.4, "tiny": 1e-4, "large": 8.0, "clipped": 1.5}[kind]
        if kind == "clipped":
            center[2] = 0.3 * generator.random()
        angle = np.sort(generator.random(corners) * 2.0 * np.pi)
        polygon = center + size * (np.cos(angle)[:, None] * axes[0] + np.sin(angle)[:, None] * axes[1])
        if kind == "large":
            polygon[:, 2] = center[2]
        below = (polygon[:, 2] <= 0.0).sum()
        if below == corners or (kind == "clipped") != (below > 0):
            continue
        if below:
            polygon = clip_to_horizon(polygon.T[:, :, None])[:, :, 0].T
        polygons.append(polygon / np.linalg.norm(polygon, axis=1, keepdims=True))
    return polygons


def closed_form(polygon, degree):
    """Integrals (K,) of all basis functions over one polygon (V, 3)."""
    moments = edge_integrals.moments(polygon.T[:, :, None], degree)
    return (edge_integrals.ridge_matrix(degree) @ moments)[:, 0]


@pytest.mark.parametrize("kind", ["generic", "tiny", "large", "clipped"])
@pytest.mark.parametrize("degree", range(1, 9))
def test_polygon_integrals_of_spherical_harmonics_match_quadrature(kind, degree):
    for polygon in random_polygons(kind, 12, seed=degree):
        expected = polygon_quadrature.integral(
            polygon, lambda directions: spherical_harmonics.evaluate(degree, directions), pieces=8
        )
        found = closed_form(polygon, degree)
        assert np.abs(found - expected).max() < 1e-8, polygon


@pytest.mark.parametrize("degree", [2, 4])
def test_tiny_polygons_keep_their_relative_accuracy(degree):
    """The edge sum has rounding errors of order eps for an answer of order size^2 = 1e-8: relative 1e-16 / 1e-8."""
    for polygon in random_polygons("tiny", 12, seed=20 + degree):
        expected = polygon_quadrature.integral(
            polygon, lambda directions: spherical_harmonics.evaluate(degree, directions), apex=polygon[0], pieces=1
        )
        scale = abs(expected[0])
        assert np.abs(closed_form(polygon, degree) - expected).max() < 1e-5 * scale


@pytest.mark.parametrize("degree", [-1, 9])
def test_degrees_out_of_range_are_refused(degree):
    with pytest.raises(ValueError, match=f"degree is {degree}, expected 0 to 8"):
        edge_integrals.ridge_matrix(degree)
