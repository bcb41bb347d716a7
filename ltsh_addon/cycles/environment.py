"""Light from all directions, given by square pictures, as distant lights. Needs no bpy.

Six pictures make up the cube around a sample. Each becomes a `SkyLight` with its mean radiance. Its `children`
are a tree of parts, each with its own mean; parts like their whole are not cut further. Something as small
and bright as the sun becomes a light of its own, and the pictures keep the rest.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..scene import Light, SunLight

# Axes (ahead, right, up) of the pictures of a cube; right and up are half a side long.
CUBE = tuple(
    (np.array(ahead, float), np.array(right, float), np.array(up, float))
    for ahead, right, up in (
        ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
        ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, -1, 0), (-1, 0, 0), (0, 0, 1)),
        ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
        ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
    )
)
# Mean absolute difference between the smallest patches and the picture, relative to the mean radiance, at which cutting
# stops.
ERROR = 0.02
# Most patches of all pictures together.
MOST_PATCHES = 6144
# A patch and its parts are at most this many halvings of both sides apart.
LEVELS = 2
# A spot is brighter than the mean by SPOT_BRIGHTNESS, has at least the share SPOT_SHARE of the light, and fits into the
# angle SPOT_RADIUS in rad.
SPOT_BRIGHTNESS, SPOT_SHARE, SPOT_RADIUS = 100.0, 0.01, 0.06
# A sky is smooth if it differs from itself blurred by squares of DETAIL_ANGLE, in rad, by at most the share SMOOTH_SKY.
DETAIL_ANGLE, SMOOTH_SKY = 0.1, 0.01
# MOST_SPOTS: most spots of a sky. SPOT_PATCHES: most patches of a spot that is no disk.
MOST_SPOTS, SPOT_PATCHES = 8, 40
# A spot becomes a disk of constant radiance if the disk misses at most this share of its light.
DISK_ERROR = 0.25


@dataclass(frozen=True)
class SkyPicture:
    """Radiance (N, N, 3) from the directions ahead + s right + t up for s and t in [-1, 1]; row 0 is at t = 1."""

    ahead: np.ndarray  # (3,) unit
    right: np.ndarray  # (3,)
    up: np.ndarray  # (3,)
    radiance: np.ndarray

    def offsets(self) -> np.ndarray:
        """Directions (N, N, 3) of the pixels' centers, not unit."""
        count = len(self.radiance)
        coordinate = (np.arange(count) + 0.5) * (2.0 / count) - 1.0
        return self.ahead + coordinate[None, :, None] * self.right - coordinate[:, None, None] * self.up

    def solid_angles(self) -> np.ndarray:
        """Solid angles (N, N) of the pixels in sr."""
        offsets = self.offsets()
        area = 4.0 * np.linalg.norm(self.right) * np.linalg.norm(self.up) / len(self.radiance) ** 2
        return area * np.square(offsets).sum(axis=-1) ** -1.5


@dataclass(frozen=True)
class Spot:
    """A small bright part of a sky. What exceeds the radiance `least` within `radius` belongs to it."""

    direction: np.ndarray  # (3,) unit, to its center
    radius: float  # rad
    least: float  # mean of the three colors


def mean_magnitude(radiance: np.ndarray) -> np.ndarray:
    """Mean absolute value (...) of colors (..., 3)."""
    return np.abs(radiance).mean(axis=-1)


def above(radiance: np.ndarray, least: float) -> np.ndarray:
    """The part of colors (..., 3) of a mean magnitude above `least`."""
    brightness = mean_magnitude(radiance)
    return radiance * np.maximum(1.0 - least / np.maximum(brightness, 1e-30), 0.0)[..., None]


def bright_spots(pictures: list[SkyPicture]) -> list[Spot]:
    """The spots in the pictures of a cube; the first has the most light."""
    values = np.concatenate([mean_magnitude(picture.radiance).ravel() for picture in pictures])
    angles = np.concatenate([picture.solid_angles().ravel() for picture in pictures])
    power = values * angles
    least, total = SPOT_BRIGHTNESS * power.sum() / angles.sum(), power.sum()
    index = np.flatnonzero(values > least)
    if len(index) == 0:
        return []
    offsets = np.concatenate([picture.offsets().reshape(-1, 3) for picture in pictures])[index]
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True)
    power, pixel = power[index], np.sqrt(angles.max())
    spots = []
    while len(power) and len(spots) < MOST_SPOTS:
        center = offsets[np.argmax(power)]
        for _ in range(3):
            near = np.linalg.norm(offsets - center, axis=1) < SPOT_RADIUS
            center = power[near] @ offsets[near]
            center /= np.linalg.norm(center)
        near = np.linalg.norm(offsets - center, axis=1) < SPOT_RADIUS
        if not near.any() or power[near].sum() < SPOT_SHARE * total:
            break
        radius = np.linalg.norm(offsets[near] - center, axis=1).max() + 1.5 * pixel
        spots.append(Spot(center, float(radius), float(least)))
        offsets, power = offsets[~near], power[~near]
    return spots


def fine_detail(pictures: list[SkyPicture]) -> float:
    """The mean absolute difference of pictures from themselves, blurred by squares of DETAIL_ANGLE; relative to their
    mean. It is near 0 for gradients, however steep."""
    difference = total = 0.0
    for picture in pictures:
        light = mean_magnitude(picture.radiance)
        half = int(len(light) * DETAIL_ANGLE / np.pi)
        sums = np.pad(light, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        side = 2 * half + 1
        blurred = (sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]) / side**2
        inner = light[half : len(light) - half, half : len(light) - half]
        difference, total = difference + np.abs(inner - blurred).sum(), total + inner.sum()
    return difference / total if total > 0.0 else 0.0


def spot_frame(spot: Spot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ahead, right and up of a picture that shows the whole spot."""
    axis = np.eye(3)[np.argmin(np.abs(spot.direction))]
    right = np.cross(spot.direction, axis)
    right *= np.tan(spot.radius) / np.linalg.norm(right)
    return spot.direction, right, np.cross(right, spot.direction)


def without_spots(picture: SkyPicture, spots: list[Spot]) -> SkyPicture:
    """The picture without `spots`: where a spot is, radiance is cut off at its `least`."""
    radiance = picture.radiance
    offsets = picture.offsets()
    for spot in spots:
        ahead, right, up = spot_frame(spot)
        along = offsets @ ahead
        with np.errstate(divide="ignore", invalid="ignore"):
            places = [np.abs(offsets @ axis / along) / (axis @ axis) for axis in (right, up)]
        inside = (along > 0.0) & (np.maximum(*places) < 1.0)
        radiance = radiance - np.where(inside[..., None], above(radiance, spot.least), 0.0)
    return replace(picture, radiance=radiance)


def spot_light(like: Light, picture: SkyPicture, spot: Spot) -> list[Light]:
    """The spot that a close `picture` shows, as lights with the name and traits of `like`: a disk if it looks like one,
    otherwise patches; [] if the picture shows no spot."""
    radiance, angles = above(picture.radiance, spot.least), picture.solid_angles()
    values = mean_magnitude(radiance)
    power = (values * angles).sum()
    if power <= 0.0:
        return []
    # The edge of the sun is dark: only what is brighter than a fourth of the mean counts for the size.
    mean = (values * values * angles).sum() / power
    solid_angle = min(angles[values > 0.25 * mean].sum(), np.pi)
    offsets = picture.offsets()
    offsets /= np.linalg.norm(offsets, axis=-1, keepdims=True)
    center = ((values * angles)[..., None] * offsets).sum(axis=(0, 1))
    center /= np.linalg.norm(center)
    radius = np.arccos(1.0 - solid_angle / (2.0 * np.pi))
    inside = np.linalg.norm(offsets - center, axis=-1) < 2.0 * np.sin(0.5 * radius)
    light = (radiance * angles[..., None]).sum(axis=(0, 1)) / solid_angle
    missed = (np.abs(values - inside * mean_magnitude(light)) * angles).sum()
    if missed > DISK_ERROR * power:
        return sky_lights(like, [replace(picture, radiance=radiance)], SPOT_PATCHES)[0]
    _, right, up = spot_frame(replace(spot, direction=center, radius=radius))
    return [SunLight.like(like, center=center, half_u=right, half_v=up, direction=-center, radiance=light)]


def sky_lights(like: Light, pictures: list[SkyPicture], most: int = MOST_PATCHES) -> tuple[list[Light], float]:
    """A distant light for each picture that is not dark, with the name and traits of `like`; and the mean absolute
    difference between the smallest patches and the pictures, relative to the mean radiance.

    All lights have `children`, or none if all pictures are constant: a map of the sky should not end at one of them.
    """
    trees = [_SkyQuadtree.of(picture) for picture in pictures]
    total = sum((mean_magnitude(picture.radiance) * picture.solid_angles()).sum() for picture in pictures)
    limit, error = _limit(trees, ERROR * total, most)
    if any(tree.errors[0] > limit for tree in trees):
        trees = [replace(tree, errors=[np.full((1, 1), np.inf), *tree.errors[1:]]) for tree in trees]
    bright = [
        _light(like, picture, tree, limit, (0, 0, 0))
        for picture, tree in zip(pictures, trees, strict=True) if np.any(picture.radiance)
    ]  # fmt: skip
    return bright, error / total if total > 0.0 else 0.0


@dataclass(frozen=True)
class _SkyQuadtree:
    """Squares of a picture by level: level k has 2^k along each side."""

    means: list[np.ndarray]  # (2^k, 2^k, 3) radiance
    errors: list[np.ndarray]  # (2^k, 2^k) about the mean absolute difference from the mean, times solid angle

    @classmethod
    def of(cls, picture: SkyPicture) -> "_SkyQuadtree":
        """For a picture whose side is a power of two pixels."""
        weight = picture.solid_angles()
        light, squares = picture.radiance * weight[..., None], np.square(picture.radiance).mean(axis=-1) * weight
        means, errors = [], []
        while True:
            mean = light / weight[..., None]
            variance = np.maximum(squares / weight - np.square(mean).mean(axis=-1), 0.0)
            means.append(mean)
            # The mean absolute difference is about this factor smaller than the standard deviation.
            errors.append(0.8 * weight * np.sqrt(variance))
            if len(weight) == 1:
                break
            light, squares, weight = (summed(values) for values in (light, squares, weight))
        errors[0][:] = 0.0
        return cls(means[::-1], errors[::-1])


def summed(values):
    """Sums over squares of 2 x 2."""
    rows = values[0::2] + values[1::2]
    return rows[:, 0::2] + rows[:, 1::2]


def _leaves(trees, limit: float) -> tuple[int, float]:
    """Number of squares, and their total error, if those with an error above `limit` are cut."""
    count, error = 0, 0.0
    for tree in trees:
        exists = np.ones((1, 1), bool)
        for level, errors in enumerate(tree.errors):
            cut = exists & (errors > limit) if level + 1 < len(tree.errors) else np.zeros_like(exists)
            leaf = exists & ~cut
            count += np.count_nonzero(leaf)
            error += errors[leaf].sum()
            if not cut.any():
                break
            exists = np.repeat(np.repeat(cut, 2, axis=0), 2, axis=1)
    return count, float(error)


def _limit(trees, wanted: float, most: int) -> tuple[float, float]:
    """The largest error of a square at which the total error is `wanted`, or at which there are `most` squares; and the
    total error."""
    low, high = 0.0, max(float(errors.max()) for tree in trees for errors in tree.errors)
    if high <= wanted * 1e-6 or high == 0.0:
        return high, _leaves(trees, high)[1]
    # At 0 all squares are cut; at `high` none is.
    low = high * 1e-9
    for _ in range(40):
        middle = np.sqrt(low * high)
        count, error = _leaves(trees, middle)
        low, high = (middle, high) if error <= wanted or count > most else (low, middle)
    count, error = _leaves(trees, low)
    limit = low if count <= most else high
    return limit, _leaves(trees, limit)[1]


def _light(like: Light, picture: SkyPicture, tree: _SkyQuadtree, limit: float, square) -> Light:
    """The square `square` (level, row, column) of a picture as a light; its parts are the detail."""
    level, row, column = square
    size = 2.0**-level
    across, upward = (2 * column + 1) * size - 1.0, 1.0 - (2 * row + 1) * size
    parts = _leaves_below(tree, limit, square)
    return replace(
        like,
        center=picture.ahead + across * picture.right + upward * picture.up,
        half_u=size * picture.right,
        half_v=size * picture.up,
        direction=-picture.ahead / np.linalg.norm(picture.ahead),
        radiance=tree.means[level][row, column],
        children=tuple(_light(like, picture, tree, limit, smaller) for smaller in parts) if len(parts) > 1 else (),
    )


def _leaves_below(tree: _SkyQuadtree, limit: float, square) -> list:
    squares = [square]
    for _ in range(LEVELS):
        cut = []
        for level, row, column in squares:
            is_last = level + 1 == len(tree.errors)
            if is_last or level >= square[0] + LEVELS or tree.errors[level][row, column] <= limit:
                cut.append((level, row, column))
                continue
            cut += [(level + 1, 2 * row + i, 2 * column + j) for i in (0, 1) for j in (0, 1)]
        squares = cut
    return squares
