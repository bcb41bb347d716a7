"""The child process: one .blend in, arrays out, nothing else touched; every failure is one clear line."""

import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import bpy
import numpy as np
import programs
import pytest
import scene_parts
from kills import is_running

from ltsh_addon.blender.process.blender_process import child_command
from ltsh_addon.blender.process.client import ExtractOptions, extract
from ltsh_addon.scene import Cancelled, SceneError

ROOT = Path(__file__).resolve().parents[3]


def saved_scene(path: Path, *, camera=True, light=True, look=(0.0, 0.0, 0.0)) -> Path:
    """A metal plane with one light, saved as `path`, 40 x 20 pixels at 50 %."""
    scene = scene_parts.empty_scene(80, 40)
    scene.render.resolution_percentage = 50
    scene_parts.add_plane(scene_parts.principled(Metallic=1.0, Roughness=0.4)[0], size=8.0)
    if light:
        scene_parts.add_area_light("Key")
    if camera:
        scene_parts.add_top_camera()
        scene.camera.rotation_euler = look
        second = scene_parts.add_camera(name="Second")
        second.keyframe_insert("location", frame=1)
        second.location = (0.0, 0.0, 4.0)
        second.rotation_euler = (0.0, 0.0, 0.0)
        second.keyframe_insert("location", frame=10)
        scene.camera = bpy.data.objects["Camera"]
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def left_over(folder: Path) -> list[str]:
    return [entry.name for entry in folder.iterdir() if entry.name.startswith("ltsh-")]


def one_line(error) -> str:
    text = str(error.value)
    assert "\n" not in text and text
    return text


def test_everything_comes_back_and_the_file_stays_as_it_was(tmp_path, temporary_root):
    path = saved_scene(tmp_path / "scene with spaces.blend")
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    loaded, stages = len(bpy.data.objects), []

    def progress(stage, fraction):
        assert 0.0 <= fraction <= 1.0
        stages.append(stage)

    found = extract(ExtractOptions(path, cycles_samples=64), progress=progress)
    assert list(dict.fromkeys(stages)) == ["open scene", "samples", "Cycles A", "Cycles B"]
    assert (found.film.width, found.film.height, found.film.sub_samples) == (40, 20, 1)
    assert [light.name for light in found.lights] == ["Key"] and found.warnings == ()
    assert len(found.samples) == 800 and np.allclose(found.samples.roughness, 0.4)
    assert set(found.reference) == {"specular", "diffuse"} and set(found.seconds) == {"start", "samples", "cycles"}
    for image in found.reference.values():
        assert image.shape == (2, 20, 40, 3) and image.dtype == np.float32
    specular = found.reference["specular"]
    # Row 0 on top: the light stands at y > 0, seen from above.
    assert specular[:, :10].sum() > specular[:, 10:].sum() > 0.0
    assert 0.0 < np.abs(specular[0] - specular[1]).sum() < 0.2 * specular.sum()
    assert (found.frame, found.camera, found.blender_version) == (1, "Camera", bpy.app.version_string)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before and len(bpy.data.objects) == loaded
    assert sorted(entry.name for entry in tmp_path.glob("*.blend*")) == [path.name]
    assert left_over(temporary_root) == []


def test_camera_frame_size_and_sub_samples_can_be_chosen(tmp_path):
    path = saved_scene(tmp_path / "scene.blend")
    found = extract(ExtractOptions(path, width=16, height=12, sub_samples=3, frame=10, camera="Second"))
    assert (found.film.width, found.film.height, found.film.sub_samples) == (16, 12, 3)
    assert (found.frame, found.camera, found.reference) == (10, "Second", None)
    assert len(found.samples) == 3 * 16 * 12 and found.film.coverage().min() == 1.0
    # At frame 10 the second camera is 4 m above the origin.
    view = found.samples.position + found.samples.view * (4.0 / found.samples.view[:, 2:])
    assert np.allclose(view, (0.0, 0.0, 4.0), atol=1e-4)


def test_an_unknown_camera_is_named_beside_those_there_are(tmp_path):
    path = saved_scene(tmp_path / "scene.blend")
    with pytest.raises(SceneError) as error:
        extract(ExtractOptions(path, camera="Third"))
    assert "'Third'" in one_line(error) and "'Camera', 'Second'" in one_line(error)


def test_counts_that_make_no_sense_are_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match="sub_samples is 0"):
        extract(ExtractOptions(tmp_path / "any.blend", sub_samples=0))


def test_cancelling_ends_the_child(tmp_path, temporary_root):
    path, children = saved_scene(tmp_path / "scene.blend"), []

    def progress(stage, fraction):
        children.extend(_children_of(os.getpid()))
        return stage != "Cycles A"

    with pytest.raises(Cancelled, match="Cycles A"):
        extract(ExtractOptions(path, cycles_samples=100000), progress=progress)
    assert children and not any(is_running(child) for child in children)
    assert left_over(temporary_root) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_parent_that_is_ended_takes_its_child_and_their_folders_along(tmp_path, temporary_root, number):
    path = saved_scene(tmp_path / "scene.blend")
    code = (
        "from ltsh_addon.blender.process.client import *\n"
        "def progress(stage, fraction):\n    print(stage, flush=True)\n"
        f"extract(ExtractOptions({str(path)!r}, width=600, height=400, cycles_samples=100000), progress=progress)\n"
    )
    parent = subprocess.Popen(programs.python(code), cwd=ROOT, stdout=subprocess.PIPE, text=True)
    watchdog = threading.Timer(60.0, parent.kill)
    watchdog.start()
    try:
        for line in parent.stdout:
            if line.strip() == "Cycles A":
                break
        children = _children_of(parent.pid)
        parent.send_signal(number)
        assert parent.wait(30) == -number
    finally:
        watchdog.cancel()
        parent.kill()
        parent.stdout.close()
        parent.wait()
    deadline = time.monotonic() + 20.0
    while any(is_running(child) for child in children) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert len(children) == 1 and not is_running(children[0])
    assert left_over(temporary_root) == []


def test_the_command_is_this_python_with_pips_bpy_or_this_blender(tmp_path):
    command = child_command(tmp_path / "job.json")
    assert command[0] == (bpy.app.binary_path or sys.executable)
    assert any(word.endswith("worker.py") for word in command) and command[-1].endswith("job.json")


def test_without_bpy_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "bpy")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SceneError, match=r"has no module bpy.*pip install bpy=="):
        child_command(tmp_path / "job.json")


def _children_of(parent: int) -> list[int]:
    """Process ids of the direct children of `parent` (Linux)."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == parent and fields[0] != "Z":
            found.append(int(entry.parent.name))
    return found
