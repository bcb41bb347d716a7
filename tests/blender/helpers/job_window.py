"""A window for the operators of jobs, which Blender has in its interface alone: timers, events, the status bar."""

import time
from contextlib import contextmanager
from types import SimpleNamespace

import bpy
import numpy as np

import ltsh_addon
from ltsh_addon.blender.ui import operators

SECONDS = 300


def room(path, width=24, height=16):
    """A plane under an area light, saved at `path`; the scene."""
    import scene_parts as parts

    scene = parts.empty_scene(width, height)
    parts.add_plane(parts.principled("Floor", Roughness=0.4)[0], name="Floor")
    parts.add_area_light()
    parts.add_camera()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    scene.ltsh.cycles_samples, scene.ltsh.anti_aliasing = 4, 1
    scene.ltsh.bake_size, scene.ltsh.bake_margin = "256", 2
    return scene


@contextmanager
def add_on_in_room(path):
    """The add-on, and the scene of `room`."""
    ltsh_addon.register()
    yield room(path)
    ltsh_addon.unregister()


def image_pixels(name):
    """Pixels (H, W, 3) of an image, row 0 above."""
    image = bpy.data.images[name]
    width, height = image.size
    flat = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(flat)
    return flat.reshape(height, width, 4)[::-1, :, :3]


class Window:
    """What `operators._JobOperator` uses of bpy.context, with the timers it has and what the status bar says."""

    def __init__(self):
        self.timers, self.status = [], None
        self.window_manager = SimpleNamespace(
            event_timer_add=self._add, event_timer_remove=self.timers.remove, modal_handler_add=lambda operator: True
        )
        self.workspace = SimpleNamespace(status_text_set=lambda text: setattr(self, "status", text))
        self.window = None

    def __getattr__(self, name):
        return getattr(bpy.context, name)

    def _add(self, seconds, window):
        self.timers.append(object())
        return self.timers[-1]


class Events:
    """What an operator gets that a test invokes and hands events to; `reports` are what it told."""

    def __init__(self):
        self.context, self.reports, self.outcome = Window(), [], None

    def report(self, kinds, text):
        self.reports.append((*kinds, text))

    def start(self):
        self.outcome = self.invoke(self.context, None)
        return self

    def send(self, kind="TIMER", value="NOTHING"):
        """One event; as Blender does, none after the operator has ended."""
        assert self.outcome == {"RUNNING_MODAL"}, self.outcome
        outcome = self.modal(self.context, SimpleNamespace(type=kind, value=value))
        if outcome != {"PASS_THROUGH"}:
            self.outcome = outcome
        return outcome

    def until(self, condition):
        """Send timer events until `condition()` or the end of the operator."""
        end = time.monotonic() + SECONDS
        while self.outcome == {"RUNNING_MODAL"} and not condition():
            assert time.monotonic() < end, "the job takes too long"
            self.send()
            time.sleep(0.02)
        return self


class Hand(Events, operators._JobOperator):
    """An operator of a job."""

    def __init__(self, command="compare"):
        super().__init__()
        self.command, self.bl_label = command, {"compare": "Compare with Cycles"}.get(command, command)


def ended(job) -> bool:
    """True once the process of `job` is gone, and its folder."""
    job._process.wait(SECONDS)
    end = time.monotonic() + SECONDS
    while job.folder.exists() and time.monotonic() < end:
        time.sleep(0.02)
    return not job.folder.exists()
