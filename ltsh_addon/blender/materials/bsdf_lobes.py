"""What the sockets of BSDF nodes mean for the lobes of `aovs`, and what of them is not shaded (runs in the child)."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np

from ...shading.brdf import schlick_curve
from .aovs import LOBE_AOVS, LOBE_KINDS
from .reflectance import f82_dip
from .shader_graph import cut, is_constant, is_socket, live_link, product, value_of

PRINCIPLED = "ShaderNodeBsdfPrincipled"
METALLIC = "ShaderNodeBsdfMetallic"
# BSDF -> kind of lobe, {AOV of aovs.LOBE_AOVS: socket name}.
LOBE_SOCKETS = {
    PRINCIPLED: (
        "principled",
        {
            "color": "Base Color",
            "roughness": "Roughness",
            "metallic": "Metallic",
            "ior": "IOR",
            "specular_level": "Specular IOR Level",
            "tint": "Specular Tint",
            "transmission": "Transmission Weight",
            "sheen_weight": "Sheen Weight",
            "sheen_tint": "Sheen Tint",
            "sheen_roughness": "Sheen Roughness",
            "coat_weight": "Coat Weight",
            "coat_roughness": "Coat Roughness",
            "coat_ior": "Coat IOR",
            "coat_tint": "Coat Tint",
            "coat_normal": "Coat Normal",
        },
    ),
    "ShaderNodeBsdfAnisotropic": ("glossy", {"color": "Color", "roughness": "Roughness"}),
    "ShaderNodeBsdfDiffuse": ("diffuse", {"color": "Color"}),
    "ShaderNodeBsdfTranslucent": ("translucent", {"color": "Color"}),
    "ShaderNodeBsdfGlass": ("glass", {"color": "Color", "roughness": "Roughness", "ior": "IOR"}),
    "ShaderNodeBsdfSheen": ("diffuse", {"color": "Color"}),
    "ShaderNodeSubsurfaceScattering": ("diffuse", {"color": "Color"}),
    "ShaderNodeBsdfToon": ("diffuse", {"color": "Color"}),
}
# Distribution -> alpha of the GGX lobe that comes nearest, in units of its own: half the error of the same alpha.
NEAREST_ALPHA = {"BECKMANN": 0.75, "ASHIKHMIN_SHIRLEY": 0.9}
CONDUCTOR = "conductor" if bpy.app.version >= (5, 0, 0) else "conductor_4_5"
METALLIC_SOCKETS = {
    "F82": ("metal", {"color": "Base Color", "tint": "Edge Tint", "roughness": "Roughness"}),
    "PHYSICAL_CONDUCTOR": (CONDUCTOR, {"color": "IOR", "tint": "Extinction", "roughness": "Roughness"}),
}
SHEEN = "ShaderNodeBsdfSheen"
MICROFIBER_SOCKETS = "sheen", {"color": "Color", "roughness": "Roughness"}
# Node -> what is said of it.
NEAREST = {
    "ShaderNodeBsdfGlass": "lets no light through, only its reflection is shaded, of back faces about",
    "ShaderNodeBsdfSheen": "is not supported, it is shaded as a Diffuse BSDF of the same albedo",
    "ShaderNodeSubsurfaceScattering": "is not supported, it is shaded as a Diffuse BSDF",
    "ShaderNodeBsdfToon": "is not supported, it is shaded as a Diffuse BSDF of the same albedo",
}
# Metals that are darker than minus this are worth a warning.
NEGLIGIBLE_REFLECTANCE = -1e-3
NOT_SUPPORTED = "is not supported, it is not shaded"
# Node -> {socket: (value at which it changes nothing, what is done)}; sockets absent in a version are skipped.
NOT_SHADED = {
    PRINCIPLED: {
        "Diffuse Roughness": (0.0, "is shaded as 0"),
        "Subsurface Weight": (0.0, "is shaded as diffuse reflection"),
        "Anisotropic": (0.0, "is shaded as 0"),
        "Transmission Weight": (0.0, "lets no light through, only the reflection is shaded, of back faces about"),
        "Sheen Weight": (0.0, "adds diffuse reflection of the same albedo"),
        "Thin Wall": (0.0, "is shaded as off"),
        "Thin Film Thickness": (0.0, "is shaded as 0"),
    },
    "ShaderNodeBsdfAnisotropic": {"Anisotropy": (0.0, "is shaded as 0")},
    "ShaderNodeBsdfDiffuse": {"Roughness": (0.0, "is shaded as 0")},
    "ShaderNodeBsdfGlass": {"Thin Film Thickness": (0.0, "is shaded as 0")},
    METALLIC: {
        "Anisotropy": (0.0, "is shaded as 0"),
        "Thin Film Thickness": (0.0, "is shaded as 0"),
    },
}
# Nodes whose lobe is multiplied by what multiple scattering adds.
MULTIPLE_SCATTERING_NODES = (
    PRINCIPLED,
    "ShaderNodeBsdfAnisotropic",
    METALLIC,
    "ShaderNodeBsdfGlass",
)


def lobe_of(node, warn: Callable[[str], None]) -> dict:
    """What the BSDF `node` writes: AOV of `aovs.LOBE_AOVS` -> value of `shader_graph.value_of`; {} without a lobe.

    Quantities that change nothing are left out. `warn` gets what is not shaded as Cycles does.
    """
    sockets = LOBE_SOCKETS.get(node.bl_idname)
    if node.bl_idname == METALLIC:
        sockets = METALLIC_SOCKETS[node.fresnel_type]
    if node.bl_idname == SHEEN and node.distribution == "MICROFIBER":
        sockets = MICROFIBER_SOCKETS
    if sockets is None or (node.bl_idname == "ShaderNodeBsdfToon" and node.component != "DIFFUSE"):
        warn(f"node {node.name!r} {NOT_SUPPORTED}")
        return {}
    note_unsupported(node, warn)
    kind, names = sockets
    values = {"kind": LOBE_KINDS[kind], **{aov: value_of(node.inputs[name]) for aov, name in names.items()}}
    nearest_alpha = NEAREST_ALPHA.get(getattr(node, "distribution", ""))
    if nearest_alpha is not None:
        values["roughness"] = product(node.id_data, values["roughness"], nearest_alpha**0.5)
    normal = live_link(node.inputs["Normal"])
    if normal is not None:
        values["normal"] = normal.from_socket
    if kind == "principled":
        _drop_absent_layers(node, values)
    if getattr(node, "distribution", "") == "MULTI_GGX" and node.bl_idname in MULTIPLE_SCATTERING_NODES:
        values["multiple_scattering"] = 1.0
    if kind == "glass" or "transmission" in values:
        backfacing = node.id_data.nodes.new("ShaderNodeNewGeometry").outputs["Backfacing"]
        values["backfacing"] = backfacing
    return {name: value for name, value in values.items() if name == "kind" or not _is_neutral(name, value)}


def cut_alpha(tree, node, warn: Callable[[str], None]) -> None:
    """Make a Principled BSDF `node` of `tree` opaque."""
    if node.bl_idname != PRINCIPLED or is_constant(value_of(node.inputs["Alpha"]), 1.0):
        return
    warn(f"Alpha of {node.name!r} is cut, the surface is shaded and rendered opaque")
    cut(tree, node.inputs["Alpha"])
    node.inputs["Alpha"].default_value = 1.0


def is_emission(node) -> bool:
    """True for nodes that do nothing but shine, as a color does that is linked to a shader socket."""
    return node.bl_idname == "ShaderNodeEmission" or all(socket.type != "SHADER" for socket in node.outputs)


def emits(node) -> bool:
    """True for nodes that shine."""
    if is_emission(node):
        return True
    if node.bl_idname != PRINCIPLED:
        return False
    strength, color = value_of(node.inputs["Emission Strength"]), value_of(node.inputs["Emission Color"])
    return not is_constant(strength, 0.0) and not is_constant(color, (0.0, 0.0, 0.0))


def _is_neutral(name, value) -> bool:
    kind, neutral = LOBE_AOVS[name]
    return neutral is not None and is_constant(value, neutral)


def _drop_absent_layers(node, values) -> None:
    """Leave layers out whose weight is 0. An unlinked Coat Normal is the smooth normal, not that of the base."""
    for layer in ("coat", "sheen"):
        if _is_neutral(f"{layer}_weight", values[f"{layer}_weight"]):
            for name in [name for name in values if name.startswith(f"{layer}_")]:
                del values[name]
    if "coat_normal" in values and live_link(node.inputs["Coat Normal"]) is None:
        del values["coat_normal"]
    if _is_neutral("transmission", values["transmission"]):
        del values["transmission"]


def note_unsupported(node, warn: Callable[[str], None]) -> None:
    """Call `warn` with what the lobe of a BSDF `node` is shaded as and is not; changes nothing."""
    kind = node.bl_idname
    if kind in NEAREST:
        warn(f"node {node.name!r} {NEAREST[kind]}")
    for name, (neutral, done) in NOT_SHADED.get(kind, {}).items():
        if name in node.inputs and not is_constant(value_of(node.inputs[name]), neutral):
            warn(f"{name} of {node.name!r} {done}")
    _note_reflectance(node, warn)
    distribution = getattr(node, "distribution", "")
    if distribution in NEAREST_ALPHA:
        alpha = f"{NEAREST_ALPHA[distribution]} times its alpha"
        warn(f"distribution {distribution} of {node.name!r} is shaded as GGX of {alpha}")


def _note_reflectance(node, warn) -> None:
    """Name indices of refraction below 1, and metals whose reflectance Cycles clips."""
    if node.bl_idname in (PRINCIPLED, "ShaderNodeBsdfGlass"):
        ior = value_of(node.inputs["IOR"])
        if is_socket(ior):
            warn(f"IOR of {node.name!r} varies: where it is below 1, the reflectance is that for the mirror direction")
        elif ior < 1.0:
            warn(f"IOR of {node.name!r} is below 1, its reflectance is that for the mirror direction")
    if node.bl_idname == PRINCIPLED:
        tint = "" if is_constant(value_of(node.inputs["Metallic"]), 0.0) else "Specular Tint"
    else:
        tint = "Edge Tint" if node.bl_idname == METALLIC and node.fresnel_type == "F82" else ""
    if tint and may_be_negative(value_of(node.inputs["Base Color"]), value_of(node.inputs[tint])):
        warn(f"{tint} of {node.name!r} is so dark that the reflectance of the metal, as shaded, falls below 0")


def may_be_negative(color, tint) -> bool:
    """True if the F82 reflectance of a metal of these colors (of `shader_graph.value_of`) may fall below 0."""
    if is_constant(tint, (1.0, 1.0, 1.0)):
        return False
    # The darker both are, the lower is the curve.
    f0, edge = (np.zeros(3) if is_socket(value) else np.clip(value[:3], 0.0, 1.0) for value in (color, tint))
    c = np.linspace(0.0, 1.0, 101)[:, None]
    curve = f0 + (1.0 - f0) * schlick_curve(c) - f82_dip(f0, edge) * c * (1.0 - c) ** 6
    return bool(curve.min() < NEGLIGIBLE_REFLECTANCE)
