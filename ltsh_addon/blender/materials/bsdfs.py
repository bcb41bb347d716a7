"""BSDF nodes: the leaves of a material, and the lobes of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ...cycles.closures import f82_dip
from ...cycles.lobes import LOBE_AOVS, LOBE_KINDS
from ...shading.brdf import schlick_curve
from .graph import (
    bypass,
    carry_into_group,
    carry_out_of_group,
    cut,
    group_output,
    is_constant,
    is_socket,
    live_link,
    mix_weights,
    passed_through,
    product,
    socket_named,
    total,
    value_of,
)

TRANSPARENT_NODES = ("ShaderNodeBsdfTransparent", "ShaderNodeHoldout")
GROUP_NODES = ("ShaderNodeGroup", "ShaderNodeCustomGroup")


@dataclass(frozen=True)
class Leaf:
    """A shader node that is neither mix nor sum, and its share in the material."""

    tree: Any  # the node tree it lives in
    node: Any
    weight: Any  # a float, or a socket of `tree`
    bound: float  # no weight is larger, as far as constants tell


def bsdf_leaves(tree, surface, warn: Callable[[str], None]) -> list[Leaf]:
    """The leaves behind the input `surface` of a material's `tree`, in the order in which they are linked."""
    walk = _Walk(warn)
    walk.follow(tree, surface, 1.0, 1.0)
    return list(walk.leaves.values())


def is_group(node) -> bool:
    """True for nodes that hold a node tree, or could."""
    return node.bl_idname in GROUP_NODES or hasattr(node, "node_tree")


class _Walk:
    """From a shader input backwards to the leaves."""

    def __init__(self, warn):
        self.warn = warn
        self.levels: list = []  # (tree, group node) from the material inwards
        self.leaves: dict = {}
        self.copied: set = set()  # group nodes whose trees have been made single-user

    def follow(self, tree, socket, weight, bound) -> None:
        link = live_link(socket)
        if link is None or (not is_socket(weight) and weight == 0.0):
            return
        node, output = link.from_node, link.from_socket
        if node.mute:
            inner = passed_through(node, output)
            if inner is not None:
                self.follow(tree, inner, weight, bound)
        elif node.bl_idname == "NodeReroute":
            self.follow(tree, node.inputs[0], weight, bound)
        elif is_group(node):
            self._into_group(tree, node, output, weight, bound)
        elif node.bl_idname == "NodeGroupInput":
            self._out_of_group(output, weight, bound)
        elif node.bl_idname == "ShaderNodeMixShader":
            self._mix(tree, node, weight, bound)
        elif node.bl_idname == "ShaderNodeAddShader":
            self._sum(tree, node, weight, bound)
        else:
            self._add(tree, node, weight, bound)

    def _add(self, tree, node, weight, bound):
        key = (tree.as_pointer(), node.name)
        known = self.leaves.get(key)
        if known is None:
            self.leaves[key] = Leaf(tree, node, weight, bound)
        else:
            summed = total(tree, known.weight, weight)
            self.leaves[key] = replace(known, weight=summed, bound=known.bound + bound)

    def _into_group(self, tree, node, output, weight, bound):
        if node.node_tree is None:
            return
        key = (tree.as_pointer(), node.name)
        if key not in self.copied:
            node.node_tree = node.node_tree.copy()
            self.copied.add(key)
        end = group_output(node.node_tree)
        socket = socket_named(end.inputs, output.identifier) if end is not None else None
        if socket is None:
            return
        inner = carry_into_group(tree, node, weight)
        self.levels.append((tree, node))
        self.follow(node.node_tree, socket, inner, bound)
        self.levels.pop()

    def _out_of_group(self, output, weight, bound):
        if not self.levels:
            return
        tree, node = self.levels.pop()
        socket = socket_named(node.inputs, output.identifier)
        if socket is not None and live_link(socket) is not None:
            self.follow(tree, socket, carry_out_of_group(node, weight), bound)
        self.levels.append((tree, node))

    def _mix(self, tree, node, weight, bound):
        branches = node.inputs[1], node.inputs[2]
        transparent = [self._is_transparent(tree, socket, list(self.levels)) for socket in branches]
        mixed = live_link(node.inputs[0]) is not None or 0.0 < node.inputs[0].default_value < 1.0
        for index in (0, 1):
            other = branches[1 - index]
            if mixed and transparent[index] and not transparent[1 - index] and live_link(other) is not None:
                self.warn(f"transparency of node {node.name!r} is cut, the surface is shaded and rendered opaque")
                bypass(tree, node, live_link(other).from_socket)
                self.follow(tree, other, weight, bound)
                return
        shares = mix_weights(tree, node.inputs[0])
        for socket, share in zip(branches, shares, strict=True):
            self.follow(tree, socket, product(tree, weight, share), bound if is_socket(share) else bound * share)

    def _sum(self, tree, node, weight, bound):
        transparent = [self._is_transparent(tree, socket, list(self.levels)) for socket in node.inputs]
        for socket, clear in zip(node.inputs, transparent, strict=True):
            if clear and not all(transparent):
                self.warn(f"transparency of node {node.name!r} is cut, the surface is shaded and rendered opaque")
                cut(tree, socket)
            else:
                self.follow(tree, socket, weight, bound)

    def _is_transparent(self, tree, socket, levels) -> bool:
        """True where nothing but transparency is behind `socket`; changes nothing."""
        link = live_link(socket)
        if link is None:
            return False
        node, output = link.from_node, link.from_socket
        if node.mute:
            inner = passed_through(node, output)
            return inner is not None and self._is_transparent(tree, inner, levels)
        if is_group(node):
            end = group_output(node.node_tree) if node.node_tree is not None else None
            inner = socket_named(end.inputs, output.identifier) if end is not None else None
            return inner is not None and self._is_transparent(node.node_tree, inner, [*levels, (tree, node)])
        if node.bl_idname == "NodeGroupInput":
            if not levels:
                return False
            outer = socket_named(levels[-1][1].inputs, output.identifier)
            return outer is not None and self._is_transparent(levels[-1][0], outer, levels[:-1])
        if node.bl_idname == "NodeReroute":
            return self._is_transparent(tree, node.inputs[0], levels)
        if node.bl_idname in ("ShaderNodeMixShader", "ShaderNodeAddShader"):
            shaders = [socket for socket in node.inputs if socket.type == "SHADER"]
            return all(self._is_transparent(tree, socket, levels) for socket in shaders)
        return node.bl_idname in TRANSPARENT_NODES


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
