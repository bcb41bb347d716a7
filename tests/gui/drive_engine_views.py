"""The engine LTSH in views of every kind, beside a Cycles picture, with errors, and stopped by Escape.

To be opened with the example scene.
"""

import time

import bpy
import eyes
import numpy as np
from hands import Pulse, click, editor_for_results, module, operate, select, settings, until, view_middle, wait_for_job

SECONDS = 1800
EXPOSURE = -1.5
# After Escape is pressed; the driver itself looks only every 0.02 s, and xdotool takes its time to start.
CANCEL_SECONDS = 0.8
# Rows and columns of the view: the right half of the camera's frame, without captions.
PART = slice(200, 400), slice(540, 740)
MOST_SHIFT = 2  # pixels
# The radiance of LTSH 4 itself is 0.5 % below Cycles' here; where in the pixels the view takes its points changes the
# ratio by 0.25 % (standard deviation over 16 places).
SAME_BRIGHTNESS = 0.015


def main(rig):
    scene = bpy.context.scene
    yield from eyes.engine_started(rig)
    yield from eyes.settled(rig, "views_1_with_overlays.png")
    yield from selected_by_a_click(rig)
    eyes.bare_view(rig)
    eyes.plain_colors(scene, EXPOSURE)
    # Views with one point per pixel keep their first, coarse shadows, whose noise is another one every time.
    settings().shadows = False
    whole = yield from eyes.settled(rig, "views_2_bare.png")
    yield from another_engine(rig)
    yield from changed_by_hand(rig, whole)
    yield from local_view(rig, whole)
    yield from quad_view(rig)
    yield from resized(rig, whole)
    yield from with_an_error(rig)
    yield from beside_cycles(rig)
    yield from stopped_by_escape(rig)


def is_picture(pixels):
    return pixels.std() > 0.02 and (pixels.max(axis=-1) > 0.01).mean() > 0.3


def selected_by_a_click(rig):
    # The knot stands in the middle of the camera's frame.
    x, y = view_middle(rig)
    yield from click(rig, x, y + 55)
    active = bpy.context.view_layer.objects.active
    rig.fact("clicked on", active.name if active else None)
    rig.check(active is not None and active.select_get(), "a click selects what the picture shows there")
    rig.shot("views_1_selected.png")


def another_engine(rig):
    """Choosing an engine by hand ends a preview, which then does not come back on its own."""
    scene = bpy.context.scene
    scene.render.engine = "BLENDER_WORKBENCH"
    yield 1
    operate(rig, bpy.ops.ltsh.preview)
    yield 1
    rig.check(eyes.view().artist_engine == "BLENDER_WORKBENCH", "the preview knows the engine to give back")
    scene.render.engine = "CYCLES"
    yield 1
    rig.check(eyes.view().artist_engine == "", "an engine chosen by hand ends the preview")
    scene.render.engine = "LTSH"
    yield 1


def changed_by_hand(rig, whole):
    """Materials and objects update, and give the picture back as it was."""
    material = bpy.data.materials["plastic violet"]
    inputs = next(node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled").inputs
    color = tuple(inputs["Base Color"].default_value)
    inputs["Base Color"].default_value = (0.9, 0.9, 0.1, 1.0)
    pixels = yield from eyes.settled(rig, "views_3_material.png")
    rig.check(np.abs(pixels - whole).max() > 0.1, "a changed material is seen at once")
    inputs["Base Color"].default_value = color
    wall = bpy.data.objects["back wall"]
    wall.hide_viewport = True
    yield from eyes.differs(rig, "views_3_hidden.png", whole, "a hidden object is gone at once", 0.003)
    wall.hide_viewport = False
    yield from eyes.same_again(rig, "views_3_again.png", whole, "undone, the picture is what it was")


def local_view(rig, whole):
    select(rig, bpy.data.objects["back wall"])
    operate(rig, bpy.ops.view3d.localview, frame_selected=False)
    pixels = yield from eyes.settled(rig, "views_4_local.png")
    lit, lit_before = ((image.max(axis=-1) > 0.02).mean() for image in (pixels, whole))
    rig.check(lit < 0.5 * lit_before, "local view hides the others")
    operate(rig, bpy.ops.view3d.localview, frame_selected=False)
    yield from eyes.same_again(rig, "views_4_left.png", whole, "after local view the picture is what it was")


def quad_view(rig):
    operate(rig, bpy.ops.screen.region_quadview)
    yield 2
    rig.shot("views_5_quad.png")
    regions = [region for region in rig.area().regions if region.type == "WINDOW" and region.width > 10]
    rig.check(len(regions) == 4, "there are four views")
    # From the right the walls are seen from behind, where there is no light.
    shown = [eyes.view_pixels(rig, "views_5_quad.png", region).std() > 0.01 for region in regions]
    rig.check(sum(shown) >= 3, f"they show something: {shown}")
    operate(rig, bpy.ops.screen.region_quadview)
    yield 1


def resized(rig, whole):
    rig.camera_view()
    operate(rig, bpy.ops.screen.screen_full_area, use_hide_panels=True)
    pixels = yield from eyes.settled(rig, "views_6_full.png")
    rig.check(pixels.shape[1] > whole.shape[1] and is_picture(pixels), "a larger view is filled")
    rig.check((pixels[-100:].max(axis=-1) > 0.0).mean() > 0.9, "down to its lower edge")
    operate(rig, bpy.ops.screen.screen_full_area, use_hide_panels=True)
    yield from eyes.same_again(rig, "views_6_back.png", whole, "and so is the smaller one again")


def with_an_error(rig):
    """What goes wrong is said in the view; the picture comes back when it is over."""
    mirror = module("viewport.mirror").SceneMirror
    sync = mirror.sync

    def broken(self, *arguments):
        raise ValueError("light 'Neon': an error made for this test")

    mirror.sync = broken
    try:
        light = bpy.data.objects["Neon"].data
        light.energy *= 1.01
        pixels = yield from eyes.settled(rig, "views_7_error.png")
    finally:
        mirror.sync = sync
    rig.check(red_pixels(pixels) > 100, "the error stands in the view")
    light.energy /= 1.01
    pixels = yield from eyes.settled(rig, "views_7_gone.png")
    rig.check(is_picture(pixels) and red_pixels(pixels) < 20, "after the error there is a picture without it")


def red_pixels(pixels):
    """How many pixels of the corner in which errors stand are red."""
    corner = pixels[-60:, -600:]
    return ((corner[..., 0] > 0.6) & (corner[..., 1] < 0.5) & (corner[..., 2] < 0.45)).sum()


def beside_cycles(rig):
    """Compare with Cycles, then the difference to its picture."""
    eyes.view().mode, eyes.view().second_technique, eyes.view().technique = "difference", "cycles", "ltsh4"
    yield 1
    pixels = yield from eyes.settled(rig, "views_8_no_cycles.png")
    rig.check(is_picture(pixels), "without a Cycles picture the technique is seen")
    settings().techniques, settings().cycles_samples, settings().anti_aliasing = {"ltsh4"}, 64, 1
    editor_for_results(rig)
    operate(rig, bpy.ops.ltsh.compare, "INVOKE_DEFAULT")
    yield from wait_for_job(rig, 900)
    pixels = yield from eyes.settled(rig, "views_8_difference.png")
    middle = pixels[pixels.shape[0] // 3 : -pixels.shape[0] // 3, pixels.shape[1] // 3 : -pixels.shape[1] // 3]
    rig.fact("brightness of the difference in the middle", round(float(middle.mean()), 3))
    rig.check(middle.mean() > 0.7, "within the camera's frame the difference is about white")
    rig.check(np.ptp(pixels[80, 40]) < 0.02 and pixels[80, 40].max() < 0.8, "outside there is none")
    eyes.view().mode = "split"
    split = yield from eyes.settled(rig, "views_8_split.png")
    eyes.view().mode = "single"
    alone = yield from eyes.settled(rig, "views_8_alone.png")
    lies_on(rig, split[PART], alone[PART])
    bpy.data.objects["Sunset"].location.x += 0.3
    eyes.view().mode = "difference"
    before = pixels
    pixels = yield from eyes.settled(rig, "views_8_outdated.png")
    yellow = [int((image[-40:, -500:, 0] - image[-40:, -500:, 2] > 0.25).sum()) for image in (before, pixels)]
    rig.check(yellow[0] == 0 and yellow[1] > 50, f"the view says when the Cycles picture is older: {yellow}")
    bpy.data.objects["Sunset"].location.x -= 0.3
    eyes.view().mode = "single"


def lies_on(rig, cycles, technique):
    """Check that two pictures of the screen lie on each other and are as bright."""
    inner = technique[MOST_SHIFT:-MOST_SHIFT, MOST_SHIFT:-MOST_SHIFT]
    size = range(2 * MOST_SHIFT + 1)
    apart = [[np.abs(cycles[y:, x:][: len(inner), : len(inner[0])] - inner).mean() for x in size] for y in size]
    row, column = np.unravel_index(np.argmin(apart), (len(size), len(size)))
    shift = int(column) - MOST_SHIFT, int(row) - MOST_SHIFT
    rig.check(shift == (0, 0), f"Cycles' picture lies where the technique's is: {shift} pixels to the right and down")
    where = is_even(cycles) & is_even(technique)
    ratio = float(eyes.linear(cycles[where], EXPOSURE).mean() / eyes.linear(technique[where], EXPOSURE).mean())
    rig.fact("Cycles by LTSH 4, mean of the even pixels of a part", round(ratio, 4))
    rig.fact("share of these pixels", round(float(where.mean()), 3))
    rig.check(where.mean() > 0.4 and abs(ratio - 1.0) < SAME_BRIGHTNESS, "Cycles' picture is as bright")


def is_even(pixels):
    """(H, W): are the 3 x 3 pixels around each of these pixels of the screen unclipped, and alike to a factor of two?

    Edges are left out: the view takes one point of each of its pixels, the Cycles picture has pixels of another size
    and is averaged over them. At bright thin edges one is clipped where the other is not.
    """
    brightness = eyes.linear(pixels, EXPOSURE).mean(axis=-1)
    brightness[~eyes.unclipped(pixels)] = np.inf
    around = np.lib.stride_tricks.sliding_window_view(np.pad(brightness, 1, mode="edge"), (3, 3))
    return around.max(axis=(-2, -1)) < 2.0 * around.min(axis=(-2, -1))


def stopped_by_escape(rig):
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = 1920, 1080
    settings().anti_aliasing = 16
    ended = yield from eyes.render_started(rig)
    yield 3
    pulse = Pulse()
    yield 5
    rig.shot("views_9_rendering.png")
    pulse.stop(rig, "while F12 renders")
    rig.check(not ended, "the render still runs")
    start = time.monotonic()
    rig.xdo("key", "Escape")
    yield from until(lambda: ended, 20)
    seconds = time.monotonic() - start
    rig.fact("from Escape to the end of the render, s", round(seconds, 2))
    rig.check(ended == ["cancel"] and seconds < CANCEL_SECONDS, f"Escape stops the render at once: {ended}")
    yield 1
    rig.shot("views_9_cancelled.png")
