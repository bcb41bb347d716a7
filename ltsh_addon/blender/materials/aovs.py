"""Materials changed so that Cycles outputs what shading needs of them (in the child).

Each node group gets a tree of its own, transparency and volumes are cut, and new nodes compute the weights of lobes.
Pictures write all quantities into AOVs, bakes show them as `maps`.
"""

import functools
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import bpy

from ...cycles.lobes import (
    AOV_PREFIX,
    DENSITY_AOVS,
    HIT_AOVS,
    KEPT_AOV,
    KEPT_BITS,
    LOBE_AOVS,
    MAX_LOBES,
    aov_kind,
    lobe_aov,
)
from ...scene import listed
from ..render_settings import SCRIPT
from . import bsdfs, graph
from .bsdfs import BOTH, NEITHER, bsdf_of, emits, has_alpha, is_emission, lobe_values, notes_of, passes_of_cycles

# Nodes whose values differ from those in the Cycles reference, and the note about each.
NOTED_NODES = {
    "ShaderNodeAmbientOcclusion": "looks once at its surroundings, which the Cycles reference leaves out",
    "ShaderNodeBevel": "is sampled once per hit, in Cycles many times",
    SCRIPT: "is Open Shading Language, which is not read: what it feeds keeps the value of its own socket",
}
LEFT_OUT = "left out of the Cycles reference as well"
# RECEIVER_PROPERTY: custom property of objects, a value of `Light.receivers` that tells which lights reach them.
RECEIVER_PROPERTY = "ltsh_receiver"
# AHEAD: how far in m a ray goes on behind a surface of glass. NOTHING, CLEAREST: the least share of light that passes
# glass, and the least density that it writes.
AHEAD, NOTHING, CLEAREST = 1e-4, 1e-5, 1e-6


@dataclass(frozen=True)
class OpaqueInput:
    """An input that was changed to make a surface opaque."""

    socket: Any
    source: Any  # the socket or number that was there
    level: float  # the number that makes the surface opaque, 0 or 1


@dataclass(frozen=True)
class MaterialLobes:
    """The lobes of one material: the leaves that have one, the values of each, and the differences from Cycles."""

    leaves: tuple[graph.WeightedShader, ...]
    values: tuple[dict, ...]  # per leaf those of `bsdfs.lobe_values`, and the weight unless that is 1
    warnings: tuple[str, ...]
    is_transparent: bool = False  # rays pass through it and meet the next surface
    unshaded: str = ""  # why it is black where Cycles has light, "" where it is shaded
    made_opaque: tuple[OpaqueInput, ...] = ()
    left_to_cycles: frozenset[str] = NEITHER  # passes in which direct light is not as in Cycles
    has_volume: bool = False
    through: tuple | None = None  # of glass: `bsdfs.let_through`, in the tree of the material


@dataclass
class CyclesReasons:
    """What finished pictures leave to Cycles, and why."""

    materials: list[str] = field(default_factory=list)  # materials, and their passes, with direct light by Cycles
    everything: list[str] = field(default_factory=list)  # reasons why all direct light is left to Cycles

    def note(self, material, lobes: MaterialLobes) -> None:
        """Add what the `lobes` of `material` leave to Cycles."""
        if lobes.has_volume:
            self.everything.append(f"the volume of material {material.name!r}")
        if lobes.left_to_cycles:
            reasons = [line.partition(": ")[2] for line in lobes.warnings]
            why = listed(reasons or [lobes.unshaded], 2, "; ")
            self.materials.append(f"material {material.name!r} ({' and '.join(sorted(lobes.left_to_cycles))}: {why})")


def lobes_of(material, emitter: bool) -> MaterialLobes:
    """The lobes of `material`, at most MAX_LOBES; its tree is changed. An `emitter` gets no note about its emission."""
    tree = material.node_tree
    output = graph.material_output(tree) or tree.nodes.new("ShaderNodeOutputMaterial")
    surface = output.inputs["Surface"]
    shaders = graph.shaders_behind(surface, tree_of=functools.cache(_own_tree))
    notes = notes_of_material(output, shaders, emitter)
    warnings = tuple(dict.fromkeys(f"material {material.name!r}: {note}" for note in notes))
    left_to_cycles = _passes_left_to_cycles(output, shaders)
    has_volume = graph.live_link(output.inputs["Volume"]) is not None
    traits = {"left_to_cycles": left_to_cycles, "has_volume": has_volume}
    without_lobe, made_opaque = MaterialLobes((), (), warnings, **traits), []
    for cut_node in shaders.cuts:
        if cut_node.node.bl_idname == graph.MIX:
            is_last = cut_node.other == [socket for socket in cut_node.node.inputs if socket.type == "SHADER"][-1]
            made_opaque.append(_fixed(cut_node.node.inputs[0], float(is_last)))
        else:
            made_opaque.append(OpaqueInput(cut_node.clear, graph.live_link(cut_node.clear).from_socket, 1.0))
            graph.cut(cut_node.clear)
    is_clear = graph.is_seen_through(output, shaders)
    graph.cut(output.inputs["Volume"])
    if is_clear:
        if graph.live_link(surface) is not None:
            made_opaque.append(OpaqueInput(surface, graph.live_link(surface).from_socket, 1.0))
        _show(surface, graph.CLEAR, 1.0)
    elif not shaders.leaves:
        # Without a shader Cycles counts AOVs twice; a black BSDF looks the same.
        _show(surface, "ShaderNodeBsdfDiffuse", 0.0)
    if is_clear or (shaders.leaves and all(leaf.is_transparent for leaf in shaders.leaves)):
        unshaded = f"material {material.name!r} is transparent"
        return replace(without_lobe, is_transparent=True, unshaded=unshaded, made_opaque=tuple(made_opaque))
    for leaf in shaders.leaves:
        if has_alpha(leaf.node):
            made_opaque.append(_fixed(leaf.node.inputs["Alpha"], 1.0))
    leaves, _ = shaded_leaves(shaders)
    weight_of = _Weights().of
    # Compute all weights before any value: the group sockets that values come from must stay where they are.
    weights = [weight_of(leaf) for leaf in leaves]
    shares = [{} if graph.is_constant(weight, 1.0) else {"weight": weight} for weight in weights]
    values = tuple({**lobe_values(leaf.node), **share} for leaf, share in zip(leaves, shares, strict=True))
    unknown = [leaf.node.name for leaf in shaders.leaves if bsdf_of(leaf.node) is None and not is_emission(leaf.node)]
    unshaded, through = "", _through(shaders.leaves, weight_of)
    if unknown and not leaves and through is None:
        unshaded = f"material {material.name!r} has no shader that is supported, found {listed(map(repr, unknown))}"
    traits = {"unshaded": unshaded, "made_opaque": tuple(made_opaque), "through": through}
    return replace(without_lobe, leaves=tuple(leaves), values=values, **traits)


def _through(leaves, weight_of) -> tuple | None:
    """`MaterialLobes.through` of the shaders `leaves`: the sum of the light, in the direction of the first."""
    sums = None
    for leaf in leaves:
        if (values := bsdfs.let_through(leaf.node)) is None:
            continue
        weight = weight_of(leaf)
        values = *(graph.product(weight, share) for share in values[:3]), values[3]
        for group in reversed(leaf.groups):
            values = [graph.carry_out_of_group(group, value) for value in values]
        sums = values if sums is None else (*map(graph.total, sums[:3], values[:3]), sums[3])
    return sums


def _passes_left_to_cycles(output, shaders: graph.SurfaceShaders) -> frozenset[str]:
    """The passes in which direct light on a material is not as in Cycles."""
    leaves = shaders.leaves
    if all(leaf.is_transparent for leaf in leaves):
        return BOTH if _tinted(leaves) else NEITHER
    if shaders.cuts or _noted_nodes(output.id_data) or shaded_leaves(shaders)[1]:
        return BOTH
    return NEITHER.union(*(passes_of_cycles(leaf.node) for leaf in leaves if not is_emission(leaf.node)))


def _fixed(target, level: float) -> OpaqueInput:
    """Fix the number at the input `target` to `level`, 0 or 1.

    Its old source stays linked: Cycles reads an image differently if its alpha feeds nothing.
    """
    before = graph.value_of(target)
    if graph.is_socket(before):
        fixed = graph.computed("MAXIMUM" if level else "MINIMUM", before, level, clamp=True)
        target.id_data.links.new(fixed, target)
    else:
        graph.cut(target)
        target.default_value = level
    return OpaqueInput(target, before, level)


def let_shadow_rays_through(made_opaque: Iterable[OpaqueInput]) -> None:
    """Give materials their transparency back for all but camera rays."""
    for changed in made_opaque:
        target, before, tree = changed.socket, changed.source, changed.socket.id_data
        is_camera_ray = tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"]
        if target.type != "SHADER":
            if changed.level:
                tree.links.new(graph.computed("MAXIMUM", is_camera_ray, before), target)
            else:
                tree.links.new(
                    graph.computed("MINIMUM", graph.computed("SUBTRACT", 1.0, is_camera_ray), before), target
                )
            continue
        now = graph.live_link(target)
        tree.links.new(graph.mixed(is_camera_ray, before, now and now.from_socket), target)


def _show(surface, node_type: str, level: float) -> None:
    """Link a new node of a gray `level` to the input `surface`."""
    node = surface.id_data.nodes.new(node_type)
    node.inputs["Color"].default_value = (level, level, level, 1.0)
    surface.id_data.links.new(node.outputs[0], surface)


def notes_of_material(output, shaders: graph.SurfaceShaders, emitter: bool = False) -> list[str]:
    """Notes about what of a material is not shaded as in Cycles; `emitter`: it is a light. Changes nothing."""
    notes, leaves = [], shaders.leaves
    if graph.live_link(output.inputs["Volume"]) is not None:
        notes.append(f"its volume is not shaded{'' if leaves else ', it is seen through'}; {LEFT_OUT}")
    elif not leaves:
        notes.append("it has no surface shader and is black, as in Cycles")
    notes += [f"node {node.name!r} {NOTED_NODES[node.bl_idname]}" for node in _noted_nodes(output.id_data)]
    for cut_node in shaders.cuts:
        notes.append(f"transparency of node {cut_node.node.name!r} is cut, the surface is shaded and rendered opaque")
    if all(leaf.is_transparent for leaf in leaves):
        return notes + _tinted(leaves)
    if not emitter and any(is_emission(leaf.node) or emits(leaf.node) for leaf in leaves):
        notes.append("emission is not shaded and lights nothing, in the Cycles reference neither")
    notes += [note for leaf in leaves if not is_emission(leaf.node) for note in notes_of(leaf.node)]
    _, left_out = shaded_leaves(shaders)
    if left_out:
        names = ", ".join(repr(leaf.node.name) for leaf in left_out)
        notes.append(f"it has {MAX_LOBES + len(left_out)} BSDF nodes, of which {MAX_LOBES} are shaded, not {names}")
    return notes


def _tinted(leaves) -> list[str]:
    """Notes about transparency that is not clear."""
    notes = []
    for node in (leaf.node for leaf in leaves if leaf.node.bl_idname == graph.CLEAR):
        color = graph.value_of(node.inputs["Color"])
        lost = "what varies" if graph.is_socket(color) else f"up to {100.0 * (1.0 - min(color[:3])):.0f} %"
        if not graph.is_constant(color, (1.0, 1.0, 1.0)):
            notes.append(f"node {node.name!r} is shaded as clear, {lost} of what is behind it too much; {LEFT_OUT}")
    return notes


def shaded_leaves(shaders: graph.SurfaceShaders) -> tuple[list[graph.WeightedShader], list[graph.WeightedShader]]:
    """The leaves with a lobe: the MAX_LOBES with the largest upper bounds on their weights, and the others."""
    leaves = [leaf for leaf in shaders.leaves if bsdf_of(leaf.node) is not None]
    order = sorted(range(len(leaves)), key=lambda index: -leaves[index].bound)
    return [leaves[index] for index in sorted(order[:MAX_LOBES])], [leaves[index] for index in order[MAX_LOBES:]]


def _noted_nodes(tree) -> list:
    """Nodes in `tree` and its groups that are in NOTED_NODES and feed something."""
    noted = []
    for node in tree.nodes:
        if graph.is_group(node) and node.node_tree is not None:
            noted += _noted_nodes(node.node_tree)
        elif node.bl_idname in NOTED_NODES and not node.mute:
            noted += [node] * any(socket.is_linked and socket.type != "SHADER" for socket in node.outputs)
    return noted


def _own_tree(group):
    """A copy of the node tree of a `group` node, which gets it as its own; None if it has no tree."""
    if group.node_tree is not None:
        group.node_tree = group.node_tree.copy()
    return group.node_tree


class _Weights:
    """Computes the weights of leaves with new nodes; each group tree must have one user."""

    def __init__(self):
        self._known: dict = {}
        self._shares: dict = {}

    def of(self, leaf: graph.WeightedShader):
        """The weight of the lobes of `leaf`: a number, or a socket of its tree."""
        return functools.reduce(graph.total, (self._product(term, leaf.groups) for term in leaf.lobe_terms))

    def _product(self, factors: tuple[graph.Factor, ...], groups: tuple):
        """The product of `factors` in the tree that `groups` lead to."""
        key = factors, groups
        if key not in self._known:
            self._known[key] = self._carried(factors, groups) if factors else 1.0
        return self._known[key]

    def _carried(self, factors, groups):
        last = factors[-1]
        if groups == last.groups:
            return graph.product(self._product(factors[:-1], groups), self._share(last))
        depth = len(groups)
        if last.groups[:depth] == groups:
            return graph.carry_out_of_group(last.groups[depth], self._product(factors, last.groups[: depth + 1]))
        return graph.carry_into_group(groups[-1], self._product(factors, groups[:-1]))

    def _share(self, factor: graph.Factor):
        if factor.constant is not None:
            return factor.constant
        if factor.node not in self._shares:
            self._shares[factor.node] = graph.mix_weights(factor.node)
        return self._shares[factor.node][0 if factor.is_complement else 1]


def inject_aovs(
    materials: list,
    emitters: frozenset[str] = frozenset(),
    unshaded: list[str] | None = None,
    made_opaque: list[OpaqueInput] | None = None,
    reasons: CyclesReasons | None = None,
    glass: list | None = None,
) -> list[str]:
    """Make every material write its lobes into AOVs; returns warnings.

    Only materials with a full name in `emitters` give light. A material that is not shaded at all writes -n as the
    kind of its first lobe, and the n-th entry of `unshaded` is the reason. `made_opaque` gets the entries that
    `let_shadow_rays_through` takes, `reasons` gets what a finished picture leaves to Cycles, and `glass` gets what
    `make_clear` takes.
    """
    unshaded = [] if unshaded is None else unshaded
    made_opaque = [] if made_opaque is None else made_opaque
    opaque, warnings = [], []
    for material in materials:
        graph.ensure_nodes(material)
        emitter = material.name_full in emitters
        if not emitter:
            material.cycles.emission_sampling = "NONE"
        lobes = lobes_of(material, emitter)
        warnings += lobes.warnings
        made_opaque += lobes.made_opaque
        if reasons is not None:
            reasons.note(material, lobes)
            if lobes.left_to_cycles:
                _write_aov(material.node_tree, KEPT_AOV, sum(KEPT_BITS[name] for name in lobes.left_to_cycles))
        if lobes.through is not None and glass is not None:
            glass.append((material, lobes.through[3]))
            for name, share in zip(DENSITY_AOVS, lobes.through, strict=False):
                logarithm = graph.computed("LOGARITHM", graph.computed("MAXIMUM", share, NOTHING), math.e)
                density = graph.computed("SUBTRACT", 0.0, logarithm)
                _write_aov(material.node_tree, name, graph.computed("MAXIMUM", density, CLEAREST))
        if not lobes.is_transparent:
            opaque.append(lobes)
            _write_hit(material)
            if lobes.unshaded:
                unshaded.append(lobes.unshaded)
                _write_aov(material.node_tree, lobe_aov("kind", 0), -len(unshaded))
    # All materials must write the same AOVs for a slot.
    for slot in range(max((len(lobes.leaves) for lobes in opaque), default=0)):
        users = [lobes for lobes in opaque if len(lobes.leaves) > slot]
        names = sorted({name for lobes in users for name in lobes.values[slot]})
        for lobes, name in itertools.product(users, names):
            neutral = LOBE_AOVS[name][1]
            value = lobes.values[slot].get(name, 0.0 if neutral is None else neutral)
            _write_aov(lobes.leaves[slot].node.id_data, lobe_aov(name, slot), value)
    return list(dict.fromkeys(warnings))


def make_clear(glass: Iterable[tuple]) -> None:
    """Let camera rays pass through `glass`, materials and directions, which then write DENSITY_AOVS alone."""
    for material, direction in glass:
        tree = material.node_tree
        _forget(tree)
        # To Cycles such a ray is still one of the camera, so what it meets next writes its AOVs.
        portal, geometry = tree.nodes.new("ShaderNodeBsdfRayPortal"), tree.nodes.new("ShaderNodeNewGeometry")
        ahead = graph.vector("MULTIPLY_ADD", direction, (AHEAD,) * 3, geometry.outputs["Position"])
        tree.links.new(ahead, portal.inputs["Position"])
        tree.links.new(direction, portal.inputs["Direction"])
        tree.links.new(portal.outputs[0], graph.material_output(tree).inputs["Surface"])


def _forget(tree) -> None:
    """Remove the AOVs of `tree` and its groups, except DENSITY_AOVS."""
    for node in list(tree.nodes):
        if graph.is_group(node) and node.node_tree is not None:
            _forget(node.node_tree)
        elif (
            getattr(node, "aov_name", "").startswith(AOV_PREFIX)
            and node.aov_name[len(AOV_PREFIX) :] not in DENSITY_AOVS
        ):
            tree.nodes.remove(node)


def _write_hit(material) -> None:
    """Write the AOVs that do not depend on the lobe."""
    tree = material.node_tree
    geometry = tree.nodes.new("ShaderNodeNewGeometry")
    receiver = tree.nodes.new("ShaderNodeAttribute")
    # As in Cycles, this reads the property of the instancer if it has one, else that of the object itself.
    receiver.attribute_type, receiver.attribute_name = "INSTANCER", RECEIVER_PROPERTY
    _write_aov(tree, "hit", 1.0)
    _write_aov(tree, "receiver", receiver.outputs["Fac"])
    bends = 0.0
    if material.cycles.use_bump_map_correction:
        # 0 on hair: Cycles bends no specular normals there.
        bends = graph.computed("SUBTRACT", 1.0, tree.nodes.new("ShaderNodeHairInfo").outputs["Is Strand"])
    _write_aov(tree, "correct_normal", bends)
    _write_aov(tree, "position", geometry.outputs["Position"])
    _write_aov(tree, "incoming", geometry.outputs["Incoming"])
    _write_aov(tree, "smooth_normal", geometry.outputs["Normal"])
    _write_aov(tree, "true_normal", geometry.outputs["True Normal"])


def _write_aov(tree, name: str, value) -> None:
    """Add a node to `tree` that writes `value`, a socket of the tree, a number or a color, into the AOV `name`."""
    node = tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = AOV_PREFIX + name
    target = node.inputs["Color" if aov_kind(name) == "COLOR" else "Value"]
    graph.feed(target, (*value[:3], 1.0) if isinstance(value, tuple) else value)


def declare_aovs(view_layer) -> None:
    """Add a pass to `view_layer` for every AOV that some material writes, and for all of HIT_AOVS."""
    trees = [material.node_tree for material in bpy.data.materials if material.node_tree] + list(bpy.data.node_groups)
    written = {
        node.aov_name.removeprefix(AOV_PREFIX)
        for tree in trees
        if tree.bl_idname == "ShaderNodeTree"
        for node in tree.nodes
        if node.bl_idname == "ShaderNodeOutputAOV" and node.aov_name.startswith(AOV_PREFIX)
    }
    for name in sorted(written | set(HIT_AOVS)):
        aov = view_layer.aovs.add()
        aov.name, aov.type = AOV_PREFIX + name, aov_kind(name)


def remove_aovs(view_layer) -> None:
    """Remove the passes of `declare_aovs`."""
    for aov in [aov for aov in view_layer.aovs if aov.name.startswith(AOV_PREFIX)]:
        view_layer.aovs.remove(aov)


def materials_in_use(surfaces: list, override=None) -> list:
    """Original materials of the evaluated objects `surfaces`, each once; only `override` if it is given."""
    if override is not None:
        return [override.original]
    materials = {}
    for ob in surfaces:
        for slot in ob.material_slots:
            if slot.material is not None:
                materials[slot.material.original.name_full] = slot.material.original
    return list(materials.values())


def materials_of(scene) -> list:
    """Materials of the objects of `scene` that render, each once, sorted by name."""
    objects = (ob for ob in scene.objects if not ob.hide_render and ob.type not in ("LIGHT", "CAMERA"))
    materials = {slot.material for ob in objects for slot in ob.material_slots} - {None}
    return sorted(materials, key=lambda material: material.name_full)


def objects_without_material(surfaces: list) -> list:
    """Original objects of `surfaces` with no material slot or an empty one."""
    objects = {}
    for ob in surfaces:
        slots = ob.material_slots
        if len(slots) == 0 or any(slot.material is None for slot in slots):
            objects[ob.original.name_full] = ob.original
    return list(objects.values())


def give_default_material(objects: list):
    """Assign a material that looks like Cycles' default surface to all empty slots; returns it, or None if unused."""
    if not objects:
        return None
    material = bpy.data.materials.new("Default surface")
    graph.ensure_nodes(material)
    # Measured: a gray Diffuse BSDF in 4.5.15, a Principled BSDF with all its defaults in 5.2.3.
    default = "ShaderNodeBsdfDiffuse" if bpy.app.version < (5, 0, 0) else "ShaderNodeBsdfPrincipled"
    graph.fill_with_bsdf(material.node_tree, default, (0.8, 0.8, 0.8, 1.0))
    for ob in objects:
        if len(ob.material_slots) == 0:
            ob.data.materials.append(material)
        for slot in ob.material_slots:
            if slot.material is None:
                slot.material = material
    return material
