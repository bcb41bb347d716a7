"""The light mixer by the mouse: a light muted, dragged, undone; applied to the scene, undone; a light moved."""

import statistics
import time

import bpy
import hands

SIZE = "1600x900"
SECONDS = 1200
# Where things of our panel are, in pixels from the right and the upper end of the sidebar: of the first light the eye,
# its power below the list, and Apply to Scene.
EYE, POWER, APPLY = (256, 209), (107, 314), (88, 386)


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
    yield from clicked(rig)
    yield from changed(rig)
    yield from applied(rig)
    yield from moved(rig)
    yield from rendered(rig)


def items():
    return {item.name: item for item in hands.settings().mixed}


def place(rig, where):
    return hands.to_window(rig, "IMAGE_EDITOR", "UI", *where)


def undone(rig):
    """Undo with the mouse over the picture."""
    yield from hands.over(rig, "IMAGE_EDITOR", x=0.2, y=0.2)
    yield from hands.keys(rig, "ctrl+z")
    yield 1


def clicked(rig):
    hands.settings().mode = "MIX"
    yield 1
    before = hands.image_pixels("LTSH Comparison")
    yield from hands.click(rig, *place(rig, EYE))
    yield from hands.until(lambda: hands.settings().mixed[0].muted)
    rig.check(hands.settings().mixed[0].muted, "a click on the eye mutes a light")
    yield 0.5
    rig.check(max(hands.image_pixels("LTSH Comparison")) < max(before), "and the picture gets darker")
    yield from undone(rig)
    rig.check(not hands.settings().mixed[0].muted, "Ctrl Z takes it back")
    rig.check(hands.image_pixels("LTSH Comparison") == before, "with the picture")
    x, y = place(rig, POWER)
    yield from hands.drag(rig, (x - 20, y), (x + 50, y))
    yield 1
    rig.fact("power after a drag by 70 pixels", round(hands.settings().mixed[0].power, 3))
    rig.check(hands.settings().mixed[0].power > 1.0, "dragging the power makes it brighter")
    energy = bpy.data.objects[hands.settings().mixed[0].name].data.energy
    yield from hands.click(rig, *place(rig, APPLY))
    name, power = hands.settings().mixed[0].name, hands.settings().mixed[0].power
    yield from hands.until(lambda: bpy.data.objects[name].data.energy != energy)
    rig.check(
        abs(bpy.data.objects[name].data.energy - power * energy) < 1e-3 * energy, "Apply to Scene writes the power"
    )
    rig.shot("1_dragged.png")
    yield from undone(rig)
    rig.check(bpy.data.objects[name].data.energy == energy, "Ctrl Z takes that back in one step")
    rig.check(hands.settings().mixed[0].power == power, "and the mixer keeps its values")
    yield from undone(rig)
    rig.check(hands.settings().mixed[0].power == 1.0, "which the next one takes back")
    rig.check(hands.image_pixels("LTSH Comparison") == before, "with the picture, again")


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


def moved(rig):
    name = hands.settings().mixed[0].name
    bpy.data.objects[name].location.x += 1.0
    yield 1
    start = time.perf_counter()
    hands.operate(rig, bpy.ops.ltsh.update_moved_lights, kind="IMAGE_EDITOR")
    rig.fact("a moved light, the first time, s", round(time.perf_counter() - start, 2))
    bpy.data.objects[name].location.x -= 0.5
    yield 1
    start = time.perf_counter()
    hands.operate(rig, bpy.ops.ltsh.update_moved_lights, kind="IMAGE_EDITOR")
    rig.fact("a moved light, once more, s", round(time.perf_counter() - start, 2))
    yield 1
    rig.shot("6_moved.png")


def rendered(rig):
    """F12, and its lights changed in the window of the render."""
    bpy.context.scene.render.engine = "LTSH"
    hands.operate(rig, bpy.ops.render.render, "INVOKE_DEFAULT")
    results = hands.module("ui.results")
    yield from hands.until(lambda: results._rendered, 400)
    rig.check(bool(results._rendered), "the mixer has the lights of the final render")
    yield 2
    rig.shot("7_rendered.png")
    rig.check(hands.settings().mixed[-1].name == "Everything else", f"the rest is a row: {list(items())}")
    hands.settings().mixed[1].muted = True
    yield 2
    rig.shot("8_render_mixed.png")
