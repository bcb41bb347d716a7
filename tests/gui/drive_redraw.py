"""How long a redraw takes while a light moves: LTSH with shadows and without, and EEVEE, in turn within one minute.

A frame is what `wm.redraw_timer` draws after the light has moved, in processor time: without a card it is the
processor that draws. EEVEE is as Blender sets it up, without its own filter of many frames.
"""

import statistics
import time

import bpy
from eyes import SETTLE_SECONDS
from hands import over

SIZE = "1000x640"
SECONDS = 900
ROUNDS, FRAMES = 4, 6
# EEVEE compiles its shaders first.
COMPILE_SECONDS = 90
# Of EEVEE's time, and of that without shadows.
MOST, MOST_SHADOWS = 1.0, 1.5


def main(rig):
    rig.only_view3d()
    yield 1
    yield from over(rig)
    rig.camera_view()
    rig.space.overlay.show_overlays = False
    rig.space.show_region_ui = False
    yield 1
    region = rig.region()
    rig.fact("view", (region.width, region.height))
    light = next(ob for ob in bpy.data.objects if ob.type == "LIGHT")
    kinds = {"LTSH": ("LTSH", True), "LTSH without shadows": ("LTSH", False), "EEVEE": ("BLENDER_EEVEE", True)}
    seconds = {kind: [] for kind in kinds}
    for number in range(ROUNDS + 1):
        for kind, (engine, shadows) in kinds.items():
            bpy.context.scene.render.engine = engine
            bpy.context.scene.ltsh.shadows = shadows
            rig.space.shading.type = "RENDERED"
            yield COMPILE_SECONDS if number == 0 and engine != "LTSH" else 8
            found = yield from moving(rig, light)
            # The first round compiles.
            seconds[kind] += found * (number > 0)
    medians = {kind: statistics.median(found) for kind, found in seconds.items()}
    rig.fact("median seconds of a redraw", {kind: round(value, 3) for kind, value in medians.items()})
    rig.fact("redraws", {kind: [round(value, 2) for value in found] for kind, found in seconds.items()})
    rig.fact("LTSH / EEVEE", round(medians["LTSH"] / medians["EEVEE"], 2))
    rig.fact("with shadows / without", round(medians["LTSH"] / medians["LTSH without shadows"], 2))
    rig.check(medians["LTSH"] <= MOST * medians["EEVEE"], "a redraw takes as long as EEVEE's")
    few = medians["LTSH"] <= MOST_SHADOWS * medians["LTSH without shadows"]
    rig.check(few, f"shadows make a redraw at most {MOST_SHADOWS:g} times as long")


def moving(rig, light):
    """Seconds of the redraws after each of FRAMES moves; the light comes back."""
    found, place = [], light.location.copy()
    for number in range(FRAMES):
        light.location.x = place.x + 0.02 * (number + 1)
        bpy.context.view_layer.update()
        start = time.process_time()
        with rig.override():
            bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        found.append(time.process_time() - start)
        yield 0.1
    light.location = place
    yield SETTLE_SECONDS
    return found
