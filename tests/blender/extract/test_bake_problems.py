"""What cannot be baked is named; bakes that were stopped leave nothing."""

import json

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import baked, save, start
from scene_parts import add_plane, principled

from ltsh_addon.blender.process import blender_process
from ltsh_addon.pipeline import BakeOptions, bake_scene
from ltsh_addon.scene import Cancelled


def broken_scene():
    start()
    add_plane(name="Good")
    bare = add_plane(name="No map", location=(0, 0, 0.1))
    bare.data.uv_layers.remove(bare.data.uv_layers[0])
    add_plane(name="Point map").data.uv_layers.active.data.foreach_set("uv", np.full(8, 0.5, np.float32))
    add_plane(name="Far map").data.uv_layers.active.data.foreach_set(
        "uv", np.float32([-5, -5, -4.1, -5, -4.1, -4.1, -5, -4.1])
    )
    square = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    double = scene_parts.add_mesh("Double", 2 * square, [(0, 1, 2, 3), (4, 5, 6, 7)])
    double.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32([0, 0, 1, 0, 1, 1, 0, 1] * 2))
    add_plane(name="Hidden").hide_render = True
    scene_parts.add_mesh("No faces", [(0, 0, 0)], []).data.uv_layers.new(name="UVMap")
    flat = add_plane(name="Flat")
    flat.scale = (1.0, 0.0, 0.0)


def test_broken_objects_are_named_and_the_rest_is_baked(tmp_path, capsys):
    from ltsh_addon import cli

    broken_scene()
    path = save(tmp_path)
    names = [ob.name for ob in bpy.data.objects if ob.type == "MESH"]
    arguments = [value for name in names for value in ("--object", name)]
    capsys.readouterr()
    code = cli.main(["bake", str(path), "-o", str(tmp_path / "out"), "--size", "64", "--quiet", *arguments])
    said = capsys.readouterr().err
    assert code == 1
    assert {file.name for file in (tmp_path / "out").glob("*.exr")} == {"Good.exr", "Double.exr"}
    for text in (
        "not baked: object 'No map' has no UV map, found none",
        "not baked: object 'Point map': all faces of UV map 'UVMap' have no area",
        "not baked: object 'Far map': all of UV map 'UVMap' lies outside of the texture",
        "not baked: object 'Hidden' is hidden in renders",
        "not baked: object 'No faces' has no faces",
        "not baked: object 'Flat': its transform has no inverse",
        "warning: object 'Double': 100 % of its texels are covered more than once",
    ):
        assert text in said, text
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert len(report["problems"]) == 6 and len(report["objects"]) == 2


def test_scenes_that_cannot_be_baked_say_why(tmp_path):
    start(light=False)
    add_plane()
    with pytest.raises(
        blender_process.SceneError, match="no area light that renders, found no lights at all; add an area light"
    ):
        baked(save(tmp_path), tmp_path / "out")
    scene_parts.add_area_light()
    path = save(tmp_path)
    with pytest.raises(
        blender_process.SceneError, match="object 'Wall' is not in scene 'Scene'; meshes there: 'Plane'"
    ):
        baked(path, tmp_path / "out", objects=("Wall",))
    report, _ = baked(path, tmp_path / "out", uv="Lightmap")
    assert report["problems"] == [
        "object 'Plane' has no UV map 'Lightmap', found 'UVMap': unwrap it, or name another with --uv"
    ]
    with pytest.raises(ValueError, match="size is 32x8192, expected 64 to 8192 each"):
        baked(path, tmp_path / "out", size=(32, 8192))
    bpy.data.objects.remove(bpy.data.objects["Plane"])
    with pytest.raises(blender_process.SceneError, match="no mesh that renders, nothing to bake"):
        baked(save(tmp_path), tmp_path / "out")


def test_above_needs_no_camera_and_camera_does(tmp_path):
    start(camera=None)
    add_plane(principled(Metallic=1.0, Roughness=0.5)[0])
    path = save(tmp_path)
    _, files = baked(path, tmp_path / "out", view="above")
    assert files["Plane.exr"]["ltsh4.specular"].max() > 0.0
    with pytest.raises(blender_process.SceneError, match="no active camera"):
        baked(path, tmp_path / "out")


def test_stopping_leaves_no_file(tmp_path):
    start()
    add_plane()

    def stop(stage, fraction):
        return not stage.startswith("shade")

    with pytest.raises(Cancelled):
        bake_scene(BakeOptions(scene=save(tmp_path), output=tmp_path / "out", size=(64, 64)), stop)
    assert list((tmp_path / "out").iterdir()) == []


def test_resume_bakes_again_what_belongs_to_another_job(tmp_path):
    start()
    add_plane(principled(Metallic=1.0, Roughness=0.5)[0])
    path = save(tmp_path)
    _, first = baked(path, tmp_path / "out", view="above", resume=True)
    _, second = baked(path, tmp_path / "out", view="camera", resume=True)
    assert np.abs(first["Plane.exr"]["ltsh4.specular"] - second["Plane.exr"]["ltsh4.specular"]).max() > 0.0
    (tmp_path / "out" / "Plane.exr").write_bytes(b"no EXR")
    _, third = baked(path, tmp_path / "out", view="camera", resume=True)
    assert np.array_equal(second["Plane.exr"]["ltsh4.specular"], third["Plane.exr"]["ltsh4.specular"])
