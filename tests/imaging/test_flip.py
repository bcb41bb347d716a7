"""FLIP against the program of its authors, and against what follows from the paper by hand."""

import math

import numpy as np
import pytest

from ltsh_addon.imaging.metrics import PIXELS_PER_DEGREE, flip, mean_flip


def pictures(seed, kind="noise", shape=(40, 56)):
    """A pair of linear pictures (H, W, 3) in [0, 1]: noise, or edges and points that are moved a little."""
    random = np.random.default_rng(seed)
    if kind == "noise":
        first = random.random((*shape, 3), np.float32)
        return first, np.clip(first + 0.2 * random.standard_normal((*shape, 3), np.float32), 0.0, 1.0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    pair = []
    for offset in (0, 3):
        picture = np.zeros((*shape, 3), np.float32)
        picture[(x + offset > 20) & (y < 25)] = 0.1, 0.6, 0.9
        picture[(x - 40) ** 2 + (y - 20 - offset) ** 2 < 60] = 0.9, 0.3, 0.05
        picture[::11, (5 + offset) :: 13] = 1.0
        pair.append(picture)
    return tuple(pair)


@pytest.mark.parametrize("kind", ["noise", "edges"])
def test_it_is_what_the_authors_program_says(kind):
    evaluator = pytest.importorskip("flip_evaluator", reason="flip-evaluator is not installed")
    first, second = pictures(0, kind)
    theirs, mean, _ = evaluator.evaluate(
        first, second, "LDR", inputsRGB=False, applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE}
    )
    ours = flip(first, second)
    # Both in float32, which keeps differences of lightness to about 1e-5 of its range; the root of (10) makes a feature
    # difference of 1e-7 one of 3e-4 where there is nearly none, in a few pixels.
    difference = np.abs(ours - np.squeeze(theirs))
    assert difference.max() < 2e-3 and difference.mean() < 2e-5, (difference.max(), difference.mean())
    assert ours.mean() == pytest.approx(mean, abs=2e-5) and mean > 0.01


def lab_with_hunt(color):
    """CIELAB of a linear sRGB color, chroma scaled by lightness, in plain numbers (IEC 61966-2-1, CIE 15)."""
    matrix = ((0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041))
    bent = []
    for row in matrix:
        ratio = sum(weight * value for weight, value in zip(row, color, strict=True)) / sum(row)
        bent.append(ratio ** (1.0 / 3.0) if ratio > (6.0 / 29.0) ** 3 else ratio * 841.0 / 108.0 + 4.0 / 29.0)
    lightness = 116.0 * bent[1] - 16.0
    return lightness, 0.01 * lightness * 500.0 * (bent[0] - bent[1]), 0.01 * lightness * 200.0 * (bent[1] - bent[2])


def color_distance(first, second):
    a, b = lab_with_hunt(first), lab_with_hunt(second)
    return (abs(a[0] - b[0]) + math.hypot(a[1] - b[1], a[2] - b[2])) ** 0.7


@pytest.mark.parametrize(
    ("first", "second"),
    [((0.2, 0.3, 0.4), (0.25, 0.3, 0.35)), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), ((0.9, 0.1, 0.1), (0.1, 0.8, 0.2))],
)
def test_even_pictures_differ_by_their_colors_alone(first, second):
    """Filters do nothing to them, and they have no edges: equations (4), (5) and (7) remain."""
    largest = color_distance((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    share = color_distance(first, second) / largest
    expected = share / 0.4 * 0.95 if share < 0.4 else 0.95 + (share - 0.4) / 0.6 * 0.05
    found = flip(*(np.broadcast_to(np.float32(color), (12, 9, 3)) for color in (first, second)))
    # The matrices above are rounded to seven digits, the pictures are float32.
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_the_mean_is_over_the_mask_at_the_exposure_of_the_reference():
    random = np.random.default_rng(3)
    first = random.random((20, 30, 3), np.float32)
    second = np.clip(first + 0.05, 0.0, None)
    mask = np.zeros((20, 30), bool)
    mask[5:15] = True
    both = mean_flip(first, second, mask)
    # Brighter by any factor on both sides is the same picture after exposure.
    assert mean_flip(50.0 * first, 50.0 * second, mask) == pytest.approx(both, rel=1e-3)
    assert mean_flip(first, second, np.zeros_like(mask)) is None
    broken = second.copy()
    broken[0, 0] = np.nan
    assert np.isfinite(mean_flip(first, broken))


@pytest.mark.parametrize("shapes", [((4, 5, 3), (4, 6, 3)), ((4, 5), (4, 5)), ((4, 5, 4), (4, 5, 4))])
def test_pictures_that_cannot_be_compared_are_refused(shapes):
    with pytest.raises(ValueError, match=r"expected both \(height, width, 3\)"):
        flip(*(np.zeros(shape, np.float32) for shape in shapes))
