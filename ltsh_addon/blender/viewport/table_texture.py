"""A lookup table as textures: the warp and the weights of the moments of every Fresnel curve.

The first layer holds the warp, then each curve takes as many layers as its weights need, four in each. The weights are
those of `ridge_table.along_directions`, so that an integral over a polygon is their product with its moments. After the
curves of the table come those of dielectrics of a few known indices of refraction, summed up beforehand.
"""

from __future__ import annotations

import numpy as np

from ...shading import ridge_table
from ...shading.lookup_table import LookupTable

# Indices of refraction per unit in the texture of the dielectrics' weights; those of the shipped tables are among them.
IOR_STEPS = 200


def table_texels(table: LookupTable, iors: tuple[float, ...] = ()) -> np.ndarray:
    """Texels (N, R, T, 4) in float32, with one more curve for every index of refraction of `iors`."""
    ridges = ridge_table.along_directions(table)
    rows, columns, parameters = table.warp.shape
    vectors = (*range(len(ridges.weights)), *(("dielectric", float(ior)) for ior in iors))
    channels = ridges.channels(vectors)
    parts = [channels[:parameters], *np.split(channels[parameters:], len(vectors))]
    padded = np.concatenate([np.pad(part, ((0, -len(part) % 4), (0, 0))) for part in parts])
    return padded.reshape(-1, 4, rows, columns).transpose(0, 2, 3, 1)


def dielectric_texels(table: LookupTable, iors: tuple[float, ...] = ()) -> np.ndarray:
    """Texels (S, 2, 4), column x for the index of refraction 1 + y / `IOR_STEPS`, y the row: weights of the table's
    first four curves and, in the second texel, of the fifth; its w is 1 + n where the index is number n of `iors`.
    """
    count = table.fresnel_weights.shape[1]
    if count > 7:
        raise ValueError(f"table {table.name} has {count} Fresnel curves, the graphics card's path takes up to 7")
    grid = 1.0 + np.arange(round((float(table.fresnel_ior[-1]) - 1.0) * IOR_STEPS) + 1) / IOR_STEPS
    texels = np.zeros((len(grid), 8), np.float32)
    texels[:, :count] = table.dielectric_weights(grid).T
    for number, ior in enumerate(iors):
        nearest = round((ior - 1.0) * IOR_STEPS)
        if 0 <= nearest < len(grid) and abs(grid[nearest] - ior) < 1e-6:
            texels[nearest, 7] = 1.0 + number
    return texels.reshape(len(grid), 2, 4)
