"""Lobes and their integrals over polygons agree with each other, for every shipped table."""

import numpy as np
import pytest
import textbook
from lobe_cases import TABLES, lobe_quadrature, random_rectangles, table_names
from polygon_quadrature import above_horizon

from ltsh_addon import shading


def random_cases(seed, count=200, crossing=False, lowest=0.0):
    generator = np.random.default_rng(seed)
    cosine, roughness = generator.random(count), lowest + (1.0 - lowest) * generator.random(count)
    return cosine, roughness, random_rectangles(generator, count, crossing)


@table_names
@pytest.mark.parametrize("crossing", [False, True], ids=["above", "crossing"])
def test_integral_is_that_of_the_lobe(name, crossing):
    cosine, roughness, rectangles = random_cases(11, 16, crossing, lowest=0.05)
    found = shading.integrate_polygon(TABLES[name], cosine, roughness, rectangles, signed=True)
    for n, rectangle in enumerate(rectangles):
        expected, bound = lobe_quadrature(TABLES[name], cosine[n], roughness[n], above_horizon(rectangle))
        assert bound < 1e-5
        assert abs(found[n] - expected) < bound, (cosine[n], roughness[n], rectangle.tolist())


def test_clamped_form_factor_is_lambert_for_either_winding():
    generator = np.random.default_rng(14)
    polygons = random_rectangles(generator, 60, crossing=True)
    expected = np.abs([textbook.lambert_form_factor(above_horizon(polygon)) for polygon in polygons])
    assert np.abs(shading.clamped_form_factor(polygons) - expected).max() < 1e-9
    assert np.abs(shading.clamped_form_factor(polygons[:, ::-1]) - expected).max() < 1e-9


@table_names
def test_scaling_all_vertices_changes_nothing(name):
    """Powers of two: not one bit."""
    cosine, roughness, rectangles = random_cases(15, crossing=True)
    expected = shading.integrate_polygon(TABLES[name], cosine, roughness, rectangles)
    for factor in (2.0**-40, 2.0**30):
        found = shading.integrate_polygon(TABLES[name], cosine, roughness, rectangles * factor)
        assert np.array_equal(found, expected)


@table_names
def test_below_the_horizon_there_is_exactly_nothing(name):
    cosine, roughness, rectangles = random_cases(18)
    below = rectangles * np.array([1.0, 1.0, -1.0])
    assert np.array_equal(shading.integrate_polygon(TABLES[name], cosine, roughness, below), np.zeros(200))
    flat = rectangles * np.array([1.0, 1.0, 0.0])
    assert np.array_equal(shading.integrate_polygon(TABLES[name], cosine, roughness, flat), np.zeros(200))
    directions = below / np.linalg.norm(below, axis=2, keepdims=True)
    assert np.array_equal(shading.evaluate_lobe(TABLES[name], cosine, roughness, directions), np.zeros((200, 4)))


@table_names
def test_wrong_shapes_are_refused(name):
    with pytest.raises(ValueError, match=r"vertices have shape \(2, 2, 3\), expected \(2, V >= 3, 3\)"):
        shading.integrate_polygon(TABLES[name], [0.5, 0.5], [0.5, 0.5], np.ones((2, 2, 3)))
    with pytest.raises(ValueError, match=r"vertices have shape \(3, 4, 3\)"):
        shading.integrate_polygon(TABLES[name], [0.5, 0.5], [0.5, 0.5], np.ones((3, 4, 3)))
    with pytest.raises(ValueError, match=r"directions have shape \(2, 3\), expected \(2, S, 3\)"):
        shading.evaluate_lobe(TABLES[name], [0.5, 0.5], [0.5, 0.5], np.ones((2, 3)))


@table_names
def test_no_points_give_no_values(name):
    empty = np.zeros(0)
    assert shading.integrate_polygon(TABLES[name], empty, empty, np.zeros((0, 4, 3))).shape == (0,)
    assert shading.evaluate_lobe(TABLES[name], empty, empty, np.zeros((0, 5, 3))).shape == (0, 5)
