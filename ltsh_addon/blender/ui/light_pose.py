"""How a light object stands, how a gesture may put it elsewhere and back, and what holds it."""

import colorsys
import math
from dataclasses import dataclass

from mathutils import Euler, Matrix, Vector

from ..lights.groups import is_animated, is_linked, reason_to_keep, reason_to_stay


@dataclass(frozen=True)
class LightPose:
    """How a light object stood before a drag, and where its channels may put it."""

    channels: dict[str, tuple]
    basis: Matrix
    parent: Matrix  # of the world, from what the channels say
    is_sun: bool

    @classmethod
    def of(cls, ob) -> "LightPose":
        """That of the light object `ob` now."""
        names = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
        channels = {name: tuple(getattr(ob, name)) for name in names}
        basis = ob.matrix_basis.copy()
        parent = Matrix() if ob.parent is None else ob.matrix_world @ basis.inverted_safe()
        return cls(channels, basis, parent, ob.data.type == "SUN")

    @property
    def matrix(self) -> Matrix:
        """In the world."""
        return self.parent @ self.basis

    def put_back(self, ob) -> None:
        """Give `ob` its channels back, to the last bit: a matrix would come back through a parent's rounding."""
        for name, values in self.channels.items():
            setattr(ob, name, values)

    def facing(self, point: Vector, direction: Vector, distance: float) -> Matrix:
        """The matrix in the world of the light in `direction` from a point, which it faces, turned no further than it
        must; a sun stays where it is. Also under a parent of uneven scale the light faces the point exactly."""
        location, rotation, scale = self.basis.decompose()
        if not self.is_sun:
            location = self.parent.inverted_safe() @ (point + distance * direction)
        backward = self.parent.to_3x3().inverted_safe() @ direction * math.copysign(1.0, scale.z)
        turn = (rotation @ Vector((0.0, 0.0, 1.0))).rotation_difference(backward.normalized())
        return self.parent @ Matrix.LocRotScale(location, turn @ rotation, scale)

    def put(self, ob, matrix: Matrix) -> None:
        """Put `ob` there; `matrix` is one of `facing`."""
        ob.matrix_basis = self.parent.inverted_safe() @ matrix


def match_lights(scene, records: list[dict]) -> tuple[int, list[str]]:
    """Give light objects the powers, colors, places and directions of the lights in the report of `match`; how many
    moved, and problems."""
    moved, problems = 0, []
    for record in records:
        name = record["name"]
        ob = scene.objects.get(name)
        if ob is None or ob.type != "LIGHT":
            problems.append(f"{name}: not in the scene any more")
            continue
        if reason := reason_to_keep(ob):
            problems.append(f"{name}: {reason}")
            continue
        ob.data.energy, ob.data.color = record["power_after"], record["color"]
        if all(record[f"{key}_after"] == record[f"{key}_before"] for key in ("location", "rotation")):
            continue
        if reason := reason_to_stay(ob):
            problems.append(f"{name}: {reason}")
            continue
        turn = Euler([math.radians(angle) for angle in record["rotation_after"]])
        ob.matrix_world = Matrix.LocRotScale(Vector(record["location_after"]), turn, ob.matrix_world.to_scale())
        moved += 1
    return moved, problems


# SIZES: the settings of a light's size, by its type.
SIZES = {"AREA": ("size", "size_y"), "POINT": ("shadow_soft_size",), "SPOT": ("shadow_soft_size",), "SUN": ("angle",)}


def _sizes_of(data) -> tuple[str, ...]:
    """The settings of the size of a light's data that have an effect."""
    is_even = data.type == "AREA" and data.shape in ("SQUARE", "DISK")
    return ("size",) if is_even else SIZES[data.type]


@dataclass(frozen=True)
class LightLook:
    """The color and size of a light object before a drag."""

    color: tuple[float, ...]
    sizes: dict[str, float]

    @classmethod
    def of(cls, ob) -> "LightLook":
        """That of the light object `ob` now."""
        return cls(tuple(ob.data.color), {name: getattr(ob.data, name) for name in _sizes_of(ob.data)})

    def put_back(self, ob) -> None:
        """Give `ob` what has changed."""
        now = LightLook.of(ob)
        if now.color != self.color:
            ob.data.color = self.color
        for name, size in self.sizes.items():
            if now.sizes[name] != size:
                setattr(ob.data, name, size)

    def scale(self, ob, factor: float) -> None:
        """Make the light larger by a factor."""
        for name in self.sizes:
            setattr(ob.data, name, factor * max(getattr(ob.data, name), 1e-3))

    def resize(self, ob, size: float) -> None:
        """Give the light a size in m, that of a sun in degrees; of rectangles and ellipses their first side."""
        name = next(iter(self.sizes))
        self.scale(ob, (math.radians(size) if name == "angle" else size) / max(getattr(ob.data, name), 1e-3))

    def tint(self, ob, hue: float, saturation: float) -> None:
        """Turn the light's hue, and add to its saturation; its brightest channel stays as bright."""
        h, s, v = colorsys.rgb_to_hsv(*ob.data.color)
        ob.data.color = colorsys.hsv_to_rgb((h + hue) % 1.0, min(max(s + saturation, 0.0), 1.0), v)

    def text(self, ob, mode: str) -> str:
        """What the light has now of the size (mode S) or color (mode C), after a colon."""
        if mode == "D":
            return ""
        if mode == "C":
            return ": " + ", ".join(f"{value:.3g}" for value in ob.data.color)
        sizes = LightLook.of(ob).sizes.items()
        return ": " + ", ".join(f"{math.degrees(v):.3g}°" if name == "angle" else f"{v:.3g} m" for name, v in sizes)


def locked_place(start: Vector, point: Vector, place: Vector, free: tuple[bool, bool, bool]) -> Vector:
    """Where a light is that may move from `start` along the `free` axes alone, and shall be seen from `point` in the
    direction of `place`: there exactly where two axes are free and that direction leads there, else next to it."""
    toward, moved = (place - point).normalized(), start.copy()
    axes = [axis for axis in range(3) if free[axis]]
    if len(axes) == 2:
        (fixed,) = {0, 1, 2} - set(axes)
        way = (start - point)[fixed] / toward[fixed] if abs(toward[fixed]) > 1e-6 else -1.0
        target = point + way * toward if way > 0.0 else place
        for axis in axes:
            moved[axis] = target[axis]
        return moved
    (axis,) = axes
    across = 1.0 - toward[axis] ** 2
    if across > 1e-6:
        # The place of the axis that is next to the ray from the point; not behind the point.
        gap = start - point
        along = (gap.dot(toward) * toward[axis] - gap[axis]) / across
        if gap.dot(toward) + along * toward[axis] > 0.0:
            moved[axis] += along
            return moved
    moved[axis] = place[axis]
    return moved


def power_for(factor: float, power: float, share: float) -> float:
    """The power of a light with which a point gets `factor` times its light, of which a light of this `power` gives
    the `share`, over 0; never below 0."""
    return max(0.0, power * (1.0 + (factor - 1.0) / share))


def reason_to_keep_power(ob) -> str:
    """Why the mouse may not change the power of a light; "" if it may."""
    return _reason_to_keep(ob, "power", ("energy",))


def reason_to_keep_look(ob, quantity: str) -> str:
    """Why the mouse may not change the size or color of a light; "" if it may."""
    return _reason_to_keep(ob, quantity, ("color",) if quantity == "color" else _sizes_of(ob.data))


def _reason_to_keep(ob, quantity: str, names: tuple[str, ...]) -> str:
    if is_linked(ob.data):
        return f"its {quantity} is linked from another file"
    if any(is_animated(ob.data, name) for name in names):
        return f"its {quantity} is animated or driven"
    users = ob.data.users - ob.data.use_fake_user
    if users > 1:
        return f"its data {ob.data.name!r} has {users} users: make it single-user first"
    return ""
