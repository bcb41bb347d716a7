"""Cutting images and outlines into patches, without Blender."""

import numpy as np
import pytest

from ltsh_addon.cycles.patches import ERROR, GRID, clip_to_cell, cut_into_patches, signed_area, split_light
from ltsh_addon.scene import light_of

PLACED = {
    "center": [1.0, 2.0, 3.0],
    "half_u": [0.6, 0.0, 0.0],
    "half_v": [0.0, 0.4, 0.0],
    "direction": [0.0, 0.0, -1.0],
}


def everywhere(image):
    return np.ones(image.shape[:2], bool)


def painted(patches, shape):
    """The image that patches make."""
    image = np.zeros((*shape, 3))
    for patch in patches.smallest:
        left, right, bottom, top = patch.cell
        columns = [round((side + 1.0) / 2.0 * shape[1]) for side in (left, right)]
        rows = [round((1.0 - side) / 2.0 * shape[0]) for side in (top, bottom)]
        image[slice(*rows), slice(*columns)] += patch.radiance
    return image


def test_a_constant_image_is_one_patch():
    image = np.full((32, 16, 3), 2.5)
    patches = cut_into_patches(image, everywhere(image))
    assert patches.whole.cell == (-1.0, 1.0, -1.0, 1.0) and np.allclose(patches.whole.radiance, 2.5)
    assert patches.whole.parts == () and patches.error == 0.0


@pytest.mark.parametrize("shape", [(64, 64), (256, 32), (100, 60), (1, 256)])
def test_the_stated_error_is_that_of_the_patches(shape):
    rows, columns = np.meshgrid(*(np.linspace(0.0, 1.0, count) for count in shape), indexing="ij")
    image = np.stack([1.0 + np.sin(5.0 * rows), columns**2, 0.2 + rows * columns], axis=-1)
    patches = cut_into_patches(image, everywhere(image))
    difference = np.abs(painted(patches, shape) - image).sum() / image.sum()
    assert difference == pytest.approx(patches.error, rel=1e-6) and patches.error <= ERROR
    # One patch of the mean would not do, and means keep the sum.
    assert len(patches.smallest) >= 8 and painted(patches, shape).sum() == pytest.approx(image.sum())


def test_noise_ends_at_the_finest_grid_and_says_so():
    image = np.random.default_rng(2).random((256, 256, 3))
    patches = cut_into_patches(image, everywhere(image))
    assert len(patches.smallest) == GRID * GRID and patches.error > ERROR
    assert len(cut_into_patches(image, everywhere(image), most=10).smallest) == 10


def test_pixels_that_are_not_covered_do_not_count():
    image = np.full((64, 64, 3), 3.0)
    covered = np.hypot(*np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64))) < 1.0
    image[~covered] = 1e6
    patches = cut_into_patches(image, covered)
    assert len(patches.smallest) == 1 and np.allclose(patches.whole.radiance, 3.0)


def test_dark_patches_are_left_out_and_a_dark_image_has_none():
    image = np.zeros((64, 64, 3))
    assert cut_into_patches(image, everywhere(image)).whole is None
    image[:32] = 1.0
    assert [patch.cell for patch in cut_into_patches(image, everywhere(image)).smallest] == [(-1.0, 1.0, 0.0, 1.0)]


def test_clipping_to_the_cells_of_a_grid_loses_no_area():
    generator = np.random.default_rng(11)
    star = generator.uniform(0.3, 1.0, 12)[:, None]
    angle = np.arange(12) * np.pi / 6.0
    outline = star * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    edges = np.linspace(-1.0, 1.0, 6)
    total = 0.0
    for left, right in zip(edges, edges[1:], strict=False):
        for bottom, top in zip(edges, edges[1:], strict=False):
            part = clip_to_cell(outline, (left, right, bottom, top))
            assert signed_area(part) >= 0.0
            assert np.all(part >= (left - 1e-12, bottom - 1e-12)) and np.all(part <= (right + 1e-12, top + 1e-12))
            total += signed_area(part)
    assert total == pytest.approx(abs(signed_area(outline)), rel=1e-12)


def area_of(light):
    corners = light.polygon() - light.center
    return 0.5 * np.dot(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0), light.direction)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
@pytest.mark.parametrize(("shape", "spread"), [("RECTANGLE", np.pi), ("ELLIPSE", np.pi), ("ELLIPSE", 1.0)])
def test_the_parts_of_a_light_have_its_power(shape, spread, direction):
    changes = {
        "name": "L",
        "shape": shape,
        "direction": [0, 0, direction],
        "radiance": [1.0, 1.0, 1.0],
        "spread": spread,
    }
    light = light_of(PLACED | changes)
    image = np.random.default_rng(7).random((64, 64, 3))
    area = 4.0 * 0.6 * 0.4 * (np.pi / 4.0 if shape == "ELLIPSE" else 1.0)
    # The mean of the image inside the ellipse is not known better than by its pixels.
    for picture, most, mean, tolerance in ((np.ones((64, 64, 3)), 1, 1.0, 1e-9), (image, 100, 0.5, 0.03)):
        (whole,) = split_light(light, cut_into_patches(picture, everywhere(picture), most=most))
        powers = [area_of(part) * part.radiance for part in whole.leaves]
        # Counterclockwise around the direction: all areas are positive.
        assert min(power.min() for power in powers) > 0.0
        assert np.allclose(sum(powers), area * mean, rtol=tolerance)
        assert {part.spread for part in whole.leaves} == {spread}
        if spread < np.pi and most > 1:
            assert {part.shape for part in whole.leaves} == {"RECTANGLE"}
