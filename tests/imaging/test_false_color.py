"""The colors of signed errors."""

import numpy as np
import pytest

from ltsh_addon.imaging.color import NOT_FINITE_COLOR, color_bar, signed_error_colors


def lightness(srgb):
    """CIE L* of sRGB display values (..., 3)."""
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    y = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(y > 0.008856, 116.0 * np.cbrt(y) - 16.0, 903.3 * y)


def gray(value):
    return np.full((1, 1, 3), value)


def test_zero_is_nearly_white_and_neutral():
    color = signed_error_colors(gray(0.0), 1.0)[0, 0]
    assert color.min() > 0.95 and np.ptp(color) < 0.01


def test_too_bright_is_red_and_too_dark_is_blue():
    red, blue = signed_error_colors(gray(0.6), 1.0)[0, 0], signed_error_colors(gray(-0.6), 1.0)[0, 0]
    assert red[0] > red[1] + 0.3 and red[0] > red[2] + 0.3
    assert blue[2] > blue[0] + 0.3 and blue[2] > blue[1] + 0.1


def test_equal_errors_of_either_sign_are_equally_dark():
    errors = np.linspace(0.0, 1.0, 41)
    bright, dark = (lightness(signed_error_colors(sign * errors[None], 1.0))[0] for sign in (1.0, -1.0))
    assert np.abs(bright - dark).max() < 8.0  # L*; a difference of 10 is plainly seen, 2 hardly
    assert (np.diff(bright) < 0.0).all() and (np.diff(dark) < 0.0).all()


def test_beyond_the_scale_colors_saturate():
    assert np.array_equal(signed_error_colors(gray(7.0), 2.0), signed_error_colors(gray(2.0), 2.0))
    assert np.array_equal(signed_error_colors(gray(-7.0), 2.0), signed_error_colors(gray(-2.0), 2.0))


def test_not_finite_has_a_color_of_its_own():
    error = np.array([[[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0, 0.0]]])
    colors = signed_error_colors(error, 1.0)
    assert np.array_equal(colors[0, 0], NOT_FINITE_COLOR) and np.array_equal(colors[0, 1], NOT_FINITE_COLOR)
    assert not np.array_equal(colors[0, 2], NOT_FINITE_COLOR)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_a_scale_that_is_not_positive_is_refused(scale):
    with pytest.raises(ValueError, match="positive"):
        signed_error_colors(gray(0.0), scale)


def test_the_bar_runs_from_too_dark_to_too_bright():
    bar = color_bar(101, 4)
    assert bar.shape == (4, 101, 3)
    assert bar[0, 0, 2] > bar[0, 0, 0] and bar[0, -1, 0] > bar[0, -1, 2]
    assert np.array_equal(bar[0, 50], signed_error_colors(gray(0.0), 1.0)[0, 0])
