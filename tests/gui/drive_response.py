"""The window answers while a comparison of 1920 x 1080 pixels is started, runs, and is looked at."""

import bpy
import hands

SECONDS = 1800
# Small, for the graphics driver may be a program that takes longer to draw the window than all else.
SIZE = "800x600"
LONGEST = 0.2  # seconds, beside drawing: the machine may be busy
DRAWINGS = 5


def main(rig):
    image = yield from image_drawn(rig)
    yield from hands.open_panel(rig)
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 1920, 1080
    hands.settings().techniques, hands.settings().cycles_samples = {"ltc", "ltsh4"}, 4
    yield 4
    pulse = hands.Pulse()
    yield 5
    pulse.stop(rig, "idle")
    drawing = yield from drawn(rig)
    pulses = []
    for what in ("click", "click with results of 1080p"):
        pulse = hands.Pulse()
        yield from hands.click_button(rig, hands.COMPARE)
        yield from hands.until(lambda: hands.job() is not None)
        yield 0.5
        pulses.append(pulse.stop(rig, what))
        if pulse is pulses[0]:
            running = hands.Pulse()
            yield from hands.wait_for_job(rig, 1200)
            pulses.append(running.stop(rig, "job"))
            rig.check(hands.job() is None and "LTSH cycles.combined" in bpy.data.images, "the comparison is there")
            yield 2
    yield from hands.over(rig)
    pulse = hands.Pulse()
    yield from hands.keys(rig, "Escape")
    yield from hands.until(lambda: hands.job() is None)
    pulses.append(pulse.stop(rig, "Esc"))
    rig.check(hands.job() is None, "Esc ends the job")
    yield from open_results(rig)
    pulse = hands.Pulse()
    yield from dragged(rig)
    yield 3
    # Every step brings a new picture of 1080p to the graphics card, which may be a program: only told, not checked.
    pulse.stop(rig, "dragging the line")
    work = max(pulse.longest_work for pulse in pulses) - image.longest_work
    rig.check(work < LONGEST, f"the main thread never works for {LONGEST} s, beside drawing an image")
    longest = max(pulse.longest for pulse in pulses) - max(drawing, image.longest)
    rig.check(longest < LONGEST, f"the window answers within {LONGEST} s and the time to draw it")
    rig.shot("1080p.png")


def image_drawn(rig):
    """The pulse while Blender draws any image of 1080p for the first time."""
    image = bpy.data.images.new("Any", 1920, 1080, float_buffer=True)
    area = max(bpy.context.window_manager.windows[0].screen.areas, key=lambda area: area.width * area.height)
    kind, pulse = area.type, hands.Pulse()
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image = image
    yield 4
    pulse.stop(rig, "any image")
    area.type = kind
    bpy.data.images.remove(image)
    yield 1
    return pulse


def open_results(rig):
    yield from hands.results_opened(rig)
    rig.area("IMAGE_EDITOR").spaces.active.show_region_ui = False
    yield 3


def dragged(rig):
    """Drag the line of the wipe from the middle to the left."""
    region = rig.region("IMAGE_EDITOR")
    (x, y), (end, _) = (region.view2d.view_to_region(split, 0.4) for split in (hands.settings().split, 0.25))
    height = rig.size[1] - region.y - y
    yield from hands.drag(rig, (region.x + x, height), (region.x + end, height))
    yield from hands.line_at(rig, 0.25, 0.05)


def drawn(rig):
    """Seconds for which the window does not answer when it is drawn as a whole, the longest of some."""
    longest = 0.0
    for _ in range(DRAWINGS):
        pulse = hands.Pulse()
        yield 0.2
        rig.redraw()
        yield 1.5
        longest = max(longest, pulse.stop(rig, "").longest)
    rig.fact("drawing the window: longest pause, s", round(longest, 3))
    return longest
