"""The edge loop of the hot path: integrals of degree 1 to 4 over spherical polygons, in preallocated float32 arrays.

The moments of `edge_integrals`, as coefficients of forms, from the cosines of the edges instead of the sums of their
ends, and without any branch. Points where that is not accurate in single precision are reported: the caller computes
them again in double precision.
"""

from __future__ import annotations

from math import prod

import numpy as np

from .arc_polynomials import ArcFactors, phi_of
from .edge_integrals import RIDGE_DIRECTIONS
from .spherical_harmonics import coefficient_count

MAX_DEGREE = 4
# Where single precision fails, points are reported as fragile. An edge short of a half circle, here by 8 degrees, has
# no direction: least 1 + cos(theta). The edges of a tiny polygon cancel: least sum of their angles, if all are equal.
# Corners are as exact as the farthest of them: least distance of a corner, as a share of that.
SHORTEST_SAFE = 0.01
SMALLEST_SAFE = 0.08
NEAREST_SAFE = 0.01
# Solid angles close to 2 pi are close to the branch cut of the arc tangent.
LARGEST_SAFE_ANGLE = 5.9
# Beyond these the angle of one edge is below what single precision tells from 0, and products leave its range.
MANY_CORNERS = 64
# Corners of the polygons whose moments are computed at a time: their arrays stay in a second-level cache of 1 MiB.
PIECE_CORNERS = 24624
VIEWS_KEPT = 1000
_TINY = np.float32(1e-30)


class Scratch:
    """Float32 arrays by name that are made once and reused: `scratch("name", shape)`."""

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
            # A larger array replaces this one: views of it would keep it alive.
            self._views = {key: view for key, view in self._views.items() if key[0] != name}
            array = self._arrays[name] = np.empty(size, dtype=np.float32)
        elif len(self._views) > VIEWS_KEPT:
            self._views.clear()
        view = self._views[name, shape] = array[:size].reshape(shape)
        return view


def project(corners: np.ndarray, scratch: Scratch) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3, V + 1, P) along the corners (>= 3 rows, V, P), the first corner once more at the end, and the
    mask (P,) of polygons with a corner that is fragile because it is near."""
    _, count, points = corners.shape
    unit = scratch("unit", (3, count + 1, points))
    length = scratch("two", (count, points))
    squares = np.multiply(corners[:3], corners[:3], out=scratch("three", (3, count, points)))
    np.add.reduce(squares, axis=0, out=length)
    near = np.maximum.reduce(length, axis=0)
    near *= np.float32(NEAREST_SAFE**2)
    fragile = np.minimum.reduce(length, axis=0) < near
    # A corner at the point itself becomes the zero vector.
    length += _TINY
    np.divide(np.float32(1.0), np.sqrt(length, out=length), out=length)
    np.multiply(corners[:3], length, out=unit[:, :-1])
    unit[:, -1] = unit[:, 0]
    return unit, fragile


def shifted_cosines(unit: np.ndarray, scratch: Scratch, smallest: float) -> tuple[np.ndarray, np.ndarray]:
    """1 + cos(theta) (V, P) of the edges, kept positive, and the mask (P,) of fragile polygons, among them those whose
    edges are shorter than `smallest` in all."""
    _, count, points = unit.shape
    products = np.multiply(unit[:, :-1], unit[:, 1:], out=scratch("three", (3, count - 1, points)))
    shifted = np.add.reduce(products, axis=0, out=scratch("shifted", (count - 1, points)))
    shifted += np.float32(1.0)
    least = np.minimum.reduce(shifted, axis=0)
    np.absolute(shifted, out=shifted)
    shifted += np.float32(1e-12)
    fragile = least < np.float32(SHORTEST_SAFE)
    if smallest > 0.0:
        fragile |= least > np.float32(2.0 - 0.5 * (smallest / min(count - 1, MANY_CORNERS)) ** 2)
    return shifted, fragile


def _cross_component(unit, first, second, scratch, out):
    """Component (V, P) of the cross products of the ends of the edges: a[first] b[second] - a[second] b[first]."""
    np.multiply(unit[first, :-1], unit[second, 1:], out=out)
    out -= np.multiply(unit[second, :-1], unit[first, 1:], out=scratch("one", out.shape))
    return out


def cosine_integral(
    corners: np.ndarray, scratch: Scratch, smallest: float = SMALLEST_SAFE
) -> tuple[np.ndarray, np.ndarray]:
    """Signed integral (P,) of z over polygons (>= 3 rows, V, P) in z >= 0, and the mask (P,) of fragile points."""
    unit, near = project(corners, scratch)
    shifted, fragile = shifted_cosines(unit, scratch, smallest)
    fragile |= near
    normal = _cross_component(unit, 0, 1, scratch, scratch("normal", shifted.shape))
    normal *= phi_of(shifted, scratch)
    integral = np.add.reduce(normal, axis=0)
    integral *= np.float32(0.5)
    return integral, fragile


def vector_irradiance(
    corners: np.ndarray, scratch: Scratch, smallest: float = SMALLEST_SAFE
) -> tuple[np.ndarray, np.ndarray]:
    """Signed integrals (3, P) of the direction over polygons (>= 3 rows, V, P), and the mask (P,) of fragile points."""
    unit, near = project(corners, scratch)
    shifted, fragile = shifted_cosines(unit, scratch, smallest)
    fragile |= near
    phi = phi_of(shifted, scratch)
    integrals = np.empty((3, corners.shape[2]), dtype=np.float32)
    for axis in range(3):
        out = scratch("normal", shifted.shape)
        normal = _cross_component(unit, (axis + 1) % 3, (axis + 2) % 3, scratch, out)
        normal *= phi
        np.add.reduce(normal, axis=0, out=integrals[axis])
    integrals *= np.float32(0.5)
    return integrals, fragile


def form_matrix(degree: int) -> np.ndarray:
    """Matrix (K, K) from the `moments` here to those of `edge_integrals.moments`.

    The sum of (u.X) K_k over the edges is a form in u, homogeneous of degree k + 1. Here are the coefficients of
    u_x^(k+1), u_x^k u_z, ..., u_z^(k+1), there the values for the first k + 2 directions.
    """
    matrix = np.zeros((coefficient_count(degree),) * 2)
    matrix[0, 0] = 1.0
    for k in range(degree):
        rows = slice(1 + k * (k + 3) // 2, 1 + (k + 1) * (k + 4) // 2)
        power = np.arange(k + 2)
        matrix[rows, rows] = [u_x ** power[::-1] * u_z**power for u_x, u_z in RIDGE_DIRECTIONS[: k + 2]]
    return matrix


def moments(
    corners: np.ndarray, degree: int, scratch: Scratch, smallest: float = SMALLEST_SAFE
) -> tuple[np.ndarray, np.ndarray]:
    """Moments (K, P) of polygons (>= 3 rows, V, P) in z >= 0 that need not be unit, in the order of `form_matrix`, and
    the mask (P,) of fragile points. `degree` 1 to 4. The result is overwritten by the next call."""
    unit, near = project(corners, scratch)
    shifted, fragile = shifted_cosines(unit, scratch, smallest)
    fragile |= near
    shape = shifted.shape
    result = scratch("moments", (coefficient_count(degree), shape[1]))
    normal = scratch("normal", (2, *shape))
    for row, (first, second) in zip(normal, ((1, 2), (0, 1)), strict=True):
        _cross_component(unit, first, second, scratch, row)
    total = np.add(unit[::2, :-1], unit[::2, 1:], out=scratch("total", normal.shape))
    result[0] = angle = _solid_angle(shifted, total[1], normal[1], scratch)
    fragile |= np.abs(angle) > np.float32(LARGEST_SAFE_ANGLE)
    factors = ArcFactors(degree, shifted, scratch)
    pair = scratch("pair", normal.shape)
    _sum_edges(np.multiply(normal, factors.phi, out=pair), result[1:3])
    if degree == 1:
        return result, fragile
    np.multiply(normal, factors.q, out=pair)
    linear = _product(pair, total, scratch("linear", (3, *shape)), scratch)
    _sum_edges(linear, result[3:6])
    if degree == 2:
        return result, fragile
    product = _product(unit[::2, :-1], unit[::2, 1:], scratch("product", linear.shape), scratch)
    squared = _product(total, total, scratch("squared", linear.shape), scratch)
    if degree == 4:
        _sum_edges(_quartic(linear, product, squared, factors.cube, pair, scratch), result[10:15])
    squared *= factors.square
    product *= factors.psi
    squared -= product
    cubic = scratch("cubic", (4, *shape))
    np.multiply(normal, squared[::2], out=cubic[::3])
    np.multiply(normal, squared[1], out=cubic[1:3])
    cubic[1:3] += np.multiply(normal[::-1], squared[::2], out=pair)
    _sum_edges(cubic, result[6:10])
    return result, fragile


def _product(a, b, out, scratch):
    """Coefficients (3, V, P) of the product of linear forms a and b (2, V, P): x x, x z + z x, z z."""
    np.multiply(a, b, out=out[::2])
    np.multiply(a[0], b[1], out=out[1])
    out[1] += np.multiply(a[1], b[0], out=scratch("one", out.shape[1:]))
    return out


def _quartic(linear, product, squared, cube, pair, scratch):
    """Coefficients (5, V, P) of (u.X) K_3 for a quadratic form `linear` (3, V, P), q (u.X) (u.c) with c = a + b, and
    those of (u.a) (u.b) and (u.c)^2; `pair` (2, V, P) is overwritten."""
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


def weighted_moments(
    corners: np.ndarray, weights: np.ndarray, degree: int, scratch: Scratch, smallest: float = SMALLEST_SAFE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums (F, P) of the `moments` of polygons (>= 3 rows, V, P) times weights (F, K, P), the signed solid angles (P,)
    in sr, and the mask (P,) of fragile points. `degree` 1 to 4."""
    vectors, _, points = weights.shape
    sums = np.empty((vectors, points), np.float32)
    angle, fragile = np.empty(points, np.float32), np.empty(points, bool)
    for part in pieces(points, PIECE_CORNERS // corners.shape[1]):
        found, fragile[part] = moments(corners[:, :, part], degree, scratch, smallest)
        weight = weights[:, :, part]
        products = np.multiply(weight, found, out=scratch("weighted", weight.shape))
        np.add.reduce(products, axis=1, out=sums[:, part])
        angle[part] = found[0]
    return sums, angle, fragile


def pieces(count: int, most: int) -> list[slice]:
    """Slices of about equal length, at most `most` (or 512, where that is less), that make up `count` elements."""
    number = max(-(-count // max(most, 512)), 1)
    size = max(-(-count // number), 1)
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


def _sum_edges(values, out):
    """Sum (D, P) over the edges of values (D, V, P)."""
    np.add.reduce(values, axis=1, out=out)


def _normalize(real, imaginary, scratch):
    """Divide complex numbers (V, P) by about their magnitude: only their arguments matter."""
    size = np.abs(real, out=scratch("one", real.shape))
    size += np.abs(imaginary)
    size += _TINY
    real /= size
    imaginary /= size


def _solid_angle(shifted, total_z, normal_z, scratch):
    """Signed solid angle (P,): the product over the edges of (1 + a_z + b_z + a.b) + i X_z has half of it."""
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
