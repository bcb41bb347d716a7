"""Lights with a spread or a falloff: integrals over the light times a profile, as integrals over parts of the light.

With the distance d of the point from the light's plane and r the distance in that plane from the foot of the point,
the factors of `AreaLight` are a profile p(r): that of the spread is (R - r)+ / (d (tan h - h)), R = d tan h and h half
the spread; that of the falloff is a function of t = sqrt(d^2 + r^2). Integration by parts makes of any lobe integral
over the light one over disks around the foot,

    int f p = p(r_1) J(r_1) - int_0^r_1 p'(rho) J(rho) drho,   J(rho) = int of f over the part with r < rho,

where J is 0 up to the least distance in the light, and r_1 is the largest, or R where that is less and p(R) = 0. Closed
forms give J; the integral over rho takes a Gauss-Legendre rule whose nodes are dense where the lobe meets the light,
for a sharp lobe makes J a step there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from .polygon import dot

# Half angle in rad below which Cycles takes the series of tan h - h.
_SERIES = 0.05
WIDTH_RANGE = (1e-4, 1e3)
# A round light is a polygon of the same area, whose corners stand out a little.
ROUND_MARGIN = 1.02


def cone(spread: float) -> tuple[float, float]:
    """tan h, and tan h - h by which the factor is divided."""
    half = 0.5 * spread
    tangent = float(np.tan(half))
    return tangent, half**3 / 3.0 if half <= _SERIES else tangent - half


# In place of tan h and tan h - h of a light without a spread: its factor is 1 up to far beyond any light.
_WIDE_OPEN = 1e15
# In m^2: squares in single precision do not become 0.
_TINY = 1e-30


@dataclass(frozen=True)
class Profile:
    """By what the radiance of a light is multiplied; all methods take arrays that broadcast."""

    tangent: float
    share: float
    falloff: int
    smooth: float

    @classmethod
    def of(cls, light) -> Profile:
        """That of `light`."""
        tangent, share = cone(light.spread) if light.is_focused else (_WIDE_OPEN, _WIDE_OPEN)
        return cls(tangent, share, light.falloff, light.smooth)

    def at(self, radius, distance):
        """The factor at `radius` from the foot of a point that is at `distance` from the plane of the light."""
        return self._spread(radius / distance) * self._falloff(distance * distance + radius * radius)

    def range(self, nearest, farthest, distance):
        """The least and the greatest factor where the radius is from `nearest` to `farthest`."""
        squared = distance * distance
        return tuple(
            self._spread(shaded / distance) * self._falloff(squared + faded * faded)
            for shaded, faded in ((farthest, nearest), (nearest, farthest))
        )

    def descent(self, radius, distance):
        """By how much the factor sinks per `radius`, inside of the cone."""
        squared = np.maximum(distance * distance + radius * radius, _TINY)
        share = self.falloff / squared
        if self.smooth > 0.0:
            share = share + 2.0 * self.smooth / (squared * (self.smooth + squared))
        rise = self._spread(radius / distance) * radius * share
        return self._falloff(squared) * (1.0 / (self.share * distance) - rise)

    def _spread(self, tangent):
        return np.maximum((self.tangent - tangent) / self.share, 0.0)

    def _falloff(self, squared):
        factor = squared / (squared + self.smooth) if self.smooth > 0.0 else 1.0
        return factor * (1.0, np.sqrt(squared), squared)[self.falloff]


def peak_factor(spread: float) -> float:
    """The factor straight ahead of the light, its largest value."""
    tangent, share = cone(spread)
    return tangent / share


def plane_axes(light) -> np.ndarray:
    """Two orthonormal axes (2, 3) in the plane of the light, the first along half_u."""
    first = light.half_u / np.sqrt((light.half_u**2).sum())
    return np.stack([first, np.cross(light.direction, first)])


@dataclass(frozen=True)
class Effort:
    """Layers per cone, and chords per arc of a layer, 2 or more."""

    layers: int
    chords: int


# Well inside the cone, and far away, the profile hardly varies over a light. Sharp lobes see the difference of chords
# from a circle.
EFFORTS = (Effort(5, 2), Effort(8, 2), Effort(8, 4), Effort(8, 12))
WELL_INSIDE = 0.25
WIDE_LOBE, SHARP_LOBE = 0.09, 0.01


def efforts(light, position, width):
    """Yield (effort, chosen (Q',)) that keep the error of the profile at about 0.3 % for points with x, y, z in
    `position` (3, Q), all in double precision, with lobes that are `width` (Q,) or a number of radians wide."""
    extent, reach, beside = _place_in_cone(light, position)
    length = reach - beside
    if light.has_falloff:
        length = np.minimum(length, np.sqrt(sum((position[axis] - light.center[axis]) ** 2 for axis in range(3))))
    inside = extent < WELL_INSIDE * length
    number = np.where(width >= WIDE_LOBE, np.where(inside, 0, 1), np.where(inside, 0, 2))
    number = np.where(width < SHARP_LOBE, 3, number)
    for chosen in np.unique(number):
        yield EFFORTS[chosen], np.nonzero(number == chosen)[0]


def may_reach(light, position) -> np.ndarray:
    """Mask (Q,): False for points with x, y, z in `position` (3, Q) that no part of the light shines on."""
    extent, reach, beside = _place_in_cone(light, position)
    return (reach > 0.0) & (beside < reach + extent)


def _place_in_cone(light, position):
    """How far the light extends from its center, and for points (3, Q) the radius of their cones in the light's plane
    and the distance of the center from the cone's axis."""
    offset = [position[axis] - light.center[axis] for axis in range(3)]
    distance = sum(offset[axis] * light.direction[axis] for axis in range(3))
    beside = np.sqrt(np.maximum(sum(component * component for component in offset) - distance * distance, 0.0))
    extent = ROUND_MARGIN * np.sqrt((light.half_u**2).sum() + (light.half_v**2).sum())
    return extent, Profile.of(light).tangent * distance, beside


@dataclass(frozen=True)
class LightView:
    """A light seen from points: where the points lie, and the light's plane in their coordinates."""

    distance: np.ndarray  # (P,) from the plane
    center: np.ndarray  # (2, P) of the light, from the foot along `plane_axes`
    extent: tuple[float, float]  # of the light along the axes
    foot: np.ndarray  # (C, P) in the coordinates of the integrals; in the first three a lobe is some radian wide
    axis_u: np.ndarray  # (C, P)
    axis_v: np.ndarray  # (C, P)

    @classmethod
    def of(cls, light, offset, along) -> LightView:
        """From the offsets (3, P) of the light's center, and along(vector (3,)) -> (C, P), its coordinates."""
        axes = plane_axes(light)
        distance = -dot(offset, light.direction.astype(offset.dtype))
        center = np.stack([dot(offset, axis) for axis in axes.astype(offset.dtype)])
        extent = tuple(float(np.sqrt((half**2).sum())) for half in (light.half_u, light.half_v))
        foot = -distance * along(light.direction)
        return cls(distance, center, extent, foot, along(axes[0]), along(axes[1]))

    def take(self, index) -> LightView:
        """The view of the points at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        columns = (self.foot[:, index], self.axis_u[:, index], self.axis_v[:, index])
        return LightView(self.distance[index], self.center[:, index], self.extent, *columns)

    def corners(self, flat: np.ndarray) -> np.ndarray:
        """Coordinates (C, V, P) of points (2, V, P) of the plane."""
        return self.foot[:, None] + flat[0] * self.axis_u[:, None] + flat[1] * self.axis_v[:, None]

    def peak(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where the axis e_z meets the plane: (2, P), its height (P,), the mask (P,) of points for which it does, and
        the determinant (P,) of the plane's axes seen along it."""
        foot, u, v = self.foot, self.axis_u, self.axis_v
        determinant = u[0] * v[1] - v[0] * u[1]
        size = np.sqrt((u[:3] * u[:3]).sum(axis=0) * (v[:3] * v[:3]).sum(axis=0))
        seen = np.abs(determinant) > 1e-6 * size
        determinant = np.where(seen, determinant, 1.0)
        peak = np.stack([v[0] * foot[1] - v[1] * foot[0], u[1] * foot[0] - u[0] * foot[1]]) / determinant
        height = foot[2] + peak[0] * u[2] + peak[1] * v[2]
        return peak, height, seen & (height > 0.0), determinant

    def lobe_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance (P,) from the foot at which a lobe around e_z meets the light best, and how far (P,) it reaches
        there: infinitely where it does not face the light's plane."""
        u, v = self.axis_u, self.axis_v
        peak, height, seen, determinant = self.peak()
        extent = np.array(self.extent, dtype=peak.dtype)[:, None]
        nearest = self.center + np.clip(peak - self.center, -extent, extent)
        off = peak - nearest
        distance = np.sqrt(_dot(nearest, nearest))
        toward = nearest / np.where(distance > 0.0, distance, 1.0)
        # Of a lobe with the covariance (A^T A)^-1 the width along a unit vector e is |A^-T e|.
        across = v[1] * toward[0] - u[1] * toward[1], u[0] * toward[1] - v[0] * toward[0]
        width = height / determinant
        width = np.sqrt(width * width * _dot(across, across) + _dot(off, off))
        return np.where(seen, distance, 0.0), np.where(seen, width, np.inf)


def layers(view: LightView, flat: np.ndarray, profile: Profile, effort: Effort):
    """Yield (index (Q,), weights (Q,), corners (C, W, Q)): lobe integrals over the corners times the weights add up to
    the integral over the convex part `flat` (2, V, P) of the light times its profile. The polygons grow.
    """
    part = DiskParts(flat)
    reach = profile.tangent * view.distance
    index = np.nonzero(part.least < reach)[0]
    if len(index) == 0:
        return
    if len(index) < flat.shape[2]:
        part, view, reach = DiskParts(flat[:, :, index]), view.take(index), reach[index]
    nodes, weights = _graded_nodes(part.least, np.minimum(part.largest, reach), *view.lobe_range(), effort.layers)
    for radius, weight in zip(nodes, weights, strict=True):
        weight = weight * profile.descent(radius, view.distance)
        yield index, weight, view.corners(part.inside(radius, effort.chords))
    whole = np.nonzero(part.largest < reach)[0]
    if len(whole):
        weight = profile.at(part.largest[whole], view.distance[whole])
        yield index[whole], weight, view.take(whole).corners(part.flat[:, :, whole])


class DiskParts:
    """Convex polygons (2, V, P) in a light's plane, and their parts in disks around the origin, the foot of a point."""

    def __init__(self, flat: np.ndarray):
        self.flat = flat
        following = np.roll(flat, -1, axis=1)
        self.along = following - flat
        squared = _dot(self.along, self.along)
        self.squared = np.where(squared > 0.0, squared, 1.0)
        self.side = _cross(flat, following)
        self.middle = -_dot(flat, self.along)
        nearest = flat + np.clip(self.middle / self.squared, 0.0, 1.0) * self.along
        square = _dot(nearest, nearest)
        closest = square.argmin(axis=0)
        self.size = np.sqrt(_dot(flat, flat))
        self.largest = self.size.max(axis=0)
        self.encloses = self._encloses(squared)
        length = np.sqrt(np.take_along_axis(square, closest[None], axis=0)[0])
        self.least = np.where(self.encloses, 0.0, length)
        # Seen from a foot outside, all lies within a quarter turn of the nearest point.
        forward = np.take_along_axis(nearest, closest[None, None], axis=1)[:, 0]
        forward = forward / np.where(length > 0.0, length, 1.0)
        forward[0] += length == 0.0
        self.forward = forward
        self.angle = self._angle(flat)

    def _encloses(self, squared):
        """Mask (P,): is the foot inside? Edges between corners that rounding alone tells apart have no sides."""
        short = squared <= np.finfo(self.flat.dtype).eps * self.largest**2
        left, right = (((way * self.side >= 0.0) | short).all(axis=0) for way in (1.0, -1.0))
        return (left | right) & ~short.all(axis=0)

    def _angle(self, points):
        return np.arctan2(_cross(self.forward, points), _dot(self.forward, points))

    def inside(self, radius: np.ndarray, chords: int) -> np.ndarray:
        """The parts (2, V (2 chords + 1), P) inside the disks of `radius` (P,), their boundaries in order.

        What lies outside is drawn to the circle along radii: the winding numbers inside stay. Of every edge the arc up
        to where it enters the disk, the part inside, and the arc after it remain; an arc becomes `chords` chords that
        enclose its area.
        """
        reach = np.maximum(self.squared * radius * radius - self.side * self.side, 0.0)
        root = np.sqrt(reach)
        first, last = (np.clip((self.middle + way) / self.squared, 0.0, 1.0) for way in (-root, root))
        entry, leave = (self._angle(self.flat + share * self.along) for share in (first, last))
        lowest, highest = self._seen_from_foot(entry, leave, last > first)
        angles = [np.clip(values, lowest, highest) for values in (self.angle, entry, leave, np.roll(self.angle, -1, 0))]
        size = np.minimum(self.size, radius)
        points = [
            *self._arc(angles[0], angles[1], size, chords),
            *self._arc(angles[2], angles[3], np.roll(size, -1, axis=0), chords)[:-1],
        ]
        return np.stack(points, axis=2).reshape(2, -1, self.flat.shape[2])

    def _seen_from_foot(self, entry, leave, meets):
        """Bounds (P,) of the angles at which the parts are seen. Arcs beyond would cancel, but for their chords."""
        ends = np.stack([entry, leave])
        lowest = np.where(meets, ends, np.pi).min(axis=(0, 1))
        highest = np.where(meets, ends, -np.pi).max(axis=(0, 1))
        return np.where(self.encloses, -4.0, lowest), np.where(self.encloses, 4.0, np.maximum(lowest, highest))

    def _arc(self, start, end, size, chords):
        """Corners (2, V, P), chords + 1 of them, from angle to angle (V, P) at the distance `size` (V, P)."""
        turn = end - start
        turn -= np.where(np.abs(turn) > np.pi, np.copysign(2.0 * np.pi, turn), 0.0).astype(turn.dtype)
        step = turn / chords
        cosine, sine = np.cos(step), np.sin(step)
        # The corners between the ends lie so far out that the chords enclose the area of the arc.
        total = chords * np.where(sine == 0.0, 1.0, step / np.where(sine == 0.0, 1.0, sine))
        out = 0.5 * total if chords == 2 else (np.sqrt(1.0 + (chords - 2) * total) - 1.0) / (chords - 2)
        x, y = np.cos(start), np.sin(start)
        corners = [self._turned(x * size, y * size)]
        size_between = size * out
        for number in range(1, chords + 1):
            x, y = cosine * x - sine * y, sine * x + cosine * y
            distance = size if number == chords else size_between
            corners.append(self._turned(x * distance, y * distance))
        return corners

    def _turned(self, x, y):
        """Points (2, V, P) with the coordinates x, y along `forward` and across it."""
        return np.stack([self.forward[0] * x - self.forward[1] * y, self.forward[0] * y + self.forward[1] * x])


def _graded_nodes(low, high, center, width, count):
    """Nodes and weights (count, P) of an integral over [low, high], dense within `width` of `center`; all (P,)."""
    nodes, weights = (values.astype(low.dtype)[:, None] for values in gauss_legendre(count))
    span = high - low
    center = np.clip(center, low, high)
    width = np.clip(width, WIDTH_RANGE[0] * span, WIDTH_RANGE[1] * span)
    safe = np.where(width > 0.0, width, 1.0)
    first, last = (np.arcsinh((end - center) / safe) for end in (low, high))
    half = 0.5 * (last - first)
    place = 0.5 * (first + last) + half * nodes
    return center + width * np.sinh(place), weights * half * width * np.cosh(place)


@cache
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights (count,) on [-1, 1]."""
    return np.polynomial.legendre.leggauss(count)


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1]


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]
