"""Lights of the viewport: every light of a scene is drawn as the numpy side has it, or named."""

import time
from dataclasses import replace

import bpy
import mathutils
import numpy as np
import pytest
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from lit_plane import add_image, add_lamp_plane, along_x, light_tree
from surface_scenes import single_sample
from view_pictures import SIZE, viewport_picture

from ltsh_addon import shading
from ltsh_addon.blender.evaluated import is_surface
from ltsh_addon.blender.lights.emission import nodes_as_text
from ltsh_addon.blender.lights.meshes import MOST_SHOWN, StandInLight, fewer_lights
from ltsh_addon.blender.lights.textures import ShownTextures
from ltsh_addon.blender.materials.graph import ensure_nodes, fill_with_bsdf
from ltsh_addon.blender.materials.preview_material import preview_of
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.blender.viewport import mirror
from ltsh_addon.blender.viewport.light_texels import ShownSky
from ltsh_addon.blender.viewport.live_cycles import LiveNodeLights
from ltsh_addon.blender.viewport.mirror import MOST_LIGHTS, NOT_YET, no_patterns, strongest, view_lights


def seen(patterns=no_patterns):
    """The lights, and all notes as one text."""
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    lights, notes = view_lights(graph, lambda instance: True, ShownTextures(), patterns)
    return lights, "\n".join(notes)


def test_lights_are_those_that_shading_takes():
    parts.empty_scene()
    for kind in ("POINT", "SPOT", "SUN"):
        parts.link(parts.new_light(kind, kind), (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    for shape in ("SQUARE", "RECTANGLE", "DISK", "ELLIPSE"):
        parts.add_area_light(shape, shape=shape, spread=1.2 if shape == "ELLIPSE" else np.pi)
    parts.add_camera()
    lights, notes = seen()
    _, _, inventory, _ = parts.prepare()
    expected = {light.name: light for light in inventory.lights}
    kinds = {"SQUARE", "RECTANGLE", "DISK", "ELLIPSE", "POINT", "SPOT", "SUN"}
    assert {light.name for light in lights} == set(expected) == kinds
    assert not notes
    for light in lights:
        assert (light.cone is None) == (light.name != "SPOT") and light.is_distant == (light.name == "SUN")
        for field in ("shape", "spread", "group", "receivers"):
            assert getattr(light, field) == getattr(expected[light.name], field), (light.name, field)
        for field in ("center", "half_u", "half_v", "direction", "radiance"):
            theirs = getattr(expected[light.name], field)
            np.testing.assert_allclose(getattr(light, field), theirs, rtol=1e-6, atol=1e-9)


def test_what_is_shown_otherwise_or_not_at_all_is_named():
    parts.empty_scene()
    parts.link(parts.new_light("Torn", "SPOT"), scale=(1.0, 0.0, 1.0))
    parts.add_area_light("Dark", energy=-5.0)
    parent = parts.link(bpy.data.objects.new("Parent", None), scale=(1.0, 3.0, 1.0))
    sheared = parts.add_area_light("Sheared", rotation=(0.3, 0.2, 0.7))
    sheared.parent = parent
    lights, notes = seen()
    assert {light.name for light in lights} == {"Dark", "Sheared"}
    assert "Torn: its scale is zero" in notes
    assert "'Dark': negative power" in notes and "'Sheared': its transform is sheared" in notes


@pytest.mark.parametrize("output", ["Linear", "Constant", "Quadratic"])
def test_a_falloff_is_that_of_the_render(output):
    parts.empty_scene()
    tree, emission = light_tree(parts.add_area_light("Fading"))
    node = tree.nodes.new("ShaderNodeLightFalloff")
    node.inputs["Strength"].default_value, node.inputs["Smooth"].default_value = 0.5, 0.25
    tree.links.new(node.outputs[output], emission.inputs["Strength"])
    parts.add_camera()
    ((light,), notes), (expected,) = seen(), parts.prepare()[2].lights
    assert not notes and (light.falloff, light.smooth) == (expected.falloff, 0.25)
    np.testing.assert_allclose(light.radiance, expected.radiance, rtol=1e-5)


def picture_light(pixels, **settings):
    """An area light with an image of float `pixels` (H, W, 3)."""
    light = parts.add_area_light("Picture", **settings)
    tree, emission = light_tree(light)
    tree.links.new(add_image(tree, pixels).outputs["Color"], emission.inputs["Color"])
    return light


def random_picture(height, width):
    return np.random.default_rng(3).random((height, width, 3)) ** 3


@pytest.mark.parametrize("shape", ["RECTANGLE", "ELLIPSE"])
def test_an_image_on_a_light_becomes_patches_of_its_power(shape):
    parts.empty_scene()
    light = picture_light(random_picture(4, 8), shape=shape, scale=(-1.0, 1.0, 1.0))
    parts.add_camera()
    lights, notes = seen()
    (textured,) = parts.prepare()[2].lights
    expected = textured.leaves

    def power(many):
        return sum(np.linalg.norm(one.area_vector) * one.radiance for one in many)

    def moment(many):
        return sum(np.linalg.norm(one.area_vector) * one.radiance.sum() * one.center for one in many)

    assert len(lights) > 16 and (not notes or "patches" in notes)
    np.testing.assert_allclose(power(lights), power(expected), rtol=2e-2)
    # The picture lies on the light as in Cycles, not mirrored.
    away = moment(expected) - power(expected).sum() * np.array(light.location)
    np.testing.assert_allclose(moment(lights), moment(expected), atol=0.05 * np.abs(away).max())


def test_a_fine_texture_is_shown_as_few_patches_and_named():
    parts.empty_scene()
    picture_light(np.random.default_rng(8).random((256, 256, 3)))
    lights, notes = seen()
    assert len(lights) == 64 and "Picture" in notes and "64 patches" in notes


def test_of_too_many_lights_the_strongest_are_shown():
    parts.empty_scene()
    for number in range(6):
        parts.add_area_light(f"Light {number}", energy=10.0 + (number * 5) % 7)
    lights = seen()[0]
    notes = []
    kept = strongest(lights, notes, most=4)
    power = sorted((light.radiance.sum() for light in lights), reverse=True)
    assert sorted((light.radiance.sum() for light in kept), reverse=True) == power[:4]
    assert [light.name for light in kept] == [light.name for light in lights if light in kept]
    assert "Of 6 lights" in notes[0] and f"{100.0 * sum(power[4:]) / sum(power):.1f} %" in notes[0]
    assert strongest(lights, [], most=6) is lights


def add_bulb(name, kind, make):
    """A light with the strength that `make` gives of its tree; object and tree."""
    light = parts.new_light(name, kind, energy=50.0, shadow_soft_size=0.1)
    parts.link(light, (0.5, -0.3, 2.0), (0.3, 0.2, 0.1))
    tree, emission = light_tree(light)
    tree.links.new(make(tree), emission.inputs["Strength"])
    return light, tree


def stripes(tree):
    """1 + 0.9 x of the direction in the frame of the light."""
    return along_x(tree, "Normal", 0.9)


def beam(tree):
    """A lamp of a file beside the .blend."""
    node = tree.nodes.new("ShaderNodeTexIES")
    node.mode, node.filepath = "EXTERNAL", "//beam.ies"
    return node.outputs[0]


BEAM = """IESNA:LM-63-1995
TILT=NONE
1 -1 1 7 1 1 2 0 0 0
1 1 100
0 15 30 45 60 90 180
0
900 300 800 200 500 100 0
"""


def wait_for(lamps):
    """Until Cycles has looked at all lights."""
    end, news = time.monotonic() + 90.0, False
    while lamps.is_busy and time.monotonic() < end:
        news |= lamps.step(1)
        time.sleep(0.02)
    assert news and not lamps.is_busy


def test_lights_with_nodes_may_have_receivers():
    parts.empty_scene()
    bulb, _ = add_bulb("Striped", "POINT", stripes)
    bulb.light_linking.receiver_collection = bpy.data.collections.new("Lit by it")
    parts.add_camera()
    scene, depsgraph = bpy.context.scene, bpy.context.evaluated_depsgraph_get()
    assert len(mirror.patterns_of(scene, depsgraph, {})) == 1


@pytest.mark.newest
def test_windows_get_the_patterns_of_lights_from_a_second_blender(tmp_path):
    parts.empty_scene()
    (tmp_path / "beam.ies").write_text(BEAM)
    add_bulb("Library", "SPOT", beam)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "lamps.blend"))
    parts.empty_scene()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    striped, tree = add_bulb("Striped", "POINT", stripes)
    add_bulb("File", "POINT", beam)
    with bpy.data.libraries.load(str(tmp_path / "lamps.blend"), link=True, relative=True) as (_, wanted):
        wanted.objects = ["Library"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    parts.add_camera()
    # The power of a frame is not that of the nodes.
    striped.data.keyframe_insert("energy", frame=1)
    lamps = LiveNodeLights()
    lights, notes = seen(lamps.pattern)
    assert [light.pattern for light in lights] == 3 * [None] and notes.count(NOT_YET) == 3 and lamps.is_busy
    wait_for(lamps)
    lights, notes = seen(lamps.pattern)
    expected = {light.name: light for light in parts.prepare()[2].lights}
    assert not notes and {light.name for light in lights} == set(expected) == {"Striped", "File", "Library"}
    for light in lights:
        theirs = expected[light.name]
        np.testing.assert_allclose(light.radiance, theirs.radiance, rtol=1e-5)
        np.testing.assert_allclose(light.pattern.values, theirs.pattern.values, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(light.pattern.axes, theirs.pattern.axes, atol=1e-6)
    found = next(light for light in lights if light.name == "Striped")
    np.testing.assert_allclose(found.radiance, 50.0 / (2.0 * np.pi * striped.data.shadow_soft_size) ** 2, rtol=5e-3)
    values = found.pattern.values
    polar, around = ((np.arange(count) + 0.5) / count for count in values.shape)
    x = np.sin(np.pi * polar)[:, None] * np.cos(2.0 * np.pi * around)
    # Pictures of a side of the cube have 192 points.
    np.testing.assert_allclose(values, 1.0 + 0.9 * x, atol=0.9 * 2.0 / 192)
    # Neither its place nor its power has a say, nodes have; what was found is shown until there is more.
    striped.location.x, striped.data.energy = 3.0, 70.0
    assert not seen(lamps.pattern)[1] and not lamps.is_busy
    wave = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeMath")
    wave.inputs[1].default_value = 0.5
    again, notes = seen(lamps.pattern)
    assert lamps.is_busy and not notes
    np.testing.assert_array_equal(next(light for light in again if light.name == "Striped").pattern.values, values)
    wave.inputs[1].default_value = 0.9
    assert not seen(lamps.pattern)[1] and not lamps.is_busy
    # A light that cannot be looked at is named, once.
    (tmp_path / "lamps.blend").unlink()
    wave.inputs[1].default_value = 0.4
    linked = next(light for light in bpy.data.lights if light.library is not None)
    linked.node_tree.nodes["IES Texture"].inputs["Strength"].default_value = 3.0
    seen(lamps.pattern)
    wait_for(lamps)
    notes = seen(lamps.pattern)[1]
    assert "Library" in notes and "lamps.blend" in notes and not lamps.is_busy


@pytest.mark.newest
def test_a_light_that_changes_meanwhile_is_looked_at_again_and_nobody_waits_in_vain(temporary_root):
    parts.empty_scene()
    tree = add_bulb("Striped", "POINT", stripes)[1]
    wave = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeMath")
    lamps = LiveNodeLights()

    def begun():
        seen(lamps.pattern)
        end = time.monotonic() + 30.0
        while lamps._job is None and time.monotonic() < end:
            lamps.step(1)
            time.sleep(0.02)
        return lamps._job

    begun()
    wave.inputs[1].default_value = 0.5
    seen(lamps.pattern)
    wait_for(lamps)
    ((light,), notes) = seen(lamps.pattern)
    assert not notes and not lamps.is_busy
    np.testing.assert_allclose([light.pattern.values.min(), light.pattern.values.max()], [0.5, 1.5], atol=0.02)
    wave.inputs[1].default_value = 0.7
    look = begun()
    lamps.stop()
    assert look.is_stopped and not lamps.is_busy
    look.thread.join(60.0)
    assert not list(temporary_root.iterdir())
    bpy.data.lights.remove(bpy.data.lights["Striped"])


def world_stripes(tree):
    """1 + 0.3 x of the place in the world."""
    line = along_x(tree, "Normal", 0.3)
    place = tree.nodes.new("ShaderNodeNewGeometry").outputs["Position"]
    tree.links.new(place, next(node for node in tree.nodes if node.bl_idname == "ShaderNodeSeparateXYZ").inputs[0])
    return line


def cloud(tree):
    """A pattern on the light that no formula of ours knows."""
    return tree.nodes.new("ShaderNodeTexVoronoi").outputs["Distance"]


def power_and_place(light):
    """Power (3,) of a light with its patches, and the place (3,) of its middle."""
    powers = np.array([np.linalg.norm(patch.area_vector) * patch.radiance for patch in light])
    return powers.sum(axis=0), np.average([patch.center for patch in light], axis=0, weights=powers.sum(axis=1))


def test_windows_show_what_depends_on_the_place_and_patterns_of_area_lights():
    parts.empty_scene()
    bulb, _ = add_bulb("Bulb", "POINT", world_stripes)
    flat = parts.add_area_light("Flat")
    tree, emission = light_tree(flat)
    tree.links.new(cloud(tree), emission.inputs["Strength"])
    lamps = LiveNodeLights()
    assert "Flat" in seen(lamps.pattern)[1]
    wait_for(lamps)

    def check():
        parts.add_camera()
        lights, notes = seen(lamps.pattern)
        expected = {light.name: light for light in parts.prepare()[2].lights}
        assert not [note for note in notes.splitlines() if "patches" not in note]
        by_name = {name: [light for light in lights if light.name == name] for name in expected}
        assert len(by_name["Flat"]) > 8 and len(by_name["Bulb"]) == 1
        power, place = power_and_place(by_name["Flat"])
        theirs = power_and_place(expected["Flat"].leaves)
        np.testing.assert_allclose(power, theirs[0], rtol=1e-3)
        # 1.2 x 0.7 m.
        np.testing.assert_allclose(place, theirs[1], atol=2e-3)
        (own,) = by_name["Bulb"]
        np.testing.assert_allclose(own.radiance, expected["Bulb"].radiance, rtol=1e-5)
        np.testing.assert_allclose(own.pattern.values, expected["Bulb"].pattern.values, rtol=1e-4, atol=1e-4)
        return own.radiance

    first = check()
    # The pattern on the light goes with it; what is in the world does not, and is looked at again.
    flat.location.x += 0.5
    assert not lamps.is_busy and "Flat: it shines" not in seen(lamps.pattern)[1] and not lamps.is_busy
    bulb.location.x = 3.0
    (moved,) = (light for light in seen(lamps.pattern)[0] if light.name == "Bulb")
    assert lamps.is_busy and np.array_equal(moved.radiance, first)
    bulb.location.x = 2.0
    seen(lamps.pattern)
    assert len(lamps._wanted) == 1
    wait_for(lamps)
    np.testing.assert_allclose(check() / first, (1.0 + 0.3 * 2.0) / (1.0 + 0.3 * 0.5), rtol=1e-2)


def test_only_what_may_change_a_value_changes_the_text_of_nodes():
    parts.empty_scene()
    tree = add_bulb("Lamp", "POINT", beam)[1]
    data, group = bpy.data.lights["Lamp"], bpy.data.node_groups.new("Inner", "ShaderNodeTree")
    own, ramp, curve = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("Group", "ValToRGB", "FloatCurve"))
    own.node_tree, value, text = group, group.nodes.new("ShaderNodeValue"), bpy.data.texts.new("Beam")
    ies = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeTexIES")
    texts = [nodes_as_text(data)]

    def changes():
        texts.append(nodes_as_text(data))
        return texts[-1] != texts[-2]

    data.energy, ies.location.x, ies.select = 3.0, 100.0, not ies.select
    assert not changes()
    value.outputs[0].default_value = 2.0
    assert changes()
    ramp.color_ramp.elements[1].position = 0.7
    assert changes()
    curve.mapping.curves[0].points[1].location.y = 0.3
    assert changes()
    ies.mode, ies.ies = "INTERNAL", text
    assert changes()
    text.write(BEAM)
    assert changes()
    tree.links.remove(ies.outputs[0].links[0])
    assert changes()


def lit_scene():
    """A plane and a sphere under one light of every kind; a lamp and a mesh light the plane alone. The camera."""
    parts.empty_scene(*SIZE)
    plane = parts.add_plane(parts.principled("Floor", Roughness=0.4)[0], size=7.0)
    ball = parts.add_sphere(parts.principled("Ball", Roughness=0.5, Metallic=1.0)[0], 0.7, segments=48)
    ball.location = (0.2, 0.3, 0.7)
    parts.add_area_light("Mirrored", (-1.5, 0.5, 1.4), shape="ELLIPSE", scale=(-1.0, 1.5, 1.0))
    parts.add_area_light("Disk", (1.4, -0.6, 2.0), (0.1, 0.4, 0.0), shape="DISK", size=0.6)
    picture_light(random_picture(2, 4), location=(0.0, 2.2, 1.2), rotation=(-1.1, 0.0, 0.0))
    linked = parts.add_area_light("Linked", (1.8, 1.0, 1.0), (0.0, 0.9, 0.0), color=(0.2, 1.0, 0.3), energy=150.0)
    group = bpy.data.collections.new("Lit by it")
    group.objects.link(plane)
    linked.light_linking.receiver_collection = group
    lamp = add_lamp_plane(location=(-1.2, -1.2, 1.0), rotation=(0.5, -0.4, 0.0), scale=(0.8, 0.6, -1.0))
    lamp.visible_camera = False
    spared = bpy.data.collections.new("Not lit by it")
    spared.objects.link(ball)
    spared.collection_objects[0].light_linking.link_state = "EXCLUDE"
    lamp.light_linking.receiver_collection = spared
    camera = parts.add_camera((0.0, -4.5, 2.6), (1.1, 0.0, 0.0))
    bpy.context.view_layer.update()
    return camera, ball


@edits_with_graphics
def test_lights_of_every_kind_light_the_view_as_numpy_does(tmp_path):
    camera, ball = lit_scene()
    pictures = with_graphics(lambda: [viewport_picture(camera, name) for name in shading.PASSES])
    path = parts.save(tmp_path / "lights.blend", copy=True)
    found = extract_pixels(PixelJob(scene=path))
    distance = np.linalg.norm(found.samples.position - np.array(ball.location), axis=1)
    # Away from the edge of the ball and what is hidden behind it, where positions differ by more than a pixel.
    on_ball = np.abs(distance - 0.7) < 0.01
    for name, (picture, notes) in zip(shading.PASSES, pictures, strict=True):
        reflected = shading.shade(found.samples, found.lights, "ltsh4", passes=(name,), workers=1).combined
        # A lobe that ends at two horizons is two samples of one pixel.
        shaded = found.film.image(reflected).reshape(-1, 3)[found.film.pixel]
        seen_there = picture.reshape(-1, 3)[found.film.pixel]
        for part in (on_ball, ~on_ball):
            error = np.abs(seen_there - shaded)[part].max(axis=1) / (1e-3 + shaded[part].max(axis=1))
            assert np.quantile(error, 0.9) < 1e-2, f"{name}: {np.quantile(error, [0.5, 0.9, 0.99])}"
        assert notes == []


@edits_with_graphics
def test_a_flat_surface_that_shines_does_not_light_itself():
    parts.empty_scene(*SIZE)
    glow = {"Emission Color": (0.3, 0.2, 0.1, 1.0), "Emission Strength": 2.0}
    # Turned, so that rounding puts its points before it and behind it.
    parts.add_plane(parts.principled("Sign", **glow)[0], size=2.0, location=(0.7, 0.6, 0.6), rotation=(1.2, 0.3, -0.4))
    camera = parts.add_camera((0.0, -4.0, 2.6), (1.02, 0.0, 0.0))
    bpy.context.view_layer.update()
    for passes in shading.PASSES:
        picture, _ = with_graphics(lambda passes=passes: viewport_picture(camera, passes))
        assert not picture.any()


@pytest.mark.newest
def test_lights_and_those_of_the_world_fit_the_layers_of_a_card(monkeypatch):
    """With the sky's sides they have a layer each, and cards take 2048."""
    parts.empty_scene()
    parts.add_area_light("Lamp")
    (lamp,), _ = seen()
    assert MOST_LIGHTS < 2048
    monkeypatch.setattr(mirror, "MOST_LIGHTS", 4)
    shown = mirror.SceneMirror()
    shown.lights_without_world = tuple(replace(lamp, radiance=(1.0 + n) * lamp.radiance) for n in range(4))
    shown.take_sky(ShownSky(lights=(lamp,)))
    assert len(shown.lights) == 4 and shown.lights[-1] is lamp and shown.lights[0] is shown.lights_without_world[1]
    assert any("10.0 % of the power is missing" in note for note in shown.notes)


def glowing(color_node=None, strength=3.0, **settings):
    """A material that emits the color of a node, with `settings` of that."""
    material = bpy.data.materials.new("Glow")
    ensure_nodes(material)
    fill_with_bsdf(material.node_tree, "ShaderNodeEmission", (1.0, 1.0, 1.0, 1.0))
    emission = next(node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeEmission")
    emission.inputs["Strength"].default_value = strength
    if color_node:
        node = material.node_tree.nodes.new(color_node)
        for name, value in settings.items():
            setattr(node, name, value)
        material.node_tree.links.new(node.outputs[0], emission.inputs["Color"])
    return material


def missing_image():
    image = bpy.data.images.new("Gone", 4, 4)
    image.source, image.filepath = "FILE", "//gone.png"
    return image


@pytest.mark.newest
@pytest.mark.parametrize(
    ("node", "color", "note"),
    [("ShaderNodeTexImage", (1.0, 0.0, 1.0), ""), ("ShaderNodeVertexColor", (0.5,) * 3, "half of"),
     ("ShaderNodeTexNoise", (0.5,) * 3, "about the mean of its colors")],
)  # fmt: skip
def test_glowing_faces_of_colors_that_views_cannot_read_shine(node, color, note):
    """Missing images are pink in Cycles; other colors from 0 to 1 are taken as half, and named."""
    parts.empty_scene()
    parts.add_camera()
    options = {"image": missing_image()} if node == "ShaderNodeTexImage" else {}
    parts.add_plane(glowing(node, **options), size=1.0)
    lights, notes = seen()
    for light in lights:
        np.testing.assert_allclose(light.radiance, 3.0 * np.array(color), rtol=1e-6)
    assert sum(np.linalg.norm(light.area_vector) for light in lights) == pytest.approx(2.0) and " 0 %" not in notes
    names = preview_of(bpy.data.materials["Glow"]).notes
    assert not names if not note else any(note in line for line in names)


@pytest.mark.newest
@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (-2.0, 1.0, 1.0)])
def test_faces_that_shine_by_an_image_light_as_they_are_mapped(scale):
    """A quad and a triangle in one plane and a quad beside, with UV coordinates of their own and another map; a red
    ramp along u and a green one along v, so that radiance is the place on the image."""
    parts.empty_scene()
    parts.add_camera()
    count = 64
    u, v = np.meshgrid(*2 * [(np.arange(count) + 0.5) / count])
    texture = bpy.data.images.new("ramps", count, count, float_buffer=True, is_data=True)
    texture.pixels.foreach_set(np.stack([u, v, 0.0 * u, 1.0 + 0.0 * u], axis=-1).astype(np.float32).ravel())
    places = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (1, 2, 0), (5, 0, 0), (5, 1, 0), (5, 1, 1), (5, 0, 1)]
    faces = [(0, 1, 2, 3), (3, 2, 4), (5, 6, 7, 8)]
    mesh = bpy.data.meshes.new("Sign")
    mesh.from_pydata(places, [], faces)
    mesh.materials.append(glowing("ShaderNodeTexImage", image=texture, extension="EXTEND"))
    mesh.uv_layers.new(name="Other")
    mesh.uv_layers.new(name="Shown").active_render = True
    chosen = {0: (0.1, 0.2), 1: (0.9, 0.3), 2: (0.8, 0.8), 3: (0.0, 0.7), 4: (0.5, 1.0)}
    chosen |= {5: (0.2, 0.2), 6: (0.6, 0.2), 7: (0.6, 0.9), 8: (0.2, 0.9)}
    for loop, of_loop in zip(mesh.loops, mesh.uv_layers["Shown"].uv, strict=True):
        of_loop.vector = chosen[loop.vertex_index]
    parts.link(bpy.data.objects.new("Sign", mesh)).scale = scale
    lights, _ = seen()
    area, expected = 0.0, np.zeros((2, 3))
    for light in lights:
        size = np.linalg.norm(light.area_vector)
        area += size
        expected[int(abs(light.center[0] / scale[0]) > 4.0)] += size * light.radiance
    stretch = abs(scale[0])
    assert area == pytest.approx(2.0 * (3.0 * stretch + 1.0), rel=0.02)  # cells at outlines that are not covered
    # Both sides: triangles' areas times the mean of their corners, on ramps.
    triangles = [(0, 1, 2), (0, 2, 3), (3, 2, 4)]
    flat = sum(np.mean([chosen[corner] for corner in one], axis=0) for one in triangles)
    np.testing.assert_allclose(expected[0, :2], 3.0 * 2.0 * stretch * flat, rtol=0.02)
    np.testing.assert_allclose(expected[1, :2], 3.0 * 2.0 * np.array([0.4, 0.55]), rtol=0.02)
    # Each patch has the color of its place.
    for light in lights:
        x, y, z = light.center / scale
        if x > 4.0:
            np.testing.assert_allclose(light.radiance[:2] / 3.0, (0.2 + 0.4 * y, 0.2 + 0.7 * z), atol=0.03)


@pytest.mark.parametrize("temperature", [2000.0, 3200.0, 6500.0, 15000.0])
def test_faces_that_glow_by_their_temperature_have_its_color(temperature):
    """That of a lamp, which Blender tells."""
    parts.empty_scene()
    parts.add_camera()
    material = glowing("ShaderNodeBlackbody")
    node = next(one for one in material.node_tree.nodes if one.bl_idname == "ShaderNodeBlackbody")
    node.inputs[0].default_value = temperature
    parts.add_plane(material, size=1.0)
    lamp = bpy.data.lights.new("Lamp", "POINT")
    lamp.use_temperature, lamp.temperature = True, temperature
    for light in seen()[0]:
        # Of the color matching functions' sums of lobes.
        np.testing.assert_allclose(light.radiance, 3.0 * np.array(lamp.temperature_color[:3]), rtol=0.03, atol=0.01)
    assert not preview_of(material).notes


@pytest.mark.newest
def test_polygons_stand_for_very_many_glowing_faces():
    """Beside the integral over a smooth torus, whose area its facets have within .5 %, a quarter of its size away."""
    parts.empty_scene()
    parts.add_camera()
    bpy.ops.mesh.primitive_torus_add(major_segments=80, minor_segments=60, major_radius=1.0, minor_radius=0.25)
    bpy.context.object.data.materials.append(glowing())
    lights, notes = seen()
    assert len(lights) == MOST_SHOWN and "112 polygons stand for 4800 flat faces" in notes
    power = sum(np.linalg.norm(light.area_vector) * light.radiance for light in lights)
    np.testing.assert_allclose(power, 3.0 * 4.0 * np.pi**2 * 0.25, rtol=0.005)
    u, v = np.meshgrid(*((np.arange(count) + 0.5) * 2.0 * np.pi / count for count in (400, 100)))
    normal = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    ring = np.stack([np.cos(u), np.sin(u), 0.0 * u], axis=-1).reshape(-1, 3)
    area = ((1.0 + 0.25 * np.cos(v)) * 0.25 * (2.0 * np.pi) ** 2 / u.size).ravel()
    found, expected = [], []
    for place, out in zip((ring + 0.75 * normal)[::613], normal[::613], strict=True):
        way = ring + 0.25 * normal - place
        squared = (way * way).sum(axis=1)
        cosines = np.maximum(-(way @ out), 0.0) * np.maximum(-(way * normal).sum(axis=1), 0.0)
        expected.append(3.0 * (area * cosines / squared**2).sum())
        lit = shading.shade(single_sample(place, -out, -out), lights, passes=("diffuse",), workers=1)
        found.append(np.pi * lit.diffuse.sum(axis=0)[0, 0])
    assert np.linalg.norm(np.subtract(found, expected)) < 0.08 * np.linalg.norm(expected)


@pytest.mark.newest
def test_faces_that_other_lobes_see_are_not_drawn_together():
    parts.empty_scene()
    parts.add_camera()
    bpy.ops.mesh.primitive_torus_add()
    bpy.context.object.data.materials.append(glowing())
    faces = seen()[0][0].faces
    both = [*faces, *(replace(face, affects_specular=False) for face in faces)]
    shown = fewer_lights(both, lambda warning: None)
    assert {light.affects_specular for light in shown} == {True, False}
    for light in shown:
        assert {face.affects_specular for face in light.faces} == {light.affects_specular}


@pytest.mark.newest
def test_of_very_many_faces_as_many_backs_as_fronts_shine():
    """An open mesh shines on both sides; of a grid all fronts look up."""
    parts.empty_scene()
    parts.add_camera()
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=60, y_subdivisions=60)
    bpy.context.object.data.vertices.foreach_set("co", crumpled(bpy.context.object.data))
    bpy.context.object.data.materials.append(glowing())
    lights, _ = seen()
    power = np.array([np.linalg.norm(light.area_vector) * light.radiance[0] for light in lights])
    is_up = np.array([light.direction[2] > 0.0 for light in lights])
    assert len(lights) <= MOST_SHOWN and power[is_up].sum() / power.sum() == pytest.approx(0.5, abs=1e-6)


@pytest.mark.newest
def test_small_lamps_are_drawn_face_by_face_beside_large_ones():
    parts.empty_scene()
    parts.add_camera()
    bpy.ops.mesh.primitive_torus_add(major_segments=80, minor_segments=60)
    bpy.context.object.data.materials.append(glowing())
    bpy.ops.mesh.primitive_cube_add(location=(0.0, 0.0, 3.0))
    bpy.context.object.data.materials.append(glowing())
    lights, _ = seen()
    assert [len(light.faces) for light in lights if isinstance(light, StandInLight)] == MOST_SHOWN * [4800]
    assert len(lights) == MOST_SHOWN + 6


def crumpled(mesh):
    """Coordinates of the vertices, of which no four are in a plane any more."""
    coordinates = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", coordinates.ravel())
    return coordinates.ravel() + np.random.default_rng(0).normal(0.0, 0.003, coordinates.size)


@pytest.mark.newest
@pytest.mark.parametrize("flipped", [False, True])
def test_what_is_nearly_a_sphere_shines_as_one_light(flipped):
    """A bulb and a box of one mesh; the camera is outside, then inside of the bulb, which then shines inward."""
    parts.empty_scene()
    camera = parts.add_camera()
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(2.0, 0.0, 0.0))
    bulb = parts.add_sphere(glowing(), radius=0.3, location=(0.0, 0.0, 1.0))
    bpy.data.objects["Cube"].data.materials.append(bulb.data.materials[0])
    bpy.data.objects["Cube"].select_set(True)
    bpy.ops.object.join()
    bulb.scale.x = -2.0 if flipped else 2.0
    bulb.scale.yz = 2.0, 2.0
    lights, notes = seen()
    (ball,) = (light for light in lights if light.is_facing)
    assert len(lights) == 7 and ball.is_sphere and not notes
    assert ball.radius == pytest.approx(0.6, rel=0.005)
    np.testing.assert_allclose(ball.center, bulb.matrix_world.translation, atol=1e-5)
    # The ball's surface area is that of the faces.
    faces = [np.linalg.norm(light.area_vector) for light in lights if not light.is_facing]
    assert sum(faces) == pytest.approx(6.0)
    power = 4.0 * np.pi * ball.radius**2 * ball.radiance
    np.testing.assert_allclose(power, 3.0 * 4.0 * np.pi * 0.36, rtol=0.01)
    camera.location = bulb.matrix_world.translation
    lights, _ = seen()
    assert len(lights) == MOST_SHOWN and not any(light.is_facing for light in lights)
    assert {len(light.faces) for light in lights} == {6 + 32 * 16}
    # Mirror-like lobes see no gaps: 3 % off on average, where rectangles of the same area are 20 % off.
    rng, off, fresnel = np.random.default_rng(0), [], {"specular_f0": np.ones(3), "specular_f90": np.ones(3)}
    for normal in rng.normal(size=(100, 3)):
        place = camera.location + 0.1 * mathutils.Vector(rng.normal(size=3))
        one = single_sample(place, normal, normal, roughness=0.15, **fresnel)
        shine, whole = (shading.shade(one, some, workers=1).specular.sum() for some in (lights, lights[0].faces))
        off.append(shine / whole - 1.0)
    assert np.sqrt(np.mean(np.square(off))) < 0.06


def test_texts_and_curves_are_drawn_and_shine_once():
    parts.empty_scene()
    parts.add_camera()
    bpy.ops.object.text_add()
    bpy.context.object.data.materials.append(glowing())
    bpy.ops.curve.primitive_bezier_circle_add()
    bpy.context.object.data.bevel_depth = 0.1
    depsgraph = bpy.context.evaluated_depsgraph_get()
    names = [instance.object.name for instance in depsgraph.object_instances if is_surface(instance)]
    assert sorted(names) == ["BézierCircle", "Text"]


@pytest.mark.newest
def test_lights_that_are_hidden_from_one_kind_of_rays_are_named():
    parts.empty_scene()
    parts.add_area_light("Lamp").visible_glossy = False
    parts.add_area_light("Plain")
    lights, _ = seen()
    shown = mirror.SceneMirror()
    shown.lights_without_world = lights
    shown.take_sky(ShownSky(lights=(replace(lights[1], name="Sky", affects_diffuse=False),)))
    assert [note.partition(";")[0] for note in shown.notes] == [
        "light 'Lamp': it is hidden from glossy rays",
        "light 'Sky': it is hidden from diffuse rays",
    ]
