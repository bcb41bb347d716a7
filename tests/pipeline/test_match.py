"""Factors of lights by non-negative least squares, against all active sets one by one and against known factors."""

import itertools

import numpy as np
import pytest

from ltsh_addon.pipeline.light_search import SQUARE, in_squares, non_negative_least_squares
from ltsh_addon.pipeline.match import PIXELS, matched_factors, reduced

# STEADY draws factors to 1 by 1e-6 x (target / what differs between the layers)^2. Means over squares of these random
# layers differ by some 20 % of a layer, a tenth of the target, and the factors are up to 3.
DRAWN = 1e-3


def by_all_active_sets(matrix, target):
    """The least squares without negative values: the best among those of all subsets of the columns."""
    columns = range(matrix.shape[1])
    best, error = np.zeros(matrix.shape[1]), np.linalg.norm(target)
    for chosen in itertools.chain(*(itertools.combinations(columns, count) for count in range(1, len(columns) + 1))):
        values = np.linalg.lstsq(matrix[:, chosen], target, rcond=None)[0]
        off = np.linalg.norm(matrix[:, chosen] @ values - target)
        if values.min() >= 0.0 and off < error - 1e-13:
            best, error = np.zeros(matrix.shape[1]), off
            best[list(chosen)] = values
    return best


@pytest.mark.parametrize("seed", range(40))
def test_the_solver_has_the_least_error_of_all_active_sets(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(12, 5)) if seed % 2 else rng.uniform(size=(12, 5))
    target = matrix @ rng.normal(size=5) + 0.1 * rng.normal(size=12)
    # The normal equations square the condition, which is below 1e3 here: errors of 1e-16 x 1e6.
    solution = non_negative_least_squares(matrix, target)
    np.testing.assert_allclose(solution, by_all_active_sets(matrix, target), atol=1e-9)


def test_equal_columns_and_a_zero_column_end_with_the_least_error():
    rng = np.random.default_rng(1)
    one = rng.uniform(size=(20, 1))
    matrix, target = np.concatenate([one, one, np.zeros((20, 1))], axis=1), 3.0 * one[:, 0]
    solution = non_negative_least_squares(matrix, target)
    assert solution.min() >= 0.0
    np.testing.assert_allclose(matrix @ solution, target, rtol=1e-9)
    assert not non_negative_least_squares(one, -one[:, 0]).any()


@pytest.fixture
def pictures():
    rng = np.random.default_rng(2)
    layers = rng.gamma(0.7, size=(4, 23, 31, 3))
    return layers, rng.uniform(size=(23, 31, 3)), np.array([0.2, 1.0, 3.0, 0.0])


def test_known_factors_come_back(pictures):
    layers, fixed, factors = pictures
    target = np.einsum("rhwc,r->hwc", layers, factors) + fixed
    weights = np.ones(target.shape[:2])
    # Outside of the mask the target may be anything, inside a square too.
    weights[3:9, 4:17], target[3:9, 4:17] = 0.0, 77.0
    result = matched_factors(layers, fixed, target, weights)
    np.testing.assert_allclose(result.factors, np.repeat(factors[:, None], 3, axis=1), atol=DRAWN)
    assert result.after < DRAWN < result.before


def test_colors_have_a_factor_for_each_channel(pictures):
    layers, fixed, _ = pictures
    factors = np.random.default_rng(3).uniform(0.0, 2.0, (4, 3))
    target = np.einsum("rhwc,rc->hwc", layers, factors) + fixed
    colored = matched_factors(layers, fixed, target, np.ones((23, 31)), colors=True)
    np.testing.assert_allclose(colored.factors, factors, atol=DRAWN)
    assert matched_factors(layers, fixed, target, np.ones((23, 31))).after > 0.05


def test_a_light_that_gives_nothing_keeps_its_power(pictures):
    layers, fixed, _ = pictures
    layers = np.concatenate([layers, np.zeros((1, *fixed.shape))])
    target = np.einsum("rhwc,r->hwc", layers, np.array([2.0, 2.0, 2.0, 2.0, 5.0])) + fixed
    result = matched_factors(layers, fixed, target, np.ones((23, 31)))
    np.testing.assert_allclose(result.factors[4], 1.0)
    assert result.shares[4] == 0.0
    assert 0.5 < result.shares.sum() < 1.0


def test_squares_have_the_weighted_means_of_their_pixels():
    rng = np.random.default_rng(4)
    image, weights = rng.normal(size=(2, 13, 11, 3)), rng.uniform(size=(13, 11))
    means = in_squares(image, weights)
    assert means.shape == (2, 3, 3, 3)
    last = np.s_[10:13, 10:11]
    expected = np.average(image[:, *last].reshape(2, -1, 3), axis=1, weights=weights[last].ravel())
    np.testing.assert_allclose(means[:, 2, 2], expected)
    assert SQUARE == 5


def test_a_large_target_is_reduced_to_means_over_equal_areas():
    rng = np.random.default_rng(5)
    image = rng.uniform(size=(700, 1111, 3))
    small = reduced(image)
    height, width = small.shape[:2]
    assert 0.98 * PIXELS < height * width < 1.02 * PIXELS
    np.testing.assert_allclose(small.mean(axis=(0, 1)), image.mean(axis=(0, 1)), rtol=1e-12)
    # The first pixel by brute force: the image with each pixel cut into 40 x 40.
    sides = 700 / height, 1111 / width
    rows, columns = ((np.arange(200) + 0.5) / 40 < side for side in sides)
    cells = np.repeat(np.repeat(image[:5, :5], 40, axis=0), 40, axis=1)[rows][:, columns]
    # The cut is as fine as 1/40 of a pixel, of some 2.3.
    np.testing.assert_allclose(small[0, 0], cells.mean(axis=(0, 1)), atol=0.02)
    np.testing.assert_array_equal(reduced(image[:100, :100]), image[:100, :100])
