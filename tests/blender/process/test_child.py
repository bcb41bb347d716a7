"""The child process: one .blend in, arrays out, nothing else touched; every failure is one clear line."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import programs
import pytest
import scene_parts
from kills import children, is_running

from ltsh_addon.blender.process import blender_process
from ltsh_addon.blender.process.finished import FinishedJob, render_finished
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.scene import Cancelled

ROOT = Path(__file__).resolve().parents[3]


def saved_scene(path: Path) -> Path:
    """A metal plane with one light, saved as `path`, 40 x 20 pixels at 50 %."""
    scene = scene_parts.empty_scene(80, 40)
    scene.render.resolution_percentage = 50
    scene_parts.add_plane(scene_parts.principled(Metallic=1.0, Roughness=0.4)[0], size=8.0)
    scene_parts.add_area_light("Key")
    second = scene_parts.add_camera(name="Second")
    second.keyframe_insert("location", frame=1)
    second.location, second.rotation_euler = (0.0, 0.0, 4.0), (0.0, 0.0, 0.0)
    second.keyframe_insert("location", frame=10)
    scene_parts.add_top_camera()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_everything_comes_back_and_the_file_stays_as_it_was(tmp_path, temporary_root):
    path = saved_scene(tmp_path / "scene with spaces.blend")
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    loaded, stages = len(bpy.data.objects), []

    def progress(stage, fraction):
        assert 0.0 <= fraction <= 1.0
        stages.append(stage)

    found = extract_pixels(PixelJob(path, cycles_samples=64), progress=progress)
    assert list(dict.fromkeys(stages)) == ["open scene", "samples", "Cycles A", "Cycles B"]
    assert (found.film.width, found.film.height, found.film.sub_samples) == (40, 20, 1)
    assert [light.name for light in found.lights] == ["Key"] and found.warnings == ()
    assert len(found.samples) == 800 and np.allclose(found.samples.roughness, 0.4)
    assert set(found.cycles.reference) == {"specular", "diffuse"}
    assert set(found.times.stages) == {"start", "samples", "cycles"}
    for image in found.cycles.reference.values():
        assert image.shape == (2, 20, 40, 3) and image.dtype == np.float32
    specular = found.cycles.reference["specular"]
    # Row 0 on top: the light stands at y > 0, seen from above.
    assert specular[:, :10].sum() > specular[:, 10:].sum() > 0.0
    assert 0.0 < np.abs(specular[0] - specular[1]).sum() < 0.2 * specular.sum()
    assert (found.picture.frame, found.picture.camera) == (1, "Camera")
    assert found.picture.blender_version == bpy.app.version_string
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before and len(bpy.data.objects) == loaded
    assert sorted(entry.name for entry in tmp_path.glob("*.blend*")) == [path.name]
    assert list(temporary_root.glob("ltsh-*")) == []


def test_camera_frame_size_and_sub_samples_can_be_chosen(tmp_path):
    path = saved_scene(tmp_path / "scene.blend")
    found = extract_pixels(PixelJob(path, width=16, height=12, sub_samples=3, frame=10, camera="Second"))
    assert (found.film.width, found.film.height, found.film.sub_samples) == (16, 12, 3)
    assert (found.picture.frame, found.picture.camera, found.cycles.reference) == (10, "Second", None)
    assert len(found.samples) == 3 * 16 * 12 and found.film.coverage().min() == 1.0
    # At frame 10 the second camera is 4 m above the origin.
    view = found.samples.position + found.samples.view * (4.0 / found.samples.view[:, 2:])
    assert np.allclose(view, (0.0, 0.0, 4.0), atol=1e-4)


def test_counts_that_make_no_sense_are_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match="sub_samples is 0"):
        extract_pixels(PixelJob(tmp_path / "any.blend", sub_samples=0))


def test_cancelling_ends_the_child(tmp_path, temporary_root):
    path, running = saved_scene(tmp_path / "scene.blend"), []

    def progress(stage, fraction):
        running.extend(children(os.getpid()))
        return stage != "Cycles A"

    with pytest.raises(Cancelled, match="Cycles A"):
        extract_pixels(PixelJob(path, cycles_samples=100000), progress=progress)
    assert running and not any(is_running(child) for child in running)
    assert list(temporary_root.glob("ltsh-*")) == []


# Goes on telling while its folder is being deleted, which takes a while.
TELLER = """
import shutil, time
from pathlib import Path
from ltsh_addon.blender.process import blender_process
delete = shutil.rmtree
shutil.rmtree = lambda *arguments, **options: (time.sleep(0.5), delete(*arguments, **options))
blender_process.listen_to_parent([Path({folder!r})])
while True:
    blender_process.tell({{"stage": "Cycles A", "fraction": 0.5}})
    time.sleep(0.01)
"""


def test_a_child_that_still_speaks_deletes_the_folders_of_a_parent_that_is_gone(tmp_path):
    folder = tmp_path / "temporary"
    folder.mkdir()
    (folder / "samples.npy").write_bytes(b"values")
    child = subprocess.Popen(
        programs.python(TELLER.format(folder=str(folder))),
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert child.stdout.readline().startswith(b"LTSH ")
    child.stdout.close()
    child.stdin.close()
    assert (child.wait(60.0), child.stderr.read()) == (3, b"") and not folder.exists()
    child.stderr.close()


def test_the_second_blender_reads_its_renders_though_it_has_no_extensions(tmp_path, own_blender, monkeypatch):
    """Beside bpy and numpy it has OpenEXR from the folder that this process has it from."""
    site = Path(np.__file__).parents[1]
    for path in (*site.glob("bpy*"), *site.glob("numpy*")):
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    bare = [sys.executable, "-S", str(blender_process.WORKER)]
    monkeypatch.setattr(blender_process, "child_command", lambda job: [*bare, str(job)])
    scene = saved_scene(tmp_path / "scene.blend")
    job = FinishedJob(scene, None, None, None, None, None, None, cycles_samples=2, seconds=None)
    assert render_finished(job, tmp_path).samples == 2
