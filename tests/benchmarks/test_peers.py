"""The implementations we compare ourselves with are correct."""

import numpy as np
import pytest
from bench_scenes import floor_scene, random_polygons
from textbook_ltc import TextbookLtc
from zonal_harmonics import ZonalHarmonics

from ltsh_addon import shading
from ltsh_addon.lobes import edge_integrals
from ltsh_addon.lobes.polygon import project_to_sphere


@pytest.mark.parametrize("degree", [2, 4])
def test_zonal_harmonics_give_our_integrals(degree):
    generator = np.random.default_rng(degree)
    _, _, vertices = random_polygons(500, "whole", seed=1)
    unit = project_to_sphere(np.ascontiguousarray(vertices.astype(float).transpose(2, 1, 0)))
    coefficients = generator.normal(size=((degree + 1) * (degree + 2) // 2, 500))
    weights = edge_integrals.ridge_matrix(degree).T @ coefficients
    expected = (weights * edge_integrals.moments(unit, degree)).sum(axis=0)
    found = ZonalHarmonics(degree).integrate(unit, coefficients)
    # The matrices of the bands are stored in float32.
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


def test_textbook_ltc_gives_our_integrals():
    """Polygons above both horizons; the textbook's clamp of the arc cosine costs short edges some digits."""
    table = shading.load_table("ltc")
    cosine, roughness, vertices = random_polygons(2000, "whole", seed=2)
    found = TextbookLtc(table).integrate_polygon(cosine, roughness, vertices)
    expected = shading.integrate_polygon(table, cosine, roughness, vertices)
    assert np.abs(found - expected).max() < 1e-3


def test_textbook_ltc_shades_as_we_do():
    samples, lights = floor_scene(3000, seed=3)
    found = TextbookLtc(shading.load_table("ltc")).shade(samples, lights)
    expected = shading.shade(samples, lights, "ltc", passes=["specular"], workers=1).combined
    # Without a clip at the shading horizon light from below leaks in at grazing angles.
    assert np.quantile(np.abs(found - expected), 0.9) < 1e-3 * expected.max()
