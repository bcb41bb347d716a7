"""Directions of numbers: the Sobol sequence, quadrilaterals sampled over their solid angle, and the warp of GGX.

Everything is in single precision. Arrays are (S, Q), S directions from each of Q points, or (Q,). Vectors have their
components first.
"""

import copy

import numpy as np

from ..lobes.lookup_table import WARP_REGULARIZATION
from ..lobes.polygon import cross, dot

_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# In sr. Quadrilaterals with a smaller solid angle count as invisible.
_LEAST_SOLID_ANGLE = np.float32(1e-20)


class SphericalQuads:
    """Quadrilaterals (3, 4, Q) as points see them, for directions spread evenly over their solid angles (Q,).

    A diagonal splits each into two triangles, sampled as in Peters 2021, "BRDF importance sampling for polygonal
    lights", section 3 (after Arvo 1995), doi:10.1145/3450626.3459672.
    """

    def __init__(self, corners: np.ndarray):
        unit = corners / np.maximum(np.sqrt(dot(corners, corners)), _TINY)
        self.apex, far, self.near = unit[:, 0], unit[:, 2], (unit[:, 1], unit[:, 3])
        # Sums and differences stay accurate for corners that are close to each other or nearly opposite.
        self.both, chord = self.apex + far, far - self.apex
        self.gap = np.float32(0.5) * dot(self.both, self.both)
        self.terms, angles = [], []
        for near in self.near:
            volume = np.abs(dot(cross(near - self.apex, chord), self.apex))
            near_both = dot(near, self.both)
            both = self.apex + near
            self.terms.append((volume, np.float32(0.5) * dot(both, both), near_both))
            angles.append(2.0 * np.arctan2(volume, self.gap + near_both))
        self.first, self.solid_angle = angles[0], angles[0] + angles[1]
        self.has_solid_angle = self.solid_angle > _LEAST_SOLID_ANGLE
        np.maximum(self.solid_angle, _LEAST_SOLID_ANGLE, out=self.solid_angle)

    def take_rows(self, rows: slice) -> "SphericalQuads":
        """The quadrilaterals of these `rows`, if they are (3, 4, S, Q): each sample sees several."""
        quads = copy.copy(self)
        for name in ("apex", "both"):
            setattr(quads, name, getattr(self, name)[:, rows])
        quads.near = [near[:, rows] for near in self.near]
        quads.terms = [tuple(term[rows] for term in terms) for terms in self.terms]
        for name in ("gap", "first", "solid_angle", "has_solid_angle"):
            setattr(quads, name, getattr(self, name)[rows])
        return quads

    def directions(self, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Unit vectors `out` (3, S, Q) for numbers x, y (S, Q) in [0, 1), which are overwritten."""
        x *= self.solid_angle
        is_second = x > self.first
        x -= np.where(is_second, self.first, _ZERO)
        x *= np.float32(0.5)
        volume, near_gap, near_both = (np.where(is_second, b, a) for a, b in zip(*self.terms, strict=True))
        cosine, sine = np.cos(x), np.sin(x, out=x)
        # The third corner of the subtriangle with this solid angle is on_apex `apex` + on_both `both`.
        on_apex = np.multiply(cosine, volume, out=volume)
        on_apex -= (self.gap + near_both) * sine
        on_both = sine
        on_both *= near_gap
        scale = on_both * self.gap
        squared = on_apex + on_both
        squared *= scale
        squared *= np.float32(2.0)
        squared += on_apex * on_apex
        scale += on_apex
        scale *= np.float32(2.0)
        scale /= np.maximum(squared, _TINY, out=squared)
        on_apex *= scale
        on_apex -= _ONE
        on_both *= scale
        # The cosine between the corner `near` and that third corner.
        near_gap -= _ONE
        near_gap *= on_apex
        near_both *= on_both
        near_gap += near_both
        cosine = np.clip(near_gap, -_ONE, _ONE, out=near_gap)
        height = cosine - _ONE
        height *= y
        height += _ONE
        share = height + _ONE
        share *= y
        share /= np.maximum(cosine + _ONE, _TINY)
        np.sqrt(share, out=share)
        on_apex *= share
        on_both *= share
        cosine *= share
        height -= cosine
        for k in range(3):
            near = np.where(is_second, self.near[1][k], self.near[0][k])
            np.multiply(near, height, out=out[k])
            out[k] += on_apex * self.apex[k]
            out[k] += on_both * self.both[k]
        # Correct what rounding changed.
        length = np.sqrt(dot(out, out))
        out /= np.maximum(length, _TINY, out=length)
        return out


class Warps:
    """Maps from the world to coordinates in which GGX lobes have no peak: the local frames, then the warps of
    `shading.lookup_table` with A, B and C = 1, the limit for alpha -> 0."""

    def __init__(self, rows: np.ndarray, cosine: np.ndarray, sine: np.ndarray, alpha: np.ndarray):
        """`rows` are local frames (3, 3, Q); `cosine` and `sine` are of the view's angle from the normal, (Q,) as is
        `alpha`."""
        self.rows = rows
        self.xx = cosine * cosine + np.float32(WARP_REGULARIZATION**2) * alpha * alpha
        self.xz = np.sqrt(self.xx) * sine
        self.zz = 2.0 * alpha
        self.determinant = self.xx * self.zz

    def local(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """World vectors (3, S, Q) in the local frames."""
        return self._turned(vectors, self.rows, out)

    def world(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Local vectors (3, S, Q) in the world."""
        return self._turned(vectors, self.rows.transpose(1, 0, 2), out)

    def _turned(self, vectors, rows, out):
        out = np.empty_like(vectors) if out is None else out
        for k in range(3):
            np.multiply(vectors[0], rows[k, 0], out=out[k])
            out[k] += vectors[1] * rows[k, 1]
            out[k] += vectors[2] * rows[k, 2]
        return out

    def warped(self, local: np.ndarray) -> np.ndarray:
        """Local vectors (3, S, Q) after the warp."""
        return np.stack([self.xx * local[0] + self.xz * local[2], local[1], self.zz * local[2]])

    def lengths(self, local: np.ndarray) -> np.ndarray:
        """Lengths (S, Q) that unit local vectors (3, S, Q) have after the warp."""
        warped = self.warped(local)
        warped *= warped
        return np.sqrt(warped[0] + warped[1] + warped[2])

    def unwarped(self, vectors: np.ndarray) -> np.ndarray:
        """Turn warped unit vectors (3, S, Q) in place into unit local vectors, and return the `lengths` of these."""
        x, y, z = vectors
        z /= self.zz
        x -= self.xz * z
        x /= self.xx
        length = x * x
        length += y * y
        length += z * z
        np.maximum(length, _TINY, out=length)
        np.sqrt(length, out=length)
        np.divide(_ONE, length, out=length)
        vectors *= length
        return length


def frames(normal: np.ndarray, view: np.ndarray):
    """Cosine and sine (Q,) of the angle between view and normal, both (3, Q), and local frames (3, 3, Q): rows tangent,
    bitangent, normal."""
    # Differences of close vectors are exact. A single-precision normal is not quite a unit vector.
    across = view - normal
    squared = dot(normal, normal)
    across -= dot(across, normal) / squared * normal
    sine = np.sqrt(dot(across, across))
    axis = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normal), axis=0)].T
    tangent = np.where(sine > 1e-6, across / np.maximum(sine, _TINY), axis)
    tangent -= dot(tangent, normal) / squared * normal
    tangent /= np.sqrt(dot(tangent, tangent))
    normal = normal / np.sqrt(squared)
    rows = np.stack([tangent, cross(normal, tangent), normal])
    return np.clip(dot(normal, view), _ZERO, _ONE), sine, rows


# Bits of a coordinate of the sequence, as many as single precision holds.
BITS = 23
# Length of each sequence
MOST_POINTS = 1024


def sequence(count: int, seed: int = 1) -> np.ndarray:
    """The first `count` points (2, count) of the Sobol sequence, uint32 of 23 bits, scrambled as by Owen (1995).

    Each block of 2^k points that starts at a multiple of 2^k is stratified as well as can be. XOR with any number keeps
    this property.
    """
    points = sobol(np.arange(count, dtype=np.uint32))
    scrambled = [_nested_scramble(row, 2 * seed + axis) for axis, row in enumerate(points)]
    return np.stack(scrambled) >> np.uint32(32 - BITS)


def sobol(number: np.ndarray) -> np.ndarray:
    """The points (2, ...) of these numbers, uint32, in the Sobol sequence, uint32 of 32 bits."""
    points = np.zeros((2, *number.shape), np.uint32)
    direction = np.uint32(1) << np.uint32(31)
    for bit in range(int(number.max(initial=0)).bit_length()):
        is_set = (number >> np.uint32(bit)) & np.uint32(1)
        points[0] ^= is_set << np.uint32(31 - bit)
        points[1] ^= is_set * direction
        direction ^= direction >> np.uint32(1)
    return points


def _nested_scramble(values, seed):
    """Scrambled uint32 values: Laine and Karras 2011, "Stratified sampling for stochastic transparency", with the
    constants of Vegdahl."""
    values = _reversed_bits(values) + np.uint32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        values = values ^ (values * np.uint32(factor))
    return _reversed_bits(values)


def _reversed_bits(values):
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        low, step = np.uint32(mask), np.uint32(shift)
        values = ((values >> step) & low) | ((values & low) << step)
    return values


_POINTS = [sequence(MOST_POINTS, seed) for seed in (1, 2)]


def unit_points(
    seeds: np.ndarray, stream: int, first: int, last: int, order: np.ndarray | None = None
) -> list[np.ndarray]:
    """Numbers x, y (S, Q) in (0, 1): the points `first` to `last` of the sequence `stream`, 0 or 1, scrambled by the
    seeds (Q,) or one seed. With an `order` (Q,) the points of pairs whose numbers follow each other make up one
    sequence."""
    coordinates, shift = [], None
    if order is not None:
        size = np.uint32(1 << max(int(last - first) - 1, 0).bit_length())
        # Pairs with fewer points than `size` do not all leave out the same ones.
        shift = sobol(order * size + mixed_bits(order) % size)
        seeds, last, first = seeds + np.uint32(first), last - first, 0
    for axis, points in enumerate(_POINTS[stream][:, first:last]):
        scrambled = mixed_bits(seeds + np.uint32((2 * stream + axis) * 0x9E3779B1 & 0xFFFFFFFF))
        if shift is not None:
            scrambled = scrambled ^ shift[axis]
        numbers = (points[:, None] ^ (scrambled >> np.uint32(32 - BITS))).astype(np.float32)
        numbers += np.float32(0.5)
        numbers *= np.float32(2.0**-BITS)
        coordinates.append(numbers)
    return coordinates


def seeds_of(position: np.ndarray) -> np.ndarray:
    """Seeds (P,) uint32 of points (P, 3). They do not depend on the place of a point in a picture or a block."""
    bits = np.ascontiguousarray(position, dtype=np.float32).view(np.uint32)
    return mixed_bits(mixed_bits(mixed_bits(bits[:, 0]) ^ bits[:, 1]) ^ bits[:, 2])


def mixed_bits(values):
    """A hash of uint32 (Wellons 2018, "lowbias32")."""
    values = (values ^ (values >> np.uint32(16))) * np.uint32(0x7FEB352D)
    values = (values ^ (values >> np.uint32(15))) * np.uint32(0x846CA68B)
    return values ^ (values >> np.uint32(16))
