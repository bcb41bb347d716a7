"""Lights by a picture and by numbers: Match and Move as a job with Escape and undo; a highlight of a light that is not
active, at a typed distance."""

import bpy
import hands
from drive_gestures import LIT, at, built, heard, place
from mathutils import Vector

SIZE = "1400x1000"
SECONDS = 900
MATCH_SECONDS = 400
MOVED = Vector((0.3, 0.0, 0.1))


def main(rig):
    hands.patient(rig)
    told = heard()
    built()
    yield from hands.open_panel(rig)
    hands.operate(rig, bpy.ops.ed.undo_push, message="Built")
    yield from numbers(rig, told)
    yield from match(rig)


def numbers(rig, told):
    """No light is active: the one with the most glossy light is taken, and goes to a typed distance."""
    before = place()
    bpy.context.view_layer.objects.active = None
    hands.operate(rig, bpy.ops.ltsh.drag_highlight, "INVOKE_DEFAULT")
    yield from at(rig, LIT)
    rig.xdo("mousedown", 1)
    yield from hands.comes(rig, lambda: (told[-1] or "").startswith("Key    "), lambda: f"Key is taken: {told[-1:]}")
    yield from hands.keys(rig, "2", "period", "5")
    yield from hands.comes(
        rig, lambda: "[2.5]" in (told[-1] or "") and "Distance 2.5 m" in told[-1], lambda: f"2.5 m: {told[-1:]}"
    )
    rig.shot("01_typed.png")
    yield from hands.keys(rig, "Return")
    yield from hands.comes(rig, lambda: told[-1] is None, "Enter ends the drag")
    rig.xdo("mouseup", 1)
    yield 1
    rig.check(abs((Vector([row[3] for row in place()][:3]) - LIT).length - 2.5) < 0.02, f"it is there: {place()}")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: place() == before, "one undo takes it back")


def match(rig):
    """A target of Cycles, with the light elsewhere."""
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.engine = 96, 64, "CYCLES"
    scene.cycles.samples, scene.render.image_settings.file_format = 128, "OPEN_EXR"
    scene.render.filepath = str(rig.out / "target.exr")
    hands.operate(rig, bpy.ops.render.render, write_still=True)
    scene.ltsh.match_target = bpy.data.images.load(scene.render.filepath)
    true = bpy.data.objects["Key"].location.copy()
    bpy.data.objects["Key"].location += MOVED
    yield 1
    hands.operate(rig, bpy.ops.ed.undo_push, message="Moved")
    before = place()
    hands.operate(rig, bpy.ops.ltsh.match_move, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "Match and Move starts a job")
    yield 4
    rig.shot("02_job.png")
    yield from hands.typed(rig, "Escape")
    yield from hands.comes(rig, lambda: hands.job() is None and place() == before, "Escape ends it, and nothing moved")
    hands.operate(rig, bpy.ops.ltsh.match_move, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "it starts again")
    yield from hands.wait_for_job(rig, MATCH_SECONDS)
    yield 1
    off = (bpy.data.objects["Key"].location - true).length
    rig.fact("how far the light is from where it was, in m", round(off, 4))
    rig.check(off < 0.03 * 4.0, f"the light is back within 3 % of its distance: {off:.3f} m")
    rig.shot("03_matched.png")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: place() == before, "one undo takes it back")
