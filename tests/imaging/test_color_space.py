"""Color spaces: matrices from chromaticities, names from matrices."""

import numpy as np
import pytest

from ltsh_addon.imaging import color
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


def test_luminance_is_the_second_row():
    weights = color.rgb_to_xyz(color.CHROMATICITIES["Linear Rec.709"])[1]
    assert np.abs(weights - [0.2126, 0.7152, 0.0722]).max() < 1e-4


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


def test_a_matrix_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="color space 'odd'"):
        ColorSpace("odd", np.eye(4))
