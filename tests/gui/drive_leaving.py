"""Leaving while a job runs: another file is opened, then Blender is quit by the keyboard. Nothing stays behind."""

import atexit
import tempfile
import time
from pathlib import Path

import bpy
from hands import file_copy, job, module, open_panel, settings, start_comparison, typed, until

SECONDS = 400
ENDING_SECONDS = 15.0


def main(rig):
    other = file_copy()
    before = our_folders()
    yield from started(rig)
    stopped = job()
    yield from until(lambda: stopped.stage != "Starting", 120)
    bpy.ops.wm.open_mainfile(filepath=other)
    yield 1
    rig.check(job() is None and stopped.cancelled, "opening another file ends the job")
    yield from until(lambda: is_gone(stopped) and our_folders() == before, ENDING_SECONDS)
    rig.check(is_gone(stopped), "its process is gone")
    rig.check(our_folders() == before, "and its files")
    rig.check(not bpy.data.is_dirty, "the new file is as it was saved")
    rig.shot("1_other_file.png")
    yield from started(rig)
    running = job()
    yield from until(lambda: running.stage != "Starting", 120)
    rig.shot("2_before_quitting.png")
    after_the_add_on(lambda: quit_was_clean(rig, running, before))
    yield from typed(rig, "ctrl+q")
    yield 30
    rig.check(False, "Ctrl Q quits")


def started(rig):
    """A comparison that does not end by itself, started by the mouse."""
    yield from open_panel(rig)
    settings().cycles_samples = 1 << 20
    yield 3
    yield from start_comparison(rig)


def after_the_add_on(function):
    """Let Python call `function` at its end, after the add-on's own: what is registered last is called first."""
    end_now = module("ui.operators")._end_now
    atexit.unregister(end_now)
    atexit.register(function)
    atexit.register(end_now)


def our_folders():
    return sorted(str(path) for path in Path(tempfile.gettempdir()).glob("ltsh-*"))


def is_gone(ended):
    """True once the process of a job has ended and was asked for its exit code."""
    return ended._process.poll() is not None and not ended.folder.exists()


def quit_was_clean(rig, running, before):
    end = time.monotonic() + ENDING_SECONDS
    while time.monotonic() < end and not (is_gone(running) and our_folders() == before):
        time.sleep(0.05)
    rig.check(is_gone(running), "quitting ends the job's process and removes its files")
    rig.check(our_folders() == before, "and those of the Blender that it started")
    rig.exit(0)
