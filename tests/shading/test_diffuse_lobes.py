"""Sheen and rough diffuse lobes against quadratures of their formulas, written down here anew."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import quadrature
from surface_scenes import area_light, single_sample

from ltsh_addon import shading
from ltsh_addon.lobes import diffuse


def gauss(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def over_polygon(corners, lobe, count=100):
    """Integral of lobe(directions (S, 3)) over a convex polygon (V, 3) above the horizon."""
    nodes, weights = gauss(count)
    u, v = np.meshgrid(nodes, nodes, indexing="ij")
    weights, total = np.outer(weights, weights) * u, 0.0
    for second, third in zip(corners[1:-1], corners[2:], strict=True):
        points = corners[0] + u[..., None] * ((second - corners[0]) + v[..., None] * (third - second))
        distance = np.linalg.norm(points, axis=-1)
        facing = np.abs(points @ np.cross(second - corners[0], third - second))
        total += (weights * lobe(points / distance[..., None]) * facing / distance**3).sum()
    return total


UP = np.array([0.0, 0.0, 1.0])


def view_of(cosine):
    return np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])


def polygons(count, seed):
    """Quadrilaterals (count, 4, 3) above the horizon, about half of which cross x = 0."""
    random, found = np.random.default_rng(seed), []
    while len(found) < count:
        center = random.normal(size=3) * (1.0, 1.0, 0.3) + (0.0, 0.0, random.uniform(0.3, 2.0))
        first, second = random.normal(size=(2, 3)) * random.uniform(0.1, 0.8)
        corners = np.array([center - first - second, center + first - second, center + first + second,
                            center - first + second])  # fmt: skip
        if corners[:, 2].min() > 0.05:
            found.append(corners)
    return np.array(found)


def test_rough_lobes_are_integrated_as_their_formula_says():
    random, count = np.random.default_rng(3), 30
    corners = polygons(count, 4)
    cosine, sigma = random.uniform(0.03, 1.0, count), random.uniform(0.05, 1.0, count)
    single, several = diffuse.rough_integrals(corners.transpose(2, 1, 0), cosine, sigma)
    errors = np.zeros(count)
    for number, shape in enumerate(corners):
        own = UP, view_of(cosine[number]), sigma[number]
        plain, again = (
            over_polygon(shape, lambda directions, k=k, own=own: quadrature.rough(directions, *own)[k])
            for k in range(2)
        )
        errors[number] = single[number] / plain - 1.0
        assert several[number] == pytest.approx(again, rel=1e-3)
    # Where the kink at z = cosine is, both quadratures are off.
    assert np.abs(errors).max() < 6e-3 and np.sqrt(np.square(errors).mean()) < 1e-3


def test_sheen_is_integrated_as_its_formula_says():
    random = np.random.default_rng(5)
    a, b = random.uniform(0.2, 1.4, 40), random.uniform(-1.5, 0.3, 40)
    corners = polygons(40, 6)
    found = diffuse.sheen_form_factor(corners.transpose(2, 1, 0), a, b)
    for number, shape in enumerate(corners):

        def lobe(directions, a=a[number], b=b[number]):
            x, y, z = np.moveaxis(directions, -1, 0)
            return z / np.pi * (a / ((a * x + b * z) ** 2 + (a * y) ** 2 + z * z)) ** 2

        assert abs(found[number]) == pytest.approx(over_polygon(shape, lobe), rel=1e-6)


def test_velvet_is_integrated_as_its_formula_says():
    random = np.random.default_rng(7)
    sigma, cosine = random.uniform(0.3, 1.0, 20), random.uniform(0.1, 1.0, 20)
    corners = polygons(20, 8)
    found = diffuse.velvet_integral(corners.transpose(2, 1, 0), cosine, sigma)
    turned = diffuse.velvet_integral(corners[:, ::-1].transpose(2, 1, 0), cosine, sigma)
    for number, shape in enumerate(corners):
        view = view_of(cosine[number])
        lobe = partial(quadrature.velvet, normal=UP, view=view, sigma=sigma[number])
        expected = over_polygon(shape, lobe)
        # The kink of the masking crosses some polygons.
        assert found[number] == pytest.approx(expected, rel=2e-3, abs=1e-6)
        assert turned[number] == pytest.approx(expected, rel=2e-3, abs=1e-6)
        # By which rays to lights are weighed.
        direction = np.array([0.6, 0.0, 0.8])[:, None, None]
        rows = np.array([0.0, 0.0, 1.0])[:, None], view[:, None], np.array([[0.0], [-sigma[number]], [0.0], [0.0]])
        factor = diffuse.diffuse_factor(direction, direction[2], *rows)
        assert factor[0, 0] * 0.8 / np.pi == pytest.approx(lobe(direction[:, 0, 0]), rel=1e-6)


def test_all_light_is_the_albedo():
    """Over the hemisphere: pi A + B G(cosine) of the view, as the lobe is reciprocal; 1 of sheen."""
    turn = 2.0 * np.pi * (np.arange(64) + 0.5) / 64
    ring = np.stack([np.cos(turn), np.sin(turn), np.full(64, 1e-7)])[:, :, None]
    for cosine in (0.1, 0.5, 0.9):
        single, _ = diffuse.rough_integrals(ring, np.array([cosine]), np.array([0.7]))
        a, b = diffuse.rough_terms(np.array([0.7]))
        # The cut at x = 0 is half a circle.
        assert single[0] == pytest.approx(np.pi * a[0] + b[0] * quadrature.fujii_slope(cosine), rel=2e-4)
    assert abs(diffuse.sheen_form_factor(ring, np.array([0.5]), np.array([-0.8]))[0]) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("roughness", [0.2, 1.0])
def test_a_white_rough_surface_reflects_all_light(roughness):
    """With R of a white color: single and multiple scattering together, seen from anywhere."""
    nodes, weights = gauss(200)
    angle, angle_weights = gauss(200)
    z, phi = np.meshgrid(nodes, np.pi * angle, indexing="ij")
    directions = np.stack([np.sqrt(1.0 - z * z) * np.cos(phi), np.zeros_like(z), z], axis=-1)
    for cosine in (0.2, 0.6, 0.95):
        rebound = diffuse.rebound(np.ones((1, 3)), np.array([cosine]), np.array([roughness]))[0, 0]
        once, again = quadrature.rough(directions, UP, view_of(cosine), roughness)
        total = 2.0 * np.pi * (np.outer(weights, angle_weights) * (once + rebound * again)).sum()
        assert total == pytest.approx(1.0, abs=2e-3)


def test_smooth_surfaces_scatter_nothing_again():
    smooth, rough = diffuse.rebound(np.ones((2, 3)), np.array([0.5, 0.5]), np.array([0.0, 1.0]))
    assert np.abs(smooth).max() < 1e-5 and rough.min() > 1e-3


@pytest.mark.parametrize("shape", [{"diffuse_roughness": 1e-7}, {"sheen_a": 1.0, "sheen_b": 0.0}])
def test_without_roughness_both_are_lamberts(shape):
    sample, light = single_sample(), area_light()
    own = replace(sample, **{name: np.full(len(sample), value) for name, value in shape.items()})
    expected = shading.shade(sample, [light]).diffuse
    assert expected.max() > 0.0
    assert np.allclose(shading.shade(own, [light]).diffuse, expected, rtol=1e-5)
    assert np.allclose(shading.shade(own, [light], dtype=np.float64).diffuse, expected, rtol=1e-5)
