"""Diffuse light of few points of a pixel, with what many samples know of colors and normals."""

from dataclasses import replace

import numpy as np
import pytest
from surface_scenes import single_sample

from ltsh_addon.pipeline.aliasing import factor_of_samples
from ltsh_addon.scene import Film

SIDE, POINTS, MANY = 12, 3, 2000
SUN = np.array([0.3, 0.2, 0.9])


def cloth(count, seed, stripes=1.0):
    """Samples of a bumped, colored surface, `count` in each pixel; and their film."""
    random = np.random.default_rng(seed)
    pixel = np.tile(np.arange(SIDE * SIDE), count)
    bump = np.concatenate([0.4 * random.uniform(-1.0, 1.0, (len(pixel), 2)), np.ones((len(pixel), 1))], axis=1)
    normal = bump / np.linalg.norm(bump, axis=1, keepdims=True)
    albedo = np.where(random.random((len(pixel), 1)) < 0.5, [0.2, 0.4, 0.6], stripes * np.array([0.2, 0.4, 0.6]))
    one = single_sample().take(np.zeros(len(pixel), int))
    return replace(one, normal=normal, diffuse_normal=normal, diffuse_albedo=albedo), Film(SIDE, SIDE, pixel, count)


def light(samples):
    """The light of the sun and of a sky, linear in the normal."""
    return samples.diffuse_albedo * (0.5 + samples.diffuse_normal @ SUN)[:, None]


def truth(stripes):
    """The picture, and the mean colors and normals, of many samples."""
    samples, film = cloth(MANY, 99, stripes)
    return film.image(light(samples)), film.image(samples.diffuse_albedo), film.image(samples.diffuse_normal)


def errors(stripes, seed):
    """Root mean square errors of the picture of the points: as it is, with the color alone, and with both."""
    samples, film = cloth(POINTS, seed, stripes)
    true, color, normal = truth(stripes)
    picture, points = film.image(light(samples)), film.image(samples.diffuse_albedo)
    factor = factor_of_samples(film, samples, light(samples), color, normal, MANY)
    pictures = picture, picture * color / points, picture * factor
    return [float(np.sqrt(np.mean(np.square(one - true)))) for one in pictures]


@pytest.mark.parametrize("stripes", [1.0, 2.0])
def test_bumps_and_textures_finer_than_pixels_have_the_mean_of_many_samples(stripes):
    found = np.mean([errors(stripes, seed) for seed in range(5)], axis=0)
    # The light is linear in the normal. But the variance among points at random explains their mean half of the time
    # only in part; and with stripes, products of deviations of normals and colors are left.
    assert found[2] < 0.55 * found[1]
    assert found[1] < 0.8 * found[0] or stripes == 1.0


def test_normals_of_something_else_change_nothing():
    samples, film = cloth(POINTS, 1)
    _, color, normal = truth(1.0)
    mirrored = normal * [-1.0, 1.0, 0.2]  # what is seen in a mirror
    factor = factor_of_samples(film, samples, light(samples), color, mirrored, MANY)
    own = factor_of_samples(film, samples, light(samples), color, film.image(samples.diffuse_normal), MANY)
    right = factor_of_samples(film, samples, light(samples), color, normal, MANY)
    # The difference of the normals is 5 times as large as that of the points' own mean, and counts a twentieth.
    assert np.abs(mirrored - normal).max() > 0.7
    assert np.std(factor - own) < 0.3 * np.std(right - own)


def test_even_surfaces_and_pixels_without_a_surface_keep_their_light():
    samples, film = cloth(POINTS, 2)
    up = np.broadcast_to([0.0, 0.0, 1.0], samples.normal.shape)
    samples, film = replace(samples, diffuse_normal=up).take(film.pixel > 4), film.take(film.pixel > 4)
    color = film.image(samples.diffuse_albedo)
    factor = factor_of_samples(film, samples, light(samples), color, film.image(samples.diffuse_normal), MANY)
    np.testing.assert_allclose(factor, 1.0, atol=1e-9)


def test_lobes_of_one_point_count_once():
    samples, film = cloth(POINTS, 3)
    _, color, normal = truth(1.0)
    expected = factor_of_samples(film, samples, light(samples), color, normal, MANY)
    twice = np.repeat(np.arange(len(samples)), 2)
    film = replace(film.take(twice), first=np.arange(2 * len(samples)) % 2 == 0)
    half = replace(samples, diffuse_albedo=0.5 * samples.diffuse_albedo).take(twice)
    found = factor_of_samples(film, half, light(half), color, normal, MANY)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
