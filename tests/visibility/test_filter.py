"""The filter of shares: less noise in penumbrae, nothing else changes."""

import numpy as np
import pytest
from test_ratio import THREE_SPHERES, floor, panel, past_spheres, with_all_rays

from ltsh_addon.scene import PASSES, Film
from ltsh_addon.visibility import ratio
from ltsh_addon.visibility.filter import ShareFilter


def test_penumbrae_get_closer_and_settled_pairs_stay():
    samples, film = floor(64)
    light, tracer = panel(), past_spheres(((0.0, 1.0, 0.8), 0.5))
    exact = with_all_rays(samples, light, tracer)
    plain, smooth = (
        ratio.visible_shares(samples, [light], tracer, rays=16, film=film, smooth=smooth) for smooth in (False, True)
    )
    assert np.array_equal(plain.mixed, smooth.mixed)
    for name in PASSES:
        before, after = getattr(plain, name)[0], getattr(smooth, name)[0]
        np.testing.assert_array_equal(before[~plain.mixed[0]], after[~plain.mixed[0]])
        assert ((after >= 0.0) & (after <= 1.0)).all()
        errors = [np.sqrt(np.square(values[exact.index] - exact.found(name)[0]).mean()) for values in (before, after)]
        assert errors[1] < 0.75 * errors[0], name
        assert smooth.noise(name) < plain.noise(name)


def two_walls():
    """Samples of 8 x 8 pixels: the left half on one wall, the right one on a wall across or far behind it."""
    samples, film = floor(8)
    return samples, film, film.pixel % 8 >= 4


@pytest.mark.parametrize("difference", ("geometric_normal", "position"))
def test_surfaces_do_not_mix(difference):
    import dataclasses

    samples, film, right = two_walls()
    value = np.array(getattr(samples, difference))
    value[right] = [1.0, 0.0, 0.0] if difference == "geometric_normal" else value[right] + [0.0, 0.0, 9.0]
    share_filter = ShareFilter(dataclasses.replace(samples, **{difference: value}), film)
    index, rays, noise = np.arange(64), np.full(64, 16), np.full(64, 0.5, np.float32)
    shares = np.where(right, 0.75, 0.25).astype(np.float32)
    found, factor = share_filter.filtered("diffuse", index, shares, rays, np.ones(64, bool), noise)
    np.testing.assert_allclose(found, shares, atol=1e-3)
    assert (factor < 0.7).all()


def test_samples_of_one_pixel_are_filtered_apart():
    """Two lobes per pixel: one blocked, one lit."""
    samples, film = floor(6)
    twice = np.repeat(np.arange(36), 2)
    share_filter = ShareFilter(samples.take(twice), Film(6, 6, twice, first=np.arange(72) % 2 == 0))
    shares = np.where(np.arange(72) % 2, 0.9, 0.1).astype(np.float32)
    found, _ = share_filter.filtered(
        "specular", np.arange(72), shares, np.full(72, 16), np.ones(72, bool), np.full(72, 0.5, np.float32)
    )
    np.testing.assert_allclose(found, shares, atol=1e-5)


def test_nothing_chosen_is_nothing_changed():
    samples, film = floor(4)
    shares = np.linspace(0.0, 1.0, 16, dtype=np.float32)
    found, factor = ShareFilter(samples, film).filtered(
        "diffuse", np.arange(16), shares, np.full(16, 8), np.zeros(16, bool), np.zeros(16, np.float32)
    )
    assert found is shares and (factor == 1.0).all()
    assert ratio.visible_shares(samples, [panel()], THREE_SPHERES, smooth=True).diffuse.shape == (1, 16)
