"""Facing lights, which look the same from every side: point lights, and spot lights with their cones.

A sphere is seen as the disk in its outline. From within a sphere, light comes from everywhere; a disk that almost fills
the half space over the lobe's normal stands for it. Cones and patterns make some places of a disk brighter than others:
`mean_emission` weights them by the lobe.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..lobes.brdf import ggx_distribution, masking
from ..lobes.polygon import dot, normal_frames

# Distance, in units of a sphere's radius, of the disk that stands for the half space seen from within.
NEAR_DISK = 1e-3
# Least share of the squared distance by which a point counts as outside a sphere.
LEAST_SHRINKING = 1e-6
# Least radius of a disk in units of its distance: in smaller ones too few digits of double precision tell edges apart.
LEAST_SIZE = 1e-5
# Squared radius in units of the squared distance below which single precision needs more care for the near side.
SMALL = 1e-4
# Shares of the brightest place of a disk. CHANGING: emission that varies by less takes a plain mean. STEP: emission
# that falls below counts as having a step.
CHANGING, STEP = 0.01, 0.1
# Orders of the quadrature rules on a disk: Chebyshev (second kind) along its first axis, Legendre across. The second
# rule is for emission that goes all the way from bright to dark on the disk, perhaps in a step. SPIRAL: points of the
# rule for patterns, whose steps go anywhere.
ORDERS, SPIRAL = ((16, 4), (64, 5)), 512
# The center of a disk, and points around it.
_RIM = np.array([[0.0, 1.0, -1.0, 0.0, 0.0, 0.7, -0.7, 0.7, -0.7], [0.0, 0.0, 0.0, 1.0, -1.0, 0.7, 0.7, -0.7, -0.7]])
NODES_CHUNK = 1 << 17
# Weight of the point nearest to the lobe's peak. It counts little for wide lobes, whose peak other points meet.
PEAK_WEIGHT = 1.0 / 400.0


def _disk_rule(along: int, across: int) -> tuple[np.ndarray, np.ndarray]:
    """Places (2, N) and weights (N,) of integrals over the unit disk; the weights add up to 1."""
    angle = np.pi * np.arange(1, along + 1) / (along + 1)
    nodes, weights = np.polynomial.legendre.leggauss(across)
    places = np.stack(np.broadcast_arrays(np.cos(angle)[:, None], np.sin(angle)[:, None] * nodes))
    whole = np.sin(angle)[:, None] ** 2 * weights / (along + 1)
    return places.reshape(2, -1), whole.ravel()


def _spiral(count: int) -> tuple[np.ndarray, np.ndarray]:
    """As `_disk_rule`, for points of equal weights along a sunflower's spiral (Vogel 1979)."""
    number = np.arange(count)
    radius, turn = np.sqrt((number + 0.5) / count), number * (np.pi * (3.0 - np.sqrt(5.0)))
    return radius * np.stack([np.cos(turn), np.sin(turn)]), np.full(count, 1.0 / count)


_RULES = [*(_disk_rule(*orders) for orders in ORDERS), _spiral(SPIRAL)]


@dataclass(frozen=True)
class FacingDisk:
    """The disks as which Q points see a facing light. Corners and half axes have the order of `Light.polygon`."""

    offset: np.ndarray  # (3, Q) from the points to the centers
    half_u: np.ndarray  # (3, Q)
    half_v: np.ndarray  # (3, Q)
    length: np.ndarray  # (Q,) of the offset
    radius: np.ndarray  # (Q,)
    gain: np.ndarray  # (Q,) factor of the radiance, below 1 for disks that are enlarged

    @classmethod
    def of(cls, light, offset: np.ndarray, normal: np.ndarray) -> "FacingDisk":
        """For points from which the center of `light` is at `offset` (3, Q). Their lobes have the `normal` (3, Q)."""
        radius = offset.dtype.type(np.sqrt((light.half_u**2).sum()))
        squared = dot(offset, offset)
        if light.is_sphere:
            inside = squared <= radius * radius
            shrinking = 1.0 - radius * radius / np.where(inside, radius * radius + 1.0, squared)
            shrinking = np.maximum(shrinking, offset.dtype.type(LEAST_SHRINKING))
            offset = offset * shrinking
            disk_radius = np.where(inside, radius, radius * np.sqrt(shrinking))
            distance = NEAR_DISK
        else:
            inside = squared <= 0.0
            disk_radius, distance = np.broadcast_to(radius, squared.shape), 1e-6
        if inside.any():
            offset = np.where(inside, offset.dtype.type(distance) * radius * normal, offset)
        length = np.sqrt(dot(offset, offset))
        gain = np.ones_like(length)
        tiny = disk_radius < LEAST_SIZE * length
        if tiny.any():
            gain = np.where(tiny, np.square(disk_radius / (LEAST_SIZE * length)), gain)
            disk_radius = np.where(tiny, LEAST_SIZE * length, disk_radius)
        half_u, half_v = (disk_radius * axis for axis in normal_frames(-offset / length)[:2])
        return cls(offset, half_u, half_v, length, disk_radius, gain)

    def take(self, index) -> "FacingDisk":
        """The disks of the points `index`."""
        return FacingDisk(*(values[..., index] for values in vars(self).values()))

    def along(self, cone) -> "FacingDisk":
        """The same disks turned so that the factor of `cone` changes most along u; unchanged without a cone."""
        if cone is None:
            return self
        axes = cone.axes.astype(self.offset.dtype)
        local = np.einsum("ij,jq->iq", axes, self.offset / self.length)
        rise = axes[2][:, None] * dot(local, local) - local[2] * np.einsum("ij,iq->jq", axes, local)
        s, t = dot(rise, self.half_u), dot(rise, self.half_v)
        size = np.sqrt(s * s + t * t)
        s, t = (np.where(size > 0.0, value / np.where(size > 0.0, size, 1.0), 1.0) for value in (s, t))
        return replace(self, half_u=s * self.half_u + t * self.half_v, half_v=s * self.half_v - t * self.half_u)

    def corners(self, outline: np.ndarray) -> np.ndarray:
        """Offsets (3, V, Q) from the points to places (2, V) of the disks, in units of the half axes."""
        s, t = outline.astype(self.offset.dtype)[:, :, None]
        return self.offset[:, None] + s * self.half_u[:, None] + t * self.half_v[:, None]

    @property
    def direction(self) -> np.ndarray:
        """Unit vectors (3, Q) to the side that shines."""
        return -self.offset / self.length


def cone_factor(light, directions: np.ndarray) -> np.ndarray:
    """The factor (...) of a spot's cone for light that arrives from `directions` (3, ...), of any length."""
    axes = light.cone.axes.astype(directions.dtype)
    x, y, z = (dot(row, directions) for row in axes)
    cosine = z / np.sqrt(np.maximum(x * x + y * y + z * z, np.finfo(directions.dtype).tiny))
    share = np.clip((cosine - light.cone.cosine) * light.cone.sharpness, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def cone_angle(cone) -> float:
    """Half the opening angle in rad of a cone, along its wider axis; an upper bound if its axes are not orthogonal."""
    angle = np.arccos(np.clip(cone.cosine, -1.0, 1.0))
    edge, axis = np.split(np.linalg.inv(cone.axes), [2], axis=1)
    along = axis.T @ edge / np.linalg.norm(axis)
    wide = np.linalg.norm(edge - axis / np.linalg.norm(axis) @ along, 2) * np.sin(angle)
    least = np.linalg.norm(axis) * np.cos(angle) - np.linalg.norm(along) * np.sin(angle)
    return float(np.arctan2(wide, least)) if least > -1e-9 * wide else np.pi


def may_reach(light, offset: np.ndarray) -> np.ndarray:
    """Mask (Q,): False for points that the cone surely misses. The center of the light is at `offset` (3, Q)."""
    if light.cone is None:
        return np.ones(offset.shape[1], bool)
    distance = np.sqrt(np.maximum(dot(offset, offset), np.finfo(offset.dtype).tiny))
    axis = np.linalg.solve(light.cone.axes, [0.0, 0.0, 1.0])
    axis /= np.sqrt((axis**2).sum())
    between = np.arccos(np.clip(dot(axis, offset) / distance, -1.0, 1.0))
    angular_radius = np.arcsin(np.minimum(light.radius / distance, 1.0))
    return (between < cone_angle(light.cone) + 1.001 * angular_radius + 1e-4) | (distance <= light.radius)


def ray_length(light, offset: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (...) of a light along unit `directions` (3, ...) that meet it; its center is at `offset` (3, ...)."""
    along = dot(offset, directions)
    squared = dot(offset, offset)
    # Directions that miss the light have no distance; give them one that can be squared.
    least = 1e-9 * np.sqrt(squared) + np.finfo(offset.dtype).tiny
    if not light.is_sphere:
        return squared / np.maximum(along, least)
    rest = light.radius**2 - squared
    if light.radius**2 < SMALL * squared.max(initial=0.0):
        across = offset - along * directions
        root = np.sqrt(np.maximum(light.radius**2 - dot(across, across), 0.0))
    else:
        root = np.sqrt(np.maximum(rest + along * along, 0.0))
    # The near side or, from within, the far one, computed without a difference of nearly equal numbers.
    return np.where(rest < 0.0, -rest / np.maximum(along + root, least), along + root)


def emission(light, offset: np.ndarray, directions: np.ndarray) -> np.ndarray | float:
    """Factor (...) of the radiance along unit `directions` (3, ...) that meet the light; 1.0 if it is 1 everywhere."""
    factor = 1.0
    if light.cone is not None:
        factor = cone_factor(light, directions)
        if light.is_sphere:
            factor = np.where(dot(offset, offset) <= light.radius**2, 1.0, factor)
    if light.has_falloff:
        squared = np.square(ray_length(light, offset, directions))
        factor = factor * (squared / (squared + light.smooth)) * squared ** (0.5 * light.falloff)
    if light.pattern is not None:
        factor = factor * pattern_values(light.pattern, _normals(light, offset, directions))
    return factor


def _normals(light, offset, directions):
    """Normals (3, ...) of the places on the light that unit `directions` (3, ...) meet."""
    if not light.is_sphere or light.pattern.by_ray:
        return -directions
    distance = np.sqrt(np.maximum(dot(offset, offset), np.finfo(offset.dtype).tiny))
    axis = offset / distance
    along = dot(directions, axis)
    across = directions - along * axis
    sine = np.sqrt(dot(across, across))
    # The law of sines gives the sine of the angle at the place between the point and the light's center.
    ratio = np.clip(sine * distance / np.maximum(light.radius, LEAST_SIZE * distance), 0.0, 1.0)
    root = np.sqrt(1.0 - ratio * ratio) * np.where(distance > light.radius, 1.0, -1.0)
    cosine, beside = root * along + ratio * sine, ratio * along - root * sine
    return across * (beside / np.maximum(sine, 1e-20)) - cosine * axis


def pattern_values(pattern, normals: np.ndarray) -> np.ndarray:
    """Values (...) of a pattern for normals (3, ...), by linear interpolation."""
    x, y, z = (dot(row, normals) for row in pattern.axes.astype(normals.dtype))
    rows, columns = pattern.values.shape
    row = (np.arctan2(np.sqrt(x * x + y * y), z) - pattern.start) * (rows / (np.pi - pattern.start)) - 0.5
    column = np.arctan2(y, x) * (0.5 * columns / np.pi) - 0.5
    first_row, first_column = np.floor(row), np.floor(column)
    down, right = row - first_row, column - first_column
    upper, lower = (np.clip(first_row + step, 0, rows - 1).astype(np.intp) for step in (0, 1))
    here, there = ((first_column + step).astype(np.intp) % columns for step in (0, 1))
    values = pattern.values
    above = values[upper, here] * (1.0 - right) + values[upper, there] * right
    below = values[lower, here] * (1.0 - right) + values[lower, there] * right
    return (above * (1.0 - down) + below * down).astype(normals.dtype)


def mean_emission(light, offset: np.ndarray, disk: FacingDisk, lobe: "AnalyticLobe") -> np.ndarray | float:
    """Mean factor (Q,) of the light's radiance for the lobes; 1.0 if it is 1 everywhere. The light's center is at
    `offset` (3, Q).

    Where the factor changes over the disk, this is its mean over points of the disk, weighted by the values of the
    lobe.
    """
    if light.is_uniform:
        return 1.0

    def factors(places, points):
        directions = disk.take(points).along(light.cone).corners(places)
        lengths = np.sqrt(dot(directions, directions))
        directions /= lengths
        center_offset = np.broadcast_to(offset[:, None, points], directions.shape)
        return emission(light, center_offset, directions), directions, lengths

    few = factors(_RIM, slice(None))[0]
    least, most = few.min(axis=0), few.max(axis=0)
    # The center stands for half of the disk's area, the points around it for the other half: right for smooth changes.
    result = 0.5 * few[0] + 0.5 * few[1:].mean(axis=0)
    chosen = np.where(least < STEP * most, 1, 0) if light.pattern is None else 2
    rule = np.where(most - least > CHANGING * most, chosen, -1)
    for points, (places, shares) in _parts(rule):
        values, directions, lengths = factors(places, points)
        lobes = lobe.take(points)
        weights = lobes.values(directions) / lengths**3 * shares.astype(lengths.dtype)[:, None]
        peak = lobes.peak(disk.take(points))
        length = np.sqrt(dot(peak, peak))
        toward_peak = peak / length
        at_peak = emission(light, offset[:, points], toward_peak)
        weight = PEAK_WEIGHT * lobes.values(toward_peak[:, None])[0] / length**3
        weight *= lobes.view is not None
        whole = weights.sum(axis=0) + weight
        lit = whole > 0.0
        mean = ((weights * values).sum(axis=0) + weight * at_peak) / np.where(lit, whole, 1.0)
        result[points] = np.where(lit, mean, values.mean(axis=0))
    return result


def _parts(rule):
    """Yield (index, rule): the points for which each rule is chosen, in chunks."""
    for number, (places, shares) in enumerate(_RULES):
        chosen = np.nonzero(rule == number)[0]
        step = NODES_CHUNK // len(shares)
        for start in range(0, len(chosen), step):
            yield chosen[start : start + step], (places, shares)


@dataclass(frozen=True)
class AnalyticLobe:
    """Lobes of Q samples: diffuse, or GGX if there are a view and alpha."""

    normal: np.ndarray  # (3, Q)
    view: np.ndarray | None = None  # (3, Q)
    alpha: np.ndarray | None = None  # (Q,)

    def take(self, index) -> "AnalyticLobe":
        """The lobes of the samples `index`."""
        return AnalyticLobe(*(None if values is None else values[..., index] for values in vars(self).values()))

    def values(self, directions: np.ndarray) -> np.ndarray:
        """BRDF times cosine (S, Q) of white lobes, for unit directions (3, S, Q)."""
        normal = self.normal[:, None]
        cosine = np.maximum(dot(normal, directions), 0.0)
        if self.view is None:
            return cosine * (1.0 / np.pi)
        half = directions + self.view[:, None]
        # Cross products keep the digits that matter to sharp lobes; a difference would lose them.
        across = [normal[a] * half[b] - normal[b] * half[a] for a, b in ((0, 1), (1, 2), (2, 0))]
        vertical, squared = np.square(dot(normal, half)), self.alpha * self.alpha
        distribution = ggx_distribution(dot(across, across), vertical, squared)
        facing = np.maximum(dot(self.normal, self.view), 0.0)
        return distribution * cosine / np.maximum(2.0 * masking(facing, cosine, squared), 1e-30)

    def peak(self, disk: FacingDisk) -> np.ndarray:
        """The points (3, Q) of disks nearest to the lobe's peak."""
        if self.view is None:
            return disk.offset
        mirrored = 2.0 * dot(self.normal, self.view) * self.normal - self.view
        along = dot(mirrored, disk.offset)
        ahead = along > 1e-3 * disk.length
        hit = mirrored * (disk.length * disk.length / np.where(ahead, along, 1.0)) - disk.offset
        squared = disk.radius * disk.radius
        s, t = (np.where(ahead, dot(hit, half) / squared, 0.0) for half in (disk.half_u, disk.half_v))
        beyond = np.maximum(np.sqrt(s * s + t * t), 1.0)
        return disk.offset + s / beyond * disk.half_u + t / beyond * disk.half_v
