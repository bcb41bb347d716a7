"""Lights with nodes in the viewport: a lamp of a file (IES) is shown by itself, edited, undone, and beside numpy; then
a ball and an area light by the place in the world, and a point by its normal.

To be opened with the example scene.
"""

import time

import bpy
import eyes
from hands import keys, module, operate, over, select, until

SECONDS = 1200
EXPOSURE = -1.5
# Two beams of a lamp that shines down.
BEAM = """IESNA:LM-63-1995
TILT=NONE
1 -1 1 8 1 1 2 0 0 0
1 1 100
0 10 20 30 40 55 90 180
0
600 900 200 700 900 100 40 0
"""


def main(rig):
    scene = bpy.context.scene
    scene.ltsh_view.technique, scene.ltsh.anti_aliasing, scene.ltsh.shadows = "ltsh4", 1, False
    yield from eyes.engine_started(rig)
    eyes.bare_view(rig)
    eyes.free_view(rig, scene.camera)
    eyes.plain_colors(scene, EXPOSURE)
    yield from eyes.settled(rig, "lamps_1_before.png")
    lamp, node = lamp_of_a_file(scene)
    seen = yield from looked_at(rig, "lamps_2_lamp.png", "new")
    yield from edited_and_undone(rig, lamp, node, seen)
    # Undo has made another scene of it.
    bpy.context.scene.camera = eyes.camera_like_view(rig, "Like the view")
    found = yield from eyes.final_render(rig)
    rig.xdo("key", "Escape")
    yield 2
    eyes.check_against_numpy(rig, "lamps", seen, found["LTSH Specular"] + found["LTSH Diffuse"], EXPOSURE)
    lamps_of_patterns(bpy.context.scene)
    seen = yield from looked_at(rig, "lamps_6_patterns.png", "new", 3)
    found = yield from eyes.final_render(rig)
    rig.xdo("key", "Escape")
    yield 2
    eyes.check_against_numpy(rig, "patterns", seen, found["LTSH Specular"] + found["LTSH Diffuse"], EXPOSURE)


def lamps_of_patterns(scene):
    """In place of the lamp of a file: a ball and a flat one by the mean of x, y and z, a point by its normal."""
    bpy.data.objects["Lamp"].hide_viewport = bpy.data.objects["Lamp"].hide_render = True
    for name, kind, radius, x in (
        ("Ball", "POINT", 0.3, -1.2),
        ("Point", "POINT", 0.0, 0.0),
        ("Flat", "AREA", 1.0, 1.4),
    ):
        data = bpy.data.lights.new(f"Lamp {name}", kind)
        data.energy, data.use_nodes = 150.0, True
        if kind == "AREA":
            data.shape, data.size = "SQUARE", radius
        else:
            data.shadow_soft_size, data.use_soft_falloff = radius, False
        tree = data.node_tree
        emission = next(one for one in tree.nodes if one.bl_idname == "ShaderNodeEmission")
        strength = tree.nodes.new("ShaderNodeNewGeometry").outputs["Normal" if name == "Point" else "Position"]
        if name == "Point":
            cells = tree.nodes.new("ShaderNodeTexVoronoi")
            tree.links.new(strength, cells.inputs["Vector"])
            strength = cells.outputs["Distance"]
        tree.links.new(strength, emission.inputs["Strength"])
        lamp = bpy.data.objects.new(f"Lamp {name}", data)
        lamp.location, lamp.rotation_euler, lamp.scale = (x, 0.0, 2.4), (0.3, 0.1, 0.5), (1.0, 1.4, 1.0)
        scene.collection.objects.link(lamp)


def lamp_of_a_file(scene):
    """Only this point light shines, by the text of a file; object and node."""
    for ob in scene.objects:
        ob.hide_viewport = ob.hide_render = ob.hide_viewport or ob.type == "LIGHT"
    data = bpy.data.lights.new("Lamp", "POINT")
    data.energy, data.shadow_soft_size = 300.0, 0.05
    lamp = bpy.data.objects.new("Lamp", data)
    lamp.location, lamp.rotation_euler = (0.0, 0.0, 2.6), (0.2, 0.1, 0.0)
    data.use_nodes = True
    nodes = data.node_tree.nodes
    node = nodes.new("ShaderNodeTexIES")
    node.mode, node.ies = "INTERNAL", bpy.data.texts.new("Beam")
    node.ies.write(BEAM)
    emission = next(one for one in nodes if one.bl_idname == "ShaderNodeEmission")
    data.node_tree.links.new(node.outputs[0], emission.inputs["Strength"])
    scene.collection.objects.link(lamp)
    return lamp, node


def notes(rig):
    """What the view says."""
    return module("engine.overlay")._texts[rig.region().as_pointer()].notes


def looked_at(rig, name, what, count=1):
    """Wait until Cycles has looked at so many lamps; what the view shows then."""
    lamps, start = module("engine.redraws").node_lights, time.monotonic()
    yield from until(lambda: lamps.is_busy)
    yield 0.1
    said = [note for note in notes(rig) if "Lamp" in note]
    if what == "new":
        known = len(said) == count and all("until Cycles" in note for note in said)
        rig.check(known, f"each new lamp is said to be missing: {said}")
        rig.shot(name.replace(".png", "_waiting.png"))
    else:
        rig.check(not said, f"{what}: the lamp of before is shown meanwhile: {said}")
    yield from until(lambda: not lamps.is_busy, 60.0)
    rig.fact(f"{what}: seconds until it is seen", round(time.monotonic() - start, 1))
    seen = yield from eyes.settled(rig, name)
    left = [note for note in notes(rig) if "Lamp" in note and "patches" not in note]
    rig.check(not left, f"{what}: no note is left")
    return seen


def edited_and_undone(rig, lamp, node, seen):
    """Another strength of the beam, by its node, and back by the keyboard; what is moved is not looked at again."""
    select(rig, lamp)
    operate(rig, bpy.ops.ed.undo_push, message="Before")
    lamps = module("engine.redraws").node_lights
    lamp.location.x += 0.4
    yield from eyes.differs(rig, "lamps_3_moved.png", seen, "a lamp that is moved shines elsewhere")
    rig.check(not lamps.is_busy, "and nobody looks at it again")
    lamp.location.x -= 0.4
    node.inputs["Strength"].default_value = 3.0
    brighter = yield from looked_at(rig, "lamps_4_brighter.png", "edited")
    rig.check(brighter.mean() > 1.2 * seen.mean(), "a stronger beam is brighter")
    operate(rig, bpy.ops.ed.undo_push, message="After")
    yield from over(rig)
    yield from keys(rig, "ctrl+z")
    back = bpy.data.lights["Lamp"].node_tree.nodes["IES Texture"]
    rig.check(back.inputs["Strength"].default_value == 1.0, "Ctrl Z takes it back")
    yield from until(lambda: not lamps.is_busy, 60.0)
    yield from eyes.same_again(rig, "lamps_5_undone.png", seen, "and the view is as before")
