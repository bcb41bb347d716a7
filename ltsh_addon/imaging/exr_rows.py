"""A multi-layer OpenEXR file written by blocks of rows, so that an image need not fit into memory."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from .atomic import replacing
from .exr import _openexr, check_metadata


class RowWriter:
    """Takes the rows of an EXR from top to bottom; made by `writing_rows`."""

    def __init__(self, file, names: Sequence[str], width: int, height: int):
        self._file, self._names, self._shape, self._done = file, tuple(names), (height, width), 0

    def write(self, planes: Mapping[str, np.ndarray]) -> None:
        """The next rows, (R, W) for every channel; raises ValueError for other channels or shapes."""
        height, width = self._shape
        rows = len(next(iter(planes.values()))) if planes else 0
        if set(planes) != set(self._names) or rows == 0 or self._done + rows > height:
            raise ValueError(
                f"rows {self._done} to {self._done + rows} of channels {sorted(planes)}, expected rows up to {height} "
                f"of channels {sorted(self._names)}"
            )
        data = {}
        for name, plane in planes.items():
            if plane.shape != (rows, width):
                raise ValueError(f"channel {name!r}: rows have shape {plane.shape}, expected {(rows, width)}")
            data[name] = np.ascontiguousarray(plane, dtype=np.float32).tobytes()
        try:
            self._file.writePixels(data, rows)
        except RuntimeError as error:
            raise OSError(str(error)) from error
        self._done += rows

    def close(self) -> None:
        self._file.close()
        if self._done != self._shape[0]:
            raise ValueError(f"{self._done} rows were written, expected {self._shape[0]}")


@contextmanager
def writing_rows(
    path: str | os.PathLike,
    names: Sequence[str],
    width: int,
    height: int,
    metadata: Mapping[str, str] | None = None,
):
    """Meanwhile a RowWriter for a float32 EXR with ZIP compression and the channels `names`.

    The file appears complete at the end of the block, or not at all where an exception leaves it. Raises OSError.
    """
    OpenEXR = _openexr()
    header = OpenEXR.Header(width, height)
    kind = header["channels"]["R"]
    header["channels"] = dict.fromkeys(names, kind)
    header["type"] = b"scanlineimage"
    header |= {key: value.encode() for key, value in check_metadata(metadata).items()}
    with replacing(path) as temporary:
        try:
            file = OpenEXR.OutputFile(str(temporary), header)
        except OSError as error:
            raise OSError(f"{path}: cannot be written ({error})") from error
        writer = RowWriter(file, names, width, height)
        try:
            yield writer
        except BaseException:
            file.close()
            raise
        writer.close()
