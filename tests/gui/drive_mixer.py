"""The light mixer: a light brighter, solo, in another color; applied; moved; the same with an F12 picture."""

import statistics
import time

import bpy
import hands

SIZE = "1600x900"
SECONDS = 1200


def main(rig):
    yield from hands.open_panel(rig)
    yield 1
    settings = hands.settings()
    settings.anti_aliasing, settings.resolution_percentage = 1, 60
    hands.operate(rig, bpy.ops.ltsh.shade, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "shading starts")
    yield from hands.wait_for_job(rig, 600)
    yield from hands.results_opened(rig)
    yield 2
    rig.shot("1_shaded.png")
    yield from changed(rig)
    yield from applied(rig)
    yield from moved(rig)
    yield from rendered(rig)


def items():
    return {item.name: item for item in hands.settings().mixed}


def changed(rig):
    rig.check(len(items()) > 1, f"the mixer has the lights of the picture: {list(items())}")
    first = hands.settings().mixed[0]
    times = []
    for number in range(24):
        start = time.perf_counter()
        first.power = 1.0 + 0.1 * number
        times.append(time.perf_counter() - start)
        yield 0.05
    rig.fact("a change, from the value to the pixels of the image, ms", round(1e3 * statistics.median(times), 1))
    rig.fact("size", tuple(bpy.data.images["LTSH Comparison"].size))
    rig.check(hands.settings().mode == "MIX", "a changed value shows the mix")
    yield 1
    rig.shot("2_brighter.png")
    first.solo = True
    yield 1
    rig.shot("3_solo.png")
    first.solo = False
    first.color = (1.0, 0.3, 0.1)
    yield 1
    rig.shot("4_color.png")


def applied(rig):
    name = hands.settings().mixed[0].name
    energy = bpy.data.objects[name].data.energy
    hands.operate(rig, bpy.ops.ltsh.apply_mixer, kind="IMAGE_EDITOR")
    yield 1
    rig.check(bpy.data.objects[name].data.energy > energy, "Apply to Scene makes the light brighter")
    rig.shot("5_applied.png")


def moved(rig, picture="6_moved"):
    name = hands.settings().mixed[0].name
    bpy.data.objects[name].location.x += 1.0
    # Meanwhile a thread gets ready what shades it.
    yield 5
    yield from updated(rig, "the first time", picture)
    bpy.data.objects[name].location.x -= 0.5
    yield 1
    yield from updated(rig, "once more", picture)


def updated(rig, when, picture):
    """The button, and the picture; how long it takes, and the window does not answer."""
    results, scene = hands.module("ui.results"), bpy.context.scene
    before = results.mixed_pixels(scene).copy()
    longest = 0.0
    start = last = time.perf_counter()
    hands.operate(rig, bpy.ops.ltsh.update_moved_lights, "INVOKE_DEFAULT", kind="IMAGE_EDITOR")
    while results.state["update"] is not None and last - start < 300.0:
        yield 0.01
        now = time.perf_counter()
        longest, last = max(longest, now - last - 0.01), now
    rig.fact(f"{picture}, {when}: end, longest without an answer, s", [round(last - start, 2), round(longest, 2)])
    rig.check(results.state["update"] is None, "moved lights are shaded")
    rig.check((results.mixed_pixels(scene) != before).mean() > 0.05, "and seen where they are")
    yield 1
    rig.shot(f"{picture}.png")


def rendered(rig):
    """F12, and its lights changed in the window of the render."""
    bpy.context.scene.render.engine = "LTSH"
    hands.operate(rig, bpy.ops.render.render, "INVOKE_DEFAULT")
    results = hands.module("ui.results")
    yield from hands.until(lambda: results._rendered, 400)
    rig.check(bool(results._rendered), "the mixer has the lights of the final render")
    yield 2
    rig.shot("7_rendered.png")
    rig.check(hands.settings().mixed[-1].name == "The rest", f"the rest is a row: {list(items())}")
    hands.settings().mixed[1].muted = True
    yield 2
    rig.shot("8_render_mixed.png")
    before = results.mixed_pixels(bpy.context.scene).copy()
    yield from moved(rig, "9_render_moved")
    rig.check((results.mixed_pixels(bpy.context.scene) != before).mean() > 0.05, "a light of the render was moved")
