"""Make the example scene of `ltsh demo`, an arcade with plastic, metal and area lights: ltsh_addon/blender/demo.blend.

.venv/py311/bin/python docs/demo_scene.py [FILE]

Blender 4.5 makes it, so that later ones open it too. Blender keeps equal meshes one by one: `zstd` makes the file half
as large.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

FILE = Path(__file__).resolve().parent.parent / "ltsh_addon" / "blender" / "demo.blend"
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
    heights = np.broadcast_to(rings[:, None, 1:], (len(rings), segments, 1))
    vertices = np.concatenate([rings[:, None, :1] * circle, heights], axis=-1).reshape(-1, 3)
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


BALL_ROUGHNESS = (0.10, 0.18, 0.28, 0.40, 0.55, 0.80)  # of both rows of balls, from the front to the back
FLOOR_SIZE = 9.6  # m, edge of the square floor
WALL_Y, WALL_SIZE = 3.0, (8.4, 4.2)  # m


@dataclass(frozen=True)
class Part:
    """A shape in its place, the name of its material and the width in m of its bevels (0: none)."""

    name: str
    shape: Shape
    material: str
    location: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    bevel: float = 0.0


CABINET_WIDTH = 0.72
# fmt: off
CABINET_OUTLINE = (  # y and z of the side view, counterclockwise as seen from +x; the front is at -y
    (-0.42, 0.10), (0.40, 0.10), (0.40, 1.86), (-0.26, 1.92), (-0.44, 1.86), (-0.46, 1.60), (-0.20, 1.53),
    (-0.34, 1.06), (-0.62, 0.98), (-0.62, 0.90), (-0.42, 0.82),
)
# fmt: on


def _slope(lower, upper) -> tuple[np.ndarray, np.ndarray]:
    """Rotation that lays the plane z = 0 on a face of the cabinet between two points (y, z), and the face's middle."""
    along = np.subtract(upper, lower)
    degrees = np.degrees(np.arctan2(along[1], along[0]))
    return rotation("x", degrees), np.array([0.0, *(0.5 * np.add(lower, upper))])


def _controls() -> dict[str, Shape]:
    """Knobs, sticks and the coin door of a cabinet, by material."""
    tilt, middle = _slope(CABINET_OUTLINE[8], CABINET_OUTLINE[7])
    button = drum(0.024, 0.022, 0.010, segments=32)
    place = [(x, y) for x in (0.05, 0.12, 0.19) for y in (-0.045, 0.035)]
    knobs = [button.moved((x, y + 0.15 * x, 0.0)).moved(middle, tilt) for x, y in place]
    rod = tube([(0.0, 0.0, z) for z in np.linspace(0.0, 0.11, 4)], 0.009, closed=False)
    collar = drum(0.035, 0.012, 0.005, segments=32)
    knob = sphere(0.036, 48)
    left = np.array([-0.15, 0.0, 0.0])
    steel = [rod.moved(left).moved(middle, tilt), collar.moved(left).moved(middle, tilt)]
    upright, door = _slope(CABINET_OUTLINE[0], CABINET_OUTLINE[10])
    return {
        "plastic button red": joined(knobs[::2] + [knob.moved(left + (0, 0, 0.125)).moved(middle, tilt)]),
        "plastic button yellow": joined(knobs[1::2]),
        "metal steel": joined(steel),
        "metal iron": box((0.34, 0.40, 0.02)).moved(door, upright),
    }


def cabinet(name: str, material: str, location, degrees: float) -> list[Part]:
    """An arcade cabinet with sides of `material`, turned by `degrees` from facing -y."""
    half = 0.5 * CABINET_WIDTH
    core = extruded(CABINET_OUTLINE, CABINET_WIDTH - 0.03)
    silhouette = outset(CABINET_OUTLINE, 0.035)
    side = extruded(silhouette, 0.036)
    round_edge = rounded_outline(silhouette, 0.03)
    edge = np.column_stack([np.zeros(len(round_edge)), round_edge])
    edging = tube(edge, 0.017, closed=True)
    tilt, middle = _slope(CABINET_OUTLINE[7], CABINET_OUTLINE[6])
    sign_tilt, sign = _slope(CABINET_OUTLINE[5], CABINET_OUTLINE[4])
    up = np.array([0.0, 0.0, 1.0])
    parts = {
        material: (joined([side.moved((x, 0, 0)) for x in (-half, half)]), 0.008),
        "plastic black": (joined([core, box((0.66, 0.74, 0.10)).moved((0.0, 0.0, 0.05))]), 0.006),
        "metal trim": (joined([edging.moved((x, 0, 0)) for x in (-half, half)]), 0.0),
        "plastic bezel": (box((0.64, 0.47, 0.016)).moved(middle, tilt), 0.006),
        "plastic screen": (plate((0.50, 0.41)).moved(middle + 0.0085 * tilt @ up, tilt), 0.0),
        "plastic marquee": (plate((0.62, 0.22)).moved(sign + 0.002 * sign_tilt @ up, sign_tilt), 0.0),
    }
    parts |= {key: (shape, 0.004 if key == "metal iron" else 0.0) for key, shape in _controls().items()}
    turn = rotation("z", degrees)
    return [Part(f"{name} {key}", shape, key, tuple(location), turn, bevel) for key, (shape, bevel) in parts.items()]


def ball_row(kind: str, start, end, radius: float = 0.19) -> list[Part]:
    """A low shelf from `start` to `end` (x, y) m with one ball per roughness, made of `kind` (metal or plastic)."""
    start, end = np.array(start), np.array(end)
    along = end - start
    degrees = np.degrees(np.arctan2(along[1], along[0]))
    length, height = np.linalg.norm(along) + 3.0 * radius, 0.12
    middle = 0.5 * (start + end)
    shelf = box((length, 2.6 * radius, height)).moved((0.0, 0.0, 0.5 * height))
    outline = [(x * length / 2, y * 1.3 * radius, height) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    rail = tube(rounded_outline(outline, 0.05), 0.014, closed=True)
    turn = rotation("z", degrees)
    parts = [
        Part(f"{kind} shelf", shelf, "plastic black", (*middle, 0.0), turn, bevel=0.02),
        Part(f"{kind} rail", rail, "metal trim", (*middle, 0.0), turn),
    ]
    for share, roughness in zip(np.linspace(0.0, 1.0, len(BALL_ROUGHNESS)), BALL_ROUGHNESS, strict=True):
        place = (*(start + share * along), height + radius)
        parts.append(Part(f"{kind} ball {roughness:.2f}", sphere(radius), f"{kind} {roughness:.2f}", place))
    return parts


def knot(radius: float, thickness: float, points: int = 360) -> Shape:
    """A trefoil: a tube that winds three times around a ring while it goes round twice."""
    t = FULL_TURN * np.arange(points) / points
    ring = radius * (1.0 + 0.42 * np.cos(3.0 * t))
    path = np.stack([ring * np.cos(2.0 * t), ring * np.sin(2.0 * t), 0.55 * radius * np.sin(3.0 * t)], axis=-1)
    return tube(path, thickness, closed=True, sides=40)


def sculpture(location) -> list[Part]:
    """A golden knot that stands on a brushed drum."""
    x, y = location
    upright = rotation("z", 20.0) @ rotation("x", 82.0)
    base = drum(0.52, 0.42, 0.03, segments=128)
    ring = np.array([(0.52 * np.cos(a), 0.52 * np.sin(a), 0.10) for a in np.linspace(0, FULL_TURN, 97)[:-1]])
    return [
        Part("pedestal", base, "metal brushed", (x, y, 0.0)),
        Part("pedestal ring", tube(ring, 0.016, closed=True), "metal trim", (x, y, 0.0)),
        Part("knot", knot(0.36, 0.105), "metal gold", (x, y, 1.02), upright),
    ]


def sprite_sign(sprite: str, cell: float, location) -> list[Part]:
    """A creature of bevelled cubes with edges of `cell` m, fixed to the back wall."""
    rows = SPRITES[sprite]
    cube = box((0.93 * cell, 0.93 * cell, 0.93 * cell))
    places = [
        ((j - 0.5 * (len(line) - 1)) * cell, 0.0, (0.5 * (len(rows) - 1) - i) * cell)
        for i, line in enumerate(rows)
        for j, letter in enumerate(line)
        if letter == "#"
    ]
    cubes = joined([cube.moved(p) for p in places])
    return [Part(f"sign {sprite}", cubes, "metal copper", location, bevel=0.09 * cell)]


def room() -> list[Part]:
    """Floor, padded back wall and plain side walls."""
    floor = plate((FLOOR_SIZE, FLOOR_SIZE))
    wall = plate(WALL_SIZE, (WALL_SIZE[0] / 0.7, WALL_SIZE[1] / 0.7))
    side = plate((FLOOR_SIZE, WALL_SIZE[1]))
    stand = rotation("x", 90.0)
    middle_y, height = WALL_Y - 0.5 * FLOOR_SIZE, 0.5 * WALL_SIZE[1]
    parts = [
        Part("floor", floor, "floor tiles", (0.0, middle_y, 0.0)),
        Part("back wall", wall, "wall quilted", (0.0, WALL_Y, height), stand),
    ]
    for name, sign in (("left wall", -1), ("right wall", 1)):
        turn = rotation("z", -90.0 * sign) @ stand
        parts.append(Part(name, side, "wall paint", (sign * 0.45 * WALL_SIZE[0], middle_y, height), turn))
    return parts


def everything() -> list[Part]:
    """All parts of the scene."""
    parts = room() + sculpture((0.0, 0.9)) + sprite_sign("moth", 0.14, (0.0, WALL_Y - 0.1, 2.35))
    rows = (
        (-2.35, 62.0, ("plastic violet", "plastic cyan", "plastic orange", "plastic magenta")),
        (2.35, -62.0, ("plastic cyan", "plastic magenta", "plastic violet", "plastic orange")),
    )
    for x, degrees, bodies in rows:
        for index, (body, y) in enumerate(zip(bodies, (-2.3, -1.1, 0.1, 1.3), strict=True)):
            side = "left" if x < 0.0 else "right"
            parts += cabinet(f"cabinet {side} {index + 1}", body, (x, y, 0.0), degrees)
    parts += ball_row("metal", (-1.15, -3.75), (-0.95, -0.9))
    parts += ball_row("plastic", (1.15, -3.75), (0.95, -0.9))
    return parts


RESOLUTION = (480, 270)
CAMERA = {"location": (0.25, -6.55, 1.12), "target": (0.0, 0.0, 0.98), "lens": 29.0}

# fmt: off
# Sizes in m, power in W. `up` is the world direction of the light's y axis.
LIGHTS = (
    {"name": "Neon", "shape": "RECTANGLE", "size": 5.2, "size_y": 0.22, "color": (1.0, 0.06, 0.62), "energy": 110.0,
     "location": (2.75, -0.6, 2.35), "target": (-0.6, -0.6, 0.3), "up": (0.0, 0.0, 1.0)},
    {"name": "Porthole", "shape": "DISK", "size": 1.5, "color": (0.05, 0.75, 1.0), "energy": 100.0,
     "location": (-2.9, -1.4, 2.3), "target": (0.6, -0.4, 0.4), "up": (0.0, 0.0, 1.0)},
    {"name": "Sunset", "shape": "ELLIPSE", "size": 1.9, "size_y": 0.8, "color": (1.0, 1.0, 1.0), "energy": 60.0,
     "temperature": 2100.0, "location": (0.0, 2.7, 1.5), "target": (0.0, -6.0, 0.6), "up": (0.0, 0.0, 1.0)},
    {"name": "Skylight", "shape": "SQUARE", "size": 2.4, "color": (0.80, 0.88, 1.0), "energy": 22.0, "exposure": 1.0,
     "location": (0.0, -3.4, 3.9), "target": (0.0, 1.4, 0.9), "up": (0.0, 1.0, 0.0)},
)
# fmt: on

# Base color (linear), metallic, roughness, index of refraction.
MATERIALS = {
    "metal trim": ((0.90, 0.88, 0.85), 1.0, 0.18, 1.5),
    "metal steel": ((0.72, 0.72, 0.74), 1.0, 0.25, 1.5),
    "metal iron": ((0.45, 0.44, 0.44), 1.0, 0.42, 1.5),
    "metal gold": ((1.00, 0.71, 0.29), 1.0, 0.22, 1.5),
    "metal copper": ((0.95, 0.60, 0.48), 1.0, 0.35, 1.5),
    "plastic black": ((0.012, 0.012, 0.016), 0.0, 0.35, 1.5),
    "plastic bezel": ((0.010, 0.010, 0.014), 0.0, 0.15, 1.5),
    "plastic violet": ((0.16, 0.03, 0.55), 0.0, 0.30, 1.5),
    "plastic cyan": ((0.01, 0.38, 0.50), 0.0, 0.22, 1.5),
    "plastic orange": ((0.80, 0.17, 0.02), 0.0, 0.40, 1.5),
    "plastic magenta": ((0.62, 0.02, 0.26), 0.0, 0.26, 1.5),
    "plastic button red": ((0.75, 0.02, 0.03), 0.0, 0.16, 1.5),
    "plastic button yellow": ((0.85, 0.55, 0.03), 0.0, 0.20, 1.5),
    "wall paint": ((0.035, 0.025, 0.08), 0.0, 0.50, 1.45),
}
METAL_BALLS = (
    (0.93, 0.92, 0.90),
    (0.95, 0.72, 0.42),
    (0.92, 0.55, 0.42),
    (0.75, 0.78, 0.85),
    (0.90, 0.88, 0.84),
    (0.85, 0.64, 0.34),
)
PLASTIC_BALLS = (
    (0.75, 0.02, 0.04),
    (0.85, 0.35, 0.01),
    (0.10, 0.55, 0.06),
    (0.01, 0.30, 0.60),
    (0.25, 0.04, 0.60),
    (0.75, 0.72, 0.68),
)


def _image(name: str, values: np.ndarray, *, data: bool, precise: bool = False) -> bpy.types.Image:
    """A packed image of `values` (H, W) or (H, W, 3), row 0 at the bottom; `data` images are not color managed."""
    height, width = values.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=precise, is_data=data)
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :3] = values if values.ndim == 3 else values[..., None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    return image


def _new_material(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """An empty material and its output node."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):  # later versions always have nodes and warn
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, material.node_tree.nodes.new("ShaderNodeOutputMaterial")


def _principled(name: str, color, metallic: float, roughness: float, ior: float) -> bpy.types.Node:
    """The shader node of a new material with one Principled BSDF, single scattering."""
    material, output = _new_material(name)
    shader = material.node_tree.nodes.new("ShaderNodeBsdfPrincipled")
    shader.distribution = "GGX"
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Metallic"].default_value = metallic
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["IOR"].default_value = ior
    material.node_tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return shader


def _link_image(shader: bpy.types.Node, socket: str, image: bpy.types.Image, *, sharp: bool = False) -> None:
    """Feed the input `socket` of `shader` from `image`; `sharp` shows its texels."""
    tree = shader.id_data
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    texture.interpolation = "Closest" if sharp else "Linear"
    source = texture.outputs["Color"]
    if socket == "Normal":
        bump = tree.nodes.new("ShaderNodeNormalMap")
        tree.links.new(source, bump.inputs["Color"])
        source = bump.outputs["Normal"]
    tree.links.new(source, shader.inputs[socket])


def _materials() -> None:
    """Make all materials; parts refer to them by name."""
    for name, values in MATERIALS.items():
        _principled(name, *values)
    for kind, colors in (("metal", METAL_BALLS), ("plastic", PLASTIC_BALLS)):
        for roughness, color in zip(BALL_ROUGHNESS, colors, strict=True):
            _principled(f"{kind} {roughness:.2f}", color, float(kind == "metal"), roughness, 1.5)
    roughness, color = floor_textures()
    floor = _principled("floor tiles", (0.02, 0.02, 0.03), 0.0, 0.25, 1.6)
    _link_image(floor, "Roughness", _image("floor roughness", roughness, data=True))
    _link_image(floor, "Base Color", _image("floor color", color, data=False))
    wall = _principled("wall quilted", (0.20, 0.02, 0.16), 0.0, 0.30, 1.5)
    normals = encoded_normals(quilted_normals())
    _link_image(wall, "Normal", _image("wall normal", normals, data=True, precise=True))
    screen = _principled("plastic screen", (0.1, 0.1, 0.2), 0.0, 0.12, 1.5)
    _link_image(screen, "Base Color", _image("screen", screen_picture(), data=False), sharp=True)
    marquee = _principled("plastic marquee", (0.5, 0.2, 0.4), 0.0, 0.20, 1.5)
    _link_image(marquee, "Base Color", _image("marquee", side_art(), data=False))
    material, output = _new_material("metal brushed")
    glossy = material.node_tree.nodes.new("ShaderNodeBsdfAnisotropic")
    glossy.distribution = "GGX"
    glossy.inputs["Color"].default_value = (0.55, 0.56, 0.60, 1.0)
    glossy.inputs["Roughness"].default_value = 0.32
    material.node_tree.links.new(glossy.outputs["BSDF"], output.inputs["Surface"])


def _add_object(name: str, data) -> bpy.types.Object:
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def _add_part(part: Part) -> None:
    mesh = bpy.data.meshes.new(part.name)
    mesh.from_pydata(part.shape.vertices.tolist(), [], part.shape.faces())
    if part.shape.uv is not None:
        mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", part.shape.uv.astype(np.float32).ravel())
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=np.radians(32.0))
    mesh.materials.append(bpy.data.materials[part.material])
    obj = _add_object(part.name, mesh)
    obj.matrix_world = Matrix.Translation(part.location) @ Matrix(part.rotation.tolist()).to_4x4()
    if part.bevel > 0.0:
        bevel = obj.modifiers.new("Bevel", "BEVEL")
        bevel.width, bevel.segments, bevel.harden_normals = part.bevel, 4, True
        bevel.limit_method, bevel.angle_limit = "ANGLE", np.radians(30.0)


def _aimed(location, target, up) -> Matrix:
    """Matrix that places the origin at `location`, points -z at `target` and y as far as possible along `up`."""
    backward = (Vector(location) - Vector(target)).normalized()
    right = Vector(up).cross(backward).normalized()
    axes = Matrix((right, backward.cross(right), backward)).transposed()
    return Matrix.Translation(location) @ axes.to_4x4()


def _add_light(settings: dict) -> None:
    light = bpy.data.lights.new(settings["name"], "AREA")
    light.shape, light.size = settings["shape"], settings["size"]
    light.size_y = settings.get("size_y", settings["size"])
    light.color, light.energy = settings["color"], settings["energy"]
    light.exposure, light.normalize, light.spread = settings.get("exposure", 0.0), True, np.pi
    if "temperature" in settings:
        light.use_temperature, light.temperature = True, settings["temperature"]
    _add_object(settings["name"], light).matrix_world = _aimed(settings["location"], settings["target"], settings["up"])


def _set_up_view() -> None:
    """Camera, black world, render settings."""
    scene = bpy.context.scene
    camera = bpy.data.cameras.new("Camera")
    camera.lens = CAMERA["lens"]
    scene.camera = _add_object("Camera", camera)
    scene.camera.matrix_world = _aimed(CAMERA["location"], CAMERA["target"], (0.0, 0.0, 1.0))
    scene.world = bpy.data.worlds.new("Night")
    if bpy.app.version < (5, 0, 0):
        scene.world.use_nodes = True
    background = next(node for node in scene.world.node_tree.nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = RESOLUTION
    render.resolution_percentage = 100
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0


def build() -> None:
    """Make the example scene in place of the file that is open in Blender."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    _materials()
    for part in everything():
        _add_part(part)
    for settings in LIGHTS:
        _add_light(settings)
    _set_up_view()


def main(path: Path) -> None:
    build()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "demo.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(plain), copy=True, compress=False, check_existing=False)
        subprocess.run(["zstd", "-19", "--long=24", "--force", "--quiet", str(plain), "-o", str(path)], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
