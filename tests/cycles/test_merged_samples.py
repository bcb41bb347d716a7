"""One sample stands for the hits of a pixel on one surface, and the picture stays what it was."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from surface_scenes import single_sample

from ltsh_addon.cycles import gbuffer
from ltsh_addon.scene import Film

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


def test_shadows_of_a_sample_are_those_of_all_for_which_it_stands():
    samples, film = hits(7, step=0.5)
    merged, own = gbuffer.merged(samples, film)
    shadowed, again, _ = gbuffer.with_one_shadow(merged, own)
    for found, its_film in ((merged, own), (shadowed, again)):
        there = np.concatenate([found.position[:, None], found.position[:, None] + its_film.extent], axis=1)
        assert its_film.take([3]).extent.shape == (1, 7, 3) or its_film.extent.shape[1] < 7
        for pixel in range(SIDE * SIDE):
            of_pixel = np.concatenate(there[its_film.pixel == pixel])
            apart = np.linalg.norm(of_pixel[:, None] - samples.position[film.pixel == pixel], axis=-1)
            # In single precision; all points of the pixel, on both sides of the step.
            assert (apart.min(axis=1) < 1e-7).all() and set(apart.argmin(axis=1)) == set(range(POINTS))


def ball(points, seed, roughness, side=12):
    """Samples of the top of a shiny ball, seen from above in square pixels that turn by 2 degrees each way."""
    random = np.random.default_rng(seed)
    pixel = np.tile(np.arange(side * side), points)
    inside = random.random((len(pixel), 2))
    # A point in each strip of a pixel.
    inside[:, 0] = (np.repeat(np.arange(points), side * side) + inside[:, 0]) / points
    place = np.stack([pixel % side, pixel // side], axis=1) + inside - 0.5 * side
    normal = np.concatenate([np.radians(2.0) * place, np.ones((len(pixel), 1))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    one = single_sample(roughness=roughness).take(np.zeros(len(pixel), int))
    one = replace(one, specular_f0=np.ones((len(pixel), 3)))
    fields = {name: normal for name in ("normal", "diffuse_normal", "geometric_normal", "smooth_normal")}
    view = np.broadcast_to([0.0, 0.0, 1.0], normal.shape)
    return replace(one, position=normal, view=view, **fields), Film(side, side, pixel, points)


def picture(samples, film):
    """Specular light of a small lamp, by GGX itself."""
    lamp = np.array([0.3, 0.1, 3.0])
    direction = lamp - samples.position
    distance = np.linalg.norm(direction, axis=1, keepdims=True)
    direction /= distance
    half = samples.view + direction
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine, alpha = (half * samples.normal).sum(axis=1), samples.roughness**2
    density = alpha**2 / (np.pi * (1.0 + (alpha**2 - 1.0) * cosine**2) ** 2)
    return film.image(density / distance[:, 0] ** 2)


@pytest.mark.parametrize("points", [3, 8])
def test_highlights_thinner_than_pixels_do_not_fall_between_points(points):
    # The highlight is a tenth of a pixel wide.
    truth = picture(*ball(2000, 0, 0.05))
    errors = []
    for seed in range(60):
        samples, film = ball(points, seed, 0.05)
        both = samples, gbuffer.with_widened_lobes(samples, film, points)
        errors.append([picture(one, film) - truth for one in both])
    plain, widened = np.sqrt(np.square(errors).mean(axis=(0, 2, 3)))
    # Twice as many points, or more, would have this error without wider lobes.
    assert widened < 0.65 * plain


def test_what_is_flat_or_an_edge_or_rough_stays_as_sharp():
    samples, film = hits(0)
    np.testing.assert_array_equal(gbuffer.with_widened_lobes(samples, film, POINTS).roughness, samples.roughness)
    # Two walls at a right angle in each pixel.
    wall = np.where((np.arange(len(samples)) % 2 == 0)[:, None], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    walls = replace(samples, **dict.fromkeys(("normal", "geometric_normal"), wall))
    np.testing.assert_array_equal(gbuffer.with_widened_lobes(walls, film, POINTS).roughness, samples.roughness)
    bent, film = hits(0, bend=0.3)
    widened = gbuffer.with_widened_lobes(bent, film, POINTS).roughness
    assert (widened >= bent.roughness).all() and widened.max() < 1.01 * bent.roughness.max()


def test_each_axis_of_a_brushed_lobe_takes_the_same_in():
    samples, film = ball(4, 1, 0.2)
    samples = replace(samples, anisotropy=np.full(len(samples), 0.5))
    widened = gbuffer.with_widened_lobes(samples, film, 4)

    def squares(one):
        alpha, across = one.roughness**2, 1.0 - one.anisotropy
        return np.square([alpha / across, alpha * across])

    added = squares(widened) - squares(samples)
    np.testing.assert_allclose(added[0], added[1], rtol=1e-9, atol=1e-12)
    assert (added > 0.0).all()


def test_flat_mirrors_stay_mirrors():
    samples, film = hits(0)
    nothing, brushed = np.zeros(len(samples)), np.full(len(samples), 0.5)
    mirror = replace(samples, roughness=nothing, anisotropy=brushed, specular_f0=np.ones((len(samples), 3)))
    widened = gbuffer.with_widened_lobes(mirror, film, POINTS)
    assert (widened.roughness == 0.0).all() and np.isfinite(widened.anisotropy).all()
