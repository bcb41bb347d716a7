"""Lights, kind by kind."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

# FARTHEST: the largest distance or size in m. Squares of much larger numbers overflow single precision.
FARTHEST = 1e15


AREA_LIGHT_SHAPES = ("SQUARE", "RECTANGLE", "DISK", "ELLIPSE")  # shapes of Blender's area lights


FACING_SHAPES = ("BALL", "FACING_DISK")  # shapes of Blender's point and spot lights


LIGHT_SHAPES = (*AREA_LIGHT_SHAPES, *FACING_SHAPES, "POLYGON")


@dataclass(frozen=True)
class SpotCone:
    """The cone of a spot light. In the direction w from the light its radiance is multiplied by x^2 (3 - 2 x), where
    x = (c - cosine) sharpness, clamped to [0, 1], c = v_z / |v| and v = axes w."""

    axes: np.ndarray  # (3, 3), of any length
    cosine: float
    sharpness: float

    def __post_init__(self):
        axes = np.asarray(self.axes, dtype=np.float64)
        if axes.shape != (3, 3) or not np.isfinite([*axes.ravel(), self.cosine, self.sharpness]).all():
            raise ValueError(f"spot cone: {self!r}, expected 3 x 3 and two finite numbers")
        object.__setattr__(self, "axes", axes)


@dataclass(frozen=True)
class Pattern:
    """Factors of the radiance of a light, by the normal n of the place on a ball, or by the direction n of the light.

    With v = axes n, the polar angle of v from z, 0 to pi, selects the row of `values`; the azimuth of v around z,
    counted from x, selects the column. Rows and columns are equal steps of these angles.
    """

    axes: np.ndarray  # (3, 3), of any length
    values: np.ndarray  # (H, W)
    by_ray: bool = False  # n is the direction in which the light travels, not the normal

    def __post_init__(self):
        axes, values = np.asarray(self.axes, dtype=np.float64), np.asarray(self.values, dtype=np.float32)
        if axes.shape != (3, 3) or values.ndim != 2 or not np.isfinite(axes).all() or not np.isfinite(values).all():
            raise ValueError(f"pattern: axes {axes!r} and values of shape {values.shape}, expected 3 x 3 and (H, W)")
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "values", values)


@dataclass(frozen=True)
class AreaLight:
    """A one-sided, uniformly emitting, flat area light, or one that looks flat from every point.

    Surface: ``center + s * half_u + t * half_v`` with |s|, |t| <= 1 for SQUARE and RECTANGLE, and s^2 + t^2 <= 1 for
    DISK and ELLIPSE. A POLYGON is the area inside `corners`, in the plane of center, half_u and half_v; the half axes
    tell its extent.

    Spread: a `spread` below pi focuses the light as in Cycles. The radiance is multiplied by
    max(0, (tan h - tan theta) / (tan h - h)), h = spread / 2, theta the angle from `direction` at the light.

    Falloff: at the distance t the radiance is multiplied by t^`falloff` t^2 / (`smooth` + t^2), as by Blender's Light
    Falloff node: 0 is quadratic, 1 linear, 2 constant.

    Facing lights: a BALL has the radius |half_u| = |half_v|. A FACING_DISK is a disk with that radius which turns its
    front to every point. Directions of the half axes and `direction` mean nothing for these two. They may have a
    `cone` and a `pattern`, but no spread.

    Distant lights: a light that `is_distant` is infinitely far away. Its center, half_u, half_v and corners are
    directions toward it, of any length, the same for every point.
    """

    name: str
    shape: str  # one of LIGHT_SHAPES
    center: np.ndarray  # (3,) m
    half_u: np.ndarray  # (3,) m
    half_v: np.ndarray  # (3,) m
    direction: np.ndarray  # (3,) unit, the side that emits
    radiance: np.ndarray  # (3,) W m^-2 sr^-1
    group: str = ""
    affects_diffuse: bool = True
    affects_specular: bool = True
    corners: np.ndarray | None = None  # (V, 3) m, a simple polygon, either way around; POLYGON only
    spread: float = np.pi  # rad, full angle of the cone into which the light shines
    receivers: tuple[int, ...] | None = None  # values of SurfaceSamples.receiver that it lights, None: all
    detail: tuple[AreaLight, ...] = ()  # finer lights that together are this one
    falloff: int = 0  # power of the distance in m
    smooth: float = 0.0  # m^2
    is_distant: bool = False
    cone: SpotCone | None = None
    pattern: Pattern | None = None  # for a FACING_DISK always by the direction in which the light travels

    def __post_init__(self):
        if self.shape not in LIGHT_SHAPES:
            raise ValueError(f"light {self.name!r}: shape is {self.shape!r}, expected one of {', '.join(LIGHT_SHAPES)}")
        for name in ("center", "half_u", "half_v", "direction", "radiance"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"light {self.name!r}: {name} is {value!r}, expected three finite numbers")
            object.__setattr__(self, name, value)
        if (self.shape == "POLYGON") != (self.corners is not None):
            found = "left out" if self.corners is None else "given"
            raise ValueError(
                f"light {self.name!r}: shape {self.shape} and corners {found}, "
                "expected corners for POLYGON and for no other shape"
            )
        if self.corners is not None:
            corners = np.asarray(self.corners, dtype=np.float64)
            if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3 or not np.isfinite(corners).all():
                raise ValueError(f"light {self.name!r}: corners {corners!r}, expected (V, 3) finite numbers, V >= 3")
            object.__setattr__(self, "corners", corners)
        if not 0.0 < self.spread <= np.pi + 1e-6:
            raise ValueError(f"light {self.name!r}: spread is {self.spread!r} rad, expected more than 0 and at most pi")
        if self.shape in ("POLYGON", *FACING_SHAPES) and self.is_focused:
            raise ValueError(f"light {self.name!r}: spread is {self.spread!r} rad, expected pi for shape {self.shape}")
        if isinstance(self.cone, dict):
            object.__setattr__(self, "cone", SpotCone(**self.cone))
        if isinstance(self.pattern, dict):
            object.__setattr__(self, "pattern", Pattern(**self.pattern))
        if not self.is_facing and (self.cone is not None or self.pattern is not None):
            raise ValueError(f"light {self.name!r}: {self.shape} has a cone or pattern, expected {FACING_SHAPES}")
        if self.is_facing and (self.is_distant or self.detail):
            raise ValueError(f"light {self.name!r}: shape {self.shape} is expected nearby, and without detail")
        if self.falloff not in (0, 1, 2) or not 0.0 <= self.smooth < np.inf:
            raise ValueError(
                f"light {self.name!r}: falloff is {self.falloff!r} and smooth is {self.smooth!r}, expected 0, 1 or 2 "
                "and a finite number that is not negative"
            )
        if self.is_distant and self.is_profiled:
            raise ValueError(f"light {self.name!r}: it is distant, expected neither spread nor falloff")
        if self.receivers is not None:
            object.__setattr__(self, "receivers", tuple(int(number) for number in self.receivers))
        detail = tuple(part if isinstance(part, AreaLight) else AreaLight(**part) for part in self.detail)
        object.__setattr__(self, "detail", detail)

    @property
    def patches(self) -> tuple[AreaLight, ...]:
        """The finest lights that together are this one: the leaves of `detail`, or this light where it has none."""
        return tuple(patch for part in self.detail for patch in part.patches) if self.detail else (self,)

    def moved(self, offset: np.ndarray) -> AreaLight:
        """The same light moved by `offset` (3,) in m; distant lights stay as they are."""
        if self.is_distant or not np.any(offset):
            return self
        corners = None if self.corners is None else self.corners + offset
        detail = tuple(part.moved(offset) for part in self.detail)
        return self.altered(center=self.center + offset, corners=corners, detail=detail)

    def altered(self, **changes) -> AreaLight:
        """A copy with the fields `changes`, unchecked: `dataclasses.replace` takes too long for 100,000 lights."""
        light = object.__new__(AreaLight)
        light.__dict__.update({name: self.__dict__[name] for name in _LIGHT_FIELDS}, **changes)
        return light

    def origins(self, position: np.ndarray) -> np.ndarray:
        """What to subtract from the light's vectors at `position` (..., 3): that position; zero for distant lights."""
        return np.zeros_like(position) if self.is_distant else position

    def record(self) -> dict:
        """This light as a JSON-able dict; AreaLight(**record) restores it."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        record = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
        if self.cone is not None:
            record["cone"] = {**vars(self.cone), "axes": self.cone.axes.tolist()}
        if self.pattern is not None:
            own = self.pattern
            record["pattern"] = {**vars(own), "axes": own.axes.tolist(), "values": own.values.tolist()}
        return {**record, "detail": [part.record() for part in self.detail]}

    @property
    def radius(self) -> float:
        """Radius in m of a sphere around the center that holds the whole light."""
        if self.is_facing:
            return float(np.linalg.norm(self.half_u))
        if self.is_round:
            return float(np.hypot(np.linalg.norm(self.half_u), np.linalg.norm(self.half_v)))
        return float(np.linalg.norm(self.polygon() - self.center, axis=1).max())

    @property
    def is_round(self) -> bool:
        """True for lights with the outline of an ellipse."""
        return self.shape in ("DISK", "ELLIPSE", *FACING_SHAPES)

    @property
    def is_facing(self) -> bool:
        """True for BALL and FACING_DISK, which face every point (see `shading.facing`)."""
        return self.shape in FACING_SHAPES

    @property
    def is_even(self) -> bool:
        """True where all of a facing light is equally bright: no cone, pattern or falloff."""
        return self.cone is None and self.pattern is None and not self.has_falloff

    @property
    def is_focused(self) -> bool:
        """True where the spread matters. Closer to pi its factor is 1, except along the light's plane."""
        return self.spread < np.pi - 1e-5

    @property
    def has_falloff(self) -> bool:
        """True unless the falloff is plainly quadratic."""
        return self.falloff != 0 or self.smooth > 0.0

    @property
    def is_profiled(self) -> bool:
        """True for flat lights with a spread or falloff: a point sees some places of them brighter than others."""
        return (self.is_focused or self.has_falloff) and not self.is_facing

    def receives(self, receiver: np.ndarray, index=slice(None)) -> np.ndarray | None:
        """Mask (Q,) of the samples at `index` that the light may light, by their `receiver` (P,); None: all."""
        return None if self.receivers is None else np.isin(receiver[index], self.receivers)

    @cached_property
    def area_vector(self) -> np.ndarray:
        """Normal (3,), as long as the area in m^2; `corners`, or half_u to half_v, run counterclockwise around it."""
        # np.cross of two vectors takes twenty times as long, and there may be 100,000 lights.
        if self.corners is not None:
            x, y, z = (self.corners - self.corners[0]).T
            a, b, c = (np.concatenate([values[1:], values[:1]]) for values in (x, y, z))
            return 0.5 * np.array([y @ c - z @ b, z @ a - x @ c, x @ b - y @ a])
        (x, y, z), (a, b, c) = self.half_u.tolist(), self.half_v.tolist()
        return (np.pi if self.is_round else 4.0) * np.array([y * c - z * b, z * a - x * c, x * b - y * a])

    def polygon(self, round_vertices: int = 32) -> np.ndarray:
        """Corners (V, 3) in m, counterclockwise as seen from the lit side.

        A disk or ellipse becomes an affine image of a regular polygon of `round_vertices` corners, with its own area.
        """
        corners = self.corners
        if corners is None:
            s, t = self._outline(round_vertices)
            corners = self.center + s[:, None] * self.half_u + t[:, None] * self.half_v
        return corners[::-1] if np.dot(self.area_vector, self.direction) < 0.0 else corners

    def _outline(self, round_vertices):
        """Corners s, t (2, V) in units of half_u and half_v."""
        if self.is_round:
            return round_outline(round_vertices)
        return np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])


_LIGHT_FIELDS = tuple(item.name for item in fields(AreaLight))


_VECTORS = ("center", "half_u", "half_v", "direction", "radiance")


# _FEW_ALIKE: up to so many consecutive lights that differ only in vectors and corners have a record each; more share
# one record.
_FEW_ALIKE = 16


def light_records(lights: Iterable[AreaLight]) -> list[dict]:
    """`lights` as JSON-able records, which `lights_of` reads."""
    found = []
    for own in (list(alike) for _, alike in itertools.groupby(lights, _kind)):
        if len(own) <= _FEW_ALIKE or own[0].detail or own[0].cone is not None or own[0].pattern is not None:
            found += [light.record() for light in own]
            continue
        vectors = [np.array([getattr(light, name) for light in own]) for name in _VECTORS]
        if own[0].corners is not None:
            vectors.append(np.array([light.corners for light in own]).reshape(len(own), -1))
        values = np.concatenate(vectors, axis=1).astype("<f8")
        found.append({"like": own[0].record(), "vectors": base64.b64encode(values.tobytes()).decode()})
    return found


def _kind(light) -> tuple:
    rest = (light.__dict__[name] for name in _LIGHT_FIELDS if name not in (*_VECTORS, "corners", "detail"))
    return *rest, len(light.detail), 0 if light.corners is None else len(light.corners)


def lights_of(records: Iterable[dict]) -> tuple[AreaLight, ...]:
    """The lights of records of `light_records`. Raises ValueError or TypeError for malformed records."""
    found = []
    for record in records:
        if "like" not in record:
            found.append(AreaLight(**record))
            continue
        like = AreaLight(**record["like"])
        corners = () if like.corners is None else like.corners.shape
        values = np.frombuffer(base64.b64decode(record["vectors"], validate=True), "<f8")
        values = values.reshape(-1, 3 * (len(_VECTORS) + (corners[0] if corners else 0)))
        if not np.isfinite(values).all():
            raise ValueError(f"light {like.name!r}: vectors that are not finite, expected finite numbers")
        for row in values:
            own = {name: row[3 * place : 3 * place + 3] for place, name in enumerate(_VECTORS)}
            found.append(like.altered(**own, corners=row[3 * len(_VECTORS) :].reshape(corners) if corners else None))
    return tuple(found)


def round_outline(count: int) -> np.ndarray:
    """Corners (2, V) of a regular polygon with the area of the unit disk, counterclockwise."""
    angle = 2.0 * np.pi * np.arange(count) / count
    step = 2.0 * np.pi / count
    radius = np.sqrt(step / np.sin(step))
    return radius * np.stack([np.cos(angle), np.sin(angle)])
