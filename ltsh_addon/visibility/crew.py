"""Blocks of samples on all cores: this process and child processes that trace rays take them from one list.

Embree is called with Python's lock held, so that threads would not help. Children are started as those of
`shading.parallel`, and open a tracer of their own. What happens in a block does not depend on who takes it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ..scene import Cancelled, Progress
from ..shading import parallel, worker
from .occluders import Occluders
from .rays import open_tracer

_STAGE = "shadows"


@dataclass(frozen=True)
class Errand:
    """What a child is told first."""

    task: object
    occluders: Occluders
    library: str


class ChildSide:
    """Answers each block (samples, film, starts) with what the task finds."""

    def __init__(self, errand: Errand):
        self._task, self._tracer = errand.task, open_tracer(errand.occluders, [errand.library])

    def shade(self, block):
        """What `task.shares` returns, by the tracer of this process."""
        return self._task.shares(*block, self._tracer)


def run(task, tracer, blocks: Sequence, workers: int | None, progress: Progress | None) -> Iterator[tuple]:
    """Yield (number, task.shares(*block, tracer)) for each of `blocks`, in any order.

    `workers` processes in all; None: as many as there are cores. `progress` is called from this thread; where it
    returns False Cancelled is raised. No child is left when this ends.
    """
    wanted = min(parallel.cores() if workers is None else workers, len(blocks)) - 1
    if parallel.interpreter() is None or getattr(tracer, "library", None) is None:
        wanted = 0
    queue = _Queue(blocks)
    with parallel.helpers(queue) as children:
        # By this thread: it will keep more in the task while it traces.
        errand = worker.packed(Errand(task, tracer.occluders, tracer.library)) if wanted > 0 else b""
        for _ in range(wanted):
            children.append(_Tracing(errand, queue))
        yielded = 0
        while yielded < len(blocks):
            if progress is not None and progress(_STAGE, yielded / len(blocks)) is False:
                raise Cancelled("shadows were stopped")
            number = queue.next()
            if number is not None:
                queue.done(number, task.shares(*blocks[number], tracer))
            for found in queue.found(wait=number is None):
                yield found
                yielded += 1


class _Queue:
    """The blocks that are left, and what was found, for several threads."""

    def __init__(self, blocks):
        self.blocks = blocks
        self._left, self._found = deque(range(len(blocks))), deque()
        self._changed = threading.Condition()
        self.stopped = False

    def next(self):
        """The number of a block that nobody works on, or None."""
        with self._changed:
            return self._left.popleft() if self._left and not self.stopped else None

    def give_back(self, number):
        with self._changed:
            self._left.append(number)
            self._changed.notify_all()

    def done(self, number, found):
        with self._changed:
            self._found.append((number, found))
            self._changed.notify_all()

    def found(self, wait: bool) -> list:
        """What has been found since the last call; `wait` for something new, or to do."""
        with self._changed:
            if wait and not self._found and not self._left:
                self._changed.wait(parallel.PATIENCE_SECONDS)
            found = list(self._found)
            self._found.clear()
            return found

    def stop(self):
        with self._changed:
            self.stopped = True


class _Tracing(parallel.Child):
    """A child that finds shares for blocks."""

    side = "visibility.crew.ChildSide"

    def __init__(self, errand: bytes, queue: _Queue):
        self._errand, self._queue, self._number = errand, queue, None
        super().__init__()

    def _feed(self):
        self.begin(self._errand)
        while (number := self._queue.next()) is not None:
            self._number = number
            self._queue.done(number, self.ask(self._queue.blocks[number]))
            self._number = None

    def _is_unwanted(self):
        return self._queue.stopped

    def _give_back(self):
        if self._number is not None:
            self._queue.give_back(self._number)
