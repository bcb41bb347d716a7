"""What stands in the example scene: arcade cabinets, rows of balls, sculptures, the room. Needs numpy only.

Each function gives `Part`s; `demo_scene` turns them into Blender objects. The aisle runs along +y, z is up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from . import demo_shapes as shapes
from .demo_textures import SPRITES

BALL_ROUGHNESS = (0.10, 0.18, 0.28, 0.40, 0.55, 0.80)  # of both rows of balls, from the front to the back
FLOOR_SIZE = 9.6  # m, edge of the square floor
WALL_Y, WALL_SIZE = 3.0, (8.4, 4.2)  # m


@dataclass(frozen=True)
class Part:
    """A shape in its place, the name of its material and the width in m of its bevels (0: none)."""

    name: str
    shape: shapes.Shape
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
    return shapes.rotation("x", degrees), np.array([0.0, *(0.5 * np.add(lower, upper))])


def _controls() -> dict[str, shapes.Shape]:
    """Knobs, sticks and the coin door of a cabinet, by material."""
    tilt, middle = _slope(CABINET_OUTLINE[8], CABINET_OUTLINE[7])
    button = shapes.drum(0.024, 0.022, 0.010, segments=32)
    place = [(x, y) for x in (0.05, 0.12, 0.19) for y in (-0.045, 0.035)]
    knobs = [button.moved((x, y + 0.15 * x, 0.0)).moved(middle, tilt) for x, y in place]
    rod = shapes.tube([(0.0, 0.0, z) for z in np.linspace(0.0, 0.11, 4)], 0.009, closed=False)
    collar = shapes.drum(0.035, 0.012, 0.005, segments=32)
    knob = shapes.sphere(0.036, 48)
    left = np.array([-0.15, 0.0, 0.0])
    steel = [rod.moved(left).moved(middle, tilt), collar.moved(left).moved(middle, tilt)]
    upright, door = _slope(CABINET_OUTLINE[0], CABINET_OUTLINE[10])
    return {
        "plastic button red": shapes.joined(knobs[::2] + [knob.moved(left + (0, 0, 0.125)).moved(middle, tilt)]),
        "plastic button yellow": shapes.joined(knobs[1::2]),
        "metal steel": shapes.joined(steel),
        "metal iron": shapes.box((0.34, 0.40, 0.02)).moved(door, upright),
    }


def cabinet(name: str, material: str, location, degrees: float) -> list[Part]:
    """An arcade cabinet with sides of `material`, turned by `degrees` from facing -y."""
    half = 0.5 * CABINET_WIDTH
    core = shapes.extruded(CABINET_OUTLINE, CABINET_WIDTH - 0.03)
    silhouette = shapes.outset(CABINET_OUTLINE, 0.035)
    side = shapes.extruded(silhouette, 0.036)
    round_edge = shapes.rounded_outline(silhouette, 0.03)
    edge = np.column_stack([np.zeros(len(round_edge)), round_edge])
    edging = shapes.tube(edge, 0.017, closed=True)
    tilt, middle = _slope(CABINET_OUTLINE[7], CABINET_OUTLINE[6])
    sign_tilt, sign = _slope(CABINET_OUTLINE[5], CABINET_OUTLINE[4])
    up = np.array([0.0, 0.0, 1.0])
    parts = {
        material: (shapes.joined([side.moved((x, 0, 0)) for x in (-half, half)]), 0.008),
        "plastic black": (shapes.joined([core, shapes.box((0.66, 0.74, 0.10)).moved((0.0, 0.0, 0.05))]), 0.006),
        "metal trim": (shapes.joined([edging.moved((x, 0, 0)) for x in (-half, half)]), 0.0),
        "plastic bezel": (shapes.box((0.64, 0.47, 0.016)).moved(middle, tilt), 0.006),
        "plastic screen": (shapes.plate((0.50, 0.41)).moved(middle + 0.0085 * tilt @ up, tilt), 0.0),
        "plastic marquee": (shapes.plate((0.62, 0.22)).moved(sign + 0.002 * sign_tilt @ up, sign_tilt), 0.0),
    }
    parts |= {key: (shape, 0.004 if key == "metal iron" else 0.0) for key, shape in _controls().items()}
    turn = shapes.rotation("z", degrees)
    return [Part(f"{name} {key}", shape, key, tuple(location), turn, bevel) for key, (shape, bevel) in parts.items()]


def ball_row(kind: str, start, end, radius: float = 0.19) -> list[Part]:
    """A low shelf from `start` to `end` (x, y) m with one ball per roughness, made of `kind` (metal or plastic)."""
    start, end = np.array(start), np.array(end)
    along = end - start
    degrees = np.degrees(np.arctan2(along[1], along[0]))
    length, height = np.linalg.norm(along) + 3.0 * radius, 0.12
    middle = 0.5 * (start + end)
    shelf = shapes.box((length, 2.6 * radius, height)).moved((0.0, 0.0, 0.5 * height))
    outline = [(x * length / 2, y * 1.3 * radius, height) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    rail = shapes.tube(shapes.rounded_outline(outline, 0.05), 0.014, closed=True)
    turn = shapes.rotation("z", degrees)
    parts = [
        Part(f"{kind} shelf", shelf, "plastic black", (*middle, 0.0), turn, bevel=0.02),
        Part(f"{kind} rail", rail, "metal trim", (*middle, 0.0), turn),
    ]
    for share, roughness in zip(np.linspace(0.0, 1.0, len(BALL_ROUGHNESS)), BALL_ROUGHNESS, strict=True):
        place = (*(start + share * along), height + radius)
        parts.append(Part(f"{kind} ball {roughness:.2f}", shapes.sphere(radius), f"{kind} {roughness:.2f}", place))
    return parts


def knot(radius: float, thickness: float, points: int = 360) -> shapes.Shape:
    """A trefoil: a tube that winds three times around a ring while it goes round twice."""
    t = shapes.FULL_TURN * np.arange(points) / points
    ring = radius * (1.0 + 0.42 * np.cos(3.0 * t))
    path = np.stack([ring * np.cos(2.0 * t), ring * np.sin(2.0 * t), 0.55 * radius * np.sin(3.0 * t)], axis=-1)
    return shapes.tube(path, thickness, closed=True, sides=40)


def sculpture(location) -> list[Part]:
    """A golden knot that stands on a brushed drum."""
    x, y = location
    upright = shapes.rotation("z", 20.0) @ shapes.rotation("x", 82.0)
    base = shapes.drum(0.52, 0.42, 0.03, segments=128)
    ring = np.array([(0.52 * np.cos(a), 0.52 * np.sin(a), 0.10) for a in np.linspace(0, shapes.FULL_TURN, 97)[:-1]])
    return [
        Part("pedestal", base, "metal brushed", (x, y, 0.0)),
        Part("pedestal ring", shapes.tube(ring, 0.016, closed=True), "metal trim", (x, y, 0.0)),
        Part("knot", knot(0.36, 0.105), "metal gold", (x, y, 1.02), upright),
    ]


def sprite_sign(sprite: str, cell: float, location) -> list[Part]:
    """A creature of bevelled cubes with edges of `cell` m, fixed to the back wall."""
    rows = SPRITES[sprite]
    cube = shapes.box((0.93 * cell, 0.93 * cell, 0.93 * cell))
    places = [
        ((j - 0.5 * (len(line) - 1)) * cell, 0.0, (0.5 * (len(rows) - 1) - i) * cell)
        for i, line in enumerate(rows)
        for j, letter in enumerate(line)
        if letter == "#"
    ]
    return [
        Part(
            f"sign {sprite}",
            shapes.joined([cube.moved(p) for p in places]),
            "metal copper",
            location,
            bevel=0.09 * cell,
        )
    ]


def room() -> list[Part]:
    """Floor, padded back wall and plain side walls."""
    floor = shapes.plate((FLOOR_SIZE, FLOOR_SIZE))
    wall = shapes.plate(WALL_SIZE, (WALL_SIZE[0] / 0.7, WALL_SIZE[1] / 0.7))
    side = shapes.plate((FLOOR_SIZE, WALL_SIZE[1]))
    stand = shapes.rotation("x", 90.0)
    middle_y, height = WALL_Y - 0.5 * FLOOR_SIZE, 0.5 * WALL_SIZE[1]
    parts = [
        Part("floor", floor, "floor tiles", (0.0, middle_y, 0.0)),
        Part("back wall", wall, "wall quilted", (0.0, WALL_Y, height), stand),
    ]
    for name, sign in (("left wall", -1), ("right wall", 1)):
        turn = shapes.rotation("z", -90.0 * sign) @ stand
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
