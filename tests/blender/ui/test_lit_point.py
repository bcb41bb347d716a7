"""The light of a point under the mouse: each light's share, and drags of the brightness."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from mathutils import Vector

from ltsh_addon.blender.lights.textures import ShownTextures
from ltsh_addon.blender.ui import gestures
from ltsh_addon.blender.ui.lit_point import LightShare, SceneLights, samples_at_hit, share_line, surface_hit
from ltsh_addon.cycles.texels import GRAY
from ltsh_addon.shading import shade

EYE = Vector((0.0, -3.0, 4.0))
ALBEDO = 0.6


def hit_from(eye, target):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return surface_hit(bpy.context.scene, depsgraph, Vector(eye), (Vector(target) - Vector(eye)).normalized())


def add_ball(name, location, energy, kind="POINT", **settings):
    return parts.link(parts.new_light(name, kind, energy=energy, use_soft_falloff=False, **settings), location)


@pytest.fixture
def floor(addon):
    """A matte floor with a board above a quarter of it."""
    parts.add_plane(parts.bsdf_material("ShaderNodeBsdfDiffuse", Color=(ALBEDO, ALBEDO, ALBEDO, 1.0))[0])
    parts.add_plane(size=1.0, name="Board", location=(1.5, 0.0, 1.0))
    return addon


def luminance_of_ball(light, point=(0.0, 0.0, 0.0)):
    """Of the light that the floor reflects: a ball of P watts has the irradiance P cos / (4 pi d^2), without regard to
    its size where it is whole above the horizon."""
    way = np.array(light.location) - point
    return ALBEDO / np.pi * light.data.energy * way[2] / (4.0 * np.pi * np.linalg.norm(way) ** 3)


def shares_at(target, eye=EYE):
    lights = SceneLights.of(bpy.context)
    try:
        return {share.name: share for share in lights.shares_at(hit_from(eye, target))}
    finally:
        lights.close()


def test_shares_are_those_of_a_closed_form(floor):
    key = add_ball("Key", (1.0, 1.0, 2.0), 100.0, shadow_soft_size=0.3)
    rim = add_ball("Rim", (-1.0, 0.5, 1.5), 30.0, shadow_soft_size=0.1)
    # Its rays to the middle of the floor go through the board.
    add_ball("Hidden", (3.0, 0.0, 2.0), 500.0, shadow_soft_size=0.05)
    parts.add_white_world()
    bpy.context.view_layer.update()
    shares = shares_at((0.0, 0.0, 0.0))
    for light in (key, rim):
        assert shares[light.name].luminance == pytest.approx(luminance_of_ball(light), rel=1e-3)
        assert shares[light.name].is_lamp
    assert shares["Hidden"].luminance == 0.0
    # Of the world the board hides a share: none of it, up to the noise of 256 rays, or 6 % of the hemisphere.
    assert 0.9 * ALBEDO < shares["World"].luminance <= ALBEDO * 1.001 and not shares["World"].is_lamp
    assert list(shares)[0] == max(shares, key=lambda name: shares[name].luminance)
    floor.ltsh.shadows = floor.ltsh_view.world = False
    bare = shares_at((0.0, 0.0, 0.0))
    assert bare["Hidden"].luminance > 0.1 and "World" not in bare


def test_a_glowing_mesh_is_listed_but_is_no_lamp(floor):
    glow = parts.bsdf_material("ShaderNodeEmission", Strength=5.0)[0]
    parts.add_plane(glow, size=0.5, name="Panel", location=(0.0, 0.0, 2.0), rotation=(np.pi, 0.0, 0.0))
    bpy.context.view_layer.update()
    share = shares_at((0.0, 0.0, 0.0))["Panel"]
    # A small square above: E = L A / d^2, 4 % less for its size (by quadrature 0.9606).
    assert share.luminance == pytest.approx(0.97 * ALBEDO / np.pi * 5.0 * 0.25 / 4.0, rel=0.02) and not share.is_lamp


def coated():
    return parts.principled(**{
        "Base Color": (0.7, 0.3, 0.1, 1.0), "Roughness": 0.35, "Coat Weight": 0.8, "Coat Roughness": 0.2,
        "Coat Tint": (0.9, 0.8, 1.0, 1.0), "Sheen Weight": 0.5, "Sheen Roughness": 0.4,
        "Sheen Tint": (0.9, 0.9, 0.3, 1.0),
    })[0]  # fmt: skip


def mixed():
    """Matte under gloss, by Fresnel."""
    material, gloss = parts.bsdf_material("ShaderNodeBsdfGlossy", Roughness=0.4, Color=(0.9, 0.8, 0.7, 1.0))
    tree = material.node_tree
    matte = parts.add_node(tree, "ShaderNodeBsdfDiffuse", Color=(0.2, 0.5, 0.6, 1.0), Roughness=0.3)
    mix, fresnel = tree.nodes.new("ShaderNodeMixShader"), parts.add_node(tree, "ShaderNodeFresnel", IOR=1.8)
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    for start, end in ((fresnel, mix.inputs[0]), (matte, mix.inputs[1]), (gloss, mix.inputs[2])):
        tree.links.new(start.outputs[0], end)
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return material


def painted():
    """Metal with an image for its color and its roughness."""
    material, node = parts.principled(Metallic=0.7)
    image = bpy.data.images.new("Paint", 8, 8)
    random = np.random.default_rng(3).random((64, 4))
    random[:, 3] = 1.0
    image.pixels.foreach_set(random.astype(np.float32).ravel())
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    for name in ("Base Color", "Roughness"):
        material.node_tree.links.new(texture.outputs["Color"], node.inputs[name])
    return material


@pytest.mark.parametrize("make", [coated, mixed, painted])
def test_the_material_is_that_of_cycles(addon, tmp_path, make):
    """Beside the values that Cycles itself writes for the pixel in the middle."""
    parts.add_plane(make())
    camera = parts.add_camera((0.31, -3.0, 2.0))
    parts.add_area_light("Key", location=(0.5, 1.0, 1.5), rotation=(-0.5, 0.2, 0.0))
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = 15
    bpy.context.view_layer.update()
    eye = camera.matrix_world.translation.copy()
    hit = hit_from(eye, eye - camera.matrix_world.col[2].xyz)
    ours = samples_at_hit(hit, ShownTextures())
    lights = SceneLights.of(bpy.context)
    lights.close()
    prepared = parts.prepare()
    ((samples, pixel, _),), _ = parts.sample(tmp_path, prepared)
    theirs = samples.take(pixel == 7 * 15 + 7)
    assert np.abs(theirs.position[0] - np.array(hit.position)).max() < 1e-3
    radiance, expected = (shade(one, lights.lights, workers=1).combined.sum(axis=0) for one in (ours, theirs))
    # Cycles measures the albedo of diffuse lobes; here it is estimated (1 %).
    assert radiance == pytest.approx(expected, rel=0.02)


def drag(hit, lights, *moves):
    """What a drag of the brightness that is pressed at `hit` leaves; `moves` are (y, shift, ctrl)."""
    this = SimpleNamespace(
        _scale=1.0, hit_under=lambda context, event: hit, shares_at=lambda context, hit: lights.shares_at(hit),
        share_line=lambda hit, shares: share_line(shares), _mouse=np.array([0.0, 100.0]), _typed="",
    )  # fmt: skip
    kind = gestures.LTSH_OT_drag_brightness
    this.follow = lambda context, event: kind.follow(this, context, event)
    is_pressed = kind.press(this, bpy.context, SimpleNamespace(ctrl=False))
    last = 100.0
    for y, shift, ctrl in moves:
        kind.move(this, (gestures.PRECISE if shift else 1.0) * np.array([0.0, y - last]))
        last = y
        this.follow(bpy.context, SimpleNamespace(ctrl=ctrl))
    return this, is_pressed


@pytest.mark.parametrize(("moves", "factor"), [
    ([(150, False, False), (200, False, False)], 2.0),
    ([(50, False, False)], 2.0**-0.5),
    ([(200, False, False), (300, True, False)], 2.0**1.1),
    ([(240, False, True)], 2.0 ** (4 / 3)),
    ([(240, False, True), (230, False, False)], 2.0**1.3),
])  # fmt: skip
def test_the_point_gets_as_much_brighter_as_the_mouse_says(floor, moves, factor):
    key = add_ball("Key", (1.0, 1.0, 2.0), 100.0, shadow_soft_size=0.3)
    rim = add_ball("Rim", (-1.0, 0.5, 1.5), 30.0, shadow_soft_size=0.1)
    floor.ltsh_view.world = False
    bpy.context.view_layer.update()
    before, lights = luminance_of_ball(key) + luminance_of_ball(rim), SceneLights.of(bpy.context)
    this, is_pressed = drag(hit_from(EYE, (0.0, 0.0, 0.0)), lights, *moves)
    lights.close()
    assert is_pressed and this._light == key and rim.data.energy == 30.0
    assert luminance_of_ball(key) + luminance_of_ball(rim) == pytest.approx(factor * before, rel=1e-3)
    assert f"Key: 100 to {key.data.energy:.4g} W" in this._note and "Rim" in this._note
    for typed in ("3.5", "0.5"):
        this._typed = typed
        this.follow(bpy.context, SimpleNamespace(ctrl=False))
        bpy.context.view_layer.update()
        now = luminance_of_ball(key) + luminance_of_ball(rim)
        assert now == pytest.approx(float(typed) * before, rel=1e-3) and f"here {typed} times" in this._note
    gestures.LTSH_OT_drag_brightness.put_back(this)
    assert key.data.energy == 100.0


def test_a_light_goes_out_and_says_what_is_left(floor):
    key = add_ball("Key", (1.0, 1.0, 2.0), 100.0)
    add_ball("Rim", (-1.0, 0.5, 1.5), 30.0)
    bpy.context.view_layer.update()
    lights = SceneLights.of(bpy.context)
    this, _ = drag(hit_from(EYE, (0.0, 0.0, 0.0)), lights, (-900, False, False))
    lights.close()
    assert key.data.energy == 0.0 and "off: the other lights leave 0.3" in this._note


def test_lights_whose_power_something_holds_keep_it(floor):
    key = add_ball("Key", (1.0, 1.0, 2.0), 100.0)
    bpy.context.view_layer.update()
    assert gestures.reason_to_keep_power(key) == ""
    key.data.keyframe_insert("color", frame=1)
    key.data.use_fake_user = True
    assert gestures.reason_to_keep_power(key) == ""
    key.data.keyframe_insert("energy", frame=1)
    assert gestures.reason_to_keep_power(key) == "its power is animated or driven"
    lights, hit = SceneLights.of(bpy.context), hit_from(EYE, (0.0, 0.0, 0.0))
    this, is_pressed = drag(hit, lights)
    assert not is_pressed and this._note == "Key: its power is animated or driven" and key.data.energy == 100.0
    key.data.animation_data_clear()
    key.data.driver_add("energy").driver.expression = "7"
    assert gestures.reason_to_keep_power(key) == "its power is animated or driven"
    key.data.driver_remove("energy")
    track = key.data.animation_data.nla_tracks.new()
    key.data.keyframe_insert("energy", frame=1)
    track.strips.new("Strip", 1, key.data.animation_data.action)
    key.data.animation_data.action = None
    assert gestures.reason_to_keep_power(key) == "its power is animated or driven"
    key.data.animation_data_clear()
    other = parts.link(bpy.data.objects.new("Other", key.data), (0.0, 0.0, 3.0))
    assert gestures.reason_to_keep_power(key) == "its data 'Key' has 2 users: make it single-user first"
    bpy.data.objects.remove(other)
    key.hide_viewport = True
    bpy.context.view_layer.update()
    dark = SceneLights.of(bpy.context)
    this, is_pressed = drag(hit, dark)
    assert not is_pressed and this._note.startswith("No light that can be changed arrives here")
    for one in (lights, dark):
        one.close()


def test_a_line_names_the_brightest_and_counts_the_others():
    shares = [LightShare(f"L{number}", True, 2.0**-number) for number in range(6)]
    assert share_line(shares) == "L0 50.8 %   L1 25.4 %   L2 12.7 %   L3 6.35 %   2 others 4.8 %"
    assert share_line([]) == "No light arrives here"
    assert GRAY.sum() == pytest.approx(1.0)
