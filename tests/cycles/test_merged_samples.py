"""One sample stands for the hits of a pixel on one surface, and the picture stays what it was."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from surface_scenes import single_sample

from ltsh_addon.cycles import gbuffer
from ltsh_addon.cycles.gbuffer import FinerPoints, finer, merged
from ltsh_addon.scene import Film, SurfaceSamples

POINTS, SIDE = 8, 4


def hits(seed, bend=0.0, step=0.0):
    """Samples of a textured floor that is bent, and has a step in the middle of each pixel; each pixel has POINTS."""
    random = np.random.default_rng(seed)
    pixel = np.tile(np.arange(SIDE * SIDE), POINTS)
    inside = random.random((len(pixel), 2))
    inside[: SIDE * SIDE] = 0.4  # the pixels' centers come first, left of the step
    place = np.stack([pixel % SIDE, pixel // SIDE], axis=1) + inside
    normal = np.stack([bend * place[:, 0], np.zeros(len(pixel)), np.ones(len(pixel))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    one = single_sample(roughness=0.4).take(np.zeros(len(pixel), int))
    position = np.concatenate([0.1 * place, np.where(inside[:, :1] > 0.5, step, 0.0)], axis=1)
    fields = {name: normal for name in ("normal", "diffuse_normal", "geometric_normal", "smooth_normal")}
    albedo = random.random((len(pixel), 3))
    return replace(one, position=position, diffuse_albedo=albedo, **fields), Film(SIDE, SIDE, pixel, POINTS)


@pytest.mark.parametrize(("bend", "step", "left"), [(0.0, 0.0, 1), (0.0, 0.5, 2), (3.0, 0.0, None)])
def test_flat_surfaces_keep_one_sample_each_and_bent_ones_more(bend, step, left):
    samples, film = hits(0, bend, step)
    found, small = gbuffer.merged(samples, film)
    if left is not None:
        assert len(found) == left * SIDE * SIDE
    else:
        assert len(found) > 2 * SIDE * SIDE
    assert small.count.sum() == len(samples)
    np.testing.assert_allclose(small.coverage(), film.coverage())


@given(st.integers(0, 1000), st.sampled_from((0.0, 0.3)), st.sampled_from((0.0, 0.5)))
def test_colors_keep_their_mean(seed, bend, step):
    samples, film = hits(seed, bend, step)
    found, small = gbuffer.merged(samples, film)
    np.testing.assert_allclose(small.image(found.diffuse_albedo), film.image(samples.diffuse_albedo), atol=1e-12)


def test_lobes_of_one_hit_stay_together():
    samples, film = hits(5)
    twice = np.repeat(np.arange(len(samples)), 2)
    samples, film = samples.take(twice), replace(film.take(twice), first=np.arange(2 * len(samples)) % 2 == 0)
    samples = replace(samples, roughness=np.where(film.first, 0.3, 0.7))
    found, small = gbuffer.merged(samples, film)
    np.testing.assert_array_equal(found.roughness, np.tile([0.3, 0.7], SIDE * SIDE))
    np.testing.assert_allclose(small.coverage(), film.coverage())


def test_points_that_share_a_shadow_are_alike_and_stand_for_all():
    samples, film = hits(7, bend=0.3, step=0.5)
    film = film.shared(np.ones((POINTS, 3, 3)), np.arange(len(samples)) // SIDE**2, np.ones((SIDE, SIDE), bool))
    merged, own = gbuffer.merged(samples, film)
    leaders, small, place = gbuffer.with_one_shadow(merged, own)
    # Bent surfaces are shaded where they are, but share their shadows on both sides of the step.
    assert len(merged) > 4 * SIDE * SIDE and len(leaders) < 0.8 * len(merged)
    assert small.count.sum() == len(samples) and np.array_equal(small.pixel[place], own.pixel)
    np.testing.assert_allclose(small.coverage(), 1.0, atol=1e-6)
    apart = leaders.position[place] - merged.position
    assert np.abs((apart * merged.geometric_normal).sum(axis=1)).max() < 0.2 * np.linalg.norm(apart, axis=1).max()


WIDTH, MORE = 12, 64


def filtered(offset):
    """The density of a pixel filter that reaches 0.75 pixels far."""
    return np.where(np.abs(offset) < 0.75, 1.0 + np.cos(np.pi * offset / 0.75), 0.0)


def shared_points(count):
    """Points of a pixel, right and up of its center, evenly, and their weights in the pixels around."""
    points = (np.arange(count)[:, None] * [0.7548776662466927, 0.5698402909980532] + 0.5) % 1.0 - 0.5
    steps = np.arange(-1, 2)
    return points, filtered(points[:, 1:] + steps)[:, :, None] * filtered(points[:, :1] - steps)[:, None]


def floor_seen_from_above(points):
    """Samples of a level floor that a camera 10 m above it sees, their film, and more points of the pixels."""
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) * 0.1, (np.arange(WIDTH) + 0.5) * -0.1)
    offsets, weights = shared_points(points)
    place = np.stack([x.ravel(), y.ravel(), np.zeros(WIDTH**2)], axis=1)
    place = np.concatenate([place + [*(0.1 * offset), 0.0] for offset in offsets])
    view = [0.6, -0.6, 10.0] - place
    one = single_sample(roughness=0.4).take(np.zeros(len(place), int))
    normals = dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), np.zeros_like(place))
    normals = {name: values + [0.0, 0.0, 1.0] for name, values in normals.items()}
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    samples = replace(one, position=place, view=view, **normals)
    seen = np.ones((WIDTH, WIDTH), bool)
    film = Film(WIDTH, WIDTH, np.tile(np.arange(WIDTH**2), points), points)
    film = film.shared(weights, np.repeat(np.arange(points), WIDTH**2), seen)
    starts, directions = np.zeros((2, 3, 3))
    starts[0], directions[0] = [0.6, -0.6, 10.0], [-0.6, 0.6, -10.0]
    directions[1:, :2] = [[0.1, 0.0], [0.0, -0.1]]
    return samples, film, FinerPoints(starts, directions, *shared_points(MORE), weights.sum(0))


def met(origin, direction):
    """Where rays meet the floor: nothing is in front of it."""
    return -origin[:, 2] / direction[:, 2], np.zeros(len(origin), bool)


def refined(points, pixels, number=MORE, met=met):
    samples, film, finer_points = floor_seen_from_above(points)
    samples, film = merged(samples, film)
    chosen = {"pixel": pixels, "number": np.full(len(pixels), number)}
    more, own, replaced = finer(samples, film, finer_points, chosen, met)
    return SurfaceSamples.joined([samples.take(~replaced), more]), film.take(~replaced).with_more(own), replaced


@pytest.mark.parametrize("number", [8, MORE])
def test_more_points_of_some_pixels_weigh_as_much_as_few(number):
    _, film, replaced = refined(5, np.array([0, 40, 41, 66, 143]), number)
    assert np.count_nonzero(replaced) == 5 and len(film.pixel) == WIDTH**2 - 5 + 5 * number
    np.testing.assert_allclose(film.coverage(), 1.0, atol=1e-6)
    assert set(np.flatnonzero(film.has_more())) == {0, 40, 41, 66, 143}


def test_an_edge_through_pixels_with_more_points_is_where_the_filter_has_it():
    """A slanted edge is the integral of the filter over the side that shines."""
    samples, film, _ = refined(5, np.arange(WIDTH**2))
    few, few_film, _ = floor_seen_from_above(5)

    def edge(position):
        return (position[..., 0] + 0.3 * position[..., 1] > 0.41).astype(float)

    offset = np.stack(np.meshgrid(*[np.linspace(-0.75, 0.75, 150)] * 2), axis=-1).reshape(-1, 2)
    place = few.position[: WIDTH**2, None] + 0.1 * np.pad(offset, ((0, 0), (0, 1)))
    true = np.average(edge(place), axis=1, weights=filtered(offset).prod(axis=1)).reshape(WIDTH, WIDTH)
    inside = np.s_[2:-2, 2:-2]
    error, before = (
        np.abs(own.image(edge(one.position)) - true)[inside].max() for one, own in ((samples, film), (few, few_film))
    )
    # An edge passes between some 8 of the points of a pixel.
    assert error < 2.0 / MORE < 0.3 * before


def test_only_pixels_of_which_all_is_known_get_more_points():
    """A pixel stays as it is where the renderer saw something else, a point has something else in its way, or is off
    the plane."""

    def higher(origin, direction):
        distance, _ = met(origin, direction)
        place = origin + distance[:, None] * direction
        # A step of 1 mm right of 0.62 m, something transparent left of 0.25 m.
        return distance - np.where(place[:, 0] > 0.62, 1e-3, 0.0), place[:, 0] < 0.25

    _, film, replaced = refined(5, np.arange(WIDTH**2), met=higher)
    column = np.flatnonzero(film.has_more()) % WIDTH
    assert set(column) == {3, 4, 5} and np.count_nonzero(replaced) == 3 * WIDTH
    samples, film, points = floor_seen_from_above(5)
    samples = replace(samples, smooth_normal=samples.smooth_normal + [0.01, 0.0, 0.0])
    chosen = {"pixel": np.arange(WIDTH**2), "number": np.full(WIDTH**2, MORE)}
    more, _, replaced = finer(*merged(samples, film), points, chosen, met)
    assert len(more) == 0 and not replaced.any()
