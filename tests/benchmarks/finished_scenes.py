"""Five scenes with bounces, glass, lamps, a sun and a sky; needs bpy.

python tests/benchmarks/finished_scenes.py NAME FILE.blend
"""

import bpy
import shadow_scenes as shared  # it finds the next one
from shadow_scenes import scene_parts

SIZE = (240, 135)
WHITE, RED, GREEN = (0.75, 0.75, 0.75), (0.65, 0.06, 0.05), (0.12, 0.45, 0.09)


def artist():
    """A gold ball, a glass cylinder and a monkey on a table, under three area lights and a sky."""
    shared._camera((0.0, -6.0, 2.6), (0.0, 0.0, 0.7))
    table = scene_parts.add_plane(shared._matt((0.35, 0.28, 0.22), 0.45), 12.0, "Table")
    assert table
    scene_parts.add_sphere(shared._metal((0.9, 0.65, 0.2), 0.25), 0.7, "Gold", location=(-1.6, 0.2, 0.7))
    bpy.ops.mesh.primitive_cylinder_add(radius=0.5, depth=1.5, vertices=64, location=(1.7, -0.3, 0.76))
    glass = scene_parts.bsdf_material("ShaderNodeBsdfGlass", "Glass", Roughness=0.05, IOR=1.45)[0]
    bpy.context.object.data.materials.append(glass)
    bpy.ops.mesh.primitive_monkey_add(size=1.6, location=(0.1, 0.5, 0.8), rotation=(-0.4, 0.0, 0.2))
    monkey = bpy.context.object
    monkey.modifiers.new("Smooth", "SUBSURF").render_levels = 2
    shared._give(monkey, shared._matt((0.2, 0.35, 0.6), 0.4), smooth=True)
    shared._light("Key", (-3.0, -2.5, 4.0), (0.0, 0.0, 0.5), 300.0, size=1.5, size_y=1.5)
    shared._light("Fill", (3.5, -2.0, 2.5), (0.0, 0.0, 0.5), 80.0, size=2.0, size_y=1.0)
    shared._light("Rim", (1.0, 3.5, 3.0), (0.0, 0.0, 0.5), 200.0, size=1.0, size_y=0.5)
    scene_parts.add_world(Color=(0.5, 0.6, 0.8, 1.0), Strength=0.15)


def _walls(width, depth, height, *, front=False):
    """A room with a red wall on the left and a green one on the right; the front is open."""
    x, y, white = width / 2.0, depth / 2.0, shared._matt(WHITE, 0.6)
    shared._box("Floor", (-x, -y, -0.1), (x, y, 0.0), white)
    shared._box("Ceiling", (-x, -y, height), (x, y, height + 0.1), white)
    shared._box("Back", (-x, y, 0.0), (x, y + 0.1, height), white)
    shared._box("Left", (-x - 0.1, -y, 0.0), (-x, y, height), shared._matt(RED, 0.6))
    shared._box("Right", (x, -y, 0.0), (x + 0.1, y, height), shared._matt(GREEN, 0.6))
    if front:
        shared._box("Front", (-x, -y - 0.1, 0.0), (x, -y, height), white)


def closed():
    """A closed room with a box and a shiny ball, lit by a panel below the ceiling: bounces dominate."""
    _walls(4.0, 6.0, 3.0, front=True)
    shared._camera((0.0, -2.9, 1.5), (0.0, 2.0, 1.2))
    shared._box("Box", (-1.3, 0.6, 0.0), (-0.3, 1.6, 1.5), shared._matt(WHITE, 0.5))
    scene_parts.add_sphere(shared._metal((0.9, 0.9, 0.9), 0.2), 0.5, "Ball", location=(0.9, 0.4, 0.5))
    shared._light("Panel", (0.0, 0.5, 2.95), (0.0, 0.5, 0.0), 60.0, size=1.2, size_y=1.2)


def lamp():
    """A room lit by a glowing bar: a mesh lamp in sight."""
    _walls(4.0, 4.0, 2.6)
    shared._camera((0.0, -5.0, 1.4), (0.0, 1.0, 1.1))
    glow = scene_parts.bsdf_material("ShaderNodeEmission", "Glow", Color=(1.0, 0.75, 0.45, 1.0), Strength=25.0)[0]
    shared._box("Bar", (-1.0, 1.2, 2.1), (1.0, 1.28, 2.18), glow)
    shared._box("Table", (-0.9, 0.2, 0.7), (0.9, 1.2, 0.78), shared._matt((0.4, 0.25, 0.15), 0.3))
    for number in range(4):
        place = (-0.6 + 0.4 * number, 0.6, 0.93)
        scene_parts.add_sphere(shared._matt((0.2 + 0.2 * number, 0.3, 0.6), 0.2 + 0.1 * number), 0.15, f"B{number}",
                               location=place)  # fmt: skip


def studio():
    """Balls of many roughnesses on a sweep under four soft boxes: direct light dominates."""
    shared._camera((0.0, -6.0, 2.0), (0.0, 0.0, 0.8))
    scene_parts.add_plane(shared._matt((0.4, 0.4, 0.42), 0.35), 14.0, "Sweep")
    for number in range(5):
        color, place = (0.8, 0.3 + 0.1 * number, 0.2), (-2.4 + 1.2 * number, 0.2 * number, 0.55)
        make = shared._metal if number % 2 else shared._matt
        scene_parts.add_sphere(make(color, 0.15 + 0.12 * number), 0.55, f"Ball {number}", location=place)
    for number, place in enumerate(((-4, -3, 3.5), (4, -2, 3), (0, 4, 4), (-1, -4, 5))):
        shared._light(f"Box {number}", place, (0.0, 0.0, 0.4), 150.0, size=1.6, size_y=1.0)


def window():
    """A room with a box and balls, lit by the sun and the sky through an opening in its left wall."""
    white, gray = shared._matt(WHITE, 0.6), shared._matt((0.45, 0.42, 0.4), 0.35)
    shared._box("Floor", (-2.0, -2.5, -0.1), (2.0, 2.5, 0.0), shared._matt((0.35, 0.2, 0.1), 0.3))
    shared._box("Ceiling", (-2.1, -2.6, 2.6), (2.1, 2.6, 2.7), white)
    shared._box("Back", (-2.1, 2.5, 0.0), (2.1, 2.6, 2.6), white)
    shared._box("Front", (-2.1, -2.6, 0.0), (2.1, -2.5, 2.6), white)
    shared._box("Right", (2.0, -2.5, 0.0), (2.1, 2.5, 2.6), white)
    for name, low, high in (("Sill", (-2.5, 0.0), (2.5, 0.9)), ("Lintel", (-2.5, 2.2), (2.5, 2.6)),
                            ("Near", (-2.5, 0.9), (-0.6, 2.2)), ("Far", (1.2, 0.9), (2.5, 2.2)),
                            ("Bar", (0.25, 0.9), (0.32, 2.2))):  # fmt: skip
        shared._box(name, (-2.1, *low), (-2.0, *high), white)
    shared._camera((1.4, -2.3, 1.5), (-0.5, 1.2, 0.9))
    shared._box("Table", (-0.9, 0.4, 0.6), (0.6, 1.4, 0.68), gray)
    for x, y in ((-0.85, 0.45), (0.5, 0.45), (-0.85, 1.3), (0.5, 1.3)):
        shared._box(f"Leg {x} {y}", (x, y, 0.0), (x + 0.06, y + 0.06, 0.6), gray)
    for number, (x, y) in enumerate(((-0.5, 0.8), (0.0, 1.1), (0.3, 0.7))):
        make = shared._metal if number == 1 else shared._matt
        scene_parts.add_sphere(make((0.7, 0.3 + 0.2 * number, 0.2), 0.25), 0.16, f"Ball {number}",
                               location=(x, y, 0.84))  # fmt: skip
    sun = bpy.data.lights.new("Sun", "SUN")
    sun.energy, sun.angle = 6.0, 0.02
    scene_parts.link(bpy.data.objects.new("Sun", sun), (0.0, 0.0, 0.0), (0.0, -0.9, -0.15))
    scene_parts.add_world(Color=(0.55, 0.7, 1.0, 1.0), Strength=1.5)


SCENES = {scene.__name__: scene for scene in (artist, studio, lamp, closed, window)}


def build(name, path):
    scene = scene_parts.empty_scene(*SIZE)
    scene.render.engine = "CYCLES"
    SCENES[name]()
    scene_parts.save(path)


if __name__ == "__main__":
    shared.main(__doc__.splitlines()[0], SCENES, build)
