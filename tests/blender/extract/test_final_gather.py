"""Bounced light gathered from textures of irradiance, beside what Cycles traces."""

import math

import bpy
import numpy as np
import pytest
from scene_parts import (
    add_area_light,
    add_camera,
    add_group,
    add_mesh,
    add_plane,
    add_sphere,
    add_world,
    empty_scene,
    group_with_principled,
    new_light,
    new_material,
    principled,
)

from ltsh_addon.blender.extract.final_gather import FinalGather

SIDE = 32


def box(paint, roof, low=-2.0, high=2.0):
    """A room of 4 m with a hole of 1 m in its roof, whose faces look inside, and a floor by itself."""
    add_plane(paint, size=high - low, name="Floor")
    points = [(x, y, z) for z in (0.0, 2.5) for x, y in ((low, low), (high, low), (high, high), (low, high))]
    walls = add_mesh("Walls", points, [(0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)])
    walls.data.materials.append(paint)
    hole = [(x, y, 2.5) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    add_mesh("Roof", points[4:] + hole, [(0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)]).data.materials.append(
        roof
    )


def plain_room():
    """White walls, a red roof, a lamp."""
    empty_scene()
    add_camera()
    box(principled("White", Base_Color=(0.8,) * 3 + (1.0,))[0], principled("Red", Base_Color=(0.7, 0.2, 0.1, 1.0))[0])
    add_area_light("Key", (0.6, 0.4, 1.8), (0.4, 0.2, 0.0), energy=40.0)


def hostile_room():
    """Metal, alpha, coat, half a metal, groups, glow, instances, a sun, a spot, a world."""
    plain_room()
    grouped, tree, output = new_material("Grouped")
    tree.links.new(add_group(tree, group_with_principled()).outputs[0], output.inputs["Surface"])
    bpy.data.objects["Roof"].material_slots[0].material = grouped
    chrome = principled("Chrome", Metallic=1.0, Roughness=0.3, Base_Color=(0.9, 0.8, 0.6, 1.0))[0]
    add_sphere(chrome, radius=0.4, location=(-0.9, 0.6, 0.5))
    veil = principled("Veil", Alpha=0.5, Base_Color=(0.2, 0.7, 0.3, 1.0))[0]
    add_plane(veil, size=1.0, name="Veil", location=(0.9, -0.9, 0.7))
    lacquer = principled("Lacquer", Coat_Weight=1.0, Roughness=0.6, Base_Color=(0.1, 0.2, 0.8, 1.0))[0]
    add_sphere(lacquer, radius=0.3, name="Ball", location=(0.2, 1.1, 0.3))
    glow = principled("Glow", Emission_Color=(1.0, 0.5, 0.2, 1.0), Emission_Strength=4.0)[0]
    add_sphere(glow, radius=0.15, name="Bulb", location=(-1.2, -1.0, 1.2), segments=12)
    gray = principled("Gray", Metallic=0.3, Roughness=0.9)[0]
    block = add_sphere(gray, radius=0.25, name="Block", location=(1.3, 0.9, 0.3), segments=12)
    shapes = bpy.data.collections.new("Shapes")
    shapes.objects.link(block)
    instancer = bpy.data.objects.new("Copy", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", shapes
    instancer.location = (-2.2, -0.6, 0.0)
    bpy.context.scene.collection.objects.link(instancer)
    new_light("Sun", "SUN", energy=3.0).rotation_euler = (0.3, 0.2, 0.0)
    new_light("Spot", "SPOT", energy=60.0).location = (-0.5, 0.5, 2.2)
    add_world(Color=(0.5, 0.7, 1.0, 1.0), Strength=0.6)


@pytest.fixture
def floor():
    """Bakes the floor: `floor(light, samples, seed)` is its diffuse light (SIDE, SIDE, 3), without color."""

    def baked(light, samples, seed):
        scene, ob = bpy.context.scene, bpy.data.objects["Floor"]
        scene.render.engine, scene.cycles.samples, scene.cycles.seed = "CYCLES", samples, seed
        scene.cycles.use_adaptive_sampling = False
        tree = ob.material_slots[0].material.node_tree
        image = bpy.data.images.new("floor", SIDE, SIDE, float_buffer=True, is_data=True)
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image, tree.nodes.active = image, node
        for other in scene.objects:
            other.select_set(other is ob)
        bpy.context.view_layer.objects.active = ob
        bpy.ops.object.bake(type="DIFFUSE", pass_filter=set(light), margin=0, uv_layer=ob.data.uv_layers[0].name)
        pixels = np.empty(SIDE * SIDE * 4, np.float32)
        image.pixels.foreach_get(pixels)
        tree.nodes.remove(node)
        bpy.data.images.remove(image)
        return pixels.reshape(SIDE, SIDE, 4)[..., :3].astype(float)

    return baked


def gather(samples=32):
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    made = FinalGather.of(scene, scene.view_layers[0], 256)
    assert made.serves(None, samples)
    return made


def root_mean_square(values):
    return math.sqrt(np.square(values).mean())


def test_what_is_gathered_has_half_of_the_noise_of_paths(floor):
    plain_room()
    traced = [floor({"INDIRECT"}, 32, seed) for seed in (1, 2)]
    with gather().gathering(None, has_sky=False):
        gathered = [floor({"DIRECT", "INDIRECT"}, 32, seed) for seed in (1, 2)]
    # Most of the noise left is of specular light, which is traced.
    assert root_mean_square(gathered[0] - gathered[1]) < 0.5 * root_mean_square(traced[0] - traced[1])
    # The noise of both means is .1 %.
    assert np.mean(gathered) == pytest.approx(np.mean(traced), rel=0.01)


@pytest.mark.parametrize("has_sky", [False, True])
def test_what_is_gathered_is_what_cycles_traces(floor, has_sky):
    hostile_room()
    truth = np.mean([floor({"INDIRECT"}, 256, seed) for seed in (1, 2)], axis=0)
    if has_sky:
        lamps = [ob for ob in bpy.data.objects if ob.type == "LIGHT"]
        for lamp in lamps:
            lamp.hide_render = True
        bpy.data.materials["Glow"].node_tree.nodes[-1].inputs["Emission Strength"].default_value = 0.0
        truth += floor({"DIRECT"}, 256, 1)
        for lamp in lamps:
            lamp.hide_render = False
        bpy.data.materials["Glow"].node_tree.nodes[-1].inputs["Emission Strength"].default_value = 4.0
    with gather(128).gathering(None, has_sky):
        gathered = floor({"DIRECT", "INDIRECT"}, 256, 3)
    blocks = [light.reshape(8, SIDE // 8, 8, SIDE // 8, 3).mean(axis=(1, 3)) for light in (gathered, truth)]
    # The texture has 25 texels a metre; light that counts twice, or not at all, would be 5 % and more.
    assert gathered.mean() == pytest.approx(truth.mean(), rel=0.015)
    assert root_mean_square(blocks[0] - blocks[1]) < 0.03 * truth.mean()


def facts():
    """Nodes, links and settings that gathering changes."""
    trees = [material.node_tree for material in bpy.data.materials] + [light.node_tree for light in bpy.data.lights]
    trees += [world.node_tree for world in bpy.data.worlds] + list(bpy.data.node_groups)
    links = [
        sorted(
            (
                link.from_node.name,
                link.from_socket.identifier,
                link.to_node.name,
                link.to_socket.identifier,
                link.is_muted,
            )
            for link in tree.links
        )
        for tree in trees
        if tree is not None
    ]
    lamps = [(ob.name, ob.visible_diffuse, ob.hide_render) for ob in bpy.data.objects if ob.type == "LIGHT"]
    sampled = [material.cycles.emission_sampling for material in bpy.data.materials]
    return links, lamps, sampled, [len(tree.nodes) for tree in trees if tree is not None], len(bpy.data.images)


def test_nothing_stays_changed():
    hostile_room()
    tree = new_material("Muted")[1]
    made = gather()
    noise, shader = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeBsdfDiffuse")
    tree.links.new(noise.outputs[0], shader.inputs["Color"]).is_muted = True
    before = facts()
    with pytest.raises(ZeroDivisionError), made.gathering(None, has_sky=False):
        assert facts() != before
        raise ZeroDivisionError
    assert facts() == before


def test_what_is_hidden_in_the_viewport_is_seen_in_renders(floor):
    plain_room()
    bpy.data.objects["Walls"].hide_set(True)
    bpy.data.objects["Roof"].hide_viewport = True
    closed = bpy.data.collections.new("Closed")
    bpy.context.scene.collection.children.link(closed)
    closed.objects.link(add_plane(bpy.data.materials["White"], size=1.0, name="Shelf", location=(1.0, 1.0, 1.0)))
    bpy.context.scene.collection.objects.unlink(bpy.data.objects["Shelf"])
    bpy.context.view_layer.layer_collection.children["Closed"].hide_viewport = True  # Cycles' bake refuses these
    made = gather()
    assert {ob.name for ob in made.objects} == {"Floor", "Walls", "Roof"}
    with made.gathering(None, has_sky=False):
        assert floor({"DIRECT", "INDIRECT"}, 4, 1).mean() > 0.1


def test_lamps_of_instances_cannot_be_split():
    plain_room()
    lamps = bpy.data.collections.new("Lamps")
    lamps.objects.link(bpy.data.objects["Key"])
    instancer = bpy.data.objects.new("Copy", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", lamps
    bpy.context.scene.collection.objects.link(instancer)
    scene = bpy.context.scene
    assert not FinalGather.of(scene, scene.view_layers[0], 256).serves(None, 1)
