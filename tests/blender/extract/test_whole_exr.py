"""What Blender leaves of a picture where the disk is full is told from a whole one."""

import numpy as np
import OpenEXR
import pytest
import scene_parts

from ltsh_addon.blender import render_settings
from ltsh_addon.blender.render_settings import is_whole
from ltsh_addon.imaging.exr import writing_rows


def parts(path):
    pixels = np.random.default_rng(0).normal(size=(40, 9)).astype(np.float32)
    made = [OpenEXR.Part({}, {f"{name}.V": pixels}, name) for name in ("a", "b")]
    with OpenEXR.File(made) as file:
        file.write(str(path))


def rows(path):
    pixels = np.random.default_rng(0).normal(size=(70, 9)).astype(np.float32)
    with writing_rows(path, ["a", "b"], 9, 70, {"long": "x" * 999}) as writer:
        writer.write({"a": pixels, "b": pixels})


@pytest.mark.parametrize("write", [parts, rows])
def test_no_cut_file_is_whole(tmp_path, write):
    path, cut = tmp_path / "a.exr", tmp_path / "b.exr"
    write(path)
    assert is_whole(path)
    data = path.read_bytes()
    for length in {*range(0, len(data), 53), len(data) - 1}:
        cut.write_bytes(data[:length])
        assert not is_whole(cut), length


def test_what_is_there_before_the_end_of_writing_is_not_whole(tmp_path):
    pixels = np.ones((64, 9), np.float32)
    with writing_rows(tmp_path / "a.exr", ["a"], 9, 70) as writer:
        writer.write({"a": pixels})
        (half,) = tmp_path.glob(".a.exr.*.tmp")
        assert not is_whole(half)
        writer.write({"a": pixels[:6]})


@pytest.mark.parametrize("size", [(4, 4), (33, 50)])
def test_what_blender_renders_is_whole(tmp_path, size):
    """`render_exr` itself checks it, too."""
    scene = scene_parts.empty_scene(*size)
    scene_parts.add_camera()
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    render_settings.render_exr(scene, tmp_path / "a.exr")
    assert is_whole(tmp_path / "a.exr")


def test_a_picture_that_is_not_whole_is_an_error_of_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(render_settings, "is_whole", lambda path: False)
    scene = scene_parts.empty_scene(4, 4)
    scene_parts.add_camera()
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    with pytest.raises(OSError, match="not written whole"):
        render_settings.render_exr(scene, tmp_path / "a.exr")
