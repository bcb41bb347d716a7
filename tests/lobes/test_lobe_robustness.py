"""Lobe integrals on hostile input and in single precision."""

import os

import numpy as np
import pytest
from hostile_polygons import (
    HOSTILE,
    SQUARE,
    at_the_point,
    ceilings,
    collinear,
    edge_on,
    far,
    huge,
    lattice,
    repeated,
    setting,
    spread,
    tiny,
    walls,
)
from lobe_cases import TABLES, random_rectangles, table_names
from surface_scenes import unit

from ltsh_addon import shading

# The directional albedo of GGX is at most 1; a fitted lobe that dips below zero elsewhere may exceed it a little.
LARGEST = 1.3
EACH = int(os.environ.get("LTSH_EACH", 4_000))  # `make soak` takes more


@table_names
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_polygons_give_finite_numbers_that_are_not_negative(name, kind, dtype):
    generator = np.random.default_rng(HOSTILE.index(kind))
    polygons = kind(generator, EACH).astype(dtype)
    cosine, roughness = setting(generator, EACH)
    values = shading.integrate_polygon(TABLES[name], cosine, roughness, polygons)
    assert values.shape == (EACH,) and values.dtype == dtype
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()


@table_names
@pytest.mark.parametrize("kind", [tiny, huge, far, ceilings, edge_on, walls, repeated, collinear])
def test_hostile_polygons_reflect_no_more_than_arrives(name, kind):
    """Planar polygons in double precision, down to planes that pass by the point within 1e-17.

    Below some 1e-13 of the polygon's size the side on which a plane passes is rounding: such a polygon covers half of
    the hemisphere or nothing, but all of its moments must mean the same one.
    """
    generator = np.random.default_rng(100 + HOSTILE.index(kind))
    polygons = kind(generator, EACH)
    cosine, roughness = setting(generator, EACH)
    values = shading.integrate_polygon(TABLES[name], cosine, roughness, polygons)
    worst = values.argmax()
    assert values[worst] < LARGEST, (cosine[worst], roughness[worst], polygons[worst].tolist())


@table_names
@pytest.mark.parametrize("kind", [tiny, huge, ceilings, edge_on, at_the_point, lattice])
def test_reversing_hostile_polygons_changes_only_the_sign(name, kind):
    """Not near mirrors, whose warp stretches rounding 1e5 times."""
    generator = np.random.default_rng(200 + HOSTILE.index(kind))
    polygons = kind(generator, EACH)
    cosine, roughness = generator.random(EACH), 0.3 + 0.7 * generator.random(EACH)
    signed, reverse = (
        shading.integrate_polygon(TABLES[name], cosine, roughness, corners, signed=True)
        for corners in (polygons, polygons[:, ::-1])
    )
    assert np.abs(signed + reverse).max() < 1e-9


@table_names
def test_a_point_on_the_polygon_gets_a_value_between_those_from_both_sides(name):
    """A square through the point, upright; nudged by 1e-9 to either side it is a quarter of a sphere, or little."""
    table = TABLES[name]
    generator = np.random.default_rng(9)
    angle = generator.random(500) * 2.0 * np.pi
    cosine, roughness = generator.random(500), 0.3 + 0.7 * generator.random(500)
    forward = np.stack([np.cos(angle), np.sin(angle), np.zeros(500)], axis=1)[:, None]
    side = np.stack([-np.sin(angle), np.cos(angle), np.zeros(500)], axis=1)[:, None]
    square = SQUARE[:, :1] * side + SQUARE[:, 1:2] * np.array([0.0, 0.0, 1.0])
    found, one, other = (
        shading.integrate_polygon(table, cosine, roughness, square + shift * forward, signed=True)
        for shift in (0.0, 1e-9, -1e-9)
    )
    low, high = np.minimum(one, other), np.maximum(one, other)
    assert ((found >= low - 1e-6) & (found <= high + 1e-6)).all()
    assert (high - low).max() > 0.3


@table_names
@pytest.mark.parametrize("corners", [3, 5, 9, 33, 64])
def test_polygons_of_many_corners_are_the_sum_of_their_triangles(name, corners):
    """Stars, half of their corners drawn in: not convex, several runs of corners above the horizon."""
    generator = np.random.default_rng(corners)
    count = 200
    angle = 2.0 * np.pi * np.arange(corners) / corners
    radius = np.where(np.arange(corners) % 2 == 0, 1.0, 0.4)
    center = generator.normal(size=(count, 1, 3)) + np.array([0.0, 0.0, 0.5])
    frame = np.linalg.qr(generator.normal(size=(count, 3, 3)))[0]
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    polygons = center + flat @ frame[:, :2]
    cosine, roughness = generator.random(count), 0.2 + 0.8 * generator.random(count)

    def integral(vertices):
        return shading.integrate_polygon(TABLES[name], cosine, roughness, vertices, signed=True)

    following = np.roll(polygons, -1, axis=1)
    triangles = sum(integral(np.stack([center[:, 0], polygons[:, k], following[:, k]], axis=1)) for k in range(corners))
    # Triangles with a corner in common share no long edge unless the point is in their plane.
    assert np.abs(triangles - integral(polygons)).max() < 1e-8


@table_names
def test_a_figure_of_eight_counts_its_halves_with_opposite_signs(name):
    generator = np.random.default_rng(12)
    polygons = random_rectangles(generator, 200, crossing=True)
    cosine, roughness = generator.random(200), 0.2 + 0.8 * generator.random(200)
    crossed = polygons[:, [0, 2, 1, 3]]
    middle = 0.5 * (polygons[:, 0] + polygons[:, 2])  # where the diagonals 0-2 and 1-3 meet

    def integral(*corners):
        return shading.integrate_polygon(TABLES[name], cosine, roughness, np.stack(corners, axis=1), signed=True)

    halves = integral(middle, crossed[:, 1], crossed[:, 2]) + integral(middle, crossed[:, 3], crossed[:, 0])
    assert np.abs(halves - integral(*crossed.transpose(1, 0, 2))).max() < 1e-9


@table_names
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_polygon_traced_several_times_has_as_many_times_the_integral(name, dtype):
    """Rectangles, and ceilings that cover most of the hemisphere; the error of one, as below, comes as often."""
    generator = np.random.default_rng(13)
    flat = SQUARE + generator.uniform(-0.5, 0.5, (100, 1, 3)) * [1.0, 1.0, 0.0]
    flat[..., 2] = generator.uniform(0.05, 1.5, (100, 1))
    once = np.concatenate([flat, random_rectangles(generator, 100, crossing=True)]).astype(dtype)
    cosine, roughness = (low + (1.0 - low) * generator.random(200).astype(dtype) for low in (0.1, 0.2))

    def integral(polygons, **options):
        return shading.integrate_polygon(TABLES[name], cosine, roughness, polygons, **options)

    for turns in (2, 3):
        several = np.tile(once, (1, turns, 1))
        for polygons, sign in ((several, 1.0), (several[:, ::-1], -1.0)):
            limit = turns * (2e-5 if dtype == np.float32 else 1e-9)
            assert np.abs(integral(polygons) - turns * integral(once)).max() < limit
            signed = integral(polygons, signed=True) - sign * turns * integral(once, signed=True)
            assert np.abs(signed).max() < limit
    assert integral(np.tile(once, (1, 3, 1))).max() > 1.0


@table_names
@pytest.mark.parametrize("kind", [repeated, collinear])
def test_polygons_without_area_reflect_nothing(name, kind):
    generator = np.random.default_rng(3)
    polygons = kind(generator, 2000)
    if kind is repeated:
        polygons[:, 2], polygons[:, 3] = polygons[:, 0], polygons[:, 1]
    cosine, roughness = generator.random(2000), 0.1 + 0.9 * generator.random(2000)
    values = shading.integrate_polygon(TABLES[name], cosine, roughness, polygons)
    # Rounding makes a collinear polygon a sliver of width eps; the lobe's peak is 1 / (4 pi alpha^2) at most ~ 800.
    assert values.max() < 1e-11


@table_names
@pytest.mark.parametrize("crossing", [False, True], ids=["above", "crossing"])
def test_single_precision_is_close_to_double(name, crossing):
    """Generic rectangles and roughness above 0.2, where the warp does not stretch: a few hundred units of 6e-8."""
    generator = np.random.default_rng(4)
    count = 1000
    polygons = random_rectangles(generator, count, crossing).astype(np.float32)
    cosine = (0.1 + 0.9 * generator.random(count)).astype(np.float32)
    roughness = (0.2 + 0.8 * generator.random(count)).astype(np.float32)
    single = shading.integrate_polygon(TABLES[name], cosine, roughness, polygons)
    double = shading.integrate_polygon(*(TABLES[name], *(a.astype(float) for a in (cosine, roughness, polygons))))
    assert np.abs(single - double).max() < 2e-5


@table_names
@pytest.mark.parametrize("corners", [3, 4, 5])
def test_single_precision_knows_narrow_polygons(name, corners):
    """Of 1 m by 0.1 mm and less, seen from 1 m and more: relative to the integral some units of 6e-8 remain."""
    generator = np.random.default_rng(15)
    center = generator.normal(size=(300, 1, 3)) + [0.0, 0.0, 2.0]
    along = unit(generator.normal(size=(300, 1, 3)))
    across = unit(np.cross(along, generator.normal(size=(300, 1, 3)))) * spread(generator, 300, -7, -4)
    angle = 2.0 * np.pi * np.arange(corners)[:, None] / corners
    polygons = (center + np.cos(angle) * along + np.sin(angle) * across).astype(np.float32)
    cosine, roughness = ((0.3 + 0.7 * generator.random(300)).astype(np.float32) for _ in range(2))
    double = shading.integrate_polygon(*(TABLES[name], *(a.astype(float) for a in (cosine, roughness, polygons))))
    assert double.min() >= 0.0 and np.median(double) > 1e-9
    single = shading.integrate_polygon(TABLES[name], cosine, roughness, polygons)
    bright = double > 1e-3 * np.median(double)
    assert np.abs(single / np.where(bright, double, 1.0) - 1.0)[bright].max() < 2e-7


@table_names
def test_single_precision_counts_figures_of_eight_as_double_does(name):
    """What remains of the halves has the sign of their solid angles, whatever the lobe makes of them; those whose
    halves are about equal are left out."""
    generator = np.random.default_rng(14)
    polygons = random_rectangles(generator, 2000, crossing=True)[:, [0, 2, 1, 3]]
    polygons[::2, 0] *= generator.uniform(1.0, 3.0, (1000, 1))
    polygons = polygons.astype(np.float32)
    cosine, roughness = ((0.2 + 0.8 * generator.random(2000)).astype(np.float32) for _ in range(2))
    arrays = tuple(array.astype(float) for array in (cosine, roughness, polygons))
    single = shading.integrate_polygon(TABLES[name], cosine, roughness, polygons)
    double = shading.integrate_polygon(TABLES[name], *arrays)
    signed = shading.integrate_polygon(TABLES[name], *arrays, signed=True)
    assert np.abs(single - double).max() < 2e-5
    assert ((double == 0.0) & (np.abs(signed) > 1e-3)).sum() > 20


@table_names
def test_single_precision_lobes_are_close_to_double(name):
    """Relative to the peak of each lobe."""
    generator = np.random.default_rng(5)
    directions = unit(random_rectangles(generator, 300, crossing=False)).astype(np.float32)
    cosine = generator.random(300).astype(np.float32)
    roughness = (0.2 + 0.8 * generator.random(300)).astype(np.float32)
    single = shading.evaluate_lobe(TABLES[name], cosine, roughness, directions)
    double = shading.evaluate_lobe(*(TABLES[name], *(a.astype(float) for a in (cosine, roughness, directions))))
    assert single.dtype == np.float32
    assert np.abs(single - double).max() < 1e-4 * np.abs(double).max()


@table_names
def test_lobes_are_finite_everywhere(name):
    generator = np.random.default_rng(6)
    directions = unit(generator.normal(size=(EACH, 3, 3)))
    directions[:, 1] = np.array([1.0, 0.0, 0.0])
    directions[:, 2, 2] *= 1e-9
    cosine, roughness = setting(generator, EACH)
    for dtype in (np.float32, np.float64):
        values = shading.evaluate_lobe(TABLES[name], cosine, roughness, directions.astype(dtype))
        assert np.isfinite(values).all()
