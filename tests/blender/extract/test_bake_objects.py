"""Objects in odd states: what overlaps or lies beside the texture, what is linked; light groups of a bake."""

import hashlib

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import SIZE, baked, save, start
from scene_parts import add_plane, principled


def squares(name, *uv_corners):
    """A mesh of squares above one another, of which each has the UV square (u, v, side)."""
    corners = [(x, y, 0.01 * z) for z in range(len(uv_corners)) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ob = scene_parts.add_mesh(name, corners, [tuple(range(4 * z, 4 * z + 4)) for z in range(len(uv_corners))])
    uv = [(u + a * s, v + b * s) for u, v, s in uv_corners for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    ob.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32(uv).ravel())
    return ob


def library(folder):
    """A file with an object, and a material."""
    start()
    ob = add_plane(principled("Shared", Metallic=1.0, Roughness=0.5)[0], name="Linked")
    ob.data.name = "Linked mesh"
    path = folder / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Report and layers of a bake of odd objects, and whether the library is as it was."""
    folder = tmp_path_factory.mktemp("odd")
    path = library(folder)
    before = hashlib.sha256(path.read_bytes()).digest()
    start()
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.objects, wanted.meshes, wanted.materials = ["Linked"], ["Linked mesh"], ["Shared"]
    scene_parts.link(bpy.data.objects["Linked"])
    scene_parts.link(bpy.data.objects.new("Linked mesh", bpy.data.meshes["Linked mesh"]))
    add_plane(bpy.data.materials["Shared"], name="Linked material")
    squares("Third", (0.0, 0.0, 0.5), (0.25, 0.0, 0.5))
    squares("Thrice", (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    squares("Half without area", (0.0, 0.0, 0.5), (0.75, 0.75, 0.0))
    squares("Two tiles", (0.0, 0.0, 1.0), (1.0, 0.0, 1.0))
    squares("Half outside", (0.25, 0.25, 0.5), (-1.25, 0.25, 0.5))
    report, files = baked(save(folder), folder / "out", passes=("diffuse", "specular"), view="above")
    assert hashlib.sha256(path.read_bytes()).digest() == before
    return report, files


@pytest.mark.parametrize(
    ("name", "share"), [("Third", "33.3 %"), ("Thrice", "100 %"), ("Half without area", None), ("Two tiles", None)]
)
def test_the_share_of_texels_that_islands_share_is_named(odd, name, share):
    expected = [f"object {name!r}: {share} of its texels are covered more than once"] if share else []
    assert [line for line in odd[0]["warnings"] if f"object {name!r}" in line] == expected


def test_linked_objects_are_named_with_their_library_and_linked_materials_are_baked(odd):
    report, files = odd
    assert report["problems"] == [
        f"object {name!r} is linked from //library.blend: bake it there, or make it local"
        for name in ("Linked", "Linked mesh")
    ]
    layers = files["Linked material.exr"]
    assert layers["ltsh4.specular"].max() > 0.0 and layers["coverage.hit"].all()


def test_faces_without_area_on_the_texture_leave_the_others_as_they_are(odd):
    covered = odd[1]["Half without area.exr"]["coverage.hit"]
    assert covered[SIZE // 2 :, : SIZE // 2].all() and covered.sum() == SIZE**2 / 4


def test_what_lies_beside_the_texture_is_named_with_its_share(odd):
    (warning,) = [line for line in odd[0]["warnings"] if "'Half outside'" in line]
    assert "50 % of UV map 'UVMap' lies outside of the texture, not baked" in warning
    assert set(odd[1]) >= {"Half outside.exr", "Two tiles.1001.exr", "Two tiles.1002.exr"}


def test_light_groups_are_layers_and_each_is_the_light_of_its_own_lights(tmp_path):
    start()
    groups = bpy.context.view_layer.lightgroups
    for name, place in (("Key", (0.8, 0.0, 1.0)), ("Fill", (-0.8, 0.0, 1.0)), ("", (0.0, 0.8, 1.0))):
        light = scene_parts.add_area_light(f"{name} light", place, color=(1.0, 0.5, 0.2) if name else (1.0, 1.0, 1.0))
        if name:
            groups.add(name=name)
            light.lightgroup = name
    bpy.data.objects.remove(bpy.data.objects["Key"])
    add_plane(principled(Roughness=0.4)[0])
    _, files = baked(save(tmp_path), tmp_path / "all")
    layers = files["Plane.exr"]
    for name in ("Fill light", " light"):
        bpy.data.objects.remove(bpy.data.objects[name])
    _, files = baked(save(tmp_path), tmp_path / "alone")
    for pass_name in ("specular", "diffuse"):
        layer = f"ltsh4.{pass_name}"
        assert {name for name in layers if name.startswith(f"{layer}@")} == {
            f"{layer}@{group}" for group in ("Key", "Fill", "ungrouped")
        }
        parts = [layers[f"{layer}@{group}"] for group in ("Key", "Fill", "ungrouped")]
        # Sums of three numbers in float32, in any order.
        assert np.abs(sum(parts) - layers[layer]).max() <= 3e-7 * layers[layer].max()
        assert np.array_equal(parts[0], files["Plane.exr"][layer]) and parts[0].max() > 0.0
