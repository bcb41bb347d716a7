"""The shared vocabulary: techniques, passes, lights, surface samples and film.

World space is Blender's: metres, right-handed, z up. Radiance is scene-referred linear RGB in W m^-2 sr^-1.
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

VERSION = "0.1.0"  # also in blender_manifest.toml and pyproject.toml


class Cancelled(Exception):
    """A long computation was stopped on request."""


class SceneError(Exception):
    """The task cannot be done with this scene, file or Blender; the message is one line."""


# progress(stage, fraction of the stage that is done); returning False stops the work.
Progress = Callable[[str, float], "bool | None"]


def error_line(error: BaseException) -> str:
    """The message of an error in one line of readable length; the name of its class where the message is empty."""
    return shortened(" ".join(str(error).split())) or type(error).__name__


def shortened(text: str, most: int = 1000) -> str:
    """`text`, its middle replaced by " ... " where it is longer than `most` characters."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[len(text) - most // 2 :]}"


def listed(texts: Iterable[str], most: int = 8, separator: str = ", ") -> str:
    """The first `most` of `texts` and the number of those left out: "a, b and 3 more"; "none" for no texts."""
    texts = list(texts)
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return (separator.join(texts[:most]) or "none") + more


@dataclass(frozen=True)
class Technique:
    """The texts that users see of a technique."""

    label: str  # on buttons
    title: str  # on comparison sheets and as a stage of progress
    description: str  # what it does


# Techniques by the name that they have in options, layers of files and reports. All but REFERENCE have a table.
REFERENCE = "reference"
TECHNIQUES = {
    "ltc": Technique("LTC", "LTC", "Linearly transformed cosines, as EEVEE has them: fastest, least accurate"),
    "ltsh2": Technique(
        "LTSH 2", "LTSH N=2", "Linearly transformed spherical harmonics of degree 2: nearly as fast as LTC"
    ),
    "ltsh4": Technique(
        "LTSH 4",
        "LTSH N=4",
        "Linearly transformed spherical harmonics of degree 4: accurate, 1.5 to 2 times the time of LTC",
    ),
    "ltsh4c": Technique(
        "LTSH 4c",
        "LTSH N=4 + cosine",
        "LTSH 4 with a bent cosine for grazing views: the most accurate closed form, three fifths of LTSH 4's error",
    ),
    REFERENCE: Technique(
        "Reference",
        "Reference quadrature",
        "Quadrature of the true lobe: exact and slow, on some of the pixels of large images",
    ),
}
SHIPPED_TABLES = tuple(name for name in TECHNIQUES if name != REFERENCE)
CYCLES = "cycles"  # the name of Cycles' pictures beside those of techniques
PASSES = ("specular", "diffuse")
BAKE_PASSES = (*PASSES, "diffuse_light", "combined")


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


# Fields of SurfaceSamples with one number per sample. All other fields are vectors or colors.
SCALAR_FIELDS = (
    "roughness", "ior", "bump_alpha2", "receiver", "diffuse_roughness", "sheen_a", "sheen_b", "anisotropy",
)  # fmt: skip


@dataclass(frozen=True)
class SurfaceSamples:
    """P surface points with all that shading needs. Vectors are unit, in world space; last axis is space or color.

    A surface with several lobes has one sample for each of them.

    Specular lobe: single-scatter GGX with alpha = roughness^2 and the Fresnel factor
    ``f0 + (f90 - f0) (1 - c)^5 - dip c (1 - c)^6 + dielectric F_d(c, ior)``. c is the cosine of the half angle, F_d
    the exact unpolarized reflectance of a dielectric, with total reflection where `ior` is below 1. Negative terms may
    stand for a tint. Without a dielectric, a sum of the first three terms below 0 counts as 0. With an `anisotropy`
    the alpha of GGX is roughness^2 / (1 - anisotropy) along the `tangent` and roughness^2 (1 - anisotropy) across it.

    Diffuse lobe: Lambert's; with a `diffuse_roughness` that of a rough surface, with a `sheen_a` that of sheen (see
    `shading.diffuse`). `diffuse_albedo` is what the specular layer leaves.

    Horizons, as in Cycles: the specular lobe ends at the horizons of both the shading and the geometric normal, a
    bump-mapped diffuse lobe at the horizon of the smooth normal. Toward that horizon the diffuse lobe is shadowed by
    2 / (1 + sqrt(1 + bump_alpha2 tan^2 theta_i)), theta_i the angle of the light from the smooth normal (Estevez,
    Lecocq and Stein 2019).
    """

    position: np.ndarray  # (P, 3) m
    view: np.ndarray  # (P, 3) towards the camera
    normal: np.ndarray  # (P, 3) shading normal of the specular lobe
    diffuse_normal: np.ndarray  # (P, 3) shading normal of the diffuse lobe
    roughness: np.ndarray  # (P,) in [0, 1]
    specular_f0: np.ndarray  # (P, 3)
    specular_f90: np.ndarray  # (P, 3)
    dielectric: np.ndarray  # (P, 3) weight of the dielectric lobe; (P,) is taken for all colors
    ior: np.ndarray  # (P,) relative index of refraction of the dielectric lobe
    diffuse_albedo: np.ndarray  # (P, 3)
    geometric_normal: np.ndarray | None = None  # (P, 3) for the horizon of the specular lobe; default: `normal`
    smooth_normal: np.ndarray | None = None  # (P, 3) interpolated, without bump maps; default: `diffuse_normal`
    bump_alpha2: np.ndarray | None = None  # (P,); default: 0
    specular_dip: np.ndarray | None = None  # (P, 3) of F82 metals; default: 0
    diffuse_roughness: np.ndarray | None = None  # (P,) sigma of Oren and Nayar in [0, 1]; default: 0
    diffuse_rebound: np.ndarray | None = None  # (P, 3) multiple scattering of such a surface; default: 0
    sheen_a: np.ndarray | None = None  # (P,) 0: no sheen; below 0: -sigma of velvet; default: 0
    sheen_b: np.ndarray | None = None  # (P,); default: 0
    receiver: np.ndarray | None = None  # (P,) integers that `AreaLight.receivers` names; default: 0
    anisotropy: np.ndarray | None = None  # (P,) in (-1, 1); default: 0
    tangent: np.ndarray | None = None  # (P, 3); its part along `normal` does not matter; default: 0

    def __post_init__(self):
        count = np.shape(self.position)[0]
        defaults = {
            "geometric_normal": self.normal,
            "smooth_normal": self.diffuse_normal,
            "bump_alpha2": np.broadcast_to(0.0, (count,)),
            "specular_dip": np.broadcast_to(0.0, (count, 3)),
            "diffuse_roughness": np.broadcast_to(0.0, (count,)),
            "diffuse_rebound": np.broadcast_to(0.0, (count, 3)),
            "sheen_a": np.broadcast_to(0.0, (count,)),
            "sheen_b": np.broadcast_to(0.0, (count,)),
            "receiver": np.broadcast_to(0, (count,)),
            "anisotropy": np.broadcast_to(0.0, (count,)),
            "tangent": np.broadcast_to(0.0, (count, 3)),
        }
        for name, value in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        if np.ndim(self.dielectric) == 1:
            object.__setattr__(self, "dielectric", np.broadcast_to(np.asarray(self.dielectric)[:, None], (count, 3)))
        for field in fields(self):
            value = np.asarray(getattr(self, field.name))
            expected = (count,) if field.name in SCALAR_FIELDS else (count, 3)
            if value.shape != expected:
                raise ValueError(f"surface samples: {field.name} has shape {value.shape}, expected {expected}")
            object.__setattr__(self, field.name, value)

    def __len__(self) -> int:
        return self.position.shape[0]

    @property
    def sharpest_roughness(self) -> np.ndarray:
        """Roughness (P,): the square root of the smaller of the two alphas of GGX."""
        if not self.anisotropy.any():
            return self.roughness
        across = np.maximum(1.0 - self.anisotropy, 1e-6)
        return self.roughness * np.sqrt(np.minimum(across, 1.0 / across))

    def take(self, index) -> SurfaceSamples:
        """The samples at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        count = len(self.position[index])
        return replace(self, **{field.name: _taken(getattr(self, field.name), index, count) for field in fields(self)})

    @classmethod
    def joined(cls, pieces: list[SurfaceSamples]) -> SurfaceSamples:
        """The samples of all `pieces`, at least one, one after another."""
        if len(pieces) == 1:
            return pieces[0]
        names = [field.name for field in fields(cls)]
        return cls(**{name: _one_after_another([getattr(piece, name) for piece in pieces]) for name in names})


def is_constant(values: np.ndarray) -> bool:
    """True for a broadcast scalar, which most fields of samples are."""
    return values.size > 0 and not any(values.strides)


def _taken(values: np.ndarray, index, count: int) -> np.ndarray:
    """The `count` rows at `index`."""
    return np.broadcast_to(values.flat[0], (count, *values.shape[1:])) if is_constant(values) else values[index]


def _one_after_another(parts: list[np.ndarray]) -> np.ndarray:
    """All rows of the `parts`."""
    if all(map(is_constant, parts)) and len({part.flat[0] for part in parts}) == 1:
        return np.broadcast_to(parts[0].flat[0], (sum(map(len, parts)), *parts[0].shape[1:]))
    return np.concatenate(parts)


@dataclass(frozen=True)
class Film:
    """Where P samples lie in an image. A pixel is the mean of `sub_samples` samples, or their weighted mean where
    pixels share samples. Samples that hit nothing are absent and count as 0."""

    width: int
    height: int
    pixel: np.ndarray  # (P,) integers, counted row by row from the top left
    sub_samples: int = 1
    # (P,) bool: true for one sample of each hit, as surfaces with several lobes have several samples; None: all true.
    first: np.ndarray | None = None
    # (P,) how many samples each one stands for, below 1 in pixels that have more than `sub_samples`; None: 1 each.
    count: np.ndarray | None = None
    # (P, D, D) weights of each sample in the pixels around its own, rows from top to bottom; None: its own pixel only.
    spread: np.ndarray | None = None
    # (H, W) sums of these weights per pixel, absent samples included.
    whole: np.ndarray | None = None

    def take(self, index) -> Film:
        """The film of the samples at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        own = {name: getattr(self, name) for name in ("first", "count", "spread")}
        own = {name: None if values is None else values[index] for name, values in own.items()}
        return replace(self, pixel=self.pixel[index], **own)

    def with_more(self, more: Film) -> Film:
        """A film with the samples of this one and of `more`, which has the same pixels."""
        arrays = {name: (getattr(self, name), getattr(more, name)) for name in ("pixel", "first", "count", "spread")}
        joined = {name: None if one is None else np.concatenate([one, other]) for name, (one, other) in arrays.items()}
        return replace(self, whole=more.whole, **joined)

    def has_more(self) -> np.ndarray:
        """Mask (H, W) of the pixels that have more than `sub_samples` samples, by `with_more`."""
        first = self.pixel if self.first is None else self.pixel[self.first]
        count = np.bincount(first, minlength=self.width * self.height)
        return count.reshape(self.height, self.width) > self.sub_samples

    def unspread(self) -> Film:
        """The same samples, each only in its own pixel."""
        return replace(self, spread=None, whole=None)

    @property
    def points(self) -> int:
        """The approximate number of samples of a pixel."""
        if self.count is None or not len(self.count):
            return self.sub_samples
        return max(1, round(self.sub_samples * len(self.count) / self.count.sum()))

    def image(self, values: np.ndarray) -> np.ndarray:
        """Image (H, W) or (H, W, C), row 0 on top, of per-sample `values` (P,) or (P, C)."""
        values = np.asarray(values, dtype=np.float64)
        columns = values.reshape(values.shape[0], int(np.prod(values.shape[1:])))
        if self.spread is not None:
            image = self._sums(columns, self.spread) / self.whole[..., None]
            return image.reshape(self.height, self.width, *values.shape[1:])
        columns = columns if self.count is None else columns * self.count[:, None]
        count = self.width * self.height
        image = np.stack([np.bincount(self.pixel, weights=column, minlength=count) for column in columns.T], axis=-1)
        return (image / self.sub_samples).reshape(self.height, self.width, *values.shape[1:])

    def _sums(self, columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Sums (H, W, C) of the columns (P, C) with weights (P, D, D)."""
        size, around = weights.shape[1], weights.shape[1] // 2
        shape = self.height + 2 * around, self.width + 2 * around
        sums = np.zeros((columns.shape[1], shape[0] * shape[1]))
        place = self.pixel // self.width * shape[1] + self.pixel % self.width
        for row, column in np.ndindex(size, size):
            weight, target = weights[:, row, column], place + row * shape[1] + column
            for own, values in zip(sums, columns.T, strict=True):
                own += np.bincount(target, weights=values * weight, minlength=len(own))
        inside = slice(around, around + self.height), slice(around, around + self.width)
        return np.moveaxis(sums.reshape(-1, *shape), 0, -1)[inside]

    def shared(self, weights: np.ndarray, sub_sample: np.ndarray, seen: np.ndarray) -> Film:
        """The film whose pixels share their samples. `weights` (N, D, D) are those of the N points of a pixel,
        `sub_sample` (P,) is the point of each sample, `seen` (H, W) the mask of the rendered pixels."""
        whole = self.sums_around(np.flatnonzero(seen), weights.sum(axis=0))
        spread = weights.astype(np.float32)[sub_sample]
        return replace(self, spread=spread, whole=np.where(seen, whole, np.inf))

    def sums_around(self, pixel: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Sums (H, W) of `weights` (D, D) laid around each `pixel` (Q,)."""
        every = replace(self, pixel=pixel)
        return every._sums(np.ones((len(pixel), 1)), np.broadcast_to(weights, (len(pixel), *weights.shape)))[..., 0]

    def reached(self, mask: np.ndarray) -> np.ndarray:
        """Mask (H, W) of the pixels that share samples with a pixel of `mask` (H, W)."""
        around = 0 if self.spread is None else self.spread.shape[1] // 2
        grid = np.pad(mask, around)
        steps = itertools.product(range(2 * around + 1), repeat=2)
        return np.any([grid[y : y + self.height, x : x + self.width] for y, x in steps], axis=0)

    def variance(self, values: np.ndarray) -> np.ndarray:
        """Variance (H, W) of `image`, from the variances `values` (P,) of independent samples."""
        if self.spread is not None:
            return self._sums(np.asarray(values)[:, None], np.square(self.spread))[..., 0] / np.square(self.whole)
        return self.image(values if self.count is None else values * self.count) / self.sub_samples

    def coverage(self) -> np.ndarray:
        """Share (H, W) of each pixel's sub-samples that hit a surface."""
        return self.image(np.ones(self.pixel.shape[0]) if self.first is None else self.first)


@dataclass(frozen=True)
class Border:
    """The rectangle of the picture that was rendered, in pixels from the top left corner of the whole picture.

    A `cropped` picture has the size of the rectangle. Others have the full size and are empty outside of it.
    """

    left: int
    top: int
    width: int
    height: int
    full_width: int
    full_height: int
    cropped: bool = False

    def __str__(self):
        return (
            f"{self.width}x{self.height} at {self.left},{self.top} of {self.full_width}x{self.full_height}, "
            f"{'cropped' if self.cropped else 'in place'}"
        )


@dataclass(frozen=True)
class ColorSpace:
    """The linear RGB space of all colors of a file: its name and the matrix to linear Rec.709."""

    name: str
    to_rec709: np.ndarray  # (3, 3), with both spaces' white points made equal; applied to column vectors

    def __post_init__(self):
        matrix = np.asarray(self.to_rec709, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError(f"color space {self.name!r}: matrix {matrix!r}, expected 3 x 3 finite numbers")
        object.__setattr__(self, "to_rec709", matrix)

    def rec709(self, colors: np.ndarray) -> np.ndarray:
        """Colors (..., 3) of this space in linear Rec.709."""
        return np.asarray(colors) @ self.to_rec709.T


REC709 = ColorSpace("Linear Rec.709", np.eye(3))
