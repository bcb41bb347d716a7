"""Error figures against hand-computed numbers and against noise of known size."""

import numpy as np
import pytest

from ltsh_addon.imaging import metrics


def test_figures_of_a_small_example_by_hand():
    reference = np.array([[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    technique = np.array([[[1.5, 0.0, 0.0], [0.0, 2.0, 1.0]]])
    figures = metrics.error_statistics(technique, reference)
    assert figures.relative_l2 == pytest.approx(np.sqrt(1.25 / 5.0), rel=1e-12)
    assert figures.unbiased_relative_error == pytest.approx(figures.relative_l2, rel=1e-12)
    assert figures.bias == pytest.approx(4.5 / 3.0 - 1.0, rel=1e-12)
    assert figures.median_relative_error == pytest.approx(0.5, rel=1e-12)  # both pixels are off by half their norm
    assert figures.relative_rmse == pytest.approx(0.5, rel=1e-12)
    assert figures.max_relative_error == pytest.approx(0.5, rel=1e-12)
    assert figures.max_absolute_error == 1.0
    assert (figures.pixels, figures.not_finite) == (2, 0)


def test_unbiased_error_is_that_of_the_truth_where_the_naive_one_is_the_noise():
    generator = np.random.default_rng(5)
    truth = generator.uniform(0.5, 2.0, (200, 200, 3))
    technique = truth * (1.0 + 0.01 * np.sign(generator.normal(size=truth.shape)))  # off by exactly 1 % everywhere
    half_a, half_b = (truth + 0.1 * truth * generator.normal(size=truth.shape) for _ in range(2))
    figures = metrics.noisy_error_statistics(technique, half_a, half_b)
    # e^2 has standard deviation of about 0.1^2 / sqrt(120000) = 3e-5 against e^2 = 1e-4: four of them.
    assert figures.unbiased_squared_error == pytest.approx(1e-4, abs=1.2e-4)
    assert figures.relative_l2 > 0.06  # 0.1 / sqrt(2): the noise of the mean
    assert metrics.reference_noise(half_a, half_b) == pytest.approx(0.1 / np.sqrt(2.0), rel=0.02)


def test_error_below_the_noise_is_zero_and_its_square_may_be_negative():
    truth = np.ones((4, 4, 3))
    half_a, half_b = truth + 0.1, truth - 0.1
    error, squared = metrics.unbiased_relative_error(truth, half_a, half_b)
    assert error == 0.0
    assert squared == pytest.approx(-0.01 / 0.99, rel=1e-9)


def test_values_that_are_not_finite_are_counted_and_left_out_as_those_outside_the_mask():
    reference = np.ones((4, 1, 3))
    technique = reference * 1.1
    technique[0, 0, 1], technique[2, 0, 0], technique[3] = np.nan, np.inf, 5.0
    figures = metrics.error_statistics(technique, reference, np.array([[True], [True], [True], [False]]))
    assert (figures.not_finite, figures.pixels) == (2, 3)
    assert figures.relative_l2 == pytest.approx(0.1, rel=1e-9)
    with pytest.raises(ValueError, match=r"shape \(4, 4\), expected"):
        metrics.error_statistics(np.ones((4, 4)), np.ones((4, 4)))


@pytest.mark.parametrize("case", ["empty mask", "black reference"])
def test_figures_without_meaning_are_none(case):
    reference = np.zeros((2, 2, 3)) if case == "black reference" else np.ones((2, 2, 3))
    mask = np.zeros((2, 2), dtype=bool) if case == "empty mask" else None
    figures = metrics.error_statistics(np.ones((2, 2, 3)), reference, mask).to_dict()
    for name in ("relative_l2", "unbiased_relative_error", "bias", "median_relative_error", "relative_rmse"):
        assert figures[name] is None, name
    assert metrics.reference_noise(reference, reference, mask) is None
