"""Shapes and textures of the example scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Shape:
    """A polygon mesh: `corners` (C,) lists the vertices of all faces one after another, `sizes` (F,) says how many
    each face has."""

    vertices: np.ndarray  # (N, 3) m
    corners: np.ndarray  # (C,) indices into vertices
    sizes: np.ndarray  # (F,)
    uv: np.ndarray | None = None  # (C, 2)

    def faces(self) -> list[list[int]]:
        """The vertex indices of each face."""
        return [face.tolist() for face in np.split(self.corners, np.cumsum(self.sizes)[:-1])]

    def moved(self, offset=(0.0, 0.0, 0.0), rotation=None) -> Shape:
        """The shape rotated by `rotation` (3, 3) about the origin, then shifted by `offset` (3,) m."""
        vertices = self.vertices if rotation is None else self.vertices @ np.asarray(rotation).T
        return Shape(vertices + np.asarray(offset, dtype=np.float64), self.corners, self.sizes, self.uv)


def joined(shapes) -> Shape:
    """One shape that holds all `shapes`; texture coordinates are dropped."""
    shapes = list(shapes)
    offsets = np.cumsum([0] + [len(shape.vertices) for shape in shapes[:-1]])
    return Shape(
        np.concatenate([shape.vertices for shape in shapes]),
        np.concatenate([shape.corners + offset for shape, offset in zip(shapes, offsets, strict=True)]),
        np.concatenate([shape.sizes for shape in shapes]),
    )


def rotation(axis: str, degrees: float) -> np.ndarray:
    """Right-handed rotation matrix (3, 3) about the axis "x", "y" or "z"."""
    angle = np.radians(degrees)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def _grid_faces(rows: int, columns: int, *, closed_rows: bool, closed_columns: bool) -> tuple[np.ndarray, np.ndarray]:
    """Corners and sizes of the quads of a grid of vertices numbered row by row."""
    row = np.arange(rows if closed_rows else rows - 1)[:, None]
    column = np.arange(columns if closed_columns else columns - 1)[None, :]
    next_row, next_column = (row + 1) % rows, (column + 1) % columns
    quads = np.stack(
        np.broadcast_arrays(
            row * columns + column,
            row * columns + next_column,
            next_row * columns + next_column,
            next_row * columns + column,
        ),
        axis=-1,
    ).reshape(-1, 4)
    return quads.ravel(), np.full(len(quads), 4)


def turned(profile, segments: int = 64) -> Shape:
    """Surface of revolution about z of `profile` (K, 2): radius and height in m, from bottom to top.

    Where the profile begins or ends at radius 0 the surface closes in a fan of triangles.
    """
    profile = np.asarray(profile, dtype=np.float64)
    at_bottom, at_top = profile[0, 0] == 0.0, profile[-1, 0] == 0.0
    rings = profile[int(at_bottom) : len(profile) - int(at_top)]
    angle = FULL_TURN * np.arange(segments) / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate(
        [
            rings[:, None, :1] * circle,
            np.broadcast_to(rings[:, None, 1:], (len(rings), segments, 1)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    corners, sizes = _grid_faces(len(rings), segments, closed_rows=False, closed_columns=True)
    around, ahead = np.arange(segments), (np.arange(segments) + 1) % segments
    for pole, first, turn in ((at_bottom, 0, -1), (at_top, (len(rings) - 1) * segments, 1)):
        if pole:
            height = profile[0, 1] if turn < 0 else profile[-1, 1]
            fan = np.stack([first + around, first + ahead, np.full(segments, len(vertices))], axis=-1)[:, ::turn]
            vertices = np.concatenate([vertices, [[0.0, 0.0, height]]])
            corners, sizes = np.concatenate([corners, fan.ravel()]), np.concatenate([sizes, np.full(segments, 3)])
    return Shape(vertices, corners, sizes)


def sphere(radius: float, segments: int = 96) -> Shape:
    """Sphere about the origin with `segments` meridians and half as many parallels."""
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, segments // 2 + 1)
    profile = radius * np.stack([np.cos(latitude), np.sin(latitude)], axis=-1)
    profile[[0, -1], 0] = 0.0
    return turned(profile, segments)


def drum(radius: float, height: float, rounding: float, segments: int = 64) -> Shape:
    """Upright cylinder that stands on z = 0, with rounded rims."""
    turn = np.linspace(0.0, 0.5 * np.pi, 7)
    inner = radius - rounding
    lower = np.stack([inner + rounding * np.sin(turn), rounding * (1.0 - np.cos(turn))], axis=-1)
    upper = np.stack([inner + rounding * np.cos(turn), height - rounding * (1.0 - np.sin(turn))], axis=-1)
    return turned(np.concatenate([[[0.0, 0.0]], lower, upper, [[0.0, height]]]), segments)


def tube(path, radius: float, *, closed: bool, sides: int = 16) -> Shape:
    """Round tube along `path` (K, 3) m; an open one is left open at its ends.

    The frame is carried along the path by the shortest rotation; on a closed path its total twist is spread evenly.
    """
    path = np.asarray(path, dtype=np.float64)
    if closed:
        tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    else:
        tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    across = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    normals = []
    for direction in tangent if not closed else np.concatenate([tangent, tangent[:1]]):
        across = across - np.dot(across, direction) * direction
        across = across / np.linalg.norm(across)
        normals.append(across)
    normals = np.array(normals)
    angle = FULL_TURN * np.arange(sides) / sides
    twist = np.zeros(len(path))
    if closed:
        binormal = np.cross(tangent[0], normals[0])
        turned_by = np.arctan2(np.dot(normals[-1], binormal), np.dot(normals[-1], normals[0]))
        twist = -turned_by * np.arange(len(path)) / len(path)
        normals = normals[:-1]
    phase = angle[None, :, None] + twist[:, None, None]
    ring = np.cos(phase) * normals[:, None] + np.sin(phase) * np.cross(tangent, normals)[:, None]
    vertices = (path[:, None] + radius * ring).reshape(-1, 3)
    return Shape(vertices, *_grid_faces(len(path), sides, closed_rows=closed, closed_columns=True))


def extruded(outline, width: float) -> Shape:
    """Prism of `outline` (K, 2): y and z in m, counterclockwise as seen from +x; it reaches from -width/2 to width/2
    along x."""
    outline = np.asarray(outline, dtype=np.float64)
    count = len(outline)
    sides = [np.column_stack([np.full(count, x), outline]) for x in (-0.5 * width, 0.5 * width)]
    here, ahead = np.arange(count), (np.arange(count) + 1) % count
    walls = np.stack([here, ahead, ahead + count, here + count], axis=-1)
    corners = np.concatenate([here[::-1], here + count, walls.ravel()])
    return Shape(np.concatenate(sides), corners, np.concatenate([[count, count], np.full(count, 4)]))


def box(size) -> Shape:
    """Box of `size` (3,) m about the origin."""
    width, depth, height = size
    y, z = 0.5 * depth, 0.5 * height
    return extruded([(-y, -z), (y, -z), (y, z), (-y, z)], width)


def plate(size, repeats=(1.0, 1.0)) -> Shape:
    """Rectangle of `size` (2,) m about the origin in the plane z = 0, facing +z; its texture repeats `repeats` times
    along x and y."""
    half_x, half_y = 0.5 * size[0], 0.5 * size[1]
    vertices = np.array([(-half_x, -half_y, 0), (half_x, -half_y, 0), (half_x, half_y, 0), (-half_x, half_y, 0)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * np.asarray(repeats, dtype=np.float64)
    return Shape(vertices, np.arange(4), np.array([4]), uv)


def rounded_outline(outline, radius: float, steps: int = 6) -> np.ndarray:
    """`outline` (K, D) with each corner replaced by a quadratic curve that starts at most `radius` m before it."""
    outline = np.asarray(outline, dtype=np.float64)
    t = np.linspace(0.0, 1.0, steps)[:, None]
    pieces = []
    for before, corner, after in zip(np.roll(outline, 1, 0), outline, np.roll(outline, -1, 0), strict=True):
        start, end = (
            corner + (other - corner) * min(0.45, radius / np.linalg.norm(other - corner)) for other in (before, after)
        )
        pieces.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(pieces)


def outset(outline, distance: float) -> np.ndarray:
    """`outline` (K, 2), counterclockwise, with every edge moved outwards by `distance` m."""
    outline = np.asarray(outline, dtype=np.float64)
    edge = np.roll(outline, -1, axis=0) - outline
    normal = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge, axis=-1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    return outline + distance * (before + normal) / (1.0 + np.sum(before * normal, axis=-1, keepdims=True))


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
