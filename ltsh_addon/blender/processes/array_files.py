"""Arrays as .npy files that appear complete or not at all. Needs no bpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def save_array(path: Path, values: np.ndarray) -> None:
    """Write `values` as .npy. Raises OSError, with its number also where the disk is full, unlike `np.save`."""
    values = np.ascontiguousarray(values)
    unfinished = path.with_suffix(".tmp")
    with unfinished.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
        file.write(values.data)
    unfinished.replace(path)
