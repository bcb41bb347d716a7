"""Scenes for the tests of baking, and bakes of them through real children."""

from __future__ import annotations

import scene_parts
from material_scenes import Build
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
    """Report and layers by file name, row 0 on top; without shadows unless asked for."""
    values = {"size": (SIZE, SIZE), "margin": 0, "shadows": "off", **options}
    report = bake_scene(BakeOptions(scene=path, output=output, **values))
    return report, {file.name: imaging.read_layers(file) for file in sorted(output.glob("*.exr"))}


def textured_scene():
    """A sphere of metal and a plane whose colors, roughness and normals come from textures, one in a node group."""
    start(camera=(0.0, -3.0, 3.0))
    scene_parts.add_area_light("Fill", (-1.5, 0.5, 1.2), (0.2, -0.8, 0.3), shape="DISK", energy=40.0)
    add_sphere(principled("Metal", Metallic=1.0, Roughness=0.7)[0], radius=0.5, location=(0.0, 0.0, 0.6), segments=48)
    made = Build("Rough")
    noise = made.new("ShaderNodeTexNoise", Scale=0.7, Detail=0.0)
    rough = made.shader("BsdfPrincipled", Roughness=0.5)

    def fill():
        inner, texture = made.shader("BsdfPrincipled"), made.new("ShaderNodeTexWave", Scale=0.2, Detail=0.0)
        inner.node.distribution = "MULTI_GGX"
        made.link(texture.outputs["Color"], inner.node.inputs["Base Color"])
        return inner

    made.link(noise.outputs[0], rough.node.inputs["Roughness"])
    made.link(noise.outputs["Color"], rough.node.inputs["Base Color"])
    made.show(made.mix(0.5, rough, *made.group(fill)))
    bump = scene_parts.add_bump(made.tree, rough.node, strength=0.2, scale=0.7)
    bump.inputs["Height"].links[0].from_node.inputs["Detail"].default_value = 0.0
    add_plane(made.material, size=3.0)
