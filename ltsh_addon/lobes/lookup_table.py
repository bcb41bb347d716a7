"""The lookup table of a fitted BRDF: axes, stored quantities, bilinear lookup.

The lobe is D(w) = D_orig(w') |W| / |W w|^3, w' = W w / |W w| (Heitz et al. 2016, eq. 1). The warp W = M^-1 is known up
to a factor. It is upper triangular, so it leaves the horizon in place:

    W = [[A g^2, 0, A B g sin(theta_o)], [0, C, 0], [0, 0, 2 alpha]],
    g^2 = cos^2(theta_o) + sin^2(theta_o) alpha^2 / 4

The table stores A, B and C. They tend to 1 as alpha -> 0, where GGX becomes an exactly transformed clamped cosine;
therefore they can be interpolated. At normal incidence A = C. D_orig is a spherical harmonics expansion ("ltsh"), or a
clamped cosine around the axis (sin(tilt), 0, cos(tilt)) ("ltc"; tilt is the fourth parameter of M). A table with a
`bend` adds two linear functions under one more warp to the spherical harmonics; that warp is the same for the whole
table, see `bent_cosines`.

Axes: roughness is uniform; theta_o is uniform in 1 - sqrt(1 - theta_o / 90 deg), which is dense at grazing angles.

There is one coefficient vector per Fresnel curve; all share the warp. A lobe is linear in its coefficients. So a
reflectance sum_f w_f F_f(c), where c is the cosine of the half angle, has the coefficients sum_f w_f c_f. Curves 0, 1
and 2 are 1, (1 - c)^5 (Schlick 1994) and c (1 - c)^6 (the F82 tint of metals). `dielectric_weights` gives w_f for
dielectrics.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from ..reading import NUMBER, Malformed, check, parse_json, read_arrays
from ..scene import SHIPPED_TABLES
from .edge_integrals import MAX_DEGREE, ridge_matrix
from .spherical_harmonics import coefficient_count, degree_of, evaluate, hemisphere_integrals

FORMAT_VERSION = 2
WARP_REGULARIZATION = 0.5
# Below this alpha every surface counts as a mirror at the size of real lights; above it, the warp is invertible.
MIN_ALPHA = 1e-5
_MOST_BENT = 1e3
# Arrays by name, and the least length of each of their axes. Shading needs the first three Fresnel curves.
_FEWEST = {
    "warp": (2, 2, 3),
    "coefficients": (2, 2, 3, 1),
    "fresnel_curves": (3, 2),
    "fresnel_ior": (1,),
    "fresnel_weights": (1, 3),
    "average_albedo": (2, 3),
}
_METADATA = {
    "family": str, "degree": int, "name?": str, "brdf?": str, "fresnel_curve_names?": [str], "bend?": [NUMBER],
}  # fmt: skip


class TableError(ValueError):
    """A lookup table is missing, unreadable or not of this format."""


@dataclass(frozen=True)
class Lobe:
    """Lobes of P points: the entries of W, the tilt of the clamped cosine (None for "ltsh"), and the coefficients."""

    xx: np.ndarray  # (P,)
    xz: np.ndarray  # (P,)
    yy: np.ndarray  # (P,)
    zz: np.ndarray  # (P,)
    tilt: np.ndarray | None  # (P,) radians
    coefficients: np.ndarray  # (F, K, P), one vector per Fresnel curve

    def to_original_domain(self, vectors: np.ndarray) -> np.ndarray:
        """W times `vectors` (3, ..., P): eq. 2 of Allmenroeder and Peters 2021."""
        return np.stack(
            [self.xx * vectors[0] + self.xz * vectors[2], self.yy * vectors[1], self.zz * vectors[2]], axis=0
        )

    def with_coefficients(self, coefficients: np.ndarray) -> "Lobe":
        """The same warps with other coefficients (F, K, P)."""
        return replace(self, coefficients=coefficients)

    def take(self, index) -> "Lobe":
        """The lobes at `index`: integers (Q,) or a boolean mask (P,)."""
        tilt = None if self.tilt is None else self.tilt[index]
        entries = (self.xx[index], self.xz[index], self.yy[index], self.zz[index])
        return Lobe(*entries, tilt, self.coefficients[:, :, index])

    def albedo(self) -> np.ndarray:
        """Integrals (F, P) over the hemisphere: the directional albedo for each Fresnel curve."""
        if self.tilt is not None:
            return self.coefficients[:, 0] * (0.5 + 0.5 * np.cos(self.tilt))
        integrals = basis_integrals(self.coefficients.shape[1]).astype(self.coefficients.dtype)
        # No BLAS, so that a result does not depend on how many points share a batch.
        return sum(integral * self.coefficients[:, k] for k, integral in enumerate(integrals) if integral != 0.0)


@dataclass(frozen=True)
class LookupTable:
    """The arrays of one fitted table; see the module's docstring."""

    name: str
    family: str  # "ltc" or "ltsh"
    degree: int  # of the spherical harmonics; 1 for "ltc"
    warp: np.ndarray  # (R, T, 3) A, B, C for "ltsh"; (R, T, 4) with the tilt in radians for "ltc"
    coefficients: np.ndarray  # (R, T, F, K) in sr^-1: of Y_lm ("ltsh") or of the unit-mass clamped cosine ("ltc")
    fresnel_curves: np.ndarray  # (F, C) sampled at C uniform cosines of the half angle in [0, 1]
    fresnel_ior: np.ndarray  # (I,) increasing
    fresnel_weights: np.ndarray  # (I, F): weights of the curves that give the reflectance of a dielectric of that IOR
    average_albedo: np.ndarray  # (R, F) integral of 2 mu albedo(mu) over mu in [0, 1]
    metadata: dict
    bend: tuple[float, float, float] | None = None  # warp of `bent_cosines`; the last two coefficients are then theirs

    def basis(self, unit: np.ndarray) -> np.ndarray:
        """Values (K, ...), at unit directions (..., 3), of the functions that the coefficients of "ltsh" multiply."""
        return basis_values(self.degree, self.bend, unit)

    @cached_property
    def _channels(self) -> np.ndarray:
        rows, columns = self.warp.shape[:2]
        parts = [self.warp.reshape(rows * columns, -1).T, self.coefficients.reshape(rows * columns, -1).T]
        return np.concatenate(parts)

    @cached_property
    def ridge_weights(self) -> np.ndarray:
        """Matrix (K, K) that turns coefficients of "ltsh" into weights of a polygon's moments. These are the moments of
        `edge_integrals.moments`, then twice the integrals of x and z over the bent polygon."""
        matrix = ridge_matrix(self.degree)
        if self.bend is None:
            return matrix
        count = len(matrix)
        bent = np.zeros((count + 2, count + 2))
        bent[:count, :count] = matrix
        bent[[count, count + 1], [count, count + 1]] = 0.5 / np.pi
        return bent

    def lookup(self, cos_theta_o: np.ndarray, roughness: np.ndarray, curves: int | None = None) -> Lobe:
        """Bilinearly interpolated lobes at cos_theta_o (P,) and roughness (P,), both clamped to [0, 1], with
        coefficients for the first `curves` Fresnel curves (None: all)."""
        cosine = np.clip(cos_theta_o, 0.0, 1.0)
        dtype = cosine.dtype
        roughness = np.clip(roughness, 0.0, 1.0).astype(dtype, copy=False)
        parameters, (total, count) = self.warp.shape[2], self.coefficients.shape[2:]
        curves = total if curves is None else curves
        wanted = self._channels[: parameters + curves * count]
        channels = _interpolate(wanted, self.warp.shape[:2], roughness, _theta_coordinate(cosine))
        alpha = np.maximum(roughness * roughness, dtype.type(MIN_ALPHA))
        return Lobe(
            *warp_entries(cosine, alpha, *channels[:3]),
            tilt=channels[3] if parameters == 4 else None,
            coefficients=channels[parameters:].reshape(curves, count, -1),
        )

    @cached_property
    def _albedos(self) -> np.ndarray:
        warp, coefficients = (
            np.moveaxis(values.reshape(-1, *values.shape[2:]), 0, -1) for values in (self.warp, self.coefficients)
        )
        return Lobe(*warp[[0, 0, 0, 0]], warp[3] if len(warp) > 3 else None, coefficients).albedo().astype(np.float32)

    def albedos(self, cos_theta_o: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """Directional albedos (F, P) in single precision for all Fresnel curves; arguments as for `lookup`."""
        cosine, roughness = (np.clip(values, 0.0, 1.0).astype(np.float32) for values in (cos_theta_o, roughness))
        return _interpolate(self._albedos, self.warp.shape[:2], roughness, _theta_coordinate(cosine))

    def average_albedos(self, roughness: np.ndarray) -> np.ndarray:
        """`average_albedo` (F, P) at roughness (P,), clamped to [0, 1]."""
        nodes = roughness_nodes(len(self.average_albedo))
        return np.stack([np.interp(roughness, nodes, column) for column in self.average_albedo.T])

    def dielectric_weights(self, ior: np.ndarray) -> np.ndarray:
        """Weights (F, P) of the Fresnel curves for dielectrics of relative `ior` (P,), clamped to the table's range."""
        return np.stack([np.interp(ior, self.fresnel_ior, column) for column in self.fresnel_weights.T])


def bent(bend, vectors) -> np.ndarray:
    """Vectors (3, ...) under the warp of `bent_cosines`."""
    xx, xz, yy = (np.asarray(entry, vectors.dtype) for entry in bend)
    return np.stack([xx * vectors[0] + xz * vectors[2], yy * vectors[1], vectors[2]])


def bent_cosines(bend, unit) -> np.ndarray:
    """Values (2, ...), at unit directions (..., 3), of x / pi and z / pi under the warp [[xx, 0, xz], [0, yy, 0],
    [0, 0, 1]] of `bend` (xx, xz, yy). The second is a linearly transformed cosine, the first its derivative by the
    direction to which it leans. Their integrals over the hemisphere are 0 and 1."""
    warped = bent(bend, np.moveaxis(unit, -1, 0))
    squares = (warped * warped).sum(axis=0)
    return warped[::2] * (bend[0] * bend[2] / np.pi / (squares * squares)).astype(unit.dtype)


def basis_values(degree, bend, unit) -> np.ndarray:
    """Values (K, ...) at unit directions (..., 3): spherical harmonics, then the `bent_cosines` of a bend."""
    basis = evaluate(degree, unit)
    return basis if bend is None else np.concatenate([basis, bent_cosines(bend, unit)])


@cache
def basis_integrals(count: int) -> np.ndarray:
    """Integrals (K,) over the hemisphere of the `count` functions of `basis_values`."""
    degree = degree_of(count)
    integrals = hemisphere_integrals(degree)
    return integrals if count == len(integrals) else np.concatenate([integrals, [0.0, 1.0]])


def warp_entries(cosine, alpha, a, b, c, sine=None):
    """Entries (xx, xz, yy, zz) of W for the stored A, B, C; all arrays broadcast. Give the `sine` in single precision,
    where it does not follow from a cosine close to one."""
    if sine is None:
        sine = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    squared = cosine * cosine + (WARP_REGULARIZATION * alpha * sine) ** 2
    return a * squared, a * b * np.sqrt(squared) * sine, c, 2.0 * alpha


def _theta_coordinate(cosine):
    return 1.0 - np.sqrt(np.maximum(1.0 - np.arccos(cosine) * (2.0 / np.pi), 0.0))


def theta_nodes(count: int) -> np.ndarray:
    """theta_o (T,) in radians of the table's columns."""
    return theta_at(np.linspace(0.0, 1.0, count))


def theta_at(coordinate: np.ndarray) -> np.ndarray:
    """theta_o in radians at a coordinate in [0, 1] along the columns."""
    return 0.5 * np.pi * (1.0 - (1.0 - coordinate) ** 2)


def roughness_nodes(count: int) -> np.ndarray:
    """Roughness (R,) of the table's rows."""
    return np.linspace(0.0, 1.0, count)


def _interpolate(channels, shape, roughness, theta_coordinate):
    """Channels (C, P) at roughness and theta coordinate in [0, 1], by bilinear interpolation of channels (C, R * T)."""
    rows, columns = shape
    dtype = roughness.dtype
    row_position, column_position = roughness * (rows - 1), theta_coordinate * (columns - 1)
    row = np.minimum(row_position.astype(np.intp), rows - 2)
    column = np.minimum(column_position.astype(np.intp), columns - 2)
    row_weight = (row_position - row).astype(dtype)
    column_weight = (column_position - column).astype(dtype)
    corner = row * columns + column

    def along_columns(first):
        near, far = (np.take(channels, index, axis=1).astype(dtype, copy=False) for index in (first, first + 1))
        return near * (1.0 - column_weight) + far * column_weight

    return along_columns(corner) * (1.0 - row_weight) + along_columns(corner + columns) * row_weight


def load_table(name_or_path: str | Path) -> LookupTable:
    """A shipped table ("ltc", "ltsh2", "ltsh4" or "ltsh4c"), or the one in a .npz file. Raises TableError.

    Shipped tables are loaded once, and their arrays cannot be written. A user's table may change meanwhile.
    """
    if str(name_or_path) in SHIPPED_TABLES:
        return _shipped_table(str(name_or_path))
    return _read_table(name_or_path, Path(name_or_path))


@cache
def _shipped_table(name: str) -> LookupTable:
    table = _read_table(name, _tables_folder() / f"{name}.npz")
    for array in (value for value in vars(table).values() if isinstance(value, np.ndarray)):
        array.setflags(write=False)
    return table


def _read_table(name_or_path: str | Path, path: Path) -> LookupTable:
    if not path.is_file():
        raise TableError(f"lookup table {name_or_path}: no such file or table; shipped are {', '.join(SHIPPED_TABLES)}")
    try:
        arrays = read_arrays(path, (*_FEWEST, "metadata"))
        metadata = parse_json(str(arrays.pop("metadata")))
        _check_metadata(metadata)
        _check_arrays(arrays, metadata)
    except OSError as error:
        raise TableError(f"lookup table {path}: cannot be read ({error.strerror})") from error
    except Malformed as error:
        raise TableError(f"lookup table {path}: {error}; fit it again or reinstall") from error
    known = {name: metadata[name] for name in ("family", "degree")}
    if "bend" in metadata:
        known["bend"] = tuple(float(entry) for entry in metadata["bend"])
    return LookupTable(name=metadata.get("name", path.stem), metadata=metadata, **known, **arrays)


def _tables_folder() -> Path:
    """The folder of the shipped tables: inside an installed Python package, else beside it, as in checkout and zip."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "tables"
    return inside if inside.is_dir() else package.with_name("tables")


def _check_metadata(metadata) -> None:
    check(metadata, {"format_version": int}, "metadata")
    if metadata["format_version"] != FORMAT_VERSION:
        raise Malformed(f"format version is {metadata['format_version']}, expected {FORMAT_VERSION}")
    check(metadata, _METADATA, "metadata")
    family, degree = metadata["family"], metadata["degree"]
    if family not in ("ltc", "ltsh") or not 1 <= degree <= MAX_DEGREE:
        raise Malformed(f"family {family!r} of degree {degree} is unknown")
    bend = metadata.get("bend", [1.0, 0.0, 1.0])
    if len(bend) != 3 or not all(abs(entry) <= _MOST_BENT for entry in bend) or min(bend[0], bend[2]) < 1 / _MOST_BENT:
        raise Malformed(f"bend is {bend}, expected xx, xz and yy of a warp, xx and yy above 0")
    if family == "ltc" and "bend" in metadata:
        raise Malformed("bend: expected none in a table of clamped cosines")


def _check_arrays(arrays, metadata) -> None:
    for key, value in arrays.items():
        least = _FEWEST[key]
        if value.dtype.kind != "f" or value.ndim != len(least):
            raise Malformed(f"{key} has {value.ndim} axes of {value.dtype}, expected {len(least)} of floats")
        if any(count < limit for count, limit in zip(value.shape, least, strict=True)):
            raise Malformed(f"{key} has shape {value.shape}, expected at least {least}")
        if not (np.abs(value) <= np.finfo(np.float32).max).all():
            raise Malformed(f"{key} holds NaN or infinity in single precision, expected finite numbers")
    (rows, columns), curves = arrays["warp"].shape[:2], len(arrays["fresnel_curves"])
    is_ltc = metadata["family"] == "ltc"
    count = 1 if is_ltc else coefficient_count(metadata["degree"]) + (2 if "bend" in metadata else 0)
    shapes = {
        "warp": (rows, columns, 4 if is_ltc else 3),
        "coefficients": (rows, columns, curves, count),
        "fresnel_weights": (len(arrays["fresnel_ior"]), curves),
        "average_albedo": (rows, curves),
    }
    for key, shape in shapes.items():
        if arrays[key].shape != shape:
            raise Malformed(f"{key} has shape {arrays[key].shape}, expected {shape}")
    if (np.diff(arrays["fresnel_ior"]) <= 0.0).any():
        raise Malformed("fresnel_ior does not increase")
