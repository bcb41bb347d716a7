"""Lights: a class for each kind.

| class | what it is |
|---|---|
| `QuadLight`, `EllipseLight` | flat, one-sided lights: Blender's area lights |
| `PolygonLight` | a flat, one-sided light: a polygon of a glowing mesh |
| `PointLight` | a sphere, or a disk that faces every point: Blender's point lights |
| `SpotLight` | a `PointLight` with a cone: Blender's spot lights |
| `SunLight`, `SkyLight` | distant lights: a disk (the sun), and a rectangle of the sky or world |

A textured light, and a side of the sky, is a tree: its `children` are finer lights, each of one radiance.
"""

import base64
import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from typing import ClassVar

import numpy as np

# FARTHEST: the largest distance or size in m. Squares of much larger numbers overflow single precision.
FARTHEST = 1e15


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

    With v = axes n, the polar angle of v from z, `start` to pi, selects the row of `values`; the azimuth of v around z,
    counted from x, selects the column. Rows and columns are equal steps of these angles.
    """

    axes: np.ndarray  # (3, 3), of any length
    values: np.ndarray  # (H, W)
    by_ray: bool = False  # n is the direction in which the light travels, not the normal
    start: float = 0.0  # rad

    def __post_init__(self):
        axes, values = np.asarray(self.axes, dtype=np.float64), self.values
        if isinstance(values, list) and len(values) == 2 and isinstance(values[1], str):  # of a record
            values = np.frombuffer(base64.b64decode(values[1], validate=True), "<f4").reshape(values[0], -1)
        values = np.asarray(values, dtype=np.float32)
        if axes.shape != (3, 3) or values.ndim != 2 or not np.isfinite(axes).all() or not np.isfinite(values).all():
            raise ValueError(f"pattern: axes {axes!r} and values of shape {values.shape}, expected 3 x 3 and (H, W)")
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "values", values)


@dataclass(frozen=True)
class Light:
    """What all lights have.

    Surface: ``center + s * half_u + t * half_v``, with |s|, |t| <= 1, or s^2 + t^2 <= 1 for kinds that are `is_round`.
    """

    SHAPES: ClassVar[tuple[str, ...]] = ()  # the shapes of this kind
    is_round: ClassVar[bool] = False  # the outline is an ellipse
    is_facing: ClassVar[bool] = False  # it looks the same from every side (`emitters/facing.py`)
    is_distant: ClassVar[bool] = False  # it is infinitely far away
    is_side: ClassVar[bool] = False  # it is a whole side of the sky

    name: str
    center: np.ndarray  # (3,) m
    half_u: np.ndarray  # (3,) m
    half_v: np.ndarray  # (3,) m
    direction: np.ndarray  # (3,) unit, the side that emits
    radiance: np.ndarray  # (3,) W m^-2 sr^-1
    group: str = ""
    affects_diffuse: bool = True
    affects_specular: bool = True
    receivers: tuple[int, ...] | None = None  # values of SurfaceSamples.receiver that it lights, None: all
    shape: str = ""  # one of SHAPES

    # Neutral values of fields that not all kinds have. They come last, because kinds that have them inherit the order.
    spread: ClassVar[float] = np.pi
    falloff: ClassVar[int] = 0
    smooth: ClassVar[float] = 0.0
    children: "ClassVar[tuple[Light, ...]]" = ()
    corners: ClassVar[np.ndarray | None] = None
    cone: ClassVar[SpotCone | None] = None
    pattern: ClassVar[Pattern | None] = None

    def __post_init__(self):
        if self.shape not in self.SHAPES:
            expected = ", ".join(self.SHAPES)
            raise ValueError(f"light {self.name!r}: shape is {self.shape!r}, expected one of {expected}")
        for name in _VECTORS:
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"light {self.name!r}: {name} is {value!r}, expected three finite numbers")
            object.__setattr__(self, name, value)
        if self.receivers is not None:
            object.__setattr__(self, "receivers", tuple(int(number) for number in self.receivers))
        if self.falloff not in (0, 1, 2) or not 0.0 <= self.smooth < np.inf:
            raise ValueError(
                f"light {self.name!r}: falloff is {self.falloff!r} and smooth is {self.smooth!r}, expected 0, 1 or 2 "
                "and a finite number that is not negative"
            )
        if type(self.children) is not tuple:
            object.__setattr__(self, "children", tuple(self.children))

    @classmethod
    def like(cls, light: "Light", **changes) -> "Light":
        """A light of this kind: the fields `changes`, and all others that `light` has too."""
        names = [name for name in _field_names(cls) if name in _field_names(type(light)) and name != "shape"]
        return cls(**{**{name: getattr(light, name) for name in names}, **changes})

    def altered(self, **changes) -> "Light":
        """A copy with the fields `changes`, unchecked: `dataclasses.replace` takes too long for 100,000 lights."""
        light = object.__new__(type(self))
        light.__dict__.update({name: self.__dict__[name] for name in _field_names(type(self))}, **changes)
        return light

    def viewpoint(self, position: np.ndarray) -> np.ndarray:
        """What to subtract from the light's vectors at `position` (..., 3): that position; zero for distant lights."""
        return position

    def record(self) -> dict:
        """This light as a JSON-able dict; `light_of` restores it."""
        values = {key: getattr(self, name) for key, name in _RECORD.items()}
        record = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in values.items()}
        if self.cone is not None:
            record["cone"] = {**vars(self.cone), "axes": self.cone.axes.tolist()}
        if self.pattern is not None:
            packed = base64.b64encode(self.pattern.values.astype("<f4").tobytes()).decode()
            fields_of_pattern = {"axes": self.pattern.axes.tolist(), "values": [len(self.pattern.values), packed]}
            record["pattern"] = {**vars(self.pattern), **fields_of_pattern}
        return {**record, "detail": [child.record() for child in self.children]}

    @property
    def leaves(self) -> "tuple[Light, ...]":
        """The finest lights that together are this one: this light itself where it has no children."""
        return tuple(leaf for child in self.children for leaf in child.leaves) if self.children else (self,)

    @property
    def radius(self) -> float:
        """Radius in m of a sphere around the center that holds the whole light."""
        if self.is_round:
            return float(np.hypot(np.linalg.norm(self.half_u), np.linalg.norm(self.half_v)))
        return float(np.linalg.norm(self.polygon() - self.center, axis=1).max())

    @property
    def has_spread(self) -> bool:
        """True where the spread matters. Closer to pi its factor is 1, except along the light's plane."""
        return self.spread < np.pi - 1e-5

    @property
    def has_falloff(self) -> bool:
        """True unless the falloff is plainly quadratic."""
        return self.falloff != 0 or self.smooth > 0.0

    @property
    def has_profile(self) -> bool:
        """True for flat lights with a spread or falloff, whose brightness varies (`emitters/light_profile.py`)."""
        return (self.has_spread or self.has_falloff) and not self.is_facing

    def receives(self, receiver: np.ndarray, index=slice(None)) -> np.ndarray | None:
        """Mask (Q,) of the samples at `index` that the light may light, by their `receiver` (P,); None: all."""
        return None if self.receivers is None else np.isin(receiver[index], self.receivers)

    @cached_property
    def area_vector(self) -> np.ndarray:
        """Normal (3,), as long as the area in m^2; half_u to half_v, or `corners`, run counterclockwise around it."""
        # np.cross of two vectors takes twenty times as long, and there may be 100,000 lights.
        (x, y, z), (a, b, c) = self.half_u.tolist(), self.half_v.tolist()
        return (np.pi if self.is_round else 4.0) * np.array([y * c - z * b, z * a - x * c, x * b - y * a])

    def polygon(self, round_vertices: int = 32) -> np.ndarray:
        """Corners (V, 3) in m, counterclockwise as seen from the lit side.

        A disk or ellipse becomes an affine image of a regular polygon of `round_vertices` corners, with its own area.
        """
        corners = self._outline(round_vertices)
        return corners[::-1] if np.dot(self.area_vector, self.direction) < 0.0 else corners

    def _outline(self, round_vertices):
        """Corners (V, 3), either way around."""
        s, t = round_outline(round_vertices) if self.is_round else _SQUARE
        return self.center + s[:, None] * self.half_u + t[:, None] * self.half_v


@dataclass(frozen=True)
class FlatLight(Light):
    """A flat light that emits to one side.

    Spread: a `spread` below pi focuses the light as in Cycles. The radiance is multiplied by
    max(0, (tan h - tan theta) / (tan h - h)), h = spread / 2, theta the angle from `direction` at the light.

    Falloff: at the distance t the radiance is multiplied by t^`falloff` t^2 / (`smooth` + t^2), as by Blender's Light
    Falloff node: 0 is quadratic, 1 linear, 2 constant.
    """

    spread: float = np.pi  # rad, full angle of the cone into which the light shines
    falloff: int = 0  # power of the distance in m
    smooth: float = 0.0  # m^2
    children: tuple[Light, ...] = ()  # finer lights that together are this one

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 < self.spread <= np.pi + 1e-6:
            raise ValueError(f"light {self.name!r}: spread is {self.spread!r} rad, expected more than 0 and at most pi")


@dataclass(frozen=True)
class QuadLight(FlatLight):
    """A parallelogram with the half sides half_u and half_v: Blender's squares and rectangles."""

    SHAPES: ClassVar = ("SQUARE", "RECTANGLE")
    shape: str = "RECTANGLE"


@dataclass(frozen=True)
class EllipseLight(FlatLight):
    """An ellipse with the conjugate half axes half_u and half_v: Blender's disks and ellipses."""

    SHAPES: ClassVar = ("DISK", "ELLIPSE")
    is_round: ClassVar = True
    shape: str = "ELLIPSE"


@dataclass(frozen=True)
class PolygonLight(FlatLight):
    """The area inside `corners`, in the plane of center, half_u and half_v; the half axes tell its extent. It has no
    spread. A glowing mesh is one such light for each of its polygons."""

    SHAPES: ClassVar = ("POLYGON",)
    shape: str = "POLYGON"
    corners: np.ndarray = field(kw_only=True)  # (V, 3) m, a simple polygon, either way around

    def __post_init__(self):
        super().__post_init__()
        corners = np.asarray(self.corners, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3 or not np.isfinite(corners).all():
            raise ValueError(f"light {self.name!r}: corners {corners!r}, expected (V, 3) finite numbers, V >= 3")
        object.__setattr__(self, "corners", corners)
        if self.has_spread:
            raise ValueError(f"light {self.name!r}: spread is {self.spread!r} rad, expected pi for shape {self.shape}")

    @cached_property
    def area_vector(self) -> np.ndarray:
        """As `Light.area_vector`."""
        x, y, z = (self.corners - self.corners[0]).T
        a, b, c = (np.concatenate([values[1:], values[:1]]) for values in (x, y, z))
        return 0.5 * np.array([y @ c - z @ b, z @ a - x @ c, x @ b - y @ a])

    def _outline(self, round_vertices):
        return self.corners


@dataclass(frozen=True)
class PointLight(Light):
    """A light that faces every point: a sphere (BALL) of the radius |half_u| = |half_v|, or a disk with that radius
    which turns its front to every point (FACING_DISK: Blender's Soft Falloff).

    Directions of the half axes and `direction` mean nothing. The falloff is that of a `FlatLight`.
    """

    SHAPES: ClassVar = ("BALL", "FACING_DISK")
    is_round: ClassVar = True
    is_facing: ClassVar = True
    shape: str = "BALL"
    falloff: int = 0  # power of the distance in m
    smooth: float = 0.0  # m^2
    pattern: Pattern | None = None  # for a FACING_DISK always by the direction in which the light travels

    def __post_init__(self):
        super().__post_init__()
        if isinstance(self.pattern, dict):
            object.__setattr__(self, "pattern", Pattern(**self.pattern))

    @property
    def is_sphere(self) -> bool:
        """True for a BALL, False for a FACING_DISK."""
        return self.shape == "BALL"

    @property
    def is_uniform(self) -> bool:
        """True where all of the light is equally bright: no cone, pattern or falloff."""
        return self.cone is None and self.pattern is None and not self.has_falloff

    @property
    def radius(self) -> float:
        """As `Light.radius`."""
        return float(np.linalg.norm(self.half_u))


@dataclass(frozen=True)
class SpotLight(PointLight):
    """A `PointLight` that shines into a `cone`."""

    cone: SpotCone = field(kw_only=True)

    def __post_init__(self):
        super().__post_init__()
        if isinstance(self.cone, dict):
            object.__setattr__(self, "cone", SpotCone(**self.cone))


@dataclass(frozen=True)
class DistantLight(Light):
    """A light that is infinitely far away. Its center, half_u and half_v are directions toward it, of any length, the
    same for every point."""

    is_distant: ClassVar = True

    def viewpoint(self, position: np.ndarray) -> np.ndarray:
        """As `Light.viewpoint`."""
        return np.zeros_like(position)


@dataclass(frozen=True)
class SunLight(DistantLight):
    """A distant disk: a sun, or a small, bright spot of the world."""

    SHAPES: ClassVar = ("DISK",)
    is_round: ClassVar = True
    shape: str = "DISK"


@dataclass(frozen=True)
class SkyLight(DistantLight):
    """A rectangle of the sky or world: one side of a cube around everything, or one of the `children` of that."""

    SHAPES: ClassVar = ("RECTANGLE",)
    shape: str = "RECTANGLE"
    children: tuple[Light, ...] = ()  # finer lights that together are this one

    @property
    def is_side(self) -> bool:
        """True for a whole side of that cube, along the axes of the world."""
        axes = np.abs([self.center, self.half_u, self.half_v])
        return bool((np.sort(axes) == [0.0, 0.0, 1.0]).all() and (axes.sum(axis=0) == 1.0).all())


_KINDS = (QuadLight, EllipseLight, PolygonLight, PointLight, SunLight, SkyLight)

_SQUARE = np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])  # corners s, t (2, 4)

_VECTORS = ("center", "half_u", "half_v", "direction", "radiance")

_KEYS = (
    *("name", "shape", *_VECTORS, "group", "affects_diffuse", "affects_specular", "corners", "spread", "receivers"),
    *("detail", "falloff", "smooth", "is_distant", "cone", "pattern"),
)
# _RECORD: the keys of a light's record, each with the attribute that it holds.
_RECORD = {key: "children" if key == "detail" else key for key in _KEYS}

# _FEW_ALIKE: up to so many consecutive lights that differ only in vectors and corners have a record each; more share
# one record.
_FEW_ALIKE = 16


@cache
def _field_names(kind: type[Light]) -> tuple[str, ...]:
    return tuple(item.name for item in fields(kind))


def light_of(record: dict) -> Light:
    """The light of a record of `Light.record`. Its kind follows from "shape", "is_distant" and "cone"; keys may be left
    out, for defaults. Raises ValueError or TypeError for a malformed record."""
    values = dict(record)
    shape, is_distant = values.get("shape"), bool(values.pop("is_distant", False))
    kind = next((kind for kind in _KINDS if kind.is_distant == is_distant and shape in kind.SHAPES), None)
    if kind is None:
        shapes = [shape for kind in _KINDS if kind.is_distant == is_distant for shape in kind.SHAPES]
        where = "distant" if is_distant else "near"
        raise ValueError(
            f"light {values.get('name')!r}: shape is {shape!r}, expected one of {', '.join(shapes)} for a {where} light"
        )
    kind = SpotLight if kind is PointLight and values.get("cone") is not None else kind
    values["children"] = tuple(light_of(child) for child in values.pop("detail", ()))
    for name in set(values) & set(_RECORD.values()) - set(_field_names(kind)):
        if np.any(values.pop(name) != getattr(kind, name)):
            raise ValueError(f"light {values.get('name')!r}: it has {name}, expected none for a {kind.__name__}")
    return kind(**values)


def light_records(lights: Iterable[Light]) -> list[dict]:
    """`lights` as JSON-able records, which `lights_of` reads."""
    records = []
    for alike in (list(group) for _, group in itertools.groupby(lights, _what_alike_lights_share)):
        first = alike[0]
        if len(alike) <= _FEW_ALIKE:
            records += [light.record() for light in alike]
            continue
        vectors = [np.array([getattr(light, name) for light in alike]) for name in _VECTORS]
        if first.corners is not None:
            vectors.append(np.array([light.corners for light in alike]).reshape(len(alike), -1))
        values = np.concatenate(vectors, axis=1).astype("<f8")
        records.append({"like": first.record(), "vectors": base64.b64encode(values.tobytes()).decode()})
    return records


def _what_alike_lights_share(light) -> tuple:
    if light.children or light.cone is not None or light.pattern is not None:
        return (id(light),)
    names = (name for name in _field_names(type(light)) if name not in (*_VECTORS, "corners"))
    corner_count = 0 if light.corners is None else len(light.corners)
    return type(light), corner_count, *(light.__dict__[name] for name in names)


def lights_of(records: Iterable[dict]) -> tuple[Light, ...]:
    """The lights of records of `light_records`. Raises ValueError or TypeError for malformed records."""
    lights = []
    for record in records:
        if "like" not in record:
            lights.append(light_of(record))
            continue
        like = light_of(record["like"])
        shape = () if like.corners is None else like.corners.shape
        values = np.frombuffer(base64.b64decode(record["vectors"], validate=True), "<f8")
        values = values.reshape(-1, 3 * (len(_VECTORS) + (shape[0] if shape else 0)))
        if not np.isfinite(values).all():
            raise ValueError(f"light {like.name!r}: vectors that are not finite, expected finite numbers")
        for row in values:
            arrays = {name: row[3 * number : 3 * number + 3] for number, name in enumerate(_VECTORS)}
            if shape:
                arrays["corners"] = row[3 * len(_VECTORS) :].reshape(shape)
            lights.append(like.altered(**arrays))
    return tuple(lights)


def round_outline(count: int) -> np.ndarray:
    """Corners (2, V) of a regular polygon with the area of the unit disk, counterclockwise."""
    angle = 2.0 * np.pi * np.arange(count) / count
    step = 2.0 * np.pi / count
    radius = np.sqrt(step / np.sin(step))
    return radius * np.stack([np.cos(angle), np.sin(angle)])
