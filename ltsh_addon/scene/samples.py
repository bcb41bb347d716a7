"""Surface samples, and the film: where they lie in a picture. What part of it was rendered, in what color space."""

import itertools
from dataclasses import dataclass, fields, replace

import numpy as np

# Fields of SurfaceSamples with one number per sample. All other fields are vectors or colors.
SCALAR_FIELDS = (
    "roughness", "ior", "bump_alpha2", "receiver", "diffuse_roughness", "sheen_a", "sheen_b", "anisotropy",
)  # fmt: skip


@dataclass(frozen=True)
class SurfaceSamples:
    """P surface points with all that shading needs. Vectors are unit, in world space; last axis is space or color.

    A surface with several lobes has one sample for each of them.

    Specular lobe: single-scatter GGX with alpha = roughness^2 and the Fresnel factor
    ``f0 + (f90 - f0) (1 - c)^5 - dip c (1 - c)^6 + dielectric F_d(c, ior)``. c is the cosine of the half angle, F_d
    the exact unpolarized reflectance of a dielectric, with total reflection where `ior` is below 1. Negative terms may
    stand for a tint. Without a dielectric, a sum of the first three terms below 0 counts as 0. With an `anisotropy`
    the alpha of GGX is roughness^2 / (1 - anisotropy) along the `tangent` and roughness^2 (1 - anisotropy) across it.

    Diffuse lobe: Lambert's; with a `diffuse_roughness` that of a rough surface, with a `sheen_a` that of sheen (see
    `shading.diffuse`). `diffuse_albedo` is what the specular layer leaves.

    Horizons, as in Cycles: the specular lobe ends at the horizons of both the shading and the geometric normal, a
    bump-mapped diffuse lobe at the horizon of the smooth normal. Toward that horizon the diffuse lobe is shadowed by
    2 / (1 + sqrt(1 + bump_alpha2 tan^2 theta_i)), theta_i the angle of the light from the smooth normal (Estevez,
    Lecocq and Stein 2019).
    """

    position: np.ndarray  # (P, 3) m
    view: np.ndarray  # (P, 3) towards the camera
    normal: np.ndarray  # (P, 3) shading normal of the specular lobe
    diffuse_normal: np.ndarray  # (P, 3) shading normal of the diffuse lobe
    roughness: np.ndarray  # (P,) in [0, 1]
    specular_f0: np.ndarray  # (P, 3)
    specular_f90: np.ndarray  # (P, 3)
    dielectric: np.ndarray  # (P, 3) weight of the dielectric lobe; (P,) is taken for all colors
    ior: np.ndarray  # (P,) relative index of refraction of the dielectric lobe
    diffuse_albedo: np.ndarray  # (P, 3)
    geometric_normal: np.ndarray | None = None  # (P, 3) for the horizon of the specular lobe; default: `normal`
    smooth_normal: np.ndarray | None = None  # (P, 3) interpolated, without bump maps; default: `diffuse_normal`
    bump_alpha2: np.ndarray | None = None  # (P,); default: 0
    specular_dip: np.ndarray | None = None  # (P, 3) of F82 metals; default: 0
    diffuse_roughness: np.ndarray | None = None  # (P,) sigma of Oren and Nayar in [0, 1]; default: 0
    diffuse_rebound: np.ndarray | None = None  # (P, 3) multiple scattering of such a surface; default: 0
    sheen_a: np.ndarray | None = None  # (P,) 0: no sheen; below 0: -sigma of velvet; default: 0
    sheen_b: np.ndarray | None = None  # (P,); default: 0
    receiver: np.ndarray | None = None  # (P,) integers that `Light.receivers` names; default: 0
    anisotropy: np.ndarray | None = None  # (P,) in (-1, 1); default: 0
    tangent: np.ndarray | None = None  # (P, 3); its part along `normal` does not matter; default: 0

    def __post_init__(self):
        count = np.shape(self.position)[0]
        defaults = {"geometric_normal": self.normal, "smooth_normal": self.diffuse_normal, "receiver": 0}
        if np.ndim(self.dielectric) == 1:
            object.__setattr__(self, "dielectric", np.broadcast_to(np.asarray(self.dielectric)[:, None], (count, 3)))
        for field in fields(self):
            value, expected = getattr(self, field.name), (count,) if field.name in SCALAR_FIELDS else (count, 3)
            if value is None:
                value = defaults.get(field.name, 0.0)
                value = np.broadcast_to(value, expected) if np.isscalar(value) else value
            value = np.asarray(value)
            if value.shape != expected:
                raise ValueError(f"surface samples: {field.name} has shape {value.shape}, expected {expected}")
            object.__setattr__(self, field.name, value)

    def __len__(self) -> int:
        return self.position.shape[0]

    @property
    def sharpest_roughness(self) -> np.ndarray:
        """Roughness (P,): the square root of the smaller of the two alphas of GGX."""
        if not self.anisotropy.any():
            return self.roughness
        across = np.maximum(1.0 - self.anisotropy, 1e-6)
        return self.roughness * np.sqrt(np.minimum(across, 1.0 / across))

    def take(self, index) -> "SurfaceSamples":
        """The samples at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        count = len(self.position[index])
        return replace(self, **{field.name: _taken(getattr(self, field.name), index, count) for field in fields(self)})

    @classmethod
    def joined(cls, pieces: "list[SurfaceSamples]") -> "SurfaceSamples":
        """The samples of all `pieces`, at least one, one after another."""
        if len(pieces) == 1:
            return pieces[0]
        names = [field.name for field in fields(cls)]
        return cls(**{name: _one_after_another([getattr(piece, name) for piece in pieces]) for name in names})


def is_constant(values: np.ndarray) -> bool:
    """True for a broadcast scalar, which most fields of samples are."""
    return values.size > 0 and not any(values.strides)


def _taken(values: np.ndarray, index, count: int) -> np.ndarray:
    """The `count` rows at `index`."""
    return np.broadcast_to(values.flat[0], (count, *values.shape[1:])) if is_constant(values) else values[index]


def _one_after_another(pieces: list[np.ndarray]) -> np.ndarray:
    """All rows of the `pieces`."""
    if all(map(is_constant, pieces)) and len({piece.flat[0] for piece in pieces}) == 1:
        return np.broadcast_to(pieces[0].flat[0], (sum(map(len, pieces)), *pieces[0].shape[1:]))
    return np.concatenate(pieces)


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
