"""What the viewport shows of an open scene, for comparison with samples that Cycles took of the same view."""

from __future__ import annotations

import bpy
import numpy as np
from graphics_card import Canvas

from ltsh_addon.blender.viewport.scene_mirror import SceneMirror
from ltsh_addon.blender.viewport.surface_pass import View
from ltsh_addon.blender.viewport.view_renderer import ShownPicture, ViewRenderer

SIZE = (96, 72)


def viewport_picture(camera, shown, is_parallel):
    """(H, W, 3), row 0 on top, and the notes."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(depsgraph, x=SIZE[0], y=SIZE[1])
    mirror, renderer, canvas = SceneMirror(), ViewRenderer(), Canvas(*SIZE)
    try:
        mirror.sync(depsgraph)
        view = View.of(camera.matrix_world.inverted(), projection, is_parallel)
        settings = ShownPicture("ltsh4", shown, "single", "ltc", 0.5, 1.0, 1.0, True)
        renderer.draw(mirror, view, SIZE, settings, canvas.buffer)
        return renderer.read()[::-1, :, :3].astype(np.float64), mirror.notes
    finally:
        renderer.free()


def away_from_edges(square):
    """Pixels (H, W) all of whose neighbors see the same square."""
    same = square >= 0
    for axis in (0, 1):
        for step in (-1, 1):
            same &= np.roll(square, step, axis) == square
    same[0] = same[-1] = same[:, 0] = same[:, -1] = False
    return same
