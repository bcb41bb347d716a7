"""What the emission of a node tree depends on, read from its nodes (runs in the child)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from ..materials.node_sources import source_of
from ..materials.shader_graph import live_link

# Nodes whose value is the same everywhere, as long as what they are fed is.
CONSTANT_NODES = frozenset(
    "ShaderNode" + name
    for name in (
        *("Value", "RGB", "Blackbody", "Wavelength", "Math", "VectorMath", "Mix", "MixRGB", "Clamp", "MapRange"),
        *("CombineColor", "SeparateColor", "CombineXYZ", "SeparateXYZ", "ValToRGB", "HueSaturation", "Gamma"),
        *("BrightContrast", "Invert", "RGBCurve", "VectorCurve", "FloatCurve", "RGBToBW"),
    )
) | {"FunctionNodeInputColor", "FunctionNodeInputVector", "FunctionNodeInputInt", "FunctionNodeInputBool"}
# Values that depend on where the light shines, by node and output; all outputs where none is named.
DIRECTIONAL = {
    "ShaderNodeLightPath": (),
    "ShaderNodeLayerWeight": (),
    "ShaderNodeFresnel": (),
    "ShaderNodeCameraData": (),
    "ShaderNodeLightFalloff": (),
    "ShaderNodeTexIES": (),
    "ShaderNodeNewGeometry": ("Incoming",),
    "ShaderNodeTexCoord": ("Camera", "Window", "Reflection"),
}
# What each shader node's emission is made of: shader inputs, and value inputs.
SHADERS = {
    "ShaderNodeMixShader": ((1, 2), (0,)),
    "ShaderNodeAddShader": ((0, 1), ()),
    "ShaderNodeEmission": ((), ("Color", "Strength")),
    "ShaderNodeBsdfPrincipled": ((), ("Emission Color", "Emission Strength", "Alpha")),
}


@dataclass
class Emission:
    """What was found behind a shader socket."""

    emits: bool = False
    plain: bool = False  # one Emission node, white, of strength 1
    varies: bool = False
    directional: set[str] = field(default_factory=set)  # labels of nodes


def emission_behind(tree, socket, groups: tuple = ()) -> Emission:
    """What emits behind the shader input `socket` of `tree`; `groups` leads there, as (tree, group node) pairs."""
    found = Emission()
    for owner, node, _, path in _sources(tree, socket, groups):
        if node.bl_idname not in SHADERS:
            continue
        shaders, values = SHADERS[node.bl_idname]
        found.plain = node.bl_idname == "ShaderNodeEmission" and _is_neutral(node)
        parts = [emission_behind(owner, node.inputs[name], path) for name in shaders]
        found.emits |= any(part.emits for part in parts) or (not shaders and not _is_dark(node))
        for part in parts:
            found.varies |= part.varies
            found.directional |= part.directional
        if found.emits:
            for name in values:
                _note_values(owner, node.inputs[name], path, found, set())
    return found


def _is_dark(node) -> bool:
    """True if an Emission or Principled node certainly emits nothing."""
    prefix = "Emission " if "Emission Strength" in node.inputs else ""
    strength, color = node.inputs[prefix + "Strength"], node.inputs[prefix + "Color"]
    if live_link(strength) is None and strength.default_value == 0.0:
        return True
    return live_link(color) is None and not any(color.default_value[:3])


def _is_neutral(node) -> bool:
    """True if an Emission node multiplies by 1."""
    strength, color = node.inputs["Strength"], node.inputs["Color"]
    linked = live_link(strength) or live_link(color)
    return not linked and strength.default_value == 1.0 and tuple(color.default_value[:3]) == (1.0, 1.0, 1.0)


def _note_values(tree, socket, groups, found: Emission, seen: set) -> None:
    """Note in `found` what the value at the input `socket` depends on."""
    for owner, node, output, path in _sources(tree, socket, groups):
        key = (owner.name_full, node.name, output.identifier, len(path))
        if key in seen:
            continue
        seen.add(key)
        kind = node.bl_idname
        if kind in DIRECTIONAL and (not DIRECTIONAL[kind] or output.name in DIRECTIONAL[kind]):
            found.directional.add(node.bl_label)
        found.varies |= kind not in CONSTANT_NODES
        for entry in node.inputs:
            _note_values(owner, entry, path, found, seen)


def _sources(tree, socket, groups) -> Iterator[tuple]:
    """(tree, node, output, groups) of what feeds the input `socket`, past reroutes, muted nodes and groups."""
    source = source_of(tree, socket, groups)
    if source is not None and source.node is not None:
        yield source.tree, source.node, source.socket, source.groups
