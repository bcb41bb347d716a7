"""What the drivers see: the pixels of the 3D view as the screen has them, in linear colors where that is wanted."""

import dataclasses
import importlib
import time

import bpy
import numpy as np
from hands import ADDON, module, over, until

# Pixels at the edge of a region, over which Blender draws the rounded corners of its areas.
EDGE = 12
SETTLE_SECONDS = 0.7
COMING_SECONDS = 60.0  # the longest that a view compiles shaders, or draws what moves with fewer pixels
# The key by its code: for the name xdotool also presses Alt.
F12 = 96
# Graphics cards round corners to 1/256 pixel: at an edge they may see the other surface at a pixel's center.
EDGE_SHARE = 1e-3
# Of this the 256 steps of the screen take 0.004.
AGREEMENT = 0.01
RENDER_SECONDS = 600


def view():
    """What the engine LTSH shows."""
    return bpy.context.scene.ltsh_view


def engine_started(rig):
    """See the scene through its camera as the engine LTSH draws it."""
    pixel_centers()
    bpy.context.scene.render.engine = "LTSH"
    rig.camera_view()
    yield 1
    rig.space.shading.type = "RENDERED"


def pixel_centers():
    """Views come to rest with their first picture, of direct light alone, which sees pixels at their centers."""
    view().bounces = False
    module("engine.redraws").REFINEMENTS = 1


def bare_view(rig):
    """Nothing but the picture in the 3D view, without the line about what it leaves out too."""
    space, view_module = rig.space, module("engine.view")
    show, nothing = view_module.show, module("engine.overlay").QuietLine()
    view_module.show = lambda region, texts: show(region, dataclasses.replace(texts, quiet=nothing))
    space.overlay.show_overlays = space.show_gizmo = False
    space.show_region_header = space.show_region_tool_header = False
    space.show_region_toolbar = space.show_region_ui = space.show_region_hud = False


def free_view(rig, camera):
    """See about what `camera` sees, without its frame."""
    view = rig.space.region_3d
    view.view_perspective = "PERSP"
    view.view_matrix = camera.matrix_world.inverted()
    # The sensor of a free view is twice as wide as that of a camera.
    rig.space.lens = 2.0 * camera.data.lens


def png(path):
    """Numbers between 0 and 1 (H, W, 3) of a saved picture, row 0 on top."""
    image = bpy.data.images.load(str(path), check_existing=False)
    try:
        image.colorspace_settings.name = "Non-Color"
        flat = np.empty(4 * image.size[0] * image.size[1], np.float32)
        image.pixels.foreach_get(flat)
        return flat.reshape(image.size[1], image.size[0], 4)[::-1, :, :3].astype(np.float64)
    finally:
        bpy.data.images.remove(image)


def view_pixels(rig, name, region=None):
    """What the 3D view shows without its edge: (H, W, 3) between 0 and 1, row 0 on top; `name` gets the window."""
    region = region or rig.region()
    window = png(rig.shot(name))
    top = rig.size[1] - region.y - region.height
    whole = window[top : top + region.height, region.x : region.x + region.width]
    return inside(whole)


def inside(image):
    """`image` without its edge."""
    return image[EDGE:-EDGE, EDGE:-EDGE]


def is_coming(region):
    """True while the view of a region compiles shaders, while what moves has fewer pixels, or while a second Blender
    looks at a world."""
    if any(look.thread is not None for look in module("viewport.live_cycles")._world_looks.values()):
        return True
    texts = module("engine.overlay")._texts.get(region.as_pointer())
    is_compiling = texts is not None and module("engine.view").COMPILING in texts.notes
    return is_compiling or any(view._pixel_size.step > 1 for view in module("engine.redraws").open_views)


def settled(rig, name, tries=40):
    """Wait until the view does not change any more; use as `pixels = yield from settled(...)`."""
    before, end = None, time.monotonic() + COMING_SECONDS
    for _ in range(tries):
        yield SETTLE_SECONDS
        while is_coming(rig.region()) and time.monotonic() < end:
            yield SETTLE_SECONDS
        pixels = view_pixels(rig, name)
        if before is not None and np.array_equal(pixels, before):
            return pixels
        before = pixels
    rig.check(False, f"{name}: the view comes to rest")
    return before


def same_again(rig, name, whole, what):
    """Check that the view comes to show the picture `whole`."""
    pixels = yield from settled(rig, name)
    rig.check(np.array_equal(pixels, whole), what)


def differs(rig, name, whole, what, least=1e-3):
    """Check that the view comes to show another picture; the picture."""
    pixels = yield from settled(rig, name)
    rig.check(np.abs(pixels - whole).mean() > least, what)
    return pixels


def plain_colors(scene, exposure):
    """Make the view transform one that `linear` can undo: sRGB's curve and an exposure."""
    view = scene.view_settings
    view.view_transform, view.look, view.exposure, view.gamma = "Standard", "None", exposure, 1.0
    view.use_curve_mapping = False


def linear(pixels, exposure):
    """Scene-linear colors behind pixels of the screen (IEC 61966-2-1)."""
    low = pixels / 12.92
    return np.where(pixels <= 0.04045, low, ((pixels + 0.055) / 1.055) ** 2.4) / 2.0**exposure


def unclipped(pixels):
    """(H, W): is every channel below the brightest that a screen shows?"""
    return (pixels < 254.0 / 255.0).all(axis=-1)


def relative_l2(found, expected, where):
    """Length of the difference by the length of `expected`, over the pixels `where` (H, W)."""
    return float(np.linalg.norm((found - expected)[where]) / np.linalg.norm(expected[where]))


def without_edges(found, expected, where):
    """`where` (H, W) without the `EDGE_SHARE` of its pixels that differ most."""
    difference = np.where(where, np.square(found - expected).sum(axis=-1), 0.0)
    return where & (difference <= np.quantile(difference[where], 1.0 - EDGE_SHARE))


def camera_like_view(rig, name):
    """A new camera that sees what the 3D view shows; the scene's resolution becomes that of the view."""
    scene, region = bpy.context.scene, rig.region()
    view = rig.space.region_3d
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    matrix, aspect = view.window_matrix, region.height / region.width
    if view.is_perspective:
        data.lens = 0.5 * data.sensor_width * matrix[0][0]
        data.shift_x, data.shift_y = 0.5 * matrix[0][2], 0.5 * matrix[1][2] * aspect
    else:
        data.type, data.ortho_scale = "ORTHO", 2.0 / matrix[0][0]
        data.shift_x, data.shift_y = -0.5 * matrix[0][3], -0.5 * matrix[1][3] * aspect
    data.clip_start, data.clip_end = 0.01, 1000.0
    camera = bpy.data.objects.new(name, data)
    scene.collection.objects.link(camera)
    camera.matrix_world = view.view_matrix.inverted()
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = region.width, region.height, 100
    return camera


def render_started(rig):
    """Press F12; a list that "complete" or "cancel" is put into when the render ends. To be used with `yield from`."""
    ended = []
    bpy.context.preferences.view.render_display_type = "SCREEN"
    bpy.app.handlers.render_complete.append(lambda *_: ended.append("complete"))
    bpy.app.handlers.render_cancel.append(lambda *_: ended.append("cancel"))
    yield from over(rig)
    rig.xdo("key", F12)
    return ended


def final_render(rig):
    """Press F12 for direct light alone and wait; its passes as `passes_of` has them. To be used with `yield from`."""
    scene = bpy.context.scene
    view().complete = False
    ended = yield from render_started(rig)
    start = time.monotonic()
    yield from until(lambda: ended, RENDER_SECONDS)
    rig.fact("F12, s", round(time.monotonic() - start, 1))
    rig.check(ended == ["complete"], f"F12 ends well: {ended}")
    yield 2
    settings, path = scene.render.image_settings, rig.out / "final.exr"
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    bpy.data.images["Render Result"].save_render(str(path), scene=scene)
    found = passes_of(path)
    path.unlink()
    return found


def check_against_numpy(rig, name, seen, expected, exposure, where=True):
    """Check that the pixels `seen` of the view show `expected`, the final render of the same view with its edge, within
    `AGREEMENT` in relative L2, over the pixels `where` (H, W) that are not clipped."""
    expected, shown = inside(expected), linear(seen, exposure)
    usable = unclipped(seen) & (expected < linear(254.0 / 255.0, exposure)).all(axis=-1)
    rig.fact(f"{name}: share of clipped pixels", round(1.0 - float(usable.mean()), 4))
    usable &= where
    rig.fact(f"{name}: relative L2 with edges", round(relative_l2(shown, expected, usable), 5))
    error = relative_l2(shown, expected, without_edges(shown, expected, usable))
    rig.fact(f"{name}: relative L2 of the screen against numpy", round(error, 5))
    rig.check(error < AGREEMENT, f"{name}: the view shows what numpy renders, within {AGREEMENT}")
    return usable


def passes_of(path):
    """Pictures (H, W, 3) by pass of a multi-layer EXR, row 0 on top."""
    channels = importlib.import_module(f"{ADDON}.imaging.exr").read_channels(path)
    names = {key.rpartition(".")[0] for key in channels if key.endswith(".R")}
    return {
        name.partition(".")[2]: np.stack([channels[f"{name}.{letter}"] for letter in "RGB"], axis=-1).astype(np.float64)
        for name in names
    }
