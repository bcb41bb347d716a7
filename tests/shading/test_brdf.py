"""GGX and Fresnel against the formulas of the literature and the physics they must obey."""

import numpy as np
import pytest
import textbook

from ltsh_addon.shading import brdf

COSINES = np.array([1e-3, 0.05, 0.3, 0.7, 0.99, 1.0])
ALPHAS = np.array([1e-3, 0.02, 0.1, 0.36, 1.0])


def upper_directions(count, seed):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 1e-6
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def half_vector_rule(count):
    """(tan theta_h / alpha, azimuth, weight): integrates D(h) cos(theta_h) dh over the half vectors, midpoint rule."""
    u = (np.arange(count) + 0.5) / count
    azimuth = np.pi * (np.arange(count) + 0.5) / count
    tangent, azimuth = (grid.ravel() for grid in np.meshgrid(np.sqrt(u / (1.0 - u)), azimuth, indexing="ij"))
    return tangent, azimuth, 1.0 / count**2


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


def test_distribution_has_projected_area_one():
    """At normal incidence f cos = D cos / (2 (S + cos)) reveals D for half angles up to 45 degrees, a known share."""
    for alpha in (0.05, 0.3, 1.0):
        # The share of half angles with tan < t is t^2 / (alpha^2 + t^2); quadratic spacing of t resolves the peak.
        share = 1.0 / (1.0 + alpha**2)
        nodes, weights = np.polynomial.legendre.leggauss(60)
        tangent, step = 0.25 * (nodes + 1.0) ** 2, 0.5 * (nodes + 1.0) * weights
        cos_h = 1.0 / np.sqrt(1.0 + tangent**2)
        theta = 2.0 * np.arctan(tangent)
        directions = np.stack([np.sin(theta), np.zeros(60), np.cos(theta)], axis=-1)
        mu = directions[:, 2]
        slope = np.sqrt(mu**2 + alpha**2 * (1.0 - mu**2))
        distribution = brdf.ggx_brdf_cosine(1.0, alpha, directions) * 2.0 * (slope + mu) / mu
        # D cos_h 2 pi sin_h d theta_h with d theta_h = cos_h^2 d tan
        area = (distribution * cos_h * 2.0 * np.pi * tangent * cos_h * cos_h**2 * step).sum()
        assert area == pytest.approx(share, rel=1e-6), alpha


@pytest.mark.parametrize("mu", [0.05, 0.3, 0.9])
@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_visible_normals_reflect_in_all_directions_with_probability_one(mu, alpha):
    """Weak white furnace (Heitz 2014, eq. 80), summed over half vectors that the view sees: d omega_i = 4 o.h d h."""
    # Half vectors as in `half_vector_rule`; 1 - u is a square, since the sum over u ends like 1 / sqrt(1 - u).
    rest, azimuth = np.meshgrid((np.arange(300) + 0.5) / 300, np.pi * (np.arange(300) + 0.5) / 300)
    tangent, weight = alpha * np.sqrt(1.0 - rest**2) / rest, 2.0 * rest / rest.size
    cos_h = 1.0 / np.sqrt(1.0 + tangent**2)
    seen = np.maximum((np.sqrt(1.0 - mu * mu) * tangent * np.cos(azimuth) + mu) * cos_h, 0.0)
    horizontal, vertical = 9.0 * (1.0 - cos_h**2), 9.0 * cos_h**2  # of half vectors 3 long
    density = brdf.visible_normal_density(mu, horizontal, vertical, alpha**2)
    distribution = brdf.ggx_distribution(1.0 - cos_h**2, cos_h**2, alpha**2)
    assert (density / distribution / cos_h * 4.0 * seen * weight).sum() == pytest.approx(1.0, rel=1e-4)


def test_reciprocity():
    """f(o, i) = f(i, o): the lobe divided by its cosine does not change when view and light swap."""
    lights = upper_directions(300, seed=3)
    for mu in COSINES[:-1]:
        for alpha in ALPHAS:
            forward = brdf.ggx_brdf_cosine(mu, alpha, lights) / lights[:, 2]
            # Turn about z so that the light becomes the view direction (y = 0, x >= 0).
            angle = np.arctan2(lights[:, 1], lights[:, 0])
            view = textbook.view_direction(mu)
            turned = np.stack([view[0] * np.cos(angle), -view[0] * np.sin(angle), np.full(300, mu)], axis=-1)
            backward = brdf.ggx_brdf_cosine(lights[:, 2], np.full(300, alpha), turned[:, None])[:, 0] / mu
            # Near the mirror direction half vectors cancel: relative error of about eps / alpha^2
            assert backward == pytest.approx(forward, rel=1e-14 / alpha**2)


def test_directional_albedo_is_that_of_the_half_vector_integral():
    """int f cos = int G2 (o.h) / (cos_o cos_h) D cos_h dh, by the midpoint rule over half vectors."""
    tangent, azimuth, weight = half_vector_rule(400)
    nodes, node_weights = np.polynomial.legendre.leggauss(200)
    for mu, alpha in [(0.9, 0.5), (0.4, 0.3), (0.7, 1.0)]:
        view = textbook.view_direction(mu)
        t = alpha * tangent
        half = np.stack([t * np.cos(azimuth), t * np.sin(azimuth), np.ones_like(t)], axis=-1)
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        along = half @ view
        light = 2.0 * along[:, None] * half - view
        up = (light[:, 2] > 0.0) & (along > 0.0)
        cos_i = np.where(up, light[:, 2], 1.0)
        masking = 1.0 / (1.0 + textbook.smith_lambda(mu, alpha) + textbook.smith_lambda(cos_i, alpha))
        expected = np.where(up, masking * along / (mu * half[:, 2]), 0.0).sum() * weight
        z = 0.5 * (nodes + 1.0)
        phi = 0.5 * np.pi * (nodes + 1.0)
        grid_z, grid_phi = (grid.ravel() for grid in np.meshgrid(z, phi, indexing="ij"))
        radius = np.sqrt(1.0 - grid_z**2)
        directions = np.stack([radius * np.cos(grid_phi), radius * np.sin(grid_phi), grid_z], axis=-1)
        weights = np.outer(node_weights, node_weights).ravel() * 0.5 * np.pi
        found = brdf.ggx_brdf_cosine(mu, alpha, directions) @ weights
        # The midpoint rule of 400 x 400 cells is cut at the horizon: a boundary error of about a tenth of a cell.
        assert found == pytest.approx(expected, abs=1e-3), (mu, alpha)
        assert found < 1.0


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


def test_schlick_curve():
    assert brdf.schlick_curve(np.array([0.0, 0.5, 1.0])) == pytest.approx([1.0, 0.5**5, 0.0])


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
