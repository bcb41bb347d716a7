"""Bakes on disks that are full or cannot be written: one line, nothing half written, and the rest is baked."""

import subprocess
import sys

import bpy
import kills
import numpy as np
import programs
import pytest
from bake_scenes import save, start
from scene_parts import add_plane, principled

from ltsh_addon import cli

OPTIONS = ["--size", "256", "--margin", "0", "--techniques", "ltc,ltsh2,ltsh4", "--shadows", "off", "--quiet"]

with_limit = pytest.mark.skipif(bool(bpy.app.binary_path), reason="Blender does not start under a limit of files")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="limits and mounts of Unix")


def two_planes():
    """One whose texture is 1 MB, and one whose texture is nearly empty, thus small."""
    start()
    material = principled(Roughness=0.5)[0]
    add_plane(material, name="Large")
    small = add_plane(material, name="Small", location=(0.0, 0.0, 0.1))
    small.data.uv_layers.active.data.foreach_set("uv", np.float32([0, 0, 0.1, 0, 0.1, 0.1, 0, 0.1]))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    two_planes()
    return save(tmp_path_factory.mktemp("scene"))


def bake(scene, output):
    return programs.command_line("bake", scene, "-o", output, *OPTIONS)


@pytest.fixture
def small_disk(tmp_path):
    yield from kills.small_disk(tmp_path / "disk", "600k")


@with_limit
def test_files_that_grow_too_large_are_named_the_others_are_baked_and_resume_bakes_the_rest(scene, tmp_path):
    runs, output = kills.Runs(tmp_path / "temporary"), tmp_path / "out"
    # In blocks of 1024 bytes: more than a channel of 256 KiB, less than the large texture.
    limited = ["bash", "-c", 'ulimit -f 600 && exec "$@"', "bash", *bake(scene, output)]
    code, said = runs.finish(limited)
    assert code == 1 and said == f"not baked: Large: {output}/Large.exr: cannot be written: File too large\n"
    assert {path.name for path in output.iterdir()} == {"Small.exr", "report.json", "timing.json", ".ltsh"}
    assert not kills.is_writing(output) and list(runs.temporary.iterdir()) == [] and runs.survivors() == []
    for folder in (output, tmp_path / "whole"):
        assert cli.main(["bake", str(scene), "-o", str(folder), *OPTIONS, "--resume"]) == 0
    assert kills.differences(kills.contents(output), kills.contents(tmp_path / "whole")) == []


@with_limit
def test_temporary_files_that_grow_too_large_say_where_they_are(scene, tmp_path):
    runs, output = kills.Runs(tmp_path / "temporary"), tmp_path / "out"
    code, said = runs.finish(["bash", "-c", 'ulimit -f 200 && exec "$@"', "bash", *bake(scene, output)])
    assert code == 1 and said == "".join(
        f"not baked: {name}: {runs.temporary}: no room for temporary files (File too large); "
        "make room, or let TMPDIR name another folder\n"
        for name in ("Large", "Small")
    )
    assert {path.name for path in output.iterdir()} == {"report.json", "timing.json", ".ltsh"}
    assert list(runs.temporary.iterdir()) == [] and runs.survivors() == []


def test_a_full_disk_is_one_line_and_no_half_file(scene, small_disk, capfd):
    command = ["bake", str(scene), "-o", str(small_disk / "out"), "--object", "Large", *OPTIONS]
    capfd.readouterr()
    assert cli.main(command) == 1
    expected = f"ltsh: {small_disk}/out/Large.exr: cannot be written: No space left on device\n"
    assert capfd.readouterr().err == expected
    assert not kills.is_writing(small_disk) and list(small_disk.rglob("*.exr")) == []


def test_a_blend_for_which_the_disk_is_too_small_is_not_left_half_written(scene, small_disk, tmp_path, capfd):
    output = small_disk / "out"
    command = ["bake", str(scene), "-o", str(output), "--object", "Small", "--size", "64", "--apply", "--quiet"]
    (small_disk / "filler").write_bytes(bytes(512 << 10))
    capfd.readouterr()
    assert cli.main(command) == 1
    said = capfd.readouterr().err
    assert said == f"ltsh: {output}: Blender could not save the whole .blend there; is the disk full?\n"
    assert not kills.is_writing(small_disk) and list(small_disk.rglob("*.blend")) == []
    assert (output / "Small.ltsh4c.combined.exr").is_file()


def test_a_full_disk_for_temporary_files_is_one_line(own_blender, small_disk, tmp_path, capfd, monkeypatch):
    """In Blender, which writes there first: what varies over a surface."""
    start()
    material, node = principled(Roughness=0.5)
    noise = material.node_tree.nodes.new("ShaderNodeTexNoise")
    material.node_tree.links.new(noise.outputs["Color"], node.inputs["Base Color"])
    add_plane(material)
    scene = save(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(small_disk))
    capfd.readouterr()
    assert cli.main(["bake", str(scene), "-o", str(tmp_path / "out"), "--size", "512", "--quiet"]) == 1
    expected = f"ltsh: {small_disk}: no room for temporary files (No space left on device); "
    assert capfd.readouterr().err == expected + "make room, or let TMPDIR name another folder\n"
    assert list(small_disk.iterdir()) == [] and list((tmp_path / "out").rglob("*")) == []


@pytest.mark.parametrize("command", ["shade", "compare", "bake"])
def test_a_read_only_disk_is_named_before_anything_starts(own_blender, scene, small_disk, capsys, monkeypatch, command):
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    start = "ltsh_addon.blender.process.blender_process.start"
    monkeypatch.setattr(start, lambda *_: pytest.fail("Blender was started"))
    assert cli.main([command, str(scene), "-o", str(small_disk / "out"), "--quiet"]) == 1
    expected = f"output folder {small_disk}/out: cannot be written (Read-only file system); choose another folder"
    assert capsys.readouterr().err == f"ltsh: {expected}\n"


def test_a_texture_whose_name_is_taken_by_a_folder_does_not_keep_others_from_being_baked(scene, tmp_path, capsys):
    (tmp_path / "out" / "Large.exr").mkdir(parents=True)
    assert cli.main(["bake", str(scene), "-o", str(tmp_path / "out"), "--size", "64", "--quiet"]) == 1
    expected = f"not baked: Large: {tmp_path}/out/Large.exr: cannot be written: a folder has that name\n"
    assert capsys.readouterr().err == expected
    assert (tmp_path / "out" / "Small.exr").is_file()


def test_a_blend_that_cannot_be_saved_is_named(scene, tmp_path, capsys):
    """Its name is taken by a folder; the textures stay."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    (tmp_path / "out" / "scene_baked.blend").mkdir(parents=True)
    options = ["--size", "64", "--object", "Small", "--apply", "--quiet"]
    assert cli.main(["bake", str(scene), "-o", str(tmp_path / "out"), *options]) == 1
    expected = f"ltsh: {tmp_path}/out/scene_baked.blend: cannot be written: a folder has that name\n"
    assert capsys.readouterr().err == expected
    assert (tmp_path / "out" / "Small.ltsh4c.combined.exr").is_file() and not kills.is_writing(tmp_path / "out")
