"""The samples carry what Cycles evaluates in the materials; what cannot be shaded is named."""

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from material_scenes import Build, seen_from_above
from scene_parts import add_geometry_nodes, add_plane, bsdf_material, principled

from ltsh_addon.blender import render_settings
from ltsh_addon.blender.materials.aovs import inject_aovs
from ltsh_addon.cycles import horizons, lobes

# Texture coordinates and colors pass through float32 a few times.
EXACT = 2e-6


GLOSSY, DIFFUSE = "ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfDiffuse"


@pytest.fixture(autouse=True)
def _empty_scene():
    scene_parts.empty_scene()


@pytest.mark.parametrize(
    ("kind", "color", "f0", "f90", "albedo"),
    [("ShaderNodeBsdfPrincipled", "Base Color", 1, 1, 0), (GLOSSY, "Color", 1, None, 0), (DIFFUSE, "Color", 0, 0, 1)],
)
def test_samples_have_the_values_of_textures(tmp_path, kind, color, f0, f90, albedo):
    """The texture's color is in `f0` or `albedo`; an f90 of None is the same as f0."""
    material, node = bsdf_material(kind, **({"Metallic": 1.0} if color == "Base Color" else {}))
    coordinates = material.node_tree.nodes.new("ShaderNodeTexCoord").outputs["UV"]
    separate = material.node_tree.nodes.new("ShaderNodeSeparateXYZ")
    material.node_tree.links.new(coordinates, separate.inputs[0])
    material.node_tree.links.new(coordinates, node.inputs[color])
    if kind != DIFFUSE:
        material.node_tree.links.new(separate.outputs[0], node.inputs["Roughness"])
    surface, _, warnings = seen_from_above(tmp_path, material)
    texture = surface.position / 6.0 + (0.5, 0.5, 0.0)
    assert np.abs(surface.specular_f0 - f0 * texture).max() < EXACT
    assert np.abs(surface.specular_f90 - (surface.specular_f0 if f90 is None else f90)).max() == 0.0
    assert np.abs(surface.diffuse_albedo - albedo * texture).max() < EXACT
    assert kind == DIFFUSE or np.abs(surface.roughness - texture[:, 0]).max() < EXACT
    assert not surface.dielectric.any() and warnings == []


def test_a_normal_map_turns_the_normal(tmp_path):
    material, node = principled()
    normal_map = material.node_tree.nodes.new("ShaderNodeNormalMap")
    normal_map.inputs["Color"].default_value = (0.65, 0.4, 0.95, 1.0)
    material.node_tree.links.new(normal_map.outputs[0], node.inputs["Normal"])
    surface, _, _ = seen_from_above(tmp_path, material)
    # The plane's tangent is x and its bitangent y.
    expected = horizons.unit(2.0 * np.array([[0.65, 0.4, 0.95]]) - 1.0)
    assert np.abs(surface.normal - expected).max() < 1e-5
    assert np.array_equal(surface.normal, surface.diffuse_normal)


def test_a_group_is_followed_for_each_of_its_users(tmp_path):
    tree = scene_parts.group_with_principled()
    for value, x in ((0.77, -1.5), (0.33, 1.5)):
        b = Build(f"Uses group {value}")
        # The unused second node of the same group must not write into the samples.
        for roughness in (0.1, value):
            node = b.new("ShaderNodeGroup")
            node.node_tree = tree
            node.inputs["Roughness"].default_value = roughness
        add_plane(b.show(node.outputs[0]), size=3.0, location=(x, 0.0, 0.1))
    surface, _, warnings = seen_from_above(tmp_path, principled()[0])
    left, right = (np.abs(surface.position - (x, 0.0, 0.1)).max(axis=-1) < 1.49 for x in (-1.5, 1.5))
    assert left.any() and right.any() and len(tree.nodes) == 3
    assert np.allclose(surface.roughness[left], 0.77) and np.allclose(surface.roughness[right], 0.33)


@pytest.mark.parametrize("is_rerouted", [False, True])
def test_a_muted_texture_leaves_the_color_of_the_socket(tmp_path, is_rerouted):
    """As in Cycles, where it is black behind a reroute before Blender 5.0."""
    material, node = bsdf_material(GLOSSY, Color=(0.7, 0.4, 0.2, 1.0))
    tree = material.node_tree
    texture, reroute = (tree.nodes.new(name) for name in ("ShaderNodeTexImage", "NodeReroute"))
    texture.mute, output = True, texture.outputs[0]
    if is_rerouted:
        tree.links.new(output, reroute.inputs[0])
        output = reroute.outputs[0]
    tree.links.new(output, node.inputs["Color"])
    surface, _, warnings = seen_from_above(tmp_path, material)
    is_black = is_rerouted and bpy.app.version < (5, 0, 0)
    assert np.allclose(surface.specular_f0, 0.0 if is_black else (0.7, 0.4, 0.2)) and warnings == []


@pytest.mark.parametrize("slots", ["none", "empty"])
def test_without_material_the_surface_is_cycles_default(tmp_path, slots):
    plane = add_plane()
    if slots == "empty":
        plane.data.materials.append(None)
    scene_parts.add_area_light("Other")
    scene_parts.add_top_camera()
    untouched = scene_parts.cycles_channels(tmp_path, 1, ("combined", "diffuse_color", "glossy_color"), max_bounces=0)
    names = render_settings.pass_names()
    expected = lobes.read_layer(untouched, names["diffuse_color"], "RGB").reshape(-1, 3)
    glossy = lobes.read_layer(untouched, names["specular_color"], "RGB").any()
    surface, _, _ = seen_from_above(tmp_path)
    assert np.abs(surface.diffuse_albedo - expected).max() < EXACT and expected.min() > 0.5
    # Multiple scattering adds less than a percent to a dielectric.
    assert not surface.specular_f90.any() and np.allclose(surface.dielectric, float(glossy), atol=0.02)


def test_a_material_set_by_geometry_nodes_is_sampled(tmp_path):
    plane = add_plane(size=6.0)
    tree, entry, end, node = add_geometry_nodes(plane, "SetMaterial")
    node.inputs["Material"].default_value = principled("Set by nodes", Roughness=0.42)[0]
    tree.links.new(entry.outputs[0], node.inputs["Geometry"])
    tree.links.new(node.outputs[0], end.inputs[0])
    surface, _, _ = seen_from_above(tmp_path)
    assert np.allclose(surface.roughness, 0.42) and np.all(surface.dielectric == 1.0)


def test_displacement_as_bump_is_in_the_normal(tmp_path):
    material, node = principled(Metallic=1.0)
    tree = material.node_tree
    noise, displacement = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeDisplacement")
    displacement.inputs["Scale"].default_value = 30.0
    tree.links.new(noise.outputs[0], displacement.inputs["Height"])
    tree.links.new(displacement.outputs[0], tree.nodes["Material Output"].inputs["Displacement"])
    surface, _, _ = seen_from_above(tmp_path, material)
    assert np.abs(surface.normal[:, :2]).max() > 0.1


@pytest.mark.parametrize("kind", ["alpha", "mix", "group"])
def test_transparency_is_cut_in_samples_and_reference(tmp_path, kind):
    b = Build("Veil")
    surface = b.shader("BsdfPrincipled", Base_Color=(0.8, 0.1, 0.1, 1.0), Alpha=0.5 if kind == "alpha" else 1.0)
    if kind != "alpha":
        surface = b.mix(0.5, surface, b.clear() if kind == "mix" else b.group(b.clear)[0])
    add_plane(b.show(surface), name="Front", location=(0.0, 0.0, 0.5))
    surface, _, warnings = seen_from_above(tmp_path, principled("Back", Metallic=1.0)[0])
    assert np.allclose(surface.position[:, 2], 0.5) and np.all(surface.dielectric == 1.0)
    assert len(warnings) == 1 and "'Veil'" in warnings[0] and "opaque" in warnings[0]
    halves = scene_parts.reference(tmp_path, (bpy.context.scene, bpy.context.view_layer), 32)
    expected = quadrature.radiance(surface, list(scene_parts.prepare()[2].lights), quadrature.lambert)
    # 32 samples leave 1e-3 of noise in the sum; half of the light would be missing.
    assert abs(quadrature.bias(expected, halves["diffuse"].reshape(2, -1, 3))) < 1e-2


def _colors_under_alpha(b):
    """The outputs Color and Alpha of an image of one color, half clear."""
    image = bpy.data.images.new("Veil", 2, 2, alpha=True)
    image.pixels.foreach_set(np.tile(np.float32([0.8, 0.6, 0.4, 0.5]), 4))
    image.pack()
    node = b.new("ShaderNodeTexImage")
    node.image = image
    return node.outputs["Color"], node.outputs["Alpha"]


def _principled_with_alpha(b, color, alpha):
    surface = b.shader("BsdfPrincipled")
    b.link(color, surface.node.inputs["Base Color"])
    b.link(alpha, surface.node.inputs["Alpha"])
    return surface


def _diffuse_beside_clear(b, color, alpha, is_first):
    surface = b.shader("BsdfDiffuse")
    b.link(color, surface.node.inputs["Color"])
    if not is_first:
        return b.mix(alpha, b.clear(), surface)
    clear = b.new("ShaderNodeMath")
    clear.operation, clear.inputs[0].default_value = "SUBTRACT", 1.0
    b.link(alpha, clear.inputs[1])
    return b.mix(clear.outputs[0], surface, b.clear())


@pytest.mark.parametrize("kind", ["principled", "first of a mix", "last of a mix", "group"])
def test_colors_under_a_cut_alpha_are_those_of_the_image(tmp_path, kind):
    """Cycles multiplies colors by alpha where the Alpha of the image feeds nothing."""
    b = Build("Veil")

    def fill():
        if "mix" in kind:
            return _diffuse_beside_clear(b, *_colors_under_alpha(b), kind == "first of a mix")
        return _principled_with_alpha(b, *_colors_under_alpha(b))

    surface, _, _ = seen_from_above(tmp_path, b.show(b.group(fill)[0] if kind == "group" else fill()))
    expected = ((np.array([0.8, 0.6, 0.4]) + 0.055) / 1.055) ** 2.4
    # Cycles keeps the product of colors and alpha in 8 bits: one of 102 steps is 1 % of an sRGB value.
    assert np.abs(surface.diffuse_albedo / expected - 1.0).max() < 2.4 * 0.01 + 0.04 * (kind in ("principled", "group"))


def test_every_unsupported_input_is_named_once(tmp_path):
    wanted = {"Subsurface Weight": 0.2, "Transmission Weight": 0.1, "Thin Film Thickness": 100.0}
    material, node = principled("Rich")
    if "Thin Wall" in node.inputs:
        wanted["Thin Wall"] = True
    for name, value in wanted.items():
        node.inputs[name].default_value = value
    node.inputs["Sheen Weight"].default_value = node.inputs["Diffuse Roughness"].default_value = 0.3
    node.inputs["Coat Weight"].default_value, node.inputs["Specular Tint"].default_value = 0.2, (1.0, 0.5, 0.5, 1.0)
    node.inputs["Emission Strength"].default_value = 2.0
    scene_parts.add_top_camera()
    scene_parts.add_area_light()
    add_plane(material)
    warnings = scene_parts.prepare()[3]
    assert len(warnings) == len(wanted)
    for name in wanted:
        assert sum(f"{name} of 'Principled BSDF'" in line for line in warnings) == 1, (name, warnings)
    assert all(line.startswith("material 'Rich': ") for line in warnings)
    assert not any("emission" in line for line in warnings)  # it is a light


@pytest.mark.parametrize("kind", ["AmbientOcclusion", "Bevel"])
def test_nodes_that_send_rays_are_named(kind):
    material, node = principled("Worn")
    tree = material.node_tree
    unused, used = (tree.nodes.new(f"ShaderNode{kind}") for _ in range(2))
    tree.links.new(used.outputs[0], node.inputs["Base Color"])
    warnings = inject_aovs([material])
    assert len(warnings) == 1 and repr(used.name) in warnings[0]
    assert warnings[0].startswith(f"material {material.name!r}: ") and unused.name != used.name


def test_materials_that_shine_into_the_scene_keep_their_emission():
    quiet, shining = (principled(name, **{"Emission Strength": 2.0})[0] for name in ("Quiet", "Shining"))
    warnings = inject_aovs([quiet, shining], frozenset({"Shining"}))
    assert quiet.cycles.emission_sampling == "NONE" and shining.cycles.emission_sampling != "NONE"
    assert len(warnings) == 1 and "'Quiet'" in warnings[0] and "emission" in warnings[0]
