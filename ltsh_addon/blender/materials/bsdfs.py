"""The table of BSDF nodes: how each is shaded and the notes about it; and which nodes emit.

All readers of materials get the row of a node from `bsdf_of`; a node without a row has no lobe.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import bpy

from ...cycles.lobes import LOBE_AOVS, LOBE_KINDS
from . import graph
from .graph import PRINCIPLED, computed, is_constant, is_socket, live_link, product, value_of

EMISSION = "ShaderNodeEmission"
METALLIC, GLASS = "ShaderNodeBsdfMetallic", "ShaderNodeBsdfGlass"
SHEEN, TOON = "ShaderNodeBsdfSheen", "ShaderNodeBsdfToon"
SUBSURFACE = "ShaderNodeSubsurfaceScattering"
# REFRACTION_NODE has no row: it reflects nothing.
REFRACTION_NODE = "ShaderNodeBsdfRefraction"
SEEN_THROUGH = "shows what is behind it sharp, in views also without refraction; comparisons and bakes leave it out"
NOT_SUPPORTED = "is not supported, it is not shaded"
OTHER_PASS = "is in the diffuse pass, in Cycles its Ashikhmin sheen is specular"
SHOWN_RIGHT = SEEN_THROUGH, OTHER_PASS  # ends of notes that do not matter where the passes of a view are one picture
# Node -> the property that selects one of its rows.
VARIANTS = {METALLIC: "fresnel_type", SHEEN: "distribution", TOON: "component"}


@dataclass(frozen=True)
class Bsdf:
    """How a BSDF node is shaded."""

    kind: str  # of cycles.lobes.LOBE_KINDS
    sockets: dict[str, str]  # quantity of LOBE_AOVS -> name of the input socket
    nearest: str = ""  # the note about a node that is not exactly of this kind
    # Socket -> (value at which it changes nothing, the note otherwise). A version of Blender may lack some sockets.
    not_shaded: dict[str, tuple[float, str]] = field(default_factory=dict)
    # These two depend on the node's distribution:
    roughness_factor: float = 1.0  # scales the roughness to that of the nearest GGX lobe
    is_scattered: bool = False  # multiple scattering adds to the lobe


COLOR, ROUGHNESS = {"color": "Color"}, {"roughness": "Roughness"}
BRUSHED = {**ROUGHNESS, "anisotropy": "Anisotropy", "rotation": "Rotation"}
PRINCIPLED_SOCKETS = {
    "color": "Base Color", "roughness": "Roughness", "metallic": "Metallic", "ior": "IOR", "tint": "Specular Tint",
    "specular_level": "Specular IOR Level", "transmission": "Transmission Weight",
    "diffuse_roughness": "Diffuse Roughness", "anisotropy": "Anisotropic", "rotation": "Anisotropic Rotation",
    "sheen_weight": "Sheen Weight", "sheen_tint": "Sheen Tint", "sheen_roughness": "Sheen Roughness",
    "coat_weight": "Coat Weight", "coat_roughness": "Coat Roughness", "coat_ior": "Coat IOR", "coat_tint": "Coat Tint",
    "coat_normal": "Coat Normal",
}  # fmt: skip
CONDUCTOR = "conductor" if bpy.app.version >= (5, 0, 0) else "conductor_4_5"
AS_DIFFUSE = "is not supported, it is shaded as a Diffuse BSDF"
# Relative L2 of a ball and a floor: subsurface with radii from a twentieth to a half of the ball's, and films of 100 to
# 800 nm with indices of refraction of 1.33 and 1.8.
SUBSURFACE_ERROR = "2 to 20 % off, with normal maps 20 to 90 %"
AS_ZERO = (0.0, "is shaded as 0, 2 to 27 % off")
OF_METALLIC = {"Thin Film Thickness": AS_ZERO}
# (node, value of its property of VARIANTS) -> its row.
BSDFS = {
    (PRINCIPLED, ""): Bsdf(
        "principled",
        PRINCIPLED_SOCKETS,
        not_shaded={
            "Subsurface Weight": (0.0, f"is shaded as diffuse reflection: {SUBSURFACE_ERROR}"),
            "Transmission Weight": (0.0, SEEN_THROUGH),
            "Thin Wall": (0.0, "is shaded as off"),
            "Thin Film Thickness": AS_ZERO,
        },
    ),
    ("ShaderNodeBsdfAnisotropic", ""): Bsdf("glossy", {**COLOR, **BRUSHED}),
    ("ShaderNodeBsdfDiffuse", ""): Bsdf("diffuse", {**COLOR, "diffuse_roughness": "Roughness"}),
    ("ShaderNodeBsdfTranslucent", ""): Bsdf("translucent", COLOR),
    (GLASS, ""): Bsdf("glass", {**COLOR, **ROUGHNESS, "ior": "IOR"}, SEEN_THROUGH, {"Thin Film Thickness": AS_ZERO}),
    (METALLIC, "F82"): Bsdf("metal", {**BRUSHED, "color": "Base Color", "tint": "Edge Tint"}, "", OF_METALLIC),
    (METALLIC, "PHYSICAL_CONDUCTOR"): Bsdf(
        CONDUCTOR, {**BRUSHED, "color": "IOR", "tint": "Extinction"}, "", OF_METALLIC
    ),
    (SHEEN, "MICROFIBER"): Bsdf("sheen", {**COLOR, **ROUGHNESS}),
    (SHEEN, "ASHIKHMIN"): Bsdf("velvet", {**COLOR, **ROUGHNESS}, OTHER_PASS),
    # The other component is in Cycles' glossy pass, where no diffuse lobe can replace it.
    (TOON, "DIFFUSE"): Bsdf("diffuse", COLOR, f"{AS_DIFFUSE} of the same albedo, 27 to 72 % off"),
    (SUBSURFACE, ""): Bsdf("diffuse", COLOR, f"{AS_DIFFUSE}, {SUBSURFACE_ERROR}"),
}
# Distribution -> alpha of the nearest GGX lobe, relative to the node's alpha; it has half the error of the same alpha.
NEAREST_ALPHA = {"BECKMANN": 0.75, "ASHIKHMIN_SHIRLEY": 0.9}
# The error of that lobe (root mean square), relative to the light of a ball and a floor under two area lights.
NEAREST_ERROR = {
    "BECKMANN": "5 % off at roughness 0.2, 11 % at 0.5, 28 % at 1",
    "ASHIKHMIN_SHIRLEY": "5 % off at roughness 0.2, 9 % at 0.5, 83 % at 1",
}


def bsdf_of(node) -> Bsdf | None:
    """The row of a shader node, completed by its distribution; None if the node is not shaded."""
    kind, distribution = node.bl_idname, getattr(node, "distribution", "")
    row = BSDFS.get((kind, getattr(node, VARIANTS[kind]) if kind in VARIANTS else ""))
    if row is None:
        return None
    factor = NEAREST_ALPHA.get(distribution, 1.0) ** 0.5
    return replace(row, roughness_factor=factor, is_scattered=distribution == "MULTI_GGX")


def lobe_values(node) -> dict:
    """The values of the BSDF `node`: AOV of `LOBE_AOVS` -> constant or socket, as `graph.value_of`; {} without a lobe.

    Neutral values are left out.
    """
    bsdf = bsdf_of(node)
    if bsdf is None:
        return {}
    values = {"kind": LOBE_KINDS[bsdf.kind]}
    values.update({aov: value_of(node.inputs[name]) for aov, name in bsdf.sockets.items()})
    if bsdf.roughness_factor != 1.0:
        values["roughness"] = product(values["roughness"], bsdf.roughness_factor)
    normal = live_link(node.inputs["Normal"])
    if normal is not None:
        values["normal"] = normal.from_socket
    if "anisotropy" in values:
        _add_tangent(node, values)
    if bsdf.kind == "principled":
        _drop_absent_layers(node, values)
    if bsdf.is_scattered:
        values["multiple_scattering"] = 1.0
    if bsdf.kind == "glass" or "transmission" in values:
        values["backfacing"] = node.id_data.nodes.new("ShaderNodeNewGeometry").outputs["Backfacing"]
    return {name: value for name, value in values.items() if name == "kind" or not _is_neutral(name, value)}


def _is_neutral(name, value) -> bool:
    kind, neutral = LOBE_AOVS[name]
    return neutral is not None and is_constant(value, neutral)


def _add_tangent(node, values) -> None:
    """Add the tangent of an anisotropic node; remove the rotation if the anisotropy is 0."""
    if _is_neutral("anisotropy", values["anisotropy"]):
        del values["rotation"]
        return
    tangent = live_link(node.inputs["Tangent"])
    if tangent is None:
        values["tangent"] = node.id_data.nodes.new("ShaderNodeNewGeometry").outputs["Tangent"]
    else:
        values["tangent"] = tangent.from_socket


def _drop_absent_layers(node, values) -> None:
    """Remove layers whose weight is 0. An unlinked Coat Normal is removed, too: it is the smooth normal."""
    for layer in ("coat", "sheen"):
        if _is_neutral(f"{layer}_weight", values[f"{layer}_weight"]):
            for name in [name for name in values if name.startswith(f"{layer}_")]:
                del values[name]
    if "coat_normal" in values and live_link(node.inputs["Coat Normal"]) is None:
        del values["coat_normal"]
    if _is_neutral("transmission", values["transmission"]):
        del values["transmission"]


def let_through(node) -> tuple | None:
    """What the BSDF `node` lets through at a crossing: the share of red, green and blue light, constants or sockets of
    its tree, and a socket with the direction in which a camera ray goes on. None for nodes that let nothing through.

    Where light leaves glass, the share has what was reflected inside as well, as if the sides were parallel. A thin
    wall is both crossings at once.
    """
    is_principled, is_wall, one = node.bl_idname == PRINCIPLED, False, 1.0
    if is_principled:
        metallic = value_of(node.inputs["Metallic"])
        one = product(value_of(node.inputs["Transmission Weight"]), computed("SUBTRACT", 1.0, metallic))
        is_wall = "Thin Wall" in node.inputs and not is_constant(value_of(node.inputs["Thin Wall"]), 0.0)
    elif node.bl_idname not in (GLASS, REFRACTION_NODE):
        return None
    if is_constant(one, 0.0):
        return None
    tree, color = node.id_data, value_of(node.inputs["Base Color" if is_principled else "Color"])
    if is_socket(color):
        split = tree.nodes.new("ShaderNodeSeparateColor")
        tree.links.new(color, split.inputs[0])
        color = split.outputs
    fresnel, geometry = tree.nodes.new("ShaderNodeFresnel"), tree.nodes.new("ShaderNodeNewGeometry")
    reflected, normal, leaves = fresnel.outputs[0], geometry.outputs["Normal"], geometry.outputs["Backfacing"]
    for name in ("IOR", "Normal"):
        if (link := live_link(node.inputs[name])) is not None:
            tree.links.new(link.from_socket, fresnel.inputs[name])
            normal = link.from_socket if name == "Normal" else normal
        elif name == "IOR":
            fresnel.inputs[name].default_value = node.inputs[name].default_value
    direction, passes = graph.vector("SCALE", geometry.outputs["Incoming"], -1.0), computed("SUBTRACT", 1.0, reflected)
    if is_wall:
        # (1 - F)^2 / (1 - F^2)
        share = computed("DIVIDE", passes, computed("ADD", 1.0, reflected))
        return *(product(product(one, share), channel) for channel in color[:3]), direction
    side = computed("SUBTRACT", computed("MULTIPLY", leaves, 2.0), 1.0)
    bent = graph.vector("REFRACT", direction, normal, computed("POWER", value_of(node.inputs["IOR"]), side))
    is_reflected = computed("LESS_THAN", graph.vector("LENGTH", bent), 0.5)
    mirrored = graph.vector("SCALE", graph.vector("REFLECT", direction, normal), is_reflected)
    shares = []
    for channel in color[:3]:
        tint = computed("POWER", channel, 0.5) if is_principled else channel
        if node.bl_idname == REFRACTION_NODE:
            shares.append(product(tint, computed("SUBTRACT", 1.0, is_reflected)))
            continue
        inside = reflected if is_principled else product(reflected, tint)
        more = computed("SUBTRACT", 1.0, product(leaves, product(inside, inside)))
        share = computed("DIVIDE", product(passes, tint), more)
        shares.append(product(one, computed("ADD", share, product(is_reflected, inside))))
    return *shares, graph.vector("ADD", bent, mirrored)


def emission_sockets(node) -> tuple:
    """The inputs (color, strength) of the emission of a node; () for nodes that cannot emit."""
    prefix = {EMISSION: "", PRINCIPLED: "Emission "}.get(node.bl_idname)
    return () if prefix is None else (node.inputs[f"{prefix}Color"], node.inputs[f"{prefix}Strength"])


def emits(node) -> bool:
    """True for nodes that may emit: neither color nor strength is a constant 0."""
    sockets = emission_sockets(node)
    if not sockets:
        return False
    color, strength = (value_of(socket) for socket in sockets)
    return (is_socket(color) or any(color[:3])) and (is_socket(strength) or strength != 0.0)


def is_emission(node) -> bool:
    """True for nodes that only emit: Emission nodes, and nodes without a shader output, such as a color."""
    return node.bl_idname == EMISSION or all(socket.type != "SHADER" for socket in node.outputs)


def notes_of(node) -> list[str]:
    """Notes about how the shading of a node differs from Cycles: what replaces it, and which parts are left out."""
    bsdf = bsdf_of(node)
    if bsdf is None:
        return [f"node {node.name!r} {SEEN_THROUGH if node.bl_idname == REFRACTION_NODE else NOT_SUPPORTED}"]
    notes = [f"Alpha of {node.name!r} is cut, the surface is shaded and rendered opaque"] if has_alpha(node) else []
    return notes + lobe_notes(node, bsdf, lambda name, value: is_constant(value_of(node.inputs[name]), value))


def lobe_notes(node, bsdf: Bsdf, is_at: Callable[[str, float], bool]) -> list[str]:
    """Those of `notes_of` about the lobes; `is_at` tells whether the input of a name is a constant value."""
    notes = [f"node {node.name!r} {bsdf.nearest}"] if bsdf.nearest else []
    for name, (neutral, done) in bsdf.not_shaded.items():
        if name in node.inputs and not is_at(name, neutral):
            notes.append(f"{name} of {node.name!r} {done}")
    distribution = getattr(node, "distribution", "")
    if distribution in NEAREST_ALPHA:
        alpha = f"{NEAREST_ALPHA[distribution]} times its alpha, {NEAREST_ERROR[distribution]}"
        notes.append(f"distribution {distribution} of {node.name!r} is shaded as GGX of {alpha}")
    return notes


# DIFFERENT_PASSES: node or socket -> the passes that differ from Cycles if it has a note. Others: specular alone.
BOTH, DIFFUSE_ALONE, NEITHER = frozenset(("specular", "diffuse")), frozenset(("diffuse",)), frozenset()
DIFFERENT_PASSES = {
    GLASS: NEITHER, SUBSURFACE: DIFFUSE_ALONE, SHEEN: BOTH, TOON: BOTH,
    "Subsurface Weight": DIFFUSE_ALONE, "Transmission Weight": NEITHER, "Thin Wall": BOTH,
}  # fmt: skip


def passes_of_cycles(node) -> frozenset[str]:
    """The passes in which direct light on the shader `node` differs from Cycles."""
    bsdf = bsdf_of(node)
    if bsdf is None or has_alpha(node):
        return BOTH
    different = [name for name, (neutral, _) in bsdf.not_shaded.items()
                 if name in node.inputs and not is_constant(value_of(node.inputs[name]), neutral)]  # fmt: skip
    different += [node.bl_idname] if bsdf.nearest else []
    different += ["distribution"] if getattr(node, "distribution", "") in NEAREST_ALPHA else []
    return NEITHER.union(*(DIFFERENT_PASSES.get(name, frozenset(("specular",))) for name in different))


def has_alpha(node) -> bool:
    """True for a Principled BSDF that lets light pass."""
    return node.bl_idname == PRINCIPLED and not is_constant(value_of(node.inputs["Alpha"]), 1.0)
