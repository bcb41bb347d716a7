"""Area lights of an evaluated scene as `AreaLight` (runs in the child).

Radiance as Cycles has it: L = color * temperature color * energy * 2^exposure / pi [/ area if normalize], one-sided
along the local -Z axis. Size and shape follow the first two columns of the world matrix. Measured against
Cycles 4.5.15 and 5.2.3 to 2e-5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import bpy
import numpy as np

from ..scene import AREA_LIGHT_SHAPES, AreaLight

# Two axes further from a right angle than this (cosine) are called sheared.
SHEAR_COSINE = 1e-4


@dataclass
class LightInventory:
    """Lights that can be shaded, what cannot, and the names of the objects to leave out of the reference."""

    lights: list[AreaLight] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    left_out: set[str] = field(default_factory=set)

    def warn(self, message: str) -> None:
        """Note `message` once."""
        if message not in self.warnings:
            self.warnings.append(message)


def collect_lights(depsgraph) -> LightInventory:
    """All lights that a render of `depsgraph` sees, instances included."""
    inventory = LightInventory()
    placed = []
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type != "LIGHT" or not instance.show_self:
            continue
        matrix = np.array(instance.matrix_world, dtype=np.float64)
        problem = _reason_to_leave_out(ob, matrix)
        if problem:
            inventory.left_out.add(ob.original.name_full)
            inventory.warn(f"light {ob.original.name!r}: {problem}; left out of the Cycles reference as well")
        else:
            placed.append((ob.original.name_full, _area_light(ob, matrix)))
            _note_unsupported(ob, matrix, inventory)
    # One unusable instance takes all instances of the object along: the reference can only drop the object.
    inventory.lights = [
        light for name, light in placed if name not in inventory.left_out and np.any(light.radiance != 0.0)
    ]
    return inventory


def _reason_to_leave_out(ob, matrix: np.ndarray) -> str:
    light = ob.data
    if light.type != "AREA":
        return f"{light.type} lights are not shaded, only area lights are"
    if light.shape not in AREA_LIGHT_SHAPES:
        return f"shape {light.shape} is not supported"
    if light.cycles.is_portal:
        return "it is a light portal, which only guides the sampling of the world"
    if not np.isfinite(matrix).all():
        return "its transform is not finite"
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if min(_sizes(light)) * lengths[:2].min() <= 0.0 or lengths[2] <= 0.0:
        return "its size or scale is zero"
    return ""


def _sizes(light) -> tuple[float, float]:
    """Full side lengths, or diameters, in m before scaling."""
    return light.size, light.size if light.shape in ("SQUARE", "DISK") else light.size_y


def _area_light(ob, matrix: np.ndarray) -> AreaLight:
    light = ob.data
    size_u, size_v = _sizes(light)
    half_u, half_v = 0.5 * size_u * matrix[:3, 0], 0.5 * size_v * matrix[:3, 1]
    return AreaLight(
        name=ob.original.name,
        shape=light.shape,
        center=matrix[:3, 3],
        half_u=half_u,
        half_v=half_v,
        direction=-matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]),
        radiance=_radiance(light, half_u, half_v),
        group=ob.original.lightgroup,
        affects_diffuse=ob.visible_diffuse,
        affects_specular=ob.visible_glossy,
    )


def _radiance(light, half_u: np.ndarray, half_v: np.ndarray) -> np.ndarray:
    """Emitted radiance (3,) in W m^-2 sr^-1."""
    value = np.array(light.color, dtype=np.float64) * light.energy * 2.0**light.exposure / math.pi
    if light.use_temperature:
        value *= np.array(light.temperature_color, dtype=np.float64)[:3]
    if light.normalize:
        area = 4.0 * np.linalg.norm(half_u) * np.linalg.norm(half_v)
        value /= area * (math.pi / 4.0 if light.shape in ("DISK", "ELLIPSE") else 1.0)
    factor, _ = node_factor(light)
    return value * factor


def node_factor(light) -> tuple[np.ndarray, str]:
    """What the light's node tree multiplies the radiance by (3,), and the reason if that is not a constant.

    Since 5.0 every light has a node tree, by default one white Emission node of strength 1.
    """
    neutral = np.ones(3)
    tree = light.node_tree
    uses_nodes = tree is not None and (bpy.app.version >= (5, 0, 0) or light.use_nodes)
    if not uses_nodes:
        return neutral, ""
    outputs = [
        node
        for node in tree.nodes
        if node.bl_idname == "ShaderNodeOutputLight" and node.is_active_output and not node.mute
    ]
    if not outputs or not outputs[0].inputs["Surface"].is_linked:
        return np.zeros(3), ""
    emission = outputs[0].inputs["Surface"].links[0].from_node
    if emission.bl_idname != "ShaderNodeEmission" or emission.mute:
        return neutral, f"node {emission.name!r}"
    if emission.inputs["Color"].is_linked or emission.inputs["Strength"].is_linked:
        return neutral, f"a texture on node {emission.name!r}"
    color = np.array(emission.inputs["Color"].default_value, dtype=np.float64)[:3]
    return color * emission.inputs["Strength"].default_value, ""


def _note_unsupported(ob, matrix: np.ndarray, inventory: LightInventory) -> None:
    """Warn of what Cycles renders for this light and the techniques do not."""
    light, name = ob.data, ob.original.name
    if light.spread < math.pi - 1e-4:
        inventory.warn(f"light {name!r}: spread {math.degrees(light.spread):.0f} degrees is shaded as 180 degrees")
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    if np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR_COSINE:
        inventory.warn(f"light {name!r}: its transform is sheared, which Cycles itself does not sample correctly")
    reason = node_factor(light)[1]
    if reason:
        inventory.warn(f"light {name!r}: {reason} in its node tree is not shaded")
    linking = getattr(ob.original, "light_linking", None)
    if linking is not None and linking.receiver_collection is not None:
        inventory.warn(
            f"light {name!r}: light linking to {linking.receiver_collection.name!r} is ignored, it lights everything"
        )
    if light.energy < 0.0:
        inventory.warn(f"light {name!r}: negative power {light.energy:g} W subtracts light")
