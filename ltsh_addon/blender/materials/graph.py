"""Node trees: the walk from a surface to its BSDF nodes, the sources of sockets, and edits of trees.

All readers of materials share this walk, which changes nothing: AOVs and bakes (`aovs`), the viewport
(`preview_material`), the emission of lights, and the overview in the panels.
"""

import math
import operator
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import bpy

from ..render_settings import SCRIPT

MIX, ADD = "ShaderNodeMixShader", "ShaderNodeAddShader"
_MIXES = MIX, "ShaderNodeMix", "ShaderNodeMixRGB"
CLEAR, HOLDOUT, PRINCIPLED = "ShaderNodeBsdfTransparent", "ShaderNodeHoldout", "ShaderNodeBsdfPrincipled"
GROUP_SOCKET_NAME = "ltsh"


def live_link(socket):
    """The link that feeds the input `socket`, or None. Values from Open Shading Language do not count."""
    for link in socket.links:
        is_script = link.from_node.bl_idname == SCRIPT and not link.from_node.mute and socket.type != "SHADER"
        if not link.is_muted and link.is_valid and not is_script and not _is_dead(link.from_socket):
            return link
    return None


def _is_dead(output) -> bool:
    """True if Cycles ignores links from `output`: those of muted nodes that pass nothing on to it.

    From 5.0 on also those of muted nodes and reroutes that pass on an input which is not linked.
    """
    node = output.node
    if not node.mute and node.bl_idname != "NodeReroute":
        return False
    entry = passed_through(node, output) if node.mute else node.inputs[0]
    return entry is None or (bpy.app.version >= (5, 0, 0) and live_link(entry) is None)


def value_of(socket):
    """The socket that feeds the input `socket`; the input's own value, a number or a tuple, if it is not linked."""
    link = live_link(socket)
    if link is not None:
        return link.from_socket
    value = socket.default_value
    return tuple(value) if hasattr(value, "__len__") else float(value)


def is_socket(value) -> bool:
    """True for a socket, whose value nodes compute; False for a constant."""
    return isinstance(value, bpy.types.NodeSocket)


def is_constant(value, expected) -> bool:
    """True if `value` (of `value_of`) is the constant `expected`: a number, or the first components of a tuple."""
    if is_socket(value):
        return False
    numbers = value if isinstance(value, tuple) else (value,)
    wanted = expected if isinstance(expected, tuple) else (expected,)
    return all(abs(a - b) < 1e-6 for a, b in zip(numbers, wanted, strict=False))


def material_output(tree):
    """The Material Output, World Output or Light Output that Cycles uses, or None."""
    return tree.get_output_node("CYCLES") or tree.get_output_node("ALL")


def tree_in_use(data):
    """The node tree of a material, world or light; None if it does not use nodes."""
    return data.node_tree if bpy.app.version >= (5, 0, 0) or data.use_nodes else None


def surface_of(data):
    """The Surface socket of the output node of a material, world or light; None without nodes or output."""
    tree = tree_in_use(data)
    output = material_output(tree) if tree is not None else None
    return None if output is None else output.inputs["Surface"]


def has_volume(material) -> bool:
    """True if the Volume socket of `material` has a shader."""
    surface = surface_of(material)
    return surface is not None and live_link(surface.node.inputs["Volume"]) is not None


def is_displaced(material) -> bool:
    """True if the Displacement socket of `material` moves its surface, and not its normals alone."""
    return has_displacement(material) and material.displacement_method != "BUMP"


def has_displacement(material) -> bool:
    """True if the Displacement socket of `material` moves its surface, or its normals alone."""
    surface = surface_of(material)
    return surface is not None and live_link(surface.node.inputs["Displacement"]) is not None


# The nodes that move a surface by a height times a scale.
DISPLACING = ("ShaderNodeDisplacement", "ShaderNodeVectorDisplacement")


def displacement_height(material) -> float | None:
    """How far `material` moves its surface at most, in m of its object, where heights are from 0 to 1; None where that
    is unknown."""
    source = source_of(surface_of(material).node.inputs["Displacement"])
    if source is None or source.node is None or source.node.bl_idname not in DISPLACING:
        return None
    factors = [source.input(name) for name in ("Scale", "Midlevel")]
    if not all(factor is not None and factor.node is None for factor in factors):
        return None
    scale, middle = (factor.socket.default_value for factor in factors)
    return abs(scale) * max(abs(middle), abs(1.0 - middle))


def group_output(tree):
    """The Group Output in use of a group's `tree`, or None."""
    for node in tree.nodes:
        if node.bl_idname == "NodeGroupOutput" and node.is_active_output:
            return node
    return None


def socket_named(sockets, identifier: str):
    """The socket with `identifier`, or None."""
    return next((socket for socket in sockets if socket.identifier == identifier), None)


def passed_through(node, output):
    """The input socket that a muted `node` passes on to its `output`, or None."""
    return next((link.from_socket for link in node.internal_links if link.to_socket == output), None)


def is_group(node) -> bool:
    """True for group nodes, of Blender or of add-ons, even if they have no tree."""
    return node.bl_idname == "ShaderNodeGroup" or hasattr(node, "node_tree")


@dataclass(frozen=True)
class Source:
    """Where a value comes from: an output of a node, or an unlinked input (`node` is None)."""

    socket: Any
    node: Any
    groups: tuple = ()  # the group nodes around it, outermost first
    passed: tuple[str, ...] = ()  # types of the sockets of groups and muted nodes between it and what it feeds

    def input(self, name) -> "Source | None":
        """The source of the input `name` (or position) of the node."""
        return source_of(self.node.inputs[name], self.groups)

    def arrives_whole(self, kind: str) -> bool:
        """True if nothing on the way to a socket of type `kind` converts the value, but for a number if one is wanted.

        Versions of Blender differ in other conversions.
        """
        others = {*self.passed, kind} - {self.socket.type}
        return others <= ({"VALUE"} if kind == "VALUE" else {"RGBA", "VECTOR"})


NODE_TREE = operator.attrgetter("node_tree")


def source_of(socket, groups: tuple = (), tree_of: Callable = NODE_TREE) -> Source | None:
    """The source of the input `socket`, which is inside `groups`; None where a group lacks its tree or its outside."""
    link = live_link(socket)
    return Source(socket, None, groups) if link is None else source_behind(link.from_socket, groups, tree_of)


def source_behind(output, groups: tuple = (), tree_of: Callable = NODE_TREE) -> Source | None:
    """The source of the `output` of a node, past groups, reroutes and muted nodes; None as in `source_of`.

    `tree_of(group node)` returns the node tree of a group.
    """
    node, entry = output.node, None
    if node.mute:
        entry = passed_through(node, output)
        if entry is not None and live_link(entry) is None:
            return None  # in 4.5 Cycles takes 0
    elif node.bl_idname == "NodeReroute":
        entry = node.inputs[0]
    elif is_group(node):
        inner = tree_of(node)
        end = group_output(inner) if inner is not None else None
        if end is not None:
            entry = socket_named(end.inputs, output.identifier)
            groups = (*groups, node)
    elif node.bl_idname == "NodeGroupInput":
        if groups:
            entry = socket_named(groups[-1].inputs, output.identifier)
            groups = groups[:-1]
    else:
        return Source(output, node, groups)
    source = None if entry is None else source_of(entry, groups, tree_of)
    if source is None or node.bl_idname == "NodeReroute":
        return source
    return replace(source, passed=(*source.passed, entry.type, output.type))


def images_behind(data) -> set:
    """The images whose nodes feed the output of a material, world or light."""
    output = None if tree_in_use(data) is None else material_output(data.node_tree)
    waiting = [] if output is None else [(socket, ()) for socket in output.inputs]
    images, known = set(), set()
    while waiting:
        source = source_of(*waiting.pop())
        if source is None or source.node is None or (source.node, source.groups) in known:
            continue
        known.add((source.node, source.groups))
        images.add(getattr(source.node, "image", None))
        inputs = [socket for socket in source.node.inputs if socket.enabled]
        if source.node.bl_idname in _MIXES and is_constant(value_of(inputs[0]), 0.0):
            inputs = inputs[:2]  # the first of both alone has a weight
        waiting += [(socket, source.groups) for socket in inputs]
    return images - {None}


def constant_of(socket, groups: tuple = (), tree_of: Callable = NODE_TREE) -> float | None:
    """The constant at the input `socket` inside `groups`; None if nodes compute it. `tree_of`: see `source_behind`."""
    source = source_of(socket, groups, tree_of)
    if source is None or not source.arrives_whole(socket.type):
        return None
    if source.node is not None and source.node.bl_idname != "ShaderNodeValue":
        return None
    value = getattr(source.socket, "default_value", None)
    return float(value) if isinstance(value, (int, float)) else None


@dataclass(frozen=True)
class Factor:
    """The weight that a Mix Shader node gives to one of its shaders: its factor, clamped to [0, 1], or 1 minus that."""

    node: Any
    groups: tuple
    is_complement: bool
    beside_transparency: bool  # the other shader is transparency, which is cut: the factor scales only emission

    @property
    def source(self) -> Source | None:
        """The source of the factor of the node."""
        return source_of(self.node.inputs[0], self.groups)

    @property
    def constant(self) -> float | None:
        """The constant value of the weight; None if nodes compute it."""
        value = value_of(self.node.inputs[0])
        if is_socket(value):
            return None
        value = min(max(value, 0.0), 1.0)
        return 1.0 - value if self.is_complement else value


@dataclass(frozen=True)
class WeightedShader:
    """A shader node that is neither mix nor sum. Its weight is the sum over `terms` of the product of their factors."""

    source: Source
    terms: tuple[tuple[Factor, ...], ...]  # outermost factor first

    @property
    def node(self):
        """The shader node."""
        return self.source.node

    @property
    def groups(self) -> tuple:
        """The group nodes around it, outermost first."""
        return self.source.groups

    @property
    def is_transparent(self) -> bool:
        """True for nodes that only let light through."""
        if self.node.bl_idname == PRINCIPLED:
            alpha = constant_of(self.node.inputs["Alpha"], self.groups)
            return alpha is not None and alpha <= 0.0
        return self.node.bl_idname in (CLEAR, HOLDOUT)

    @property
    def lobe_terms(self) -> tuple[tuple[Factor, ...], ...]:
        """The terms of the weight of its lobes, without the factors beside transparency."""
        return tuple(tuple(factor for factor in term if not factor.beside_transparency) for term in self.terms)

    @property
    def bound(self) -> float:
        """An upper bound on the weight of its lobes, from the constant factors."""
        terms = ([factor.constant for factor in term] for term in self.lobe_terms)
        return sum(math.prod(value for value in term if value is not None) for term in terms)


@dataclass(frozen=True)
class Cut:
    """A mix or sum with one shader that is only transparency, which is left out to make the surface opaque."""

    node: Any
    clear: Any  # the input socket of the transparency
    other: Any  # the other input socket


@dataclass
class SurfaceShaders:
    """The shader nodes behind a socket, in the order of the links, and the transparency that is cut."""

    leaves: list[WeightedShader] = field(default_factory=list)
    cuts: list[Cut] = field(default_factory=list)
    is_transparent: bool = False  # all of it is transparency

    def _add(self, other: "SurfaceShaders", *factors: Factor) -> None:
        positions = {(leaf.node, leaf.groups): position for position, leaf in enumerate(self.leaves)}
        for leaf in other.leaves:
            terms = tuple((*factors, *term) for term in leaf.terms)
            position = positions.get((leaf.node, leaf.groups))
            if position is None:
                self.leaves.append(WeightedShader(leaf.source, terms))
            else:
                self.leaves[position] = WeightedShader(leaf.source, self.leaves[position].terms + terms)
        self.cuts += [cut for cut in other.cuts if cut not in self.cuts]


def shaders_behind(socket, groups: tuple = (), tree_of: Callable = NODE_TREE) -> SurfaceShaders:
    """The shader nodes behind the input `socket`, with their weights.

    A node that is reached twice is one leaf. A mix by a constant 0 or 1 counts as the shader that it shows, and a sum
    with one linked input as the shader at that input. Transparency beside another shader is cut. `tree_of`: see
    `source_behind`.
    """
    source = source_of(socket, groups, tree_of)
    if source is None or source.node is None:
        return SurfaceShaders()
    node, groups = source.node, source.groups
    if node.bl_idname not in (MIX, ADD):
        leaf = WeightedShader(source, ((),))
        return SurfaceShaders([leaf], is_transparent=leaf.is_transparent)
    sockets = [socket for socket in node.inputs if socket.type == "SHADER"]
    if node.bl_idname == MIX:
        share = constant_of(node.inputs[0], groups, tree_of)
        if share is not None and not 0.0 < share < 1.0:
            share = min(max(share, 0.0), 1.0)
            return shaders_behind(sockets[int(share)], groups, tree_of)
    else:
        sockets = [socket for socket in sockets if live_link(socket) is not None]
        if len(sockets) == 1:
            return shaders_behind(sockets[0], groups, tree_of)
    inputs = [shaders_behind(socket, groups, tree_of) for socket in sockets]
    clear = [shaders.is_transparent for shaders in inputs]
    joined = SurfaceShaders(is_transparent=bool(inputs) and all(clear))
    if any(clear) and not all(clear):
        first, second = sockets if clear[0] else reversed(sockets)
        if live_link(second) is not None:
            joined.cuts.append(Cut(node, first, second))
    is_cut = bool(joined.cuts)
    for index, shaders in enumerate(inputs):
        factors = (Factor(node, groups, index == 0, is_cut),) if node.bl_idname == MIX else ()
        if not (is_cut and shaders.is_transparent):
            joined._add(shaders, *factors)
    return joined


def is_seen_through(output, shaders: SurfaceShaders) -> bool:
    """True if rays pass through the surface; `shaders` are those at the Surface of the material's `output`."""
    if shaders.leaves:
        return all(leaf.is_transparent and leaf.node.bl_idname != HOLDOUT for leaf in shaders.leaves)
    return live_link(output.inputs["Volume"]) is not None


def cut(socket) -> None:
    """Remove all links to the input `socket`."""
    for link in list(socket.links):
        socket.id_data.links.remove(link)


class TreeChanges(ExitStack):
    """Changes of nodes, links and properties, which are undone where its context ends, the last first."""

    def set(self, owner, name: str, value) -> None:
        """Give a property another value."""
        self.callback(setattr, owner, name, getattr(owner, name))
        setattr(owner, name, value)

    def add(self, tree, kind: str):
        """A new node."""
        node = tree.nodes.new(kind)
        self.callback(tree.nodes.remove, node)
        return node

    def relink(self, socket, source=None) -> None:
        """Let the output `source` feed the input `socket`, or nothing."""
        before = [(link.from_socket, link.is_muted) for link in socket.links]
        cut(socket)
        if source is not None:
            socket.id_data.links.new(source, socket)

        def restore():
            cut(socket)
            for one, is_muted in before:
                socket.id_data.links.new(one, socket).is_muted = is_muted

        self.callback(restore)


def feed(socket, value) -> None:
    """Let `value`, a socket or a constant, feed the input `socket`."""
    if is_socket(value):
        socket.id_data.links.new(value, socket)
    else:
        socket.default_value = value


def feed_instead(output, other) -> None:
    """Let the output `other` feed what `output` has fed."""
    for target in [link.to_socket for link in output.links]:
        output.id_data.links.new(other, target)


def replaced_by_number(output, number: float):
    """The output of a new node of this `number`, which feeds what `output` has fed."""
    value = output.id_data.nodes.new("ShaderNodeValue").outputs[0]
    value.default_value = number
    feed_instead(output, value)
    return value


def mixed(factor, first, second):
    """The output of a new Mix Shader node by the socket `factor`; None in place of a shader: nothing."""
    node = factor.id_data.nodes.new(MIX)
    for source, target in zip((factor, first, second), node.inputs, strict=True):
        if source is not None:
            node.id_data.links.new(source, target)
    return node.outputs[0]


def own_groups(tree) -> list:
    """Replace all node groups in `tree`, nested ones too, by copies; returns the copies."""
    made = []
    for node in tree.nodes:
        if is_group(node) and node.node_tree is not None:
            node.node_tree = node.node_tree.copy()
            made += [node.node_tree, *own_groups(node.node_tree)]
    return made


# FOLDED: what the operations of Math nodes are for numbers alone.
FOLDED = {
    "DIVIDE": lambda first, second: first / second,
    "LOGARITHM": math.log,
    "MAXIMUM": max,
    "POWER": lambda base, exponent: max(base, 0.0) ** exponent,
    "SUBTRACT": operator.sub,
}


def computed(operation: str, *values, clamp: bool = False):
    """The output of a new Math node; `values` are numbers and sockets, of one tree. For numbers of FOLDED a number."""
    if operation in FOLDED and not any(map(is_socket, values)):
        return FOLDED[operation](*values)
    tree = next(value for value in values if is_socket(value)).id_data
    node = tree.nodes.new("ShaderNodeMath")
    node.operation, node.use_clamp = operation, clamp
    for value, socket in zip(values, node.inputs, strict=False):
        feed(socket, value)
    return node.outputs[0]


def vector(operation: str, *values):
    """The output of a new Vector Math node; `values` are sockets, the first one a vector, and numbers."""
    node = values[0].id_data.nodes.new("ShaderNodeVectorMath")
    node.operation = operation
    for value, socket in zip(values, [socket for socket in node.inputs if socket.enabled], strict=False):
        feed(socket, value)
    return next(socket for socket in node.outputs if socket.enabled)


def product(first, second):
    """first * second, for numbers or sockets of the same tree."""
    if not is_socket(first) and not is_socket(second):
        return first * second
    for constant, other in ((first, second), (second, first)):
        if not is_socket(constant) and constant in (0.0, 1.0):
            return other if constant else 0.0
    return computed("MULTIPLY", first, second)


def total(first, second):
    """first + second, for numbers or sockets of the same tree."""
    if not is_socket(first) and not is_socket(second):
        return first + second
    return computed("ADD", first, second)


def mix_weights(node):
    """Sockets with the weights of both shaders of a Mix Shader `node` with a linked factor, clamped as in Cycles."""
    clamped = computed("ADD", value_of(node.inputs[0]), 0.0, clamp=True)
    return computed("SUBTRACT", 1.0, clamped), clamped


def carry_into_group(group, value):
    """`value`, from outside the node `group`, as a number or socket inside it; its tree must have no other user."""
    if not is_socket(value):
        return value
    inner = group.node_tree
    item = inner.interface.new_socket(GROUP_SOCKET_NAME, in_out="INPUT", socket_type="NodeSocketFloat")
    group.id_data.links.new(value, socket_named(group.inputs, item.identifier))
    return socket_named(inner.nodes.new("NodeGroupInput").outputs, item.identifier)


def carry_out_of_group(group, value):
    """`value`, from inside the node `group`, as a constant or socket outside it; its tree must have no other user."""
    if not is_socket(value):
        return value
    inner, end = group.node_tree, group_output(group.node_tree)
    for socket in end.inputs:
        if socket.name == GROUP_SOCKET_NAME and any(link.from_socket == value for link in socket.links):
            return socket_named(group.outputs, socket.identifier)
    kind = {"RGBA": "NodeSocketColor", "VECTOR": "NodeSocketVector"}.get(value.type, "NodeSocketFloat")
    item = inner.interface.new_socket(GROUP_SOCKET_NAME, in_out="OUTPUT", socket_type=kind)
    inner.links.new(value, socket_named(end.inputs, item.identifier))
    return socket_named(group.outputs, item.identifier)


def ensure_nodes(material) -> None:
    """Give a material without nodes (possible up to 4.5) the tree that Cycles renders for it."""
    if bpy.app.version >= (5, 0, 0) or (material.use_nodes and material.node_tree):
        return
    color = tuple(material.diffuse_color)
    material.use_nodes = True
    fill_with_bsdf(material.node_tree, "ShaderNodeBsdfDiffuse", color)


def fill_with_bsdf(tree, node_type: str, color) -> None:
    """Replace all nodes of `tree` by one BSDF of `color` (4 numbers)."""
    tree.nodes.clear()
    bsdf = tree.nodes.new(node_type)
    bsdf.inputs[0].default_value = color
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(bsdf.outputs[0], output.inputs["Surface"])
