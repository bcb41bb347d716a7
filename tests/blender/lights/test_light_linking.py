"""Lights reach the objects that they reach in Cycles: included, excluded, nested, instanced, of several lights."""

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_instancer, add_lamp_plane, assert_agrees, compare, instance_on_points, into_collection

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


def group(name, *members):
    """A collection with objects and collections."""
    made = bpy.data.collections.new(name)
    for member in members:
        (made.children if isinstance(member, bpy.types.Collection) else made.objects).link(member)
    return made


def receivers_of(light, *members):
    """Give `light` a receiver collection with objects and collections; the state of one inside a list is "exclude"."""
    out = [member[0] for member in members if isinstance(member, list)]
    every = [member[0] if isinstance(member, list) else member for member in members]
    made = light.light_linking.receiver_collection = group(f"Receivers of {light.name}", *every)
    for items, members in ((made.collection_objects, made.objects), (made.collection_children, made.children)):
        for item, member in zip(items, members, strict=True):
            if member in out:
                item.light_linking.link_state = "EXCLUDE"


def two_lights_with_overlapping_sets(light, tiles):
    receivers_of(light, tiles[0], tiles[1])
    other = scene_parts.add_area_light("Fill", location=(0.0, 1.0, 2.0), size=6.0, color=(1.0, 0.2, 0.1))
    receivers_of(other, tiles[1], [tiles[3]])
    scene_parts.add_area_light("Everywhere", location=(0.0, -1.0, 2.0), size=6.0, color=(0.1, 0.2, 1.0))


def linked_mesh_light(light, tiles):
    light.data.energy = 10.0
    lamp = add_lamp_plane(location=(0.0, 0.0, 1.0), rotation=(0.0, 0.0, 0.0))
    receivers_of(lamp, tiles[1], tiles[2])


# Each is called with the light and the four tiles.
CASES = {
    "included": lambda light, t: receivers_of(light, t[0], t[2]),
    "excluded": lambda light, t: receivers_of(light, [t[0]], [t[2]]),
    "both states": lambda light, t: receivers_of(light, t[0], [t[1]]),
    "empty": lambda light, t: receivers_of(light),
    "nested": lambda light, t: receivers_of(light, t[3], group("Outer", group("Inner", t[1]), t[0])),
    "excluded child": lambda light, t: receivers_of(light, t[0], t[2], [group("Child", t[0], t[1])]),
    "last child excluded": lambda light, t: receivers_of(
        light, t[3], group("First", t[0], t[1]), [group("Last", t[0], t[2])]
    ),
    "first child excluded": lambda light, t: receivers_of(
        light, t[3], [group("First", t[0], t[1])], group("Last", t[0], t[2])
    ),
    "overlapping": two_lights_with_overlapping_sets,
    "mesh light": linked_mesh_light,
}


@pytest.mark.parametrize("name", CASES)
def test_linked_lights_light_what_they_light_in_cycles(tmp_path, name):
    CASES[name](*start())
    # Whole tiles are lit or not; a wrong set is off by tens of per cents, the noise of the highlights by one.
    prepared = assert_agrees(tmp_path, samples=512, count=32, tolerance=0.02)
    assert prepared[3] == []


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
    receivers_of(other, [instancers[2]])
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
    instance_on_points(maker, tiles[0])
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
