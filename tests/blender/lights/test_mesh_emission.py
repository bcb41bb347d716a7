"""What shaders of emissive meshes are worth: mixes, sums, groups, sides, textures."""

import numpy as np
import pytest
import scene_parts
from lit_plane import add_image, add_lamp_ball, add_lamp_plane, assert_agrees, lamp_material, start
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
