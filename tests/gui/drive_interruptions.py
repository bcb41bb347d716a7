"""What comes in between: undo, Escape and another file during the preview, F12 and a bake."""

from pathlib import Path

import bpy
import eyes
import hands

SIZE = "1280x900"
SECONDS = 1800
ENDING_SECONDS = 20.0


def main(rig):
    hands.patient(rig)
    other = hands.file_copy()
    yield from hands.open_panel(rig)
    yield 1
    yield from during_the_preview(rig, other)
    yield from during_a_render(rig, other)
    yield from during_a_bake(rig, other)
    rig.shot("7_end.png")


def copy_of_render():
    """The folder of the copy that F12 renders, None where there is none."""
    folder = hands.module("engine.render")._copy.get("folder")
    return None if folder is None else Path(folder.name)


def gone(rig, folder, what):
    """Check that a folder goes."""
    yield from hands.comes(rig, lambda: not folder.exists(), f"nothing is left {what}", ENDING_SECONDS)


def opened(rig, path):
    """Open a file as File > Open does; the panel is there again."""
    bpy.ops.wm.open_mainfile(filepath=path)
    yield 1
    yield from hands.open_panel(rig)
    yield 1


def engine():
    return bpy.context.scene.render.engine


def during_the_preview(rig, other):
    artist = engine()
    yield from hands.click_button(rig, hands.PREVIEW)
    yield 3
    rig.check(engine() == "LTSH" and rig.space.shading.type == "RENDERED", "the preview is on")
    light = bpy.data.objects["Neon"]
    hands.select(rig, light)
    hands.operate(rig, bpy.ops.ed.undo_push, message="Selected")
    place = light.location.copy()
    x, y = hands.view_middle(rig)
    yield from hands.typed(rig, "g")
    for step in range(1, 6):
        rig.xdo("mousemove", x - 30 * step, y)
        yield 0.2
    rig.check((light.location - place).length > 0.01, "the mouse drags the light")
    yield from hands.keys(rig, "Escape")
    rig.check((light.location - place).length < 1e-6, "Escape puts it back")
    yield from hands.typed(rig, "Delete")
    yield from hands.comes(rig, lambda: "Neon" not in bpy.context.scene.objects, "Delete removes it")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.until(lambda: "Neon" in bpy.context.scene.objects)
    rig.check(engine() == "LTSH", "one undo brings the light back, and the preview stays")
    rig.shot("1_preview.png")
    yield from hands.typed(rig, "ctrl+z", "ctrl+z", "ctrl+z")
    rig.check(engine() == "LTSH" and rig.space.shading.type == "RENDERED", f"undo leaves the preview on: {engine()}")
    yield from hands.typed(rig, "ctrl+shift+z", "ctrl+shift+z", "ctrl+shift+z")
    rig.check(engine() == "LTSH" and rig.space.shading.type == "RENDERED", f"so does redo: {engine()}")
    yield 0.5
    # While shadows are traced and the view is refined.
    yield from opened(rig, other)
    rig.check(engine() == artist and not eyes.view().artist_engine, "another file has its own engine, and no preview")


def during_a_render(rig, other):
    """Undo and another file while F12 renders."""
    for what in ("undo", "file"):
        scene = bpy.context.scene
        scene.render.engine = "LTSH"
        scene.render.resolution_x, scene.render.resolution_y = 1280, 720
        hands.settings().anti_aliasing = 16
        light = bpy.data.objects["Neon"]
        hands.operate(rig, bpy.ops.ed.undo_push, message="Before")
        light.location.x += 1.0
        hands.operate(rig, bpy.ops.ed.undo_push, message="Moved")
        ended = yield from eyes.render_started(rig)
        yield from hands.until(copy_of_render, 20)
        folder = copy_of_render()
        yield 4
        rig.check(folder is not None and folder.exists() and not ended, f"F12 renders: {ended}")
        rig.shot(f"2_rendering_{what}.png")
        if what == "undo":
            moved = light.location.x
            yield from hands.over(rig, *picture_area(rig))
            yield from hands.keys(rig, "ctrl+z")
            yield 2
            rig.fact("the light while F12 renders and after Ctrl Z", [moved, bpy.data.objects["Neon"].location.x])
            rig.shot("2_undone.png")
            yield from hands.over(rig, *picture_area(rig))
            rig.xdo("key", "Escape")
            yield from hands.until(lambda ended=ended: ended, ENDING_SECONDS)
            rig.check(bool(ended), f"Escape or undo ends it: {ended}")
            yield from gone(rig, folder, "of the render that was stopped")
            rig.xdo("key", "Escape")
            yield 1
        yield from opened(rig, other)
        yield from gone(rig, folder, "of the render, after another file")
        rig.check(not hands.module("ui.results")._rendered, "nor in the mixer")
        rig.shot(f"3_opened_{what}.png")


def picture_area(rig):
    """The area that shows the render."""
    kinds = [area.type for area in rig.window.screen.areas]
    return ("IMAGE_EDITOR", "WINDOW") if "IMAGE_EDITOR" in kinds else ("VIEW_3D", "WINDOW")


def during_a_bake(rig, other):
    for what in ("Escape", "undo", "file"):
        settings = hands.settings()
        settings.bake_size, settings.anti_aliasing = "1024" if what != "undo" else "256", 1
        hands.select(rig, bpy.data.objects["floor"])
        light = bpy.data.objects["Neon"]
        energy = light.data.energy
        hands.operate(rig, bpy.ops.ed.undo_push, message="Before")
        light.data.energy = 2.0 * energy
        hands.operate(rig, bpy.ops.ed.undo_push, message="Brighter")
        hands.operate(rig, bpy.ops.ltsh.bake, "INVOKE_DEFAULT")
        yield from hands.job_started(rig, "a bake starts")
        job = hands.job()
        yield from hands.until(lambda job=job: job.stage != "Starting", 60)
        if what == "Escape":
            yield from hands.typed(rig, "Escape")
            yield from hands.until(lambda: hands.job() is None)
            rig.check(job.cancelled, "Escape ends it")
            bpy.data.objects["Neon"].data.energy = energy
        elif what == "undo":
            yield from hands.typed(rig, "ctrl+z")
            rig.check(abs(bpy.data.objects["Neon"].data.energy - energy) < 1e-4, "undo reaches the light")
            yield from hands.wait_for_job(rig, 600)
            rig.check(not job.error and job.shown == 1, f"and the bake ends well: {job.error}")
            yield 1
            rig.check(hands.image_pixels("LTSH floor ltsh4c.combined") != (), "with its texture")
            rig.shot("4_baked.png")
            yield from hands.typed(rig, "ctrl+z")
            rig.check("LTSH floor ltsh4c.combined" not in bpy.data.images, "one undo takes it away")
        else:
            yield from opened(rig, other)
            rig.check(hands.job() is None and job.cancelled, "another file ends it")
        yield from gone(rig, job.folder, f"of the bake, after {what}")
