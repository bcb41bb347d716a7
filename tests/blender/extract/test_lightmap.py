"""Bakes with bounced light beside Cycles' own bake of direct and indirect light, in scenes where both matter."""

import math

import bpy
import numpy as np
import pytest
from bake_scenes import SIZE, baked, save, start
from material_scenes import Build
from scene_parts import add_bump, add_mesh, add_plane, add_sphere, add_world, principled

from ltsh_addon.blender.extract.bake import SAMPLED_TEXELS
from ltsh_addon.blender.extract.bounces import rows_of_lights

TRUTH = 256  # samples; a half of them is off by 1.5 % of the light


def corner():
    """A white floor beside a red wall, a glowing ball and a lamp, under a dim world."""
    start(camera=None)
    bpy.data.objects["Key"].data.energy = 20.0
    add_plane(principled("White", Base_Color=(0.8, 0.8, 0.8, 1.0), Roughness=1.0)[0], size=2.0, name="Floor")
    red = principled("Red", Base_Color=(0.8, 0.1, 0.1, 1.0), Roughness=1.0)[0]
    for number, x in enumerate((-1.0, 1.0)):
        wall = add_mesh("Wall", [(x, -1, 0), (x, 1, 0), (x, 1, 2), (x, -1, 2)], [(0, 1, 2, 3)[:: 1 - 2 * number]])
        wall.data.materials.append(red)
    glow = principled(
        "Glow", Emission_Color=(0.2, 0.5, 1.0, 1.0), Emission_Strength=2.0, Base_Color=(0.1, 0.1, 0.1, 1.0)
    )
    add_sphere(glow[0], radius=0.2, location=(0.5, 0.3, 0.6), segments=16)
    add_world(Color=(0.2, 0.25, 0.3, 1.0))


def by_cycles(name="Floor", light=("DIRECT", "INDIRECT"), samples=TRUTH):
    """Cycles' diffuse light (2, SIZE, SIZE, 3) of an object, without color: two halves, row 0 on top."""
    scene, ob = bpy.context.scene, bpy.data.objects[name]
    scene.render.engine, scene.cycles.samples = "CYCLES", samples // 2
    scene.cycles.use_adaptive_sampling, halves = False, []
    image = bpy.data.images.new("truth", SIZE, SIZE, alpha=True, float_buffer=True, is_data=True)
    for slot in ob.material_slots:
        node = slot.material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image, slot.material.node_tree.nodes.active = image, node
    for other in scene.objects:
        other.select_set(other is ob)
    bpy.context.view_layer.objects.active = ob
    for scene.cycles.seed in (3, 4):
        bpy.ops.object.bake(type="DIFFUSE", pass_filter=set(light), margin=0, use_clear=True)
        pixels = np.empty(SIZE * SIZE * 4, np.float32)
        image.pixels.foreach_get(pixels)
        halves.append(pixels.reshape(SIZE, SIZE, 4)[::-1, :, :3])
    return np.array(halves)


def off(light, halves):
    """The error of light (N, 3) beside halves (2, N, 3) without their noise, and its mean, both relative."""
    light, a, b = light.astype(float), *halves.astype(float)
    squared = ((light - a) * (light - b)).mean() / (a * b).mean()
    return math.sqrt(max(squared, 0.0)), light.mean() / (0.5 * (a + b).mean()) - 1.0


def lightmap(tmp_path, **options):
    """The report and the layers of a bake of the open file with bounced light, and its coverage."""
    values = {"passes": ("diffuse_light",), "shadows": "on", "bounces": "on", "view": "above", "objects": ("Floor",)}
    tmp_path.mkdir(exist_ok=True)
    report, files = baked(save(tmp_path), tmp_path / "out", **{**values, **options})
    (layers,) = files.values()
    return report, layers, layers["coverage.hit"].reshape(SIZE, SIZE) > 0.0


@pytest.mark.parametrize("group", ["", "Lamps"])
def test_direct_and_bounced_light_are_that_of_cycles(tmp_path, group):
    corner()
    if group:
        bpy.context.view_layer.lightgroups.add(name=group)
        bpy.data.objects["Key"].lightgroup = group
    report, layers, covered = lightmap(tmp_path)
    truth = by_cycles()[:, covered]
    error, mean = off(layers["ltsh4c.diffuse_light"][covered], truth)
    # Light that is left out, or counts twice: a fifth is bounced, a tenth is of the world, another one of the ball.
    assert abs(mean) < 0.01
    # 64 samples without the denoiser are 4 % off (the next test tells that the denoiser gains).
    assert error < 0.02
    assert report["warnings"] == []


@pytest.mark.parametrize("kind", ["Sky", "Environment", "Checker"])
def test_a_sky_that_varies_counts_once(tmp_path, kind):
    """With a round sun, with a square one in an image, and without."""
    corner()
    tree = bpy.context.scene.world.node_tree
    background, sky = tree.nodes["Background"], tree.nodes.new(f"ShaderNodeTex{kind}")
    if kind == "Sky":
        sky.sun_elevation, sky.sun_rotation, background.inputs["Strength"].default_value = 0.9, 2.0, 0.05
    elif kind == "Environment":
        pixels = np.full((64, 128, 4), 0.3, np.float32)
        pixels[54, 30:32, :3] = 500.0
        sky.image = bpy.data.images.new("sky", 128, 64, float_buffer=True)
        sky.image.pixels.foreach_set(pixels.ravel())
        sky.image.pack()
    else:
        sky.inputs["Scale"].default_value = 4.0
        tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"], sky.inputs["Vector"])
    tree.links.new(sky.outputs["Color"], background.inputs["Color"])
    # Blender 5.2 renders a new image without its bright pixels.
    bpy.ops.wm.open_mainfile(filepath=str(save(tmp_path)))
    _, layers, covered = lightmap(tmp_path)
    error, mean = off(layers["ltsh4c.diffuse_light"][covered], by_cycles()[:, covered])
    # 64 samples without the denoiser are 4.5 % off.
    assert abs(mean) < 0.005 and error < 0.025


@pytest.mark.parametrize("points", [1, 4])
def test_surfaces_that_are_baked_light_those_after_them(tmp_path, points):
    """Colors by nodes, and points off the centers of texels, are read from what the material emits for a while."""
    corner()
    uv = bpy.data.objects["Wall"].data.uv_layers.new(name="UVMap")
    uv.uv.foreach_set("vector", [0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    tree = bpy.data.materials["White"].node_tree
    checker = tree.nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = 2.0
    checker.inputs["Color2"].default_value = (0.8, 0.8, 0.8, 1.0)
    tree.links.new(checker.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    options = {"passes": ("diffuse_light",), "shadows": "on", "bounces": "on", "sub_samples": points}
    _, files = baked(save(tmp_path), tmp_path / "out", objects=("Floor", "Wall"), view="above", **options)
    layers, truth = files["Wall.exr"], by_cycles("Wall")
    covered = layers["coverage.hit"].reshape(SIZE, SIZE) > 0.0
    error, mean = off(layers["ltsh4c.diffuse_light"][covered], truth[:, covered])
    # A black floor takes .22 of the light. 64 samples without the denoiser are 5 % off.
    assert abs(mean) < 0.01 and error < 0.03


def test_leaves_are_lit_from_both_sides(tmp_path):
    """A lightmap's light is that of all diffuse lobes of a texel, by their shares in its color."""
    corner()
    made = Build("Leaf")
    front = made.shader("BsdfDiffuse", Color=(0.2, 0.6, 0.2, 1.0))
    made.show(made.mix(0.5, front, made.shader("BsdfTranslucent", Color=(0.6, 0.6, 0.2, 1.0))))
    add_plane(made.material, size=0.8, name="Leaf", location=(-0.3, 0.0, 0.7))
    light = by_cycles("Leaf")
    # No camera is needed, and none has a say.
    _, layers, covered = lightmap(tmp_path, objects=("Leaf",), view="camera")
    error, mean = off(layers["ltsh4c.diffuse_light"][covered], light[:, covered])
    # One side alone would be 86 % too bright.
    assert abs(mean) < 0.01 and error < 0.03


def test_lamps_of_instances_count_once(tmp_path):
    corner()
    scene, lamp, lamps = bpy.context.scene, bpy.data.objects["Key"], bpy.data.collections.new("Lamps")
    scene.collection.objects.unlink(lamp)
    lamps.objects.link(lamp)
    for x in (-0.3, 0.3):
        place = bpy.data.objects.new("Place", None)
        place.instance_type, place.instance_collection, place.location = "COLLECTION", lamps, (x, 0.0, 0.0)
        scene.collection.objects.link(place)
    light = by_cycles()
    _, layers, covered = lightmap(tmp_path)
    error, mean = off(layers["ltsh4c.diffuse_light"][covered], light[:, covered])
    assert abs(mean) < 0.01 and error < 0.02
    _, layers, _ = lightmap(tmp_path / "apart", per_light=True)
    of_lights = {name.partition("@")[2]: light for name, light in layers.items() if "@" in name}
    assert set(of_lights) == {"World", "Glowing surfaces"}
    whole = sum(light.astype(float) for light in of_lights.values())[covered]
    assert abs(off(whole, light[:, covered])[1]) < 0.01


def test_faces_whose_smooth_normals_turn_away_have_the_bounces_of_a_render(tmp_path):
    corner()
    # A narrow face is folded back below a wide one, to which it owes its smooth normals at the fold.
    points = np.array([(-1, 0, 0), (1, 0, 0), (1, 1, 0), (-1, 1, 0), (0, 0.9, -0.5)]) * 0.5 + (0.0, -0.3, 1.0)
    fold = add_mesh("Fold", points.tolist(), [(0, 1, 2, 3), (1, 0, 4)])
    uv = [0, 0, 0.2, 0, 0.2, 0.2, 0, 0.2, 0.25, 0.25, 0.95, 0.25, 0.6, 0.95]
    fold.data.uv_layers.new(name="UVMap").uv.foreach_set("vector", uv)
    fold.data.materials.append(bpy.data.materials["White"])
    fold.data.shade_smooth()
    bpy.context.scene.world = None  # its direct light would be in the rest as well
    _, layers, covered = lightmap(tmp_path, objects=("Fold",))
    camera = bpy.context.scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type = "ORTHO"
    bpy.context.scene.collection.objects.link(camera)
    from_above = by_cycles("Fold", ("INDIRECT",))
    # From a camera Cycles bakes the light that such a face has in a render, from above that of its other side.
    bpy.context.scene.render.bake.view_from = "ACTIVE_CAMERA"
    truth = by_cycles("Fold", ("INDIRECT",))
    difference = np.abs(from_above - truth).mean(axis=(0, -1))
    turned = covered & (difference > 0.3 * truth.mean(axis=(0, -1)))
    assert turned.sum() > 100 and off(from_above[0][turned], truth[:, turned])[0] > 0.25
    error, mean = off(layers["rest.diffuse_light"][turned], truth[:, turned])
    # The denoiser spreads the light beside them, thirty times as much; that of their other side would be 3.9 off.
    assert error < 0.4 and abs(mean) < 0.3


def test_the_denoiser_halves_the_error_of_what_bounces(tmp_path):
    corner()
    bpy.context.scene.world = None  # its direct light would be in the rest as well
    _, layers, covered = lightmap(tmp_path, rest_samples=16)
    truth, noisy = by_cycles(light=("INDIRECT",))[:, covered], by_cycles(light=("INDIRECT",), samples=32)[0, covered]
    assert off(layers["rest.diffuse_light"][covered], truth)[0] < 0.5 * off(noisy, truth)[0]


def test_lights_by_themselves_add_up_to_other_powers(tmp_path):
    corner()
    options = {"per_light": True, "rest_samples": 32}
    _, layers, covered = lightmap(tmp_path, **options)
    of_lights = {name.partition("@")[2]: light for name, light in layers.items() if "@" in name}
    assert set(of_lights) == {"Key", "World", "Glowing surfaces"}
    assert rows_of_lights(bpy.context.scene) == len(of_lights)
    assert {light.dtype for light in of_lights.values()} == {np.dtype(np.float16)}
    whole = sum(light.astype(float) for light in of_lights.values())[covered]
    # Half floats have 11 bits, and the seams of each are fitted to a ten-thousandth.
    assert np.abs(whole - layers["ltsh4c.diffuse_light"][covered]).max() < 1e-3 * whole.max()
    of_lights["Key"] = 3.0 * of_lights["Key"]
    bpy.data.objects["Key"].data.energy *= 3.0
    mixed = sum(light.astype(float) for light in of_lights.values())[covered]
    fresh = lightmap(tmp_path / "fresh", **options)[1]["ltsh4c.diffuse_light"][covered]
    assert np.sqrt(np.square(mixed - fresh).mean()) < 0.01 * fresh.mean()
    plain = lightmap(tmp_path / "plain", rest_samples=64)[1]["ltsh4c.diffuse_light"][covered]
    assert abs(mixed.mean() / plain.mean() - 1.0) < 0.01


@pytest.mark.newest
def test_bumps_mirrored_objects_and_tiles_have_the_light_of_cycles(tmp_path):
    corner()
    material, node = principled("Bumps", Base_Color=(0.7, 0.7, 0.7, 1.0), Roughness=1.0)
    add_bump(material.node_tree, node, strength=0.6, scale=3.0)
    bpy.data.objects["Floor"].data.materials[0] = material
    white = principled("Chalk", Base_Color=(0.7, 0.7, 0.7, 1.0), Roughness=1.0)[0]
    add_sphere(white, radius=0.2, name="Mirrored", location=(-0.5, 0.3, 0.4), segments=16, scale=(-1.0, 1.0, 1.0))
    tile = add_plane(white, size=0.6, name="Tile", location=(-0.4, -0.5, 0.1))
    for corner_uv in tile.data.uv_layers.active.uv:
        corner_uv.vector.x += 1.0
    names = "Floor", "Mirrored", "Tile"
    options = {"passes": ("diffuse",), "error": True, "cycles_samples": 64, "sub_samples": 4, "rest_samples": 32}
    options |= {"objects": names, "shadows": "on", "bounces": "on", "view": "above"}
    report, _ = baked(save(tmp_path), tmp_path / "out", **options)
    figures = {one["name"]: tile["errors"]["diffuse"] for one in report["objects"] for tile in one["tiles"].values()}
    assert set(figures) == set(names)
    for name, figure in figures.items():
        # A wrong side, a flipped normal or a tile of its own is off by tens of percent; 32 samples denoised by 1 or 2.
        assert figure["techniques"]["ltsh4c"]["unbiased_error"] < 0.03, name


def test_texels_that_an_edge_of_a_shadow_crosses_have_their_mean(tmp_path):
    start(camera=None)
    white = principled("White", Base_Color=(0.8, 0.8, 0.8, 1.0), Roughness=1.0)[0]
    add_plane(white, size=2.0, name="Floor")
    # A plate a tenth of a millimeter above the floor, whose sides lie .3 and .8 of a texel from the border of a texel.
    left, right = (20.3 / SIZE) * 2.0 - 1.0, (40.8 / SIZE) * 2.0 - 1.0
    corners = [(left, -0.5, 1e-4), (right, -0.5, 1e-4), (right, 0.5, 1e-4), (left, 0.5, 1e-4)]
    add_mesh("Plate", corners, [(0, 1, 2, 3)]).data.materials.append(white)
    _, layers, _ = lightmap(tmp_path, rest_samples=4)
    light = (layers["ltsh4c.diffuse_light"] - layers["rest.diffuse_light"])[24:40].mean(axis=(0, 2)).astype(float)
    assert light[22] < 0.01 * light[19]
    for share, dark, lit in ((0.3, 20, 19), (0.2, 40, 41)):
        # As Cycles, over the middle of the texel. The points there are a sixteenth apart.
        mean = min(max(0.5 + (share - 0.5) / SAMPLED_TEXELS, 0.0), 1.0)
        assert light[dark] == pytest.approx(mean * light[lit], abs=light[lit] / 16.0)


@pytest.mark.parametrize("passes", [("diffuse_light",), ("combined", "diffuse_light")])
def test_a_lightmap_is_compared_with_that_of_cycles(tmp_path, passes):
    """Without the color of the surface, which is red. A texel's center beside its mean: 1 % of a soft light."""
    start()
    add_plane(principled("Red", Base_Color=(0.8, 0.1, 0.1, 1.0), Roughness=0.8)[0], size=2.0, name="Floor")
    options = {"passes": passes, "error": True, "cycles_samples": TRUTH}
    report, _ = baked(save(tmp_path), tmp_path / "out", **options)
    errors = report["objects"][0]["tiles"]["1001"]["errors"]
    assert set(errors) == set(passes)
    assert errors["diffuse_light"]["techniques"]["ltsh4c"]["unbiased_error"] < 0.01
