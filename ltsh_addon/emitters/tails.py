"""Limits for integrals over lights in the tails of lobes.

In its tail a fitted lobe may be off by more than its value, which shows as bright and dark rings at rims. There the
true lobe changes so slowly over a light that its values at a few points of the light bound the integral. This holds if
none of GGX's peak is between the points, that is, if the mirrored view ray misses the light by more than its size.

Where the values differ little, they also tell the integral: that of a cubic polynomial over a rectangle or an ellipse
follows from the center and the corners (Stroud 1971, "Approximate calculation of multiple integrals"). In 72,000 random
tails its error was at most SLACK times the fourth power of the contrast of the values in about 97 %.
"""

from dataclasses import dataclass

import numpy as np

from ..lobes.brdf import dielectric_reflectance, schlick_curve
from ..lobes.lookup_table import MIN_ALPHA
from ..lobes.polygon import dot
from .light_profile import Profile

# Radius of the sphere that the mirrored view ray must miss, in units of the radius of the sphere around the light.
NEAR_RADII = 2.0
# Share of the turn toward a light's corner that lies along a direction, averaged over directions.
ALONG = 0.9
# The weight of the mean of the corners in the integral, 1 less that of the center, by the share of the parallelogram
# around the light that the light fills: of parallelograms and ellipses.
CORNER_WEIGHTS = ((1.0, 1.0 / 3.0), (0.25 * np.pi, 0.25))
SLACK = 0.2
# By how much the mean over a small light may differ from the value at its center, in units of its squared change.
CURVATURE = 0.1
_TINY = 1e-12


@dataclass(frozen=True)
class LightFromPoints:
    """Lights as Q points see them: one light for all points, or one for each. "..." stands for Q or 1."""

    offset: np.ndarray  # (3, Q) of the light's center from the points
    toward: np.ndarray  # (Q,) dot product of `offset` and the direction into which the light shines; negative
    diagonals: np.ndarray  # (2, 3, ...) half diagonals of the parallelogram around the light
    squares: np.ndarray  # (2, ...) their squared lengths
    area: np.ndarray  # (...)
    profile: Profile | None

    @property
    def corner_weight(self) -> np.ndarray:
        """Of CORNER_WEIGHTS the one of the light's shape (...), 0 for other shapes."""
        one, other = self.diagonals
        crossed = np.cross(one, other, axis=0)
        share = self.area / np.maximum(2.0 * np.sqrt(dot(crossed, crossed)), _TINY)
        return sum(np.where(np.abs(share - fills) < 1e-3, weight, 0.0) for fills, weight in CORNER_WEIGHTS)

    @classmethod
    def of(cls, light, offset, toward) -> "LightFromPoints":
        """For a `Light` or a `float64.LightOfEachSample`, in the precision of `offset`."""
        vectors = np.stack([light.half_u + light.half_v, light.half_u - light.half_v, light.area_vector])
        vectors = vectors[..., None] if vectors.ndim == 2 else vectors.transpose(0, 2, 1)
        squares = (vectors * vectors).sum(axis=1).astype(offset.dtype)
        profile = Profile.of(light) if light.has_profile else None
        return cls(offset, toward, vectors[:2].astype(offset.dtype), squares[:2], np.sqrt(squares[2]), profile)

    @classmethod
    def of_plain(cls, halves, area, offset, toward) -> "LightFromPoints":
        """For lights without a profile, given by two half axes (3, Q) and area vectors (3, Q)."""
        u, v = halves
        diagonals = np.stack([u + v, u - v])
        return cls(offset, toward, diagonals, (diagonals * diagonals).sum(axis=1), np.sqrt(dot(area, area)), None)

    @classmethod
    def of_disk(cls, disk) -> "LightFromPoints":
        """For a FacingDisk."""
        u, v = disk.half_u, disk.half_v
        square = disk.radius * disk.radius
        diagonals, squares = np.stack([u + v, u - v]), np.stack([2.0 * square] * 2)
        return cls(disk.offset, -disk.length, diagonals, squares, np.pi * square, None)

    def along_diagonals(self, vectors, out, product):
        """Products (2, Q) of vectors (3, Q) with the half diagonals."""
        np.multiply(self.diagonals[:, 0], vectors[0], out=out)
        for axis in (1, 2):
            out += np.multiply(self.diagonals[:, axis], vectors[axis], out=product)
        return out

    def range_of_profile(self, distance_squared):
        """The least and the greatest value (Q,) of the profile within the circle around the light."""
        beside = np.sqrt(np.maximum(distance_squared - self.toward * self.toward, 0.0))
        radius = np.sqrt(np.maximum(*self.squares))
        return self.profile.range(np.maximum(beside - radius, 0.0), beside + radius, -self.toward)


@dataclass(frozen=True)
class TailLimits:
    """Limits for the lobes of Q samples."""

    normal: np.ndarray  # (3, Q)
    view: np.ndarray  # (3, Q)
    cosine: np.ndarray  # (Q,) dot product of normal and view
    alpha_squared: np.ndarray  # (Q,)
    second: np.ndarray | None  # (3, Q) normals of second horizons
    schlick: bool  # True if the second integral is that of Schlick's curve
    ior: np.ndarray | None  # (Q,) if the last integral is that of a dielectric

    @classmethod
    def of(cls, axes, roughness, second, schlick, ior) -> "TailLimits":
        """For samples with the normals and views `axes` (whose precision it takes), `roughness` (Q,), and `ior` (Q,) or
        None."""
        normal, view = axes
        roughness = roughness.astype(normal.dtype)
        alpha = np.maximum(roughness * roughness, normal.dtype.type(MIN_ALPHA))
        ior = None if ior is None else np.maximum(ior, 1.0).astype(normal.dtype)
        return cls(normal, view, dot(normal, view), alpha * alpha, second, schlick, ior)

    def take(self, columns) -> "TailLimits":
        """The limits of the samples `columns`: integers (Q',) or a slice."""
        values = self.normal, self.view, self.cosine, self.alpha_squared, self.second, self.ior
        *values, ior = (value if value is None else value[..., columns] for value in values)
        return TailLimits(*values, self.schlick, ior)

    def apply(self, integrals, columns, light: LightFromPoints, scratch) -> None:
        """Limit integrals (F, Q') over the light as the samples `columns` see it, in place.

        In the tail, the first integral (for F = 1) is brought between two bounds: the least and the greatest integrand
        over the area, of its values at the center and the corners, times the area, times the least and the greatest
        value of the profile. The bounds are closer together where these values tell the integral. In the tail, the
        others are at most the greatest reflectance there times the first. Everywhere, they are at most the first; a
        dielectric's is at least its reflectance head on times the first.
        scratch(name, shape) returns an array of any content.
        """
        # Outside the tail nothing is limited, but points may coincide.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            _LightPoints(self.take(columns), light, scratch).limit(integrals)

    def apply_at_centers(self, integrals, columns, rays) -> None:
        """As `apply`, for integrals (F, ...) over lights so small that their center stands for all of them. The centers
        are the ends of `rays`, `small_lights.RaysToCenters`."""
        lobes = self.take(columns)
        tail, value, cosine = lobes.true_and_tail(rays)
        # The mean over the light differs from the value at its center by terms of second order.
        margin = np.float32(CURVATURE) * rays.slack * rays.slack * value
        value = np.minimum(np.maximum(integrals[0], value - margin), value + margin)
        np.copyto(integrals[0], value, where=tail & (integrals[0] > 0.0))
        # Toward a corner the half vector turns by up to half the angle, which rarely lies along its turn.
        sine = np.sqrt(np.maximum(np.float32(1.0) - cosine * cosine, np.float32(0.0)))
        sine *= np.float32(0.5 * ALONG) * np.sqrt(rays.diagonal) / rays.distance
        cosine = np.maximum(cosine - sine, np.float32(0.0))
        cosine *= tail
        lobes.limit_others(integrals, cosine)

    def true_in_tails(self, plain, columns, rays, count) -> list:
        """`count` integrals (...) over points. The first is `plain`, replaced by the true value in the tail; the others
        are the first times their Fresnel curves."""
        lobes = self.take(columns)
        tail, value, cosine = lobes.true_and_tail(rays)
        np.copyto(plain, value, where=tail)
        return lobes.curves(plain, cosine, count)

    def true_and_tail(self, rays):
        """Mask (...) of the lights in the tail, and their `true_values`."""
        heights, views = rays.heights(self.normal), rays.heights(self.view)
        beyond = rays.squares - np.float32(NEAR_RADII**2) * rays.diagonal
        mirrored = np.float32(2.0) * self.cosine * heights
        mirrored -= views
        mirrored *= np.abs(mirrored)
        return (mirrored < beyond) & (beyond > 0.0), *self.true_values(heights, views, rays)

    def at_centers(self, columns, rays, count) -> list:
        """`count` true integrals (...) over small lights that are all in the tail."""
        lobes = self.take(columns)
        value, cosine = lobes.true_values(rays.heights(lobes.normal), rays.heights(lobes.view), rays)
        return lobes.curves(value, cosine, count)

    def true_values(self, heights, views, rays):
        """GGX's integrals (...) over small lights for F = 1, and cosines (...) of the half angles. `heights` over the
        horizon and `views` along the view are overwritten."""
        inverse = np.float32(1.0) / rays.distance
        cosines = np.multiply(heights, inverse, out=heights)
        # Half the square of the half vector's length.
        halves = np.multiply(views, inverse, out=views)
        halves += np.float32(1.0)
        np.minimum(np.maximum(halves, np.float32(_TINY), out=halves), np.float32(2.0), out=halves)
        rest = np.float32(1.0) - self.alpha_squared
        value = cosines + self.cosine
        value *= value
        value *= np.float32(-0.5) * rest
        value += halves
        np.divide(halves, value, out=value)
        value *= value
        masking = cosines * cosines
        masking *= rest
        masking += self.alpha_squared
        np.sqrt(masking, out=masking)
        masking *= self.cosine
        np.maximum(cosines, np.float32(0.0), out=cosines)
        value *= cosines
        cosines *= np.sqrt(self.alpha_squared + rest * self.cosine * self.cosine)
        masking += cosines
        value /= masking
        value *= rays.flux
        np.multiply(inverse, inverse, out=masking)
        masking *= inverse
        masking *= np.float32(0.5 / np.pi) * self.alpha_squared
        value *= masking
        halves *= np.float32(0.5)
        return value, np.sqrt(halves, out=halves)

    def curves(self, value, cosine, count) -> list:
        """`count` arrays: `value` (...), then `value` times the other Fresnel curves of the lobes. `cosine` (...) is
        that of the half angle."""
        integrals = [value]
        if self.schlick:
            integrals.append(schlick_curve(cosine) * value)
            if count > 2 + (self.ior is not None):
                integrals.append(cosine * (np.float32(1.0) - cosine) * integrals[1])
        if self.ior is not None:
            integrals.append(dielectric_reflectance(cosine, self.ior) * value)
        return integrals

    def limit_others(self, integrals, cosine) -> None:
        """Limit all but the first of integrals (F, ...) by the first, in place. `cosine` (...) is the least cosine of
        the half angle over the light, or 0 outside the tail."""
        plain = integrals[0]
        if self.schlick:
            np.minimum(integrals[1], schlick_curve(cosine) * plain, out=integrals[1])
        if self.ior is not None:
            np.minimum(integrals[-1], dielectric_reflectance(cosine, self.ior) * plain, out=integrals[-1])
            head_on = (self.ior - 1.0) / (self.ior + 1.0)
            np.maximum(integrals[-1], head_on * head_on * plain, out=integrals[-1])


class _LightPoints:
    """The centers of lights as seen from samples, later their corners too: (5, Q) heights over the horizons, dot
    products with the views, and squared distances."""

    def __init__(self, lobes, light, scratch):
        self.lobes, self.light = lobes, light
        count = len(lobes.cosine)
        self.heights, self.views, self.squares = scratch("unit", (3, 5, count))
        others = scratch("corners", (12, count))
        self.distances, self.work, self.one, self.two = others[:5], others[5:10], others[10], others[11]
        for values, vectors in ((self.heights, lobes.normal), (self.views, lobes.view), (self.squares, light.offset)):
            self._add_center(values, vectors)

    def limit(self, integrals) -> None:
        """As `TailLimits.apply`."""
        plain, cosine = integrals[0], np.zeros(1, integrals.dtype)
        tail = self.are_in_tail()
        if tail.any():
            self.add_corners()
            others = ~tail
            if len(integrals) > 1:
                cosine = self.least_half_angle_cosine()
                np.copyto(cosine, 0.0, where=others)
            least, most = self.limits()
            others |= plain <= 0.0
            np.copyto(least, 0.0, where=others)
            np.copyto(most, np.inf, where=others)
            np.minimum(np.maximum(plain, least, out=plain), most, out=plain)
        self.lobes.limit_others(integrals, cosine)

    def are_in_tail(self) -> np.ndarray:
        """Mask (Q,) of the lights that the mirrored view ray misses by far enough."""
        mirrored = np.multiply(self.lobes.cosine, self.heights[0], out=self.one)
        mirrored += mirrored
        mirrored -= self.views[0]
        mirrored *= np.abs(mirrored, out=self.two)
        beyond = np.subtract(self.squares[0], NEAR_RADII**2 * np.maximum(*self.light.squares), out=self.two)
        tail = beyond > 0.0
        tail &= mirrored < beyond
        return tail

    def add_corners(self) -> None:
        """Fill in the rows of the corners, and what follows from them."""
        self._add_corners(self.heights, self.lobes.normal)
        self._add_corners(self.views, self.lobes.view)
        # |offset +- diagonal|^2
        along = self.light.along_diagonals(self.light.offset, *self.work[:4].reshape(2, 2, -1))
        along += along
        middle = np.add(self.squares[0], self.light.squares, out=self.work[2:4])
        np.add(middle, along, out=self.squares[1:3])
        np.subtract(middle, along, out=self.squares[3:])
        np.sqrt(self.squares, out=self.distances)
        # Half the squared length of the half vector, times the squared distance.
        self.halves = self.views
        self.halves *= self.distances
        self.halves += self.squares

    def least_half_angle_cosine(self) -> np.ndarray:
        """The least cosine (Q,) of the angle between the view and the half vector."""
        least = np.minimum.reduce(np.divide(self.halves, self.squares, out=self.work), axis=0)
        least *= 0.5
        np.minimum(np.maximum(least, 0.0, out=least), 1.0, out=least)
        return np.sqrt(least, out=least)

    def limits(self):
        """The least and the greatest integrand over the area (Q,), times the area and the profile. Overwrites all
        arrays."""
        cosine, alpha_squared = self.lobes.cosine, self.lobes.alpha_squared
        profile = None if self.light.profile is None else self.light.range_of_profile(self.squares[0])
        values = _integrands(
            cosine, alpha_squared, (self.heights, self.halves, self.squares, self.distances), self.work
        )
        least = np.minimum.reduce(values, axis=0, out=self.squares[0])
        most = np.maximum.reduce(values, axis=0, out=self.squares[1])
        weight = self.light.corner_weight.astype(values.dtype)
        mean = (1.0 - weight) * values[0]
        mean += 0.25 * weight * values[1:].sum(axis=0)
        contrast = np.square((most - least) / (most + least))
        slack = SLACK * mean * contrast * contrast
        is_known = (least > 0.0) & (weight > 0.0)
        if self.lobes.second is not None:
            # Nothing below the second horizon is visible.
            self._add_center(self.heights, self.lobes.second)
            self._add_corners(self.heights, self.lobes.second)
            is_above = np.minimum.reduce(self.heights, axis=0) > 0.0
            is_known &= is_above
        np.copyto(least, np.maximum(least, mean - slack), where=is_known)
        np.copyto(most, np.minimum(most, mean + slack), where=is_known)
        factor = np.multiply(alpha_squared, self.light.toward, out=self.one)
        factor *= (-0.5 / np.pi) * self.light.area
        least *= factor
        most *= factor
        # Integrands below the horizon are negative.
        np.maximum(most, 0.0, out=most)
        if profile is not None:
            least *= profile[0]
            most *= profile[1]
        if self.lobes.second is not None:
            least *= is_above
        return least, most

    def _add_center(self, values, vectors):
        """Set values[0] to the dot products of vectors (3, Q) with the center's offset."""
        offset = self.light.offset
        np.multiply(vectors[0], offset[0], out=values[0])
        for axis in (1, 2):
            values[0] += np.multiply(vectors[axis], offset[axis], out=self.two)

    def _add_corners(self, values, vectors):
        """Set values[1:] to dot products of vectors (3, Q) with the corners' offsets. values[0] has the center's."""
        along = self.light.along_diagonals(vectors, *self.work[:4].reshape(2, 2, -1))
        np.add(values[0], along, out=values[1:3])
        np.subtract(values[0], along, out=values[3:])


def _integrands(cosine, alpha_squared, at_points, work=None):
    """GGX's BRDF times both cosines divided by the squared distance (...), without constant factors; negative below
    horizons.

    `at_points` is the heights over the horizon, halves, squared distances and distances of points, all (...); all are
    overwritten.
    """
    heights, halves, squares, distances = at_points
    rest = 1.0 - alpha_squared
    ratio = np.multiply(cosine, distances, out=work)
    ratio += heights
    ratio *= ratio
    ratio *= -0.5 * rest
    ratio += halves
    np.divide(halves, ratio, out=ratio)
    ratio *= ratio
    ratio *= heights
    masking = np.multiply(heights, heights, out=halves)
    masking *= rest
    distances *= squares
    squares *= alpha_squared
    masking += squares
    np.sqrt(masking, out=masking)
    masking *= cosine
    np.abs(heights, out=heights)
    heights *= np.sqrt(alpha_squared + rest * cosine * cosine)
    masking += heights
    masking *= distances
    ratio /= masking
    return ratio
