"""Scenes for the tests of baking, and bakes of them through real children."""

from __future__ import annotations

import bpy
import scene_parts
from scene_parts import add_plane, add_sphere, principled

from ltsh_addon import imaging
from ltsh_addon.pipeline import BakeOptions, bake_scene

SIZE = 64


def start(light=True, camera=(0.0, -3.0, 2.0)):
    scene_parts.empty_scene()
    if light:
        scene_parts.add_area_light("Key")
    if camera:
        scene_parts.add_camera(camera)


def save(folder):
    return scene_parts.save(folder / "scene.blend")


def baked(path, output, **options):
    """Report and layers by file name, row 0 on top."""
    values = {"size": (SIZE, SIZE), "margin": 0, **options}
    report = bake_scene(BakeOptions(scene=path, output=output, **values))
    return report, {file.name: imaging.read_layers(file) for file in sorted(output.glob("*.exr"))}


def textured_scene():
    """A sphere of metal and a plane whose colors, roughness and normals come from textures, one in a node group."""
    start(camera=(0.0, -3.0, 3.0))
    scene_parts.add_area_light("Fill", (-1.5, 0.5, 1.2), (0.2, -0.8, 0.3), shape="DISK", energy=40.0)
    add_sphere(principled("Metal", Metallic=1.0, Roughness=0.7)[0], radius=0.5, location=(0.0, 0.0, 0.6), segments=48)
    material, node = principled("Rough", Roughness=0.5)
    tree = material.node_tree
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 0.7, 0.0
    group = bpy.data.node_groups.new("Group", "ShaderNodeTree")
    group.interface.new_socket("BSDF", in_out="OUTPUT", socket_type="NodeSocketShader")
    inner = group.nodes.new("ShaderNodeBsdfPrincipled")
    texture = group.nodes.new("ShaderNodeTexWave")
    texture.inputs["Scale"].default_value, texture.inputs["Detail"].default_value = 0.2, 0.0
    group.links.new(texture.outputs["Color"], inner.inputs["Base Color"])
    group.links.new(inner.outputs[0], group.nodes.new("NodeGroupOutput").inputs[0])
    outer, mix = tree.nodes.new("ShaderNodeGroup"), tree.nodes.new("ShaderNodeMixShader")
    outer.node_tree = group
    tree.links.new(noise.outputs[0], node.inputs["Roughness"])
    tree.links.new(noise.outputs["Color"], node.inputs["Base Color"])
    tree.links.new(node.outputs[0], mix.inputs[1])
    tree.links.new(outer.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    scene_parts.add_bump(tree, node, strength=0.2, scale=0.7).inputs["Height"].links[0].from_node.inputs[
        "Detail"
    ].default_value = 0.0
    add_plane(material, size=3.0)
