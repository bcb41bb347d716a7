"""The figures of finished pictures, by pictures whose errors are known."""

import numpy as np
import pytest
from finished import figures

SHAPE = (60, 80, 3)


def noise(seed, size=0.3):
    return size * np.random.default_rng(seed).standard_normal(SHAPE)


def test_noise_of_the_truth_is_no_error():
    image = 1.05 * np.ones(SHAPE)
    l2, _, _ = figures((image, image), (1.0 + noise(1), 1.0 + noise(2)))
    # The mean of 14,400 products of two noises of 0.3 deviates by 0.09 / 120, a third of 0.05**2: a sixth in the root.
    assert l2 == pytest.approx(0.05, rel=0.3)


def test_direct_light_of_the_halves_counts_as_perfect():
    direct, rest = [1.0 + noise(3), 1.0 + noise(4)], [1.0 + noise(5, 0.01), 1.0 + noise(6, 0.01)]
    halves = [one + other for one, other in zip(direct, rest, strict=True)]
    l2, _, _ = figures([1.1 + one for one in direct], halves)
    assert l2 == pytest.approx(0.05, rel=0.03)  # 0.1 of 2; noise of 0.01 moves it by 1e-4 at most


def test_the_brightest_pixels_are_left_out_of_the_second_figure():
    true = np.full(SHAPE, 0.5)
    true[:3, :3] = 50.0  # 9 of 4,800 pixels
    image = true.copy()
    image[:3, :3] *= 1.5
    image[10:] += 0.05
    l2, dim, _ = figures((image, image), (true, true))
    bright, others = 27 * 25.0**2, 3 * 50 * 80 * 0.05**2
    norms = 27 * 50.0**2, (SHAPE[0] * SHAPE[1] * 3 - 27) * 0.25
    assert l2 == pytest.approx(np.sqrt((bright + others) / sum(norms)), rel=1e-6)
    assert dim == pytest.approx(np.sqrt(others / norms[1]), rel=1e-6)
