"""Scenes that nobody meant: broken, empty, huge or odd. Each function builds one in the running Blender."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import scene_parts
from scene_parts import add_area_light, add_mesh, add_plane

NAN, INF = float("nan"), float("inf")
MARK = "LTSH_SCRIPT_RAN"
LONGEST = "木漏れ日" * 5  # 60 bytes in UTF-8: Blender's names have 63 at most (255 since 5.0)


def plain(camera=True, light=True, plane=True):
    """A metal plane, an area light, a camera from above, 16 x 12 pixels."""
    scene = scene_parts.empty_scene(16, 12)
    if plane:
        scene_parts.add_plane(scene_parts.principled(Metallic=1.0, Roughness=0.4)[0])
    if light:
        scene_parts.add_area_light("Key")
    if camera:
        scene_parts.add_top_camera()
    return scene


def with_light(**changes):
    """The plain scene, its light changed."""
    plain()
    for name, value in changes.items():
        setattr(bpy.data.lights["Key"], name, value)


def with_more(add, **settings):
    """The plain scene, and what a function of scene_parts adds to it."""
    plain()
    add(**settings)


def placed(name, attribute, *values):
    """The plain scene with another location or scale of an object."""
    plain()
    setattr(bpy.data.objects[name], attribute, values)


def other_lights_only():
    plain(light=False)
    scene_parts.link(scene_parts.new_light("Sun", "SUN"))


def empty_meshes():
    plain()
    scene_parts.add_mesh("Empty", [], [])
    scene_parts.add_mesh("Edge", [(0, 0, 1), (1, 0, 1)], [])


def one_pixel():
    """Blender's smallest picture is 4 x 4: at a quarter of it one pixel."""
    scene = plain()
    scene.render.resolution_x = scene.render.resolution_y = 4
    scene.render.resolution_percentage = 25


def places_of_lights(count):
    """Where `many_lights` puts them, (count, 3) m: about 1.5 m high, no two in one plane."""
    across = np.random.default_rng(1).uniform(-2.0, 2.0, (count, 2))
    return np.column_stack([across, 1.5 + 1e-5 * np.arange(count)])


def many_lights(count):
    """Small lights of 0.01 W that shine down on a white diffuse plane."""
    scene = plain(light=False)
    scene.render.resolution_x, scene.render.resolution_y = 8, 6
    principled = bpy.data.materials[0].node_tree.nodes["Principled BSDF"]
    principled.inputs["Metallic"].default_value = 0.0
    principled.inputs["Base Color"].default_value = 1.0, 1.0, 1.0, 1.0
    data = bpy.data.lights.new("Many", "AREA")
    data.shape, data.size, data.energy = "SQUARE", 0.02, 0.01
    for number, place in enumerate(places_of_lights(count)):
        scene_parts.link(bpy.data.objects.new(f"Many {number}", data), place)


def path_as_name():
    plain()
    bpy.data.objects["Plane"].name = "../../x"
    bpy.data.objects["Key"].name = "../../light"
    bpy.context.scene.camera.name = "../../camera"


def newline_in_a_name():
    plain()
    bpy.data.objects["Plane"].name = "two\nlines\t\x07"
    light = bpy.data.objects["Key"]
    light.name, light.data.size = "Key\nLight", 0.0
    scene_parts.add_area_light("Other")


def long_names():
    plain()
    bpy.data.objects["Plane"].name = LONGEST
    bpy.data.materials[0].name = "x" * 63
    light = bpy.data.objects["Key"]
    light.name, light.lightgroup = LONGEST, "x" * 63
    scene_parts.add_area_light("Other", (-0.9, 0.2, 1.5)).lightgroup = "a.b/../@\\"


def no_uv_map():
    plain()
    layers = bpy.data.objects["Plane"].data.uv_layers
    layers.remove(layers[0])


def uv_that_is_no_number():
    plain()
    layer = bpy.data.objects["Plane"].data.uv_layers[0]
    layer.data.foreach_set("uv", np.array([NAN, 0, 1, 0, INF, 1, 0, 1], dtype=np.float32))


def missing_files():
    plain()
    texture = bpy.data.images.new("Lost picture", 4, 4)
    texture.source, texture.filepath = "FILE", "//nowhere/lost.png"
    tree = bpy.data.materials[0].node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = texture
    principled = next(each for each in tree.nodes if each.type == "BSDF_PRINCIPLED")
    tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])


def lost_library():
    """An object of another file, which then is no more."""
    plain()
    path = Path(bpy.app.tempdir) / "props.blend"
    bpy.data.libraries.write(str(path), {bpy.data.objects.new("Prop", bpy.data.meshes.new("Prop"))})
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.objects = ["Prop"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    path.unlink()


def volume():
    plain()
    scene_parts.link(bpy.data.objects.new("Smoke", bpy.data.volumes.new("Smoke")))


def scripts():
    """A text that registers itself and a driver that is Python: both leave a mark where they run."""
    plain()
    code = f"import os\nopen(os.environ['{MARK}'], 'a').write('script ')\n"
    text = bpy.data.texts.new("Run me.py")
    text.write(code)
    text.use_module = True
    curve = bpy.data.objects["Plane"].driver_add("location", 2)
    curve.driver.expression = f"len(open(__import__('os').environ['{MARK}'], 'a').name) * 0.0"


# Scenes of one line; the others are functions of their names.
SCENES = {
    "no_camera": lambda: plain(camera=False),
    "no_light": lambda: plain(light=False),
    "nothing_at_all": lambda: plain(camera=False, light=False, plane=False),
    "no_object": lambda: plain(plane=False),
    "light_of_no_size": lambda: with_light(size=0.0, size_y=0.0),
    "second_light_of_no_size": lambda: with_more(add_area_light, name="Dot", size=0.0, size_y=0.0),
    "light_scaled_to_nothing": lambda: placed("Key", "scale", 0.0, 0.0, 0.0),
    "light_without_power": lambda: with_light(energy=0.0),
    "light_of_negative_power": lambda: with_light(energy=-50.0),
    "light_of_endless_power": lambda: with_light(energy=INF),
    "light_of_power_that_is_no_number": lambda: with_light(energy=NAN),
    # Blender keeps what a driver or a simulation put there.
    "light_that_is_nowhere": lambda: placed("Key", "location", NAN, 0.2, 1.5),
    "second_light_that_is_nowhere": lambda: with_more(add_area_light, name="Lost", location=(INF, 0.0, 0.0)),
    "object_that_is_nowhere": lambda: with_more(add_plane, name="Lost", location=(NAN, NAN, NAN)),
    "object_of_endless_size": lambda: with_more(add_plane, name="Lost", scale=(INF, 1.0, 1.0)),
    "object_of_no_size": lambda: with_more(add_plane, name="Flat", scale=(0.0, 0.0, 0.0)),
    "camera_that_is_nowhere": lambda: placed("Camera", "location", NAN, 0.0, 5.0),
    "vertices_that_are_nowhere": lambda: with_more(
        add_mesh, name="Torn", vertices=[(NAN, 0, 1), (1, 0, 1), (0, 1, 1)], faces=[(0, 1, 2)]
    ),
    "far_away": lambda: with_more(add_plane, name="Far", location=(1e30, 1e30, -1e30), size=1e20),
}
