"""Five scenes in which much of the light is blocked, each in a way of its own; needs bpy.

python tests/benchmarks/shadow_scenes.py NAME FILE.blend
"""

import argparse
import math
import sys
from pathlib import Path

import bpy
import mathutils
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blender" / "helpers")]

import scene_parts  # noqa: E402

SIZE = (320, 180)


def contact(generator):
    """Small parts that lie on a table: shadows end where they touch it."""
    _camera((0.0, -3.2, 1.9), (0.0, 0.1, 0.0))
    scene_parts.add_plane(_matt((0.45, 0.42, 0.4), 0.35), name="Table")
    parts = [
        _mesh_of("cylinder", radius=0.05, depth=0.5, vertices=24),
        _mesh_of("cube", size=0.2),
        _mesh_of("uv_sphere", radius=0.1, segments=32, ring_count=16),
        _mesh_of("torus", major_radius=0.12, minor_radius=0.03),
    ]
    materials = [_matt((0.7, 0.2, 0.1), 0.4), _metal((0.9, 0.8, 0.6), 0.3), _matt((0.1, 0.3, 0.7), 0.25)]
    heights, reach = (0.05, 0.1, 0.1, 0.03), (0.26, 0.15, 0.1, 0.15)
    places = []
    # Faces that coincide would block each other's light.
    while len(places) < 44:
        place, own = generator.uniform((-1.6, -1.0), (1.6, 1.3)), reach[len(places) % 4]
        if all(math.dist(place, other) > own + its for other, its in places):
            places.append((place, own))
    for number, (place, _) in enumerate(places):
        kind = number % 4
        turn = (0.5 * math.pi if kind == 0 else 0.0, 0.0, generator.uniform(0.0, math.pi))
        ob = bpy.data.objects.new(f"Part {number}", parts[kind])
        _give(scene_parts.link(ob, (*place, heights[kind]), turn), materials[number % 3])
    _light("Key", (1.8, -0.6, 2.2), (0.0, 0.0, 0.0), 60.0, size=0.8, size_y=0.5)
    _light("Rim", (-1.0, 2.4, 1.4), (0.0, 0.2, 0.0), 40.0, size=1.4, size_y=0.3)
    _light("Spot", (-2.0, -1.0, 1.8), (0.0, 0.0, 0.0), 15.0, shape="DISK", size=0.25)


def soft(generator):
    """One large soft light over large objects: penumbrae everywhere."""
    _camera((0.0, -6.5, 2.6), (0.0, 0.0, 0.7))
    scene_parts.add_plane(_matt((0.5, 0.5, 0.5), 0.3), size=12.0, name="Floor")
    bpy.ops.mesh.primitive_monkey_add(size=1.6, location=(-1.7, -0.4, 0.75), rotation=(-0.6, 0.0, 0.4))
    _give(bpy.context.object, _metal((0.95, 0.6, 0.4), 0.25), smooth=True)
    # Smooth normals of its 500 faces would stand apart from those of the faces by far.
    rounded = bpy.context.object.modifiers.new("Rounded", "SUBSURF")
    rounded.levels = rounded.render_levels = 2
    scene_parts.add_sphere(_matt((0.2, 0.5, 0.3), 0.2), radius=0.7, location=(0.3, 0.6, 0.7))
    ring = {"major_radius": 0.6, "minor_radius": 0.2}
    bpy.ops.mesh.primitive_torus_add(**ring, location=(1.9, -0.5, 0.6), rotation=(1.2, 0.3, 0.0))
    _give(bpy.context.object, _matt((0.6, 0.2, 0.5), 0.5), smooth=True)
    for number in range(5):
        bpy.ops.mesh.primitive_cylinder_add(radius=0.12, depth=2.4, location=(-3.0 + 1.5 * number, 2.2, 1.2))
        _give(bpy.context.object, _matt((0.7, 0.7, 0.65), 0.6))
    _light("Sky", (0.5, 1.5, 4.0), (0.0, 0.0, 0.0), 700.0, size=5.0, size_y=3.5)


def highlight(generator):
    """The mirror image of a long light in a glossy floor, half blocked by bars."""
    _camera((0.0, -4.5, 1.6), (0.0, 0.6, 0.3))
    scene_parts.add_plane(_matt((0.3, 0.3, 0.32), 0.15), size=10.0, name="Floor")
    scene_parts.add_sphere(_metal((0.8, 0.8, 0.85), 0.12), radius=0.45, location=(-1.1, 0.0, 0.45))
    scene_parts.add_sphere(_metal((0.9, 0.7, 0.3), 0.35), radius=0.45, location=(1.1, 0.0, 0.45))
    for number, (height, width) in enumerate(((0.8, 0.25), (1.3, 0.05), (1.55, 0.02))):
        _box(f"Bar {number}", (-2.6, 1.9, height), (2.6, 1.95, height + width), _matt((0.1, 0.1, 0.1), 0.5))
    _box("Post", (0.1, 1.7, 0.0), (0.2, 1.8, 2.2), _metal((0.7, 0.7, 0.7), 0.4))
    _light("Tube", (0.0, 3.2, 1.3), (0.0, 0.0, 0.4), 120.0, size=3.6, size_y=0.8)


def window(generator):
    """A closed room that has light through the grille of a window only."""
    _camera((1.5, -2.3, 1.7), (-0.6, 0.7, 0.6))
    wall, floor = _matt((0.7, 0.68, 0.62), 0.6), _matt((0.4, 0.25, 0.15), 0.3)
    _box("Floor", (-2.2, -2.6, -0.1), (2.2, 2.2, 0.0), floor)
    _box("Ceiling", (-2.2, -2.6, 2.6), (2.2, 2.2, 2.7), wall)
    _box("Left", (-2.3, -2.6, -0.1), (-2.2, 2.2, 2.7), wall)
    _box("Front", (-2.3, -2.7, -0.1), (2.4, -2.6, 2.7), wall)
    _box("Back", (-2.3, 2.2, -0.1), (2.4, 2.3, 2.7), wall)
    # The right wall around a window of 1.6 x 1.3 m
    for number, (low, high) in enumerate(
        (((-2.7, -0.1), (-0.8, 2.7)), ((0.8, -0.1), (2.3, 2.7)), ((-0.8, -0.1), (0.8, 0.8)), ((-0.8, 2.1), (0.8, 2.7)))
    ):
        _box(f"Right {number}", (2.2, *low), (2.4, *high), wall)
    paint = _matt((0.85, 0.85, 0.85), 0.4)
    for number in range(7):
        y = -0.8 + 0.267 * number
        _box(f"Upright {number}", (2.25, y - 0.03, 0.8), (2.28, y + 0.03, 2.1), paint)
    for number in range(4):
        z = 0.92 + 0.35 * number
        _box(f"Crossbar {number}", (2.25, -0.8, z - 0.02), (2.28, 0.8, z + 0.02), paint)
    _box("Chest", (-0.6, 0.9, 0.0), (0.6, 1.6, 0.7), _matt((0.3, 0.12, 0.06), 0.25))
    scene_parts.add_sphere(_metal((0.9, 0.85, 0.8), 0.2), radius=0.28, location=(0.0, 1.2, 0.98))
    scene_parts.add_sphere(_matt((0.1, 0.35, 0.3), 0.3), radius=0.4, location=(0.7, -0.2, 0.4))
    _light("Sky", (8.0, -0.5, 5.0), (0.0, 0.2, 0.6), 3000.0, size=0.4, size_y=0.3)


def leaves(generator):
    """Ground and a wall in the shadow of leaves, whose outlines are the alpha of an image; the camera sees none."""
    _camera((0.0, -4.6, 1.7), (0.0, 0.6, 0.6))
    scene_parts.add_plane(_matt((0.35, 0.3, 0.22), 0.45), size=12.0, name="Ground")
    _box("Wall", (-4.0, 2.0, 0.0), (4.0, 2.1, 3.0), _matt((0.6, 0.58, 0.55), 0.3))
    scene_parts.add_sphere(_metal((0.9, 0.9, 0.9), 0.25), radius=0.5, location=(-0.9, 0.3, 0.5))
    scene_parts.add_sphere(_matt((0.5, 0.1, 0.1), 0.3), radius=0.4, location=(0.8, -0.2, 0.4))
    leaf = scene_parts.add_plane(_leaf_material(), size=0.42, name="Leaf")
    leaf.visible_camera = False
    for number in range(420):
        ob = leaf if number == 0 else scene_parts.link(bpy.data.objects.new(f"Leaf {number}", leaf.data))
        ob.visible_camera = False
        ob.location = generator.uniform((-2.8, -1.8, 1.5), (2.8, 1.4, 2.5))
        ob.rotation_euler = generator.uniform((-0.9, -0.9, 0.0), (0.9, 0.9, 6.3))
    _light("Sun", (1.2, -1.2, 5.0), (0.0, 0.3, 0.0), 500.0, shape="DISK", size=0.9)
    _light("Sky", (-1.5, -0.5, 4.2), (0.0, 0.5, 0.3), 250.0, size=2.5, size_y=2.0)


def _leaf_material(size=64):
    material, node = scene_parts.principled("Leaf", Roughness=0.5, Base_Color=(0.1, 0.4, 0.05, 1.0))
    x, y = (np.mgrid[0:size, 0:size] + 0.5) / size
    pixels = np.full((size, size, 4), 0.5, np.float32)
    across = np.abs(y - 0.5) / np.maximum(0.32 * np.sin(math.pi * np.clip(x, 0.0, 1.0)) ** 0.8, 1e-6)
    holes = np.sin(9.0 * math.pi * x) * np.sin(7.0 * math.pi * y) > 0.75
    pixels[..., 3] = (across < 1.0) & ~holes
    image = bpy.data.images.new("Leaf", size, size, alpha=True, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    material.node_tree.links.new(texture.outputs["Alpha"], node.inputs["Alpha"])
    return material


SCENES = {scene.__name__: scene for scene in (contact, soft, highlight, window, leaves)}


def build(name: str, path: Path) -> None:
    """Save the scene `name` as `path`."""
    scene = scene_parts.empty_scene(*SIZE)
    scene.render.engine = "CYCLES"
    SCENES[name](np.random.default_rng(1))
    scene_parts.save(path)


def _camera(place, target):
    camera = scene_parts.add_camera(place, _toward(place, target))
    camera.data.lens = 35.0


def _toward(place, target):
    """Angles that turn the -z axis from `place` to `target`."""
    return (mathutils.Vector(target) - mathutils.Vector(place)).to_track_quat("-Z", "Y").to_euler()


def _light(name, place, target, power, **settings):
    light = scene_parts.add_area_light(name, place, _toward(place, target), energy=power, **settings)
    light.visible_camera = False


def _matt(color, roughness):
    return scene_parts.principled("Matt", Base_Color=(*color, 1.0), Roughness=roughness)[0]


def _metal(color, roughness):
    return scene_parts.principled("Metal", Base_Color=(*color, 1.0), Roughness=roughness, Metallic=1.0)[0]


def _give(ob, material, smooth=False):
    """Give the object, not its mesh, the material."""
    if not ob.data.materials:
        ob.data.materials.append(None)
    ob.material_slots[0].link = "OBJECT"
    ob.material_slots[0].material = material
    if smooth:
        ob.data.polygons.foreach_set("use_smooth", [True] * len(ob.data.polygons))


def _mesh_of(kind, **settings):
    """The mesh of a primitive, smooth where it is round, whose object is removed."""
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**settings)
    ob = bpy.context.object
    mesh = ob.data
    mesh.materials.append(None)
    mesh.polygons.foreach_set("use_smooth", [kind in ("uv_sphere", "torus")] * len(mesh.polygons))
    bpy.data.objects.remove(ob)
    return mesh


def _box(name, low, high, material):
    """A box with sides along the axes between two corners."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    ob = scene_parts.add_mesh(name, corners, faces)
    ob.data.materials.append(material)
    return ob


def main(description: str, names, build) -> None:
    """Build the scene that the command line names."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("name", choices=names)
    parser.add_argument("path", type=Path)
    options = parser.parse_args()
    build(options.name, options.path)


if __name__ == "__main__":
    main(__doc__.splitlines()[0], SCENES, build)
