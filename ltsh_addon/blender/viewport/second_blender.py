"""The second Blender of a view: with views that follow each other it is one."""

import threading
from contextlib import ExitStack

from ...files import temporary_folder
from ..process.blender_process import BlenderProcess


class SecondBlender:
    """A second Blender, with a folder of its own, that renders the rest for one view after another."""

    def __init__(self):
        self._stack = ExitStack()
        self.folder = self._stack.enter_context(temporary_folder())
        self.process = BlenderProcess(self.folder, background=True)
        self._stack.callback(self.process.end)
        self.step: threading.Thread | None = None  # the last one
        self.left = 0.0  # the moment at which its view was left

    @property
    def is_busy(self) -> bool:
        """True while it does a step, perhaps for a view that was left."""
        return self.step is not None and self.step.is_alive()

    def end(self) -> None:
        """End the process, whatever it is doing, and remove its files."""
        self._stack.close()


# Those of views that were left, for the next ones: undo makes all views new, and artists go to Solid and back.
spare: list[SecondBlender] = []


def end_spare() -> None:
    """End the second Blenders that no view has."""
    while spare:
        spare.pop().end()
