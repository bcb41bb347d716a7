"""GGX and Fresnel against the formulas of the literature and the physics they must obey."""

import numpy as np
import pytest
import textbook

from ltsh_addon.lobes import brdf

COSINES = np.array([1e-3, 0.05, 0.3, 0.7, 0.99, 1.0])
ALPHAS = np.array([1e-3, 0.02, 0.1, 0.36, 1.0])


def upper_directions(count, seed):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 1e-6
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_lobe_is_the_textbook_formula():
    """Everywhere on the upper hemisphere, dense around the mirror direction; the textbook's form cancels at alpha^2."""
    generator = np.random.default_rng(1)
    for mu in COSINES:
        for alpha in ALPHAS:
            near = textbook.mirror_direction(mu) + alpha * generator.normal(size=(200, 3))
            directions = np.concatenate([upper_directions(200, 2), near / np.linalg.norm(near, axis=1, keepdims=True)])
            directions = directions[directions[:, 2] > 1e-6]
            expected = textbook.ggx_brdf(textbook.view_direction(mu), directions, alpha) * directions[:, 2]
            found = brdf.ggx_brdf_cosine(mu, alpha, directions)
            assert found == pytest.approx(expected, rel=1e-13 / alpha**2), (mu, alpha)


@pytest.mark.parametrize("mu", [0.05, 0.3, 0.9])
@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_visible_normals_reflect_in_all_directions_with_probability_one(mu, alpha):
    """Weak white furnace (Heitz 2014, eq. 80), summed over half vectors that the view sees: d omega_i = 4 o.h d h."""
    # Midpoint rule over half vectors, tan theta_h = alpha sqrt(u / (1 - u)); 1 - u is a square, since the sum over u
    # ends like 1 / sqrt(1 - u).
    rest, azimuth = np.meshgrid((np.arange(300) + 0.5) / 300, np.pi * (np.arange(300) + 0.5) / 300)
    tangent, weight = alpha * np.sqrt(1.0 - rest**2) / rest, 2.0 * rest / rest.size
    cos_h = 1.0 / np.sqrt(1.0 + tangent**2)
    seen = np.maximum((np.sqrt(1.0 - mu * mu) * tangent * np.cos(azimuth) + mu) * cos_h, 0.0)
    horizontal, vertical = 9.0 * (1.0 - cos_h**2), 9.0 * cos_h**2  # of half vectors 3 long
    density = brdf.visible_normal_density(mu, horizontal, vertical, alpha**2)
    distribution = brdf.ggx_distribution(1.0 - cos_h**2, cos_h**2, alpha**2)
    assert (density / distribution / cos_h * 4.0 * seen * weight).sum() == pytest.approx(1.0, rel=1e-4)


def test_lobe_is_finite_in_the_limits():
    """Grazing view, vanishing roughness, the exact mirror direction, the horizon and below."""
    directions = np.concatenate([upper_directions(50, 5), np.eye(3), -np.eye(3)])
    for mu in (0.0, 1e-8, 1.0):
        for alpha in (1e-5, 1e-3, 1.0):
            every = np.concatenate([directions, [textbook.mirror_direction(mu)]])
            values = brdf.ggx_brdf_cosine(mu, alpha, every)
            assert np.isfinite(values).all() and (values >= 0.0).all()
            assert (values[every[:, 2] <= 0.0] == 0.0).all()


def test_half_angle_cosine_is_that_of_the_half_vector():
    lights = upper_directions(200, seed=6)
    for mu in (0.0, 0.2, 0.8, 1.0):
        view = textbook.view_direction(mu)
        half = view + lights
        expected = (half @ view) / np.linalg.norm(half, axis=1)
        assert brdf.half_angle_cosine(mu, lights) == pytest.approx(expected, abs=1e-12)
    opposite = brdf.half_angle_cosine(0.0, np.array([[-1.0, 0.0, 0.0]]))
    assert opposite == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("ior", [1.05, 1.33, 1.5, 2.4, 4.0])
def test_dielectric_reflectance_obeys_the_fresnel_equations(ior):
    cosine = np.linspace(0.0, 1.0, 401)
    s, p = textbook.fresnel_amplitudes(cosine, ior)
    assert brdf.dielectric_reflectance(cosine, ior) == pytest.approx(0.5 * (s + p), abs=1e-14)
    assert brdf.dielectric_reflectance(1.0, ior) == pytest.approx(((ior - 1.0) / (ior + 1.0)) ** 2, rel=1e-13)
    assert brdf.dielectric_reflectance(0.0, ior) == pytest.approx(1.0, rel=1e-15)
    brewster = np.cos(np.arctan(ior))
    s, p = textbook.fresnel_amplitudes(brewster, ior)
    assert p == pytest.approx(0.0, abs=1e-28)
    assert brdf.dielectric_reflectance(brewster, ior) == pytest.approx(0.5 * s, rel=1e-13)


def test_without_a_change_of_index_nothing_is_reflected():
    assert np.array_equal(brdf.dielectric_reflectance(np.linspace(0.0, 1.0, 101), 1.0), np.zeros(101))
