"""What stands for a denoiser where there is none."""

import numpy as np

from ltsh_addon.imaging.denoise import FARTHEST, smoothed


def test_light_is_smoothed_along_surfaces_and_not_across():
    """Two halves of other color, and a sky behind: the mean of noise stays, and no light crosses over."""
    random, true = np.random.default_rng(3), np.zeros((48, 60, 3))
    guides = np.zeros((48, 60, 7))
    guides[..., 5], guides[..., 6], guides[:12, :, 6] = 1.0, 3.0, FARTHEST
    guides[12:, :30, :3], guides[12:, 30:, :3], guides[:12, :, 3:6] = 0.2, 0.8, 0.0
    true[12:, :30], true[12:, 30:] = (0.5, 0.2, 0.1), (0.1, 0.6, 0.9)
    np.testing.assert_allclose(smoothed(true, guides, 4), true, atol=1e-3)
    noisy = true * random.uniform(0.2, 1.8, true.shape[:2])[..., None]
    noisy[30, 40] *= 1000.0
    few, many = (smoothed(noisy, guides, samples) for samples in (4, 64))
    surface = np.s_[16:, :]
    # 3 steps of 3 x 3 weights leave a sixth of uncorrelated noise, one step a third; .46 is that of the noise.
    errors = [np.std((one - true)[surface] / true[surface]) for one in (few, many)]
    assert errors[0] < 0.15 < errors[1] < 0.25
    # A pixel a thousand times as bright spreads twice the light of its brightest neighbor.
    assert abs((few[surface] / true[surface]).mean() - 1.0) < 0.02
    assert few[30, 40].max() < 1.8 * true[30, 40].max()
