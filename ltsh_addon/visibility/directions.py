"""Directions from surface points to a light, few and well spread, and how bright each is for the lobes of the point.

A light is a quadrilateral; what a round, polygonal or textured one leaves dark of it has the weight 0. Half of the
directions are spread evenly over the solid angle of the light, as diffuse lobes need them. The other half are spread
evenly over the light after the warp that flattens the peak of GGX (`shading.lookup_table`), as specular lobes need
them: none misses the light, however sharp the lobe. The balance heuristic (Veach and Guibas 1995) joins both.

All is in single precision, arrays are (S, Q): S directions from each of Q points, or (Q,). Vectors are lists of three.
"""

from __future__ import annotations

import numpy as np

from ..scene import AreaLight
from ..shading import light_cone
from ..shading.lookup_table import WARP_REGULARIZATION
from ..shading.polygon import convex_pieces

# Bits of a point of the sequence: what fits into single precision.
BITS = 23
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# In sr: what is smaller is not seen.
_LEAST_SOLID_ANGLE = np.float32(1e-20)
# Of a sequence
MOST_POINTS = 1024
# Cells along each side of the picture of a light with a texture.
_PICTURE = 128
# Corners of an ellipse to aim at
_ROUND_CORNERS = 16


def sequence(count: int, seed: int = 1) -> np.ndarray:
    """The first `count` points (2, count) of the Sobol sequence, uint32 of 23 bits, scrambled as by Owen (1995).

    Every 2^k points, counted from the first, are stratified as well as can be. XOR with any number keeps that.
    """
    number = np.arange(count, dtype=np.uint32)
    points = np.zeros((2, count), np.uint32)
    direction = np.uint32(1) << np.uint32(31)
    for bit in range(32):
        is_set = (number >> np.uint32(bit)) & np.uint32(1)
        points[0] ^= is_set << np.uint32(31 - bit)
        points[1] ^= is_set * direction
        direction ^= direction >> np.uint32(1)
    scrambled = [_nested_scramble(row, 2 * seed + axis) for axis, row in enumerate(points)]
    return np.stack(scrambled) >> np.uint32(32 - BITS)


def _nested_scramble(values, seed):
    """Laine and Karras 2011, "Stratified sampling for stochastic transparency", with the constants of Vegdahl."""
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


def unit_points(seeds: np.ndarray, stream: int, first: int, last: int) -> list[np.ndarray]:
    """Numbers x, y (S, Q) in (0, 1): points `first` to `last` of the sequence `stream`, 0 or 1, changed by the seeds
    (Q,)."""
    found = []
    for axis, points in enumerate(_POINTS[stream][:, first:last]):
        own = mixed_bits(seeds + np.uint32((2 * stream + axis) * 0x9E3779B1 & 0xFFFFFFFF)) >> np.uint32(32 - BITS)
        numbers = (points[:, None] ^ own).astype(np.float32)
        numbers += np.float32(0.5)
        numbers *= np.float32(2.0**-BITS)
        found.append(numbers)
    return found


def seeds_of(position: np.ndarray) -> np.ndarray:
    """Seeds (P,) uint32 of points (P, 3): the same wherever a point stands in a picture or a block."""
    bits = np.ascontiguousarray(position, dtype=np.float32).view(np.uint32)
    return mixed_bits(mixed_bits(mixed_bits(bits[:, 0]) ^ bits[:, 1]) ^ bits[:, 2])


def mixed_bits(values):
    """A hash of uint32 (Wellons 2018, "lowbias32")."""
    values = (values ^ (values >> np.uint32(16))) * np.uint32(0x7FEB352D)
    values = (values ^ (values >> np.uint32(15))) * np.uint32(0x846CA68B)
    return values ^ (values >> np.uint32(16))


class Emitter:
    """What directions need of a light, the same for all points."""

    def __init__(self, light: AreaLight):
        self.light = light
        self.outline = light.polygon(_ROUND_CORNERS) - light.center
        self.direction = light.direction
        corners = self.outline if light.shape == "POLYGON" else None
        if corners is not None and len(corners) > 4:
            pieces = convex_pieces(corners)
            corners = pieces[0] if len(pieces) == 1 and len(pieces[0]) <= 4 else corners
        self.mask = None
        if corners is not None and len(corners) <= 4 and len(convex_pieces(corners)) == 1:
            self.axes, self.corners = None, corners[[0, 1, 2, -1]]
        else:
            self.center, self.axes = _frame(light)
            self.corners = None
            self.mask = _mask(light, self.center, self.axes)
        self.profile = light_cone.Profile.of(light) if light.is_profiled else None

    def corners_from(self, offset: list[np.ndarray], height: np.ndarray) -> np.ndarray:
        """Corners (3, 4, Q) of the quadrilateral from points; offset: three (Q,) to the center of the light, height
        (Q,) of the points over its plane."""
        if self.corners is not None:
            corners = self.corners.astype(np.float32)
            return np.stack([np.stack([offset[k] + corner[k] for corner in corners]) for k in range(3)])
        u, v = self.axes.astype(np.float32)
        middle = [offset[k] + np.float32(self.center[k]) for k in range(3)]
        ranges = self._ranges(middle, height)
        corners = [
            [middle[k] + ranges[0][i] * u[k] + ranges[1][j] * v[k] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
            for k in range(3)
        ]
        return np.array(corners)

    def _ranges(self, middle, height):
        """From where to where along both axes the quadrilateral reaches: as far as the cone of a spread."""
        one = np.float32(1.0)
        if not self.light.is_focused or abs(self.axes[0] @ self.axes[1]) > 1e-6 * np.prod(_lengths(self.axes)):
            return ((-one, one), (-one, one))
        ranges = []
        for axis in self.axes:
            squared = axis @ axis
            foot = -sum(middle[k] * np.float32(axis[k] / squared) for k in range(3))
            reach = np.float32(self.profile.tangent / np.sqrt(squared)) * height
            ranges.append((np.clip(foot - reach, -one, one), np.clip(foot + reach, -one, one)))
        return ranges

    def brightness(self, towards, distance, offset, height):
        """Factors (S, Q) of the radiance along directions that meet the light's plane at `distance`; None: all 1."""
        factor = None
        if self.profile is not None:
            radius = np.sqrt(np.maximum(distance * distance - height * height, 0.0))
            factor = self.profile.at(radius, np.maximum(height, _TINY)).astype(np.float32)
        if self.mask is not None:
            places = []
            for axis in np.linalg.pinv(self.axes).T.astype(np.float32):
                start = sum((offset[k] + np.float32(self.center[k])) * axis[k] for k in range(3))
                places.append(sum(towards[k] * axis[k] for k in range(3)) * distance - start)
            inside = self.mask(*places)
            factor = inside if factor is None else factor * inside
        return factor


def _lengths(axes):
    return np.sqrt((axes * axes).sum(axis=1))


def _frame(light):
    """Center, seen from that of the light, and half axes (2, 3) of a parallelogram around the light."""
    if light.shape != "POLYGON":
        return np.zeros(3), np.stack([light.half_u, light.half_v])
    outline = light.polygon() - light.center
    first = outline[1] - outline[0]
    best = None
    for first in np.roll(outline, -1, axis=0) - outline:
        if not first.any():
            continue
        axes = np.stack([first / np.linalg.norm(first), np.cross(light.direction, first) / np.linalg.norm(first)])
        flat = outline @ axes.T
        low, high = flat.min(axis=0), flat.max(axis=0)
        if best is None or np.prod(high - low) < best[0]:
            best = np.prod(high - low), 0.5 * (low + high) @ axes, 0.5 * (high - low)[:, None] * axes
    return best[1:]


def _mask(light, center, axes):
    """Function of places s, t in the parallelogram: the share of the light's radiance there; None: everywhere 1."""
    if light.detail:
        picture = _picture(light, center, axes)

        def shown(s, t):
            column, row = (np.clip((0.5 + 0.5 * x) * _PICTURE, 0, _PICTURE - 1).astype(np.int32) for x in (s, t))
            return picture.take(row * _PICTURE + column)

        return shown
    if light.is_round:
        return lambda s, t: s * s + t * t <= np.float32(1.0)
    if light.shape == "POLYGON":
        outline = ((light.polygon() - light.center - center) @ np.linalg.pinv(axes)).astype(np.float32)
        return lambda s, t: _inside(outline, s, t)
    return None


def _inside(outline, s, t):
    inside = np.zeros(s.shape, bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > t) != (y1 > t)) & (s < x0 + (t - y0) * ((x1 - x0) / (y1 - y0)))
    return inside


def _picture(light, center, axes):
    """Brightness (_PICTURE^2,) of a textured light by the places of its patches, 1 at most."""
    place = (np.arange(_PICTURE) + 0.5) * (2.0 / _PICTURE) - 1.0
    s, t = np.meshgrid(place, place)
    picture = np.zeros(s.shape)
    for patch in light.patches:
        if patch.is_round:
            covered = s * s + t * t <= 1.0
        else:
            covered = _inside((patch.polygon() - light.center - center) @ np.linalg.pinv(axes), s, t)
        picture[covered] = np.abs(patch.radiance).mean()
    return (picture / max(picture.max(), 1e-30)).ravel().astype(np.float32)


class SphericalQuads:
    """Quadrilaterals (3, 4, Q) as points see them, for directions spread evenly over their solid angles (Q,).

    Two triangles on either side of a diagonal, sampled as in Peters 2021, "BRDF importance sampling for polygonal
    lights", section 3 (after Arvo 1995), doi:10.1145/3450626.3459672.
    """

    def __init__(self, corners: np.ndarray):
        unit = corners / np.maximum(np.sqrt(dot(corners, corners)), _TINY)
        self.apex, self.far, self.near = unit[:, 0], unit[:, 2], (unit[:, 1], unit[:, 3])
        self.apex_far = dot(self.apex, self.far)
        chord = self.far - self.apex
        self.terms, angles = [], []
        for near in self.near:
            # By differences: all corners may be close together.
            volume = np.abs(dot(np.cross(near - self.apex, chord, axis=0), self.apex))
            apex_near, near_far = dot(self.apex, near), dot(near, self.far)
            self.terms.append((volume, apex_near, near_far))
            angles.append(2.0 * np.arctan2(volume, self.apex_far + near_far + 1.0 + apex_near))
        self.first, self.solid_angle = angles[0], angles[0] + angles[1]
        self.is_seen = self.solid_angle > _LEAST_SOLID_ANGLE
        np.maximum(self.solid_angle, _LEAST_SOLID_ANGLE, out=self.solid_angle)

    def directions(self, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Unit vectors `out` (3, S, Q) for numbers (S, Q) in [0, 1), which are lost."""
        x *= self.solid_angle
        is_second = x > self.first
        x -= np.where(is_second, self.first, _ZERO)
        x *= np.float32(0.5)
        volume, apex_near, near_far = (np.where(is_second, b, a) for a, b in zip(*self.terms, strict=True))
        cosine, sine = np.cos(x), np.sin(x, out=x)
        # The third corner of the part of the triangle that has the solid angle: `apex` and `far` times these.
        cosine *= volume
        cosine -= (self.apex_far + near_far) * sine
        on_apex, on_far = cosine, sine
        on_far *= _ONE + apex_near
        scale = on_far * self.apex_far
        scale += on_apex
        squared = on_apex * scale
        along = on_apex * self.apex_far
        along += on_far
        along *= on_far
        squared += along
        np.maximum(squared, _TINY, out=squared)
        scale /= squared
        scale *= np.float32(2.0)
        on_apex *= scale
        on_apex -= _ONE
        on_far *= scale
        # Between the corner `near` and that one.
        apex_near *= on_apex
        near_far *= on_far
        apex_near += near_far
        cosine = np.clip(apex_near, -_ONE, _ONE, out=apex_near)
        height = cosine - _ONE
        height *= y
        height += _ONE
        cosine_plus = np.maximum(cosine + _ONE, _TINY)
        share = height + _ONE
        share *= y
        share /= cosine_plus
        np.sqrt(share, out=share)
        on_apex *= share
        on_far *= share
        cosine *= share
        height -= cosine
        for k in range(3):
            near = np.where(is_second, self.near[1][k], self.near[0][k])
            np.multiply(near, height, out=out[k])
            out[k] += on_apex * self.apex[k]
            out[k] += on_far * self.far[k]
        # Rounding leaves 1e-3 where two corners are nearly opposite.
        length = np.sqrt(dot(out, out))
        np.maximum(length, _TINY, out=length)
        out /= length
        return out


class Warps:
    """The maps from the world to where GGX lobes have no peak: local frames, then the warps of `shading.lookup_table`
    with A, B and C = 1, the limit for alpha -> 0."""

    def __init__(self, rows: np.ndarray, cosine: np.ndarray, sine: np.ndarray, alpha: np.ndarray):
        """Local frames (3, 3, Q); cosine and sine of the view's angle from the normal, and alpha, (Q,)."""
        self.rows = rows
        self.xx = cosine * cosine + np.float32(WARP_REGULARIZATION**2) * alpha * alpha
        self.xz = np.sqrt(self.xx) * sine
        self.zz = 2.0 * alpha
        self.determinant = self.xx * self.zz

    def local(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Vectors (3, S, Q) along the local frames of those in the world."""
        return self._turned(vectors, self.rows, out)

    def world(self, vectors: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Vectors (3, S, Q) in the world of those in the local frames."""
        return self._turned(vectors, self.rows.transpose(1, 0, 2), out)

    def _turned(self, vectors, rows, out):
        out = np.empty_like(vectors) if out is None else out
        for k in range(3):
            np.multiply(vectors[0], rows[k, 0], out=out[k])
            out[k] += vectors[1] * rows[k, 1]
            out[k] += vectors[2] * rows[k, 2]
        return out

    def warped(self, local: np.ndarray) -> np.ndarray:
        """Vectors (3, S, Q) after the warp of those in the local frames."""
        return np.stack([self.xx * local[0] + self.xz * local[2], local[1], self.zz * local[2]])

    def lengths(self, local: np.ndarray) -> np.ndarray:
        """Lengths (S, Q) after the warp of unit vectors (3, S, Q) in the local frames."""
        warped = self.warped(local)
        warped *= warped
        return np.sqrt(warped[0] + warped[1] + warped[2])

    def unwarped(self, vectors: np.ndarray) -> np.ndarray:
        """Turn warped unit vectors (3, S, Q) into unit vectors in the local frames, and return their `lengths`."""
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
    """Cosine and sine (Q,) of the view's angle from the normal, both (3, Q), and local frames (3, 3, Q): rows tangent,
    bitangent, normal."""
    # The difference of vectors that are close is exact; a normal from single precision is not quite a unit vector.
    across = view - normal
    squared = dot(normal, normal)
    across -= dot(across, normal) / squared * normal
    sine = np.sqrt(dot(across, across))
    axis = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normal), axis=0)].T
    tangent = np.where(sine > 1e-6, across / np.maximum(sine, _TINY), axis)
    tangent -= dot(tangent, normal) / squared * normal
    tangent /= np.sqrt(dot(tangent, tangent))
    normal = normal / np.sqrt(squared)
    rows = np.stack([tangent, np.cross(normal, tangent, axis=0), normal])
    return np.clip(dot(normal, view), _ZERO, _ONE), sine, rows


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
