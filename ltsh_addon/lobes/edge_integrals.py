"""Integrals of low-degree polynomials over spherical polygons, in closed form, as sums over edges.

On the sphere, a spherical harmonics expansion that is even in y is a polynomial in x and z, and therefore a sum of
ridge functions (u . w)^n with u = (u_x, 0, u_z). With X = a x b for an edge from a to b, Stokes' theorem gives

    int (u.w)^n dw = (n - 1)/(n + 1) |u|^2 int (u.w)^(n-2) dw + 1/(n + 1) sum_edges (u.X) K_{n-1},
    K_k = 1/sin(theta) int_edge (u.w)^k ds.

So the moments of a polygon determine its integrals: the solid angle, and sum_edges (u.X) K_k for k + 2 directions u per
k. (These are the same integrals as in Wang and Ramamoorthi 2018 and Belcour et al. 2018, without zonal rotations.)

Cycles shadows bump-mapped diffuse lobes. With the smooth normal s, z = s.omega and alpha^2 = `bump_alpha2`, the factor
is (Estevez, Lecocq and Stein 2019, doi:10.1007/978-1-4842-4427-2_12)

    g(z) = 2 / (1 + sqrt(1 + alpha^2 (1 - z^2) / z^2)).

By Stokes' theorem, the integral of (n.omega) g(z) over a polygon is the sum, over its edges, of the means of

    (n.X) Q(z) + (n.s) (s.X) D(z),   Q(z) = (integral of t g(t) from 0 to z) / z^2,   D(z) = (Q(1) - Q(z)) / (1 - z^2).

X is the edge's normal, as long as its arc. Without shadowing Q = 1 / 2 and D = 0, which is Lambert's formula. Here
Q(z) = z / (a + b z + c r), where r^2 = k + (1 - k) z^2. This makes D as simple, and stands for a g at most 0.4 %
off. The result is divided by its error in the mean direction, so that small polygons get g itself. Q and D have no
poles, so few nodes do an arc. They lie closer toward its lower end, where g is steep.
"""

from functools import cache
from math import comb

import numpy as np

from . import spherical_harmonics
from .polygon import edge_sums, one_plus_cosine, solid_angle

RIDGE_DIRECTIONS = np.array([[1, 0], [0, 1], [1, 1], [1, -1], [1, 2], [2, 1], [1, -2], [2, -1], [1, 3]], dtype=float)
MAX_DEGREE = len(RIDGE_DIRECTIONS) - 1
# Accurate to 6e-15 on half a circle for powers up to 7.
_ARC_QUADRATURE = np.polynomial.legendre.leggauss(18)
# For bump shadowing: Gauss-Legendre nodes u in [0, 1], moved to (u + u^2) / 2, their places between the ends of an arc,
# and weights.
_NODES, _WEIGHTS = ((0.5 * values).tolist() for values in np.polynomial.legendre.leggauss(5))
BUMP_NODES = [((u + 0.5) * (u + 1.5) / 2.0, w * (1.0 + u)) for u, w in zip(_NODES, _WEIGHTS, strict=True)]
# Quartics in alpha, constant first, fitted to g for alpha^2 <= 4: k / alpha^2, a / alpha, (b + c - 2) / alpha, and c.
TERM_POLYNOMIALS = (
    (2.1783, -3.2715, 3.6047, -1.7641, 0.2940),
    (0.3047, 0.9373, -0.8150, 0.3676, -0.0900),
    (-0.1847, 0.3115, -0.4986, 0.2880, -0.0324),
    (0.8052, -0.0050, 0.0225, -0.1359, 0.0963),
)


# Degrees of the polynomial for psi that suffice in single and in double precision.
SINGLE_PSI_DEGREE, _DOUBLE_PSI_DEGREE = 9, 22


@cache
def arc_polynomial(factor: str, degree: int, longest: float = 1.0) -> np.ndarray:
    """Coefficients (degree + 1,), highest power first, of v phi or v psi of an edge as a polynomial in
    v = `longest` cos(theta / 2).

    `factor` is "phi" or "psi", as in `arc_factors`. The polynomial interpolates at Chebyshev points.
    """

    def values(v):
        # phi = 2F1(1, 1; 3/2; w), w = sin^2(theta/2); psi = (phi - 1) / (2 w), as a series where w is small
        kappa = v / longest
        w = (1.0 - kappa) * (1.0 + kappa)
        closed = (np.arccos(kappa) / (kappa * np.sqrt(w)) - 1.0) / (2.0 * w)
        term, series = np.full_like(w, 1.0 / 3.0), np.zeros_like(w)
        for n in range(1, 60):
            series += term
            term = term * w * (n + 1.0) / (n + 1.5)
        psi = np.where(w < 0.3, series, closed)
        return v * (psi if factor == "psi" else 1.0 + 2.0 * w * psi)

    chebyshev = np.polynomial.chebyshev.Chebyshev.interpolate(values, degree, domain=[0.0, longest])
    return chebyshev.convert(kind=np.polynomial.Polynomial).coef[::-1].copy()


def arc_factors(one_plus_cosine: np.ndarray):
    """(phi, psi, q) of edges of length theta: theta / sin(theta), (phi - 1) / (1 - cos theta), 1 / (1 + cos theta).

    The relative error is below 1e-6 (float32; phi 4e-7) and 4e-14 (float64). Results are finite at theta = 0. theta is
    kept off pi, where the edge has no direction.
    """
    dtype = one_plus_cosine.dtype
    shifted = np.maximum(one_plus_cosine, np.finfo(dtype).eps ** 2)
    kappa = np.sqrt(np.minimum(0.5 * shifted, 1.0))
    coefficients = arc_polynomial("psi", SINGLE_PSI_DEGREE if dtype == np.float32 else _DOUBLE_PSI_DEGREE)
    coefficients = coefficients.astype(dtype)
    psi = np.full_like(kappa, coefficients[0])
    for coefficient in coefficients[1:]:
        psi = psi * kappa + coefficient
    psi = psi / kappa
    return 1.0 + np.maximum(2.0 - shifted, 0.0) * psi, psi, 1.0 / shifted


def clamped_cosine_integral(unit: np.ndarray) -> np.ndarray:
    """Signed integral (P,) of max(0, z) over spherical polygons (3, V, P) in z >= 0 (Lambert 1760; sign as there)."""
    total = edge_sums(unit)
    phi, _, _ = arc_factors(one_plus_cosine(total))
    return 0.5 * ((unit[0] * total[1] - unit[1] * total[0]) * phi).sum(axis=0)


def vector_irradiance(unit: np.ndarray) -> np.ndarray:
    """Signed integral (3, P) of the direction over spherical polygons (3, V, P) (Lambert 1760; sign as solid angle)."""
    total = edge_sums(unit)
    phi, _, _ = arc_factors(one_plus_cosine(total))
    return 0.5 * (np.cross(unit, total, axis=0) * phi).sum(axis=1)


def moments(unit: np.ndarray, degree: int) -> np.ndarray:
    """Moments (K, P) of spherical polygons (3, V, P) in z >= 0; K = (degree + 1)(degree + 2) / 2.

    Order: the solid angle; then, for k = 0 .. degree - 1, the sums of (u.X) K_k over the first k + 2
    `RIDGE_DIRECTIONS`.
    """
    total = edge_sums(unit)
    phi, psi, q = arc_factors(one_plus_cosine(total))
    normal_x = unit[1] * total[2] - unit[2] * total[1]
    normal_z = unit[0] * total[1] - unit[1] * total[0]
    result = np.empty((spherical_harmonics.coefficient_count(degree), unit.shape[2]), dtype=unit.dtype)
    result[0] = solid_angle(unit)
    nodes = _ArcNodes(q) if degree > 4 else None
    for j, (u_x, u_z) in enumerate(RIDGE_DIRECTIONS[: degree + 1]):
        start, both = u_x * unit[0] + u_z * unit[2], u_x * total[0] + u_z * total[2]
        normal = u_x * normal_x + u_z * normal_z
        for k in range(max(j - 1, 0), min(degree, 4)):
            row = 1 + k * (k + 3) // 2 + j
            result[row] = (normal * _arc_power(k, start, both, phi, psi, q)).sum(axis=0)
        first = max(j - 1, 4)
        if first < degree:
            powers = nodes.powers(start, both, first, degree)
            normal *= phi
            for k, power in enumerate(powers, first):
                result[1 + k * (k + 3) // 2 + j] = (normal * power).sum(axis=0)
    return result


def _arc_power(k, start, total, phi, psi, q):
    """K_k of edges on which u.w runs from `start` to `total - start`."""
    if k == 0:
        return phi
    if k == 1:
        return q * total
    product = start * (total - start)
    if k == 2:
        return 0.5 * q * (1.0 + psi) * total * total - psi * product
    return q * total * ((q + 1.0) / 3.0 * total * total - product)


class _ArcNodes:
    """Gauss-Legendre nodes along edges. u.w is a sinusoid there, so that K_k / phi, a mean, is exact to rounding."""

    def __init__(self, q):
        half = np.arctan2(np.sqrt(np.maximum(1.0 - 0.5 / q, 0.0)), np.sqrt(0.5 / q))
        sine = np.sin(half)
        per_cosine = 1.0 / np.cos(half)
        per_sine = np.where(sine > 0.0, 1.0 / np.where(sine > 0.0, sine, 1.0), 0.0)
        nodes, self.weights = _ARC_QUADRATURE
        # The nodes come in pairs of opposite sign.
        angles = [half * node for node in nodes[: len(nodes) // 2]]
        self.cosines = [np.cos(angle) * per_cosine for angle in angles]
        self.sines = [np.sin(angle) * per_sine for angle in angles]

    def powers(self, start, total, first, last):
        """Means (V, P) of (u.w)^k along the edges for k = first .. last - 1. u.w runs from `start` to
        `total - start`."""
        middle, half_difference = 0.5 * total, 0.5 * total - start
        result = [np.zeros_like(middle) for _ in range(first, last)]
        for cosine, sine, weight in zip(self.cosines, self.sines, self.weights, strict=False):
            across, along = half_difference * sine, middle * cosine
            for value in (along + across, along - across):
                squared = value * value
                power = squared * squared * (0.5 * weight)
                for _ in range(4, first):
                    power *= value
                for k in range(len(result)):
                    result[k] += power
                    if k + 1 < len(result):
                        power *= value
        return result


@cache
def ridge_matrix(degree: int) -> np.ndarray:
    """Matrix (K, K): spherical harmonics coefficients (.., K) @ ridge_matrix = weights of `moments`.

    Raises ValueError above degree `MAX_DEGREE`.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics degree is {degree}, expected 0 to {MAX_DEGREE}")
    count = spherical_harmonics.coefficient_count(degree)
    # Expand the basis in powers of ridges, by interpolation at generic points of the sphere.
    generator = np.random.default_rng(1)
    directions = generator.normal(size=(4 * count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ridges = directions[:, [0, 2]] @ RIDGE_DIRECTIONS.T
    columns = [np.ones(len(directions))] + [ridges[:, j] ** n for n in range(1, degree + 1) for j in range(n + 1)]
    basis = spherical_harmonics.evaluate(degree, directions)
    powers = np.linalg.lstsq(np.stack(columns, axis=1), basis.T, rcond=None)[0].T
    return powers @ _power_integrals(degree)


def _power_integrals(degree: int) -> np.ndarray:
    """Matrix (K, K): integral of each ridge power (1, then (n, j) in order) as a combination of the moments."""
    count = spherical_harmonics.coefficient_count(degree)
    matrix = np.zeros((count, count))
    matrix[0, 0] = 1.0
    for n in range(1, degree + 1):
        for j in range(n + 1):
            row = n * (n + 1) // 2 + j
            u = RIDGE_DIRECTIONS[j]
            factor, k = 1.0, n
            # Unroll the recursion of the module's docstring down to the solid angle (even n) or K_0 (odd n).
            while k > 0:
                matrix[row, 1 + (k - 1) * (k + 2) // 2 :][: k + 1] += factor / (k + 1) * _in_moment_directions(u, k)
                factor *= (k - 1) / (k + 1) * (u @ u)
                k -= 2
            if k == 0:
                matrix[row, 0] += factor
    return matrix


def _in_moment_directions(u: np.ndarray, k: int) -> np.ndarray:
    """Weights (k + 1,) of the first k + 1 moments with K_{k-1} that give the moment along `u`, a form of degree k in
    u."""
    exponents = np.arange(k + 1)
    binomials = np.array([comb(k, int(e)) for e in exponents], dtype=float)

    def monomials(direction):
        return binomials * direction[0] ** exponents * direction[1] ** (k - exponents)

    system = np.stack([monomials(direction) for direction in RIDGE_DIRECTIONS[: k + 1]], axis=1)
    return np.linalg.solve(system, monomials(u))


def bump_shadowing(along, squares, bump_alpha2):
    """Bump shadowing (...) at heights (...) over the plane of the smooth normal and squared distances (...)."""
    along = np.maximum(along, np.float32(1e-15) * np.sqrt(squares) + np.float32(1e-18))
    tangent2 = np.maximum(squares / (along * along) - np.float32(1.0), np.float32(0.0))
    shadowing = np.sqrt(np.float32(1.0) + bump_alpha2.astype(np.float32) * tangent2)
    return np.float32(2.0) / (np.float32(1.0) + shadowing)


def shadowing_terms(bump_alpha2: np.ndarray) -> np.ndarray:
    """alpha^2, k, a, b and c (5, P) of the formulas above, for alpha^2 (P,) in [0, 4]."""
    alpha = np.sqrt(bump_alpha2)
    k, a, both, c = (np.polynomial.polynomial.polyval(alpha, terms) for terms in TERM_POLYNOMIALS)
    return np.stack([bump_alpha2, k * bump_alpha2, a * alpha, 2.0 + both * alpha - c, c]).astype(bump_alpha2.dtype)


def shadowed_integral(toward, heights, shifted, mean, terms):
    """Signed integrals (P,) of cosine times shadowing over polygons above both horizons.

    `toward` (2, V, P) are products of the edges' normals, whose lengths are the angles theta of the edges, with n and
    with (n.s) s; `heights` (2, V, P) those of the edges' ends with s; `shifted` (V, P) is 1 + cos theta, and
    `mean` (P,) the cosine between s and the mean direction. `terms` (5, P) are `shadowing_terms`.
    """
    alpha2, k, a, b, c = terms
    half = np.sqrt(0.5 * shifted)
    # Close ends have a straight line between them, at any small angle.
    np.minimum(half, 1.0 - 1e-6, out=half)
    middle = heights[0] + heights[1]
    middle /= 2.0 * half
    np.arccos(half, out=half)
    rise = np.abs(heights[1] - heights[0])
    rise /= 2.0 * np.sin(half)
    ck, rest = c * k, 1.0 - k
    plain = mixed = 0.0
    for place, weight in BUMP_NODES:
        angle = half * (2.0 * place - 1.0)
        z = np.cos(angle)
        z *= middle
        z += np.sin(angle, out=angle) * rise
        np.maximum(z, 1e-6, out=z)
        root = np.sqrt(rest * z * z + k)
        share = weight / (a + b * z + c * root)
        plain = plain + share * z
        root += z
        z += 1.0
        mixed = mixed + share * (ck / root + a / z)
    integral = (toward[0] * plain + toward[1] * mixed / (a + b + c)).sum(axis=0)
    z = np.maximum(mean, 1e-6)
    squared = z * z
    root = np.sqrt(rest * squared + k)
    share = a + b * z + c * root
    slope = 3.0 * share - z * (b + c * rest * z / root)
    return integral * (2.0 * share * share / ((z + np.sqrt(alpha2 + (1.0 - alpha2) * squared)) * slope))
