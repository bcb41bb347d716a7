"""Materials in the viewport: every lobe and texture that Cycles samples, and what is not shown is named."""

import bpy
import numpy as np
import pytest
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from view_pictures import SIZE, image, normal_map, patches_too_far, textured, viewport_picture

from ltsh_addon import shading
from ltsh_addon.blender.engine import view
from ltsh_addon.blender.materials import looks
from ltsh_addon.blender.materials.looks import look_of
from ltsh_addon.cycles.closures import sheen_albedo

RED, GOLD, AMBER = (0.6, 0.25, 0.1, 1.0), (0.9, 0.7, 0.3, 1.0), (0.9, 0.6, 0.3, 1.0)


def coated(name, **inputs):
    return lambda: parts.principled(name, Base_Color=RED, **{"Roughness": 0.5, "Coat_Weight": 1.0, **inputs})[0]


def coated_normal_map(follows):
    """A bumpy base under a coat that is as bumpy, or smooth."""

    def make():
        material = normal_map()
        node = next(node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
        node.inputs["Coat Weight"].default_value, node.inputs["Coat Roughness"].default_value = 0.8, 0.2
        if follows:
            link = node.inputs["Normal"].links[0]
            material.node_tree.links.new(link.from_socket, node.inputs["Coat Normal"])
        material.name = f"coat over bumps {follows}"
        return material

    return make


def nodes_of(tree, *types):
    return [tree.nodes.new(f"ShaderNode{kind}") for kind in types]


def mixed(name, joiner="MixShader", factor=0.3):
    """Chalk and gloss, mixed or added."""

    def make():
        material, tree, output = parts.new_material(name)
        join, chalk, gloss = nodes_of(tree, joiner, "BsdfDiffuse", "BsdfAnisotropic")
        chalk.inputs["Color"].default_value, gloss.inputs["Color"].default_value = RED, GOLD
        gloss.distribution, gloss.inputs["Roughness"].default_value = "GGX", 0.35
        if joiner == "MixShader":
            join.inputs[0].default_value = factor
        for entry, node in zip(list(join.inputs)[-2:], (chalk, gloss), strict=True):
            tree.links.new(node.outputs[0], entry)
        tree.links.new(join.outputs[0], output.inputs["Surface"])
        return material

    return make


def nested():
    """A coated plastic, chalk behind it and gloss: four lobes."""
    material, tree, output = parts.new_material("nested")
    outer, inner, plastic, chalk, gloss = nodes_of(
        tree, "MixShader", "MixShader", "BsdfPrincipled", "BsdfDiffuse", "BsdfAnisotropic"
    )
    outer.inputs[0].default_value, inner.inputs[0].default_value = 0.4, 0.25
    plastic.inputs["Coat Weight"].default_value, plastic.inputs["Roughness"].default_value = 0.7, 0.6
    gloss.distribution, gloss.inputs["Roughness"].default_value = "GGX", 0.25
    tree.links.new(plastic.outputs[0], inner.inputs[1])
    tree.links.new(chalk.outputs[0], inner.inputs[2])
    tree.links.new(inner.outputs[0], outer.inputs[1])
    tree.links.new(gloss.outputs[0], outer.inputs[2])
    tree.links.new(outer.outputs[0], output.inputs["Surface"])
    return material


def half_glow():
    """Half of the chalk gives way to what glows: passes of light do not show that."""
    material, tree, output = parts.new_material("half glow")
    mix, chalk, glow = nodes_of(tree, "MixShader", "BsdfDiffuse", "Emission")
    glow.inputs["Strength"].default_value = 1e-6
    tree.links.new(chalk.outputs[0], mix.inputs[1])
    tree.links.new(glow.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return material


LAYERED = (
    coated("varnish"),
    coated("thin varnish", Coat_Weight=0.4, Coat_Roughness=0.3, Coat_IOR=1.8),
    coated("tinted varnish", Coat_Tint=AMBER, Coat_Roughness=0.15, Coat_IOR=1.35),
    coated("tint alone", Coat_Tint=AMBER, Coat_IOR=1.0),
    coated("car paint", Metallic=0.7, Coat_Roughness=0.1),
    coated_normal_map(False),
    coated_normal_map(True),
    mixed("mixed"),
    mixed("added", "AddShader"),
    mixed("mostly gloss", factor=0.9),
    nested,
    half_glow,
)


def masked(name, node_type=None, output="Color", inside=False, **inputs):
    """Chalk and gloss mixed by what a node says, or else an image; `inside`: that mixed with metal by an image."""

    def make():
        material = mixed(name)()
        tree = material.node_tree
        mix = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeMixShader")
        (factor,) = nodes_of(tree, node_type or "TexImage")
        if node_type is None:
            factor.image = image(name, is_data=True)
        for key, value in inputs.items():
            factor.inputs[key].default_value = value
        tree.links.new(factor.outputs[output], mix.inputs[0])
        if inside:
            outer, metal = nodes_of(tree, "MixShader", "BsdfMetallic")
            metal.inputs["Roughness"].default_value = 0.4
            texture = tree.nodes.new("ShaderNodeTexImage")
            texture.image = image(f"{name} outside", is_data=True)
            tree.links.new(texture.outputs["Color"], outer.inputs[0])
            end = mix.outputs[0].links[0].to_socket
            tree.links.new(mix.outputs[0], outer.inputs[1])
            tree.links.new(metal.outputs[0], outer.inputs[2])
            tree.links.new(outer.outputs[0], end)
        return material

    return make


MASKED = (
    masked("mask"),
    masked("Fresnel", "Fresnel", "Factor", IOR=1.8),
    masked("dense Fresnel", "Fresnel", "Factor", IOR=3.5, inside=True),
    masked("layer of Fresnel", "LayerWeight", "Fresnel", Blend=0.6),
    masked("facing", "LayerWeight", "Facing", Blend=0.5),
    masked("facing less", "LayerWeight", "Facing", Blend=0.2),
    masked("facing more", "LayerWeight", "Facing", Blend=0.9),
)


@edits_with_graphics
@pytest.mark.parametrize(
    ("materials", "kind", "passes"),
    [(LAYERED, "PERSP", shading.PASSES), (LAYERED, "ORTHO", ("specular",)), (MASKED, "PERSP", shading.PASSES)],
    ids=["perspective", "parallel", "masked"],
)
def test_the_viewport_adds_up_the_lobes_that_cycles_sampled(tmp_path, materials, kind, passes):
    assert not patches_too_far(tmp_path / "patches.blend", materials, kind, passes)


def test_factors_that_depend_on_more_are_named():
    parts.empty_scene()
    material = masked("Noise", "TexNoise", "Color")()
    look = look_of(material)
    assert [lobe.weight for lobe in look.lobes] == [0.5, 0.5]
    assert look.notes == ("Noise: factor of 'Mix Shader' is not resolved",)


@pytest.mark.parametrize("emitter", ["Emission", "BsdfPrincipled"])
def test_what_a_transparent_share_takes_from_emission_and_not_from_lobes(emitter):
    parts.empty_scene()
    material, tree, output = parts.new_material("Lamp shade")
    mix, clear, glow = nodes_of(tree, "MixShader", "BsdfTransparent", emitter)
    mix.inputs[0].default_value = 0.25
    strength = "Strength" if emitter == "Emission" else "Emission Strength"
    glow.inputs[strength].default_value = 2.0
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(glow.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    look = look_of(material)
    np.testing.assert_allclose(look.emission, 0.5, rtol=1e-6)
    assert look.weight == 1.0


def test_microfiber_sheen_reflects_what_it_does_on_average_and_is_named():
    parts.empty_scene()
    material, node = parts.bsdf_material("ShaderNodeBsdfSheen", "Velvet", Roughness=0.4)
    node.distribution = "MICROFIBER"
    look = look_of(material)
    # Views that are as frequent as uniform light makes them: their cosine is the root of a uniform number.
    cosine = np.sqrt(np.random.default_rng(1).random(100_000))
    wanted = sheen_albedo(cosine, np.full(len(cosine), 0.4))
    assert look.kind == "sheen" and look.weight == 1.0
    assert look.albedo == pytest.approx(wanted.mean(), abs=5.0 * wanted.std() / len(wanted) ** 0.5)
    assert look.notes == ("Velvet: Sheen BSDF is shown as a Diffuse BSDF of its mean albedo",)


def test_mixed_shaders_are_lobes_with_their_shares():
    parts.empty_scene()
    look = look_of(mixed("Mixed", factor=0.7)())
    assert [(lobe.kind, round(lobe.weight, 6)) for lobe in look.lobes] == [("glossy", 0.7), ("diffuse", 0.3)]
    assert look.notes == ()


def test_transparent_parts_leave_their_share_to_the_rest():
    parts.empty_scene()
    material, tree, output = parts.new_material("Veil")
    mix, clear, chalk = nodes_of(tree, "MixShader", "BsdfTransparent", "BsdfDiffuse")
    mix.inputs[0].default_value = 0.2
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(chalk.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    look = look_of(material)
    assert len(look.lobes) == 1 and look.weight == pytest.approx(1.0)
    assert look.notes == ("Veil: transparency is not shown",)


def test_more_lobes_than_are_shown_are_named():
    parts.empty_scene()
    material, tree, output = parts.new_material("Onion")
    last = tree.nodes.new("ShaderNodeBsdfDiffuse")
    for number in range(looks.MOST_LOBES + 1):
        add, gloss = nodes_of(tree, "AddShader", "BsdfAnisotropic")
        gloss.inputs["Roughness"].default_value = 0.1 * (number + 1)
        tree.links.new(last.outputs[0], add.inputs[0])
        tree.links.new(gloss.outputs[0], add.inputs[1])
        last = add
    tree.links.new(last.outputs[0], output.inputs["Surface"])
    look = look_of(material)
    assert len(look.lobes) == looks.MOST_LOBES
    assert look.notes == (f"Onion: of its {looks.MOST_LOBES + 2} lobes only {looks.MOST_LOBES} are shown",)


def test_a_coat_that_is_not_resolved_is_named():
    parts.empty_scene()
    material, node = parts.principled("Lacquer", Coat_Weight=0.5)
    noise = material.node_tree.nodes.new("ShaderNodeTexNoise")
    bump = material.node_tree.nodes.new("ShaderNodeBump")
    material.node_tree.links.new(noise.outputs[0], node.inputs["Coat Roughness"])
    material.node_tree.links.new(bump.outputs[0], node.inputs["Coat Normal"])
    look = look_of(material)
    np.testing.assert_allclose(look.coat.roughness, 0.03, rtol=1e-6)
    assert look.notes == ("Lacquer: Coat Roughness is not resolved", "Lacquer: Coat Normal is not resolved")


def color_image():
    return textured("color image", "Base Color")[0]


def roughness_image():
    return textured("roughness image", "Roughness", is_data=True)[0]


def clipped_and_mapped():
    material, _, texture = textured("mapped", "Base Color", extension="EXTEND", interpolation="Closest")
    tree = material.node_tree
    coordinates, mapping = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
    mapping.inputs["Location"].default_value = (0.2, -0.1, 0.0)
    mapping.inputs["Rotation"].default_value = (0.0, 0.0, 0.5)
    mapping.inputs["Scale"].default_value = (1.7, 0.8, 1.0)
    tree.links.new(coordinates.outputs["UV"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    return material


def one_channel():
    """The green of an image, turned around, times a number, as roughness."""
    material, node, texture = textured("channel", "Base Color", is_data=True)
    tree = material.node_tree
    separate, math = tree.nodes.new("ShaderNodeSeparateColor"), tree.nodes.new("ShaderNodeMath")
    invert = tree.nodes.new("ShaderNodeInvert")
    math.operation, math.inputs[1].default_value = "MULTIPLY", 0.6
    tree.links.new(texture.outputs["Color"], invert.inputs["Color"])
    tree.links.new(invert.outputs["Color"], separate.inputs["Color"])
    tree.links.new(separate.outputs["Green"], math.inputs[0])
    tree.links.new(math.outputs["Value"], node.inputs["Roughness"])
    return material


def mixed_colors():
    material, node, texture = textured("mixed", "Base Color")
    tree = material.node_tree
    mix = tree.nodes.new("ShaderNodeMix")
    mix.data_type, mix.blend_type = "RGBA", "MULTIPLY"
    mix.inputs[0].default_value = 0.7
    mix.inputs[7].default_value = (0.9, 0.5, 0.2, 1.0)
    tree.links.new(texture.outputs["Color"], mix.inputs[6])
    tree.links.new(mix.outputs[2], node.inputs["Base Color"])
    return material


def grouped():
    """A BSDF in a node group, with values from outside."""
    group = bpy.data.node_groups.new("Paint", "ShaderNodeTree")
    group.interface.new_socket("Tint", in_out="INPUT", socket_type="NodeSocketColor")
    group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    start, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    inner = group.nodes.new("ShaderNodeBsdfGlossy")
    inner.distribution, inner.inputs["Roughness"].default_value = "GGX", 0.4
    group.links.new(start.outputs["Tint"], inner.inputs["Color"])
    group.links.new(inner.outputs[0], end.inputs[0])
    material, tree, output = parts.new_material("grouped")
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    node.inputs["Tint"].default_value = (0.8, 0.4, 0.3, 1.0)
    tree.links.new(node.outputs[0], output.inputs["Surface"])
    return material


def with_specular(name, **inputs):
    return lambda: parts.principled(name, **inputs)[0]


MATERIALS = (
    with_specular("plastic", Base_Color=(0.5, 0.2, 0.1, 1.0), Roughness=0.3, IOR=1.7, Specular_IOR_Level=0.3),
    with_specular("metal", Base_Color=(0.9, 0.6, 0.3, 1.0), Metallic=1.0, Specular_Tint=(0.6, 0.9, 1.0, 1.0)),
    with_specular("half metal", Base_Color=(0.3, 0.6, 0.3, 1.0), Metallic=0.4, Roughness=0.6),
    lambda: parts.bsdf_material("ShaderNodeBsdfDiffuse", "chalk", Color=(0.2, 0.5, 0.8, 1.0))[0],
    lambda: parts.bsdf_material("ShaderNodeBsdfGlossy", "mirror", Color=(0.8, 0.7, 0.6, 1.0), Roughness=0.2)[0],
    color_image,
    roughness_image,
    clipped_and_mapped,
    one_channel,
    mixed_colors,
    normal_map,
    grouped,
)


def scattered(node_type, name, fresnel_type=None, **inputs):
    """A material of one BSDF with Multiscatter GGX."""

    def make():
        material, node = parts.bsdf_material(node_type, name)
        node.distribution = "MULTI_GGX"
        if fresnel_type is not None:
            node.fresnel_type = fresnel_type
        for key, value in inputs.items():
            node.inputs[key.replace("_", " ")].default_value = value
        return material

    return make


PAINT = (0.6, 0.25, 0.1, 1.0)
PRINCIPLED, METALLIC = "ShaderNodeBsdfPrincipled", "ShaderNodeBsdfMetallic"
SCATTERED = (
    scattered(PRINCIPLED, "scattered plastic", Base_Color=PAINT, Roughness=0.7, IOR=1.6),
    scattered(PRINCIPLED, "tinted plastic", Base_Color=PAINT, Roughness=0.4, Specular_Tint=(0.3, 0.9, 0.5, 1.0)),
    scattered(PRINCIPLED, "scattered metal", Base_Color=GOLD, Metallic=1.0, Roughness=0.8),
    scattered(PRINCIPLED, "half metal", Base_Color=GOLD, Metallic=0.5, Roughness=0.5, Specular_IOR_Level=0.8),
    scattered(METALLIC, "F82", "F82", Base_Color=GOLD, Edge_Tint=(0.4, 0.7, 0.9, 1.0), Roughness=0.5),
    scattered(METALLIC, "conductor", "PHYSICAL_CONDUCTOR", Roughness=0.6),
    scattered("ShaderNodeBsdfAnisotropic", "scattered gloss", Color=GOLD, Roughness=0.9),
    lambda: parts.bsdf_material("ShaderNodeBsdfTranslucent", "paper", Color=PAINT)[0],
)


@edits_with_graphics
@pytest.mark.parametrize(
    ("materials", "kind", "passes"),
    [(MATERIALS, "PERSP", shading.PASSES), (MATERIALS, "ORTHO", ("specular",)), (SCATTERED, "PERSP", shading.PASSES)],
    ids=["perspective", "parallel", "scattered"],
)
def test_the_viewport_shows_what_cycles_sampled(tmp_path, materials, kind, passes):
    assert not patches_too_far(tmp_path / "patches.blend", materials, kind, passes)


def test_long_lines_of_the_view_are_broken():
    text = "Marble: Base Color is not resolved, because a texture of noise feeds it"
    lines = view.wrapped([(text, "red"), ("short", "blue")], 200.0, lambda part: 6.0 * len(part))
    assert lines[-1] == ("short", "blue") and len(lines) > 2
    assert all(6.0 * len(part) <= 200.0 for part, _ in lines)
    assert " ".join(part.strip() for part, color in lines if color == "red") == text


def test_what_is_not_resolved_has_the_viewport_color_and_is_named():
    parts.empty_scene()
    material, node = parts.principled("Marble", Roughness=0.25)
    noise = material.node_tree.nodes.new("ShaderNodeTexNoise")
    material.node_tree.links.new(noise.outputs["Color"], node.inputs["Base Color"])
    material.diffuse_color = (0.7, 0.1, 0.4, 1.0)
    look = look_of(material)
    np.testing.assert_allclose(look.value("color").offset, (0.7, 0.1, 0.4), rtol=1e-6)
    np.testing.assert_allclose(look.value("roughness").offset, 0.25, rtol=1e-6)
    assert look.notes == ("Marble: Base Color is not resolved",)


def test_an_image_that_is_turned_out_of_its_plane_is_not_resolved():
    parts.empty_scene()
    material = clipped_and_mapped()
    assert look_of(material).notes == ()
    (mapping,) = (node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeMapping")
    mapping.inputs["Rotation"].default_value = (0.5, 0.0, 0.0)
    assert look_of(material).notes == (f"{material.name}: Base Color is not resolved",)


@pytest.mark.parametrize(
    ("node_type", "said"),
    [("ShaderNodeBsdfHair", "Hair"), ("ShaderNodeBsdfRefraction", "Refraction")],
)
def test_materials_of_other_kinds_are_shown_in_their_viewport_color(node_type, said):
    parts.empty_scene()
    material, tree, output = parts.new_material("Odd")
    tree.links.new(tree.nodes.new(node_type).outputs[0], output.inputs["Surface"])
    material.diffuse_color = (0.2, 0.4, 0.6, 1.0)
    look = look_of(material)
    np.testing.assert_allclose(look.value("color").offset, (0.2, 0.4, 0.6), rtol=1e-6)
    assert any(note.startswith("Odd: ") and said in note for note in look.notes)


@edits_with_graphics
def test_missing_images_are_pink_and_named():
    parts.empty_scene(*SIZE)
    material, _, texture = textured("Lost", "Base Color")
    texture.image = bpy.data.images.new("lost.png", 4, 4)
    texture.image.source, texture.image.filepath = "FILE", "/nowhere/lost.png"
    texture.image.reload()
    parts.add_plane(material)
    parts.add_area_light()
    camera = parts.add_camera()
    bpy.context.view_layer.update()
    picture, notes = with_graphics(lambda: viewport_picture(camera, "diffuse", False))
    red, green, blue = picture.reshape(-1, 3).max(axis=0)
    assert red > 0.1 and blue == pytest.approx(red) and green == 0.0
    assert notes == ["Lost: image 'lost.png' is missing, it is pink"]


def test_nothing_of_the_file_is_changed():
    parts.empty_scene()
    materials = [make() for make in MATERIALS]
    before = [[(node.name, [link.to_socket.name for link in material.node_tree.links]) for node in
               material.node_tree.nodes] for material in materials]  # fmt: skip
    images = {made.name: tuple(made.pixels) for made in bpy.data.images}
    for material in materials:
        look_of(material)
    after = [[(node.name, [link.to_socket.name for link in material.node_tree.links]) for node in
              material.node_tree.nodes] for material in materials]  # fmt: skip
    assert after == before and {made.name: tuple(made.pixels) for made in bpy.data.images} == images
