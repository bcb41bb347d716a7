"""Compare with Cycles by the mouse: cancel one, finish one, drag the wipe, change the technique, save, reload."""

import time

import bpy
import hands

SIZE = "1600x900"
SECONDS = 1500


def main(rig):
    yield from hands.open_panel(rig)
    yield 1.5
    rig.shot("1_panel.png")
    rig.check(hands.settings().techniques == {"ltc", "ltsh4c"}, "LTC and LTSH 4c are chosen at the start")
    hands.settings().cycles_samples = 64
    yield from cancelled(rig)
    yield from finished(rig)
    yield from looked_at(rig)
    yield from saved(rig)


def cancelled(rig):
    yield from hands.start_comparison(rig)
    pulse = hands.Pulse()
    yield from hands.until(lambda: hands.job() is None or hands.job().results, 400)
    yield 1.0
    pulse.stop(rig, "until the first pictures are there")
    rig.shot("2_running.png")
    stopped = hands.job()
    rig.check(stopped is not None and len(stopped.results) == 1, "the techniques are shown while Cycles still renders")
    pulse = hands.Pulse()
    yield from hands.click_button(rig, hands.CANCEL)
    yield from hands.until(lambda: stopped.cancelled)
    start = time.monotonic()
    yield from hands.until(lambda: hands.job() is None)
    pulse.stop(rig, "while cancelling")
    seconds = time.monotonic() - start
    rig.fact("from the click on Cancel to the end of the job, s", round(seconds, 3))
    # A machine that is busy draws no faster than it does.
    rig.check(stopped.cancelled and seconds < 0.5 + 3.0 * pulse.longest, "Cancel ends the job at once")
    yield from hands.until(lambda: not stopped.folder.exists())
    rig.check(not stopped.folder.exists(), "and the second Blender goes with its files")
    result = hands.module("ui.results").result_of(bpy.context.scene)
    rig.check(result is not None and "cycles" not in result.groups[""]["names"], "what was finished is kept")
    yield 1
    rig.shot("3_cancelled.png")


def finished(rig):
    # Panels below one that became shorter move for a moment.
    yield 3
    yield from hands.start_comparison(rig, "a second comparison starts")
    pulse = hands.Pulse()
    yield from hands.wait_for_job(rig, 900)
    pulse.stop(rig, "while a comparison runs")
    names = {image.name for image in bpy.data.images}
    rig.check({"LTSH ltsh4c.combined", "LTSH cycles.combined", "LTSH error_ltsh4c.combined"} <= names,
              "pictures are images of Blender")  # fmt: skip
    yield from hands.results_opened(rig)
    yield 3
    rig.shot("4_wipe.png")


def looked_at(rig):
    left, right = (column_color(rig, x) for x in (0.25, 0.75))
    rig.check(max(left) > 0 and max(right) > 0, "the comparison shows something on both sides")
    region = rig.region("IMAGE_EDITOR")
    x, _ = region.view2d.view_to_region(hands.settings().split, 0.5)
    middle = region.view2d.view_to_region(0.0, 0.5)[1]
    y = rig.size[1] - (region.y + middle)
    target = region.view2d.view_to_region(0.25, 0.5)[0]
    yield from hands.drag(rig, (region.x + x, y - 40), (region.x + target, y - 40))
    yield from hands.line_at(rig, 0.25, 0.02)
    rig.shot("5_dragged.png")
    image = bpy.data.images["LTSH Comparison"]
    cycles = bpy.data.images["LTSH cycles.combined"]
    width, height = image.size
    index = 4 * (height // 2 * width + width // 2)
    rig.check(image.pixels[index : index + 3] == cycles.pixels[index : index + 3], "right of the line is Cycles")
    for mode in ("SIDE", "ERROR"):
        hands.settings().mode = mode
        yield 1
        hands.operate(rig, bpy.ops.image.view_all, fit_view=True, kind="IMAGE_EDITOR")
        yield 1
        rig.shot(f"6_{mode.lower()}.png")
    hands.settings().mode = "WIPE"
    yield 1
    hands.settings().first = "ltc"
    yield 1
    rig.shot("7_ltc.png")
    ltc = bpy.data.images["LTSH ltc.combined"]
    index = 4 * (height // 2 * width + width // 8)
    rig.check(image.pixels[index : index + 3] == ltc.pixels[index : index + 3], "left of the line is now LTC")


def saved(rig):
    path, before = bpy.data.filepath, hands.image_pixels("LTSH Comparison")
    bpy.ops.wm.save_mainfile()
    yield 2
    rig.check(hands.image_pixels("LTSH Comparison") == before, "saving leaves the picture as it is")
    bpy.ops.wm.open_mainfile(filepath=path)
    yield 2
    rig.check(hands.settings().first == "ltc" and hands.settings().mode == "WIPE", "what was chosen is in the file")
    image = bpy.data.images.get("LTSH Comparison")
    rig.check(image is not None and image.size[0] > 4, "after loading the comparison is there")
    rig.check(hands.image_pixels("LTSH Comparison") == before, "with the same pixels")
    rig.check(not bpy.data.is_dirty, "and nothing wants to be saved again")
    rig.shot("9_reloaded.png")


def column_color(rig, share):
    region = rig.region("IMAGE_EDITOR")
    x, y = region.view2d.view_to_region(share, 0.4)
    path = str(rig.out / "4_wipe.png")
    return rig.pixel(path, (region.x + x) / rig.size[0], (region.y + y) / rig.size[1])
