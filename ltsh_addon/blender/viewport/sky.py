"""The world in a view: its light, and the background behind the surfaces.

Pictures of all directions are octahedral maps: an octahedron around the eye, unfolded onto a square. Its upper half is
the inner square, which is turned by 45 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ...cycles.environment import CUBE, SkyPicture, sky_lights
from ...scene import Light

# Texels of a side of maps. SIZE, LEAST_SIZE: the largest and the smallest map of the light. IRRADIANCE_SIZE: the map of
# the irradiance. IRRADIANCE_SOURCE: the map of the light from which the irradiance is computed.
SIZE, LEAST_SIZE, IRRADIANCE_SIZE, IRRADIANCE_SOURCE = 256, 4, 32, 64
LEVELS = (SIZE // LEAST_SIZE).bit_length()
POINTS = 16  # directions in which a lobe samples the map
MOST_PATCHES = 1536  # of all sides together, for shadows
# CUBE_SIZE: pixels of a side of the cube's pictures, enough for the light. BACKGROUND_SIZE: of the largest background.
CUBE_SIZE, BACKGROUND_SIZE = 128, 2048


@dataclass(frozen=True)
class ShownSky:
    """A world as a view shows it."""

    sides: tuple[Light, ...] = ()  # of a cube around all points, for shadows; empty for a dark world
    lights: tuple[Light, ...] = ()  # the small bright lights in it
    # (N, N, 3) map of the light without these lights; N = 1: constant.
    light: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3)))
    background: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3)))  # (N, N, 3) map as cameras see it


def constant_sky(like: Light | None, radiance: np.ndarray, background: np.ndarray) -> ShownSky:
    """A world that is the same in all directions. `like` has the name and traits of its light; None: it is dark."""
    picture = np.array(radiance, np.float64).reshape(1, 1, 3)
    sides = [] if like is None else sky_lights(like, [SkyPicture(*axes, picture) for axes in CUBE])[0]
    shown = np.array(background, np.float64).reshape(1, 1, 3)
    return ShownSky(tuple(sides), (), picture if sides else np.zeros((1, 1, 3)), shown)


def varied_sky(like: Light | None, light, lights, background: np.ndarray) -> ShownSky:
    """A world from a cube of coarse pictures of its `light`, the small bright `lights` that these leave out, and the
    map `background` (N, N, 3)."""
    sides = () if like is None else tuple(sky_lights(like, light, MOST_PATCHES)[0])
    if not sides:
        return ShownSky(lights=tuple(lights), background=background)
    return ShownSky(sides, tuple(lights), unfolded(light, SIZE), background)


def background_of(pictures: list[SkyPicture]) -> np.ndarray:
    """The map (N, N, 3) of a background from the pictures of a cube."""
    return unfolded(pictures, min(2 * len(pictures[0].radiance), BACKGROUND_SIZE))


def coarse(picture: SkyPicture) -> SkyPicture:
    """The picture, reduced to at most `CUBE_SIZE` pixels along each side."""
    while len(picture.radiance) > CUBE_SIZE:
        weight = picture.solid_angles()[..., None]
        picture = replace(picture, radiance=_summed(picture.radiance * weight) / _summed(weight))
    return picture


def _summed(values: np.ndarray) -> np.ndarray:
    """Sums over blocks of 2 x 2."""
    rows = values[0::2] + values[1::2]
    return rows[:, 0::2] + rows[:, 1::2]


def directions(size: int) -> np.ndarray:
    """Unit directions (N, N, 3) of the texels of a map with N = `size` texels along each side, row 0 at v = -1."""
    coordinate = (np.arange(size) + 0.5) * (2.0 / size) - 1.0
    u, v = np.meshgrid(coordinate, coordinate)
    height = 1.0 - np.abs(u) - np.abs(v)
    below = height < 0.0
    x = np.where(below, (1.0 - np.abs(v)) * np.where(u < 0.0, -1.0, 1.0), u)
    y = np.where(below, (1.0 - np.abs(u)) * np.where(v < 0.0, -1.0, 1.0), v)
    toward = np.stack([x, y, height], axis=-1)
    return toward / np.linalg.norm(toward, axis=-1, keepdims=True)


def solid_angles(size: int) -> np.ndarray:
    """Approximate solid angles (N, N) in sr of the texels of `directions`."""
    return (2.0 / size) ** 2 * np.abs(directions(size)).sum(axis=-1) ** 3


def unfolded(pictures: list[SkyPicture], size: int) -> np.ndarray:
    """The map (size, size, 3) interpolated from the six pictures of a cube."""
    toward = directions(size).reshape(-1, 3)
    radiance = np.zeros((len(toward), 3))
    side = np.argmax(np.stack([toward @ picture.ahead for picture in pictures]), axis=0)
    for number, picture in enumerate(pictures):
        texels = np.flatnonzero(side == number)
        along = toward[texels] @ picture.ahead
        count = len(picture.radiance)
        column, row = (
            np.clip(
                (sign * (toward[texels] @ axis) / (axis @ axis) / along + 1.0) * 0.5 * count - 0.5, 0.0, count - 1.0
            )
            for sign, axis in ((1.0, picture.right), (-1.0, picture.up))
        )
        radiance[texels] = _interpolated(picture.radiance, row, column)
    return radiance.reshape(size, size, 3)


def _interpolated(values: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    top, west = row.astype(int), column.astype(int)
    down, east = np.minimum(top + 1, len(values) - 1), np.minimum(west + 1, values.shape[1] - 1)
    y, x = (row - top)[:, None], (column - west)[:, None]
    above = (1.0 - x) * values[top, west] + x * values[top, east]
    below = (1.0 - x) * values[down, west] + x * values[down, east]
    return (1.0 - y) * above + y * below


def halved(picture: np.ndarray) -> np.ndarray:
    """Means over blocks of 2 x 2 texels, weighted by their solid angles."""
    weight = solid_angles(len(picture))[..., None]
    return _summed(picture * weight) / _summed(weight)


def mean_of(picture: np.ndarray) -> np.ndarray:
    """The mean (3,) of a map over all directions."""
    return np.average(picture.reshape(-1, 3), axis=0, weights=solid_angles(len(picture)).ravel())


def irradiance(picture: np.ndarray, size: int) -> np.ndarray:
    """Irradiance divided by pi, (size, size, 3), of surfaces whose normals are the directions of the texels."""
    toward, weight = directions(len(picture)).reshape(-1, 3), solid_angles(len(picture)).ravel()
    mean = mean_of(picture)
    cosines = np.maximum(directions(size).reshape(-1, 3) @ toward.T, 0.0)
    # Only differences from the mean are summed: a world that is the same everywhere then has no error.
    rest = (picture.reshape(-1, 3) - mean) * weight[:, None] / np.pi
    return np.maximum(mean + cosines @ rest, 0.0).reshape(size, size, 3)


def with_border(picture: np.ndarray) -> np.ndarray:
    """The map with one more texel on each side, from beyond the fold."""
    wide = np.concatenate([picture[:1, ::-1], picture, picture[-1:, ::-1]])
    return np.concatenate([wide[::-1, :1], wide, wide[::-1, -1:]], axis=1)


def sky_texels(sky: ShownSky) -> np.ndarray:
    """Texels (H, W, 4) of the light of `sky`.

    Texel 0 of the first row: mean radiance, w = 1 if the light is not constant. Texel 1: whether glossy lobes and
    diffuse lobes see the light. The next rows are maps with borders, absent for constant light: the largest with the
    smaller ones beside it, then the irradiance divided by pi.
    """
    traits = sky.sides[0]
    header = np.zeros((1, 2, 4))
    header[0, 1, :2] = traits.affects_specular, traits.affects_diffuse
    header[0, 0, :3] = mean_of(sky.light)
    if len(sky.light) == 1:
        return header
    header[0, 0, 3] = 1.0
    texels = np.zeros((SIZE + 3 + IRRADIANCE_SIZE + 2, SIZE + SIZE // 2 + 4, 4))
    texels[:1, :2] = header
    picture, row, sources = sky.light, 1, {}
    for level in range(LEVELS):
        sources[len(picture)] = picture
        wide = with_border(picture)
        column = 0 if level == 0 else SIZE + 2
        texels[row : row + len(wide), column : column + len(wide), :3] = wide
        row += len(wide) if level else 0
        picture = halved(picture)
    wide = with_border(irradiance(sources[IRRADIANCE_SOURCE], IRRADIANCE_SIZE))
    texels[SIZE + 3 : SIZE + 3 + len(wide), : len(wide), :3] = wide
    return texels


def background_texels(sky: ShownSky) -> np.ndarray:
    """Texels (N + 2, N + 2, 4) of the background, with a border."""
    wide = with_border(sky.background)
    return np.concatenate([wide, np.ones((*wide.shape[:2], 1))], axis=-1)
