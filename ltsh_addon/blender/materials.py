"""Shader outputs (AOVs) that carry what shading needs, put into the materials of the opened file (runs in the child).

Supported are Principled BSDF, Glossy BSDF and Diffuse BSDF with anything feeding their sockets. What else Cycles would
render is named in a warning and shaded as the nearest of these.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy

from .gbuffer import AOV_PREFIX, AOVS, LOBES
from .hair import bends_normals
from .shader_graph import (
    TRANSPARENT_NODES,
    BsdfSearch,
    ensure_nodes,
    fill_with_bsdf,
    live_link,
    material_output,
)

# Socket -> value at which it changes nothing; absent sockets (by version) are skipped.
NEUTRAL_PRINCIPLED = {
    "Diffuse Roughness": 0.0,
    "Subsurface Weight": 0.0,
    "Specular Tint": (1.0, 1.0, 1.0),
    "Anisotropic": 0.0,
    "Transmission Weight": 0.0,
    "Coat Weight": 0.0,
    "Sheen Weight": 0.0,
    "Thin Film Thickness": 0.0,
}
# Custom property of objects that tells which lights reach them: a value of `AreaLight.receivers`.
RECEIVER_PROPERTY = "ltsh_receiver"
NEUTRAL_GLOSSY = {"Anisotropy": 0.0}
NEUTRAL_DIFFUSE = {"Roughness": 0.0}

# BSDF -> (lobe, {AOV: socket name or constant}).
LOBE_SOCKETS = {
    "ShaderNodeBsdfPrincipled": (
        "principled",
        {
            "color": "Base Color",
            "roughness": "Roughness",
            "metallic": "Metallic",
            "ior": "IOR",
            "specular_level": "Specular IOR Level",
        },
    ),
    "ShaderNodeBsdfAnisotropic": ("glossy", {"color": "Color", "roughness": "Roughness"}),
    "ShaderNodeBsdfDiffuse": ("none", {"roughness": 1.0}),
    "ShaderNodeBsdfGlass": ("principled", {"roughness": "Roughness", "ior": "IOR", "specular_level": 0.5}),
    "ShaderNodeBsdfMetallic": ("principled", {"color": "Base Color", "roughness": "Roughness", "metallic": 1.0}),
}
SUPPORTED = ("ShaderNodeBsdfPrincipled", "ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfDiffuse")
NEAREST = {
    "ShaderNodeBsdfGlass": "shaded as the reflection of a dielectric",
    "ShaderNodeBsdfMetallic": "shaded as a Principled metal",
}


@dataclass
class MaterialReport:
    """Warnings about materials; the multiple-scattering ones are gathered into one line."""

    warnings: list[str] = field(default_factory=list)
    multiple_scattering: list[str] = field(default_factory=list)

    def warn(self, material_name: str, message: str) -> None:
        """Note `message` about a material once."""
        line = f"material {material_name!r}: {message}"
        if line not in self.warnings:
            self.warnings.append(line)

    def lines(self) -> list[str]:
        """All warnings."""
        gathered = []
        if self.multiple_scattering:
            names = ", ".join(repr(name) for name in sorted(self.multiple_scattering))
            gathered.append(
                "distribution Multiscatter GGX is shaded as GGX (rough surfaces come out darker than in Cycles), "
                f"materials: {names}"
            )
        return self.warnings + gathered


def materials_in_use(surfaces: list, override=None) -> list:
    """Original materials of the evaluated objects `surfaces`, each once; only `override` where one is set."""
    if override is not None:
        return [override.original]
    found = {}
    for ob in surfaces:
        for slot in ob.material_slots:
            if slot.material is not None:
                found[slot.material.original.name_full] = slot.material.original
    return list(found.values())


def objects_without_material(surfaces: list) -> list:
    """Original objects of `surfaces` with no material slot or an empty one."""
    found = {}
    for ob in surfaces:
        slots = ob.material_slots
        if len(slots) == 0 or any(slot.material is None for slot in slots):
            found[ob.original.name_full] = ob.original
    return list(found.values())


def give_default_material(objects: list):
    """Put a material that looks like Cycles' default surface where none is assigned; the material, or None."""
    if not objects:
        return None
    material = bpy.data.materials.new("Default surface")
    ensure_nodes(material)
    # Measured: a gray Diffuse BSDF in 4.5.15, a Principled BSDF with all its defaults in 5.2.3.
    default = "ShaderNodeBsdfDiffuse" if bpy.app.version < (5, 0, 0) else "ShaderNodeBsdfPrincipled"
    fill_with_bsdf(material.node_tree, default, (0.8, 0.8, 0.8, 1.0))
    for ob in objects:
        if len(ob.material_slots) == 0:
            ob.data.materials.append(material)
        for slot in ob.material_slots:
            if slot.material is None:
                slot.material = material
    return material


def inject_aovs(materials: list, report: MaterialReport, emitters: frozenset[str] = frozenset()) -> None:
    """Make every material write the quantities of `gbuffer.AOVS`; cut transparency and volumes.

    Materials light nothing, but for those with a full name in `emitters`, of whose emission nothing is said either.
    """
    for material in materials:
        ensure_nodes(material)
        if material.name_full not in emitters:
            material.cycles.emission_sampling = "NONE"
        _inject_into(material, report)


def declare_aovs(view_layer) -> None:
    """Add the passes of `gbuffer.AOVS` to `view_layer`."""
    for name, kind in AOVS.items():
        aov = view_layer.aovs.add()
        aov.name, aov.type = AOV_PREFIX + name, kind


def remove_aovs(view_layer) -> None:
    """Take the passes of `declare_aovs` out again."""
    for aov in [aov for aov in view_layer.aovs if aov.name.startswith(AOV_PREFIX)]:
        view_layer.aovs.remove(aov)


def _inject_into(material, report: MaterialReport) -> None:
    tree = material.node_tree
    output = material_output(tree)
    found = None
    if output is not None:
        volume = live_link(output.inputs["Volume"])
        if volume is not None:
            tree.links.remove(volume)
            report.warn(material.name, "its volume is not shaded; left out of the Cycles reference as well")
        found = BsdfSearch(lambda message: report.warn(material.name, message)).find(tree, output.inputs["Surface"])
    if found is None:
        _add_aovs(tree, None, "none", {"roughness": 1.0}, material)
        return
    tree, node = found
    if node.bl_idname in TRANSPARENT_NODES:
        return  # nothing to shade: rays and AOVs go on to the next surface
    lobe, sockets = LOBE_SOCKETS.get(node.bl_idname, ("none", {"roughness": 1.0}))
    _note_unsupported(material, tree, node, report)
    _add_aovs(tree, node, lobe, sockets, material)


def _note_unsupported(material, tree, node, report: MaterialReport) -> None:
    def warn(message):
        report.warn(material.name, message)

    kind = node.bl_idname
    if kind == "ShaderNodeEmission":
        warn("emission is not shaded and lights nothing, in the Cycles reference neither")
        return
    if kind not in SUPPORTED:
        warn(f"node {node.name!r} is not supported, {NEAREST.get(kind, 'its specular part is not shaded')}")
    neutral = {
        "ShaderNodeBsdfPrincipled": NEUTRAL_PRINCIPLED,
        "ShaderNodeBsdfAnisotropic": NEUTRAL_GLOSSY,
        "ShaderNodeBsdfDiffuse": NEUTRAL_DIFFUSE,
    }.get(kind, {})
    for name, value in neutral.items():
        if name in node.inputs and not _is_constant(node.inputs[name], value):
            warn(f"{name} of {node.name!r} is not shaded")
    if kind == "ShaderNodeBsdfPrincipled":
        _cut_principled_extras(tree, node, warn)
    distribution = getattr(node, "distribution", "GGX")
    if distribution == "MULTI_GGX" and kind in SUPPORTED:
        report.multiple_scattering.append(material.name)
    elif distribution != "GGX" and kind in SUPPORTED:
        warn(f"distribution {distribution} of {node.name!r} is shaded as GGX")


def _cut_principled_extras(tree, node, warn) -> None:
    alpha = node.inputs["Alpha"]
    if not _is_constant(alpha, 1.0):
        warn(f"Alpha of {node.name!r} is cut, the surface is shaded and rendered opaque")
        _cut(tree, alpha)
        alpha.default_value = 1.0
    strength, color = node.inputs["Emission Strength"], node.inputs["Emission Color"]
    if not _is_constant(strength, 0.0) and not _is_constant(color, (0.0, 0.0, 0.0)):
        warn("emission is not shaded and lights nothing, in the Cycles reference neither")


def _cut(tree, socket) -> None:
    for link in list(socket.links):
        tree.links.remove(link)


def _is_constant(socket, value) -> bool:
    if live_link(socket) is not None:
        return False
    found = socket.default_value
    if isinstance(value, tuple):
        return all(abs(a - b) < 1e-6 for a, b in zip(found, value, strict=False))
    return abs(found - value) < 1e-6


def _add_aovs(tree, node, lobe: str, sockets: dict, material) -> None:
    """AOV nodes beside `node` (inside the group where it is), fed by what feeds its `sockets`."""
    geometry = tree.nodes.new("ShaderNodeNewGeometry")
    _aov(tree, "hit", 1.0)
    _aov(tree, "lobe", LOBES[lobe])
    receiver = tree.nodes.new("ShaderNodeAttribute")
    receiver.attribute_type, receiver.attribute_name = "OBJECT", RECEIVER_PROPERTY
    _aov(tree, "receiver", receiver.outputs["Fac"])
    _aov(tree, "correct_normal", bends_normals(tree) if material.cycles.use_bump_map_correction else 0.0)
    _aov(tree, "position", geometry.outputs["Position"])
    _aov(tree, "incoming", geometry.outputs["Incoming"])
    _aov(tree, "smooth_normal", geometry.outputs["Normal"])
    _aov(tree, "true_normal", geometry.outputs["True Normal"])
    normal = live_link(node.inputs["Normal"]) if node is not None and "Normal" in node.inputs else None
    _aov(tree, "normal", normal.from_socket if normal else geometry.outputs["Normal"])
    for name, wanted in sockets.items():
        if isinstance(wanted, str):
            link = live_link(node.inputs[wanted])
            wanted = link.from_socket if link else node.inputs[wanted].default_value
        _aov(tree, name, wanted)


def _aov(tree, name: str, value) -> None:
    """One AOV output: `value` is a socket, a number or a color."""
    node = tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = AOV_PREFIX + name
    target = node.inputs["Color" if AOVS[name] == "COLOR" else "Value"]
    if isinstance(value, bpy.types.NodeSocket):
        tree.links.new(value, target)
    else:
        target.default_value = value
