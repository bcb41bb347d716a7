"""The float32 path of `shade` against the float64 path, and its parts against their double precision counterparts."""

from dataclasses import replace

import numpy as np
import pytest
from hostile_polygons import oriented
from lobe_cases import table_names
from precisions import assert_close
from surface_scenes import all_kinds_of_samples, area_light, four_lights, random_samples, unit

from ltsh_addon import shading
from ltsh_addon.emitters import small_lights as points
from ltsh_addon.lobes import edge_integrals, moments32
from ltsh_addon.lobes.polygon import project_to_sphere
from ltsh_addon.scene import PolygonLight
from ltsh_addon.shading import float64, lobes32


def white_lights(lights):
    return [replace(light, radiance=np.ones(3)) for light in lights]


@table_names
def test_single_precision_keeps_its_promise(name):
    double = assert_close(all_kinds_of_samples(6000, seed=1), white_lights(four_lights()), name)
    assert double.specular.max() > 0.5 and double.diffuse.max() > 0.1


@pytest.mark.newest
@table_names
def test_lights_at_hostile_places_keep_the_promise(name):
    """Touching the surface, standing on it, edge-on, crossing the horizon, tiny, huge, far away and at the point."""
    samples = all_kinds_of_samples(400, seed=2)
    samples = replace(samples, position=samples.position * np.array([1.0, 1.0, 0.0]))
    lights = [
        area_light(center=(0, 0, 1e-6)),
        area_light(center=(0, 0, 0.5), half_u=(0, 0, 0.5), half_v=(0, 1, 0)),
        area_light(center=(0, 0, 0.2), half_u=(0, 0, 0.5), half_v=(1, 0.3, 0)),
        area_light(center=(0.2, 0.1, 1.0), half_u=(1e-3, 0, 0), half_v=(0, -1e-3, 0)),
        area_light(center=(0.2, 0.1, 1.0), half_u=(1e3, 0, 0), half_v=(0, -1e3, 0)),
        area_light(center=(0, 0, 1e4), half_u=(2e3, 0, 0), half_v=(0, -2e3, 0)),
        area_light(shape="DISK", center=(0.5, 0, 0.3), half_u=(1, 0, 0.4), half_v=(0, -1, 0)),
    ]
    for light in lights:
        assert_close(samples, white_lights([light]), name)


@pytest.mark.newest
@table_names
def test_narrow_lights_are_exact_to_rounding(name):
    """1 m by 10 um: in single precision their long edges would cancel but for some percent."""
    samples = all_kinds_of_samples(400, seed=5)
    narrow = {"center": (0.2, 0.1, 1.5), "half_u": (0.5, 0, 0), "half_v": (0, -5e-6, 0)}
    triangle = np.array([[-0.5, 0.0, 1.5], [-0.5, 1e-5, 1.5], [0.5, 0.0, 1.5]])
    lights = [
        area_light(**narrow),
        area_light(**narrow, shape="ELLIPSE"),
        area_light(**narrow, spread=1.0),
        PolygonLight.like(area_light(**narrow), corners=triangle),
    ]
    for light in white_lights(lights):
        single = shading.shade(samples, [light], name, workers=1)
        double = shading.shade(samples, [light], name, workers=1, dtype=np.float64)
        for part in shading.PASSES:
            found, expected = getattr(single, part), getattr(double, part)
            # Of the light with a spread single precision takes points, double precision layers.
            limit = 0.003 if light.has_spread else 2e-7
            assert np.abs(found - expected).max() < limit * expected.max() and expected.max() > 0.0


def small_lights(size, seed):
    """One of each shape, of about `size` m, 1 to 6 m from the samples and facing them."""
    generator = np.random.default_rng(seed)
    for shape in ("RECTANGLE", "DISK", "ELLIPSE", "POLYGON"):
        center = np.array([*generator.uniform(-4.0, 4.0, 2), generator.uniform(1.5, 4.0)])
        direction = -unit(center)
        u = size * unit(np.cross(direction, [0.3, 1.0, 0.0]))
        v = np.cross(direction, u) * (1.0 if shape == "DISK" else 0.6)
        # A boomerang, whose center of gravity is not in the middle
        corners = center + np.array([-u, 0.3 * u, u + v, 0.2 * u - v]) if shape == "POLYGON" else None
        yield area_light("Small", shape, center, u, v, direction=direction, corners=corners, radiance=np.ones(3))


@pytest.mark.newest
@pytest.mark.parametrize("size", [0.2, 0.05, 0.01, 1e-3])
@table_names
def test_small_lights_keep_the_promise_and_their_share(name, size, monkeypatch):
    """They are their center: that neglects at most 0.2 % of a light, and more only of the tails that are confined by
    a light's corners. Bent horizons among them. Few pairs are left to double precision."""
    samples = all_kinds_of_samples(1000, seed=11)
    samples = replace(samples, roughness=np.maximum(samples.roughness, moments32.SHARP_ROUGHNESS))
    asked, original = [], float64.shade_pairs

    def counted(samples, members, *others):
        asked.append(len(members))
        return original(samples, members, *others)

    monkeypatch.setattr(float64, "shade_pairs", counted)
    squares = {part: np.zeros(2) for part in shading.PASSES}
    for light in small_lights(size, seed=5):
        double = assert_close(samples, [light], name)
        single = shading.shade(samples, [light], name, workers=1)
        for part, both in squares.items():
            expected = getattr(double, part)
            both += ((getattr(single, part) - expected) ** 2).sum(), (expected**2).sum()
    assert all(0.0 < error < (5e-3) ** 2 * energy for error, energy in squares.values()), squares
    # Of the pairs of four lights, two passes and two calls
    assert sum(asked) < 0.02 * 4 * 2 * 2 * len(samples)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_terms_of_weights_give_the_moments_of_a_tiny_patch(degree):
    """Against the moments of regular polygons of 1 mrad in double precision by their area: second order in that."""
    generator = np.random.default_rng(degree)
    polygons = regular_polygons(5, 50, seed=degree).astype(np.float64)
    center = polygons.mean(axis=1, keepdims=True)
    patch = project_to_sphere(center + 1e-3 * (polygons - center))
    moments = np.linalg.solve(moments32.form_matrix(degree), edge_integrals.moments(patch, degree))
    weights = generator.normal(size=(2, len(moments), 50))
    x, _, z = project_to_sphere(center)[:, 0]
    terms = points.polynomial_terms(weights)
    for vector, own in zip(weights, terms, strict=True):
        expected = (vector * moments).sum(axis=0) / moments[0]
        assert np.abs(points.polynomial(own, x, z) - expected).max() < 1e-5 * np.abs(weights).sum(axis=1).max()


@table_names
def test_a_scene_far_from_the_origin_keeps_the_promise(name):
    """Positions are subtracted in double precision."""
    samples, lights = all_kinds_of_samples(500, seed=3), white_lights(four_lights())
    shift = np.array([1e6, -2e6, 3e5])
    moved = replace(samples, position=samples.position + shift)
    assert_close(moved, [replace(light, center=light.center + shift) for light in lights], name)


@table_names
def test_many_indices_of_refraction_give_what_single_ones_give(name):
    samples = replace(all_kinds_of_samples(300, seed=4), roughness=np.full(300, 0.4))
    lights = white_lights(four_lights())
    few = replace(samples, ior=np.where(np.arange(300) % 2 == 0, 1.45, 1.8))
    assert_close(few, lights, name)
    # The first is another one for each of more samples than are kept apart: the same values by the other way.
    many = replace(few, ior=few.ior + np.where(np.arange(300) < 150, 0.0, 1e-3 * np.arange(300)))
    apart = shading.shade(few, lights, name, workers=1).specular[:, :150]
    together = shading.shade(many, lights, name, workers=1).specular[:, :150]
    assert len(np.unique(many.ior)) > lobes32.SEPARATE_IORS
    assert np.abs(apart - together).max() < 2e-6


@pytest.mark.newest
@pytest.mark.parametrize("corners", [3, 4, 5, 12, 32, 64])
@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_edge_loop_gives_the_moments(degree, corners):
    """Regular polygons around random directions: rounding of 6e-8 per edge, of moments up to 20."""
    polygons = regular_polygons(corners, 300, seed=degree)
    moments, needs_float64 = moments32.moments(polygons, degree, moments32.Scratch())
    along_directions = edge_integrals.moments(project_to_sphere(polygons.astype(np.float64)), degree)
    expected = np.linalg.solve(moments32.form_matrix(degree), along_directions)
    assert moments.dtype == np.float32
    assert needs_float64.mean() < 0.2
    assert np.abs(moments - expected)[:, ~needs_float64].max() < 1e-7 * corners * np.abs(expected).max() + 1e-6


@pytest.mark.parametrize("corners", [3, 5, 32])
def test_bent_moments_are_those_of_the_bent_polygon(corners):
    """In double precision, after the warp of the bend; tolerance as above."""
    bend, polygons = (0.4, 0.2, 1.4), regular_polygons(corners, 300, seed=corners)
    moments, needs_float64 = moments32.moments(polygons, 4, moments32.Scratch(), bend=bend)
    plain, _ = moments32.moments(polygons, 4, moments32.Scratch())
    x, y, z = polygons.astype(np.float64)
    bent = project_to_sphere(np.stack([0.4 * x + 0.2 * z, 1.4 * y, z]))
    expected = 2.0 * edge_integrals.vector_irradiance(bent)[::2]
    assert np.array_equal(moments[:-2], plain) and needs_float64.mean() < 0.2
    assert np.abs(moments[-2:] - expected)[:, ~needs_float64].max() < 1e-7 * corners * np.abs(expected).max() + 1e-6


def regular_polygons(corners, count, seed):
    """Polygons (3, V, P) in float32 around random directions above the horizon, of 0.03 to 0.5 rad."""
    generator = np.random.default_rng(seed)
    center = unit(generator.normal(size=(count, 3)) * np.array([0.5, 0.5, 0.0]) + np.array([0.0, 0.0, 1.0]))
    square = oriented(generator, count, np.zeros((count, 3)), 0.5)
    u = square[:, 1] - square[:, 0]
    u -= (u * center).sum(axis=1, keepdims=True) * center
    u, v = unit(u)[:, None], unit(np.cross(center, u))[:, None]
    size = 10.0 ** generator.uniform(-1.5, -0.3, size=(count, 1, 1))
    angle = 2.0 * np.pi * np.arange(corners) / corners
    polygons = center[:, None] + size * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
    return np.ascontiguousarray(polygons.transpose(2, 1, 0), dtype=np.float32)


def test_degrees_beyond_the_fast_path_are_shaded_in_double():
    table = shading.load_table("ltsh2")
    rows, columns, curves, _ = table.coefficients.shape
    wider = np.zeros((rows, columns, curves, 28))
    wider[..., :6] = table.coefficients
    same = replace(table, degree=6, coefficients=wider)
    samples, lights = all_kinds_of_samples(60, seed=7), white_lights(four_lights())
    found = shading.shade(samples, lights, same, workers=1)
    expected = shading.shade(samples, lights, table, workers=1, dtype=np.float64)
    assert found.specular.dtype == np.float32
    assert np.abs(found.specular - expected.specular).max() < 1e-6
    with pytest.raises(ValueError, match="degree 6, the single precision path goes up to 4"):
        moments32.prepare(same)


def test_other_types_are_refused():
    with pytest.raises(ValueError, match="dtype is int64, expected float32 or float64"):
        shading.shade(random_samples(3), four_lights(), dtype=np.int64)
