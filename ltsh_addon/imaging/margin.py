"""The margin around what is baked: texels that are not covered take the value of the nearest covered one."""

from __future__ import annotations

import numpy as np


def nearest_covered(coverage: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (Q,) of the texels of `coverage` (H, W) that are not covered and at most `margin` texels from one
    that is, and the flat indices (Q,) of the nearest (Euclidean distance; of several the first in memory).

    Exact: along the rows first, then over the rows within reach (Felzenszwalb and Huttenlocher 2012, "Distance
    Transforms of Sampled Functions").
    """
    height, width = coverage.shape
    if margin <= 0 or not coverage.any() or coverage.all():
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    column = _nearest_in_row(coverage, margin)
    rows, columns = np.nonzero(~coverage & _within_reach(column >= 0, margin))
    best = np.full(len(rows), margin * margin + 1, dtype=np.int64)
    source = np.full(len(rows), -1, dtype=np.int64)
    for step in range(-margin, margin + 1):
        row = rows + step
        inside = (row >= 0) & (row < height)
        row = np.clip(row, 0, height - 1)
        found = column[row, columns]
        distance = (found - columns).astype(np.int64) ** 2 + step * step
        better = inside & (found >= 0) & (distance < best)
        best[better] = distance[better]
        source[better] = row[better] * width + found[better]
    reached = source >= 0
    return (rows * width + columns)[reached], source[reached]


def _nearest_in_row(coverage, margin):
    """Column (H, W) of the nearest covered texel in the same row, the left one of two; -1 beyond `margin`."""
    height, width = coverage.shape
    columns = np.arange(width, dtype=np.int32)
    far = np.int32(width + 2 * margin + 2)
    left = np.maximum.accumulate(np.where(coverage, columns, -far), axis=1)
    right = np.minimum.accumulate(np.where(coverage, columns, 2 * far)[:, ::-1], axis=1)[:, ::-1]
    to_left, to_right = columns - left, right - columns
    nearest = np.where(to_left <= to_right, left, right)
    return np.where(np.minimum(to_left, to_right) <= margin, nearest, -1).astype(np.int32)


def _within_reach(found, margin):
    """Mask (H, W) of the texels with a true one of `found` (H, W) at most `margin` rows above or below."""
    height = len(found)
    counts = np.zeros((height + 1, found.shape[1]), dtype=np.int32)
    np.cumsum(found, axis=0, out=counts[1:])
    rows = np.arange(height)
    return counts[np.minimum(rows + margin + 1, height)] > counts[np.maximum(rows - margin, 0)]
