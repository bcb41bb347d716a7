"""Covered texels, against Blender's own bake."""

import bpy
import numpy as np
import pytest
import scene_parts
from material_scenes import Build
from mathutils import Vector

from ltsh_addon.blender.extract.bake_meshes import read_mesh
from ltsh_addon.cycles.uv import UvTriangles


def position_material():
    made = Build("Position")
    emission = made.shader("Emission")
    made.link(made.new("ShaderNodeNewGeometry").outputs["Position"], emission.node.inputs["Color"])
    return made.show(emission)


def baked_by_blender(ob, size):
    """Mask (size, size) of the texels that Blender bakes, row 0 below."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    if not ob.data.materials:
        ob.data.materials.append(position_material())
    image = bpy.data.images.new("Bake", size, size, alpha=True, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.zeros(size * size * 4, np.float32))
    tree = ob.data.materials[0].node_tree
    tree.nodes.active = tree.nodes.new("ShaderNodeTexImage")
    tree.nodes.active.image = image
    bpy.ops.object.bake(type="EMIT", margin=0, use_clear=False)
    pixels = np.empty(size * size * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(size, size, 4)[..., 3] > 0.5


def sphere():
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)


def suzanne():
    bpy.ops.mesh.primitive_monkey_add()
    modifier = bpy.context.object.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels = modifier.render_levels = 2


def two_tiles():
    """A plane over the tiles 1001 and 1002, in a small rotation."""
    bpy.ops.mesh.primitive_plane_add()
    corners = np.float32([(0.07, 0.11), (1.93, 0.05), (1.9, 0.93), (0.1, 0.88)])
    bpy.context.object.data.uv_layers.active.uv.foreach_set("vector", corners.ravel())


@pytest.mark.parametrize("size", [256, 1024])
@pytest.mark.parametrize("make", [sphere, bpy.ops.mesh.primitive_cube_add, suzanne, two_tiles])
def test_covered_texels_are_those_that_cycles_bakes(make, size):
    scene_parts.empty_scene()
    make()
    ob = bpy.context.object
    mesh, _, _ = read_mesh(ob, bpy.context.evaluated_depsgraph_get(), None)
    layer = ob.data.uv_layers.active.uv
    for tile in range(2 if make is two_tiles else 1):
        baked_texels = baked_by_blender(ob, size)
        ours = np.zeros(size * size, bool)
        ours[UvTriangles.in_tile(mesh.uv, size, size, (tile, 0)).texels(0, size).index] = True
        assert baked_texels.any() and np.array_equal(ours.reshape(size, size), baked_texels)
        # The next tile comes to where the first was.
        layer.foreach_set("vector", np.float32([value for item in layer for value in item.vector - Vector((1.0, 0.0))]))
