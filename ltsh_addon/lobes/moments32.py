"""The hot path in float32: moments of polygons, and the tables that weight them.

The moments are those of `edge_integrals`, but as coefficients of forms. They are computed without any branch, from the
cosines of the edges instead of the sums of their ends. The mask `needs_float64` marks points for which that is not
accurate; the caller computes these again in double precision. Temporary arrays come from a `Scratch`, whose next user
overwrites them.
"""

from dataclasses import dataclass, field
from functools import cache
from math import prod

import numpy as np

from .edge_integrals import RIDGE_DIRECTIONS, arc_polynomial, shadowed_integral
from .lookup_table import MIN_ALPHA, LookupTable, warp_entries
from .spherical_harmonics import coefficient_count

MAX_DEGREE = 4
# Limits beyond which a polygon needs float64. SHORTEST_SAFE: least 1 + cos(theta) of an edge; an edge of nearly half a
# circle, here by 8 degrees, has no direction. SMALLEST_SAFE: least sum of the edges' angles in rad, if all are equal;
# the edges of a tiny polygon cancel. NEAREST_SAFE: least distance of a corner in units of the distance of the farthest
# corner, to which the rounding of all corners is proportional.
SHORTEST_SAFE = 0.01
SMALLEST_SAFE = 0.08
NEAREST_SAFE = 0.01
# Larger solid angles, close to 2 pi, are close to the branch cut of the arc tangent.
LARGEST_SAFE_ANGLE = 5.9
# Lobes below this roughness, where 2 alpha = 0.02, amplify the rounding of directions too much for single precision.
SHARP_ROUGHNESS = 0.1
# With more corners, single precision cannot tell the angle of one edge from 0, and products leave its range.
MANY_CORNERS = 64
# Corners of the polygons in one piece: its arrays stay in a second-level cache of 1 MiB.
PIECE_CORNERS = 24624
_VIEWS_KEPT = 1000
_DIELECTRICS_KEPT = 64
_TINY = np.float32(1e-30)


class Scratch:
    """Float32 arrays by name, made once and reused: `scratch("name", shape)`."""

    def __init__(self):
        self._arrays: dict[str, np.ndarray] = {}
        self._views: dict[tuple, np.ndarray] = {}

    def __call__(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        view = self._views.get((name, shape))
        return self._view(name, shape) if view is None else view

    def _view(self, name, shape):
        size = prod(shape)
        array = self._arrays.get(name)
        if array is None or array.size < size:
            # Views of the smaller array would keep it alive.
            self._views = {key: view for key, view in self._views.items() if key[0] != name}
            array = self._arrays[name] = np.empty(size, dtype=np.float32)
        elif len(self._views) > _VIEWS_KEPT:
            self._views.clear()
        view = self._views[name, shape] = array[:size].reshape(shape)
        return view


def pieces(count: int, most: int, least: int = 512) -> list[slice]:
    """Slices of about equal length that make up `count` elements; at most `most` long, or `least` if that is more."""
    number = max(-(-count // max(most, least)), 1)
    size = max(-(-count // number), 1)
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


@cache
def _arc_coefficients(factor: str, degree: int) -> np.ndarray:
    """Coefficients of `arc_polynomial` in s = sqrt(1 + cos theta); the relative error is 8e-7 for phi, 6e-7 for psi."""
    return arc_polynomial(factor, degree, np.sqrt(2.0)).astype(np.float32)


def _horner(coefficients, variable, out):
    np.multiply(variable, coefficients[0], out=out)
    for coefficient in coefficients[1:-1]:
        out += coefficient
        out *= variable
    out += coefficients[-1]
    return out


def _arc_factor(factor, degree, shifted, scratch):
    """phi or psi, from a polynomial, of edges with 1 + cos(theta) in `shifted` (V, P)."""
    root = np.sqrt(shifted, out=scratch("root", shifted.shape))
    values = _horner(_arc_coefficients(factor, degree), root, scratch(factor, shifted.shape))
    values /= root
    return values


def _phi(shifted, scratch):
    return _arc_factor("phi", 7, shifted, scratch)


class _ArcFactors:
    """Factors that all ridges share: phi, q = 1 / (1 + cos), psi, q (1 + psi) / 2 and (q + 1) / 3; None if unused."""

    def __init__(self, degree, shifted, scratch):
        shape = shifted.shape
        self.q = self.psi = self.square = self.cube = None
        if degree < 3:
            self.phi = _phi(shifted, scratch)
        else:
            self.psi = _arc_factor("psi", 8, shifted, scratch)
            self.phi = np.subtract(np.float32(2.0), shifted, out=scratch("phi", shape))
            self.phi *= self.psi
            self.phi += np.float32(1.0)
        if degree > 1:
            self.q = np.divide(np.float32(1.0), shifted, out=scratch("q", shape))
        if degree > 2:
            self.square = np.add(self.psi, np.float32(1.0), out=scratch("square", shape))
            self.square *= self.q
            self.square *= np.float32(0.5)
        if degree > 3:
            self.cube = np.add(self.q, np.float32(1.0), out=scratch("cube", shape))
            self.cube *= np.float32(1.0 / 3.0)


def _edges(corners, scratch, smallest):
    """Unit vectors (3, V + 1, P) along the corners (>= 3 rows, V, P), where the first corner is repeated at the end;
    1 + cos(theta) (V, P) of the edges, kept positive; and the mask (P,) of polygons that need float64, among them those
    whose edges add up to less than `smallest`."""
    _, count, points = corners.shape
    unit = scratch("unit", (3, count + 1, points))
    length = scratch("two", (count, points))
    squares = np.multiply(corners[:3], corners[:3], out=scratch("three", (3, count, points)))
    np.add.reduce(squares, axis=0, out=length)
    near = np.maximum.reduce(length, axis=0)
    near *= np.float32(NEAREST_SAFE**2)
    needs_float64 = np.minimum.reduce(length, axis=0) < near
    # A corner at the point itself becomes the zero vector.
    length += _TINY
    np.divide(np.float32(1.0), np.sqrt(length, out=length), out=length)
    np.multiply(corners[:3], length, out=unit[:, :-1])
    unit[:, -1] = unit[:, 0]
    products = np.multiply(unit[:, :-1], unit[:, 1:], out=scratch("three", (3, count, points)))
    shifted = np.add.reduce(products, axis=0, out=scratch("shifted", (count, points)))
    shifted += np.float32(1.0)
    least = np.minimum.reduce(shifted, axis=0)
    np.absolute(shifted, out=shifted)
    shifted += np.float32(1e-12)
    needs_float64 |= least < np.float32(SHORTEST_SAFE)
    if smallest > 0.0:
        needs_float64 |= least > np.float32(2.0 - 0.5 * (smallest / min(count, MANY_CORNERS)) ** 2)
    return unit, shifted, needs_float64


def _cross_component(unit, first, second, scratch, out):
    """Component (V, P) of the cross products of the ends of the edges: a[first] b[second] - a[second] b[first]."""
    np.multiply(unit[first, :-1], unit[second, 1:], out=out)
    out -= np.multiply(unit[second, :-1], unit[first, 1:], out=scratch("one", out.shape))
    return out


def cosine_integral(
    corners: np.ndarray, scratch: Scratch, smallest: float = SMALLEST_SAFE
) -> tuple[np.ndarray, np.ndarray]:
    """Signed integral (P,) of z over polygons (>= 3 rows, V, P) in z >= 0, and the mask (P,) of points that need
    float64."""
    unit, shifted, needs_float64 = _edges(corners, scratch, smallest)
    phi = _phi(shifted, scratch)
    normal = _cross_component(unit, 0, 1, scratch, scratch("normal", shifted.shape))
    normal *= phi
    integral = np.add.reduce(normal, axis=0)
    integral *= np.float32(0.5)
    return integral, needs_float64


def shadowed_cosine_integral(
    corners: np.ndarray, smooth: np.ndarray, terms: np.ndarray, scratch: Scratch, smallest: float = SMALLEST_SAFE
) -> tuple[np.ndarray, np.ndarray]:
    """As `cosine_integral`, of z times bump shadowing with `shadowing_terms` (5, P).

    `smooth` (2, P) are the x and z of the smooth normal, whose y is 0. Row 3 of the corners (>= 4, V, P) are their
    products with it, which are not negative."""
    count, points = corners.shape[1:]
    integral, needs_float64 = np.empty(points, np.float32), np.empty(points, bool)
    for piece in pieces(points, PIECE_CORNERS // count):
        unit, shifted, needs_float64[piece] = _edges(corners[:, :, piece], scratch, smallest)
        # Double precision splits such long edges, and then finds other nodes.
        needs_float64[piece] |= np.minimum.reduce(shifted, axis=0) < np.float32(2.01 * SHORTEST_SAFE)
        heights = scratch("heights", unit.shape[1:])
        np.multiply(corners[3, :, piece], scratch("two", shifted.shape), out=heights[:-1])  # 1 / lengths, of `_edges`
        heights[-1] = heights[0]
        normal, (sine, cosine) = scratch("normal", (3, *shifted.shape)), smooth[:, piece]
        for row, (first, second) in zip(normal, ((1, 2), (2, 0), (0, 1)), strict=True):
            _cross_component(unit, first, second, scratch, row)
        normal *= _phi(shifted, scratch)
        total = np.add.reduce(normal, axis=1)
        along = sine * total[0] + cosine * total[2]
        mean = np.abs(along) / np.sqrt((total * total).sum(axis=0) + _TINY)
        normal[0] *= sine
        normal[0] += cosine * normal[2]
        normal[0] *= cosine
        ends = heights[:-1], heights[1:]
        integral[piece] = shadowed_integral(normal[::-2], ends, shifted, mean, terms[:, piece])
    return integral, needs_float64


def form_matrix(degree: int, more: int = 0) -> np.ndarray:
    """Matrix (K, K) from the `moments` of this module to those of `edge_integrals.moments`, and `more` equal ones.

    The sum of (u.X) K_k over the edges is a homogeneous form of degree k + 1 in u. The moments of this module are its
    coefficients of u_x^(k+1), u_x^k u_z, ..., u_z^(k+1). Those of `edge_integrals` are its values for the first k + 2
    directions.
    """
    matrix = np.eye(coefficient_count(degree) + more)
    for k in range(degree):
        rows = slice(1 + k * (k + 3) // 2, 1 + (k + 1) * (k + 4) // 2)
        power = np.arange(k + 2)
        matrix[rows, rows] = [u_x ** power[::-1] * u_z**power for u_x, u_z in RIDGE_DIRECTIONS[: k + 2]]
    return matrix


def moments(
    corners: np.ndarray, degree: int, scratch: Scratch, smallest: float = SMALLEST_SAFE, bend: tuple | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Moments (K, P) of polygons (>= 3 rows, V, P) in z >= 0, in the order of `form_matrix`, and the mask (P,) of
    points that need float64. Corners need not be unit vectors; `degree` is 1 to 4. With the `bend` of a table, its two
    moments follow. The next call overwrites the result."""
    unit, shifted, needs_float64 = _edges(corners, scratch, smallest)
    count, bent_count = coefficient_count(degree), 0 if bend is None else 2
    result = scratch("moments", (count + bent_count, shifted.shape[1]))
    normal = _polynomial_moments(unit, shifted, degree, scratch, result)
    needs_float64 |= np.abs(result[0]) > np.float32(LARGEST_SAFE_ANGLE)
    if bend is not None:
        needs_float64 |= _bent_moments(unit, normal, bend, scratch, result[count:])
    return result, needs_float64


def _polynomial_moments(unit, shifted, degree, scratch, result):
    """Write the moments into `result` (>= K, P). Returns the x and z components (2, V, P) of the edges' normals."""
    shape = shifted.shape
    normal = scratch("normal", (2, *shape))
    for row, (first, second) in zip(normal, ((1, 2), (0, 1)), strict=True):
        _cross_component(unit, first, second, scratch, row)
    total = np.add(unit[::2, :-1], unit[::2, 1:], out=scratch("total", normal.shape))
    result[0] = _solid_angle(shifted, total[1], normal[1], scratch)
    factors = _ArcFactors(degree, shifted, scratch)
    pair = scratch("pair", normal.shape)
    np.add.reduce(np.multiply(normal, factors.phi, out=pair), axis=1, out=result[1:3])
    if degree == 1:
        return normal
    np.multiply(normal, factors.q, out=pair)
    linear = _product(pair, total, scratch("linear", (3, *shape)), scratch)
    np.add.reduce(linear, axis=1, out=result[3:6])
    if degree == 2:
        return normal
    product = _product(unit[::2, :-1], unit[::2, 1:], scratch("product", linear.shape), scratch)
    squared = _product(total, total, scratch("squared", linear.shape), scratch)
    if degree == 4:
        np.add.reduce(_quartic(linear, product, squared, factors.cube, pair, scratch), axis=1, out=result[10:15])
    squared *= factors.square
    product *= factors.psi
    squared -= product
    cubic = scratch("cubic", (4, *shape))
    np.multiply(normal, squared[::2], out=cubic[::3])
    np.multiply(normal, squared[1], out=cubic[1:3])
    cubic[1:3] += np.multiply(normal[::-1], squared[::2], out=pair)
    np.add.reduce(cubic, axis=1, out=result[6:10])
    return normal


def _bent_moments(unit, normal, bend, scratch, out):
    """Write twice the integrals of x and z over bent polygons into `out` (2, P), and return the mask (P,) of points
    that need float64. `lookup_table.bent` bends the polygons with the corners `unit` (3, V + 1, P). Overwrites
    `normal`, the result of `_polynomial_moments`."""
    xx, xz, yy = (np.float32(entry) for entry in bend)
    shape = normal.shape[1:]
    rows, length = scratch("bent", (2, *unit.shape[1:])), scratch("bent_length", unit.shape[1:])
    np.multiply(unit[0], xx, out=rows[0])
    rows[0] += np.multiply(unit[2], xz, out=length)
    np.multiply(unit[1], yy, out=rows[1])
    np.multiply(unit[2], unit[2], out=length)
    squares = np.multiply(rows, rows, out=scratch("bent_squares", rows.shape))
    length += squares[0]
    length += squares[1]
    length += _TINY
    np.divide(np.float32(1.0), np.sqrt(length, out=length), out=length)
    scale = np.multiply(length[:-1], length[1:], out=scratch("two", shape))
    products = np.multiply(rows[:, :-1], rows[:, 1:], out=scratch("pair", normal.shape))
    shifted = np.multiply(unit[2, :-1], unit[2, 1:], out=scratch("shifted", shape))
    shifted += products[0]
    shifted += products[1]
    shifted *= scale
    shifted += np.float32(1.0)
    needs_float64 = np.minimum.reduce(shifted, axis=0) < np.float32(SHORTEST_SAFE)
    np.absolute(shifted, out=shifted)
    shifted += np.float32(1e-12)
    phi = _phi(shifted, scratch)
    phi *= scale
    # The cross product of warped vectors is the cofactor matrix of the warp times the cross product of the vectors.
    normal[1] *= xx
    normal[1] -= np.multiply(normal[0], xz, out=scratch("one", shape))
    normal *= phi
    np.add.reduce(normal, axis=1, out=out)
    out *= yy
    return needs_float64


def _product(a, b, out, scratch):
    """Coefficients (3, V, P) of the product of linear forms a and b (2, V, P): x x, x z + z x, z z."""
    np.multiply(a, b, out=out[::2])
    np.multiply(a[0], b[1], out=out[1])
    out[1] += np.multiply(a[1], b[0], out=scratch("one", out.shape[1:]))
    return out


def _quartic(linear, product, squared, cube, pair, scratch):
    """Coefficients (5, V, P) of (u.X) K_3. `linear` (3, V, P) is the quadratic form q (u.X) (u.c), where c = a + b;
    `product` is that of (u.a) (u.b), `squared` that of (u.c)^2. `pair` (2, V, P) is overwritten."""
    inner = np.multiply(squared, cube, out=scratch("inner", linear.shape))
    inner -= product
    result = scratch("quartic", (5, *cube.shape))
    np.multiply(linear[::2], inner[::2], out=result[::4])
    np.multiply(linear[::2], inner[1], out=result[1::2])
    result[1::2] += np.multiply(inner[::2], linear[1], out=pair)
    np.multiply(linear[1], inner[1], out=result[2])
    np.multiply(linear[::2], inner[::-2], out=pair)
    result[2] += pair[0]
    result[2] += pair[1]
    return result


def _normalize(real, imaginary, scratch):
    """Divide complex numbers (V, P) by roughly their magnitude: only their arguments matter."""
    size = np.abs(real, out=scratch("one", real.shape))
    size += np.abs(imaginary)
    size += _TINY
    real /= size
    imaginary /= size


def _solid_angle(shifted, total_z, normal_z, scratch):
    """Signed solid angle (P,): twice the argument of the product over the edges of (1 + a_z + b_z + a.b) + i X_z."""
    count, points = shifted.shape
    real = np.add(shifted, total_z, out=scratch("real", shifted.shape))
    imaginary = scratch("imaginary", shifted.shape)
    many = count > MANY_CORNERS
    if count > 8:  # keep the product of many factors in range
        real *= np.float32(0.5)
        np.multiply(normal_z, np.float32(0.5), out=imaginary)
    else:
        np.copyto(imaginary, normal_z)
    while count > 1:
        half = count // 2
        if many:
            _normalize(real[:count], imaginary[:count], scratch)
        a, b = real[:half], imaginary[:half]
        c, d = real[half : 2 * half], imaginary[half : 2 * half]
        new_real = np.multiply(a, c, out=scratch("product_real", (half, points)))
        new_real -= np.multiply(b, d, out=scratch("one", (half, points)))
        b *= c
        b += np.multiply(a, d, out=scratch("one", (half, points)))
        real[:half] = new_real
        if count % 2:
            real[half], imaginary[half] = real[count - 1], imaginary[count - 1]
        count -= half
    angle = np.arctan2(imaginary[0], real[0])
    angle *= np.float32(2.0)
    return angle


def weighted_moments(
    corners: np.ndarray,
    weights: np.ndarray,
    degree: int,
    scratch: Scratch,
    smallest: float = SMALLEST_SAFE,
    bend: tuple | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sums (F, P) of the `moments` of polygons (>= 3 rows, V, P) times weights (F, K, P); the signed solid angles (P,)
    in sr; the signed integrals (P,) of z / pi; and the mask (P,) of points that need float64. `degree` is 1 to 4."""
    vectors, _, points = weights.shape
    sums = np.empty((vectors, points), np.float32)
    angle, cosine, needs_float64 = np.empty(points, np.float32), np.empty(points, np.float32), np.empty(points, bool)
    for piece in pieces(points, PIECE_CORNERS // corners.shape[1]):
        terms, needs_float64[piece] = moments(corners[:, :, piece], degree, scratch, smallest, bend)
        weight = weights[:, :, piece]
        products = np.multiply(weight, terms, out=scratch("weighted", weight.shape))
        np.add.reduce(products, axis=1, out=sums[:, piece])
        angle[piece] = terms[0]
        np.multiply(terms[2], np.float32(0.5 / np.pi), out=cosine[piece])
    return sums, angle, cosine, needs_float64


@dataclass(frozen=True)
class RidgeTable:
    """One table prepared for the hot path; `fetch` interpolates chosen vectors of its weights.

    Coefficients of spherical harmonics become weights of the moments once, at the nodes of the table. Both this and the
    interpolation are linear, so their order may be swapped. Only the Fresnel curves that a batch of points needs are
    fetched. A vector is the number of a Fresnel curve, or ("dielectric", ior), or, in the last place, "dielectric" for
    each sample's own IOR.
    """

    source: LookupTable
    parameters: np.ndarray  # (3 or 4, R * T): A, B, C and, for "ltc", the tilt
    weights: np.ndarray  # (F, K, R * T): weights of the moments; for "ltc", of the clamped cosine
    _stacked: dict = field(default_factory=dict)

    @property
    def degree(self) -> int:
        """Degree of the moments; 1 for "ltc", which needs only the integral of z."""
        return self.source.degree

    def channels(self, vectors: tuple) -> np.ndarray:
        """Float32 array (C, R * T): the warp's parameters, then the K weights of each vector."""
        stacked = self._stacked.get(vectors)
        if stacked is None:
            if len(self._stacked) >= _DIELECTRICS_KEPT:
                self._stacked.clear()
            parts = [self.parameters, *(self._vector(vector) for vector in vectors)]
            stacked = self._stacked[vectors] = np.concatenate(parts).astype(np.float32)
        return stacked

    def _vector(self, vector):
        if not isinstance(vector, tuple):
            return self.weights[vector]
        _, ior = vector
        shares = self.source.dielectric_weights(np.array([ior]))[:, 0]
        return sum(share * weights for share, weights in zip(shares, self.weights, strict=True))

    def fetch(self, vectors, cosine, sine, roughness, ior, scratch) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Warp entries xx, xz, yy, zz (4, P), weights (len(vectors), K, P), and the tilt (P,) of "ltc", else None.

        cosine and sine (P,) of theta_o and roughness (P,) are float32; ior is (P,). The next call with this scratch
        overwrites the result.
        """
        many = vectors[-1] == "dielectric"
        curves = tuple(range(len(self.weights)))
        channels = self.channels(vectors[:-1] + curves if many else vectors)
        shape = self.source.warp.shape[:2]
        theta = np.arctan2(sine, cosine)
        coordinate = 1.0 - np.sqrt(np.maximum(1.0 - theta * np.float32(2.0 / np.pi), np.float32(0.0)))
        values = _bilinear(channels, shape, roughness, coordinate, scratch)
        alpha = np.maximum(roughness * roughness, np.float32(MIN_ALPHA))
        warp = np.stack(warp_entries(cosine, alpha, *values[:3], sine=sine))
        count = len(self.parameters)
        weights = values[count:].reshape(-1, self.weights.shape[1], len(roughness))
        if many:
            first = len(vectors) - 1
            shares = self.source.dielectric_weights(ior).astype(np.float32)
            combined = sum(share * vector for share, vector in zip(shares, weights[first:], strict=True))
            weights = np.concatenate([weights[:first], combined[None]])
        return warp, weights, values[3] if count == 4 else None

    def integrals(
        self, corners, weights, scratch, smallest=SMALLEST_SAFE
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Signed integrals (F, P) of lobes with weights (F, K, P) over polygons (>= 3 rows, V, P); numbers (P,) with
        the sign of the solid angle; signed integrals (P,) of a clamped cosine of mass 1 under the same warp; and the
        mask (P,) of points that need float64."""
        if self.source.family == "ltsh":
            return weighted_moments(corners, weights, self.degree, scratch, smallest, self.source.bend)
        # The clamped cosine is not negative, so its integral has the sign of the solid angle.
        integral, needs_float64 = cosine_integral(corners, scratch, smallest)
        integral *= np.float32(1.0 / np.pi)
        return weights[:, 0] * integral, integral, integral, needs_float64


def prepare(table: LookupTable) -> RidgeTable:
    """The table with weights for the `moments` of this module, made once per table. Raises ValueError for a degree
    above MAX_DEGREE."""

    def matrix():
        forms = form_matrix(table.degree, 0 if table.bend is None else 2)
        return _product_in_order(table.ridge_weights, forms)

    return _kept(table, "_ridge_table", matrix)


def along_directions(table: LookupTable) -> RidgeTable:
    """As `prepare`, with weights for `edge_integrals.moments`, which shaders use."""
    return _kept(table, "_direction_table", lambda: table.ridge_weights)


def _kept(table, name, matrix):
    """The RidgeTable stored under `name`, made on first use; matrix() (K, K) turns coefficients into weights."""
    if table.degree > MAX_DEGREE:
        raise ValueError(
            f"table {table.name} has degree {table.degree}, the single precision path goes up to "
            f"{MAX_DEGREE}: use float64"
        )
    # Stored with the table (frozen except for what it caches), so that both are freed together.
    ridges = table.__dict__.get(name)
    if ridges is None:
        ridges = table.__dict__[name] = _build(table, matrix)
    return ridges


def _build(table, matrix):
    rows, columns, curves, count = table.coefficients.shape
    flat = table.coefficients.reshape(rows * columns, curves, count)
    if table.family == "ltsh":
        flat = _product_in_order(flat, matrix())
    return RidgeTable(table, table.warp.reshape(rows * columns, -1).T, flat.transpose(1, 2, 0))


def _product_in_order(vectors, matrix):
    """Vectors (..., K) times a matrix (K, K). Unlike numpy's product, it gives the same bits on every machine."""
    return sum(vectors[..., k, None] * row for k, row in enumerate(matrix))


def _bilinear(channels, shape, roughness, coordinate, scratch):
    """Channels (C, P) at roughness and theta coordinate (P,), both in [0, 1]."""
    rows, columns = shape
    row_position = roughness * np.float32(rows - 1)
    column_position = coordinate * np.float32(columns - 1)
    row = np.minimum(row_position.astype(np.intp), rows - 2)
    column = np.minimum(column_position.astype(np.intp), columns - 2)
    row_weight = (row_position - row).astype(np.float32)
    column_weight = (column_position - column).astype(np.float32)
    corner = row * columns + column
    size = (len(channels), len(roughness))
    taps = [scratch(f"tap{number}", size) for number in range(4)]
    for tap, step in zip(taps, (0, 1, columns, columns + 1), strict=True):
        np.take(channels, corner + step, axis=1, out=tap, mode="clip")
    for near, far, weight in ((taps[0], taps[1], column_weight), (taps[2], taps[3], column_weight),
                              (taps[0], taps[2], row_weight)):  # fmt: skip
        far -= near
        far *= weight
        near += far
    return taps[0]
