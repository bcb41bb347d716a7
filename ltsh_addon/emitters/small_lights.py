"""Lights so small, as a sample sees them, that their center stands for the whole light: no integral over a polygon.

The integral is the lobe at the center times the solid angle. The error is second order in the light's radius, in units
of the length over which the integrand changes. That length is the distance; for specular lobes it is their width, or
the angle from their peak if that is larger. For a cosine or the peak of GGX, the error is 2/3 LARGEST^2 = 0.2 % of the
light. Such a light has at most 2 LARGEST^2 sr, so the error is 3e-6 per unit of radiance.
The dots in shapes (...) stand for lights, samples or both; arrays broadcast over them.
"""

from dataclasses import dataclass

import numpy as np

from ..lobes.edge_integrals import bump_shadowing
from ..lobes.lobe_integrals import LEAST_SHARE
from ..lobes.lookup_table import bent_cosines
from ..lobes.polygon import cross, dot
from ..lobes.spherical_harmonics import degree_of
from .light_polygons import LEAST_COSINE, LOBE_WIDTH
from .tails import NEAR_RADII

# Angle in rad from the peak of a sharp lobe beyond which single precision finds its tail to 2e-4.
SHARP_TAIL = 0.05
# Greatest radius of a small light in units of the length over which the integrand changes.
LARGEST = 0.05
# Relative change of GGX toward the rim of such a light, divided by that size.
VARIATION = 4.0


@dataclass(frozen=True)
class SmallLight:
    """The quantities of a light that matter if it is small."""

    center: np.ndarray  # (3,) m: the centroid
    radius: float  # m, around the centroid
    area_vector: np.ndarray  # (3,) m^2, toward where it shines
    diagonal: float  # m^2: square of the longer half diagonal of the parallelogram around it

    @classmethod
    def of(cls, light) -> "SmallLight":
        """For a `Light`."""
        (center,), (area,), _, (diagonal,), (radius,) = moments_of([light])
        return cls(center, float(radius), area, float(diagonal))


def moments_of(lights) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Centers (L, 3), area vectors (L, 3), covariances (L, 3, 3) of the points in m^2, diagonals (L,) and radii (L,) of
    lights, as in `SmallLight`."""
    center, u, v, direction = (
        np.array([getattr(light, name) for light in lights]) for name in ("center", "half_u", "half_v", "direction")
    )
    area, is_round = np.array([light.area_vector for light in lights]), np.array([light.is_round for light in lights])
    diagonal = np.maximum(np.square(u + v).sum(axis=1), np.square(u - v).sum(axis=1))
    radius = np.sqrt(np.where(is_round, np.maximum(np.square(u).sum(axis=1), np.square(v).sum(axis=1)), diagonal))
    covariance = u[:, :, None] * u[:, None] + v[:, :, None] * v[:, None]
    covariance /= np.where(is_round, 4.0, 3.0)[:, None, None]
    counts = np.array([0 if light.corners is None else len(light.corners) for light in lights])
    for count in np.unique(counts[counts > 0]):
        same = np.flatnonzero(counts == count)
        corners = np.array([lights[number].corners for number in same])
        center[same], covariance[same] = _moments(corners, area[same])
        radius[same] = np.sqrt(np.square(corners - center[same, None]).sum(axis=2).max(axis=1))
    return center, area * np.copysign(1.0, (area * direction).sum(axis=1))[:, None], covariance, diagonal, radius


def _moments(corners, area):
    """Centroids (L, 3) and covariances (L, 3, 3) of polygons with corners (L, V, 3) and area vectors (L, 3)."""
    # A fan of triangles. The mean of products over a triangle is a twelfth of the products at its corners and their
    # sum.
    first = corners - corners[:, :1]
    second = np.roll(first, -1, axis=1)
    x, y, z = np.moveaxis(first, -1, 0)
    a, b, c = np.moveaxis(second, -1, 0)
    crossed = np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)
    shares = (crossed * (0.5 * area)[:, None]).sum(axis=-1) / (area * area).sum(axis=1)[:, None]
    center = (shares[..., None] * (first + second)).sum(axis=1) / 3.0
    products = (
        sum(np.einsum("lv,lvi,lvj->lij", shares, vectors, vectors) for vectors in (first, second, first + second))
        / 12.0
    )
    return corners[:, 0] + center, products - center[:, :, None] * center[:, None]


@dataclass(frozen=True)
class RaysToCenters:
    """Rays (...) from samples to the centers of small lights."""

    offset: np.ndarray  # (3, ...) m
    squares: np.ndarray  # (...) m^2, squared lengths
    distance: np.ndarray  # (...) m
    flux: np.ndarray  # (...) m^3: distance times projected area; divided by the cubed distance it is the solid angle
    diagonal: np.ndarray | float  # (...) m^2, see `SmallLight`
    slack: np.ndarray | None = None  # (...): relative change of a specular lobe over the light

    @classmethod
    def along(cls, offset, area_vector, diagonal) -> "RaysToCenters":
        """Rays to lights with `area_vector` (3, ...) whose centers are at `offset` from the samples."""
        squares = dot(offset, offset)
        flux = np.maximum(-dot(area_vector, offset), np.float32(0.0))
        return cls(offset, squares, np.sqrt(squares), flux, diagonal)

    def heights(self, vectors) -> np.ndarray:
        """Dot products (...) of the offsets with vectors (3, Q)."""
        return dot(vectors, self.offset)

    def take(self, index) -> "RaysToCenters":
        """The rays `index` (Q,) of the last axis."""
        chosen = (values[..., index] for values in (self.offset, self.squares, self.distance, self.flux))
        diagonal = self.diagonal[index] if np.ndim(self.diagonal) else self.diagonal
        return RaysToCenters(*chosen, diagonal, None if self.slack is None else self.slack[index])


class SharpestLobes:
    """The narrowest parts of the specular lobes of samples (...)."""

    def __init__(self, normal, view, width):
        cosine = dot(normal, view)
        self.mirrored = np.float32(2.0) * cosine * normal - view
        self.width = (LOBE_WIDTH * width * np.maximum(np.abs(cosine), LEAST_COSINE)).astype(np.float32)

    def are_tails(self, light, position) -> np.ndarray:
        """Mask (Q,) of the lobes at `position` (3, Q) of which a light meets only the tail, where limits hold."""
        offset = (light.center[:, None] - light.viewpoint(position)).astype(np.float32)
        distance = np.maximum(np.sqrt(dot(offset, offset)), np.float32(1e-30))
        reach = np.arcsin(np.minimum(np.float32(NEAR_RADII * SmallLight.of(light).radius) / distance, np.float32(1.0)))
        away = np.arccos(np.clip(dot(self.mirrored, offset) / distance, -1.0, 1.0))
        return away > reach + np.float32(SHARP_TAIL)

    def lengths(self, columns, rays: RaysToCenters, size) -> np.ndarray:
        """The least angle (...) in rad, at most 1, over which the lobes `columns` change within lights of a radius of
        `size` rad."""
        toward = dot(self.mirrored[:, columns], rays.offset)
        toward /= rays.distance
        chord = np.sqrt(np.maximum(np.float32(2.0) - np.float32(2.0) * toward, np.float32(0.0)))
        chord -= size
        return np.minimum(np.maximum(chord, np.float32(0.0)) + self.width[columns], np.float32(1.0))


def relative_sizes(lobes, columns, rays: RaysToCenters, radius) -> np.ndarray:
    """Radii (...) of lights of `radius` m, in units of the length over which the lobes `columns` change."""
    with np.errstate(divide="ignore"):  # a sample may lie in the center of a face that shines
        size = np.float32(radius) / rays.distance
    return size if lobes.sharpest is None else size / lobes.sharpest.lengths(columns, rays, size)


def small_and_lit(lobes, columns, rays: RaysToCenters, radius, size) -> tuple[np.ndarray, np.ndarray]:
    """Masks (...) of the lights that are small, given `size` from `relative_sizes`, and of those that also light the
    samples.

    Lights that cross a horizon are not small.
    """
    small = size < np.float32(LARGEST)
    lit = rays.flux > 0.0
    for row, length in lobes.lengths.items():
        height = dot(lobes.rows[row][:, columns], rays.offset)
        small &= np.abs(height) > np.float32(radius) * length[columns]
        lit &= height > 0.0
    return small, lit & small


class CosineAtPoint:
    """Form factors (1, ...) of small lights under lobes with the axes `rows` (C, 3, ...)."""

    def __init__(self, rows):
        self.normal = rows[2]

    def __call__(self, columns, rays: RaysToCenters):
        values = rays.heights(self.normal[:, columns])
        np.maximum(values, np.float32(0.0), out=values)
        values *= rays.flux
        values *= np.float32(1.0 / np.pi)
        values /= rays.squares * rays.squares
        return values[None]

    def integral(self, columns, coordinates, weights):
        """Sums (1, Q) over points of the lobe divided by the cubed distance, times `weights` that broadcast to (S, T,
        Q). The points have `coordinates` (C, S, T, Q) along the rows of the lobes `columns` (Q,)."""
        return _sum(self.at(coordinates), weights)[None]

    @staticmethod
    def at(coordinates):
        """The lobe divided by the cubed distance (...) at `coordinates` (C, ...)."""
        x, y, z = coordinates[:3]
        squares = x * x
        squares += y * y
        squares += z * z
        squares *= squares
        values = np.maximum(z, np.float32(0.0))
        values *= np.float32(1.0 / np.pi)
        values /= squares
        return values


class ShadowedCosineAtPoint:
    """As `CosineAtPoint`, times the bump shadowing of `SurfaceSamples`."""

    def __init__(self, rows, bump_alpha2):
        self.plain, self.smooth, self.bump_alpha2 = CosineAtPoint(rows), rows[3], bump_alpha2

    def __call__(self, columns, rays: RaysToCenters):
        along = rays.heights(self.smooth[:, columns])
        return self.plain(columns, rays) * bump_shadowing(along, rays.squares, self.bump_alpha2[columns])

    def integral(self, columns, coordinates, weights):
        """As in `CosineAtPoint`. There is one more coordinate, along the smooth normal."""
        values = self.plain.at(coordinates)
        squares = dot(coordinates[:3], coordinates[:3])
        values *= bump_shadowing(coordinates[3], squares, self.bump_alpha2[columns])
        return _sum(values, weights)[None]


class LobeAtPoint:
    """Integrals (F, ...) of lobes over small lights, with weights (F, K, ...) of a `moments32.RidgeTable`."""

    def __init__(self, rows, weights, table, limits):
        self.rows, self.limits = rows, limits
        self.is_cosine, self.bend = table.family == "ltc", table.bend
        x, y, z = rows[:3]
        self.determinant = dot(x, cross(y, z))
        self.terms = weights if self.is_cosine else polynomial_terms(weights)

    def __call__(self, columns, rays: RaysToCenters):
        x, y, z = (rays.heights(row[:, columns]) for row in self.rows[:3])
        inverse = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
        angle = inverse * inverse * inverse
        angle *= self.determinant[columns] * rays.flux
        z *= inverse
        cosine = np.maximum(z, np.float32(0.0)) * angle
        cosine *= np.float32(1.0 / np.pi)
        if self.is_cosine:
            return np.stack([terms[columns] * cosine for terms in self.terms[:, 0]])
        x *= inverse
        leaning = None if self.bend is None else self._leaning(x, y * inverse, z)
        # For points of a light tree, the other integrals follow from the first.
        needed = self.terms[:1] if rays.slack is None else self.terms
        values = np.stack([self._value(terms[..., columns], x, z, leaning) for terms in needed])
        values *= angle
        np.maximum(values, np.float32(0.0), out=values)
        np.maximum(values[0], np.float32(LEAST_SHARE) * cosine, out=values[0])
        if rays.slack is None:
            return self.limits.true_in_tails(values[0], columns, rays, len(self.terms))
        self.limits.apply_at_centers(values, columns, rays)
        return values

    def integral(self, columns, coordinates, weights):
        """As in `CosineAtPoint`, but (F, Q), without limits."""
        x, y, z = coordinates[:3]
        inverse = x * x
        inverse += y * y
        inverse += z * z
        np.sqrt(inverse, out=inverse)
        np.divide(np.float32(1.0), inverse, out=inverse)
        x, z = x * inverse, z * inverse
        leaning = None if self.bend is None else self._leaning(x, y * inverse, z)
        angle = inverse * inverse
        angle *= inverse
        angle *= weights
        determinant = self.determinant[columns]
        cosine = _sum(z, angle) * (determinant * np.float32(1.0 / np.pi))
        if self.is_cosine:
            return self.terms[:, 0, columns] * cosine
        values = np.stack([_sum(self._value(terms[:, columns], x, z, leaning), angle) for terms in self.terms])
        values *= determinant
        np.maximum(values, np.float32(0.0), out=values)
        np.maximum(values[0], np.float32(LEAST_SHARE) * cosine, out=values[0])
        return values

    def _leaning(self, x, y, z):
        """The two functions (2, ...) of the bend, whose terms come last, in direction (x, y, z)."""
        return (2.0 * np.pi) * bent_cosines(self.bend, np.stack([x, y, z], axis=-1))

    @staticmethod
    def _value(terms, x, z, leaning):
        if leaning is None:
            return polynomial(terms, x, z)
        values = polynomial(terms[:-2], x, z)
        values += terms[-2] * leaning[0]
        values += terms[-1] * leaning[1]
        return values


def _sum(values, weights):
    """Sums (Q,) of values (S, T, Q) times weights that broadcast to them."""
    values = values * weights
    return values.reshape(values.shape[0] * values.shape[1], -1).sum(axis=0)


def polynomial_terms(weights: np.ndarray) -> np.ndarray:
    """Coefficients (..., K, P) of 1; x, z; x^2, xz, z^2; x^3, ... of a lobe with weights (..., K, P) of `moments`.
    Weights of the two moments of a bend stay as they are.

    The moments of a patch around the direction (x, y, z) are its solid angle times 1; 2 x, 2 z; and, for k > 1, the
    coefficients of the form (k + 1) (u.w)^k - (k - 1) |u|^2 (u.w)^(k - 2) in u, where w = (x, z).
    """
    w = np.moveaxis(weights, -2, 0)
    terms = w.copy()
    degree = degree_of(len(w))
    terms[1:3] = 2.0 * w[1:3]
    if degree > 1:
        terms[0] -= w[3] + w[5]
        terms[3:6] = 3.0 * w[3], 6.0 * w[4], 3.0 * w[5]
    if degree > 2:
        terms[1] -= 2.0 * (w[6] + w[8])
        terms[2] -= 2.0 * (w[7] + w[9])
        terms[6:10] = 4.0 * w[6], 12.0 * w[7], 12.0 * w[8], 4.0 * w[9]
    if degree > 3:
        terms[3] -= 3.0 * (w[10] + w[12])
        terms[4] -= 6.0 * (w[11] + w[13])
        terms[5] -= 3.0 * (w[12] + w[14])
        terms[10:15] = 5.0 * w[10], 20.0 * w[11], 30.0 * w[12], 20.0 * w[13], 5.0 * w[14]
    return np.ascontiguousarray(np.moveaxis(terms, 0, -2))


def polynomial(terms: np.ndarray, x, z) -> np.ndarray:
    """Values (...) of the polynomials with coefficients (K, ...), in the order of `polynomial_terms`."""
    degree = int(np.sqrt(2 * len(terms))) - 1
    result = None
    for power in range(degree, -1, -1):
        # The factor of z^power. Among the terms of degree k + power, in order, the one of x^k z^power is number
        # `power`.
        rows = [(k + power) * (k + power + 1) // 2 + power for k in range(degree - power, -1, -1)]
        factor = terms[rows[0]]
        for row in rows[1:]:
            factor = factor * x
            factor += terms[row]
        result = factor if result is None else result * z + factor
    return result
