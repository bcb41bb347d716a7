"""Film: where samples lie in a picture, which part of it was rendered, and in which color space."""

import itertools
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Film:
    """Where P samples lie in an image. A pixel is the mean of `sub_samples` samples, or their weighted mean where
    pixels share samples. Samples that hit nothing are absent and count as 0."""

    width: int
    height: int
    pixel: np.ndarray  # (P,) integers, counted row by row from the top left
    sub_samples: int = 1
    # (P,) bool: true for one sample of each hit, as surfaces with several lobes have several samples; None: all true.
    first: np.ndarray | None = None
    # (P,) how many samples each one stands for, below 1 in pixels that have more than `sub_samples`; None: 1 each.
    count: np.ndarray | None = None
    # (P, N, 3) m, from each sample to others for which it stands, as its shadow does; None: the shadow is its own.
    extent: np.ndarray | None = None
    # (P, D, D) weights of each sample in the pixels around its own, rows from top to bottom; None: its own pixel only.
    spread: np.ndarray | None = None
    # (H, W) sums of these weights per pixel, absent samples included.
    whole: np.ndarray | None = None

    def take(self, index) -> "Film":
        """The film of the samples at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        arrays = {name: getattr(self, name) for name in ("first", "count", "extent", "spread")}
        arrays = {name: None if values is None else values[index] for name, values in arrays.items()}
        return replace(self, pixel=self.pixel[index], **arrays)

    def unspread(self) -> "Film":
        """The same samples, each only in its own pixel."""
        return replace(self, spread=None, whole=None)

    def hits(self, *arrays: np.ndarray) -> "tuple[Film, list[np.ndarray]]":
        """The film of the hits, each only in its own pixel, and of per-sample `arrays` (P,) the sums of each hit."""
        if self.first is None:
            return self.unspread(), list(arrays)
        hit = np.cumsum(self.first) - 1
        return self.unspread().take(self.first), [np.bincount(hit, values) for values in arrays]

    @property
    def points(self) -> int:
        """The approximate number of samples of a pixel."""
        if self.count is None or not len(self.count):
            return self.sub_samples
        return max(1, round(self.sub_samples * len(self.count) / self.count.sum()))

    def image(self, values: np.ndarray) -> np.ndarray:
        """Image (H, W) or (H, W, C), row 0 on top, of per-sample `values` (P,) or (P, C)."""
        values = np.asarray(values, dtype=np.float64)
        columns = values.reshape(values.shape[0], int(np.prod(values.shape[1:])))
        if self.spread is not None:
            image = self._sums(columns, self.spread) / self.whole[..., None]
            return image.reshape(self.height, self.width, *values.shape[1:])
        columns = columns if self.count is None else columns * self.count[:, None]
        count = self.width * self.height
        image = np.stack([np.bincount(self.pixel, weights=column, minlength=count) for column in columns.T], axis=-1)
        return (image / self.sub_samples).reshape(self.height, self.width, *values.shape[1:])

    def _sums(self, columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Sums (H, W, C) of the columns (P, C) with weights (P, D, D)."""
        size, around = weights.shape[1], weights.shape[1] // 2
        shape = self.height + 2 * around, self.width + 2 * around
        sums = np.zeros((columns.shape[1], shape[0] * shape[1]))
        corner = self.pixel // self.width * shape[1] + self.pixel % self.width
        for row, column in np.ndindex(size, size):
            weight, target = weights[:, row, column], corner + row * shape[1] + column
            for total, values in zip(sums, columns.T, strict=True):
                total += np.bincount(target, weights=values * weight, minlength=len(total))
        inside = slice(around, around + self.height), slice(around, around + self.width)
        return np.moveaxis(sums.reshape(-1, *shape), 0, -1)[inside]

    def shared(self, weights: np.ndarray, sub_sample: np.ndarray, rendered: np.ndarray) -> "Film":
        """The film whose pixels share their samples. `weights` (N, D, D) are those of the N points of a pixel,
        `sub_sample` (P,) is the point of each sample, `rendered` (H, W) the mask of the rendered pixels."""
        every = replace(self, pixel=np.flatnonzero(rendered))
        around = np.broadcast_to(weights.sum(axis=0), (len(every.pixel), *weights.shape[1:]))
        whole = every._sums(np.ones((len(every.pixel), 1)), around)[..., 0]
        spread = weights.astype(np.float32)[sub_sample]
        return replace(self, spread=spread, whole=np.where(rendered, whole, np.inf))

    def reached(self, mask: np.ndarray) -> np.ndarray:
        """Mask (H, W) of the pixels that share samples with a pixel of `mask` (H, W)."""
        around = 0 if self.spread is None else self.spread.shape[1] // 2
        grid = np.pad(mask, around)
        steps = itertools.product(range(2 * around + 1), repeat=2)
        return np.any([grid[y : y + self.height, x : x + self.width] for y, x in steps], axis=0)

    def variance(self, values: np.ndarray) -> np.ndarray:
        """Variance (H, W) of `image`, from the variances `values` (P,) of independent samples."""
        if self.spread is not None:
            return self._sums(np.asarray(values)[:, None], np.square(self.spread))[..., 0] / np.square(self.whole)
        return self.image(values if self.count is None else values * self.count) / self.sub_samples

    def coverage(self) -> np.ndarray:
        """Share (H, W) of each pixel's sub-samples that hit a surface."""
        return self.image(np.ones(self.pixel.shape[0]) if self.first is None else self.first)


@dataclass(frozen=True)
class Border:
    """The rectangle of the picture that was rendered, in pixels from the top left corner of the whole picture.

    A `cropped` picture has the size of the rectangle. Others have the full size and are empty outside of it.
    """

    left: int
    top: int
    width: int
    height: int
    full_width: int
    full_height: int
    cropped: bool = False

    def __str__(self):
        return (
            f"{self.width}x{self.height} at {self.left},{self.top} of {self.full_width}x{self.full_height}, "
            f"{'cropped' if self.cropped else 'in place'}"
        )


@dataclass(frozen=True)
class ColorSpace:
    """The linear RGB space of all colors of a file: its name and the matrix to linear Rec.709."""

    name: str
    to_rec709: np.ndarray  # (3, 3), with both spaces' white points made equal; applied to column vectors

    def __post_init__(self):
        matrix = np.asarray(self.to_rec709, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError(f"color space {self.name!r}: matrix {matrix!r}, expected 3 x 3 finite numbers")
        object.__setattr__(self, "to_rec709", matrix)

    def rec709(self, colors: np.ndarray) -> np.ndarray:
        """Colors (..., 3) of this space in linear Rec.709."""
        return np.asarray(colors) @ self.to_rec709.T


REC709 = ColorSpace("Linear Rec.709", np.eye(3))
