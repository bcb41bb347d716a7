"""AOVs, the viewport and the overview read the same lobes and weights from every material, and name the same nodes."""

from __future__ import annotations

import itertools

import bpy
import numpy as np
import pytest
import scene_parts
from material_scenes import Build

from ltsh_addon.blender.lights.emission import emission_of
from ltsh_addon.blender.materials.aovs import inject_aovs
from ltsh_addon.blender.materials.preview_material import COAT, preview_of
from ltsh_addon.blender.ui import preflight
from ltsh_addon.cycles.lobes import LOBE_KINDS, MAX_LOBES, SMALLEST_WEIGHT

KIND_NAMES = {value: name for name, value in LOBE_KINDS.items()}
CONDUCTOR = "conductor" if bpy.app.version >= (5, 0, 0) else "conductor_4_5"
# Node, property, value -> kind of lobe; without a property for all others. Nodes that are not here have no lobe.
KINDS = {
    ("BsdfPrincipled", ""): "principled",
    ("BsdfAnisotropic", ""): "glossy",
    ("BsdfDiffuse", ""): "diffuse",
    ("BsdfTranslucent", ""): "translucent",
    ("BsdfGlass", ""): "glass",
    ("BsdfMetallic", "F82"): "metal",
    ("BsdfMetallic", "PHYSICAL_CONDUCTOR"): CONDUCTOR,
    ("BsdfSheen", "MICROFIBER"): "sheen",
    ("BsdfSheen", "ASHIKHMIN"): "velvet",
    ("BsdfToon", "DIFFUSE"): "diffuse",
    ("SubsurfaceScattering", ""): "diffuse",
}
NAMED = ("BsdfGlass", "BsdfRefraction", "BsdfHair", "SubsurfaceScattering", "BsdfToon")
ALPHA = {"BECKMANN": 0.75, "ASHIKHMIN_SHIRLEY": 0.9}
CHOICES = ("distribution", "component", "fresnel_type", "model", "falloff")


@pytest.fixture(autouse=True)
def _custom_group():
    """An empty scene, and group nodes as add-ons define them."""
    scene_parts.empty_scene()

    class CustomGroup(bpy.types.ShaderNodeCustomGroup):
        bl_idname, bl_label = "TestCustomGroup", "Custom group"

    bpy.utils.register_class(CustomGroup)
    yield
    bpy.utils.unregister_class(CustomGroup)


def evaluated(socket, path=()):
    """The number or color of an input as the nodes compute it; `path` has the group nodes around it."""
    if not socket.links:
        value = socket.default_value
        return np.array(value)[:3] if hasattr(value, "__len__") else float(value)
    node, output = socket.links[0].from_node, socket.links[0].from_socket
    if node.bl_idname == "ShaderNodeMath":
        first, second = (evaluated(entry, path) for entry in node.inputs[:2])
        done = {"ADD": first + second, "SUBTRACT": first - second, "MULTIPLY": first * second}[node.operation]
        return min(max(done, 0.0), 1.0) if node.use_clamp else done
    if node.bl_idname == "NodeGroupInput":
        return evaluated(next(entry for entry in path[-1].inputs if entry.identifier == output.identifier), path[:-1])
    if hasattr(node, "node_tree"):
        end = next(inner for inner in node.node_tree.nodes if inner.bl_idname == "NodeGroupOutput")
        entry = next(entry for entry in end.inputs if entry.identifier == output.identifier)
        return evaluated(entry, (*path, node))
    assert node.bl_idname == "ShaderNodeValue", node.bl_idname
    return float(output.default_value)


def written_aovs(tree, path=()):
    """Values by name of all that a material's nodes write into AOVs of its lobes."""
    found = {}
    for node in tree.nodes:
        if node.bl_idname == "ShaderNodeOutputAOV" and node.aov_name[-1].isdigit():
            color = node.aov_name[:-2] in ("ltsh_color", "ltsh_tint")
            known = color or node.aov_name[:-2] in ("ltsh_kind", "ltsh_weight", "ltsh_roughness")
            if known:
                found[node.aov_name] = evaluated(node.inputs["Color" if color else "Value"], path)
        elif getattr(node, "node_tree", None) is not None:
            found |= written_aovs(node.node_tree, (*path, node))
    return found


def lobes_of_aovs(material):
    """(lobes, notes) of a copy of the material into which AOVs were written: (kind, weight, red, roughness) each."""
    copy = material.copy()
    warnings = inject_aovs([copy], frozenset({copy.name_full}))
    aovs = written_aovs(copy.node_tree)
    lobes = []
    for slot in range(MAX_LOBES):
        if aovs.get(f"ltsh_kind_{slot}", 0.0) > 0.0:
            kind = KIND_NAMES[round(aovs[f"ltsh_kind_{slot}"])]
            weight, color = aovs.get(f"ltsh_weight_{slot}", 1.0), aovs[f"ltsh_color_{slot}"]
            lobes.append((kind, weight, color[0], aovs.get(f"ltsh_roughness_{slot}", 0.0)))
    return visible(lobes), {line.partition(": ")[2] for line in warnings}


def lobes_of_look(material):
    """Those of the viewport; a node that is not shaded has its viewport color, which is no lobe of it."""
    lobes = []
    for lobe in preview_of(material).lobes:
        if lobe.kind != COAT and not lobe.is_stand_in:
            roughness = lobe.values["roughness"].offset[0] if "roughness" in lobe.values else 0.0
            lobes.append((lobe.kind, lobe.weight, lobe.value("color").offset[0], roughness))
    # Without any lobe it shows black.
    return [] if lobes == [("diffuse", 1.0, 0.0, 0.0)] else visible(lobes)


def visible(lobes):
    return sorted(lobe for lobe in lobes if lobe[1] > SMALLEST_WEIGHT)


def same(first, second):
    """Are these the same lobes, but for numbers that passed through float32?"""
    return len(first) == len(second) and all(
        a[0] == b[0] and np.allclose(a[1:], b[1:], atol=1e-5) for a, b in zip(first, second, strict=True)
    )


def agreed_lobes(material):
    """The lobes that all readers find in the material, and its entry in the overview."""
    entry = preflight._material(material, in_view=False, with_bounces=False)
    shown = lobes_of_look(material)
    written, notes = lobes_of_aovs(material)
    assert same(written, shown), (written, shown)
    assert set(entry.notes) == notes
    assert (entry.state == preflight.EXACT) == (not notes)
    return written, entry


# ---- every BSDF node


def shader_nodes():
    """(type, {property: value}) of all shader nodes of this Blender, in all of their variants."""
    tree = bpy.data.node_groups.new("Every node", "ShaderNodeTree")
    found = []
    for name in dir(bpy.types):
        if not name.startswith("ShaderNode"):
            continue
        try:
            node = tree.nodes.new(name)
        except RuntimeError:
            continue
        if any(socket.type == "SHADER" for socket in node.outputs):
            choices = [name for name in CHOICES if hasattr(node, name)]
            items = [[item.identifier for item in node.bl_rna.properties[name].enum_items] for name in choices]
            found += [(node.bl_idname, dict(zip(choices, values, strict=True))) for values in itertools.product(*items)]
    bpy.data.node_groups.remove(tree)
    return [entry for entry in found if entry[0][10:] not in ("MixShader", "AddShader")]


def expected_kind(node_type, settings):
    short = node_type.removeprefix("ShaderNode")
    return next((KINDS[short, value] for value in ("", *settings.values()) if (short, value) in KINDS), None)


def test_all_readers_shade_every_node_in_every_variant_alike():
    nodes = shader_nodes()
    assert len(nodes) > 35 and {kind[10:] for kind, _ in nodes} >= {kind for kind, _ in KINDS}
    for node_type, settings in nodes:
        material, tree, output = scene_parts.new_material("Single")
        node = tree.nodes.new(node_type)
        for name, value in settings.items():
            setattr(node, name, value)
        for name in ("Color", "Base Color"):
            if name in node.inputs:
                node.inputs[name].default_value = (0.3, 0.5, 0.7, 1.0)
        if "Roughness" in node.inputs and node_type != "ShaderNodeBsdfDiffuse":
            node.inputs["Roughness"].default_value = 0.4
        tree.links.new(node.outputs[0], output.inputs["Surface"])
        lobes, entry = agreed_lobes(material)
        wanted = expected_kind(node_type, settings)
        assert [lobe[:2] for lobe in lobes] == ([(wanted, 1.0)] if wanted else []), (node_type, settings, lobes)
        is_light = node_type[10:] in ("Emission", "BsdfTransparent", "Holdout")
        assert (entry.state == preflight.LEFT_OUT) == (wanted is None and not is_light), (node_type, settings, entry)
        if node_type[10:] in NAMED or wanted == "velvet":
            assert any(repr(node.name) in note for note in entry.notes), (node_type, entry)
        if wanted in ("principled", "glossy", "glass", "metal", "sheen", CONDUCTOR):
            roughness = 0.4 * ALPHA.get(settings.get("distribution"), 1.0) ** 0.5
            assert lobes[0][3] == pytest.approx(roughness, abs=1e-6), (node_type, settings)
        bpy.data.materials.remove(material)


# ---- mixes, sums and groups


def twice_the_same(b):
    leaf = b.leaf(0.1)
    return b.mix(0.25, b.mix(0.5, leaf, b.leaf(0.2)), leaf)


def group_twice(b):
    """What is different from outside stays so inside."""
    first, second = b.group(lambda deep: b.mix(0.2, b.leaf(0.1), deep), [b.leaf(0.2)], times=2)
    b.link(b.leaf(0.3), second.node.inputs[0])
    return b.mix(0.4, first, second)


def nested_groups(kind):
    def make(b):
        """A shader of the outermost tree is mixed in the innermost, and both are in another mix."""

        def outer(shader):
            (inner,) = b.group(lambda deep: b.mix(0.3, b.leaf(0.1), deep), [shader], kind)
            return b.mix(0.5, inner, b.leaf(0.2))

        (both,) = b.group(outer, [b.mix(0.2, b.leaf(0.3), b.leaf(0.4))], kind)
        return b.mix(0.1, both, b.leaf(0.5))

    return make


def muted_and_rerouted(b):
    muted, reroute = b.new("ShaderNodeMixShader"), b.new("NodeReroute")
    b.link(b.mix(0.3, b.leaf(0.1), b.leaf(0.2)), reroute.inputs[0])
    b.link(reroute.outputs[0], muted.inputs[1])
    muted.mute = True
    return muted.outputs[0]


def empty_group(b):
    node = b.new("ShaderNodeGroup")
    node.node_tree = bpy.data.node_groups.new("Nothing inside", "ShaderNodeTree")
    node.node_tree.interface.new_socket("Out", in_out="OUTPUT", socket_type="NodeSocketShader")
    return b.mix(0.3, node.outputs[0], b.leaf(0.1))


def clear_group(b):
    (veil,) = b.group(b.clear)
    return b.mix(0.3, b.mix(0.6, veil, b.leaf(0.1)), b.leaf(0.2))


# Red of the leaf -> weight.
NESTED = {0.1: 0.9 * 0.5 * 0.7, 0.2: 0.9 * 0.5, 0.3: 0.9 * 0.5 * 0.3 * 0.8, 0.4: 0.9 * 0.5 * 0.3 * 0.2, 0.5: 0.1}
STRUCTURES = {
    "mix": (lambda b: b.mix(0.3, b.leaf(0.1), b.leaf(0.2)), {0.1: 0.7, 0.2: 0.3}),
    "mixes": (
        lambda b: b.mix(0.3, b.mix(0.4, b.leaf(0.1), b.leaf(0.2)), b.mix(0.9, b.leaf(0.3), b.leaf(0.4))),
        {0.1: 0.42, 0.2: 0.28, 0.3: 0.03, 0.4: 0.27},
    ),
    "sum": (lambda b: b.add(b.leaf(0.1), b.mix(0.2, b.leaf(0.2), b.leaf(0.3))), {0.1: 1.0, 0.2: 0.8, 0.3: 0.2}),
    "a mixed sum": (lambda b: b.mix(0.2, b.add(b.leaf(0.1), b.leaf(0.2)), b.leaf(0.3)), {0.1: 0.8, 0.2: 0.8, 0.3: 0.2}),
    "factors beyond 1": (lambda b: b.mix(1.5, b.leaf(0.1), b.leaf(0.2)), {0.2: 1.0}),
    "factor 0": (lambda b: b.mix(0.0, b.leaf(0.1), b.clear()), {0.1: 1.0}),
    "a node that is used twice": (twice_the_same, {0.1: 0.75 * 0.5 + 0.25, 0.2: 0.75 * 0.5}),
    "a group that is used twice": (group_twice, {0.1: 0.8, 0.2: 0.12, 0.3: 0.08}),
    "groups": (nested_groups("ShaderNodeGroup"), NESTED),
    "custom groups": (nested_groups("TestCustomGroup"), NESTED),
    "muted nodes and reroutes": (muted_and_rerouted, {0.1: 0.7, 0.2: 0.3}),
    "a group without an output": (empty_group, {0.1: 0.3}),
    "a mix with nothing": (lambda b: b.mix(0.3, None, b.leaf(0.1)), {0.1: 0.3}),
    "a sum with nothing": (lambda b: b.add(b.leaf(0.1), None), {0.1: 1.0}),
    "nothing": (lambda b: b.mix(0.3, None, None), {}),
    "transparency": (lambda b: b.mix(0.3, b.clear(), b.leaf(0.1)), {0.1: 1.0}),
    "two transparencies": (lambda b: b.mix(0.5, b.mix(0.5, b.clear(), b.clear()), b.leaf(0.1)), {0.1: 1.0}),
    "added transparency": (lambda b: b.mix(0.5, b.add(b.clear(), b.leaf(0.1)), b.leaf(0.2)), {0.1: 0.5, 0.2: 0.5}),
    "a transparent sum": (lambda b: b.mix(0.4, b.add(b.clear(), b.clear()), b.leaf(0.1)), {0.1: 1.0}),
    "transparency in a mix": (
        lambda b: b.mix(0.3, b.mix(0.6, b.clear(), b.leaf(0.1)), b.leaf(0.2)),
        {0.1: 0.7, 0.2: 0.3},
    ),
    "transparency in a group": (clear_group, {0.1: 0.7, 0.2: 0.3}),
    "transparency alone": (lambda b: b.add(b.clear(), b.clear()), {}),
    "glossy Toon": (lambda b: b.mix(0.3, toon(b), b.leaf(0.1)), {0.1: 0.3}),
    "sheen": (lambda b: b.mix(0.3, b.leaf(0.2, "BsdfSheen"), b.leaf(0.1)), {0.2: 0.7, 0.1: 0.3}),
    "emission": (lambda b: b.mix(0.3, b.leaf(0.2, "Emission"), b.leaf(0.1)), {0.1: 0.3}),
}


def toon(b):
    socket = b.leaf(0.2, "BsdfToon")
    socket.node.component = "GLOSSY"
    return socket


@pytest.mark.parametrize("is_linked", [False, True], ids=["constants", "nodes"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_all_readers_weigh_the_lobes_of_mixes_sums_and_groups_alike(name, is_linked):
    make, expected = STRUCTURES[name]
    build = Build(is_linked=is_linked)
    lobes, _ = agreed_lobes(build.show(make(build)))
    found = {}
    for _, weight, red, _ in lobes:
        red = round(float(red), 3)
        found[red] = found.get(red, 0.0) + weight
    assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("kind", ["ShaderNodeGroup", "TestCustomGroup"])
def test_lights_and_the_viewport_see_the_same_emission_in_groups(kind):
    build = Build(is_linked=True)

    def fill(shader):
        return build.mix(0.25, shader, build.mix(0.5, build.clear(), build.leaf(1.0, "Emission")))

    build.show(*build.group(fill, [build.leaf(0.1)], kind))
    found = emission_of(build.material)
    assert found.emits and not (found.plain or found.varies or found.directional)
    # Transparency takes half of what shines and nothing of what is lit.
    np.testing.assert_allclose(preview_of(build.material).emission, np.array([1.0, 0.5, 0.5]) * 0.125, rtol=1e-6)


def test_views_name_what_they_do_not_show_of_a_material():
    for name, value in (("Alpha", 0.5), ("Volume", None), ("Displacement", None)):
        material, node = scene_parts.principled(name)
        tree, output = material.node_tree, node.outputs[0].links[0].to_node
        if value is None:
            kind = "ShaderNodeVolumeScatter" if name == "Volume" else "ShaderNodeDisplacement"
            tree.links.new(tree.nodes.new(kind).outputs[0], output.inputs[name])
        else:
            node.inputs[name].default_value = value
        (note,) = preview_of(material).notes
        assert note.startswith(f"{name}: ") and name.lower() in note and "not shown" in note
