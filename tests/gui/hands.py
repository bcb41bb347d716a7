"""What the drivers share: where things are in the window, clicking them by the mouse, waiting for a job."""

import importlib
import subprocess
import time
from pathlib import Path

import bpy

ADDON = "bl_ext.user_default.ltsh.ltsh_addon"
CLICK_SECONDS = 0.8
# Where buttons of the main panel are in the sidebar, in pixels from its right and upper end at interface scale 1.
PREVIEW, COMPARE, SHADE = (149, 52), (149, 396), (149, 424)

NARROW = 220  # pixels at scale 1
SAVE = (65, 21)  # from the right and lower end of the file browser


def module(name):
    """A module of the installed add-on."""
    return importlib.import_module(f"{ADDON}.blender.{name}")


def job():
    """The job that runs, or None."""
    return module("ui.operators").running_job()


def patient(rig):
    """Let `rig.xdo` wait until the display has it: a busy machine takes its time to start programs."""
    rig.xdo = lambda *words: subprocess.run(["xdotool", *map(str, words)], check=False, timeout=60)


def settings():
    return bpy.context.scene.ltsh


def to_window(rig, kind, which, right, top):
    """X11 coordinates of a point given in pixels at scale 1 from the right and the upper end of a region."""
    region, scale = rig.region(kind, which), bpy.context.preferences.system.ui_scale
    x = region.x + region.width - right * scale
    y = rig.size[1] - (region.y + region.height - top * scale)
    return round(x), round(y)


def click(rig, x, y):
    """Press and release the left button there; Blender handles both in the steps after."""
    rig.xdo("mousemove", x, y)
    yield CLICK_SECONDS
    rig.xdo("click", 1)
    yield CLICK_SECONDS


def click_button(rig, place):
    """Click a button of the sidebar at one of the places above."""
    yield from click(rig, *to_window(rig, "VIEW_3D", "UI", *place))


def editor_for_results(rig):
    """Make the timeline an Image Editor, in which results open: a window of their own would lie over this one."""
    for area in rig.window.screen.areas:
        if area.type == "DOPESHEET_EDITOR":
            area.ui_type = "IMAGE_EDITOR"


def open_panel(rig):
    """Look through the camera, with our tab in the sidebar; results open in the timeline's area."""
    editor_for_results(rig)
    settings().anti_aliasing = 1
    rig.camera_view()
    rig.panel()
    yield 1
    rig.tab("LTSH")


def operate(rig, operator, *arguments, kind="VIEW_3D", which="WINDOW", **options):
    """Call an operator of Blender in a region of the window."""
    with rig.override(kind, which):
        operator(*arguments, **options)


def select(rig, ob):
    """Select this object alone, as the active one."""
    operate(rig, bpy.ops.object.select_all, action="DESELECT")
    ob.select_set(True)
    bpy.context.view_layer.objects.active = ob


def job_started(rig, what):
    """Wait for the job that was asked for."""
    yield from comes(rig, lambda: job() is not None, what)


def close_window(window):
    with bpy.context.temp_override(window=window):
        bpy.ops.wm.window_close()


def editor_beside_view(rig):
    """Make half of the 3D view an Image Editor, with our tab."""
    screen = rig.window.screen
    for area in screen.areas:
        if area.type == "IMAGE_EDITOR":
            area.ui_type = "TIMELINE"
    known = set(screen.areas)
    operate(rig, bpy.ops.screen.area_split, direction="VERTICAL", factor=0.5)
    area = next(area for area in screen.areas if area not in known)
    area.ui_type = "IMAGE_EDITOR"
    area.spaces.active.show_region_ui = True
    yield 2
    rig.region("IMAGE_EDITOR", "UI").active_panel_category = "LTSH"


def results_opened(rig):
    """Show the results in an Image Editor in half of the 3D view, with our tab beside them."""
    yield from editor_beside_view(rig)
    operate(rig, bpy.ops.ltsh.open_results)
    yield 2
    operate(rig, bpy.ops.image.view_all, fit_view=True, kind="IMAGE_EDITOR")
    yield 1


def view_middle(rig):
    """X11 coordinates of the middle of the 3D view."""
    region = rig.region()
    return region.x + region.width // 2, rig.size[1] - region.y - region.height // 2


def start_comparison(rig, what="a click on Compare with Cycles starts a job"):
    """Click Compare with Cycles, and wait for its job."""
    yield from click_button(rig, COMPARE)
    yield from job_started(rig, what)


def drag(rig, start, end):
    """Drag with the left button from `start` to `end`."""
    rig.xdo("mousemove", *start)
    yield CLICK_SECONDS
    rig.xdo("mousedown", 1)
    yield CLICK_SECONDS
    for point in (((start[0] + end[0]) // 2, (start[1] + end[1]) // 2), end):
        rig.xdo("mousemove", *point)
        yield CLICK_SECONDS
    rig.xdo("mouseup", 1)
    yield CLICK_SECONDS


def narrow(rig):
    """Make the sidebar of the 3D view narrow by its edge."""
    region = rig.region("VIEW_3D", "UI")
    y = rig.size[1] - region.y - region.height // 8
    yield from drag(rig, (region.x - 1, y), (region.x + region.width - NARROW, y))
    yield 1
    width = rig.region("VIEW_3D", "UI").width
    rig.check(abs(width - NARROW) < 30, f"the sidebar is narrow: {width}")


def line_at(rig, share, most):
    """Wait for the line of the wipe to follow the mouse there."""
    yield from until(lambda: abs(settings().split - share) < most)
    found = settings().split
    rig.check(abs(found - share) < most, f"the line follows the mouse: split is {found:.3f}")


def keys(rig, *names):
    """Press keys or shortcuts such as ctrl+z one after another; the mouse must be over the area that they are for."""
    for name in names:
        rig.xdo("key", name)
        yield CLICK_SECONDS


def typed(rig, *names, kind="VIEW_3D"):
    """Press `keys` with the mouse over an area."""
    yield from over(rig, kind)
    yield from keys(rig, *names)


def over(rig, kind="VIEW_3D", which="WINDOW", x=0.3, y=0.5):
    """Put the mouse at a share of a region."""
    region = rig.region(kind, which)
    rig.xdo("mousemove", round(region.x + x * region.width), round(rig.size[1] - region.y - y * region.height))
    yield CLICK_SECONDS


def field(rig, place, text, kind="VIEW_3D", which="UI"):
    """Edit a field by Return, as a double click does, which a busy machine may take for two, and type."""
    rig.xdo("mousemove", *to_window(rig, kind, which, *place))
    yield CLICK_SECONDS
    yield from keys(rig, "Return", "ctrl+a")
    rig.xdo("type", text)
    yield CLICK_SECONDS
    yield from keys(rig, "Return")


def browser():
    """The window and the area of a file browser, None where there is none."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "FILE_BROWSER":
                return window, area
    return None, None


def saved_in(rig, folder, name, shot=""):
    """Fill in the file browser that opens, and click Save."""
    yield from until(lambda: browser()[1] is not None, 60)
    yield 2
    window, area = browser()
    area.spaces.active.params.directory = str(folder).encode()
    area.spaces.active.params.filename = name
    yield 2
    if shot:
        rig.shot(shot)
    yield from click(rig, window.x + window.width - SAVE[0], rig.size[1] - window.y - SAVE[1])
    yield from comes(rig, lambda: bpy.data.filepath.endswith(name), f"the file is saved as {name}", 60)
    yield 2


def file_copy():
    """The path of a copy of the file beside it."""
    path = str(Path(bpy.data.filepath).with_name("other.blend"))
    bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
    return path


def image_pixels(name):
    """Pixels of an image of Blender, a flat tuple; empty where it is not there."""
    image = bpy.data.images.get(name)
    return tuple(image.pixels) if image is not None else ()


def until(condition, seconds=15.0):
    """Wait for `condition()`, on a busy machine too; what follows checks it."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        yield 0.02


def comes(rig, condition, what, seconds=15.0):
    """Wait for `condition()`, and check that it has come; `what` may be a function of what is said then."""
    yield from until(condition, seconds)
    rig.check(bool(condition()), what() if callable(what) else what)


def wait_for_job(rig, seconds, shots=()):
    """Until the job has ended; `shots` are names of pictures taken on the way, one in four seconds."""
    end, names = time.monotonic() + seconds, list(shots)
    while job() is not None and time.monotonic() < end:
        if names:
            rig.shot(names.pop(0))
        yield 4.0 if names else 0.5
    rig.check(job() is None, "the job ends in time")


class Pulse:
    """How long the window did not answer, by a timer of Blender's own event loop.

    `longest` is the longest time between two calls and `at` the stage of the job then; `longest_work` is the most that
    Blender's main thread itself worked in between, which does not depend on what else the machine does.
    """

    def __init__(self):
        self.longest, self.longest_work, self.at, self._calls, self._on = 0.0, 0.0, "", 0, True
        self._last, self._worked = time.monotonic(), time.thread_time()
        bpy.app.timers.register(self._tick, first_interval=0.0)

    def _tick(self):
        now, worked = time.monotonic(), time.thread_time()
        self._calls += 1
        if now - self._last > self.longest:
            self.longest, self.at = now - self._last, job().stage if job() is not None else ""
        self.longest_work = max(self.longest_work, worked - self._worked)
        self._last, self._worked = now, worked
        return 0.01 if self._on else None

    def stop(self, rig, what):
        """Note what was found as facts, but for nameless ones."""
        self._on = False
        if not what:
            return self
        rig.check(self._calls > 1, f"{what}: the window answered")
        at = f" ({self.at})" if self.at else ""
        rig.fact(f"{what}: longest pause{at}, s", round(self.longest, 3))
        rig.fact(f"{what}: longest work of the main thread, s", round(self.longest_work, 3))
        return self
