"""Jobs with several windows and scenes: results go to the scene they were made of, whatever is closed meanwhile."""

import bpy
import hands

SIZE = "1600x900"
SECONDS = 1500


def main(rig):
    yield from hands.open_panel(rig)
    hands.settings().techniques, hands.settings().cycles_samples = {"ltc"}, 16
    yield 3
    yield from other_window_closed(rig)
    yield from undone_while_it_runs(rig)
    yield from own_window_closed(rig)
    yield from scene_removed(rig)


def results_of(scene):
    return hands.module("ui.results").result_of(scene)


def second_window(rig):
    """A new window, which may show a scene of its own."""
    hands.operate(rig, bpy.ops.wm.window_new_main)
    return bpy.context.window_manager.windows[-1]


def other_window_closed(rig):
    """A second window with a second scene is there while the job runs, and is closed."""
    first = bpy.context.scene
    second = second_window(rig)
    other = first.copy()
    other.name = "Other"
    second.scene = other
    yield 3
    rig.shot("1_two_windows.png")
    # The second window lies over the first one.
    hands.operate(rig, bpy.ops.ltsh.compare, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "a job starts in the first window")
    yield 4
    rig.shot("2_job_in_the_first.png")
    hands.close_window(second)
    yield 1
    rig.check(hands.job() is not None, "closing another window leaves the job alone")
    yield from hands.wait_for_job(rig, 600)
    yield 1
    rig.check(results_of(first) is not None, "the results are those of the scene of the job")
    rig.check(not other.ltsh.result_folder or other.ltsh.result_folder != first.ltsh.result_folder,
              "the other scene has none of them")  # fmt: skip
    rig.shot("3_done.png")
    bpy.data.scenes.remove(other)


def undone_while_it_runs(rig):
    """Ctrl Z during a job undoes what the artist did and not the job."""
    yield 3
    light = bpy.data.objects["Neon"]
    name, energy = light.name, light.data.energy
    with rig.override():
        bpy.ops.ed.undo_push(message="Before")
        light.data.energy = 3.0 * energy
        bpy.ops.ed.undo_push(message="Brighter")
    yield from hands.start_comparison(rig)
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.until(lambda: bpy.data.objects[name].data.energy == energy)
    rig.check(bpy.data.objects[name].data.energy == energy, "Ctrl Z undoes the change of the light")
    rig.check(hands.job() is not None, "and the job goes on")
    yield from hands.wait_for_job(rig, 600)
    yield 1
    rig.check(results_of(bpy.context.scene) is not None, "its results are shown")
    rig.check("LTSH cycles.combined" in bpy.data.images, "as images")
    rig.check(bpy.data.objects[name].data.energy == energy, "and the light stays as the artist left it")
    rig.shot("4_undone.png")


def own_window_closed(rig):
    """The window in which a job was started is closed: the other one goes on with it, to its end or to Escape."""
    for end in ("to its end", "to Escape"):
        second = second_window(rig)
        yield 3
        area = next(area for area in second.screen.areas if area.type == "VIEW_3D")
        region = next(region for region in area.regions if region.type == "WINDOW")
        with bpy.context.temp_override(window=second, screen=second.screen, area=area, region=region):
            bpy.ops.ltsh.compare("INVOKE_DEFAULT")
        yield from hands.job_started(rig, "a job starts in the second window")
        started = hands.job()
        yield 3
        rig.shot("5_job_in_the_second.png")
        hands.close_window(second)
        yield 2
        rig.shot("5_job_in_the_first.png")
        rig.check(hands.job() is started, f"the window that is left goes on with it {end}")
        if end == "to Escape":
            yield from hands.typed(rig, "Escape")
            yield from hands.until(lambda: hands.job() is None)
            rig.check(started.cancelled, "Escape ends it there")
        else:
            yield from hands.wait_for_job(rig, 600)
            rig.check(not started.cancelled and started.shown == 2, f"{started.shown} of its results are shown")
        yield from hands.until(lambda folder=started.folder: not folder.exists())
        rig.check(not started.folder.exists(), "its files are gone")
        yield 1
        rig.shot("6_closed.png")


def scene_removed(rig):
    """The scene of a job is removed while it runs."""
    former = bpy.context.scene
    doomed = former.copy()
    doomed.name = "Doomed"
    bpy.context.window.scene = doomed
    yield 3
    doomed.ltsh.techniques, doomed.ltsh.cycles_samples = {"ltc"}, 16
    yield from hands.start_comparison(rig)
    started = hands.job()
    yield 3
    bpy.data.scenes.remove(doomed)
    yield 1
    rig.check(bpy.context.scene == former, "the window shows the other scene")
    yield from hands.wait_for_job(rig, 600)
    rig.check(not started.error, f"the job ends without an error: {started.error}")
    yield 1
    rig.shot("7_scene_removed.png")
