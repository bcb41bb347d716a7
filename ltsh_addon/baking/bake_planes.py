"""The channels of a large image on disk, and the EXR that they become."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ..imaging.exr_rows import writing_rows
from ..imaging.margin import nearest_covered

# Texels that are in memory while the file is written.
WRITTEN_TEXELS = 1 << 18
COVERAGE = "coverage.hit.V"
_OWNER = "owner"  # 1 + the number of the island, 0 where nothing is covered


class Planes:
    """Channels of an image as files, so that only some rows of them need be in memory; a context. Row 0 is below."""

    def __init__(self, folder: Path, names: list[str], width: int, height: int, seams=None):
        """`seams` (UvSeams): margins show the adjacent faces; None: the nearest texel."""
        folder.mkdir()
        self.names, self.shape, self._seams = names, (height, width), seams
        # A bit per texel, for all that is in memory of the whole image.
        self._covered = np.zeros((height, -(-width // 8)), dtype=np.uint8)
        files = [*names, _OWNER] if seams is not None else names
        self._paths = {name: folder / f"{number}.bin" for number, name in enumerate(files)}
        self._files = {name: path.open("w+b") for name, path in self._paths.items()}

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        for name, file in self._files.items():
            file.close()
            self._paths[name].unlink()

    def put(self, first: int, count: int, texels, values) -> None:
        """Rows from `first`: `values` by channel at the `texels` (Texels)."""
        width = self.shape[1]
        covered = np.zeros((count, width), dtype=bool)
        covered.reshape(-1)[texels.index] = True
        self._covered[first : first + count] = np.packbits(covered, axis=1)
        for name, file in self._files.items():
            rows = np.zeros(count * width, np.int32 if name == _OWNER else np.float32)
            rows[texels.index] = 1 + self._seams.islands[texels.triangle] if name == _OWNER else values[name]
            file.seek(4 * first * width)
            file.write(rows)

    def coverage(self, first: int, last: int) -> np.ndarray:
        """Mask (last - first, W) of the texels that were put."""
        return np.unpackbits(self._covered[first:last], axis=1, count=self.shape[1]).view(bool)

    def _rows(self, name, first, last):
        file, width = self._files[name], self.shape[1]
        file.seek(4 * first * width)
        return np.frombuffer(file.read(4 * (last - first) * width), np.float32).reshape(-1, width)

    def _at(self, name, index, dtype=np.float32):
        """Values of a channel at texels `index` of the whole image."""
        return np.memmap(self._paths[name], dtype, mode="r")[index]

    def write(self, path: Path, margin: int, metadata, pictures, texture=None) -> None:
        """Write the EXR with the margin filled, the ErrorPictures (or None) of it, and as `texture`, (path, layer), an
        EXR with the colors of one layer."""
        height, width = self.shape
        rows = max(1, WRITTEN_TEXELS // width)
        for file in self._files.values():
            file.flush()
        with ExitStack() as files:
            # The last to be entered is the first to take its name: with the large file the tile counts as finished.
            writer = files.enter_context(writing_rows(path, [*self.names, COVERAGE], width, height, metadata))
            small = None
            if texture is not None:
                small = files.enter_context(writing_rows(texture[0], "RGB", width, height, metadata))
            for top in range(height, 0, -rows):
                bottom = max(top - rows, 0)
                block = self._filled(bottom, top, margin)
                writer.write(block)
                if small is not None:
                    small.write({letter: block[f"{texture[1]}.{letter}"] for letter in "RGB"})
                if pictures is not None:
                    pictures.add(height - top, block)
            if pictures is not None:
                pictures.write()

    def _filled(self, bottom, top, margin) -> dict[str, np.ndarray]:
        """Rows from `bottom` to `top` of all channels with the margin, row 0 on top."""
        height, width = self.shape
        low, high = max(bottom - margin, 0), min(top + margin, height)
        target, source = nearest_covered(self.coverage(low, high), margin)
        inside = (target >= (bottom - low) * width) & (target < (top - low) * width)
        target, source = target[inside] - (bottom - low) * width, source[inside]
        beyond = None
        if self._seams is not None and len(target):
            beyond = self._beyond(target + bottom * width, source + low * width)
        block = {COVERAGE: self.coverage(bottom, top)[::-1].astype(np.float32)}
        for name in self.names:
            around = self._rows(name, low, high)
            plane = around[bottom - low : top - low].copy()
            plane.reshape(-1)[target] = around.reshape(-1)[source]
            if beyond is not None:
                which, index, weights = beyond
                plane.reshape(-1)[target[which]] = (self._at(name, index) * weights).sum(axis=1)
            block[name] = plane[::-1]
        return block

    def _beyond(self, target, source):
        """Of the texels `target`, to which `source` are the nearest, those that show an adjacent face, (Q,), and the
        texels (Q, 4) that they show, with weights."""
        height, width = self.shape
        points, near = (np.stack([index % width, index // width], axis=-1) for index in (target, source))
        which, place, island = self._seams.reflected(points + 0.5, near)
        corner = np.floor(place - 0.5)
        share = place - 0.5 - corner
        index, weights = np.empty((len(which), 4), np.int64), np.empty((len(which), 4), np.float32)
        for number, (x, y) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            column, row = corner[:, 0] + x, corner[:, 1] + y
            within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            index[:, number] = np.where(within, row * width + column, 0.0)
            weight = np.abs(1 - x - share[:, 0]) * np.abs(1 - y - share[:, 1])
            weights[:, number] = np.where(within, weight, 0.0)
        # Texels that no face covers, or one beyond another cut, show something else.
        weights[self._at(_OWNER, index, np.int32) != 1 + island[:, None]] = 0.0
        total = weights.sum(axis=1)
        found = np.flatnonzero(total > 1e-3)
        return which[found], index[found], weights[found] / total[found, None]
