"""Covered texels are those that Cycles bakes."""

import bpy
import numpy as np
import pytest
import scene_parts

from ltsh_addon.cycles.uv import UvTriangles

# -- against Cycles ---------------------------------------------------------------------------------------------------


def sphere():
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)


def cube():
    bpy.ops.mesh.primitive_cube_add()


def suzanne():
    bpy.ops.mesh.primitive_monkey_add()
    bpy.context.object.modifiers.new("Subdivision", "SUBSURF").render_levels = 2


def two_tiles():
    """A plane over the tiles 1001 and 1002, in a small rotation."""
    bpy.ops.mesh.primitive_plane_add()
    uv = bpy.context.object.data.uv_layers.active.uv
    for loop, (u, v) in enumerate([(0.07, 0.11), (1.93, 0.05), (1.9, 0.93), (0.1, 0.88)]):
        uv[loop].vector = (u, v)


def baked_coverage(ob, size, folder, tiles=(1001,)):
    """Texels (tiles, size, size) that Cycles bakes, row 0 at the bottom."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    material = bpy.data.materials.new("White")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs[0], output.inputs[0])
    image = bpy.data.images.new("Bake", size, size, alpha=True, float_buffer=True, tiled=len(tiles) > 1)
    for number in tiles[1:]:
        image.tiles.new(number)
    for tile in image.tiles:
        image.tiles.active = tile
        with bpy.context.temp_override(edit_image=image):
            if len(tiles) > 1:
                bpy.ops.image.tile_fill(color=(0, 0, 0, 0), width=size, height=size, float=True, alpha=True)
    if len(tiles) == 1:
        image.pixels.foreach_set(np.zeros(size * size * 4, np.float32))
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image, tree.nodes.active = image, node
    ob.data.materials.clear()
    ob.data.materials.append(material)
    bpy.ops.object.bake(type="EMIT", margin=0, use_clear=False)
    found = []
    image.file_format = "OPEN_EXR"
    name = "bake.<UDIM>.exr" if len(tiles) > 1 else "bake.exr"
    image.filepath_raw = str(folder / name)
    image.save()
    for number in tiles:
        saved = bpy.data.images.load(str(folder / name.replace("<UDIM>", str(number))))
        pixels = np.empty(size * size * 4, np.float32)
        saved.pixels.foreach_get(pixels)
        found.append(pixels.reshape(size, size, 4)[..., 0] > 0.5)
    return np.array(found)


def uv_triangles_of(ob):
    """Triangles (T, 3, 2) of the active UV map with the modifiers of a render applied."""
    evaluated = ob.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    mesh.calc_loop_triangles()
    uv, loops = np.empty(2 * len(mesh.loops), np.float32), np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.uv_layers.active.uv.foreach_get("vector", uv)
    mesh.loop_triangles.foreach_get("loops", loops)
    triangles = uv.reshape(-1, 2)[loops].reshape(-1, 3, 2)
    evaluated.to_mesh_clear()
    return triangles


@pytest.mark.parametrize("size", [256, 1024])
@pytest.mark.parametrize("make", [sphere, cube, suzanne, two_tiles])
def test_covered_texels_are_those_that_cycles_bakes(tmp_path, make, size):
    scene_parts.empty_scene()
    make()
    ob = bpy.context.object
    for modifier in ob.modifiers:
        modifier.levels = modifier.render_levels
    tiles = (1001, 1002) if make is two_tiles else (1001,)
    baked = baked_coverage(ob, size, tmp_path, tiles)
    for number, coverage in zip(tiles, baked, strict=True):
        triangles = UvTriangles.in_tile(uv_triangles_of(ob), size, size, (number - 1001, 0))
        ours = np.zeros(size * size, bool)
        ours[triangles.texels(0, size).index] = True
        assert coverage.any()
        assert np.count_nonzero(ours.reshape(size, size) != coverage) == 0
