"""The comparison sheet and its text."""

import string

import numpy as np
import pytest

from ltsh_addon.imaging import Tile, comparison_sheet, font, sheet
from ltsh_addon.imaging.color import exposure_factor, to_srgb8


def picture(width, height, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 2.0, (height, width, 3))


def contains(page, part):
    """Whether the pixels `part` stand somewhere in `page`."""
    rows, columns = np.nonzero((page == part[0, 0]).all(axis=-1))
    height, width = part.shape[:2]
    return any(np.array_equal(page[y : y + height, x : x + width], part) for y, x in zip(rows, columns, strict=True))


@pytest.mark.parametrize("count", [1, 4, 7])
def test_every_picture_stands_on_the_sheet_pixel_for_pixel(count):
    reference = picture(240, 30)
    tiles = [Tile(f"T{k}", picture(240, 30, k + 1), picture(240, 30, k + 20) - 1.0, ["1 %"]) for k in range(count)]
    page = comparison_sheet("title", ("Cycles", reference), tiles)
    assert page.dtype == np.uint8
    exposure = exposure_factor(reference)
    for image in (reference, *(tile.image for tile in tiles)):
        assert contains(page, to_srgb8(exposure * image))


def test_tiny_images_are_enlarged_by_whole_factors():
    image = picture(16, 9)
    enlarged = sheet._resized(image)
    assert enlarged.shape == (135, 240, 3)
    assert np.array_equal(enlarged[::15, ::15], image) and np.array_equal(enlarged[14::15, 14::15], image)


def test_large_images_are_reduced_without_changing_their_mean():
    image = picture(1000, 333)
    reduced = sheet._resized(image)
    assert reduced.shape == (160, 480, 3)
    assert reduced.mean() == pytest.approx(image.mean(), rel=1e-9)  # a box filter is a partition of the image
    assert np.allclose(sheet._resized(np.full((333, 1000, 3), 0.25)), 0.25, rtol=1e-12)


@pytest.mark.parametrize("case", ["black", "no error", "not finite"])
def test_odd_images_make_a_sheet(case):
    image, error = picture(32, 18), picture(32, 18, 1) - 1.0
    if case == "black":
        image = np.zeros_like(image)
    elif case == "no error":
        error = np.zeros_like(error)
    else:
        error[3, 3], image[2, 2] = np.nan, np.inf
    page = comparison_sheet("t", ("Cycles", image), [Tile("T", image, error)])
    assert page.ndim == 3


def test_images_of_different_size_are_refused():
    with pytest.raises(ValueError, match="'T'.*shape"):
        comparison_sheet("t", ("Cycles", picture(32, 18)), [Tile("T", picture(16, 9), picture(16, 9))])


def test_text_stays_in_its_box_and_draws_ink():
    for size in (14.0, 26.0):
        width, height = font.text_size("Agjy|_{}", size)
        image = np.full((height + 40, width + 40, 3), 255, dtype=np.uint8)
        font.draw_text(image, 20, 20, "Agjy|_{}", (0, 0, 0), size)
        rows, columns = np.nonzero(image.min(axis=-1) < 255)
        assert rows.size > 50
        assert rows.min() >= 20 and rows.max() < 20 + height and columns.min() >= 20 and columns.max() < 20 + width


def test_every_printable_character_looks_different():
    looks = {}
    for character in string.printable[:95].replace(" ", ""):
        image = np.full((40, 40, 3), 255, dtype=np.uint8)
        font.draw_text(image, 4, 4, character, (0, 0, 0), 28.0)
        looks.setdefault(image.tobytes(), []).append(character)
    assert [group for group in looks.values() if len(group) > 1] == []


def test_long_text_is_shortened_and_wrapped_to_fit():
    text = "signed error of a technique with a long explanation " * 3
    assert font.text_size(font.shorten(text, 200), 14.0)[0] <= 200
    assert all(font.text_size(line)[0] <= 200 for line in font.wrap(text, 200))
    assert " ".join(font.wrap(text, 200)) == " ".join(text.split())
