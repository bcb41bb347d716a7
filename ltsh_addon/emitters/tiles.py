"""Tiles: neighboring samples that a light tree lights together.

A tile has bounds on the positions and the lobes of its samples. On smooth surfaces the light of ten samples of a tile
is interpolated to the others by cubics.
"""

from dataclasses import dataclass

import numpy as np

from ..lobes.polygon import dot

# ROUGHEST: how far all that the lobes depend on may differ from such cubics, in units of the lengths over which lobes
# change. LARGEST_WEIGHTS: limit for the sum of the absolute weights of the ten samples.
ROUGHEST, LARGEST_WEIGHTS = 1e-3, 8.0


@dataclass(frozen=True)
class Tiles:
    """T tiles of samples, and bounds on the lobes in them."""

    columns: list[np.ndarray]  # of the samples of each tile
    center: np.ndarray  # (T, 3) m
    half: np.ndarray  # (T, 3) m: half the box around the samples; this and what follows in single precision
    radius: np.ndarray  # (T,) m: half the diagonal of the box
    horizons: list[tuple[np.ndarray, np.ndarray]]  # cones around the normals of each horizon: axes (T, 3), angles (T,)
    mirrored: tuple[np.ndarray, np.ndarray] | None  # cones around the mirrored views; None for diffuse lobes
    width: np.ndarray | None  # (T,) rad, of the narrowest specular lobe
    only_tails: bool  # True: nodes must be in the tails of the lobes, `small_lights.SHARP_TAIL` from their peaks

    @classmethod
    def of(cls, lobes, position, columns) -> "Tiles":
        """The tiles with these `columns`, of samples with x, y, z in `position` (3, Q)."""
        every = np.concatenate(columns)
        first = np.concatenate([[0], np.cumsum([len(tile) for tile in columns])[:-1]])
        positions = position[:, every]
        low, high = (end.reduceat(positions, first, axis=1).T for end in (np.minimum, np.maximum))
        horizons = [direction_cones(lobes.rows[row][:, every], first) for row in lobes.clip_rows]
        mirrored = width = None
        if lobes.sharpest is not None:
            mirrored = direction_cones(lobes.sharpest.mirrored[:, every], first)
            width = np.minimum.reduceat(lobes.sharpest.width[every], first)
        half = (0.5 * (high - low)).astype(np.float32)
        return cls(columns, 0.5 * (low + high), half, lengths(half), horizons, mirrored, width, lobes.only_tails)


def neighbor_keys(lobes, position, chosen) -> np.ndarray:
    """Keys (D, Q') by which the columns `chosen` (Q',) are grouped: places, and directions of the lobes."""
    direction = lobes.rows[lobes.clip_rows[-1]] if lobes.sharpest is None else lobes.sharpest.mirrored
    positions = position[:, chosen]
    extent = np.ptp(positions, axis=1)
    weight = 4.0 / max(np.sqrt(extent @ extent), 1e-30)
    keys = np.concatenate([weight * (positions - positions.mean(axis=1, keepdims=True)), direction[:, chosen]])
    return keys.astype(np.float32)


@dataclass(frozen=True)
class TileCubics:
    """Ten samples of each of T tiles, and cubics of two coordinates that interpolate to its other samples."""

    anchors: np.ndarray  # (T, 10) places of the ten samples in the tile
    weights: np.ndarray  # (T, R, 10) for the at most R samples of a tile
    are_smooth: np.ndarray  # (T,) True if all that the lobes depend on is close to such a cubic

    @classmethod
    def of(cls, tiles, keys, shape) -> "TileCubics":
        """For tiles of the samples `tiles`. `keys` (D, Q) come from `neighbor_keys`; `shape` (S, Q) is what the lobes
        depend on, in units of the lengths over which they change."""
        count = max(map(len, tiles))
        index = np.stack([np.resize(members, count) for members in tiles])
        local = np.moveaxis(keys[:, index], 0, -1)
        local -= local.mean(axis=1, keepdims=True)
        size = np.maximum(np.abs(local[..., :3]).max(axis=(1, 2)), 1e-30)[:, None]
        _, axes = np.linalg.eigh(local.transpose(0, 2, 1) @ local)
        u, v = np.moveaxis(local @ axes[:, :, :-3:-1], -1, 0)
        u, v = (one / np.maximum(np.abs(one).max(axis=1, keepdims=True), 1e-30) for one in (u, v))
        one = np.ones_like(u)
        powers = [one, u, u * u, u * u * u, v, v * u, v * u * u, v * v, v * v * u, v * v * v]
        values = np.stack(powers, axis=-1)
        # Choose the samples that determine cubics best, one after another, by a pivoted Cholesky decomposition.
        tile, remaining = np.arange(len(tiles)), (values * values).sum(axis=2)
        factor, anchors, least = np.zeros_like(values), np.zeros((len(tiles), len(powers)), int), np.inf
        for step in range(len(powers)):
            pivot = remaining.argmax(axis=1)
            most = remaining[tile, pivot]
            column = values @ values[tile, pivot][:, :, None] - factor @ factor[tile, pivot][:, :, None]
            factor[:, :, step] = column[..., 0] / np.sqrt(np.maximum(most, 1e-30))[:, None]
            remaining -= factor[:, :, step] ** 2
            anchors[:, step], least = pivot, np.minimum(least, most)
        are_smooth = least > 1e-4
        chosen = factor[tile[:, None], anchors].astype(np.float64)
        chosen[~are_smooth] = np.eye(len(powers))
        weights = (factor @ np.linalg.inv(chosen)).astype(np.float32)
        are_smooth &= np.abs(weights).sum(axis=2).max(axis=1) < LARGEST_WEIGHTS
        shape = np.concatenate([local[..., :3] / size[..., None], np.moveaxis(shape[:, index], 0, -1)], axis=2)
        off = np.abs(weights @ shape[tile[:, None], anchors] - shape).max(axis=(1, 2))
        return cls(anchors, weights, are_smooth & (off < ROUGHEST))


def split_columns(keys, columns, most):
    """Parts of the columns `columns` that are neighbors in `keys` (D, Q), at most `most` columns each."""
    if len(columns) <= most:
        return [columns]
    values = keys[:, columns]
    along = values[np.argmax(np.ptp(values, axis=1))]
    order = np.argpartition(along, len(columns) // 2)
    half = len(columns) // 2
    return [*split_columns(keys, columns[order[:half]], most), *split_columns(keys, columns[order[half:]], most)]


def direction_cones(vectors, first):
    """Axes (T, 3) and angles (T,) of cones around the vectors (3, Q) of each tile. `first` (T,) is its first column."""
    unit = vectors.astype(np.float64)
    unit /= np.maximum(np.sqrt(dot(unit, unit)), 1e-30)
    axis = np.add.reduceat(unit, first, axis=1)
    axis /= np.maximum(np.sqrt(dot(axis, axis)), 1e-30)
    count = np.diff(np.append(first, unit.shape[1]))
    least = np.minimum.reduceat(dot(np.repeat(axis, count, axis=1), unit), first)
    return axis.T.astype(np.float32), np.arccos(np.clip(least, -1.0, 1.0)).astype(np.float32)


def products(one, two):
    """Dot products (K,) of vectors (K, 3)."""
    return np.einsum("ki,ki->k", one, two)


def lengths(vectors):
    """Lengths (K,) of vectors (K, 3)."""
    return np.sqrt(products(vectors, vectors))
