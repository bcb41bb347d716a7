"""The engine LTSH in the viewport: drag a light by the mouse, choose what is seen, drag the line, F12, back to Cycles.

To be opened with the example scene. The pictures on the screen are compared with those of numpy: a final render of the
same view, whose passes hold what every technique makes of it.
"""

import bpy
import eyes
import numpy as np
from hands import CLICK_SECONDS, drag, operate, select, view_middle

SECONDS = 1800
# Dark enough that next to nothing is clipped.
EXPOSURE = -1.5
LABELS = {"ltc": "LTC", "ltsh2": "LTSH 2", "ltsh4": "LTSH 4"}


def main(rig):
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    rig.camera_view()
    eyes.pixel_centers()
    yield 1
    yield from previewed(rig)
    yield from with_panel(rig)
    eyes.bare_view(rig)
    eyes.free_view(rig, scene.camera)
    eyes.plain_colors(scene, EXPOSURE)
    # Exact pictures have none: the first shadows of a view are coarse.
    scene.ltsh.shadows = False
    yield from light_dragged(rig)
    seen = yield from techniques(rig)
    yield from passes(rig, seen["ltsh4"])
    yield from split(rig, seen)
    yield from difference(rig, seen)
    yield from rendered(rig, seen)
    yield from back_to_cycles(rig)


def previewed(rig):
    operate(rig, bpy.ops.ltsh.preview)
    rig.check(bpy.context.scene.render.engine == "LTSH", "the preview has our engine")
    rig.check(rig.space.shading.type == "RENDERED", "the preview has Rendered shading")
    pixels = yield from eyes.settled(rig, "engine_1_preview.png")
    rig.check(0.02 < pixels.mean() < 0.9 and pixels.std() > 0.05, "the view shows a picture")


def with_panel(rig):
    """The split view as the artist has it: by the panel in the sidebar, with overlays and gizmos."""
    rig.panel()
    yield 1
    rig.tab("LTSH")
    eyes.view().mode, eyes.view().technique, eyes.view().second_technique = "split", "ltc", "ltsh4"
    rig.space.region_3d.view_camera_zoom = 14.0
    yield 2
    rig.shot("engine_1_panel.png", area="VIEW_3D")
    eyes.view().mode, eyes.view().technique = "single", "ltsh4"
    rig.space.region_3d.view_camera_zoom = 0.0


def light_dragged(rig):
    before = yield from eyes.settled(rig, "engine_2_before.png")
    light = bpy.data.objects["Porthole"]
    place = light.location.copy()
    select(rig, light)
    x, y = view_middle(rig)
    rig.xdo("mousemove", x, y)
    yield CLICK_SECONDS
    rig.xdo("key", "g")
    yield CLICK_SECONDS
    for step in range(1, 5):
        rig.xdo("mousemove", x + 30 * step, y + 6 * step)
        yield CLICK_SECONDS
    rig.shot("engine_2_dragging.png")
    rig.xdo("click", 1)
    yield CLICK_SECONDS
    yield from eyes.differs(rig, "engine_2_after.png", before, "the picture follows the light", 0.005)
    rig.check((light.location - place).length > 0.2, "the mouse has moved the light")


def techniques(rig):
    """What the screen shows for each technique."""
    seen = {}
    for name in LABELS:
        eyes.view().technique = name
        seen[name] = yield from eyes.settled(rig, f"engine_3_{name}.png")
    for name in ("ltc", "ltsh2"):
        rig.check(np.abs(seen[name] - seen["ltsh4"]).max() > 0.02, f"{name} does not look like ltsh4")
    return seen


def passes(rig, both):
    """`both` is the sum of what the specular and the diffuse pass show."""
    total = np.zeros_like(both)
    for name in ("specular", "diffuse"):
        eyes.view().shown = name
        pixels = yield from eyes.settled(rig, f"engine_4_{name}.png")
        total += eyes.linear(pixels, EXPOSURE)
    eyes.view().shown = "combined"
    error = eyes.relative_l2(total, eyes.linear(both, EXPOSURE), eyes.unclipped(both))
    rig.fact("specular + diffuse against both", error)
    rig.check(error < eyes.AGREEMENT, "specular and diffuse add up")


def split(rig, seen):
    settings = eyes.view()
    settings.mode, settings.technique, settings.second_technique, settings.split_position = "split", "ltc", "ltsh4", 0.5
    rig.space.show_gizmo = True
    yield from eyes.settled(rig, "engine_5_split.png")
    region = rig.region()
    y = rig.size[1] - region.y - region.height // 4
    start, end = ((region.x + round(share * region.width), y) for share in (0.5, 0.3))
    yield from drag(rig, start, end)
    rig.check(abs(settings.split_position - 0.3) < 0.02, f"the line follows the mouse: {settings.split_position:.3f}")
    rig.space.show_gizmo = False
    pixels = yield from eyes.settled(rig, "engine_5_dragged.png")
    line = round(settings.split_position * region.width) - (region.width - pixels.shape[1]) // 2
    # The line and the captions at the upper end are no part of the pictures.
    rows = slice(60, None)
    for name, columns in (("ltc", slice(0, line - 4)), ("ltsh4", slice(line + 4, None))):
        same = np.array_equal(pixels[rows, columns], seen[name][rows, columns])
        rig.check(same, f"{name} on its side of the line is the whole picture's")


def difference(rig, seen):
    settings = eyes.view()
    settings.mode, settings.technique, settings.second_technique = "difference", "ltsh4", "ltc"
    settings.difference_scale = 0.25
    pixels = yield from eyes.settled(rig, "engine_6_difference.png")
    truth = (eyes.linear(seen["ltsh4"], EXPOSURE) - eyes.linear(seen["ltc"], EXPOSURE)).mean(axis=-1)
    certain = eyes.unclipped(seen["ltsh4"]) & eyes.unclipped(seen["ltc"]) & (np.abs(truth) > 0.03)
    rig.fact("pixels that differ", int(certain.sum()))
    reddish = pixels[..., 0] > pixels[..., 2]
    rig.check(certain.any() and np.array_equal(reddish[certain], truth[certain] > 0.0), "red is brighter, blue darker")
    settings.second_technique = "ltsh4"
    pixels = yield from eyes.settled(rig, "engine_6_nothing.png")
    rig.check(np.ptp(pixels[100:], axis=-1).max() < 0.02, "a technique does not differ from itself")
    settings.mode, settings.second_technique = "single", "ltc"


def rendered(rig, seen):
    """F12 through a camera that sees what the view shows."""
    scene = bpy.context.scene
    camera, resolution = scene.camera, (scene.render.resolution_x, scene.render.resolution_y)
    scene.camera = eyes.camera_like_view(rig, "Like the view")
    scene.ltsh.anti_aliasing, eyes.view().technique_passes, eyes.view().technique = 1, True, "ltsh4"
    found = yield from eyes.final_render(rig)
    rig.shot("engine_7_f12.png")
    for name, label in LABELS.items():
        picture = found[f"{label} Specular"] + found[f"{label} Diffuse"]
        usable = eyes.check_against_numpy(rig, name, seen[name], picture, EXPOSURE)
        rig.check(usable.mean() > 0.97, f"{name}: next to nothing of the view is clipped")
    rig.xdo("key", "Escape")
    yield 2
    scene.camera, (scene.render.resolution_x, scene.render.resolution_y) = camera, resolution


def back_to_cycles(rig):
    operate(rig, bpy.ops.ltsh.preview)
    rig.check(bpy.context.scene.render.engine == "CYCLES", "the artist's engine is back")
    rig.check(rig.space.shading.type == "SOLID", "the artist's shading is back")
    yield 1
    rig.space.shading.type = "RENDERED"
    yield 15
    rig.shot("engine_8_cycles.png")
