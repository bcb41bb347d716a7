"""The figures of `make bench shadows` are free of noise, and name what they are given."""

import numpy as np
import pytest
import shadows

SHAPE = (200, 300, 3)
MASK = np.ones(SHAPE[:2], bool)


def noisy(truth, noise, seed):
    return truth * (1.0 + noise * np.random.default_rng(seed).normal(size=SHAPE))


@pytest.mark.parametrize("bias", [0.0, 0.02, 0.1])
def test_noise_of_both_sides_does_not_count_as_error(bias):
    truth = np.random.default_rng(0).uniform(0.5, 1.5, SHAPE)
    ours = [noisy(truth * (1.0 + bias), 0.1, seed) for seed in (1, 2)]
    error = shadows.unbiased(*ours, np.stack([noisy(truth, 0.1, seed) for seed in (3, 4)]), MASK)
    # e^2 is the mean of 1.8e5 products of two differences with deviation .14 each: 2 % / sqrt(1.8e5) = 5e-5.
    assert error.estimate**2 == pytest.approx(bias**2, abs=4 * 5e-5)
    assert error.least <= bias <= error.limit


def test_own_noise_is_that_of_one_picture():
    # Of 1.8e5 values: .2 % of itself; three times that.
    noise = shadows.own_noise(noisy(1.0, 0.05, 1), noisy(1.0, 0.05, 2), MASK)
    assert noise == pytest.approx(0.05, rel=0.006)


def test_terrain_has_as_many_triangles_as_asked_for():
    occluders, grid = shadows.terrain(20_000)
    assert shadows.triangle_count(occluders) == pytest.approx(20_000, rel=0.02)
    assert grid.reshape(-1, 3).astype(np.float32) == pytest.approx(occluders.meshes[0].vertices)
