"""Share of the light that sheen reflects, by view and roughness, as Cycles tabulates it. Needs no bpy.

The microfiber sheen of Cycles is that of Zeltner, Burley and Chiang 2022, "Practical multiple-scattering sheen using
linearly transformed cosines"; sheen_albedos.npy has its albedo at the nodes of Cycles' own table, between which both
are bilinear. `sheen_measurement` measures them.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

PATH = Path(__file__).with_name("sheen_albedos.npy")
NODES = 32
SMALLEST_ROUGHNESS = 1e-3


def sheen_albedo(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Albedo (P,) of sheen of `roughness` (P,), as in Blender, seen under the cosine (P,) from the normal; within
    1e-4 of Cycles 4.5 and 5.2."""
    table = _table()
    x, y = np.clip(cosine, 0.0, 1.0), np.clip(roughness, SMALLEST_ROUGHNESS, 1.0)
    found = 0.0
    for index, weight in corners(x, y):
        found = found + weight * table[index]
    return np.maximum(found, 0.0)


def corners(x: np.ndarray, y: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The nodes, as numbers (P,) in the table, around points of the unit square, with their bilinear weights (P,)."""
    x, y = (NODES - 1) * x, (NODES - 1) * y
    column, row = (np.minimum(value.astype(int), NODES - 2) for value in (x, y))
    return [
        ((column + i) * NODES + row + j, np.abs(1 - i - (x - column)) * np.abs(1 - j - (y - row)))
        for i in (0, 1)
        for j in (0, 1)
    ]


@cache
def _table() -> np.ndarray:
    return np.load(PATH).astype(np.float64).ravel()
