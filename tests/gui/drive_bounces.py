"""Bounces in the view: they come, follow an orbit, a light and a color, and end with the engine.

With `--blend` of a scene with a mirror or glass the pictures show what direct light alone does not.
"""

import shutil
import time

import bpy
from eyes import view
from hands import module, over
from mathutils import Matrix

SIZE = "1000x640"
SECONDS = 900
# A busy machine without a card: the first picture waits for shaders, the second Blender and the first shadows.
FIRST_SECONDS, NEXT_SECONDS, LAST_SECONDS, ENDED_SECONDS = 90, 40, 240, 0.2


def rest():
    """What the open view knows of bounces."""
    return next(iter(module("engine.redraws").open_views)).rest


def shown_of(rest):
    """The view of the picture that is shown."""
    return None if rest._picture is None or rest.has_news else rest._picture.view


def waited(rig, until, most):
    """Wait until `until()`; the seconds."""
    start = time.monotonic()
    while not until() and time.monotonic() - start < most:
        yield 0.1
    return time.monotonic() - start


def changed(rig, what, change):
    """Change the scene, wait for the first picture after it, and tell how long that took."""
    before = shown_of(rest())
    change()
    yield 0.3
    rig.shot(f"{what}_at_once.png")
    seconds = yield from waited(rig, lambda: shown_of(rest()) not in (None, before), NEXT_SECONDS)
    rig.fact(f"{what}: seconds until its bounces", round(seconds + 0.3, 1))
    rig.check(shown_of(rest()) != before, f"{what}: its bounces come")
    yield 1
    rig.shot(f"{what}.png")


def main(rig):
    rig.only_view3d()
    yield 1
    yield from over(rig)
    rig.space.overlay.show_overlays = False
    rig.space.show_region_ui = False
    rig.camera_view()
    yield 1
    start = time.monotonic()
    with rig.override():
        bpy.ops.ltsh.preview()
    yield 0.5
    yield from waited(rig, lambda: len(module("engine.redraws").open_views) > 0, FIRST_SECONDS)
    yield from waited(rig, lambda: shown_of(rest()) is not None, FIRST_SECONDS)
    rig.fact("first bounces after seconds", round(time.monotonic() - start, 1))
    rig.check(shown_of(rest()) is not None, "bounces come")
    rig.fact("problem", rest().problem)
    yield 1
    rig.shot("first.png")
    seconds = yield from waited(rig, lambda: not rest().lacks(1), LAST_SECONDS)
    rig.fact("full resolution after further seconds", round(seconds, 1))
    rig.check(not rest().lacks(1), "bounces come in full resolution")
    yield 1
    rig.shot("last.png")
    light = next(ob for ob in bpy.data.objects if ob.type == "LIGHT")

    def power():
        light.data.energy *= 2.0

    def move():
        light.location.x += 0.4

    def orbit():
        region = rig.space.region_3d
        region.view_perspective = "PERSP"
        sine, cosine = 0.25, 0.968
        turn = Matrix(((cosine, -sine, 0, 0), (sine, cosine, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)))
        region.view_matrix = region.view_matrix @ turn

    yield from changed(rig, "power", power)
    yield from changed(rig, "move", move)
    yield from changed(rig, "orbit", orbit)
    ob = next(ob for ob in bpy.data.objects if ob.type == "MESH" and ob.active_material)
    shade = bpy.context.view_layer
    before = shown_of(rest())
    ob.select_set(True)
    shade.objects.active = ob
    yield 2
    rig.check(rest()._wanted.version == before.version, "selecting renders nothing again")
    child, opened = rest()._blender.process._child, id(rest())
    rig.check(child is not None and child.poll() is None, "the second Blender waits for changes")
    bpy.ops.wm.save_mainfile()
    yield 3
    rig.check(id(rest()) == opened, "a save leaves the view of a preview")
    rig.check(child.poll() is None and rest()._wanted.version == before.version, "nor is anything rendered again")
    copied = shutil.copy(bpy.data.filepath, rig.out / "saved.blend")
    with bpy.data.libraries.load(str(copied)) as (saved, wanted):
        wanted.scenes = saved.scenes[:1]
    rig.check(wanted.scenes[0].render.engine != "LTSH", "the file has the artist's engine")
    bpy.data.scenes.remove(wanted.scenes[0])
    yield from changed(rig, "move after a save", move)
    start = time.monotonic()
    view().bounces = False
    while child.poll() is None and time.monotonic() - start < 5:
        yield 0.05
    rig.fact("second Blender gone after seconds", round(time.monotonic() - start, 2))
    rig.check(child.poll() is not None, "without bounces the second Blender ends")
    yield 2
    rig.shot("off.png")
    view().bounces = True
    yield 0.5
    yield from waited(
        rig, lambda: rest()._blender is not None and rest()._blender.process._child is not None, NEXT_SECONDS
    )
    child = rest()._blender.process._child
    start = time.monotonic()
    with rig.override():
        bpy.ops.ltsh.preview()
    yield ENDED_SECONDS
    rig.check(child.poll() is not None, f"it ends within {ENDED_SECONDS:g} s with the engine")
