"""What the viewport shows of an open scene, for comparison with samples that Cycles took of the same view."""

from __future__ import annotations

import bpy
import numpy as np
import scene_parts as parts
from graphics_card import Canvas, with_graphics

from ltsh_addon import shading
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.blender.viewport.mirror import SceneMirror
from ltsh_addon.blender.viewport.pictures import ShownPicture
from ltsh_addon.blender.viewport.renderer import ViewRenderer
from ltsh_addon.blender.viewport.still import view_of_camera

SIZE = (96, 72)
COLUMNS = 4
# Mesa's llvmpipe decodes the colors of sRGB images by a polynomial, up to 0.7 % off; without them 5e-3 would do.
RELATIVE, ABSOLUTE = 1e-2, 1e-4


class OpenView:
    """The view of a camera over the open scene, where the graphics card may be used."""

    def __init__(self, camera, size=SIZE):
        depsgraph = bpy.context.evaluated_depsgraph_get()
        self.size, self.view = size, view_of_camera(camera, depsgraph, size)
        self.mirror, self.renderer, self.canvas = SceneMirror(), ViewRenderer(), Canvas(*size)
        self.mirror.sync(depsgraph)

    def draw(self, shown, *points):
        """The canvas (H, W, 4), row 0 at the bottom, once it shows `shown`."""
        self.renderer.draw(self.mirror, self.view, self.size, shown, self.canvas.buffer, *points)
        return self.canvas.read()

    def light(self, technique, passes, *points):
        """What was drawn (H, W, 3) before a background and the color management of a window, row 0 at the bottom."""
        self.draw(ShownPicture(technique, passes, transparent=True), *points)
        return self.renderer.read()[..., :3].astype(np.float64)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.renderer.free()


def viewport_picture(camera, shown):
    """(H, W, 3), row 0 on top, and the notes."""
    with OpenView(camera) as opened:
        return opened.light("ltsh4", shown)[::-1], opened.mirror.notes


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
    found = extract_pixels(PixelJob(scene=path))
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


def image(name, is_data=False, shape=(8, 8)):
    """A packed image of random colors."""
    made = bpy.data.images.new(name, *shape, is_data=is_data)
    pixels = np.ones((shape[1], shape[0], 4), np.float32)
    pixels[..., :3] = np.random.default_rng(len(name)).uniform(0.2, 0.9, (shape[1], shape[0], 3))
    made.pixels.foreach_set(pixels.ravel())
    made.update()
    made.pack()
    return made


def textured(name, socket, is_data=False, **settings):
    """A Principled BSDF with an image at `socket`; material, its node, and the image's."""
    material, node = parts.principled(name, Roughness=0.35)
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image(name, is_data)
    for key, value in settings.items():
        setattr(texture, key, value)
    material.node_tree.links.new(texture.outputs["Color"], node.inputs[socket])
    return material, node, texture


def normal_map():
    material, node, texture = textured("normal map", "Base Color", is_data=True)
    tree = material.node_tree
    pixels = np.array(texture.image.pixels[:]).reshape(-1, 4)
    slopes = np.random.default_rng(4).uniform(-0.25, 0.25, (len(pixels), 2))
    pixels[:, :2], pixels[:, 2] = 0.5 + 0.5 * slopes, 0.5 + 0.5 * np.sqrt(1.0 - (slopes**2).sum(axis=1))
    texture.image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    texture.image.pack()
    bump = tree.nodes.new("ShaderNodeNormalMap")
    bump.inputs["Strength"].default_value = 0.6
    tree.links.remove(node.inputs["Base Color"].links[0])
    tree.links.new(texture.outputs["Color"], bump.inputs["Color"])
    tree.links.new(bump.outputs["Normal"], node.inputs["Normal"])
    return material


def patches_too_far(path, materials, kind, passes) -> list[str]:
    """Which of `materials` the viewport shows otherwise than samples that Cycles took, by passes and how far.

    `kind` is the camera's type; nothing may be named as not shown.
    """
    _, camera = patches_of(materials)
    camera.data.type, camera.data.ortho_scale = kind, 4.2
    seen = with_graphics(lambda: [viewport_picture(camera, name) for name in passes])
    expected, square = sampled_pictures(path, passes, -(-len(materials) // COLUMNS))
    usable = away_from_edges(square)
    failures = []
    for name, (picture, notes) in zip(passes, seen, strict=True):
        assert notes == []
        times = times_too_far(picture, expected[name])
        for number in range(len(materials)):
            pixels = usable & (square == number)
            assert pixels.sum() > 50
            if times[pixels].max() > 1.0:
                material = bpy.data.objects[f"Plane.{number:03d}" if number else "Plane"].active_material.name
                failures.append(f"{material}, {name}: {times[pixels].max():.1f} times as far off as it may be")
        assert expected[name][usable].max() > 0.05
    return failures
