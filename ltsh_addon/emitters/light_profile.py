"""Lights with a spread or a falloff: integrals over the light times a profile.

There are two methods. In double precision, `layers` integrates over parts of the light. In single precision,
`profile_regions` sums over points of the light wherever few of them suffice, at a tenth to a hundredth of the cost.

Let d be the distance of the shading point from the light's plane, and r the distance in that plane from the foot of
the point. The factors of a `FlatLight` are a profile p(r). The profile of a spread is (R - r)+ / (d (tan h - h)), where
R = d tan h and h is half the spread. The profile of a falloff is a function of t = sqrt(d^2 + r^2). Integration by
parts turns any lobe integral over the light into one over disks around the foot,

    int f p = p(r_1) J(r_1) - int_0^r_1 p'(rho) J(rho) drho,   J(rho) = int of f over the part with r < rho.

J is 0 up to the least distance in the light. r_1 is the largest distance, or R if that is less; p(R) = 0. Closed forms
give J. A Gauss-Legendre rule integrates over rho; its nodes are dense where the lobe meets the light, because a sharp
lobe makes J a step there.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ..lobes.polygon import dot

# Half angle in rad up to which Cycles takes the series of tan h - h.
_SERIES = 0.05
# Least and greatest width of a lobe, in units of the interval over which it is integrated.
WIDTH_RANGE = (1e-4, 1e3)
# A polygon of the same area replaces a round light. Its corners reach beyond the light by at most this factor.
ROUND_MARGIN = 1.02


def spread_tangent(spread: float) -> tuple[float, float]:
    """tan h, and tan h - h, the divisor of the factor, where h is half the `spread` in rad."""
    half = 0.5 * spread
    tangent = float(np.tan(half))
    return tangent, half**3 / 3.0 if half <= _SERIES else tangent - half


# Stands for tan h and for tan h - h of a light without a spread: its factor is then 1 up to far beyond any light.
WIDE_OPEN = 1e15
# Least squared length in m^2: it is still above 0 in single precision.
TINY = 1e-30
# A light counts as sheared if the cosine between its half axes is above this, more than rounding makes of right angles.
SHEAR = 1e-6


@dataclass(frozen=True)
class Profile:
    """The factor by which the radiance of a light is multiplied. All methods take arrays that broadcast."""

    tangent: float
    share: float
    falloff: int
    smooth: float

    @classmethod
    def of(cls, light) -> "Profile":
        """The profile of `light`."""
        tangent, share = spread_tangent(light.spread) if light.has_spread else (WIDE_OPEN, WIDE_OPEN)
        return cls(tangent, share, light.falloff, light.smooth)

    def at(self, radius, distance):
        """The factor at `radius` from the foot of a point whose distance from the light's plane is `distance`."""
        return self._spread(radius / distance) * self._falloff(distance * distance + radius * radius)

    def range(self, nearest, farthest, distance):
        """The least and the greatest factor for radii from `nearest` to `farthest`."""
        squared = distance * distance
        return tuple(
            self._spread(shaded / distance) * self._falloff(squared + faded * faded)
            for shaded, faded in ((farthest, nearest), (nearest, farthest))
        )

    def descent(self, radius, distance):
        """The negative derivative of the factor by `radius`, inside the cone."""
        squared = np.maximum(distance * distance + radius * radius, TINY)
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


def plane_axes(light) -> np.ndarray:
    """Two orthonormal axes (2, 3) in the plane of the light, the first along half_u."""
    first = light.half_u / np.sqrt((light.half_u**2).sum())
    return np.stack([first, np.cross(light.direction, first)])


@dataclass(frozen=True)
class DiskLayers:
    """Number of disks around the foot over which integrals run, and of chords per arc of a disk; at least 2 chords."""

    layers: int
    chords: int


# From the cheapest to the most accurate. The profile hardly varies over a light that is well inside the cone or far
# away. Sharp lobes see the difference between chords and a circle.
DISK_LAYERS = (DiskLayers(5, 2), DiskLayers(8, 2), DiskLayers(8, 4), DiskLayers(8, 12))
# Largest extent of a light well inside the cone, as a share of its distance from the cone's edge or from the point.
WELL_INSIDE = 0.25
# Widths in rad from which on a lobe is wide, and below which it is sharp.
WIDE_LOBE, SHARP_LOBE = 0.09, 0.01


def disk_layers(light, position, width):
    """Yield (disks, chosen (Q',)) for points with x, y, z in `position` (3, Q): `chosen` are the numbers of the points
    that need these `DiskLayers` for a profile error of about 0.3 %. Their lobes are `width` (Q,) or a number of radians
    wide. All arrays are in double precision."""
    extent, reach, beside = _place_in_cone(light, position)
    length = reach - beside
    if light.has_falloff:
        length = np.minimum(length, np.sqrt(sum((position[axis] - light.center[axis]) ** 2 for axis in range(3))))
    inside = extent < WELL_INSIDE * length
    number = np.where(width >= WIDE_LOBE, np.where(inside, 0, 1), np.where(inside, 0, 2))
    number = np.where(width < SHARP_LOBE, 3, number)
    for chosen in np.unique(number):
        yield DISK_LAYERS[chosen], np.nonzero(number == chosen)[0]


def may_reach(light, position) -> np.ndarray:
    """Mask (Q,): False for points with x, y, z in `position` (3, Q) that no part of the light shines on."""
    extent, reach, beside = _place_in_cone(light, position)
    return (reach > 0.0) & (beside < reach + extent)


def _place_in_cone(light, position):
    """How far the light extends from its center; for points (3, Q), the radius (Q,) of the cone in the light's plane
    and the distance (Q,) of the light's center from the cone's axis."""
    offset = [position[axis] - light.center[axis] for axis in range(3)]
    distance = sum(offset[axis] * light.direction[axis] for axis in range(3))
    beside = np.sqrt(np.maximum(sum(component * component for component in offset) - distance * distance, 0.0))
    extent = ROUND_MARGIN * np.sqrt((light.half_u**2).sum() + (light.half_v**2).sum())
    return extent, Profile.of(light).tangent * distance, beside


@dataclass(frozen=True)
class LightView:
    """A light seen from points: where the points lie, and the light's plane in the coordinates of the integrals."""

    distance: np.ndarray  # (P,) of the points from the plane
    center: np.ndarray  # (2, P) of the light, relative to the foot, along `plane_axes`
    extent: tuple[float, float]  # lengths of the light's half axes
    foot: np.ndarray  # (C, P) in the coordinates of the integrals; in the first three, lobes are about a radian wide
    axis_u: np.ndarray  # (C, P) the first of `plane_axes` in these coordinates
    axis_v: np.ndarray  # (C, P) the second

    @classmethod
    def of(cls, light, offset, along) -> "LightView":
        """The view from points at which the light's center has the offsets (3, P). along(vector (3,)) -> (C, P) returns
        the coordinates of a vector."""
        axes = plane_axes(light)
        distance = -dot(offset, light.direction.astype(offset.dtype))
        center = np.stack([dot(offset, axis) for axis in axes.astype(offset.dtype)])
        extent = tuple(float(np.sqrt((half**2).sum())) for half in (light.half_u, light.half_v))
        foot = -distance * along(light.direction)
        return cls(distance, center, extent, foot, along(axes[0]), along(axes[1]))

    def take(self, index) -> "LightView":
        """The view of the points at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        columns = (self.foot[:, index], self.axis_u[:, index], self.axis_v[:, index])
        return LightView(self.distance[index], self.center[:, index], self.extent, *columns)

    def corners(self, flat: np.ndarray) -> np.ndarray:
        """Coordinates (C, V, P) of points `flat` (2, V, P) of the plane."""
        return self.foot[:, None] + flat[0] * self.axis_u[:, None] + flat[1] * self.axis_v[:, None]

    def peak(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where the lobe's axis e_z meets the plane: place (2, P), height (P,), mask (P,) of the points for which it
        does, and determinant (P,) of the plane's axes seen along e_z."""
        foot, u, v = self.foot, self.axis_u, self.axis_v
        determinant = u[0] * v[1] - v[0] * u[1]
        size = np.sqrt((u[:3] * u[:3]).sum(axis=0) * (v[:3] * v[:3]).sum(axis=0))
        meets = np.abs(determinant) > 1e-6 * size
        determinant = np.where(meets, determinant, 1.0)
        peak = np.stack([v[0] * foot[1] - v[1] * foot[0], u[1] * foot[0] - u[0] * foot[1]]) / determinant
        height = foot[2] + peak[0] * u[2] + peak[1] * v[2]
        return peak, height, meets & (height > 0.0), determinant

    def lobe_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance (P,) from the foot at which a lobe around e_z meets the light best, and the lobe's width (P,) there;
        the width is infinite if the lobe does not face the light's plane."""
        u, v = self.axis_u, self.axis_v
        peak, height, meets, determinant = self.peak()
        extent = np.array(self.extent, dtype=peak.dtype)[:, None]
        nearest = self.center + np.clip(peak - self.center, -extent, extent)
        off = peak - nearest
        distance = np.sqrt(dot2(nearest, nearest))
        toward = nearest / np.where(distance > 0.0, distance, 1.0)
        # A lobe with the covariance (A^T A)^-1 has the width |A^-T e| along a unit vector e.
        across = v[1] * toward[0] - u[1] * toward[1], u[0] * toward[1] - v[0] * toward[0]
        width = height / determinant
        width = np.sqrt(width * width * dot2(across, across) + dot2(off, off))
        return np.where(meets, distance, 0.0), np.where(meets, width, np.inf)


def layers(view: LightView, flat: np.ndarray, profile: Profile, disks: DiskLayers):
    """Yield (index (Q,), weights (Q,), corners (C, W, Q)) from the innermost polygon to the outermost. The lobe
    integrals over these polygons, times the weights, add up to the integral over the convex part `flat` (2, V, P) of
    the light times its profile.
    """
    polygon = PolygonInDisks(flat)
    reach = profile.tangent * view.distance
    index = np.nonzero(polygon.least < reach)[0]
    if len(index) == 0:
        return
    if len(index) < flat.shape[2]:
        polygon, view, reach = PolygonInDisks(flat[:, :, index]), view.take(index), reach[index]
    nodes, weights = _graded_nodes(polygon.least, np.minimum(polygon.largest, reach), *view.lobe_range(), disks.layers)
    for radius, weight in zip(nodes, weights, strict=True):
        weight = weight * profile.descent(radius, view.distance)
        yield index, weight, view.corners(polygon.inside(radius, disks.chords))
    whole = np.nonzero(polygon.largest < reach)[0]
    if len(whole):
        weight = profile.at(polygon.largest[whole], view.distance[whole])
        yield index[whole], weight, view.take(whole).corners(polygon.flat[:, :, whole])


class PolygonInDisks:
    """Convex polygons (2, V, P) in a light's plane, and their parts in disks around the origin, the foot of a point."""

    def __init__(self, flat: np.ndarray):
        self.flat = flat
        following = np.roll(flat, -1, axis=1)
        self.along = following - flat
        squared = dot2(self.along, self.along)
        self.squared = np.where(squared > 0.0, squared, 1.0)
        self.side = cross2(flat, following)
        self.middle = -dot2(flat, self.along)
        nearest = flat + np.clip(self.middle / self.squared, 0.0, 1.0) * self.along
        square = dot2(nearest, nearest)
        closest = square.argmin(axis=0)
        self.size = np.sqrt(dot2(flat, flat))
        self.largest = self.size.max(axis=0)
        self.encloses = self._encloses(squared)
        length = np.sqrt(np.take_along_axis(square, closest[None], axis=0)[0])
        self.least = np.where(self.encloses, 0.0, length)
        # From a foot outside, the whole polygon lies within a quarter turn of the direction to its nearest point.
        forward = np.take_along_axis(nearest, closest[None, None], axis=1)[:, 0]
        forward = forward / np.where(length > 0.0, length, 1.0)
        forward[0] += length == 0.0
        self.forward = forward
        self.angle = self._angle(flat)

    def _encloses(self, squared):
        """Mask (P,): is the foot inside? Edges no longer than rounding errors have no sides and are skipped."""
        short = squared <= np.finfo(self.flat.dtype).eps * self.largest**2
        is_counterclockwise, is_clockwise = (((way * self.side >= 0.0) | short).all(axis=0) for way in (1.0, -1.0))
        return (is_counterclockwise | is_clockwise) & ~short.all(axis=0)

    def _angle(self, points):
        return np.arctan2(cross2(self.forward, points), dot2(self.forward, points))

    def inside(self, radius: np.ndarray, chords: int) -> np.ndarray:
        """The parts (2, V (2 chords + 1), P) inside the disks of `radius` (P,), as corners in the order of their edges.

        What lies outside is moved to the circle along radii, which keeps the winding numbers inside. Each edge leaves
        the arc up to where it enters the disk, its part inside, and the arc after it. An arc becomes `chords` chords
        that enclose its area.
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
        """Bounds (P,) of the angles at which the parts are seen. Arcs beyond these would cancel, their chords not."""
        ends = np.stack([entry, leave])
        lowest = np.where(meets, ends, np.pi).min(axis=(0, 1))
        highest = np.where(meets, ends, -np.pi).max(axis=(0, 1))
        return np.where(self.encloses, -4.0, lowest), np.where(self.encloses, 4.0, np.maximum(lowest, highest))

    def _arc(self, start, end, size, chords):
        """Corners of arcs, chords + 1 arrays (2, V, P) from angle `start` to `end` (V, P) at distance `size` (V, P)."""
        turn = end - start
        turn -= np.where(np.abs(turn) > np.pi, np.copysign(2.0 * np.pi, turn), 0.0).astype(turn.dtype)
        step = turn / chords
        cosine, sine = np.cos(step), np.sin(step)
        # The inner corners lie outside the circle, so far that the chords enclose the area of the arc.
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
        """Points (2, V, P) whose coordinates along `forward` and across it are x and y."""
        return np.stack([self.forward[0] * x - self.forward[1] * y, self.forward[0] * y + self.forward[1] * x])


def _graded_nodes(low, high, center, width, count):
    """Nodes and weights (count, P) of an integral over [low, high]. The nodes are dense within `width` of `center`; all
    arguments are (P,)."""
    nodes, weights = (values.astype(low.dtype)[:, None] for values in gauss_legendre(count))
    span = high - low
    center = np.clip(center, low, high)
    width = np.clip(width, WIDTH_RANGE[0] * span, WIDTH_RANGE[1] * span)
    safe = np.where(width > 0.0, width, 1.0)
    first, last = (np.arcsinh((end - center) / safe) for end in (low, high))
    half = 0.5 * (last - first)
    argument = 0.5 * (first + last) + half * nodes
    return center + width * np.sinh(argument), weights * half * width * np.cosh(argument)


@cache
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights (count,) on [-1, 1]."""
    return np.polynomial.legendre.leggauss(count)


def dot2(a, b):
    """Dot products (...) of vectors (2, ...)."""
    return a[0] * b[0] + a[1] * b[1]


def cross2(a, b):
    """The z (...) of the cross products of vectors (2, ...)."""
    return a[0] * b[1] - a[1] * b[0]
