"""Where a light must be for the edge of an object's shadow to be at a given point.

As seen from that point, the light is at the outline of the object: on the line through the place where a ray to the
light just passes it. Of area lights that is their center.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..lights.linking import linked_objects
from .lit_point import SurfaceHit

# NEAR_EDGE: pixels, at interface scale 1, within which a press takes the edge of a shadow.
NEAR_EDGE = 24.0
# RINGS, TURNS: where around the mouse an edge is looked for. HALVINGS: of what is between both sides of it.
RINGS, TURNS, HALVINGS = 8, 16, 24
# LIFT: m by which rays start above a surface, and the same as a share of their distance from the origin. HOPS: the most
# surfaces that a ray passes.
LIFT, LIFT_SHARE, HOPS = 1e-4, 1e-6, 32
# FIRST_STEP, REACH: the least and the largest way beside an object, by its size, in which its outline is looked for.
FIRST_STEP, REACH = 1e-3, 4.0
NO_SHADOW = "no shadow of it is here: press near the edge of one"


class OccluderRays:
    """Rays through a scene, which what casts no shadow of a light lets through."""

    def __init__(self, scene, depsgraph, light):
        self._scene, self._depsgraph = scene, depsgraph
        blockers = light.light_linking.blocker_collection
        self._linked = None if blockers is None else linked_objects(blockers)

    def blocker(self, hit: SurfaceHit, toward: Vector, distance: float, only=None) -> tuple | None:
        """As `first`, from the surface at `hit` on."""
        lift = LIFT + LIFT_SHARE * hit.position.length
        return self.first(hit.position + lift * hit.face_normal, toward, distance, only)

    def first(self, start: Vector, toward: Vector, distance: float = math.inf, only=None) -> tuple | None:
        """(object, its matrix, point) of the first that blocks a ray; None where there is none. `only`: (object, its
        matrix), which nothing else stands for."""
        for _ in range(HOPS):
            is_hit, point, _, _, ob, matrix = self._scene.ray_cast(self._depsgraph, start, toward, distance=distance)
            if not is_hit:
                return None
            own, linked = ob.original, self._linked
            is_blocker = own.visible_shadow and (linked is None or linked.reach(own.name_full))
            if is_blocker if only is None else (own, matrix) == only:
                return own, matrix.copy(), point
            way = (point - start).length + LIFT + LIFT_SHARE * point.length
            start, distance = start + way * toward, distance - way
            if distance <= 0.0:
                return None
        return None


@dataclass(frozen=True)
class ShadowEdge:
    """A place of an object's outline, as the light sees it, whose shadow is dragged."""

    ob: bpy.types.Object
    matrix: Matrix  # of the object, or of the instance of it
    point: Vector  # in the world, where a ray to the light met the object
    across: Vector | None  # unit, from the object past its outline; None: the point itself casts the shadow
    former: Vector  # where the light was
    aim: Vector
    distance: float  # of the light from its aim; infinite for a sun

    def light_for(self, rays: OccluderRays, hit: SurfaceHit) -> tuple[tuple[Vector, Vector, float] | None, str]:
        """The aim of the light, its direction from there and its distance for the shadow's edge at `hit`, None where
        there is no such place; and what there is to say about it."""
        toward = self.point - hit.position
        offset = (0.0, 0.0)
        if self.across is not None:
            across = (self.across - self.across.project(toward)).normalized()

            def is_blocked(way: float) -> bool:
                ray = toward + way * across
                return rays.blocker(hit, ray.normalized(), math.inf, (self.ob, self.matrix)) is not None

            offset = _outline(is_blocked, self._size)
            if offset is None:
                return None, "its edge cannot be here"
            beside = toward + offset[1] * across
            toward += 0.5 * (offset[0] + offset[1]) * across
        direction, notes = toward.normalized(), []
        if math.isinf(self.distance):
            place, way = (self.aim, direction, 1.0), math.inf
        else:
            way = self._way(hit.position, direction, toward.length)
            if way is None:
                return None, "the light would have to be nearer than the object"
            from_aim = hit.position + way * direction - self.aim
            place = self.aim, from_aim.normalized(), from_aim.length
            if abs(from_aim.length - self.distance) > 1e-3 * self.distance:
                notes.append(f"its distance becomes {from_aim.length:.3g} m")
        if hit.face_normal.dot(direction) <= 0.0:
            notes.append("the surface faces away from the light here")
        elif self.across is not None and (other := rays.blocker(hit, beside.normalized(), way)) is not None:
            notes.append(f"the shadow of {other[0].name} is here as well")
        return place, ", ".join(notes)

    @property
    def _size(self) -> float:
        corners = [self.matrix @ Vector(corner) for corner in self.ob.bound_box]
        return max((corner - corners[0]).length for corner in corners)

    def _way(self, start: Vector, direction: Vector, least: float) -> float | None:
        """How far along a ray the light is: at its distance from its aim, or as near to that as the ray comes."""
        from_aim = start - self.aim
        middle = -direction.dot(from_aim)
        square = middle**2 - from_aim.length_squared + self.distance**2
        half = math.sqrt(max(square, 0.0))
        ways = [way for way in (middle - half, middle + half) if way > least]
        return min(ways, key=lambda way: (start + way * direction - self.former).length, default=None)


def _outline(is_blocked: Callable[[float], bool], size: float) -> tuple[float, float] | None:
    """The ways across an outline, just inside and just outside of it, that are next to 0; None where there is none."""
    is_inside = is_blocked(0.0)
    sign = size if is_inside else -size
    near, far = 0.0, FIRST_STEP
    while is_blocked(sign * far) == is_inside:
        near, far = far, 2.0 * far
        if far > REACH:
            return None
    for _ in range(HALVINGS):
        middle = 0.5 * (near + far)
        near, far = (middle, far) if is_blocked(sign * middle) == is_inside else (near, middle)
    return (sign * near, sign * far) if is_inside else (sign * far, sign * near)


def shadow_edge_near(
    rays: OccluderRays, hit_at: Callable[[np.ndarray], SurfaceHit | None], matrix: Matrix, kind: str, radius: float
) -> tuple[ShadowEdge | None, str]:
    """The edge of a shadow within `radius` pixels of the mouse, of a light of a `kind` at `matrix`; away from edges the
    place of an object that casts its shadow at the mouse. None where there is no shadow, and why.

    `hit_at(offset)` is the surface at a pixel (2,) from the mouse.
    """
    backward, center, middle = matrix.col[2].xyz.normalized(), matrix.translation.copy(), hit_at(np.zeros(2))

    def blocked(offset: np.ndarray, only=None) -> tuple | None:
        """(hit, blocker or None); None where no part of the surface at the mouse faces the light."""
        hit = hit_at(offset)
        if hit is None or hit.ob != middle.ob:
            return None
        way = center - hit.position
        toward, distance = (backward, math.inf) if kind == "SUN" else (way.normalized(), way.length)
        return (hit, rays.blocker(hit, toward, distance, only)) if hit.face_normal.dot(toward) > 0.0 else None

    at_mouse = None if middle is None else blocked(np.zeros(2))
    if at_mouse is None:
        return None, "no surface that faces the light is under the mouse"
    is_dark = at_mouse[1] is not None
    only, other = at_mouse[1][:2] if is_dark else None, None
    turns = 2.0 * np.pi * np.arange(TURNS) / TURNS
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    for offset in (radius * np.arange(1, RINGS + 1)[:, None, None] / RINGS * ring).reshape(-1, 2):
        around = blocked(offset, only)
        if around is not None and (around[1] is None) == is_dark:
            other, only = offset, only or around[1][:2]
            break
    if only is None:
        return None, NO_SHADOW
    dark, lit = (np.zeros(2), other) if is_dark else (other, np.zeros(2))
    across = None
    if lit is not None:
        (hit, (*_, point)), (beside, _) = blocked(dark, only), blocked(lit, only)
        # Across the ray to the light, from the dark point to the lit one.
        ends = hit.position, beside.position
        ends = ends if kind == "SUN" else [(end - center).normalized() for end in ends]
        across = (ends[1] - ends[0]).normalized()
        for _ in range(HALVINGS // 2):
            between = 0.5 * (dark + lit)
            around = blocked(between, only)
            dark, lit = (between, lit) if around is not None and around[1] is not None else (dark, between)
    ob, placed, point = blocked(dark, only)[1]
    faced = None if kind in ("SUN", "POINT") else rays.first(center, -backward)
    aim = point if faced is None else faced[2]
    distance = math.inf if kind == "SUN" else max((center - aim).length, 1e-3)
    return ShadowEdge(ob, placed, point, across, center, aim, distance), ""
