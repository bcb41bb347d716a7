"""Color spaces and the colors of signed errors."""

import numpy as np
import pytest

from ltsh_addon.imaging import color
from ltsh_addon.imaging.color import NOT_FINITE_COLOR, color_bar, signed_error_colors
from ltsh_addon.scene import REC709, ColorSpace

# ITU-R BT.2087-0, annex 2: the published matrix from linear Rec.2020 to linear Rec.709, four digits.
REC2020_TO_REC709 = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]


@pytest.mark.parametrize("name", color.CHROMATICITIES)
def test_white_stays_white_and_each_matrix_finds_its_name(name):
    matrix = color.matrix_to_rec709(color.CHROMATICITIES[name])
    assert np.abs(matrix.sum(axis=1) - 1.0).max() < 1e-12
    found = color.identified(matrix + 1e-4, "anything")
    assert found.name == name and color.chromaticities(found) == color.CHROMATICITIES[name]


def test_the_matrix_of_rec2020_is_the_published_one():
    matrix = color.matrix_to_rec709(color.CHROMATICITIES["Linear Rec.2020"])
    assert np.abs(matrix - REC2020_TO_REC709).max() < 1e-4
    assert np.allclose(color.matrix_to_rec709(color.CHROMATICITIES["Linear Rec.709"]), np.eye(3))
    luminance = color.rgb_to_xyz(color.CHROMATICITIES["Linear Rec.709"])[1]
    assert np.abs(luminance - [0.2126, 0.7152, 0.0722]).max() < 1e-4


def test_a_space_without_a_known_name_has_the_chromaticities_of_its_matrix():
    given = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)
    space = color.identified(color.matrix_to_rec709(given), "Display P3")
    assert space.name == "Display P3" and np.allclose(color.chromaticities(space), given, atol=1e-12)
    assert "custom" in color.identified(space.to_rec709).name


def test_colors_are_column_vectors():
    space = ColorSpace("Linear Rec.2020", REC2020_TO_REC709)
    image = np.zeros((2, 4, 3))
    image[1, 2] = (0.0, 1.0, 0.0)
    assert np.allclose(space.rec709(image)[1, 2], [-0.5876, 1.1329, -0.1006])
    assert np.array_equal(REC709.rec709(image), image)
    with pytest.raises(ValueError, match="color space 'odd'"):
        ColorSpace("odd", np.eye(4))


def lightness(srgb):
    """CIE L* of sRGB display values (..., 3)."""
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    y = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(y > 0.008856, 116.0 * np.cbrt(y) - 16.0, 903.3 * y)


def gray(value):
    return np.full((1, 1, 3), value)


def test_zero_is_nearly_white_too_bright_is_red_and_too_dark_is_blue_up_to_the_scale():
    white, red, blue = (signed_error_colors(gray(value), 1.0)[0, 0] for value in (0.0, 0.6, -0.6))
    assert white.min() > 0.95 and np.ptp(white) < 0.01
    assert red[0] > red[1] + 0.3 and red[0] > red[2] + 0.3
    assert blue[2] > blue[0] + 0.3 and blue[2] > blue[1] + 0.1
    for sign in (1.0, -1.0):
        assert np.array_equal(signed_error_colors(gray(7.0 * sign), 2.0), signed_error_colors(gray(2.0 * sign), 2.0))


def test_equal_errors_of_either_sign_are_equally_dark():
    errors = np.linspace(0.0, 1.0, 41)
    bright, dark = (lightness(signed_error_colors(sign * errors[None], 1.0))[0] for sign in (1.0, -1.0))
    assert np.abs(bright - dark).max() < 8.0  # L*; a difference of 10 is plainly seen, 2 hardly
    assert (np.diff(bright) < 0.0).all() and (np.diff(dark) < 0.0).all()


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
