"""Materials in the viewport: every lobe and texture that Cycles samples, and what is not shown is named."""

from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from view_pictures import (
    SIZE,
    OpenView,
    image,
    normal_map,
    patches_too_far,
    sampled_pictures,
    textured,
    times_too_far,
    viewport_picture,
)

from ltsh_addon import shading
from ltsh_addon.blender.engine.overlay import LIGHTS_PANEL, MATERIALS_PANEL, QuietLine, left_out, wrapped
from ltsh_addon.blender.lights.emission import emission_of
from ltsh_addon.blender.lights.world import light_of_world
from ltsh_addon.blender.materials import preview_material
from ltsh_addon.blender.materials.bsdfs import AS_DIFFUSE, SUBSURFACE_ERROR
from ltsh_addon.blender.materials.preview_material import preview_of
from ltsh_addon.blender.ui import panels, preflight
from ltsh_addon.blender.viewport.light_texels import constant_sky
from ltsh_addon.blender.viewport.mirror import SceneMirror, ShownLook
from ltsh_addon.blender.viewport.pictures import ShownPicture
from ltsh_addon.cycles.lobes import read_layer

RED, GOLD, AMBER = (0.6, 0.25, 0.1, 1.0), (0.9, 0.7, 0.3, 1.0), (0.9, 0.6, 0.3, 1.0)
TINT = (0.2, 0.4, 0.6, 1.0)


def fill(node, values):
    """The node with these inputs and, in lower case, properties.

    An input is a number, a socket, or a node (kind, values) to add: its first output or, as "kind.output", another one.
    """
    for key, value in values.items():
        if str(key).islower():
            setattr(node, key, image(value, is_data=True) if key == "image" else value)
        elif isinstance(value, bpy.types.NodeSocket):
            node.id_data.links.new(value, node.inputs[key])
        elif isinstance(value, tuple) and isinstance(value[0], str):
            kind, _, output = value[0].partition(".")
            added = fill(node.id_data.nodes.new(f"ShaderNode{kind}"), value[1])
            node.id_data.links.new(added.outputs[output or 0], node.inputs[key])
        else:
            node.inputs[key].default_value = value
    return node


def made(name, kind, values):
    """A function that makes a material of the node (kind, values)."""

    def make():
        material, _, output = parts.new_material(name)
        fill(output, {"Surface": (kind, values)})
        material.diffuse_color = TINT
        return material

    return make


def bsdf(name, kind="BsdfPrincipled", **values):
    """A function that makes a material of one BSDF; underscores in names of inputs stand for spaces."""
    named = {key if key.islower() else key.replace("_", " "): value for key, value in values.items()}
    return made(name, kind, {"distribution": "GGX", **named})


def coated(name, **inputs):
    return bsdf(name, Base_Color=RED, **{"Roughness": 0.5, "Coat_Weight": 1.0, **inputs})


def bumpy(values):
    """A function that makes the material of a normal map with other inputs; a bumpy coat is as bumpy as its base."""

    def make():
        material = normal_map()
        node = next(node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
        bumps = node.inputs["Normal"].links[0].from_socket
        fill(node, {key: bumps if value == "bumps" else value for key, value in values.items()})
        return material

    return make


def gloss(roughness=0.35, color=GOLD):
    return ("BsdfAnisotropic", {"distribution": "GGX", "Roughness": roughness, "Color": color})


CHALK, CLEAR = ("BsdfDiffuse", {"Color": RED}), ("BsdfTransparent", {})


def mixed(factor):
    return ("MixShader", {0: factor, 1: CHALK, 2: gloss()})


COATED_PLASTIC = ("BsdfPrincipled", {"Coat Weight": 0.7, "Roughness": 0.6})
LAYERED = (
    coated("varnish"),
    coated("thin varnish", Coat_Weight=0.4, Coat_Roughness=0.3, Coat_IOR=1.8),
    coated("tinted varnish", Coat_Tint=AMBER, Coat_Roughness=0.15, Coat_IOR=1.35),
    coated("tint alone", Coat_Tint=AMBER, Coat_IOR=1.0),
    coated("car paint", Metallic=0.7, Coat_Roughness=0.1),
    bumpy({"Coat Weight": 0.8, "Coat Roughness": 0.2}),
    bumpy({"Coat Weight": 0.8, "Coat Roughness": 0.2, "Coat Normal": "bumps"}),
    made("mixed", *mixed(0.3)),
    made("added", "AddShader", {0: CHALK, 1: gloss()}),
    made("mostly gloss", *mixed(0.9)),
    made("four lobes", "MixShader", {0: 0.4, 1: ("MixShader", {0: 0.25, 1: COATED_PLASTIC, 2: CHALK}), 2: gloss(0.25)}),
    made("cloth", "BsdfSheen", {"Roughness": 0.5, "Color": GOLD}),
    coated("velvet", Coat_Weight=0.0, Sheen_Weight=0.8, Sheen_Roughness=0.4, Sheen_Tint=AMBER),
    coated("dust on varnish", Coat_Roughness=0.2, Sheen_Weight=1.0, Sheen_Roughness=0.7),
    # Passes of light do not show what glows.
    made("half glow", "MixShader", {1: CHALK, 2: ("Emission", {"Strength": 1e-6})}),
)
DENSE = mixed(("Fresnel.Factor", {"IOR": 3.5}))
MASKED = (
    made("mask", *mixed(("TexImage", {"image": "mask"}))),
    made("Fresnel", *mixed(("Fresnel.Factor", {"IOR": 1.8}))),
    made("inside", "MixShader", {0: ("TexImage", {"image": "out"}), 1: DENSE, 2: ("BsdfMetallic", {"Roughness": 0.4})}),
    made("layer of Fresnel", *mixed(("LayerWeight.Fresnel", {"Blend": 0.6}))),
    made("facing", *mixed(("LayerWeight.Facing", {"Blend": 0.5}))),
    made("facing less", *mixed(("LayerWeight.Facing", {"Blend": 0.2}))),
    made("facing more", *mixed(("LayerWeight.Facing", {"Blend": 0.9}))),
)


def clipped_and_mapped():
    material, _, texture = textured("mapped", "Base Color", extension="EXTEND", interpolation="Closest")
    placed = {"Location": (0.2, -0.1, 0.0), "Rotation": (0.0, 0.0, 0.5), "Scale": (1.7, 0.8, 1.0)}
    fill(texture, {"Vector": ("Mapping", {"Vector": ("TexCoord.UV", {}), **placed})})
    return material


def one_channel():
    """The green of an image, turned around, times a number, as roughness."""
    material, node, texture = textured("channel", "Base Color", is_data=True)
    green = ("SeparateColor.Green", {"Color": ("Invert", {"Color": texture.outputs["Color"]})})
    fill(node, {"Roughness": ("Math", {"operation": "MULTIPLY", 0: green, 1: 0.6})})
    return material


def mixed_colors():
    material, node, texture = textured("mixed", "Base Color")
    mix = fill(material.node_tree.nodes.new("ShaderNodeMix"), {"data_type": "RGBA", "blend_type": "MULTIPLY"})
    fill(mix, {0: 0.7, 6: texture.outputs["Color"], 7: (0.9, 0.5, 0.2, 1.0)})
    fill(node, {"Base Color": mix.outputs[2]})
    return material


def grouped():
    """A BSDF in a node group, with values from outside."""
    group, start, end = parts.new_group({"Tint": "Color"}, {"Shader": "Shader"})
    fill(end, {0: gloss(0.4, start.outputs["Tint"])})
    return made("grouped", "Group", {"node_tree": group, "Tint": (0.8, 0.4, 0.3, 1.0)})()


MATERIALS = (
    bsdf("plastic", Base_Color=(0.5, 0.2, 0.1, 1.0), Roughness=0.3, IOR=1.7, Specular_IOR_Level=0.3),
    bsdf("metal", Base_Color=(0.9, 0.6, 0.3, 1.0), Metallic=1.0, Specular_Tint=(0.6, 0.9, 1.0, 1.0)),
    bsdf("half metal", Base_Color=(0.3, 0.6, 0.3, 1.0), Metallic=0.4, Roughness=0.6),
    made("chalk", "BsdfDiffuse", {"Color": (0.2, 0.5, 0.8, 1.0)}),
    bsdf("mirror", "BsdfGlossy", Roughness=0.2, Color=(0.8, 0.7, 0.6, 1.0)),
    lambda: textured("color image", "Base Color")[0],
    lambda: textured("roughness image", "Roughness", is_data=True)[0],
    clipped_and_mapped,
    one_channel,
    mixed_colors,
    normal_map,
    grouped,
)


def scattered(name, kind="BsdfPrincipled", **values):
    return bsdf(name, kind, distribution="MULTI_GGX", **values)


SCATTERED = (
    scattered("scattered plastic", Base_Color=RED, Roughness=0.7, IOR=1.6),
    scattered("tinted plastic", Base_Color=RED, Roughness=0.4, Specular_Tint=(0.3, 0.9, 0.5, 1.0)),
    scattered("scattered metal", Base_Color=GOLD, Metallic=1.0, Roughness=0.8),
    scattered("half metal", Base_Color=GOLD, Metallic=0.5, Roughness=0.5, Specular_IOR_Level=0.8),
    scattered("F82", "BsdfMetallic", fresnel_type="F82", Base_Color=GOLD, Edge_Tint=(0.4, 0.7, 0.9, 1.0)),
    scattered("conductor", "BsdfMetallic", fresnel_type="PHYSICAL_CONDUCTOR", Roughness=0.6),
    scattered("scattered gloss", "BsdfAnisotropic", Color=GOLD, Roughness=0.9),
    made("paper", "BsdfTranslucent", {"Color": RED}),
)


BRUSHED = (
    bsdf("brushed", Base_Color=GOLD, Metallic=1.0, Anisotropic=0.7),
    bsdf("brushed plastic", Base_Color=RED, Roughness=0.4, Anisotropic=1.0, Anisotropic_Rotation=0.15),
    bsdf(
        "along u", "BsdfAnisotropic", Anisotropy=0.6, Roughness=0.5, Tangent=("Tangent", {"direction_type": "UV_MAP"})
    ),
    bsdf("across", "BsdfAnisotropic", Anisotropy=-0.5, Roughness=0.9, Rotation=0.3),
    bsdf("brushed node", "BsdfMetallic", Anisotropy=0.5, Tangent=("NewGeometry.Tangent", {})),
    coated("brushed and coated", Anisotropic=0.9, Metallic=1.0, Coat_Roughness=0.2),
    bumpy({"Anisotropic": 0.8, "Metallic": 1.0, "Tangent": ("Tangent", {"direction_type": "UV_MAP"})}),
    made(
        "some brushed", "MixShader", {0: 0.4, 1: CHALK, 2: ("BsdfAnisotropic", {"Anisotropy": 0.6, "Roughness": 0.5})}
    ),
)


def rough(roughness, color=RED):
    return ("BsdfDiffuse", {"Color": color, "Roughness": roughness})


MASK = ("TexImage", {"image": "mask"})
ROUGH = (
    made("rough chalk", *rough(1.0)),
    made("smooth chalk", *rough(0.0)),
    bsdf("rough plastic", Base_Color=AMBER, Roughness=0.3, Diffuse_Roughness=0.5),
    coated("rough under a coat", Diffuse_Roughness=0.8, Coat_Roughness=0.2, Sheen_Weight=0.5),
    bumpy({"Diffuse Roughness": 0.7}),
    made("two roughs", "MixShader", {0: 0.4, 1: rough(0.3), 2: rough(0.9, GOLD)}),
    made("rough and brushed", "MixShader", {0: 0.4, 1: rough(0.6), 2: ("BsdfAnisotropic", {"Anisotropy": 0.6})}),
    bsdf("rough image", Diffuse_Roughness=0.6, Base_Color=("TexImage", {"image": "colors"})),
    made("velvet", "BsdfSheen", {"distribution": "ASHIKHMIN", "Roughness": 0.5, "Color": RED}),
    made("stiff velvet", "BsdfSheen", {"distribution": "ASHIKHMIN", "Roughness": 0.15, "Color": RED}),
    made("velvet image", "BsdfSheen", {"distribution": "ASHIKHMIN", "Roughness": MASK, "Color": GOLD}),
    made("both sheens", "MixShader", {1: ("BsdfSheen", {}), 2: ("BsdfSheen", {"distribution": "ASHIKHMIN"})}),
    made("over dust", "AddShader", {0: rough(0.8), 1: ("BsdfSheen", {"distribution": "ASHIKHMIN"})}),
)

BENT = (
    bsdf("air in water", Base_Color=RED, IOR=0.75, Roughness=0.3),
    bsdf("level", Base_Color=RED, IOR=0.8, Roughness=0.5, Specular_IOR_Level=0.8),
    scattered("scattered", Base_Color=RED, IOR=0.6, Roughness=0.7, Specular_Tint=GOLD),
    bsdf("half metal", Base_Color=GOLD, IOR=0.7, Roughness=0.4, Metallic=0.5),
    bsdf("brushed", Base_Color=RED, IOR=0.8, Roughness=0.4, Anisotropic=0.6),
    bsdf("IOR image", Base_Color=RED, Roughness=0.4, IOR=("Math", {"operation": "MULTIPLY", 0: MASK, 1: 1.8})),
    bsdf("glass", "BsdfGlass", IOR=0.8, Roughness=0.3),
)


@edits_with_graphics
@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize(
    "materials",
    [MATERIALS, SCATTERED, LAYERED, MASKED, BRUSHED, ROUGH, BENT],
    ids=["plain", "scattered", "layered", "masked", "brushed", "rough", "bent"],
)
def test_the_viewport_shows_what_cycles_sampled(tmp_path, materials, kind):
    passes = shading.PASSES if kind == "PERSP" else ("specular",)
    assert not patches_too_far(tmp_path / "patches.blend", materials, kind, passes)


@edits_with_graphics
@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_tangents_run_around_the_axes_of_turned_and_stretched_objects(tmp_path, axis):
    parts.empty_scene(*SIZE)
    material = bsdf("brushed", Metallic=1.0, Anisotropic=0.9, Roughness=0.4, Tangent=("Tangent", {"axis": axis}))()
    for number in range(2):
        ball = parts.add_sphere(material, smooth=False, segments=8, location=(1.4 * number - 0.7, 0.0, 0.0))
        ball.rotation_euler, ball.scale = (0.4, 0.5 * number, 0.7), (0.7, 1.1, 0.8)
    parts.add_area_light(location=(0.5, -1.0, 2.0), size=2.0, size_y=1.0)
    camera = parts.add_camera((0.0, -2.6, 3.4), (0.6, 0.0, 0.0))
    bpy.context.view_layer.update()
    seen, notes = with_graphics(lambda: viewport_picture(camera, "specular"))
    expected, square = sampled_pictures(tmp_path / "balls.blend", ("specular",), 1)
    usable = (expected["specular"] > 0.0).all(axis=-1) & (seen > 0.0).all(axis=-1)
    assert notes == [] and usable.sum() > 500
    # Pixels at the edges of faces see another face in one of both.
    assert (times_too_far(seen, expected["specular"])[usable].max(axis=-1) > 1.0).mean() < 0.08


ONION = ("BsdfDiffuse", {})
for number in range(preview_material.MOST_LOBES + 1):
    ONION = ("AddShader", {0: ONION, 1: gloss(0.1 * (number + 1))})
HALF = "factor of 'Mix Shader' is not resolved, half of each side is shown"
NOT_BRUSHED = "its anisotropy is not resolved, it is shown without"
SUBSURFACE = f"node 'Subsurface Scattering' {AS_DIFFUSE}, {SUBSURFACE_ERROR}"
TOO_MANY = f"of its {preview_material.MOST_LOBES + 2} lobes only {preview_material.MOST_LOBES} are shown"


@pytest.mark.parametrize(
    ("shader", "lobes", "notes"),
    [
        (mixed(0.7), {"glossy": 0.7, "diffuse": 0.3}, []),
        (mixed(("TexNoise.Color", {})), {"glossy": 0.5, "diffuse": 0.5}, [HALF]),
        (("MixShader", {0: 0.2, 1: CLEAR, 2: CHALK}), {"diffuse": 1.0}, ["transparency of about 80 % is not shown"]),
        (ONION, {"glossy": preview_material.MOST_LOBES - 1, "diffuse": 1}, [TOO_MANY]),
        (("BsdfAnisotropic", {"Anisotropy": ("TexNoise", {})}), {"glossy": 1.0}, [NOT_BRUSHED]),
        (("BsdfAnisotropic", {"Anisotropy": 0.5, "Tangent": ("TexNoise", {})}), {"glossy": 1.0}, [NOT_BRUSHED]),
        (("BsdfTransparent", {"Color": GOLD}), {"filter": 1.0}, []),
        (("BsdfToon", {}), {"diffuse": 1.0}, [f"node 'Toon BSDF' {AS_DIFFUSE} of the same albedo, 27 to 72 % off"]),
        (("SubsurfaceScattering", {}), {"diffuse": 1.0}, [SUBSURFACE]),
        (
            ("BsdfPrincipled", {"Subsurface Weight": 0.1, "Thin Film Thickness": 400.0}),
            {"principled": 1.0},
            [
                f"Subsurface Weight of 'Principled BSDF' is shaded as diffuse reflection: {SUBSURFACE_ERROR}",
                "Thin Film Thickness of 'Principled BSDF' is shaded as 0, 2 to 27 % off",
            ],
        ),
        (("BsdfSheen", {"distribution": "ASHIKHMIN"}), {"velvet": 1.0}, []),
    ],
    ids=[
        *("mixed", "factor that depends on more", "transparent part", "too many", "varying anisotropy", "any tangent"),
        *("colored filter", "toon", "subsurface node", "layers", "velvet"),
    ],
)
def test_lobes_have_their_shares_and_what_is_not_shown_is_named(shader, lobes, notes):
    parts.empty_scene()
    look = preview_of(made("Material", *shader)())
    found = dict.fromkeys(lobes, 0.0)
    for lobe in look.lobes:
        found[lobe.kind] += lobe.weight
    assert found == pytest.approx(lobes) and list(look.notes) == [f"Material: {note}" for note in notes]


@pytest.mark.parametrize(
    ("kind", "values", "size"),
    [
        ("Displacement", {"Scale": 0.3, "Midlevel": 0.5}, ", by up to 0.15 m,"),
        ("Displacement", {"Scale": -2.0, "Midlevel": 0.0}, ", by up to 2 m,"),
        ("VectorDisplacement", {"Scale": 0.1, "Midlevel": 0.0}, ", by up to 0.1 m,"),
        ("Displacement", {"Scale": ("TexNoise", {})}, ""),
        ("TexNoise", {}, ""),
    ],
    ids=["about the middle", "inward", "vectors", "varying scale", "no node of displacement"],
)
def test_displacement_that_is_not_shown_is_named_with_its_height_and_error(kind, values, size):
    parts.empty_scene()
    material = made("Hill", "BsdfDiffuse", {})()
    nodes, links = material.node_tree.nodes, material.node_tree.links
    node = nodes.new(f"ShaderNode{kind}")
    for name, value in values.items():
        if isinstance(value, tuple):
            links.new(nodes.new(f"ShaderNode{value[0]}").outputs[0], node.inputs[name])
        else:
            node.inputs[name].default_value = value
    links.new(node.outputs[0], nodes["Material Output"].inputs["Displacement"])
    assert preview_of(material).notes == (f"Hill: its displacement{size} is not shown: its light is 10 to 50 % off",)


@pytest.mark.parametrize(("emitter", "strength"), [("Emission", "Strength"), ("BsdfPrincipled", "Emission Strength")])
def test_what_a_transparent_share_takes_from_emission_and_not_from_lobes(emitter, strength):
    parts.empty_scene()
    look = preview_of(made("Lamp shade", "MixShader", {0: 0.25, 1: CLEAR, 2: (emitter, {strength: 2.0})})())
    np.testing.assert_allclose(look.emission, 0.5, rtol=1e-6)
    assert look.weight == 1.0


def test_what_is_not_resolved_has_the_viewport_color_or_its_default_and_is_named():
    parts.empty_scene()
    unresolved = {"Base Color": ("TexNoise.Color", {}), "Coat Roughness": ("TexNoise", {}), "Coat Normal": ("Bump", {})}
    shown = [f"{' '.join(f'{one:.2g}' for one in TINT[:3])} is shown", "0.03 is shown", "the coat is smooth"]
    look = preview_of(made("Marble", "BsdfPrincipled", {"Roughness": 0.25, "Coat Weight": 0.5, **unresolved})())
    np.testing.assert_allclose(look.value("color").offset, TINT[:3], rtol=1e-6)
    np.testing.assert_allclose(look.value("roughness").offset, 0.25, rtol=1e-6)
    np.testing.assert_allclose(look.coat.roughness, 0.03, rtol=1e-6)
    pairs = zip(unresolved, shown, strict=True)
    assert sorted(look.notes) == sorted(f"Marble: {name} is not resolved, {instead}" for name, instead in pairs)


def test_materials_of_other_kinds_are_shown_in_their_viewport_color():
    parts.empty_scene()
    look = preview_of(made("Odd", "BsdfHair", {})())
    np.testing.assert_allclose(look.value("color").offset, TINT[:3], rtol=1e-6)
    assert any(note.startswith("Odd: ") and "Hair" in note for note in look.notes)


def test_an_image_that_is_turned_out_of_its_plane_is_not_resolved():
    parts.empty_scene()
    material = clipped_and_mapped()
    assert preview_of(material).notes == ()
    material.node_tree.nodes["Mapping"].inputs["Rotation"].default_value = (0.5, 0.0, 0.0)
    (note,) = preview_of(material).notes
    assert note.startswith(f"{material.name}: Base Color is not resolved, ")


@pytest.mark.parametrize(
    ("glass", "shadows", "world", "text"),
    [
        (False, True, True, "No bounces"),
        (True, True, True, "No bounces; glass without refraction"),
        (False, False, False, "No bounces; no shadows; no light of the world"),
    ],
)
def test_one_line_says_what_a_view_leaves_out(glass, shadows, world, text):
    mirror = SceneMirror()
    mirror.take_sky(constant_sky(light_of_world(parts.add_world()[0]), np.ones(3), np.ones(3)))
    shown = preview_of(made("Pane", "BsdfGlass" if glass else "BsdfDiffuse", {})())
    mirror._looks = {"Pane": ShownLook(shown, None)}
    scene = SimpleNamespace(ltsh=SimpleNamespace(shadows=shadows), ltsh_view=SimpleNamespace(world=world))
    assert left_out(mirror, scene) == QuietLine(text, MATERIALS_PANEL)
    # Where nothing but lights is approximated, a click shows the lights.
    mirror._light_notes = ("Lamp: its nodes are not resolved",)
    assert left_out(mirror, scene).panel == LIGHTS_PANEL
    mirror._looks["Pane"] = ShownLook(replace(shown, notes=("Pane: odd",)), None)
    assert left_out(mirror, scene).panel == MATERIALS_PANEL
    assert {LIGHTS_PANEL, MATERIALS_PANEL} <= {
        panel.bl_idname for panel in panels.CLASSES if hasattr(panel, "bl_idname")
    }


def test_long_lines_of_the_view_are_broken():
    text = "Marble: Base Color is not resolved, because a texture of noise feeds it"
    lines = wrapped([(text, "red"), ("short", "blue")], 200.0, lambda part: 6.0 * len(part))
    assert lines[-1] == ("short", "blue") and len(lines) > 2
    assert all(6.0 * len(part) <= 200.0 for part, _ in lines)
    assert " ".join(part.strip() for part, color in lines if color == "red") == text
    # Between a toolbar and a sidebar of twice the scale there may be room for a word alone, or not even for that.
    narrow = [("No bounces", "red")]
    assert wrapped(narrow, 110.0, lambda part: 15.0 * len(part)) == [("No", "red"), ("bounces", "red")]
    assert [part for part, _ in wrapped(narrow, 50.0, lambda part: 15.0 * len(part))] == ["No", "bou", "nce", "s"]
    # What counts is how wide the letters are.
    wide = wrapped([("ill ill ill WWW WWW WWW", "red")], 60.0, lambda part: sum(3 + 9 * (c == "W") for c in part))
    assert [part for part, _ in wide] == ["ill ill ill", "WWW", "WWW", "WWW"]


def seen_plane(material):
    """What a view shows of the diffuse light of a plane in an empty scene, and the notes."""
    parts.add_plane(material)
    parts.add_area_light()
    camera = parts.add_camera()
    bpy.context.view_layer.update()
    return with_graphics(lambda: viewport_picture(camera, "diffuse"))


@edits_with_graphics
def test_missing_images_are_pink_and_named():
    parts.empty_scene(*SIZE)
    material, _, texture = textured("Lost", "Base Color")
    texture.image = bpy.data.images.new("lost.png", 4, 4)
    texture.image.source, texture.image.filepath = "FILE", "/nowhere/lost.png"
    texture.image.reload()
    picture, notes = seen_plane(material)
    red, green, blue = picture.reshape(-1, 3).max(axis=0)
    assert red > 0.1 and blue == pytest.approx(red) and green == 0.0
    assert notes == ["Lost: image 'lost.png' is missing, it is pink"]


@edits_with_graphics
@pytest.mark.parametrize("interpolation", ["Linear", "Closest"])
@pytest.mark.parametrize("is_used", [False, True])
def test_colors_under_alpha_are_those_of_cycles(is_used, interpolation):
    """Cycles multiplies the sRGB values of an image by its alpha where that feeds nothing."""
    parts.empty_scene(*SIZE)
    material, node, texture = textured("Decal", "Base Color")
    texture.image, texture.interpolation = bpy.data.images.new("Decal", 2, 2, alpha=True), interpolation
    texture.image.pixels.foreach_set(np.tile(np.float32([0.8, 0.6, 0.4, 0.5]), 4))
    node.inputs["Specular IOR Level"].default_value = 0.0
    if is_used:
        material.node_tree.links.new(texture.outputs["Alpha"], node.inputs["Coat Roughness"])
    picture, _ = seen_plane(material)
    color = picture.reshape(-1, 3)[picture.sum(axis=-1).argmax()]
    values = np.array([0.8, 0.6, 0.4]) * (1.0 if is_used else 0.5)
    expected = np.where(values > 0.04045, ((values + 0.055) / 1.055) ** 2.4, values / 12.92)
    # Half floats, and images of 8 bits: half a step of 255 is 0.25 to 0.5 % of these values before they are decoded.
    np.testing.assert_allclose(color / color[0], expected / expected[0], rtol=0.02)


@edits_with_graphics
def test_an_image_that_shines_is_seen_and_lights_as_its_colors():
    """As a baked texture does; seen from above, by an orthographic camera."""
    parts.empty_scene(*SIZE)
    colors = np.array([[[0.2, 0.4, 0.6, 1.0], [0.8, 0.1, 0.0, 1.0]], [[0.0, 0.5, 0.1, 1.0], [0.3, 0.3, 0.9, 1.0]]])
    texture = bpy.data.images.new("baked", 2, 2, float_buffer=True, is_data=True)
    texture.pixels.foreach_set(colors.astype(np.float32).ravel())
    material = made("Baked", "Emission", {"Color": ("TexImage", {"interpolation": "Closest"}), "Strength": 2.0})()
    (found,) = [one for one in material.node_tree.nodes if one.bl_idname == "ShaderNodeTexImage"]
    found.image = texture
    parts.add_plane(material, size=2.0)
    camera = parts.add_top_camera(4.0)
    bpy.context.view_layer.update()

    def draw():
        with OpenView(camera) as opened:
            _, picture = (opened.draw(ShownPicture("ltsh4", "combined"), np.zeros((2, 2))) for _ in range(2))
            return picture[..., :3], opened.mirror.lights, opened.mirror.notes

    picture, lights, notes = with_graphics(draw)
    for row, column in np.ndindex(2, 2):
        seen = at(picture, column - 0.5, row - 0.5)
        # Pictures of views are half floats.
        np.testing.assert_allclose(seen, 2.0 * colors[row, column, :3], rtol=2.0**-11, atol=1e-6)
    # It lights on both sides, each quarter of the plane with its color.
    power = np.zeros((2, 2, 2, 3))
    for light in lights:
        column, row, _ = (light.center > 0.0).astype(int)
        np.testing.assert_allclose(light.radiance, 2.0 * colors[row, column, :3], rtol=1e-5)
        power[int(light.direction[2] > 0.0), row, column] += np.linalg.norm(light.area_vector) * light.radiance
    np.testing.assert_allclose(power, 2.0 * np.tile(colors[..., :3], (2, 1, 1, 1)), rtol=1e-5)
    assert not notes


def test_what_reads_a_material_changes_nothing_of_the_file():
    parts.empty_scene()
    materials = [make() for make in MATERIALS]

    def content():
        trees = [*(material.node_tree for material in materials), *bpy.data.node_groups]
        nodes = [(node.name, len(node.inputs), len(node.outputs)) for tree in trees for node in tree.nodes]
        links = [link.to_socket.path_from_id() for tree in trees for link in tree.links]
        return len(trees), nodes, links, {made.name: tuple(made.pixels) for made in bpy.data.images}

    before = content()
    for material in materials:
        preview_of(material)
        preflight._material(material, in_view=False, with_bounces=False)
        emission_of(material)
    assert content() == before


def at(picture, x, y):
    """The pixel of a place in meters, of the picture of a camera above that is 4 m wide."""
    height, width = picture.shape[:2]
    return picture[int((0.5 + y / (4.0 * height / width)) * height), int((0.5 + x / 4.0) * width)]


def glass_wall(kind):
    """A glowing wall, a pane of a BSDF before its right half, and a stick before both; the camera."""
    parts.empty_scene(*SIZE)
    parts.add_world(Color=(0.3, 0.2, 0.1, 1.0))
    black = {"Base Color": (0.0, 0.0, 0.0, 1.0), "Specular IOR Level": 0.0}
    glow = {"Emission Color": (0.2, 0.4, 0.8, 1.0), "Emission Strength": 1.0}
    parts.add_plane(parts.principled("glowing", **black, **glow)[0], size=2.0, location=(0.0, 0.0, -1.0))
    bending = {} if kind == "Transparent" else {"Roughness": 0.2, "IOR": 1.5}
    glass = parts.bsdf_material(f"ShaderNodeBsdf{kind}", "glass", Color=(0.9, 0.5, 0.7, 1.0), **bending)[0]
    parts.add_plane(glass, size=4.0, location=(2.0, 0.0, 0.0))
    parts.add_plane(parts.principled("stick", **black, **glow)[0], size=0.4, location=(1.0, 0.0, 0.5))
    camera = parts.add_top_camera(4.0)
    bpy.context.view_layer.update()
    return camera


@edits_with_graphics
@pytest.mark.parametrize("kind", ["Glass", "Refraction", "Transparent"])
def test_glass_shows_what_is_behind_tinted_and_the_reflection_before_it(kind):
    """Seen from above, of an orthographic camera: what crosses both sides of a pane is (1 - F)^2 color^2, and F is 0 of
    what only lets light through. A transparent pane has one side."""
    camera = glass_wall(kind)

    def draw():
        with OpenView(camera) as opened:
            shown = [ShownPicture("ltsh4", name) for name in ("combined", "specular", "transmitted")]
            return [[opened.draw(one, np.zeros((2, 2))) for _ in range(2)][1][..., :3] for one in shown]

    combined, specular, transmitted = with_graphics(draw)
    world, glow = np.array([0.3, 0.2, 0.1]), np.array([0.2, 0.4, 0.8])
    fresnel = 0.04 if kind == "Glass" else 0.0
    through = (1.0 - fresnel) ** 2 * np.array([0.9, 0.5, 0.7]) ** (1 if kind == "Transparent" else 2)
    # What is reflected of an even world is about F of it.
    reflected = at(specular, 0.5, 0.3)
    np.testing.assert_allclose(reflected, fresnel * np.array([0.9, 0.5, 0.7]) * world, rtol=0.05)
    places = ((-0.5, 0.3, glow, False), (-1.5, 0.3, world, False), (0.5, 0.3, glow, True), (1.5, 0.3, world, True))
    for x, y, behind, is_glass in places:
        expected = through * behind + reflected if is_glass else behind
        np.testing.assert_allclose(at(combined, x, y), expected, rtol=5e-3, err_msg=f"{x}, {y}")
        np.testing.assert_allclose(at(transmitted, x, y), is_glass * through * behind, rtol=5e-3, err_msg=f"{x}, {y}")
    # The stick is before the glass.
    np.testing.assert_allclose(at(combined, 1.0, 0.0), glow, rtol=5e-3)


# What varies over the UV square of a plane, by the kind of its nodes.
TILES = {"Color1": (0.1, 0.4, 1.0, 1.0), "Color2": (1.0, 0.1, 0.3, 1.0), "Scale": 8.0}
SHINING = {
    "checker": {"Emission Color": ("TexChecker", TILES)},
    "ramp": {"Emission Color": ("ValToRGB", {"Fac": ("TexGradient", {})})},
    "mix": {"Emission Color": ("MixRGB", {0: ("TexGradient", {}), 1: RED, 2: TINT})},
    "strength": {"Emission Color": AMBER, "Emission Strength": ("TexChecker", TILES)},
    "image": {"Emission Color": ("TexImage", {})},
}


@edits_with_graphics
@pytest.mark.parametrize("kind", SHINING)
def test_what_shines_by_a_pattern_lights_as_its_mean_and_is_named_with_bounces_too(tmp_path, kind):
    """An image as its colors. The oracle is Cycles' picture of the surface, which reflects nothing, from above."""
    parts.empty_scene(256, 256)
    black = {"Base Color": (0.0, 0.0, 0.0, 1.0), "Specular IOR Level": 0.0, "Emission Strength": 2.0}
    material = made("Wall", "BsdfPrincipled", {**black, **SHINING[kind]})()
    for node in material.node_tree.nodes:
        if node.bl_idname == "ShaderNodeValToRGB":
            for element, color in zip(node.color_ramp.elements, ((0.9, 0.1, 0, 1), (0.1, 0.2, 0.6, 1)), strict=True):
                element.color = color
        if node.bl_idname == "ShaderNodeTexImage":
            node.image = bpy.data.images.new("screen", 2, 2, float_buffer=True, is_data=True)
            colors = np.linspace(0.1, 1.0, 16).reshape(4, 4)
            node.image.pixels.foreach_set(np.c_[colors[:, :3], np.ones(4)].astype(np.float32).ravel())
        if node.bl_idname.startswith("ShaderNodeTex") and kind != "image":
            place = material.node_tree.nodes.new("ShaderNodeTexCoord")
            material.node_tree.links.new(place.outputs["UV"], node.inputs["Vector"])
    parts.add_plane(material, size=2.0)
    parts.add_top_camera(2.0)
    bpy.context.view_layer.update()

    def read():
        mirror = SceneMirror()
        mirror.sync(bpy.context.evaluated_depsgraph_get())
        return mirror.lights, mirror.notes_with_rest(is_everything=False)

    lights, notes = with_graphics(read)
    picture = read_layer(parts.cycles_channels(tmp_path, 4), "Combined", "RGB")
    mean = picture.mean(axis=(0, 1))
    off = 100.0 * np.abs(picture - mean).sum(axis=-1).mean() / mean.sum()
    if kind == "image":
        power = sum(np.linalg.norm(light.area_vector) * light.radiance for light in lights)
        np.testing.assert_allclose(power / 8.0, mean, rtol=0.01)
        for light in lights:
            size = np.abs(light.half_u) + np.abs(light.half_v)
            bounds = np.rint(128.0 + 128.0 * np.stack([light.center - size, light.center + size])).astype(int)
            (left, right), (low, high) = bounds.T[:2]
            within = picture[256 - high : 256 - low, left:right]
            np.testing.assert_allclose(light.radiance, within.mean(axis=(0, 1)), rtol=0.02)
        return
    assert lights
    for light in lights:
        np.testing.assert_allclose(light.radiance, mean, rtol=0.03)
    (note,) = notes
    assert note.startswith("Wall: it")
    told = float(note.partition(" %")[0].split()[-1])
    assert told == pytest.approx(off, abs=4.0)


def test_emission_whose_strength_is_an_image_lights_nothing_and_is_named():
    parts.empty_scene()
    material = made("Wall", "BsdfPrincipled", {"Emission Color": AMBER, "Emission Strength": ("TexImage", {})})()
    (node,) = [one for one in material.node_tree.nodes if one.bl_idname == "ShaderNodeTexImage"]
    node.image = bpy.data.images.new("mask", 2, 2, float_buffer=True, is_data=True)
    look = preview_of(material)
    assert not look.emission.any() and look.emission_image is None
    (note,) = look.notes_in_view(with_bounces=True)
    assert note == "Wall: the strength of its emission varies: it is not shown and lights nothing"
