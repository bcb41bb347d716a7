"""Materials as the viewport shades them: one lobe of constants and flat images; nothing is edited.

What cannot be said that way gets the material's viewport settings and is named in `Look.notes`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from ..pixels.cycles_settings import cycles_setting
from .bsdf_leaves import TRANSPARENT_NODES
from .bsdf_lobes import (
    LOBE_SOCKETS,
    METALLIC_SOCKETS,
    MULTIPLE_SCATTERING_NODES,
    NEAREST_ALPHA,
    PRINCIPLED,
    is_emission,
)
from .linear_values import ImageUse, Value, constant
from .node_sources import Source, source_of
from .node_values import value_at
from .shader_graph import material_output

# Quantities that may come from an image; all others are constants.
IMAGE_SLOTS = ("color", "roughness", "metallic", "ior", "normal")
# Quantity of `aovs.LOBE_AOVS` -> viewport setting of the material that stands in for it.
STAND_INS = {"color": "diffuse_color", "roughness": "roughness", "metallic": "metallic"}
NEUTRAL = {"color": 0.8, "roughness": 1.0, "metallic": 0.0, "ior": 1.5, "specular_level": 0.5, "tint": 1.0,
           "transmission": 0.0}  # fmt: skip
# Layers of the Principled BSDF that the viewport leaves out, and what they are called.
LEFT_OUT = {"Coat Weight": "coat", "Sheen Weight": "sheen"}


@dataclass(frozen=True)
class Look:
    """One material in the viewport."""

    kind: str  # of `aovs.LOBE_KINDS`
    values: dict[str, Value]  # by the names of NEUTRAL
    normal: Value | None = None  # of a tangent space normal map
    normal_strength: float = 1.0
    scattered: bool = False  # Multiscatter GGX
    corrected: bool = True  # Cycles bends specular normals toward the eye
    emission: np.ndarray = field(default_factory=lambda: np.zeros(3))
    notes: tuple[str, ...] = ()

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


def look_of(material) -> Look:
    """How the viewport shades `material`."""
    if material is None:
        return default_look()
    if bpy.app.version < (5, 0, 0) and not material.use_nodes:
        return plain_look(material.diffuse_color)
    tree = material.node_tree
    output = material_output(tree) if tree is not None else None
    if output is None:
        return plain_look(0.0)
    walk = _Leaves()
    walk.follow(source_of(tree, output.inputs["Surface"]), 1.0)
    return _Reader(material, walk).look()


class _Leaves:
    """The shader nodes of a material with their shares; of unknown factors both sides get half."""

    def __init__(self):
        self.found: list[tuple[Source, float]] = []
        self.guessed: list[str] = []

    def follow(self, source: Source | None, weight: float) -> None:
        if source is None or source.node is None or weight <= 0.0:
            return
        kind = source.node.bl_idname
        if kind == "ShaderNodeMixShader":
            factor = value_at(source.tree, source.node.inputs[0], source.groups)
            share = 0.5
            if factor is None or not factor.is_constant:
                self.guessed.append(source.node.name)
            else:
                share = float(np.clip(factor.offset[0], 0.0, 1.0))
            self.follow(source.input(1), weight * (1.0 - share))
            self.follow(source.input(2), weight * share)
        elif kind == "ShaderNodeAddShader":
            self.follow(source.input(0), weight)
            self.follow(source.input(1), weight)
        else:
            self.found.append((source, weight))


class _Reader:
    """From the leaves of a material to its look."""

    def __init__(self, material, walk: _Leaves):
        self.material, self.notes = material, []
        self.emitters = [(source, share) for source, share in walk.found if is_emission(source.node)]
        others = [pair for pair in walk.found if not is_emission(pair[0].node)]
        solid = [pair for pair in others if pair[0].node.bl_idname not in TRANSPARENT_NODES]
        if len(solid) < len(others) and solid:
            self.note("transparency is not shown")
        self.leaves = solid
        for name in walk.guessed:
            self.note(f"factor of {name!r} is not resolved")

    def note(self, message: str) -> None:
        """Name something that the viewport does not show as it is."""
        self.notes.append(f"{self.material.name}: {message}")

    def look(self) -> Look:
        emission = np.zeros(3)
        for source, share in self.emitters:
            emission = emission + share * self._emission(source, "Color", "Strength")
        if not self.leaves:
            return Look("diffuse", {"color": constant(0.0)}, emission=emission, notes=tuple(self.notes))
        source, share = max(self.leaves, key=lambda pair: pair[1])
        if len(self.leaves) > 1:
            self.note(f"of {len(self.leaves)} BSDF nodes only {source.node.name!r} is shown")
        node = source.node
        if node.bl_idname == PRINCIPLED:
            emission = emission + share * self._emission(source, "Emission Color", "Emission Strength")
        sockets = LOBE_SOCKETS.get(node.bl_idname)
        if node.bl_idname == "ShaderNodeBsdfMetallic":
            sockets = METALLIC_SOCKETS[node.fresnel_type]
        if sockets is None:
            self.note(f"{node.bl_label} is not shown, its viewport color is")
            return plain_look(self.material.diffuse_color, tuple(self.notes))
        return self._lobe(source, *sockets, emission)

    def _lobe(self, source: Source, kind: str, names: dict[str, str], emission: np.ndarray) -> Look:
        node = source.node
        values = {name: self._value(source, name, names[name]) for name in NEUTRAL if name in names}
        values = self._on_one_uv_map(values)
        distribution = getattr(node, "distribution", "")
        if distribution in NEAREST_ALPHA:
            values["roughness"] = values["roughness"].mapped(NEAREST_ALPHA[distribution] ** 0.5 * np.eye(3))
            self.note(f"distribution {distribution} is shown as GGX")
        for name, layer in LEFT_OUT.items() if kind == "principled" else ():
            weight = value_at(source.tree, node.inputs[name], source.groups)
            if weight is None or not weight.is_constant or weight.offset[0] > 0.0:
                self.note(f"{layer} is not shown")
        normal, strength = self._normal(source, values)
        scattered = distribution == "MULTI_GGX" and node.bl_idname in MULTIPLE_SCATTERING_NODES
        corrected = cycles_setting(self.material, "use_bump_map_correction")
        look = Look(kind, values, normal, strength, scattered, corrected, emission)
        for name in dict.fromkeys(use.image.name for use in look.images.values() if is_missing(use.image)):
            self.note(f"image {name!r} is missing, it is pink")
        return replace(look, notes=tuple(self.notes))

    def _value(self, source: Source, name: str, socket_name: str) -> Value:
        value = value_at(source.tree, source.node.inputs[socket_name], source.groups)
        if value is not None and (value.is_constant or name in IMAGE_SLOTS):
            return value
        self.note(f"{socket_name} is not resolved")
        if name in STAND_INS:
            return constant(getattr(self.material, STAND_INS[name]))
        default = source.node.inputs[socket_name].default_value
        return constant(default if value is None else value.offset)

    def _on_one_uv_map(self, values: dict[str, Value]) -> dict[str, Value]:
        """`values` with stand-ins for the images on other UV maps than the first."""
        first, result = None, {}
        for name, value in values.items():
            if value.image is not None:
                first = value.image.uv_map if first is None else first
                if value.image.uv_map != first:
                    self.note(f"the image of {name} is on another UV map and not shown")
                    value = constant(getattr(self.material, STAND_INS[name]) if name in STAND_INS else NEUTRAL[name])
            result[name] = value
        return result

    def _normal(self, source: Source, values: dict[str, Value]) -> tuple[Value | None, float]:
        """The normal map at the Normal socket and its strength."""
        normal = source.input("Normal") if "Normal" in source.node.inputs else None
        if normal is None or normal.node is None:
            return None, 1.0
        node = normal.node
        if node.bl_idname != "ShaderNodeNormalMap" or node.space != "TANGENT":
            self.note(f"normals from {node.name!r} are not resolved")
            return None, 1.0
        color, strength = (value_at(normal.tree, node.inputs[name], normal.groups) for name in ("Color", "Strength"))
        maps = {value.image.uv_map for value in values.values() if value.image is not None} | {node.uv_map}
        if color is None or strength is None or not strength.is_constant or len(maps - {""}) > 1:
            self.note(f"normals from {node.name!r} are not resolved")
            return None, 1.0
        if color.image is None:
            return None, 1.0
        return color, float(strength.offset[0])

    def _emission(self, source: Source, color_name: str, strength_name: str) -> np.ndarray:
        if color_name not in source.node.inputs:
            return np.zeros(3)
        parts = [value_at(source.tree, source.node.inputs[name], source.groups) for name in (strength_name, color_name)]
        if all(part is not None and part.is_constant for part in parts):
            return parts[0].offset * parts[1].offset
        if parts[0] is None or not parts[0].is_constant or np.any(parts[0].offset):
            self.note("its emission varies and is not shown")
        return np.zeros(3)
