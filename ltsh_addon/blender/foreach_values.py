"""Properties of many items of Blender as arrays."""

from __future__ import annotations

import numpy as np


def read_values(collection, name: str, shape: tuple[int, ...], dtype) -> np.ndarray:
    """An array of `shape` of the property `name` of all items of one of Blender's collections."""
    values = np.empty(int(np.prod(shape)), dtype)
    collection.foreach_get(name, values)
    return values.reshape(shape)
