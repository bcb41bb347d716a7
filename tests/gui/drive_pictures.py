"""Takes pictures for the manual: the preview of the example scene, and its difference to Cycles.

docs/viewport.png is made of `pictures_viewport.png`, docs/viewport_difference.png of `pictures_difference.png`.
`drive_artist.py` takes what docs/artist.png (its `artist_11_*.png`) and docs/blender.png (`artist_14_window.png`) show.
"""

import bpy
import eyes
from hands import editor_for_results, module, operate, select, settings

SECONDS = 1200
SIZE = "1280x760"
# A view at rest is smooth by then, on a busy machine without a graphics card too.
REST_SECONDS = 100


def main(rig):
    rig.camera_view()
    rig.panel()
    yield 1
    rig.tab("LTSH")
    editor_for_results(rig)
    operate(rig, bpy.ops.ltsh.preview)
    select(rig, bpy.data.objects["Sunset"])
    # The frame of the camera beside the sidebar, at rest soon: few further points leave time for fine shadows.
    module("engine.redraws").REFINEMENTS = 6
    view = rig.space.region_3d
    view.view_camera_zoom, view.view_camera_offset = 2.0, (0.14, 0.0)
    yield REST_SECONDS
    rig.shot("pictures_viewport.png", area="VIEW_3D")
    settings().techniques, settings().cycles_samples = {"ltsh4"}, 64
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = 960, 540
    settings().resolution_percentage, settings().anti_aliasing = 100, 4
    rig.space.show_region_ui = False
    with rig.override():
        bpy.ops.ltsh.compare()
    rig.check("LTSH cycles.combined" in bpy.data.images, "there is a picture by Cycles")
    eyes.bare_view(rig)
    eyes.view().mode, eyes.view().technique, eyes.view().second_technique = "difference", "ltsh4", "cycles"
    operate(rig, bpy.ops.screen.screen_full_area, use_hide_panels=True)
    yield 3
    operate(rig, bpy.ops.view3d.view_center_camera)
    yield REST_SECONDS
    rig.shot("pictures_difference.png")
