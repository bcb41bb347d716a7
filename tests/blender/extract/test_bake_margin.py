"""Covered texels and margins of adjacent faces: against Blender's own bake and a surface laid flat."""

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import baked, save, start
from material_scenes import Build
from mathutils import Vector
from scene_parts import add_plane, principled

from ltsh_addon import imaging
from ltsh_addon.blender.extract.bake_meshes import read_mesh
from ltsh_addon.cycles.uv import UvSeams, UvTriangles
from ltsh_addon.pipeline.bake_files import Planes

SIZE, MARGIN = 128, 6


def filled(folder, uv, vertices, colors):
    """Image (SIZE, SIZE, 3) of what `colors` gives for the covered texels, with its margin, row 0 below; coverage."""
    texels = UvTriangles.in_tile(uv, SIZE, SIZE).texels(0, SIZE)
    seams = UvSeams.of(uv, vertices, SIZE, SIZE)
    values = colors(texels)
    with Planes(folder / "planes", ["x.R", "x.G", "x.B"], SIZE, SIZE, seams) as planes:
        planes.put(0, SIZE, texels, {f"x.{letter}": values[:, axis] for axis, letter in enumerate("RGB")})
        planes.write(folder / "x.exr", MARGIN, {}, None)
    layers = imaging.read_layers(folder / "x.exr")
    return layers["x"][::-1], layers["coverage.hit"][::-1] > 0.0


def strip(turn):
    """Two squares of 0.3 that share an edge: uv (4, 3, 2) cut there, the second one turned about its middle by quarter
    turns and, where `turn` is negative, mirrored; vertices; positions (4, 3, 2) on the strip laid flat."""
    flat = np.array([[(0, 0), (1, 0), (1, 1), (0, 1)], [(1, 0), (2, 0), (2, 1), (1, 1)]])
    numbers = np.array([[0, 1, 2, 3], [1, 4, 5, 2]])
    local = flat[1] - (1.5, 0.5)
    if turn < 0:
        local = local * (1, -1)
    for _ in range(abs(turn)):
        local = np.stack([-local[:, 1], local[:, 0]], axis=-1)
    uv = 0.3 * np.stack([flat[0], local]) + np.array([(0.12, 0.55), (0.7, 0.25)])[:, None]
    halves = [[0, 1, 2], [0, 2, 3]]
    split = [values[:, halves].reshape(4, 3, *values.shape[2:]) for values in (uv, numbers, flat)]
    return split[0], split[1], split[2]


@pytest.mark.parametrize("turn", [0, 1, 2, 3, -1, -4])
def test_beyond_a_cut_the_margin_continues_the_surface_laid_flat(tmp_path, turn):
    uv, vertices, flat = strip(turn)

    def colors(texels):
        place = np.einsum("qk,qkc->qc", texels.barycentric, flat[texels.triangle])
        return np.stack([place[:, 0], place[:, 1], 1.0 + place[:, 0] - place[:, 1]], axis=-1).astype(np.float32)

    image, covered = filled(tmp_path, uv, vertices, colors)
    x, y = np.meshgrid(*2 * [(np.arange(SIZE) + 0.5) / SIZE])
    # The texels right of the first square, up to the margin and away from its corners.
    beside = (x > 0.42) & (x < 0.42 + (MARGIN - 1) / SIZE) & (y > 0.57) & (y < 0.83) & ~covered
    assert beside.sum() > 100
    across = (x[beside] - 0.12) / 0.3
    assert across.min() > 1.0
    expected = np.stack([across, (y[beside] - 0.55) / 0.3], axis=-1)
    # Positions of texels are off by 0.002 of a texel where their center is on an edge, which is 1 / 38 of a square; at
    # the cut itself one texel may stand for four.
    far = np.abs(image[beside][:, :2] - expected).max(axis=1)
    assert np.quantile(far, 0.8) < 1e-3 and far.max() < 1.0 / (0.3 * SIZE)
    # Its left side is no cut but where the surface ends: there the nearest texel is repeated.
    open_side = (x < 0.12) & (x > 0.12 - (MARGIN - 1) / SIZE) & (y > 0.57) & (y < 0.83) & ~covered
    assert np.abs(image[open_side][:, 0]).max() < 1.0 / (0.3 * SIZE)


def position_material():
    made = Build("Position")
    emission = made.shader("Emission")
    made.link(made.new("ShaderNodeNewGeometry").outputs["Position"], emission.node.inputs["Color"])
    return made.show(emission)


def blender_bake(ob, margin, size=SIZE):
    """Positions (size, size, 3) as Blender bakes them, row 0 below, 0 beyond the margin; which texels it bakes."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    if not ob.data.materials:
        ob.data.materials.append(position_material())
    image = bpy.data.images.new("Bake", size, size, alpha=True, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.zeros(size * size * 4, np.float32))
    tree = ob.data.materials[0].node_tree
    tree.nodes.active = tree.nodes.new("ShaderNodeTexImage")
    tree.nodes.active.image = image
    bpy.ops.object.bake(type="EMIT", margin=margin, margin_type="ADJACENT_FACES", use_clear=False)
    pixels = np.empty(size * size * 4, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(size, size, 4)
    return pixels[..., :3], pixels[..., 3] > 0.5


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
        _, baked_texels = blender_bake(ob, 0, size)
        ours = np.zeros(size * size, bool)
        ours[UvTriangles.in_tile(mesh.uv, size, size, (tile, 0)).texels(0, size).index] = True
        assert baked_texels.any() and np.array_equal(ours.reshape(size, size), baked_texels)
        # The next tile comes to where the first was.
        layer.foreach_set("vector", np.float32([value for item in layer for value in item.vector - Vector((1.0, 0.0))]))


@pytest.mark.parametrize(
    ("kind", "share"),
    # Of the margin, in front of an edge of the faces; the rest are corners, where Blender takes some farther edge, and
    # gaps between the triangles at a pole, which it crosses several times.
    [("cube", 0.93), ("uv_sphere", 0.9), ("monkey", 0.7)],
)
def test_margins_agree_with_blenders_own(tmp_path, kind, share):
    scene_parts.empty_scene()
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")()
    ob = bpy.context.object
    (plain, _), (wide, _) = blender_bake(ob, 0), blender_bake(ob, MARGIN)
    mesh, _, _ = read_mesh(ob, bpy.context.evaluated_depsgraph_get(), None)

    def colors(texels):
        return plain.reshape(-1, 3)[texels.index]

    image, covered = filled(tmp_path, mesh.uv, mesh.vertices, colors)
    margin = ~covered & image.any(axis=-1) & wide.any(axis=-1)
    assert margin.sum() > 0.9 * (~covered & image.any(axis=-1)).sum() > 500
    # Objects of 2 m on a few dozen texels: one stands for this many meters.
    texel = np.abs(np.diff(plain, axis=0)).max(axis=-1)[covered[1:] & covered[:-1]]
    apart = np.abs(image - wide).max(axis=-1)[margin]
    assert (apart < np.median(texel)).mean() > share, np.percentile(apart / np.median(texel), [50, 70, 90, 95])
    assert np.median(apart) < 0.12 * np.median(texel)


def test_a_bake_with_adjacent_faces_differs_in_the_margin_alone(tmp_path):
    start(camera=None)
    ob = add_plane(principled(Roughness=0.5)[0], size=2.0)
    bpy.ops.mesh.primitive_cube_add(size=1.0)
    bpy.context.object.data.materials.append(ob.data.materials[0])
    path = save(tmp_path)
    options = {"objects": ("Cube",), "view": "above", "passes": ("diffuse",), "margin": 3}
    _, plain = baked(path, tmp_path / "extend", **options)
    _, across = baked(path, tmp_path / "adjacent", margin_type="adjacent", **options)
    before, after = plain["Cube.exr"], across["Cube.exr"]
    covered = before["coverage.hit"] > 0.0
    assert np.array_equal(before["coverage.hit"], after["coverage.hit"])
    assert np.array_equal(before["ltsh4c.diffuse"][covered], after["ltsh4c.diffuse"][covered])
    assert np.abs(before["ltsh4c.diffuse"] - after["ltsh4c.diffuse"]).max() > 0.0
    with pytest.raises(ValueError, match="margin_type is 'wide', expected extend or adjacent"):
        baked(path, tmp_path / "wrong", margin_type="wide")
