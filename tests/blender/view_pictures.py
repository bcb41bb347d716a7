"""What the viewport shows of an open scene, for comparison with samples that Cycles took of the same view."""

from __future__ import annotations

import bpy
import numpy as np
import scene_parts as parts
from graphics_card import Canvas

from ltsh_addon import shading
from ltsh_addon.blender.processes import child
from ltsh_addon.blender.viewport.scene_mirror import SceneMirror
from ltsh_addon.blender.viewport.surface_pass import View
from ltsh_addon.blender.viewport.view_renderer import ShownPicture, ViewRenderer

SIZE = (96, 72)
COLUMNS = 4
# Mesa's llvmpipe decodes the colors of sRGB images by a polynomial, up to 0.7 % off; without them 5e-3 would do.
RELATIVE, ABSOLUTE = 1e-2, 1e-4


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


def patches_of(materials):
    """One square of each material, side by side, seen from above and a light over them."""
    scene = parts.empty_scene(*SIZE)
    rows = -(-len(materials) // COLUMNS)
    for number, make in enumerate(materials):
        row, column = divmod(number, COLUMNS)
        parts.add_plane(make(), size=1.0, location=(column + 0.5 - 0.5 * COLUMNS, row + 0.5 - 0.5 * rows, 0.0))
    parts.add_area_light(location=(0.5, 0.6, 1.4), size=1.5, size_y=1.0)
    camera = parts.add_camera((0.0, -2.6, 3.4), (0.6, 0.0, 0.0))
    bpy.context.view_layer.update()
    return scene, camera


def sampled_pictures(path, passes, rows):
    """Pictures (H, W, 3) by pass of the samples that Cycles took, and the number of the square (H, W) that each pixel
    sees, or -1."""
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    found = child.extract(child.ExtractOptions(scene=path))
    shaded = shading.shade(found.samples, found.lights, "ltsh4", passes=passes, workers=1)
    square = np.full(SIZE[0] * SIZE[1], -1)
    column, row = (np.floor(found.samples.position[:, axis] + 0.5 * count).astype(int)
                   for axis, count in enumerate((COLUMNS, rows)))  # fmt: skip
    square[found.film.pixel] = COLUMNS * row + column
    pictures = {name: found.film.image(getattr(shaded, name).sum(axis=0)) for name in passes}
    return pictures, square.reshape(SIZE[1], SIZE[0])


def times_too_far(picture, expected):
    """How many times as far `picture` is from what is expected as it may be, by number."""
    return np.abs(picture - expected) / (ABSOLUTE + RELATIVE * np.abs(expected))
