"""Lights reach the objects that they reach in Cycles: included, excluded, nested, instanced, of several lights."""

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_instancer, add_lamp_plane, assert_agrees, compare, into_collection

TILES = 4


def start():
    """A row of tiles seen from above; (light, tiles)."""
    scene_parts.empty_scene(8 * TILES, 8)
    scene_parts.add_top_camera(2.0 * TILES)
    material = scene_parts.principled("Tile", Roughness=0.45)[0]
    light = scene_parts.add_area_light("Key", location=(0.0, 0.0, 2.0), rotation=(0.0, 0.0, 0.0), size=6.0)
    tiles = [
        scene_parts.add_plane(material, 1.5, f"Tile {k}", location=(2.0 * k - TILES + 1.0, 0.0, 0.0))
        for k in range(TILES)
    ]
    return light, tiles


def receivers_of(light, *objects, children=()):
    """Give `light` a receiver collection with `objects` and child collections; the collection."""
    collection = bpy.data.collections.new(f"Receivers of {light.name}")
    for ob in objects:
        collection.objects.link(ob)
    for child in children:
        collection.children.link(child)
    light.light_linking.receiver_collection = collection
    return collection


def exclude(collection, *names):
    """Set the items `names` of a receiver collection to "exclude"."""
    for item, ob in zip(collection.collection_objects, collection.objects, strict=True):
        if ob.name in names:
            item.light_linking.link_state = "EXCLUDE"
    for item, child in zip(collection.collection_children, collection.children, strict=True):
        if child.name in names:
            item.light_linking.link_state = "EXCLUDE"


def lit(inventory, *names):
    """Whether the light `inventory.lights[0]` lights the objects `names`."""
    (light, *_) = inventory.lights
    numbers = [bpy.data.objects[name].get("ltsh_receiver", 0) for name in names]
    return [light.receivers is None or number in light.receivers for number in numbers]


def included_tile():
    light, tiles = start()
    receivers_of(light, tiles[0], tiles[2])


def excluded_tile():
    light, tiles = start()
    exclude(receivers_of(light, tiles[0], tiles[2]), "Tile 0", "Tile 2")


def both_states():
    light, tiles = start()
    exclude(receivers_of(light, tiles[0], tiles[1]), "Tile 1")


def empty_collection():
    receivers_of(start()[0])


def nested_collections():
    light, tiles = start()
    outer, inner = (bpy.data.collections.new(name) for name in ("Outer", "Inner"))
    outer.children.link(inner)
    outer.objects.link(tiles[0])
    inner.objects.link(tiles[1])
    receivers_of(light, tiles[3], children=[outer])


def excluded_child_against_included_item():
    light, tiles = start()
    child = bpy.data.collections.new("Child")
    child.objects.link(tiles[0])
    child.objects.link(tiles[1])
    exclude(receivers_of(light, tiles[0], tiles[2], children=[child]), "Child")


def children_that_disagree(first, last):
    light, tiles = start()
    children = [bpy.data.collections.new(name) for name in ("First", "Last")]
    for child in children:
        child.objects.link(tiles[0])
    children[0].objects.link(tiles[1])
    children[1].objects.link(tiles[2])
    exclude(receivers_of(light, tiles[3], children=children), *(["First"] * first + ["Last"] * last))


def last_child_excluded():
    children_that_disagree(False, True)


def first_child_excluded():
    children_that_disagree(True, False)


def two_lights_with_overlapping_sets():
    light, tiles = start()
    receivers_of(light, tiles[0], tiles[1])
    other = scene_parts.add_area_light("Fill", location=(0.0, 1.0, 2.0), size=6.0, color=(1.0, 0.2, 0.1))
    exclude(receivers_of(other, tiles[1], tiles[3]), "Tile 3")
    scene_parts.add_area_light("Everywhere", location=(0.0, -1.0, 2.0), size=6.0, color=(0.1, 0.2, 1.0))


def linked_mesh_light():
    light, tiles = start()
    light.data.energy = 10.0
    lamp = add_lamp_plane(location=(0.0, 0.0, 1.0), rotation=(0.0, 0.0, 0.0))
    receivers_of(lamp, tiles[1], tiles[2])


CASES = [
    included_tile,
    excluded_tile,
    both_states,
    empty_collection,
    nested_collections,
    excluded_child_against_included_item,
    last_child_excluded,
    first_child_excluded,
    two_lights_with_overlapping_sets,
    linked_mesh_light,
]


@pytest.mark.parametrize("build", CASES, ids=lambda build: build.__name__)
def test_linked_lights_light_what_they_light_in_cycles(tmp_path, build):
    build()
    # Whole tiles are lit or not; a wrong set is off by tens of per cents, the noise of the highlights by one.
    prepared = assert_agrees(tmp_path, samples=512, count=32, tolerance=0.02)
    assert prepared[3] == []


def test_the_states_are_understood_as_stated():
    both_states()
    assert lit(scene_parts.prepare()[2], "Tile 0", "Tile 1", "Tile 2") == [True, False, False]
    excluded_tile()
    assert lit(scene_parts.prepare()[2], "Tile 0", "Tile 1") == [False, True]
    nested_collections()
    assert lit(scene_parts.prepare()[2], "Tile 0", "Tile 1", "Tile 2", "Tile 3") == [True, True, False, True]


def instanced(k, tiles, nested=False):
    """Replace tile `k` by an instance of it; the instancer."""
    place = tuple(tiles[k].location)
    tiles[k].location = (0.0, 0.0, 0.0)
    collection = into_collection(f"Of tile {k}", tiles[k])
    if nested:
        collection = into_collection(f"Around tile {k}", add_instancer(collection, f"Inner {k}"))
    return add_instancer(collection, f"Instancer {k}", location=place)


@pytest.mark.parametrize("nested", [False, True])
def test_instances_follow_their_instancer_where_it_is_linked(tmp_path, nested):
    """Listed are: tile 0 itself, the instancer of tile 1, tile 2 itself while its instancer is listed by another light,
    nothing of tile 3."""
    light, tiles = start()
    instancers = [instanced(k, tiles, nested) for k in range(TILES)]
    receivers_of(light, tiles[0], instancers[1], tiles[2])
    other = scene_parts.add_area_light("Fill", location=(0.0, 1.0, 2.0), size=6.0, color=(1.0, 0.2, 0.1), energy=10.0)
    exclude(receivers_of(other, instancers[2]), "Instancer 2")
    prepared = assert_agrees(tmp_path, samples=128, count=32, tolerance=6e-3)
    ((surface, _, _),) = scene_parts.sample(tmp_path, prepared)[0]
    key = next(light for light in prepared[2].lights if light.name == "Key")
    reached = np.isin(surface.receiver, key.receivers)
    tile = np.floor((surface.position[:, 0] + TILES) / 2.0).astype(int)
    assert [bool(reached[tile == k].all()) for k in range(TILES)] == [True, True, False, False]
    assert [bool(reached[tile == k].any()) for k in range(TILES)] == [True, True, False, False]


def test_geometry_nodes_instances_follow_the_object_that_makes_them(tmp_path):
    light, tiles = start()
    maker = scene_parts.add_mesh("Maker", [(-3.0, 0.0, 0.0), (-1.0, 0.0, 0.0)], [])
    tree = bpy.data.node_groups.new("Instances", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    nodes = [tree.nodes.new(kind) for kind in ("NodeGroupInput", "GeometryNodeInstanceOnPoints", "NodeGroupOutput")]
    info = tree.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value = tiles[0]
    info.inputs["As Instance"].default_value = True
    tree.links.new(nodes[0].outputs[0], nodes[1].inputs["Points"])
    tree.links.new(info.outputs["Geometry"], nodes[1].inputs["Instance"])
    tree.links.new(nodes[1].outputs[0], nodes[2].inputs[0])
    maker.modifiers.new("Instances", "NODES").node_group = tree
    for k in (0, 1):
        tiles[k].location = (50.0, 0.0, 0.0)
    receivers_of(light, maker, tiles[2])
    prepared = assert_agrees(tmp_path, samples=128, count=32, tolerance=6e-3)
    images = scene_parts.reference(tmp_path, prepared, 16)["diffuse"].mean(axis=0)
    assert [bool(images[4, 8 * k + 4].any()) for k in range(TILES)] == [True, True, True, False]


def test_an_unlinked_scene_has_no_receiver_sets(tmp_path):
    start()
    bpy.data.objects["Tile 0"]["ltsh_receiver"] = 7  # left there by somebody
    errors, prepared = compare(tmp_path, samples=16)
    ((surface, _, _),) = scene_parts.sample(tmp_path, prepared)[0]
    assert prepared[2].lights[0].receivers is None and not surface.receiver.any() and errors
