"""The margin holds the nearest covered texel, found by looking at all of them."""

import numpy as np
import pytest

from ltsh_addon.imaging.seams import nearest_covered


@pytest.mark.parametrize("share", [0.0, 0.002, 0.02, 0.4, 1.0])
@pytest.mark.parametrize("margin", [0, 1, 5, 12])
def test_every_texel_within_the_margin_gets_the_nearest_covered_one(share, margin):
    coverage = np.random.default_rng(3).random((37, 53)) < share
    covered = np.argwhere(coverage)
    target, source = nearest_covered(coverage, margin)
    assert coverage.ravel()[source].all() and not coverage.ravel()[target].any()
    empty = np.argwhere(~coverage)
    if len(covered) == 0:
        assert len(target) == 0
        return
    distance = ((empty[:, None] - covered) ** 2).sum(axis=-1).min(axis=1, initial=10**9)
    reached = distance <= margin**2
    assert np.array_equal(np.sort(target), np.ravel_multi_index(empty[reached].T, coverage.shape))
    found = ((np.argwhere(np.ones_like(coverage))[target] - np.argwhere(np.ones_like(coverage))[source]) ** 2).sum(1)
    expected = np.full(coverage.size, -1)
    expected[np.ravel_multi_index(empty.T, coverage.shape)] = distance
    assert np.array_equal(found, expected[target])
