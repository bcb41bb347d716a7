"""Materials as the viewport shades them: lobes of constants and flat images (`look_reader` makes them)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from .linear_values import ImageUse, Value, constant

# Quantities that may come from an image; all others are constants.
IMAGE_SLOTS = ("color", "roughness", "metallic", "ior", "normal", "weight")
NEUTRAL = {"color": 0.8, "roughness": 1.0, "metallic": 0.0, "ior": 1.5, "specular_level": 0.5, "tint": 1.0,
           "transmission": 0.0, "weight": 1.0}  # fmt: skip
# The kind of a lobe that is the coat of another one; all others are those of `aovs.LOBE_KINDS`.
COAT = "coat"


@dataclass(frozen=True)
class Coat:
    """What covers the lobe of a Principled BSDF: all constants."""

    weight: float
    roughness: float
    ior: float
    tint: np.ndarray  # (3,)
    follows_normal: bool  # has the normal map of the lobe; else no one


@dataclass(frozen=True)
class ViewFactor:
    """What the nodes Fresnel and Layer Weight say of the cosine c between the view and the smooth normal."""

    kind: str  # "fresnel": of a dielectric; "facing": 1 - c^parameter
    parameter: float  # "fresnel": the index of refraction
    is_complement: bool = False  # 1 minus that

    @classmethod
    def of(cls, kind: str, parameter: float, is_blend: bool = False) -> ViewFactor:
        """From the node's number: an index of refraction, or the Blend of a Layer Weight node."""
        if not is_blend:
            return cls(kind, max(parameter, 1e-5))
        if kind == "fresnel":
            return cls(kind, 1.0 / max(1.0 - parameter, 1e-5))
        blend = float(np.clip(parameter, 0.0, 1.0 - 1e-5))
        return cls(kind, 2.0 * blend if blend < 0.5 else 0.5 / (1.0 - blend))

    def complement(self) -> ViewFactor:
        """1 minus this."""
        return replace(self, is_complement=not self.is_complement)


@dataclass(frozen=True)
class Look:
    """One lobe of a material in the viewport; the first one has all that is not a lobe, and the others."""

    kind: str  # of `aovs.LOBE_KINDS`, or COAT
    values: dict[str, Value]  # by the names of NEUTRAL
    normal: Value | None = None  # of a tangent space normal map
    normal_strength: float = 1.0
    scattered: bool = False  # Multiscatter GGX
    corrected: bool = True  # Cycles bends specular normals toward the eye
    weight: float = 1.0
    view_factor: ViewFactor | None = None  # times the weight
    coat: Coat | None = None  # over it; of the kind COAT itself
    emission: np.ndarray = field(default_factory=lambda: np.zeros(3))
    notes: tuple[str, ...] = ()
    further: tuple[Look, ...] = ()  # lobes that are added to this one

    @property
    def lobes(self) -> tuple[Look, ...]:
        """This lobe and the further ones."""
        return (self, *self.further)

    def value(self, name: str) -> Value:
        """The quantity `name`, or what changes nothing."""
        return self.values.get(name) or constant(NEUTRAL[name])

    @property
    def images(self) -> dict[str, ImageUse]:
        """Images by slot of IMAGE_SLOTS."""
        found = {name: value.image for name, value in self.values.items() if name in IMAGE_SLOTS and value.image}
        return {**found, "normal": self.normal.image} if self.normal is not None else found

    @property
    def uv_map(self) -> str:
        """The UV map of its images ("": the active one)."""
        return next((use.uv_map for use in self.images.values()), "")


def is_missing(image) -> bool:
    """True for images without pixels: their file is not there, or cannot be read."""
    return not all(image.size)


def plain_look(color, notes: tuple[str, ...] = ()) -> Look:
    """A diffuse surface."""
    return Look("diffuse", {"color": constant(color)}, notes=notes)


def default_look() -> Look:
    """What Cycles shows where no material is assigned: gray, with a Principled BSDF's defaults from 5.0 on."""
    if bpy.app.version < (5, 0, 0):
        return plain_look(0.8)
    return Look("principled", {"color": constant(0.8), "roughness": constant(0.5)})
