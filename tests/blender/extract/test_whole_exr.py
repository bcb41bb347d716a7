"""A picture that Blender could not write whole is told from a whole one, and why is said in one line."""

import errno

import numpy as np
import OpenEXR
import pytest
import scene_parts

from ltsh_addon.blender import render_settings
from ltsh_addon.blender.process.pixels import rendered_channels
from ltsh_addon.files import temporary_folder
from ltsh_addon.imaging.exr import read_channels


def parts(path):
    """As Blender 5.0 writes it, a part for each pass."""
    pixels = np.random.default_rng(0).normal(size=(40, 9)).astype(np.float32)
    made = [OpenEXR.Part({}, {f"{name}.V": pixels}, name) for name in ("a", "b")]
    with OpenEXR.File(made) as file:
        file.write(str(path))


def rendered(path, size=(33, 50)):
    scene = scene_parts.empty_scene(*size)
    scene_parts.add_camera()
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    render_settings.render_exr(scene, path)


@pytest.mark.parametrize("write", [parts, rendered])
def test_no_cut_picture_is_read(tmp_path, write):
    path, cut = tmp_path / "a.exr", tmp_path / "b.exr"
    write(path)
    assert read_channels(path)
    data = path.read_bytes()
    for length in {*range(0, len(data), 53), len(data) - 1}:
        cut.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"b\.exr"):
            read_channels(cut)


def test_a_picture_that_is_not_whole_says_where_room_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(OSError) as error, temporary_folder() as folder:
        parts(folder / "a.exr")
        (folder / "a.exr").write_bytes((folder / "a.exr").read_bytes()[:-1])
        rendered_channels(folder / "a.exr")
    assert str(error.value) == (
        f"{tmp_path}: no room for temporary files (a picture was not written whole); "
        "make room, or let TMPDIR name another folder"
    )


def test_a_picture_that_is_as_large_as_may_be_is_an_error_of_the_disk(tmp_path):
    resource = pytest.importorskip("resource", reason="limits of Unix")
    rendered(tmp_path / "whole.exr")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "whole.exr").stat().st_size - 9, before[1]))
    try:
        with pytest.raises(OSError) as error:
            rendered(tmp_path / "a.exr")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert error.value.errno == errno.EFBIG


@pytest.mark.parametrize("size", [(4, 4), (33, 50)])
def test_a_whole_picture_stays_as_it_was_rendered(tmp_path, size, monkeypatch):
    """Trying whether there is room leaves no trace."""
    rendered(tmp_path / "a.exr", size)
    monkeypatch.setattr(render_settings, "check_room_after", lambda path: None)
    rendered(tmp_path / "b.exr", size)
    assert (tmp_path / "a.exr").stat().st_size == (tmp_path / "b.exr").stat().st_size
