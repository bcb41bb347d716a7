"""The samples carry what Cycles evaluates in the materials; what cannot be shaded is named."""

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from scene_parts import add_plane, bsdf_material, new_material, principled

from ltsh_addon.blender import render_settings
from ltsh_addon.blender.materials.aovs import inject_aovs
from ltsh_addon.blender.materials.bsdfs import notes_of
from ltsh_addon.cycles import horizons, lobes

# Texture coordinates and colors pass through float32 a few times.
EXACT = 2e-6


@pytest.fixture
def plane_scene():
    """A plane of 6 m seen from above, one light; call with its material for (surface samples, warnings)."""

    def make(folder, *materials):
        scene_parts.add_area_light()
        for material in materials:
            add_plane(material)
        prepared = scene_parts.prepare()
        ((surface, _, unusable),), _ = scene_parts.sample(folder, prepared)
        assert unusable == 0 and len(surface) == scene_parts.SIZE[0] * scene_parts.SIZE[1]
        return surface, prepared[3]

    scene_parts.empty_scene()
    scene_parts.add_top_camera()
    return make


def uv_of(surface):
    """Texture coordinates (P, 2) of the plane that `add_plane` makes."""
    return surface.position[:, :2] / 6.0 + 0.5


def feed_uv(tree, color_socket, value_socket):
    """(u, v, 0) into a color socket, u into a value socket."""
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    separate = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(coordinates.outputs["UV"], separate.inputs[0])
    tree.links.new(coordinates.outputs["UV"], color_socket)
    tree.links.new(separate.outputs[0], value_socket)


def test_textures_on_principled(tmp_path, plane_scene):
    material, node = principled(Metallic=1.0)
    feed_uv(material.node_tree, node.inputs["Base Color"], node.inputs["Roughness"])
    surface, warnings = plane_scene(tmp_path, material)
    uv = uv_of(surface)
    assert np.abs(surface.specular_f0[:, :2] - uv).max() < EXACT and not surface.specular_f0[:, 2].any()
    assert np.abs(surface.roughness - uv[:, 0]).max() < EXACT
    assert np.all(surface.specular_f90 == 1.0) and np.all(surface.dielectric == 0.0)
    assert surface.diffuse_albedo.max() == 0.0 and warnings == []


def test_textures_on_glossy(tmp_path, plane_scene):
    material, node = bsdf_material("ShaderNodeBsdfAnisotropic")
    feed_uv(material.node_tree, node.inputs["Color"], node.inputs["Roughness"])
    surface, warnings = plane_scene(tmp_path, material)
    uv = uv_of(surface)
    assert np.abs(surface.specular_f0[:, :2] - uv).max() < EXACT
    assert np.array_equal(surface.specular_f0, surface.specular_f90)
    assert np.abs(surface.roughness - uv[:, 0]).max() < EXACT and warnings == []


def test_a_diffuse_bsdf_has_no_specular_part(tmp_path, plane_scene):
    surface, warnings = plane_scene(tmp_path, bsdf_material("ShaderNodeBsdfDiffuse", Color=(0.3, 0.5, 0.7, 1.0))[0])
    assert np.allclose(surface.diffuse_albedo, (0.3, 0.5, 0.7), atol=EXACT)
    assert not surface.specular_f0.any() and not surface.specular_f90.any() and not surface.dielectric.any()
    assert warnings == []


def test_a_normal_map_turns_the_normal(tmp_path, plane_scene):
    material, node = principled()
    normal_map = material.node_tree.nodes.new("ShaderNodeNormalMap")
    normal_map.inputs["Color"].default_value = (0.65, 0.4, 0.95, 1.0)
    material.node_tree.links.new(normal_map.outputs[0], node.inputs["Normal"])
    surface, _ = plane_scene(tmp_path, material)
    # The plane's tangent is x and its bitangent y.
    expected = horizons.unit(2.0 * np.array([[0.65, 0.4, 0.95]]) - 1.0)
    assert np.abs(surface.normal - expected).max() < 1e-5
    assert np.array_equal(surface.normal, surface.diffuse_normal)


def test_principled_weights_reproduce_cycles(tmp_path):
    """Metal, dielectric and diffuse share one material; the oracle sees only the samples."""
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_area_light()
    material, _ = principled(
        Base_Color=(0.8, 0.5, 0.2, 1.0), Metallic=0.4, Roughness=0.5, IOR=1.6, **{"Specular IOR Level": 0.8}
    )
    add_plane(material, size=12.0)
    prepared = scene_parts.prepare()
    ((surface, pixel, _),), _ = scene_parts.sample(tmp_path, prepared)
    halves = scene_parts.reference(tmp_path, prepared, 512)
    for lobe, brdf in (("specular", quadrature.ggx), ("diffuse", quadrature.lambert)):
        image = quadrature.radiance(surface, prepared[2].lights, brdf)
        cycles = halves[lobe].reshape(2, -1, 3)[:, pixel]
        # Cycles' tabulated albedo of the specular layer is good to about 0.3 %; a wrong weight shows as 5 % and more.
        assert quadrature.relative_l2(image, cycles) < 4e-3 and abs(quadrature.bias(image, cycles)) < 4e-3


def test_a_group_is_followed_for_each_of_its_users(tmp_path, plane_scene):
    tree = scene_parts.group_with_principled()
    materials = []
    for value, x in ((0.77, -1.5), (0.33, 1.5)):
        material, nodes, output = new_material(f"Uses group {value}")
        # The unused second node of the same group must not write into the samples.
        for roughness in (0.1, value):
            node = nodes.nodes.new("ShaderNodeGroup")
            node.node_tree = tree
            node.inputs["Roughness"].default_value = roughness
        nodes.links.new(node.outputs[0], output.inputs["Surface"])
        materials.append(material)
        add_plane(material, size=3.0, location=(x, 0.0, 0.1))
    surface, warnings = plane_scene(tmp_path, principled()[0])
    left, right = (np.abs(surface.position - (x, 0.0, 0.1)).max(axis=-1) < 1.49 for x in (-1.5, 1.5))
    assert left.any() and right.any() and len(tree.nodes) == 3
    assert np.allclose(surface.roughness[left], 0.77) and np.allclose(surface.roughness[right], 0.33)


def test_a_shader_that_goes_through_a_group_reroutes_and_a_muted_node(tmp_path, plane_scene):
    tree = bpy.data.node_groups.new("Pass", "ShaderNodeTree")
    tree.interface.new_socket("In", in_out="INPUT", socket_type="NodeSocketShader")
    tree.interface.new_socket("Out", in_out="OUTPUT", socket_type="NodeSocketShader")
    tree.links.new(tree.nodes.new("NodeGroupInput").outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
    material, nodes, output = new_material()
    shader = nodes.nodes.new("ShaderNodeBsdfPrincipled")
    shader.distribution, shader.inputs["Roughness"].default_value = "GGX", 0.61
    group, reroute, muted = (
        nodes.nodes.new(name) for name in ("ShaderNodeGroup", "NodeReroute", "ShaderNodeMixShader")
    )
    group.node_tree, muted.mute = tree, True
    nodes.links.new(shader.outputs[0], group.inputs[0])
    nodes.links.new(group.outputs[0], reroute.inputs[0])
    nodes.links.new(reroute.outputs[0], muted.inputs[1])
    nodes.links.new(muted.outputs[0], output.inputs["Surface"])
    surface, warnings = plane_scene(tmp_path, material)
    assert np.allclose(surface.roughness, 0.61) and np.all(surface.dielectric == 1.0) and warnings == []


@pytest.mark.parametrize("slots", ["none", "empty"])
def test_without_material_the_surface_is_cycles_default(tmp_path, plane_scene, slots):
    plane = add_plane()
    if slots == "empty":
        plane.data.materials.append(None)
    scene_parts.add_area_light("Other")
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", 1, 0
    render_settings.enable_passes(bpy.context.view_layer, ("combined", "diffuse_color", "glossy_color"))
    render_settings.render_exr(scene, tmp_path / "untouched.exr")
    untouched = scene_parts.read_channels(tmp_path / "untouched.exr")
    names = render_settings.pass_names()
    expected = lobes.read_layer(untouched, names["diffuse_color"], "RGB").reshape(-1, 3)
    glossy = lobes.read_layer(untouched, names["specular_color"], "RGB").any()
    surface, _ = plane_scene(tmp_path)
    assert np.abs(surface.diffuse_albedo - expected).max() < EXACT and expected.min() > 0.5
    # Multiple scattering adds less than a percent to a dielectric.
    assert not surface.specular_f90.any() and np.allclose(surface.dielectric, float(glossy), atol=0.02)


def test_a_material_set_by_geometry_nodes_is_sampled(tmp_path, plane_scene):
    plane = add_plane(size=6.0)
    tree = bpy.data.node_groups.new("Set", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    node = tree.nodes.new("GeometryNodeSetMaterial")
    node.inputs["Material"].default_value = principled("Set by nodes", Roughness=0.42)[0]
    tree.links.new(tree.nodes.new("NodeGroupInput").outputs[0], node.inputs["Geometry"])
    tree.links.new(node.outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
    plane.modifiers.new("Set", "NODES").node_group = tree
    surface, _ = plane_scene(tmp_path)
    assert np.allclose(surface.roughness, 0.42) and np.all(surface.dielectric == 1.0)


def test_a_view_layer_override_is_what_counts(tmp_path, plane_scene):
    bpy.context.view_layer.material_override = principled("Clay", Roughness=0.9)[0]
    surface, _ = plane_scene(tmp_path, principled(Roughness=0.1)[0], None)
    assert np.allclose(surface.roughness, 0.9)


def test_a_linked_material_is_sampled(tmp_path, plane_scene):
    library = tmp_path / "library.blend"
    bpy.data.libraries.write(str(library), {principled("Far", Roughness=0.37)[0]}, fake_user=True)
    before = library.read_bytes()
    scene_parts.empty_scene()
    scene_parts.add_top_camera()
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.materials = ["Far"]
    surface, warnings = plane_scene(tmp_path, bpy.data.materials["Far"])
    assert np.allclose(surface.roughness, 0.37) and warnings == [] and library.read_bytes() == before


def test_displacement_as_bump_is_in_the_normal(tmp_path, plane_scene):
    material, node = principled(Metallic=1.0)
    tree = material.node_tree
    noise, displacement = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeDisplacement")
    displacement.inputs["Scale"].default_value = 30.0
    tree.links.new(noise.outputs[0], displacement.inputs["Height"])
    output = next(item for item in tree.nodes if item.bl_idname == "ShaderNodeOutputMaterial")
    tree.links.new(displacement.outputs[0], output.inputs["Displacement"])
    surface, _ = plane_scene(tmp_path, material)
    assert np.abs(surface.normal[:, :2]).max() > 0.1


def transparent_material(kind):
    """A red surface that lets half of the light through, built in three ways."""
    if kind == "alpha":
        material, _ = principled("Veil", Base_Color=(0.8, 0.1, 0.1, 1.0), Alpha=0.5)
        return material
    material, node = principled("Veil", Base_Color=(0.8, 0.1, 0.1, 1.0))
    tree = material.node_tree
    output = next(item for item in tree.nodes if item.bl_idname == "ShaderNodeOutputMaterial")
    mix, transparent = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfTransparent")
    order = (node, transparent) if kind == "mix" else (transparent, node)
    for index, item in enumerate(order):
        tree.links.new(item.outputs[0], mix.inputs[1 + index])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return material


@pytest.mark.parametrize("kind", ["alpha", "mix", "mix, other way round"])
def test_transparency_is_cut_in_samples_and_reference(tmp_path, plane_scene, kind):
    add_plane(transparent_material(kind), name="Front", location=(0.0, 0.0, 0.5))
    surface, warnings = plane_scene(tmp_path, principled("Back", Metallic=1.0)[0])
    assert np.allclose(surface.position[:, 2], 0.5) and np.all(surface.dielectric == 1.0)
    assert len(warnings) == 1 and "'Veil'" in warnings[0] and "opaque" in warnings[0]
    layer = bpy.context.view_layer
    halves = scene_parts.reference(tmp_path, (bpy.context.scene, layer), 32)
    lights = [light for light in scene_parts.prepare()[2].lights]
    expected = quadrature.radiance(surface, lights, quadrature.lambert)
    # 32 samples leave 1e-3 of noise in the sum; half of the light would be missing.
    assert abs(quadrature.bias(expected, halves["diffuse"].reshape(2, -1, 3))) < 1e-2


def test_every_unsupported_input_is_named_once(tmp_path, plane_scene):
    wanted = {
        "Diffuse Roughness": 0.5,
        "Subsurface Weight": 0.2,
        "Anisotropic": 0.3,
        "Transmission Weight": 0.1,
        "Sheen Weight": 0.3,
        "Thin Film Thickness": 100.0,
        "IOR": 0.8,
    }
    material, node = principled("Rich")
    if "Thin Wall" in node.inputs:
        wanted["Thin Wall"] = True
    for name, value in wanted.items():
        node.inputs[name].default_value = value
    node.inputs["Coat Weight"].default_value, node.inputs["Specular Tint"].default_value = 0.2, (1.0, 0.5, 0.5, 1.0)
    node.inputs["Emission Strength"].default_value = 2.0
    scene_parts.add_area_light()
    add_plane(material)
    warnings = scene_parts.prepare()[3]
    assert len(warnings) == len(wanted)
    for name in wanted:
        assert sum(f"{name} of 'Principled BSDF'" in line for line in warnings) == 1, (name, warnings)
    assert all(line.startswith("material 'Rich': ") for line in warnings)
    assert not any("emission" in line for line in warnings)  # it is a light


@pytest.mark.parametrize(
    "edge, base, named", [(0.0, 0.5, True), (0.1, 0.5, False), (0.3, 0.02, True), (0.0, 0.95, False), (1.0, 0.0, False)]
)
def test_metals_that_cycles_clips_at_black_are_named(edge, base, named):
    found = []
    for kind, tint in (("ShaderNodeBsdfMetallic", "Edge_Tint"), ("ShaderNodeBsdfPrincipled", "Specular_Tint")):
        _, node = bsdf_material(kind, Base_Color=(base, base, base, 1.0), **{tint: (edge, edge, edge, 1.0)})
        if "Metallic" in node.inputs:
            found += notes_of(node)  # no metal yet
            node.inputs["Metallic"].default_value = 1.0
        found += notes_of(node)
    assert len(found) == (2 if named else 0) and all("Tint of '" in line for line in found)


@pytest.mark.parametrize("kind", ["AmbientOcclusion", "Bevel"])
def test_nodes_that_send_rays_are_named(kind):
    material, node = principled("Worn")
    tree = material.node_tree
    unused, used = (tree.nodes.new(f"ShaderNode{kind}") for _ in range(2))
    tree.links.new(used.outputs[0], node.inputs["Base Color"])
    warnings = inject_aovs([material])
    assert len(warnings) == 1 and repr(used.name) in warnings[0]
    assert warnings[0].startswith(f"material {material.name!r}: ") and unused.name != used.name


def test_an_index_of_refraction_that_varies_is_named():
    found = []
    for kind in ("ShaderNodeBsdfGlass", "ShaderNodeBsdfPrincipled"):
        material, node = bsdf_material(kind)
        value = material.node_tree.nodes.new("ShaderNodeTexCoord").outputs["UV"]
        material.node_tree.links.new(value, node.inputs["IOR"])
        found += notes_of(node)
    assert sum("IOR of '" in line and "varies" in line for line in found) == 2


def test_other_shaders_are_named_and_shaded_as_the_nearest(tmp_path, plane_scene):
    kinds = {
        "ShaderNodeBsdfGlass": "only its reflection",
        "ShaderNodeBsdfRefraction": "not shaded",
        "ShaderNodeBsdfHair": "not shaded",
        "ShaderNodeBsdfSheen": "as a Diffuse BSDF",
        "ShaderNodeSubsurfaceScattering": "as a Diffuse BSDF",
        "ShaderNodeBsdfToon": "as a Diffuse BSDF",
    }
    for number, kind in enumerate(kinds):
        add_plane(bsdf_material(kind, f"Material {number}")[0])
    surface, warnings = plane_scene(tmp_path, principled()[0])
    assert len(warnings) == len(kinds) and len(surface) == 24 * 16
    for number, (line, done) in enumerate(zip(warnings, kinds.values(), strict=True)):
        assert line.startswith(f"material 'Material {number}': node '") and done in line


def test_materials_that_shine_into_the_scene_keep_their_emission():
    quiet, shining = (principled(name, **{"Emission Strength": 2.0})[0] for name in ("Quiet", "Shining"))
    warnings = inject_aovs([quiet, shining], frozenset({"Shining"}))
    assert quiet.cycles.emission_sampling == "NONE" and shining.cycles.emission_sampling != "NONE"
    assert len(warnings) == 1 and "'Quiet'" in warnings[0] and "emission" in warnings[0]
