"""The window answers while a comparison of 1920 x 1080 pixels runs."""

import bpy
from hands import Pulse, job, settings, wait_for_job

SECONDS = 900
LONGEST_WORK = 0.2  # seconds


def main(rig):
    rig.camera_view()
    rig.panel()
    yield 1
    rig.tab("LTSH")
    yield 3
    idle = Pulse()
    yield 5
    idle.stop(rig, "idle")
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 1920, 1080
    settings().techniques, settings().cycles_samples = {"ltc", "ltsh4"}, 4
    yield 1
    start = Pulse()
    with rig.override():
        bpy.ops.ltsh.compare("INVOKE_DEFAULT")
    yield 2
    start.stop(rig, "start of the job")
    pulse = Pulse()
    yield from wait_for_job(rig, 500)
    pulse.stop(rig, "1080p")
    rig.check(job() is None and "LTSH cycles.combined" in bpy.data.images, "the comparison is there")
    rig.check(pulse.longest_work < LONGEST_WORK, f"the main thread never works for {LONGEST_WORK} s at a stretch")
    shown = Pulse()
    settings().split = 0.3
    yield 3
    shown.stop(rig, "moving the wipe at 1080p")
    rig.shot("1080p.png")
