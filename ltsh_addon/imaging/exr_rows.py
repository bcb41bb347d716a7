"""A multi-layer OpenEXR file written by blocks of rows, so that an image need not fit into memory."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from .atomic import replacing
from .exr import _openexr, check_metadata, reason

# More than the header of a file with thousands of channels has.
_HEADER_BYTES = 1 << 22


class RowWriter:
    """Takes the rows of an EXR from top to bottom; made by `writing_rows`."""

    def __init__(self, file, path: os.PathLike, names: Sequence[str], width: int, height: int):
        self._file, self._path, self._names, self._shape, self._done = file, path, tuple(names), (height, width), 0

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
        except (RuntimeError, OSError) as error:
            raise OSError(reason(error, self._path)) from error
        self._done += rows

    def close(self) -> None:
        """End the file. Raises ValueError where rows are missing."""
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
    chromaticities: Sequence[float] | None = None,
    pixel_aspect: float = 1.0,
):
    """Meanwhile a RowWriter for a float32 EXR with ZIP compression and the channels `names`; else as `write_layers`.

    The file appears complete at the end of the block, or not at all where an exception leaves it. Raises OSError,
    ValueError for metadata and chromaticities that are none.
    """
    OpenEXR = _openexr()
    header = OpenEXR.Header(width, height)
    header["pixelAspectRatio"] = float(pixel_aspect)
    if chromaticities is not None:
        chromaticities = _chromaticities(chromaticities)
        header["chromaticities"] = _no_chromaticities()
    kind = header["channels"]["R"]
    header["channels"] = dict.fromkeys(names, kind)
    header["type"] = b"scanlineimage"
    header |= {key: value.encode() for key, value in check_metadata(metadata).items()}
    with replacing(path) as temporary:
        try:
            file = OpenEXR.OutputFile(str(temporary), header)
        except OSError as error:
            raise OSError(reason(error, temporary)) from error
        writer = RowWriter(file, temporary, names, width, height)
        try:
            yield writer
        except BaseException:
            file.close()
            raise
        writer.close()
        if chromaticities is not None:
            _put_chromaticities(temporary, chromaticities)


def _chromaticities(values) -> bytes:
    """As they stand in a file."""
    if np.shape(values) != (8,) or not np.isfinite(values).all():
        raise ValueError(f"chromaticities {values!r}: expected xy of red, green, blue and white, 8 numbers")
    return np.asarray(values, dtype="<f4").tobytes()


def _no_chromaticities():
    import Imath

    return Imath.Chromaticities(*[Imath.chromaticity(0.0, 0.0)] * 4)


def _put_chromaticities(path, values: bytes) -> None:
    """Put them into the header of a file: OutputFile writes zeros, whatever it is given (OpenEXR 3.5)."""
    attribute = b"\0chromaticities\0chromaticities\0" + len(values).to_bytes(4, "little")
    with open(path, "r+b") as file:
        start = file.read(_HEADER_BYTES).index(attribute) + len(attribute)
        file.seek(start)
        file.write(values)
