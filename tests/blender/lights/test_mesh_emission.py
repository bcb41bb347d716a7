"""What shaders of emissive meshes are worth: mixes, sums, groups, sides, textures."""

import numpy as np
import pytest
import scene_parts
from lit_plane import (
    LAMP_CORNERS,
    add_image,
    add_lamp,
    add_lamp_ball,
    add_lamp_plane,
    assert_agrees,
    lamp_material,
    start,
)
from material_scenes import Build

from ltsh_addon.blender.lights import meshes

# A ball of 6 segments and 3 rings.
FACES_OF_THE_BALL = 18


def test_emission_through_mixes_sums_and_groups_is_what_cycles_sees(tmp_path):
    start()
    made = Build("Mixed")
    warm, blue = made.shader("Emission"), made.shader("Emission", Color=(0.0, 0.0, 4.0, 1.0))
    made.link(made.shader("Blackbody", Temperature=3000.0), warm.node.inputs["Color"])
    made.link(made.product(made.value(5.0), 3.0), warm.node.inputs["Strength"])
    add_lamp_plane(made.show(made.add(made.mix(0.25, made.shader("BsdfDiffuse"), warm), blue)))
    inventory = assert_agrees(tmp_path)[2]
    # Cycles' black body of 3000 K is (1.77, 0.84, 0.27) in the linear colors of Rec.709.
    assert np.allclose(
        inventory.lights[0].radiance, (0.25 * 15 * 1.77, 0.25 * 15 * 0.84, 0.25 * 15 * 0.27 + 4), rtol=0.02
    )


def test_a_principled_surface_that_emits_is_a_light(tmp_path):
    start()
    material, _ = scene_parts.principled("Screen", Emission_Color=(0.2, 1.0, 0.4, 1.0), Emission_Strength=15.0)
    add_lamp_plane(material)
    _, _, inventory, warnings = assert_agrees(tmp_path)
    assert np.allclose(inventory.lights[0].radiance, (3.0, 15.0, 6.0), rtol=1e-4)
    assert not any("Screen" in line for line in warnings), warnings


@pytest.mark.parametrize("sampling", ["NONE", "AUTO", "FRONT", "BACK", "FRONT_BACK"])
def test_how_cycles_samples_the_emission_changes_nothing(tmp_path, sampling):
    start()
    material, _ = lamp_material()
    material.cycles.emission_sampling = sampling
    add_lamp_plane(material)
    inventory = assert_agrees(tmp_path, samples=128, tolerance=5e-3)[2]
    assert len(inventory.lights) == 2


def test_emission_of_one_side_only(tmp_path):
    start()
    made = Build("Lamp")
    emission = made.shader("Emission", Color=(1.0, 0.5, 0.2, 1.0))
    backfacing = made.new("ShaderNodeNewGeometry").outputs["Backfacing"]
    made.link(made.product(backfacing, 20.0), emission.node.inputs["Strength"])
    add_lamp_plane(made.show(emission))
    (light,) = assert_agrees(tmp_path)[2].lights
    assert light.direction[2] < 0.0


def test_a_textured_screen_becomes_patches(tmp_path):
    start()
    material, node = lamp_material()
    pixels = np.random.default_rng(5).random((4, 8, 3)) ** 3
    tree = material.node_tree
    tree.links.new(add_image(tree, pixels).outputs["Color"], node.inputs["Color"])
    add_lamp_plane(material)
    _, _, inventory, warnings = assert_agrees(tmp_path, samples=1024, count=8)
    assert warnings == [] and len(inventory.lights) == 2
    assert 32 <= sum(len(light.leaves) for light in inventory.lights) <= 64
    total = sum(
        4.0 * np.linalg.norm(np.cross(light.half_u, light.half_v)) * light.radiance for light in inventory.lights
    )
    # Both sides of 0.6 square meters; patches may leave 2 %.
    assert np.allclose(total, 2.0 * 0.6 * 20.0 * pixels.mean(axis=(0, 1)), rtol=0.02)


def test_a_texture_over_many_faces_is_shaded_as_its_mean(monkeypatch):
    monkeypatch.setattr(meshes, "MOST_RENDERED_POLYGONS", 8)
    start()
    material, node = lamp_material()
    tree = material.node_tree
    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs[0], node.inputs["Strength"])
    add_lamp_ball(material)
    _, _, inventory, warnings = scene_parts.prepare()
    assert len(inventory.lights) == FACES_OF_THE_BALL and any("'Lamp'" in line and "mean" in line for line in warnings)
    assert len({tuple(light.radiance) for light in inventory.lights}) == 1


def _add_screens(materials, links=()):
    """Two lamp planes as one mesh: face 0 has the last of `materials`, the other the first. `links`: slots whose
    material is linked to the object."""
    corners = [(x + shift, y, z) for shift in (0.0, 2.0) for x, y, z in LAMP_CORNERS]
    ob = add_lamp(corners, [(0, 1, 2, 3), (4, 5, 6, 7)], materials[0])
    for material in materials[1:]:
        ob.data.materials.append(material)
    for slot in links:
        ob.material_slots[slot].link = "OBJECT"
        ob.material_slots[slot].material, ob.data.materials[slot] = materials[slot], materials[0]
    ob.data.polygons[0].material_index = len(materials) - 1
    uv = ob.data.uv_layers.new(name="UVMap")
    uv.data.foreach_set("uv", np.array([0, 0, 1, 0, 1, 1, 0, 1] * 2, dtype=np.float32))
    return ob


def _textured_lamp(pixels, name="Lamp"):
    material, node = lamp_material(name)
    tree = material.node_tree
    tree.links.new(add_image(tree, pixels).outputs["Color"], node.inputs["Color"])
    return material


@pytest.mark.newest
@pytest.mark.parametrize(("count", "links"), [(2, ()), (3, ()), (2, (1,))], ids=["second", "third", "of the object"])
def test_a_textured_face_shines_in_any_slot(count, links):
    start()
    pixels = np.random.default_rng(5).random((2, 2, 3))
    plain = [scene_parts.principled("Plain")[0], *[None] * (count - 2)]
    _add_screens([*plain, _textured_lamp(pixels)], links)
    lights = scene_parts.prepare()[2].lights
    assert len(lights) == 2 and all(light.center[0] < 1.0 for light in lights)
    # Texels as large as a quarter of the face: patches of one radiance, so their mean is that of the picture.
    assert np.allclose([light.radiance for light in lights], 20.0 * pixels.mean(axis=(0, 1)), rtol=1e-2)


@pytest.mark.newest
def test_a_pane_close_before_a_textured_screen_does_not_darken_it():
    start()
    ob = _add_screens([scene_parts.principled("Pane")[0], _textured_lamp(np.full((2, 2, 3), 0.5))])
    for vertex in list(ob.data.vertices)[4:]:
        vertex.co.x, vertex.co.z = vertex.co.x - 2.0, 5e-4
    assert np.allclose([light.radiance for light in scene_parts.prepare()[2].lights], 10.0, rtol=1e-3)


@pytest.mark.newest
def test_each_material_of_many_textured_faces_has_its_mean(monkeypatch):
    """Also a material whose faces are the smallest."""
    monkeypatch.setattr(meshes, "MOST_RENDERED_POLYGONS", 1)
    monkeypatch.setattr(meshes, "STAND_INS", 1)
    start()
    ob = _add_screens([_textured_lamp(np.full((1, 1, 3), value), f"Of {value}") for value in (0.1, 0.9)])
    for vertex in list(ob.data.vertices)[:4]:
        vertex.co *= 0.1
    lights = scene_parts.prepare()[2].lights
    assert sorted(light.radiance[0] for light in lights) == pytest.approx([2.0, 2.0, 18.0, 18.0], rel=1e-3)


@pytest.mark.newest
def test_a_textured_face_that_emits_nothing_is_named():
    start()
    add_lamp_plane()
    add_lamp_plane(_textured_lamp(np.zeros((2, 2, 3)), "Unlit"), "Screen")
    (line,) = scene_parts.prepare()[3]
    assert "'Screen'" in line and "'Unlit'" in line and "black" in line, line


@pytest.mark.newest
@pytest.mark.parametrize("is_textured", [False, True])
def test_with_shadows_a_transparent_face_gives_the_share_that_it_emits(is_textured):
    """0.3 of the emission, 0.7 of what is behind: as in Cycles, where nothing is made opaque for shadow rays."""
    start()
    veil = Build("Veil")
    emission = veil.shader("Emission", Strength=20.0)
    if is_textured:
        veil.link(add_image(emission.node.id_data, np.full((2, 2, 3), 0.5)).outputs["Color"], emission.node.inputs[0])
    add_lamp_plane(veil.show(veil.mix(0.3, veil.clear(), emission)))
    lights = scene_parts.prepare(with_occluders=True)[2].lights
    assert np.allclose([light.radiance for light in lights], 3.0 if is_textured else 6.0, rtol=1e-3)
