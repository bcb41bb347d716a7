"""The channels of a large image on disk, and the EXR that they become."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from .imaging.exr_rows import writing_rows
from .imaging.margin import nearest_covered

# Texels that are in memory while the file is written.
WRITTEN_TEXELS = 1 << 18
COVERAGE = "coverage.hit.V"


class Planes:
    """Channels of an image as files, so that only some rows of them need be in memory; a context. Row 0 is below."""

    def __init__(self, folder: Path, names: list[str], width: int, height: int):
        folder.mkdir()
        self.names, self.shape = names, (height, width)
        self.coverage = np.zeros((height, width), dtype=bool)
        self._paths = {name: folder / f"{number}.bin" for number, name in enumerate(names)}
        self._files = {name: path.open("w+b") for name, path in self._paths.items()}

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        for name, file in self._files.items():
            file.close()
            self._paths[name].unlink()

    def put(self, first: int, count: int, index, values) -> None:
        """Rows from `first`: `values` by channel at the texels `index`."""
        width = self.shape[1]
        self.coverage[first : first + count].reshape(-1)[index] = True
        for name, file in self._files.items():
            rows = np.zeros(count * width, np.float32)
            rows[index] = values[name]
            file.seek(4 * first * width)
            file.write(rows.tobytes())

    def _rows(self, name, first, last):
        file, width = self._files[name], self.shape[1]
        file.seek(4 * first * width)
        return np.frombuffer(file.read(4 * (last - first) * width), np.float32).reshape(-1, width)

    def write(self, path: Path, margin: int, metadata, pictures, texture=None) -> None:
        """Write the EXR with the margin filled, the ErrorPictures (or None) of it, and as `texture`, (path, layer), an
        EXR with the colors of one layer."""
        height, width = self.shape
        rows = max(1, WRITTEN_TEXELS // width)
        with ExitStack() as files:
            # The last to be entered is the first to take its name: with the large file the tile counts as finished.
            writer = files.enter_context(writing_rows(path, [*self.names, COVERAGE], width, height, metadata))
            small = None
            if texture is not None:
                small = files.enter_context(writing_rows(texture[0], "RGB", width, height, metadata))
            for top in range(height, 0, -rows):
                bottom = max(top - rows, 0)
                low, high = max(bottom - margin, 0), min(top + margin, height)
                target, source = nearest_covered(self.coverage[low:high], margin)
                inside = (target >= (bottom - low) * width) & (target < (top - low) * width)
                target, source = target[inside] - (bottom - low) * width, source[inside]
                block = {COVERAGE: self.coverage[bottom:top][::-1].astype(np.float32)}
                for name in self.names:
                    around = self._rows(name, low, high)
                    plane = around[bottom - low : top - low].copy()
                    plane.reshape(-1)[target] = around.reshape(-1)[source]
                    block[name] = plane[::-1]
                writer.write(block)
                if small is not None:
                    small.write({letter: block[f"{texture[1]}.{letter}"] for letter in "RGB"})
                if pictures is not None:
                    pictures.add(height - top, block)
            if pictures is not None:
                pictures.write()
