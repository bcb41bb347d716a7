"""Atlases: many objects in one texture, each with its own texels, at one density."""

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import baked, save, start
from material_scenes import Build
from scene_parts import add_plane, add_sphere, principled

from ltsh_addon.blender.extract.atlas import BORDER, DENSITY, make_atlas
from ltsh_addon.cycles.uv import UvTriangles
from ltsh_addon.scene import ATLAS, SceneError

SIDE = 128


def room():
    """A plane with a noise texture, a sphere, and two boxes of one mesh, one of them stretched and mirrored."""
    start(camera=(0.0, -3.0, 3.0))
    noise = Build("Noise")
    shader = noise.shader("BsdfPrincipled", Roughness=0.5)
    noise.link(
        noise.new("ShaderNodeTexNoise", Scale=0.7, Detail=0.0).outputs["Color"], shader.node.inputs["Base Color"]
    )
    noise.show(shader)
    gray = principled("Gray", Roughness=0.6)[0]
    floor = add_plane(noise.material, size=3.0, name="Floor")
    ball = add_sphere(gray, radius=0.4, location=(-0.6, 0.0, 0.5), segments=16)
    ball.name = "Ball"
    bpy.ops.mesh.primitive_cube_add(size=0.4, location=(0.7, 0.0, 0.3))
    box = bpy.context.object
    box.name = "Box"
    box.data.materials.append(noise.material)
    twin = bpy.data.objects.new("Twin", box.data)
    scene_parts.link(twin)
    twin.location, twin.scale = (0.2, 0.9, 0.4), (3.0, -1.0, 0.5)
    bpy.context.view_layer.update()
    return floor, ball, box, twin


def triangles_of(ob):
    """UV coordinates (T, 3, 2) in the atlas, and corners (T, 3, 3) in world space."""
    mesh = ob.data
    mesh.calc_loop_triangles()
    loops = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("loops", loops)
    uv, at = np.empty((len(mesh.loops), 2), np.float32), np.empty((len(mesh.vertices), 3), np.float32)
    mesh.uv_layers[ATLAS].uv.foreach_get("vector", uv.ravel())
    mesh.vertices.foreach_get("co", at.ravel())
    vertex = np.array([loop.vertex_index for loop in mesh.loops])[loops]
    world = at[vertex] @ np.array(ob.matrix_world)[:3, :3].T
    return uv[loops].reshape(-1, 3, 2).astype(np.float64), world.reshape(-1, 3, 3)


def islands_of(uv):
    """The number (T,) of the island of each triangle: triangles with a common corner are in one."""
    number, at = np.arange(len(uv)), {}
    for triangle, corners in enumerate(np.round(uv * 1e5).astype(int)):
        for corner in map(tuple, corners):
            number[number == number[triangle]] = number[at.setdefault(corner, triangle)]
    return number


def owners(objects, side):
    """The island (side, side) that touches each texel, -1 without; no texel is touched twice."""
    owner, first = np.full((side, side), -1), 0
    for ob in objects:
        uv = triangles_of(ob)[0]
        texels = UvTriangles.in_tile(uv, side, side).texels(0, side, conservative=True)
        assert (owner.reshape(-1)[texels.index] == -1).all(), ob.name
        owner.reshape(-1)[texels.index] = first + islands_of(uv)[texels.triangle]
        first += len(uv)
    return owner


def distance_of(owner):
    """The smallest distance in texels, along rows and columns, of texels of different islands; at most 8."""
    for distance in range(1, 9):
        for axis in (0, 1):
            a, b = np.moveaxis(owner, axis, 0)[distance:], np.moveaxis(owner, axis, 0)[:-distance]
            if ((a >= 0) & (b >= 0) & (a != b)).any():
                return distance
    return 9


@pytest.mark.parametrize("unwrap", ["smart", "faces"])
def test_islands_have_one_density_and_keep_their_distance(unwrap):
    objects = room()
    objects[1][DENSITY] = 2.0
    densities, problems = make_atlas(objects, 256, 25.0, unwrap)
    assert not problems
    for ob in objects:
        uv, world = triangles_of(ob)
        sides = 256.0 * (uv[:, 1:] - uv[:, :1])
        texels = 0.5 * np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
        metres = 0.5 * np.linalg.norm(np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0]), axis=1)
        wanted = 50.0 if ob is objects[1] else 25.0
        # Single precision; where islands are curved, only their means have the density.
        assert densities[ob.name] == pytest.approx(wanted, rel=1e-4)
        assert np.sqrt(texels.sum() / metres.sum()) == pytest.approx(wanted, rel=1e-4)
        if ob is not objects[1]:
            np.testing.assert_allclose(np.sqrt(texels / metres), wanted, rtol=1e-3)
    # Twice BORDER between islands, less the texels that they touch without covering their centers.
    assert distance_of(owners(objects, 256)) >= 2 * BORDER
    assert objects[2].data != objects[3].data


def test_making_an_atlas_adds_a_uv_map_and_nothing_else():
    objects = room()
    objects[3].data = objects[3].data.copy()
    objects[0].data.polygons[0].hide = True
    counts = [len(getattr(bpy.data, name)) for name in ("objects", "meshes", "scenes", "materials", "collections")]
    before = [(ob.select_get(), ob.mode, list(ob.data.materials), ob.data.uv_layers.active.name) for ob in objects]
    active, scene = bpy.context.view_layer.objects.active, bpy.context.scene
    first = [triangles_of_map(ob, 0) for ob in objects]
    make_atlas(objects, SIDE)
    assert counts == [
        len(getattr(bpy.data, name)) for name in ("objects", "meshes", "scenes", "materials", "collections")
    ]
    assert before == [
        (ob.select_get(), ob.mode, list(ob.data.materials), ob.data.uv_layers.active.name) for ob in objects
    ]
    assert (active, scene) == (bpy.context.view_layer.objects.active, bpy.context.scene)
    assert all(np.array_equal(a, triangles_of_map(ob, 0)) for a, ob in zip(first, objects, strict=True))
    assert all([layer.name for layer in ob.data.uv_layers] == ["UVMap", ATLAS] for ob in objects)
    assert objects[0].data.polygons[0].hide


def triangles_of_map(ob, number):
    uv = np.empty((len(ob.data.loops), 2), np.float32)
    ob.data.uv_layers[number].uv.foreach_get("vector", uv.ravel())
    return uv


def test_an_atlas_that_is_too_small_names_the_size_that_suffices():
    objects = room()
    with pytest.raises(SceneError, match=r"has 64 texels a side, but 40 texels per metre take \d+: make it") as hit:
        make_atlas(objects, 64, 40.0)
    side = int(str(hit.value).split(" take ")[1].split(":")[0])
    assert 64 < side < 256 and make_atlas(objects, side, 40.0)[0]["Floor"] == pytest.approx(40.0, rel=1e-4)


def test_each_texel_of_an_atlas_is_that_of_its_object_alone(tmp_path):
    objects = room()
    make_atlas(objects, SIDE)
    path, of_all = save(tmp_path), {"view": "above", "passes": ("diffuse", "specular"), "sub_samples": 1}
    report, files = baked(path, tmp_path / "atlas", atlas=SIDE, uv=ATLAS, **of_all)
    of_objects = baked(path, tmp_path / "alone", size=(SIDE, SIDE), uv=ATLAS, **of_all)[1]
    atlas = files[f"{ATLAS}.exr"]
    for name, layers in of_objects.items():
        covered = layers["coverage.hit"] > 0.0
        assert covered.sum() == report["objects"][0]["tiles"]["1001"]["member_texels"][name.removesuffix(".exr")] > 50
        for layer in ("ltsh4c.diffuse", "ltsh4c.specular"):
            # Single precision: other samples in a block round otherwise.
            np.testing.assert_allclose(atlas[layer][covered], layers[layer][covered], rtol=1e-3, atol=1e-6)
    assert np.array_equal(sum(layers["coverage.hit"] for layers in of_objects.values()), atlas["coverage.hit"])
    assert report["warnings"] == report["problems"] == []


def test_a_bake_makes_the_atlas_itself_of_applied_modifiers_and_names_what_it_leaves_out(tmp_path):
    objects = room()
    modifier = objects[2].modifiers.new("Array", "ARRAY")
    modifier.count, modifier.use_relative_offset, modifier.use_constant_offset = 2, False, True
    modifier.constant_offset_displace = (0.0, -0.8, 0.0)
    scene_parts.add_mesh("Line", [(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)])
    objects[1][DENSITY] = "many"
    report, files = baked(save(tmp_path), tmp_path / "out", atlas=SIDE, view="above", passes=("diffuse",))
    assert report["problems"] == [
        "object 'Ball': its property 'ltsh_density' is 'many', expected a number above 0",
        "object 'Line' has no faces with an area, nothing to bake",
    ]
    (record,) = report["objects"]
    texels = record["tiles"]["1001"]["member_texels"]
    assert set(record["members"]) == set(texels) == {"Floor", "Box", "Twin"}
    # Two cubes of side .4: their texels are their area, up to those on borders.
    assert texels["Box"] == pytest.approx(2 * 6 * 0.16 * record["members"]["Box"] ** 2, rel=0.1)
    assert record["tiles"]["1001"]["overlapping_texels"] == 0
    assert files[f"{ATLAS}.exr"]["ltsh4c.diffuse"].any()


def test_apply_makes_the_same_atlas_again_and_all_objects_show_it(tmp_path):
    room()
    report, files = baked(save(tmp_path), tmp_path / "out", atlas=SIDE, view="above", passes=("diffuse",), apply=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out" / report["applied"]))
    covered = files[f"{ATLAS}.exr"]["coverage.hit"][::-1] > 0.0
    texels = report["objects"][0]["tiles"]["1001"]["member_texels"]
    for name, count in texels.items():
        at = UvTriangles.in_tile(triangles_of(bpy.data.objects[name])[0], SIDE, SIDE).texels(0, SIDE)
        assert len(at.index) == count and covered.reshape(-1)[at.index].all()
        covered.reshape(-1)[at.index] = False
        (slot,) = bpy.data.objects[name].material_slots
        assert slot.link == "OBJECT" and "(baked " in slot.material.name
    assert not covered.any() and set(texels) == {"Floor", "Ball", "Box", "Twin"}
    assert sum(image.source == "FILE" for image in bpy.data.images) == 1
