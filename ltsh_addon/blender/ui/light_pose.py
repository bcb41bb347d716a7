"""How a light object stands, how a gesture may put it elsewhere and back, and what holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mathutils import Matrix, Vector

from ..lights.groups import is_animated, is_linked


@dataclass(frozen=True)
class LightPose:
    """How a light object stood before a drag, and where its channels may put it."""

    channels: dict[str, tuple]
    basis: Matrix
    parent: Matrix  # of the world, from what the channels say
    is_sun: bool

    @classmethod
    def of(cls, ob) -> LightPose:
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


def reason_to_keep_power(ob) -> str:
    """Why the mouse may not change the power of a light; "" if it may."""
    if is_linked(ob.data):
        return "its power is linked from another file"
    if is_animated(ob.data, "energy"):
        return "its power is animated or driven"
    users = ob.data.users - ob.data.use_fake_user
    if users > 1:
        return f"its data {ob.data.name!r} has {users} users: make it single-user first"
    return ""
