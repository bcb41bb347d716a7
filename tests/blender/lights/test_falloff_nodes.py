"""Light Falloff nodes of area lights and glowing meshes: as bright as in Cycles at every distance."""

import math

import numpy as np
import pytest
import scene_parts
from lit_plane import add_image, add_lamp_plane, assert_agrees, lamp_material, light_tree, start

FALLOFFS = {"Quadratic": (0, 0.0), "Linear": (1, 0.0), "Constant": (2, 0.0), "Quadratic, smooth": (0, 2.0)}


def add_falloff(tree, name, strength=1.0):
    """A Light Falloff node as `name` says; its output."""
    node = tree.nodes.new("ShaderNodeLightFalloff")
    node.inputs["Strength"].default_value, node.inputs["Smooth"].default_value = strength, FALLOFFS[name][1]
    return node.outputs[name.partition(",")[0]]


@pytest.mark.parametrize("name", FALLOFFS)
def test_a_light_is_as_bright_as_in_cycles(tmp_path, name):
    start()
    tree, emission = light_tree(scene_parts.add_area_light(shape="ELLIPSE" if "smooth" in name else "RECTANGLE"))
    tree.links.new(add_falloff(tree, name, 0.7), emission.inputs["Strength"])
    _, _, inventory, warnings = assert_agrees(tmp_path)
    (light,) = inventory.lights
    assert warnings == [] and (light.falloff, light.smooth) == FALLOFFS[name] and not light.children


def test_a_picture_on_a_focused_light_keeps_its_falloff(tmp_path):
    """The falloff is times a number, in a node group, and the color is an image."""
    start()
    tree, emission = light_tree(scene_parts.add_area_light(spread=2.0))
    tree.links.new(add_image(tree, np.random.default_rng(3).random((4, 8, 3))).outputs["Color"], emission.inputs[0])
    group, _, end = scene_parts.new_group({}, {"Strength": "Float"})
    half = group.nodes.new("ShaderNodeMath")
    half.operation, half.inputs[0].default_value = "MULTIPLY", 0.5
    group.links.new(add_falloff(group, "Linear", 3.0), half.inputs[1])
    group.links.new(half.outputs[0], end.inputs[0])
    tree.links.new(scene_parts.add_group(tree, group).outputs[0], emission.inputs["Strength"])
    _, _, inventory, warnings = assert_agrees(tmp_path, samples=1024, count=6, tolerance=4e-3)
    assert warnings == [] and {light.falloff for light in inventory.lights[0].leaves} == {1}


def test_a_glowing_mesh_has_a_falloff_of_its_material(tmp_path):
    start()
    material, emission = lamp_material(strength=1.0)
    tree = material.node_tree
    tree.links.new(add_falloff(tree, "Constant", 20.0), emission.inputs["Strength"])
    add_lamp_plane(material)
    _, _, inventory, _ = assert_agrees(tmp_path)
    assert {light.falloff for light in inventory.lights} == {2}


def test_nodes_are_as_before_after_a_look():
    start()
    tree, emission = light_tree(scene_parts.add_area_light())
    tree.links.new(add_falloff(tree, "Quadratic, smooth"), emission.inputs["Strength"])
    tree.links.new(add_falloff(tree, "Linear"), emission.inputs["Color"])

    def links():
        return sorted((link.from_socket.path_from_id(), link.to_socket.path_from_id()) for link in tree.links)

    before = links()
    scene_parts.prepare()
    smooth = [node.inputs["Smooth"].default_value for node in tree.nodes if "Smooth" in node.inputs]
    assert links() == before and smooth == [2.0, 0.0]


@pytest.mark.parametrize("kind", ["sine", "whole numbers"])
def test_a_falloff_that_is_no_factor_is_named(kind):
    start()
    tree, emission = light_tree(scene_parts.add_area_light("Odd"))
    if kind == "sine":
        node = tree.nodes.new("ShaderNodeMath")
        node.operation = "SINE"
        tree.links.new(add_falloff(tree, "Linear", math.pi / 2.0), node.inputs[0])
    else:
        group, _, end = scene_parts.new_group({}, {"Strength": "Int"})
        group.links.new(add_falloff(group, "Linear", 1.0), end.inputs[0])
        node = scene_parts.add_group(tree, group)
    tree.links.new(node.outputs[0], emission.inputs["Strength"])
    _, _, inventory, warnings = scene_parts.prepare()
    assert sum("'Odd'" in line and "Light Falloff" in line for line in warnings) == 1, warnings
    assert np.allclose(inventory.lights[0].radiance, 100.0 / math.pi / (1.2 * 0.7), rtol=1e-4)
