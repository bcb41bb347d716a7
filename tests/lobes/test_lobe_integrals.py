"""Lobes and their integrals over polygons agree with each other, for every shipped table."""

import numpy as np
import pytest
import textbook
from lobe_cases import TABLES, lobe_quadrature, random_rectangles, table_names
from polygon_quadrature import above_horizon

from ltsh_addon import shading
from ltsh_addon.lobes import spherical_harmonics
from ltsh_addon.lobes.lobe_integrals import polygon_integrals
from ltsh_addon.lobes.lookup_table import Lobe

# At grazing angles and low roughness the warp stretches polygons up to 1e5 times: 1e5 * eps * some edges
ROUNDING = 1e-9


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


@table_names
def test_integral_over_a_non_convex_polygon_is_that_of_the_lobe(name):
    star = np.array([[np.cos(a) * r, 1.0 + np.sin(a) * r, 0.4 + 0.9 * np.cos(a) * r] for a, r in STAR])
    for turn, (cosine, roughness) in enumerate([(0.3, 0.4), (0.8, 0.7), (0.6, 0.2)]):
        angle = 1.5 + turn
        rotation = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        polygon = star @ rotation
        found = shading.integrate_polygon(TABLES[name], [cosine], [roughness], polygon[None], signed=True)[0]
        expected, bound = lobe_quadrature(TABLES[name], cosine, roughness, above_horizon(polygon))
        assert abs(found - expected) < bound
        assert abs(expected) > 1e-3


STAR = [(2.0 * np.pi * k / 10, (1.2, 0.4)[k % 2]) for k in range(10)]


def test_identity_lobe_is_the_lambert_form_factor():
    """Both families: a clamped cosine without tilt, and z / pi as a spherical harmonics expansion."""
    generator = np.random.default_rng(13)
    polygons = random_rectangles(generator, 60, crossing=False)
    kernel = np.ascontiguousarray(polygons.transpose(2, 1, 0))
    one, zero = np.ones(60), np.zeros(60)
    expected = np.array([textbook.lambert_form_factor(polygon) for polygon in polygons])
    for name, table in TABLES.items():
        coefficients = np.ones((1, 1, 60))
        if name != "ltc":
            coefficients = np.zeros((1, table.coefficients.shape[-1], 60))
            coefficients[0, 1] = 1.0 / (np.pi * spherical_harmonics.normalization(1, 0))
        lobe = Lobe(one, zero, one, one, zero if name == "ltc" else None, coefficients)
        found = polygon_integrals(table, lobe, kernel, coefficients)[0]
        # arccos of the oracle loses half the digits at short edges
        assert np.abs(found - expected).max() < 1e-9, name


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
def test_mirroring_in_y_and_reversing_change_only_the_sign(name):
    cosine, roughness, rectangles = random_cases(16, crossing=True)
    table = TABLES[name]
    signed = shading.integrate_polygon(table, cosine, roughness, rectangles, signed=True)
    mirrored = rectangles * np.array([1.0, -1.0, 1.0])
    for changed in (mirrored, rectangles[:, ::-1]):
        found = shading.integrate_polygon(table, cosine, roughness, changed, signed=True)
        assert np.abs(found + signed).max() < ROUNDING
        either = shading.integrate_polygon(table, cosine, roughness, changed)
        assert np.abs(either - shading.integrate_polygon(table, cosine, roughness, rectangles)).max() < ROUNDING


@table_names
def test_splitting_a_polygon_adds_up(name):
    cosine, roughness, rectangles = random_cases(17, crossing=True)
    parts = [
        shading.integrate_polygon(TABLES[name], cosine, roughness, rectangles[:, corners], signed=True)
        for corners in ([0, 1, 2], [0, 2, 3])
    ]
    whole = shading.integrate_polygon(TABLES[name], cosine, roughness, rectangles, signed=True)
    assert np.abs(parts[0] + parts[1] - whole).max() < ROUNDING


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
