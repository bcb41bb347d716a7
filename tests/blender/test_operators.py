"""The operators that run jobs: their pictures, and what happens when something comes in between."""

import json
import os
import subprocess
import time
from pathlib import Path

import bpy
import numpy as np
import programs
import pytest
from job_window import SECONDS, Hand, ended, room

import ltsh_addon
from ltsh_addon import cli, imaging
from ltsh_addon.blender.interface import job_arguments, job_stages, operators, results
from ltsh_addon.blender.interface.job import Job
from ltsh_addon.blender.interface.job_plan import Plan
from ltsh_addon.blender.processes import blender_process

ROOT = Path(__file__).resolve().parents[2]
# Runs a job until its first stage, and waits to be killed or cancels it and ends.
OWNER = """
import json, threading, time
from ltsh_addon.blender.interface.job import Job, new_folder
from ltsh_addon.blender.interface.job_plan import Plan, Step
job = Job("Job", Plan([Step("Starting", 1.0)]), new_folder(), "compare", 0)
job.start(json.loads({runs!r}), background=False)
while not job.finished and job.stage == "Starting":
    job.poll()
    time.sleep(0.05)
print("OWNER", job._process.pid, job.folder, flush=True)
if {end!r} == "killed":
    time.sleep(600)
job.cancel()
# What Python does at its end; a real Blender that runs this ends without.
for thread in threading.enumerate():
    if thread is not threading.current_thread() and not thread.daemon:
        thread.join()
"""


@pytest.fixture
def scene(tmp_path):
    """The add-on and a saved file that can be shaded."""
    ltsh_addon.register()
    yield room(tmp_path / "room.blend")
    ltsh_addon.unregister()


@pytest.fixture
def never_ends(scene):
    """Cycles has enough to do for as long as a test takes."""
    scene.ltsh.cycles_samples = 1 << 20
    return scene


@pytest.fixture
def reported(monkeypatch):
    """Stages that jobs report, each as often as it begins."""
    stages, report = [], Plan.report

    def note(plan, stage, fraction):
        if stages[-1:] != [stage]:
            stages.append(stage)
        report(plan, stage, fraction)

    monkeypatch.setattr(Plan, "report", note)
    return stages


def planned(command):
    return [step.stage for step in job_stages.steps(bpy.context, command)]


def image_pixels(name):
    """Pixels (H, W, 3) of an image, row 0 above."""
    image = bpy.data.images[name]
    width, height = image.size
    flat = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(flat)
    return flat.reshape(height, width, 4)[::-1, :, :3]


def command_line(*arguments):
    assert cli.main([*map(str, arguments), "--quiet"]) == 0


def test_a_comparison_shows_what_the_command_line_writes(scene, tmp_path, reported):
    assert bpy.ops.ltsh.compare() == {"FINISHED"}
    assert [job_stages.STARTING, *reported] == planned("compare")
    command_line("compare", tmp_path / "room.blend", "-o", tmp_path / "out", "--techniques", "ltc,ltsh4",
                 "--cycles-samples", "4")  # fmt: skip
    expected = imaging.read_layers(tmp_path / "out" / "compare.exr")
    for name in ("ltc", "ltsh4", "cycles", "error_ltsh4"):
        both = expected[f"{name}.specular"] + expected[f"{name}.diffuse"]
        np.testing.assert_array_equal(image_pixels(f"LTSH {name}.combined"), both)
    scene.ltsh.pass_name = "specular"
    for name in ("ltsh4", "cycles", "error_ltc"):
        np.testing.assert_array_equal(image_pixels(f"LTSH {name}.specular"), expected[f"{name}.specular"])
    assert not expected["ltsh4.specular"].max() == 0.0
    assert bpy.data.images["LTSH error_ltsh4.combined"].colorspace_settings.name == "Non-Color"
    files = [tmp_path / folder / "compare.exr" for folder in ("ltsh/compare", "out")]
    assert files[0].read_bytes() == files[1].read_bytes() and operators.running_job() is None


def test_shading_and_baking_show_what_the_command_line_writes(scene, tmp_path, reported):
    scene.ltsh.techniques, scene.ltsh.anti_aliasing, scene.ltsh.resolution_percentage = {"ltsh2"}, 2, 50
    assert bpy.ops.ltsh.shade() == {"FINISHED"}
    assert [job_stages.STARTING, *reported] == planned("shade")
    command_line("shade", tmp_path / "room.blend", "-o", tmp_path / "out", "--techniques", "ltsh2", "--aa", "2",
                 "--resolution", "12x8")  # fmt: skip
    expected = imaging.read_layers(tmp_path / "out" / "shade.exr")["ltsh2.diffuse"]
    scene.ltsh.pass_name = "diffuse"
    np.testing.assert_array_equal(image_pixels("LTSH ltsh2.diffuse"), expected)
    bpy.data.objects["Floor"].select_set(True)
    scene.ltsh.bake_view, scene.ltsh.bake_passes = "above", {"specular"}
    reported.clear()
    assert bpy.ops.ltsh.bake() == {"FINISHED"}
    # Materials without textures need no maps.
    assert [job_stages.STARTING, *reported] == [stage for stage in planned("bake") if stage != "bake Floor"]
    command_line("bake", tmp_path / "room.blend", "-o", tmp_path / "out", "--object", "Floor", "--size", "256",
                 "--margin", "2", "--view", "above", "--passes", "specular", "--techniques", "ltsh2")  # fmt: skip
    expected = imaging.read_layers(tmp_path / "out" / "Floor.exr")["ltsh2.specular"]
    np.testing.assert_array_equal(image_pixels("LTSH Floor ltsh2.specular"), expected)
    # Pictures of the other job go from the list of images, not from the disk: one click shows them again.
    assert "LTSH ltsh2.diffuse" not in bpy.data.images
    assert bpy.ops.ltsh.show_results(command="shade") == {"FINISHED"} and "LTSH ltsh2.specular" in bpy.data.images


@pytest.mark.parametrize("stop", ["Esc", "button"])
def test_cancelling_keeps_what_is_finished_and_marks_it(never_ends, stop):
    hand = Hand().start()
    assert hand.context.status.startswith("Compare with Cycles: ") and len(hand.context.timers) == 1
    hand.until(lambda: operators.running_job().results)
    hand.until(lambda: operators.running_job().stage == "Cycles A")
    job = operators.running_job()
    if stop == "Esc":
        hand.send("ESC", "PRESS")
    else:
        assert bpy.ops.ltsh.cancel() == {"FINISHED"}
        hand.send()
    assert hand.outcome == {"FINISHED"} and hand.context.timers == []
    assert hand.reports == [("WARNING", "Compare with Cycles was cancelled; kept: LTC, LTSH 4")]
    assert operators.running_job() is None and ended(job)
    result = results.result_of(never_ends)
    assert result.partial == job_arguments.NO_CYCLES
    assert image_pixels("LTSH ltsh4.combined").max() > 0.0
    # The choice is there again when Cycles is.
    assert never_ends.ltsh.second == "cycles"


class Watcher(Hand):
    """The window that goes on with a job whose own window was closed."""

    _begin = operators.LTSH_OT_watch._begin


def test_a_job_whose_window_is_closed_goes_on_in_another(never_ends):
    hand = Hand().start()
    hand.until(lambda: operators.running_job().stage == "Cycles A")
    job = operators.running_job()
    hand.cancel(hand.context)
    assert hand.context.timers == [] and operators.running_job() is job and not job.cancelled
    other = Watcher().start()
    assert other.context.status.startswith("Compare with Cycles: ")
    other.send("ESC", "PRESS")
    assert other.outcome == {"FINISHED"} and operators.running_job() is None and ended(job)
    assert other.reports == [("WARNING", "Compare with Cycles was cancelled; kept: LTC, LTSH 4")]


def test_cancelling_before_anything_is_finished_says_so(never_ends):
    hand = Hand().start()
    hand.send("ESC", "PRESS")
    assert hand.outcome == {"CANCELLED"} and hand.reports[0][1].endswith("nothing was finished yet")
    assert results.result_of(never_ends) is None


def test_one_job_at_a_time(never_ends):
    hand = Hand().start()
    for operator in (bpy.ops.ltsh.shade, bpy.ops.ltsh.compare, bpy.ops.ltsh.bake):
        assert not operator.poll()
        with pytest.raises(RuntimeError, match="A job is running"):
            operator()
    hand.send("ESC", "PRESS")
    assert bpy.ops.ltsh.shade.poll() and not bpy.ops.ltsh.cancel.poll()


def test_opening_another_file_ends_the_job(never_ends, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"), copy=True)
    hand = Hand().start()
    hand.until(lambda: operators.running_job().results)
    job = operators.running_job()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other.blend"))
    assert operators.running_job() is None
    hand.send()
    assert hand.outcome != {"RUNNING_MODAL"} and ended(job)
    assert results.result_of(bpy.context.scene) is None


@pytest.mark.parametrize("end", ["killed", "quit"])
def test_a_blender_that_ends_meanwhile_leaves_no_process_and_no_files(never_ends, tmp_path, end):
    """The job belongs to another process here, which stands for that Blender."""
    runs = job_arguments.runs(bpy.context, "compare", tmp_path / "room.blend")
    command = programs.python(OWNER.format(runs=json.dumps(runs), end=end))
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        line = next(line for line in owner.stdout if line.startswith("OWNER "))
        _, pid, folder = line.split(" ", 2)
        if end == "killed":
            assert Path(folder.strip()).is_dir()
            owner.kill()
    # One that quits has waited for it.
    seconds = SECONDS if end == "killed" else 0.0
    assert ends(lambda: not Path(folder.strip()).exists(), seconds) and ends(lambda: not is_running(int(pid)), seconds)


def ends(condition, seconds):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def is_running(pid):
    """A process that has ended stays in the list as long as nobody has asked for its exit code."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_disabling_the_add_on_ends_the_job(never_ends):
    hand = Hand().start()
    job = operators.running_job()
    operators.unregister()
    try:
        assert job._process.poll() is not None and not job.folder.exists()
        hand.send()
        assert hand.outcome == {"CANCELLED"}
    finally:
        operators.register()


def test_a_scene_that_is_renamed_or_removed_meanwhile(scene):
    scene.name = "Before"
    hand = Hand("shade").start()
    scene.name = "After"
    hand.until(lambda: False)
    assert hand.outcome == {"FINISHED"} and hand.reports[0][0] == "INFO" and results.result_of(scene) is not None
    hand = Hand("shade").start()
    bpy.data.scenes.new("Other")
    bpy.data.scenes.remove(scene)
    hand.send()
    hand.send("ESC", "PRESS")
    assert hand.outcome == {"CANCELLED"} and hand.reports[0][0] == "WARNING"


# ---- faults are one line


def faults_of(operator) -> str:
    with pytest.raises(RuntimeError) as caught:
        operator()
    text = str(caught.value)
    assert text.startswith("Error: ") and text.count("\n") == 1 and "Traceback" not in text, text
    assert operators.running_job() is None
    return text


def test_a_process_that_dies_is_told(scene):
    hand = Hand("shade").start()
    operators.running_job()._process.kill()
    hand.until(lambda: False)
    ((kind, text),) = hand.reports
    assert kind == "ERROR" and "Blender ended with code" in text and "\n" not in text
    assert hand.outcome == {"CANCELLED"} and hand.context.timers == []


def test_a_blender_that_cannot_be_started_is_told(scene, monkeypatch):
    def fail(*arguments, **options):
        raise OSError("no more processes")

    monkeypatch.setattr(blender_process, "start", fail)
    assert "no more processes" in faults_of(bpy.ops.ltsh.compare)


def test_what_the_command_line_refuses_is_told(scene):
    bpy.data.objects["Light"].data.energy = 0.0
    assert "no area light" in faults_of(bpy.ops.ltsh.shade)


def test_an_output_folder_that_is_a_file_is_told(scene, tmp_path):
    (tmp_path / "taken").write_text("")
    scene.ltsh.output_folder = "//taken/"
    assert "taken" in faults_of(bpy.ops.ltsh.shade)
    assert (tmp_path / "taken").read_text() == ""


def test_an_unexpected_fault_ends_the_job_with_one_line(scene, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("cannot\nread")

    monkeypatch.setattr(results, "show", fail)
    hand = Hand("shade").start().until(lambda: False)
    assert hand.outcome == {"CANCELLED"} and hand.reports == [("ERROR", "shade failed: cannot read")]
    assert hand.context.timers == [] and operators.running_job() is None
    monkeypatch.setattr(Job, "wait", fail)
    assert "Shade Camera View failed: cannot read" in faults_of(bpy.ops.ltsh.shade)


def test_the_scene_and_its_file_stay_as_they_were(scene, tmp_path):
    before = (tmp_path / "room.blend").read_bytes(), bpy.data.filepath, sorted(path.name for path in tmp_path.iterdir())
    scene.frame_set(7)
    names = [ob.name for ob in bpy.data.objects], [layer.name for layer in scene.view_layers], scene.render.engine
    Hand("shade").start().send("ESC", "PRESS")
    assert [ob.name for ob in bpy.data.objects] == names[0] and scene.frame_current == 7
    assert ([layer.name for layer in scene.view_layers], scene.render.engine) == names[1:]
    after = (tmp_path / "room.blend").read_bytes(), bpy.data.filepath, sorted(path.name for path in tmp_path.iterdir())
    assert after == before


def test_a_file_that_was_never_saved_uses_the_folder_of_the_preferences(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("ltsh_addon.blender.interface.preferences.default_output_folder", lambda: tmp_path / "own")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    room_scene = Path(bpy.data.filepath)
    assert job_arguments.output_folder(scene, "shade") == room_scene.parent / "ltsh" / "shade"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert job_arguments.output_folder(bpy.context.scene, "shade") == tmp_path / "own" / "untitled" / "shade"
    bpy.data.scenes.new("Second")
    assert job_arguments.output_folder(bpy.data.scenes["Second"], "bake").parts[-3:] == ("untitled", "Second", "bake")


def test_objects_that_cannot_be_baked_are_left_out(scene):
    floor = bpy.data.objects["Floor"]
    other = floor.copy()
    other.data, other.name = floor.data.copy(), "Bare"
    scene.collection.objects.link(other)
    other.data.uv_layers.remove(other.data.uv_layers[0])
    for ob in (floor, other):
        ob.select_set(True)
    arguments = job_arguments.bake_arguments(bpy.context, Path("room.blend"))
    assert [item for item in arguments if item.startswith("--object")] == ["--object=Floor"]
