"""What is missing and its fix, shading, baking, undo in one step, the preview, the manual: each by a click."""

import bpy
import hands

SIZE = "1280x900"
SECONDS = 1800
# Places that shift with what the panel shows.
ADD_CAMERA, GRAY_COMPARE, BAKE_HEADER, BAKE = (149, 358), (149, 392), (223, 420), (149, 477)
SHADED = "LTSH ltsh4c.combined"


def main(rig):
    hands.settings().resolution_percentage, hands.settings().bake_size = 25, "256"
    yield from hands.open_panel(rig)
    yield 2
    yield from mended(rig)
    yield from shaded(rig)
    yield from previewed(rig)
    yield from baked(rig)
    yield from manual(rig)


def mended(rig):
    bpy.context.scene.camera = None
    hands.operate(rig, bpy.ops.ed.undo_push, message="Without camera")
    yield 3
    rig.shot("1_no_camera.png")
    yield from hands.click_button(rig, GRAY_COMPARE)
    rig.check(hands.job() is None, "without a camera nothing starts")
    yield from hands.click_button(rig, ADD_CAMERA)
    yield 1
    rig.check(bpy.context.scene.camera is not None, "Add Camera adds one")
    yield from hands.over(rig)
    yield from hands.keys(rig, "ctrl+z")
    rig.check(bpy.context.scene.camera is None, "and one undo takes it back")
    cameras = [ob for ob in bpy.data.objects if ob.type == "CAMERA"]
    rig.check(len(cameras) == 1, "with its object")
    bpy.context.scene.camera = cameras[0]
    hands.operate(rig, bpy.ops.ed.undo_push, message="With camera")
    yield 2


def shaded(rig):
    yield from hands.click_button(rig, hands.SHADE)
    yield from hands.job_started(rig, "a click on Shade Camera View starts a job")
    yield from hands.wait_for_job(rig, 900)
    # Panels below one that became shorter move for a moment.
    yield 3
    pixels = hands.image_pixels(SHADED)
    rig.check(max(pixels, default=0.0) > 0.1, "the picture is an image of Blender")
    rig.shot("2_shaded.png")
    yield from hands.over(rig)
    yield from hands.keys(rig, "ctrl+z")
    rig.check(SHADED not in bpy.data.images and not hands.settings().result_folder, "one undo takes the results back")
    yield from hands.keys(rig, "ctrl+shift+z")
    rig.check(hands.settings().result_folder != "", "redo brings the results back")
    rig.check(hands.image_pixels(SHADED) == pixels, "with the same pixels")
    rig.check(hands.job() is None, "and starts nothing")


def previewed(rig):
    engine = bpy.context.scene.render.engine
    yield from hands.click_button(rig, hands.PREVIEW)
    yield 4
    rig.check(bpy.context.scene.render.engine == "LTSH", "the preview is on")
    rig.shot("3_preview.png")
    yield from hands.click_button(rig, hands.PREVIEW)
    yield 2
    rig.check(bpy.context.scene.render.engine == engine, "and ending it brings the artist's engine back")


def baked(rig):
    hands.select(rig, bpy.data.objects["floor"])
    yield from hands.click(rig, *hands.to_window(rig, "VIEW_3D", "UI", *BAKE_HEADER))
    yield 3
    rig.shot("4_bake.png")
    yield from hands.click_button(rig, BAKE)
    yield from hands.job_started(rig, "a click on Bake Selected starts a job")
    yield from hands.wait_for_job(rig, 900)
    # Panels below one that became shorter move for a moment.
    yield 3
    rig.check(max(hands.image_pixels("LTSH floor ltsh4c.combined"), default=0.0) > 0.1, "the baked texture is an image")
    result = hands.module("ui.results").result_of(bpy.context.scene)
    rig.check(result is not None and result.command == "bake", "the results are those of the bake")
    rig.shot("5_baked.png")
    yield from hands.click(rig, *hands.to_window(rig, "VIEW_3D", "UI", *BAKE_HEADER))
    yield 1


def manual(rig):
    windows = len(bpy.context.window_manager.windows)
    yield from hands.click_button(rig, hands.MANUAL)
    yield 2
    rig.check(len(bpy.context.window_manager.windows) == windows + 1, "the question mark opens a window")
    text = bpy.data.texts.get("LTSH Manual")
    rig.check(text is not None and "# LTSH in Blender" in text.as_string(), "with the manual")
    rig.shot("6_manual.png")
