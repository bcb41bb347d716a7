"""Limits for integrals over lights in the tails of lobes.

In its tail a fitted lobe may be off by more than its value, which shows as bright and dark rings at rims. There the
true lobe changes so slowly over a light that its values at a few points of the light confine the integral. This holds
where none of GGX's peak is between the points: where the mirrored view ray misses the light by more than its size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .brdf import dielectric_reflectance, schlick_curve
from .lookup_table import MIN_ALPHA
from .polygon import dot

# Of the sphere that the mirrored view ray must miss, in units of that around the light.
NEAR_RADII = 2.0


@dataclass(frozen=True)
class LightExtent:
    """Where lights are: the half diagonals of the parallelograms around them, and their areas times the direction to
    which they shine; all (3, 1), or (3, Q) for a light of each point."""

    diagonals: tuple[np.ndarray, np.ndarray]
    area: np.ndarray

    @classmethod
    def of(cls, light, dtype) -> LightExtent:
        """That of an AreaLight, or of a `float64.LightOfEachSample`."""
        vectors = light.half_u, light.half_v, light.direction, light.area_vector
        half_u, half_v, direction, area = (vector[None].T if vector.ndim == 1 else vector.T for vector in vectors)
        area = np.sqrt(dot(area, area)) * direction
        return cls(tuple(vector.astype(dtype) for vector in (half_u + half_v, half_u - half_v)), area.astype(dtype))

    def take(self, index) -> LightExtent:
        """Those of the points `index` (Q',)."""
        if self.area.shape[1] == 1:
            return self
        return LightExtent(tuple(diagonal[:, index] for diagonal in self.diagonals), self.area[:, index])


@dataclass(frozen=True)
class TailLimits:
    """Limits for the lobes of Q samples."""

    rows: np.ndarray  # (9, Q) normal, view, their product, alpha^2, ior; (12, Q) with the normal of a second horizon
    head_on: np.ndarray | None  # (Q,) the least reflectance, where the last integral is that of a dielectric
    schlick: bool  # whether the second integral is that of Schlick's curve

    @classmethod
    def of(cls, samples, index, geometric, kinds, dtype) -> TailLimits:
        """Those of the samples `index` (Q,), with normals `geometric` (3, Q) or None; `kinds`: whether there are
        integrals for Schlick's curve, and for a dielectric."""
        schlick, dielectric = kinds
        normal, view = samples.normal[index].T, samples.view[index].T
        alpha = np.maximum(samples.roughness[index] ** 2, MIN_ALPHA)
        ior = np.maximum(samples.ior[index], 1.0)
        second = () if geometric is None else geometric
        cosine = dot(normal, view)
        rows = np.stack([*normal, *view, cosine, alpha * alpha, ior, *second], dtype=dtype, casting="same_kind")
        head_on = (((ior - 1.0) / (ior + 1.0)) ** 2).astype(dtype) if dielectric else None
        return cls(rows, head_on, schlick)

    def apply(self, integrals, part, offset, light, scratch) -> None:
        """Limit integrals (F, Q') over lights whose centers are at `offset` (3, Q') from the samples `part`.

        In the tail the first, for F = 1, is brought between the least and the greatest integrand over the area, of
        those at the center and the corners, times the area; not for profiled lights. The others are at most the
        greatest reflectance there times the first, and nowhere more than the first. That of a dielectric is at least
        its reflectance head on times the first.
        scratch(name, shape) gives an array whose content does not matter.
        """
        rows = self.rows[:, part] if isinstance(part, slice) else np.take(self.rows, part, axis=1)
        extent = LightExtent.of(light, rows.dtype)
        center = scratch("center of light", (6, rows.shape[1]))
        for number, vectors in enumerate((rows[:3], rows[3:6], offset)):
            _dot(vectors, offset, center[number], scratch)
        center[3:] = offset
        chosen = np.nonzero(_is_tail(rows[6], center, extent) & (integrals[0] > 0.0))[0]
        if len(chosen):
            rows, center = np.take(rows, chosen, axis=1), np.take(center, chosen, axis=1)
            found = np.take(integrals, chosen, axis=1)
            points = _LightPoints(rows, center, extent.take(chosen), scratch)
            far = points.least_half_angle_cosine()
            if not light.is_profiled:
                least, most = points.limits()
                np.minimum(np.maximum(found[0], least, out=least), most, out=found[0])
            if self.schlick:
                np.minimum(found[1], schlick_curve(far) * found[0], out=found[1])
            if self.head_on is not None:
                np.minimum(found[-1], dielectric_reflectance(far, rows[8]) * found[0], out=found[-1])
            integrals[:, chosen] = found
        if self.schlick:
            np.minimum(integrals[1], integrals[0], out=integrals[1])
        if self.head_on is not None:
            np.minimum(integrals[-1], integrals[0], out=integrals[-1])
            np.maximum(integrals[-1], self.head_on[part] * integrals[0], out=integrals[-1])


def _is_tail(cosine, center, extent):
    """Mask (Q,) of the lights that the mirrored view ray misses far enough."""
    mirrored = cosine * center[0]
    mirrored += mirrored
    mirrored -= center[1]
    beyond = center[2] - NEAR_RADII**2 * np.maximum(*(dot(diagonal, diagonal) for diagonal in extent.diagonals))
    tail = beyond > 0.0
    tail &= mirrored * np.abs(mirrored) < beyond
    return tail


class _LightPoints:
    """The centers and corners of lights as seen from samples: (5, Q) heights over the horizons, products with the
    views, squared distances."""

    def __init__(self, rows, center, extent, scratch):
        self.rows, self.offset, self.extent, self.scratch = rows, center[3:], extent, scratch
        self.heights = self._products("heights", rows[:3], center[0])
        self.views = self._products("views", rows[3:6], center[1])
        self.squares = self._products("squares", self.offset, center[2])
        for number, diagonal in enumerate(extent.diagonals):
            # |offset +- diagonal|^2
            corners = self.squares[1 + 2 * number : 3 + 2 * number]
            corners += corners
            corners += dot(diagonal, diagonal)
            corners -= center[2]
        self.distances = np.sqrt(self.squares, out=self._array("distances"))
        # Half the squared length of the half vector, times the squared distance.
        self.halves = self.views
        self.halves *= self.distances
        self.halves += self.squares

    def least_half_angle_cosine(self) -> np.ndarray:
        """The least cosine (Q,) of the angle between the view and the half vector."""
        work = np.divide(self.halves, self.squares, out=self._array("work"))
        return np.sqrt((0.5 * np.minimum.reduce(work, axis=0)).clip(0.0, 1.0))

    def limits(self):
        """The least and the greatest integrand over the area (Q,), times the area. Changes all arrays."""
        alpha_squared = self.rows[7]
        values = self._integrands(self.rows[6], alpha_squared)
        factor = dot(self.offset, self.extent.area)
        factor *= alpha_squared
        factor *= -0.5 / np.pi
        least, most = (bound.reduce(values, axis=0) for bound in (np.minimum, np.maximum))
        least *= factor
        most *= factor
        if len(self.rows) > 9:
            # What is below the second horizon is not seen.
            second = self.rows[9:]
            heights = self._products("heights", second, dot(second, self.offset))
            least *= np.minimum.reduce(heights, axis=0) > 0.0
        return least, most

    def _integrands(self, cosine, alpha_squared):
        """GGX's BRDF times both cosines by the squared distance (5, Q), but for constants."""
        rest = 1.0 - alpha_squared
        heights, distances, squares = self.heights, self.distances, self.squares
        ratio = np.multiply(cosine, distances, out=self._array("work"))
        ratio += heights
        ratio *= ratio
        ratio *= -0.5 * rest
        ratio += self.halves
        np.divide(self.halves, ratio, out=ratio)
        ratio *= ratio
        np.maximum(heights, np.zeros_like(rest), out=heights)
        ratio *= heights
        masking = np.multiply(heights, heights, out=self.halves)
        masking *= rest
        distances *= squares
        squares *= alpha_squared
        masking += squares
        np.sqrt(masking, out=masking)
        masking *= cosine
        heights *= np.sqrt(alpha_squared + rest * cosine * cosine)
        masking += heights
        masking *= distances
        ratio /= masking
        return ratio

    def _array(self, name):
        return self.scratch(name, (5, self.offset.shape[1]))

    def _products(self, name, vectors, at_center):
        """Products (5, Q) of vectors (3, Q) with the offsets of the points."""
        result, along = self._array(name), self.scratch("along", at_center.shape)
        result[0] = at_center
        for number, diagonal in enumerate(self.extent.diagonals):
            _dot(vectors, diagonal, along, self.scratch)
            np.add(at_center, along, out=result[1 + 2 * number])
            np.subtract(at_center, along, out=result[2 + 2 * number])
        return result


def _dot(a, b, out, scratch):
    """Scalar products (Q,) of vectors (3, Q)."""
    work = scratch("dot", out.shape)
    np.multiply(a[0], b[0], out=out)
    for axis in (1, 2):
        out += np.multiply(a[axis], b[axis], out=work)
