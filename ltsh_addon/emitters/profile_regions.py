"""Lights with a spread or a falloff in single precision: sums over points of the light times its profile.

A point sees a region of the light: the part in the cone of its spread and above the horizons. Rules of a few points
suffice for most regions, at a tenth to a hundredth of the cost of `light_profile.layers`.
"""

import numpy as np

from ..lobes.polygon import dot
from ..scene import EllipseLight, QuadLight
from .light_profile import SHEAR, TINY, WIDE_OPEN, LightView, Profile, cross2, dot2, gauss_legendre

# Least width of a peak in m.
TINY_WIDTH = 1e-9
# Kinds of quadrature rules. EVEN: points on chords of the light. SPLIT: like EVEN, with separate points on either side
# of the foot. WHOLE_CONE: points on rays from the foot, for cones that lie in the light. GRADED: points that are dense
# where the lobe peaks. Each is accurate to 0.3 % except at 1 in 100 places, mostly at faint edges.
EVEN, SPLIT, WHOLE_CONE, GRADED = range(4)
# SIZES: size of the visible region in units of its distance, in the coordinates in which lobes are a radian wide.
# POINTS, ROUND_POINTS: points per axis up to each of SIZES and beyond; 0 stands for `layers` instead.
SIZES = (0.2, 0.4, 0.6)
POINTS, ROUND_POINTS = np.array([3, 4, 6, 0]), np.array([5, 6, 8, 0])
# RANGES: half the range of arsinh(place / width of the peak). GRADED_POINTS: points per axis of GRADED for these.
RANGES = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
GRADED_POINTS, ROUND_GRADED_POINTS = np.array([8, 8, 12, 14, 14, 20, 0]), np.array([10, 12, 14, 20, 0, 0, 0])
# The tip of the profile needs more points where the foot is in the visible region, or closer to it than its size.
# TIP_SIZES: that size in units of the cone's radius. TIP_POINTS: least points per axis for these, even numbers.
TIP_SIZES = (0.15, 0.5)
TIP_POINTS, ROUND_TIP_POINTS = np.array([0, 6, 10]), np.array([0, 8, 16])
# A light is long if its longer side is more than this many times the other.
LONG = 2.0
# Radii of WHOLE_CONE up to each of SIZES; there are twice as many angles.
RADII = np.array([3, 4, 5])


class ProfileRegions:
    """The region of a light that each point sees: the part in its cone and above its horizons, where the profile is
    not 0.

    The foot of the point plus s `along_s` plus t `along_t` is a point of the light's plane. The region consists of the
    chords along t for every s in [low, high]. The light is a rectangle or an ellipse, see `suit`.
    """

    def __init__(self, light, view: LightView, horizons):
        """horizons: numbers of the coordinates of `view` that are positive above a horizon."""
        self.view, self.profile, self.is_round, self.horizons = view, Profile.of(light), light.is_round, horizons
        dtype = view.distance.dtype.type
        u, v = view.extent
        self.is_long = max(u, v) > LONG * min(u, v)
        self.extent = dtype(u), dtype(v)
        self.reach = np.minimum(dtype(self.profile.tangent) * view.distance, dtype(WIDE_OPEN))
        e, f = self.turn = self._turns(dtype)
        self.along_s = e * view.axis_u + f * view.axis_v
        self.along_t = e * view.axis_v - f * view.axis_u
        self.center = np.stack([dot2(self.turn, view.center), cross2(self.turn, view.center)])
        self._bound(*self.extent)

    @staticmethod
    def suit(light) -> bool:
        """Whether the light is a rectangle, or an ellipse given by its principal axes, but for rounding."""
        u, v = light.half_u, light.half_v
        is_square = abs(u @ v) <= SHEAR * np.linalg.norm(u) * np.linalg.norm(v)
        return isinstance(light, (QuadLight, EllipseLight)) and is_square

    def _turns(self, dtype):
        """Unit vectors (2, P) along s. They follow the longer side of a long light. For other round lights they point
        away from the foot, which makes the cone's chords symmetric; for other rectangles they follow the side that
        horizons cut less."""
        view = self.view
        u, v = self.extent
        if self.is_long:
            across = np.full(len(view.distance), v > u)
            return np.stack([~across, across]).astype(dtype)
        if self.is_round:
            length = np.sqrt(dot2(view.center, view.center))
            is_off = length > 0.0
            turn = view.center / np.where(is_off, length, dtype(1.0))
            turn[0] += ~is_off
            return turn
        row = self.horizons[0]
        across = np.abs(view.axis_u[row]) * dtype(u) > np.abs(view.axis_v[row]) * dtype(v)
        return np.stack([~across, across]).astype(dtype)

    def _bound(self, u, v):
        """Set the bounds (P,) of s, `low` and `high`, and those of t for any s, `lowest` and `highest`."""
        (s, t), reach, (e, f) = self.center, self.reach, self.turn
        half_s, half_t = (np.sqrt((u * along_u) ** 2 + (v * along_v) ** 2) for along_u, along_v in ((e, f), (f, e)))
        if self.is_round:
            self.half = half_s
            self.shear = (v * v - u * u) * e * f / (half_s * half_s)
            self.chord = u * v / half_s
        off_s, off_t = (np.maximum(np.abs(middle) - half, 0.0) for middle, half in ((s, half_s), (t, half_t)))
        reach_s, reach_t = (np.sqrt(np.maximum((reach - off) * (reach + off), 0.0)) for off in (off_t, off_s))
        low, high = np.maximum(s - half_s, -reach_s), np.minimum(s + half_s, reach_s)
        self.lowest, self.highest = np.maximum(t - half_t, -reach_t), np.minimum(t + half_t, reach_t)
        if self.is_round:
            self.is_whole_cone = np.sqrt(s * s + t * t) + reach < min(u, v)
        else:
            self.is_whole_cone = (np.abs(s) + reach < half_s) & (np.abs(t) + reach < half_t)
        for row in self.horizons:
            along, across = self.along_s[row], self.along_t[row]
            best = self.view.foot[row] + np.maximum(across * self.lowest, across * self.highest)
            self.is_whole_cone &= self.view.foot[row] > reach * np.sqrt(along * along + across * across)
            flat = along == 0.0
            root = -best / np.where(flat, 1.0, along)
            low = np.where(along > 0.0, np.maximum(low, root), low)
            high = np.where(along < 0.0, np.minimum(high, root), high)
            high = np.where(flat & (best <= 0.0), low, high)
        self.low, self.high = low, high

    def rules(self):
        """Yield (points per axis, kind, index (Q,)): which rule suits which points. 0 points per axis means that no
        such rule suffices. Points that are missing see nothing of the light."""
        half_s, half_t = 0.5 * (self.high - self.low), 0.5 * (self.highest - self.lowest)
        visible = np.nonzero((half_s > 0.0) & (half_t > 0.0) & (self.view.distance > 0.0))[0]
        half_s, half_t, reach = half_s[visible], half_t[visible], self.reach[visible]
        middle_s, middle_t = 0.5 * (self.high + self.low)[visible], 0.5 * (self.highest + self.lowest)[visible]
        foot, along_s, along_t = self._axes(visible)
        middle = foot + middle_s * along_s + middle_t * along_t
        squares = dot(along_s, along_s) * half_s * half_s + dot(along_t, along_t) * half_t * half_t
        size = np.sqrt(squares / np.maximum(dot(middle, middle), TINY))
        level = np.searchsorted(SIZES, size)
        number = (ROUND_POINTS if self.is_round else POINTS)[level]
        kind = np.full(len(visible), EVEN)
        whole = self.is_whole_cone[visible] & (number > 0)
        kind[whole] = WHOLE_CONE
        large = np.nonzero(level == len(SIZES))[0]
        kind[large] = GRADED
        graded = ROUND_GRADED_POINTS if self.is_round else GRADED_POINTS
        number[large] = graded[np.searchsorted(RANGES, self._ranges(visible[large]))]
        extent = np.sqrt(half_s * half_s + half_t * half_t)
        near = (np.abs(middle_s) < half_s + extent) & (np.abs(middle_t) < half_t + extent)
        tip = np.searchsorted(TIP_SIZES, np.where(near, extent / reach, 0.0))
        tip = (ROUND_TIP_POINTS if self.is_round else TIP_POINTS)[tip]
        if self.is_long:
            tip = np.where(tip > 0, ROUND_TIP_POINTS[-1], 0)
        number = np.where(number > 0, np.maximum(number, tip), 0)
        if self.is_long or not self.is_round:
            kind[(tip >= TIP_POINTS[-1]) & (kind == EVEN)] = SPLIT
        number[whole] = RADII[level[whole]]
        for key in np.unique(4 * number + kind):
            yield int(key // 4), int(key % 4), visible[4 * number + kind == key]

    def _axes(self, index):
        """`foot`, `along_s` and `along_t` (3, Q) of the points `index` (Q,), in the coordinates of their lobes."""
        return self.view.foot[:3, index], self.along_s[:3, index], self.along_t[:3, index]

    def _ranges(self, index):
        """Half the range (Q,) of the nodes of graded rules, see RANGES."""
        axes = self._axes(index)
        line = _nearest_line(*axes)
        low, high = self.low[index], self.high[index]
        point = _nearest_point(*axes, np.clip(line[0], low, high))
        ranges = _pole_range(low, high, line), _pole_range(self.lowest[index], self.highest[index], point)
        return 0.5 * np.maximum(*(last - first for first, last in ranges))

    def points(self, count, kind, index):
        """Rule (s, t, weights) for integrals over the regions `index` (Q,) times the profile. The arrays broadcast to
        (S, T, Q)."""
        dtype = self.reach.dtype
        nodes, weights = (values.astype(dtype)[:, None] for values in gauss_legendre(count))
        reach, distance = self.reach[index], self.view.distance[index]
        if kind == WHOLE_CONE:
            angles = np.pi / count * (np.arange(2 * count) + 0.5)
            radius = (0.5 * reach) * (1.0 + nodes)
            weights = weights * radius * self.profile.at(radius, distance) * (0.5 * reach) * dtype.type(np.pi / count)
            cosine, sine = (values.astype(dtype)[:, None] for values in (np.cos(angles), np.sin(angles)))
            return radius[:, None] * cosine, radius[:, None] * sine, weights[:, None]
        weights_s, places = weights, nodes
        if kind == SPLIT:
            places, weights_s = (values.astype(dtype)[:, None] for values in gauss_legendre(count // 2))
        if self.is_round:
            # Near its ends a chord's length grows as a square root of s; with these nodes it grows linearly.
            places, weights_s = 0.5 * places * (3.0 - places * places), weights_s * (1.5 - 1.5 * places * places)
        low, high = self.low[index], self.high[index]
        axes = self._axes(index)
        if kind == SPLIT:
            middle = np.clip(dtype.type(0.0), low, high)
            sides = (_spaced(places, *ends, None) for ends in ((low, middle), (middle, high)))
            s, weights_s = (
                np.concatenate(values) for values in zip(*((at, weights_s * by) for at, by in sides), strict=True)
            )
        else:
            s, stretch = _spaced(places, low, high, _nearest_line(*axes) if kind == GRADED else None)
            weights_s = weights_s * stretch
        low, high = self._chords(s, index)
        pole = None
        if kind == GRADED:
            pole = _nearest_point(*axes, s)
            pole = pole[0][:, None], pole[1][:, None]
        t, stretch = _spaced(nodes, low[:, None], high[:, None], pole)
        s = s[:, None]
        profile = self.profile.at(np.sqrt(s * s + t * t), distance)
        profile *= weights_s[:, None] * weights
        profile *= stretch
        return s, t, profile

    def _chords(self, s, index):
        """Ends (S, Q) of the chords at `s` (S, Q) of the regions `index` (Q,)."""
        reach = self.reach[index]
        half = np.sqrt(np.maximum((reach - s) * (reach + s), 0.0))
        low, high = np.maximum(self.lowest[index], -half), np.minimum(self.highest[index], half)
        if self.is_round:
            off = s - self.center[0, index]
            middle = self.center[1, index] + self.shear[index] * off
            off = off / self.half[index]
            half = self.chord[index] * np.sqrt(np.maximum(1.0 - off * off, 0.0))
            low, high = np.maximum(low, middle - half), np.minimum(high, middle + half)
        for row in self.horizons:
            across = self.along_t[row, index]
            height = self.view.foot[row, index] + self.along_s[row, index] * s
            root = -height / np.where(across == 0.0, 1.0, across)
            low = np.where(across > 0.0, np.maximum(low, root), low)
            high = np.where(across < 0.0, np.minimum(high, root), high)
            high = np.where((across == 0.0) & (height <= 0.0), low, high)
        return low, np.maximum(high, low)

    def coordinates(self, s, t, index):
        """Coordinates (C, S, T, Q) of the points s, t of the light's plane, for the shading points `index` (Q,)."""
        result = np.empty((len(self.along_s), *np.broadcast_shapes(s.shape, t.shape)), s.dtype)
        for out, foot, along_s, along_t in zip(result, self.view.foot, self.along_s, self.along_t, strict=True):
            np.multiply(along_t[index], t, out=out)
            out += foot[index] + along_s[index] * s
        return result


def _spaced(nodes, low, high, pole):
    """Places on [low, high] (..., P) of nodes on [-1, 1], and their derivatives by the nodes. With a `pole`, a pair of
    a center and a width, they are dense around it; without one they are evenly stretched."""
    if pole is None:
        half = 0.5 * (high - low)
        return 0.5 * (low + high) + half * nodes, half
    center, width = pole
    first, last = _pole_range(low, high, pole)
    half = 0.5 * (last - first)
    argument = 0.5 * (first + last) + half * nodes
    # Rounding must not move a place beyond the ends.
    return np.clip(center + width * np.sinh(argument), low, high), half * width * np.cosh(argument)


def _pole_range(low, high, pole):
    center, width = pole
    return tuple(np.arcsinh((end - center) / width) for end in (low, high))


def _nearest_point(foot, along_s, along_t, s):
    """The t (..., P) at which the line of each s (..., P) comes closest to the origin, and its distance there, in units
    of t."""
    squared = dot(along_t, along_t)
    t = -(dot(along_t, foot) + dot(along_t, along_s) * s) / squared
    off = [foot[axis] + s * along_s[axis] + t * along_t[axis] for axis in range(3)]
    return t, np.maximum(np.sqrt(dot(off, off) / squared), TINY_WIDTH)


def _nearest_line(foot, along_s, along_t):
    """The s (P,) of the line along t that comes closest to the origin, and the distance of that line, in units of s."""
    along_t = along_t / np.sqrt(dot(along_t, along_t))
    foot, along_s = (vector - dot(vector, along_t) * along_t for vector in (foot, along_s))
    squared = np.maximum(dot(along_s, along_s), TINY)
    s = -dot(foot, along_s) / squared
    off = foot + s * along_s
    return s, np.maximum(np.sqrt(dot(off, off) / squared), TINY_WIDTH)
