"""Textures of the example scene, computed with numpy. Row 0 is the bottom row, as in Blender's images.

`floor_textures` gives what makes the reflections of lights break up from tile to tile, `quilted_normals` the padded
wall, `screen_picture` and `side_art` the pictures on the cabinets.
"""

from __future__ import annotations

import numpy as np

GLOSSIEST, ROUGHEST = 0.12, 0.55  # roughness of the floor: the best polished tile, the joints

SPRITES = {
    "moth": (
        "..#......#..",
        "#..#....#..#",
        "##.######.##",
        "############",
        "##..####..##",
        ".##########.",
        "...#.##.#...",
        "..##....##..",
    ),
    "crab": (
        "..#....#..",
        ".##....##.",
        "#.######.#",
        "##.####.##",
        "##########",
        "..######..",
        ".##.##.##.",
        "#........#",
    ),
    "ship": (
        ".....#.....",
        "....###....",
        "....###....",
        "..#######..",
        ".#########.",
        "###########",
        "##..###..##",
    ),
}


def smooth_noise(size: int, wavelength: float, rng: np.random.Generator) -> np.ndarray:
    """Periodic noise (size, size) with mean 0 and standard deviation 1, without structure below `wavelength` pixels."""
    frequency = np.fft.fftfreq(size)
    squared = frequency[:, None] ** 2 + frequency[None, :] ** 2
    spectrum = np.fft.fft2(rng.standard_normal((size, size))) * np.exp(-squared * wavelength**2)
    spectrum[0, 0] = 0.0
    noise = np.fft.ifft2(spectrum).real
    return noise / noise.std()


def _joints(tiles: int, texels: int, width: float) -> np.ndarray:
    """1 in the joints between `tiles` x `tiles` tiles, 0 inside; `width` is a share of the tile."""
    across = np.abs((np.arange(tiles * texels) + 0.5) / texels % 1.0 - 0.5)
    edge = np.clip((across - 0.5 + 0.5 * width) * texels + 0.5, 0.0, 1.0)
    return np.maximum(edge[:, None], edge[None, :])


def floor_textures(tiles: int = 16, texels: int = 64, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Roughness (S, S) and sRGB-encoded color (S, S, 3) of a floor of polished tiles, S = tiles * texels.

    Light and dark tiles alternate; every tile has its own polish, and people have worn a broad path.
    """
    rng = np.random.default_rng(seed)
    size = tiles * texels
    chess = np.add.outer(np.arange(tiles), np.arange(tiles)) % 2
    polish = np.where(chess == 0, 0.17, 0.30) + 0.045 * rng.uniform(-1.0, 1.0, (tiles, tiles))
    shade = 1.0 + 0.25 * rng.uniform(-1.0, 1.0, (tiles, tiles))
    spread = np.ones((texels, texels))
    polish, shade, chess = (np.kron(values, spread) for values in (polish, shade, chess))
    patches = smooth_noise(size, 1.6 * texels, rng)
    worn = 0.11 / (1.0 + np.exp(-3.0 * (patches - 0.6)))
    smear = 0.012 * smooth_noise(size, 0.12 * texels, rng)
    joints = _joints(tiles, texels, 0.035)
    roughness = np.clip(polish + worn + smear, GLOSSIEST, ROUGHEST - 0.1)
    roughness = roughness + joints * (ROUGHEST - roughness)
    dark, light = np.array([0.10, 0.09, 0.16]), np.array([0.19, 0.17, 0.27])
    color = (dark + chess[..., None] * (light - dark)) * shade[..., None] * (1.0 - 0.6 * joints[..., None])
    return roughness, color


def quilted_heights(size: int, depth: float) -> np.ndarray:
    """Heights (size, size) of one period of diamond-shaped cushions; the period is 1, the cushions rise by `depth`."""
    u = (np.arange(size) + 0.5) / size
    first = np.abs(np.sin(np.pi * (u[None, :] + u[:, None])))
    second = np.abs(np.sin(np.pi * (u[None, :] - u[:, None])))
    # The offset rounds the seams: without it the slope would jump from one cushion to the next.
    return depth * np.sqrt(first * second + 0.02)


def quilted_normals(size: int = 256, depth: float = 0.085, steepest: float = 0.55) -> np.ndarray:
    """Tangent-space normals (size, size, 3) of the cushions, unit, x along u, y along v.

    Slopes are compressed to stay below `steepest`, so that a viewer in front of the wall sees no hidden side.
    """
    heights = quilted_heights(size, depth)
    slopes = [0.5 * size * (np.roll(heights, -1, axis) - np.roll(heights, 1, axis)) for axis in (1, 0)]
    slope = np.stack(slopes, axis=-1)
    slope /= np.sqrt(1.0 + np.sum(slope**2, axis=-1, keepdims=True) / steepest**2)
    normal = np.concatenate([-slope, np.ones((size, size, 1))], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def encoded_normals(normals: np.ndarray) -> np.ndarray:
    """Colors in [0, 1] that a normal map stores for unit vectors `normals` (..., 3)."""
    return 0.5 + 0.5 * normals


def _stamp(picture: np.ndarray, sprite: str, row: int, column: int, color) -> None:
    """Draw a sprite with its lower left corner at (row, column)."""
    mask = np.array([[letter == "#" for letter in line] for line in SPRITES[sprite]])[::-1]
    picture[row : row + mask.shape[0], column : column + mask.shape[1]][mask] = color


def screen_picture(seed: int = 3) -> np.ndarray:
    """sRGB-encoded picture (96, 80, 3) of a game: stars, rows of creatures, a ship."""
    rng = np.random.default_rng(seed)
    height, width = 96, 80
    picture = np.empty((height, width, 3))
    picture[:] = np.linspace((0.10, 0.05, 0.30), (0.02, 0.02, 0.10), height)[:, None]
    picture[rng.integers(0, height, 90), rng.integers(0, width, 90)] = (0.75, 0.78, 0.9)
    picture[:6] = (0.10, 0.75, 0.45)
    for row, sprite, color in (
        (78, "moth", (1.0, 0.3, 0.75)),
        (63, "crab", (0.2, 0.95, 1.0)),
        (48, "moth", (1.0, 0.8, 0.2)),
    ):
        for column in range(6, 70, 18):
            _stamp(picture, sprite, row, column, color)
    _stamp(picture, "ship", 9, 34, (0.9, 0.95, 1.0))
    picture[18:30:4, 39] = picture[19:30:4, 39] = (1.0, 0.95, 0.5)
    return picture


def side_art(size: int = 128) -> np.ndarray:
    """sRGB-encoded picture (size, size, 3) for marquees: a striped sun over a horizon of lines."""
    v, u = np.meshgrid(*(2 * [(np.arange(size) + 0.5) / size]), indexing="ij")
    sky = np.array([0.16, 0.05, 0.35]) + v[..., None] * np.array([0.55, 0.05, 0.35])
    inside = np.hypot(u - 0.5, v - 0.5) < 0.36
    stripes = (v * 16.0 % 1.0) > np.clip(1.4 * (0.55 - v), 0.0, 0.8)
    sun = np.array([1.0, 0.25, 0.45]) + v[..., None] * np.array([0.0, 0.65, -0.2])
    picture = np.where((inside & stripes)[..., None], sun, sky)
    ground = v < 0.26
    lines = (np.abs((u - 0.5) / (0.34 - v + 1e-3) * 2.2 % 1.0 - 0.5) > 0.42) | (np.abs(v * 14.0 % 1.0 - 0.5) > 0.40)
    return np.where(ground[..., None], np.where(lines[..., None], (0.2, 0.9, 1.0), (0.08, 0.04, 0.2)), picture)
