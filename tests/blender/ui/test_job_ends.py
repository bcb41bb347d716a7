"""Jobs of the window that end early or elsewhere: cancelled, another file, a closed window, a Blender that ends."""

import json
import subprocess
import time
from pathlib import Path

import bpy
import programs
import pytest
import scene_parts
from job_window import SECONDS, Hand, ended, image_pixels
from kills import is_running

import ltsh_addon
from ltsh_addon.blender.ui import job as job_module
from ltsh_addon.blender.ui import operators, results

ROOT = Path(__file__).resolve().parents[3]
# Runs a job until its first stage, and waits to be killed or cancels it and ends.
OWNER = """
import json, tempfile, threading, time
from pathlib import Path
from ltsh_addon.blender.ui.job import Job, Plan, Step
job = Job("Job", Plan([Step("Starting", 1.0)]), Path(tempfile.mkdtemp(prefix="ltsh-")), "compare", 0)
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
def never_ends(scene):
    """Cycles has enough to do for as long as a test takes."""
    scene.ltsh.cycles_samples = 1 << 20
    return scene


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
    assert hand.reports == [("WARNING", "Compare with Cycles was cancelled; kept: LTC, LTSH 4c")]
    assert operators.running_job() is None and ended(job)
    result = results.result_of(never_ends)
    assert result.partial == job_module.NO_CYCLES
    assert image_pixels("LTSH ltsh4c.combined").max() > 0.0
    # The choice is there again when Cycles is.
    assert never_ends.ltsh.second == "cycles"


def test_a_cancelled_bake_keeps_and_shows_finished_objects_and_the_next_does_the_others(scene):
    names = ["Floor", *(f"Tile {number}" for number in range(3))]
    for number, name in enumerate(names[1:]):
        scene_parts.add_plane(bpy.data.materials["Floor"], size=0.5, name=name, location=(number, 0.0, 0.3))
    for name in names:
        bpy.data.objects[name].select_set(True)
    scene.ltsh.bake_view = "above"
    hand = Hand("bake").start()
    job = operators.running_job()
    hand.until(lambda: job.shown)
    assert "done" in job.objects.values() and len(job.objects) < len(names)
    # The object is there to look at while the others go on.
    assert all(image_pixels(f"LTSH {name} ltsh4c.combined").any() for name in shown_names(scene))
    assert results.lacks(results.result_of(scene)) == "Not complete: more objects"
    hand.send("ESC", "PRESS")
    done = [name for name, state in job.objects.items() if state == "done"]
    assert hand.reports == [("WARNING", f"bake was cancelled; kept: {', '.join(done)}")]
    folder = job.output
    files = {name: (folder / f"{name}.exr").read_bytes() for name in done}
    hand = Hand("bake").start()
    job = operators.running_job()
    hand.until(lambda: False)
    assert job.objects == {name: "unchanged" if name in done else "done" for name in names}
    assert hand.reports[-1][1].endswith(f"not baked again since nothing has changed: {len(done)} of 4")
    assert files == {name: (folder / f"{name}.exr").read_bytes() for name in done}
    assert set(shown_names(scene)) == set(names)
    scene.ltsh.bake_changed = False
    Hand("bake").start().until(lambda: False)
    assert set(results.state["baked"][1].values()) == {"done"}


def shown_names(scene):
    return list(results.result_of(scene).groups)


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
    assert other.reports == [("WARNING", "Compare with Cycles was cancelled; kept: LTC, LTSH 4c")]


def test_one_job_at_a_time_and_cancelling_one_without_results_says_so(never_ends):
    hand = Hand().start()
    for operator in (bpy.ops.ltsh.shade, bpy.ops.ltsh.compare, bpy.ops.ltsh.bake):
        assert not operator.poll()
        with pytest.raises(RuntimeError, match="A job is running"):
            operator()
    hand.send("ESC", "PRESS")
    assert hand.outcome == {"CANCELLED"} and hand.reports[0][1].endswith("nothing was finished yet")
    assert results.result_of(never_ends) is None
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
    runs = [run.to_dict() for run in job_module.runs_of(bpy.context, "compare", tmp_path / "room.blend")]
    command = programs.python(OWNER.format(runs=json.dumps(runs), end=end))
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        line = next(line for line in owner.stdout if line.startswith("OWNER "))
        _, pid, folder = line.split(" ", 2)
        if end == "killed":
            assert Path(folder.strip()).is_dir()
            owner.kill()
    # One that quits has waited for it.
    last = time.monotonic() + (SECONDS if end == "killed" else 0.0)
    while (Path(folder.strip()).exists() or is_running(int(pid))) and time.monotonic() < last:
        time.sleep(0.05)
    assert not Path(folder.strip()).exists() and not is_running(int(pid))


def test_disabling_the_add_on_ends_the_job(never_ends):
    hand = Hand().start()
    job = operators.running_job()
    ltsh_addon.unregister()
    assert job._process.poll() is not None and not job.folder.exists()
    hand.send()
    assert hand.outcome == {"CANCELLED"}
