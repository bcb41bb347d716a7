"""Blocks of samples on all cores: this process and child processes take them from one list.

Threads do not pay off here, numpy's calls are too short. Children are interpreters started by path, never forked:
inside Blender a fork would copy a process with threads and a window. The blocks and what happens in each do not depend
on how many processes there are, so the result does not either; where no child can be started this process does it all.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from ..scene import Cancelled, SurfaceSamples
from . import edge_loop, worker
from .block_exchange import ParentSide

# A child takes some 0.2 s to start: shorter tasks are done in this process.
SECONDS_WORTH_A_CHILD = 0.5
PATIENCE_SECONDS = 0.1
ENDING_SECONDS = 5.0
CORES_VARIABLE = "LTSH_CORES"
_PACKAGE = __package__.rpartition(".")[0]
_logger = logging.getLogger(__name__)


def run(
    task,
    samples: SurfaceSamples,
    blocks: list[slice],
    workers: int | None,
    keep: Callable,
    progress: Callable[[float], bool | None] | None = None,
) -> None:
    """Call keep(block, radiance, error) with the result of every block, from this thread or another one.

    `workers` processes in all (None: as many as `cores` says). After every block `progress` is called from this
    thread; where it returns False Cancelled is raised. No child is left when this returns or raises.
    """
    queue = _Queue(blocks, keep)
    children = []
    try:
        for _ in range(_children_wanted(task, len(samples), blocks, workers)):
            children.append(_Child(task, samples, queue, max(block.stop - block.start for block in blocks)))
        _work(task, samples, queue, progress)
    finally:
        queue.stop()
        for child in children:
            child.end()


def _children_wanted(task, count, blocks, workers) -> int:
    if workers is None:
        workers = cores()
    if workers < 2 or task.seconds(count) < SECONDS_WORTH_A_CHILD or interpreter() is None:
        return 0
    return min(workers, len(blocks)) - 1


def cores() -> int:
    """Cores that this process may use: those it may run on, at most as many as the environment's LTSH_CORES says."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(CORES_VARIABLE, "").strip()
    return min(there, int(limit)) if limit.isdecimal() and int(limit) > 0 else there


def interpreter() -> str | None:
    """The Python that runs children: inside Blender the one it brings along. None where there is none."""
    path = sys.executable
    if not path or not Path(path).stem.lower().startswith("python"):
        return None
    return path


def _work(task, samples, queue, progress):
    """Shade blocks in this thread until all are done, by whomever."""
    scratch = edge_loop.Scratch()
    while not queue.finished():
        block = queue.next()
        if block is None:
            queue.wait(PATIENCE_SECONDS)
        else:
            queue.done(block, *task.shade(samples.take(block), scratch))
        if progress is not None and progress(queue.share()) is False:
            raise Cancelled("shading was stopped")


class _Queue:
    """The blocks that are left, for several threads."""

    def __init__(self, blocks, keep):
        self._keep = keep
        self._left, self._total, self._done = deque(blocks), len(blocks), 0
        self._changed = threading.Condition()
        self.stopped = False

    def next(self):
        """A block that nobody works on, or None."""
        with self._changed:
            return self._left.popleft() if self._left and not self.stopped else None

    def give_back(self, block):
        with self._changed:
            self._left.append(block)
            self._changed.notify_all()

    def done(self, block, radiance, error):
        self._keep(block, radiance, error)
        with self._changed:
            self._done += 1
            self._changed.notify_all()

    def wait(self, seconds):
        """Until something changes, or some seconds have passed."""
        with self._changed:
            if not self._left and self._done < self._total:
                self._changed.wait(seconds)

    def stop(self):
        with self._changed:
            self.stopped = True

    def share(self) -> float:
        return self._done / self._total

    def finished(self) -> bool:
        return self._done == self._total


class _Child:
    """One worker process and the thread that feeds it. Whatever goes wrong, its block goes back to the queue."""

    def __init__(self, task, samples, queue, block_size):
        self._side = ParentSide(task, samples, block_size)
        self._task, self._queue = task, queue
        self._process = None
        self._thread = threading.Thread(target=self._feed, name="ltsh-worker", daemon=True)
        try:
            self._process = subprocess.Popen(
                [interpreter(), worker.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                pass_fds=self._side.memory.inherited,
                # Nothing here uses BLAS, whose threads take time to start.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                # Ctrl-C goes to the parent alone, which ends the child; no console window on Windows.
                start_new_session=True,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            _logger.warning("worker process: %s cannot be started (%s); shading goes on without", interpreter(), error)
            return
        self._thread.start()

    def _feed(self):
        block = None
        try:
            commands, answers = self._process.stdin, self._process.stdout
            memory = self._side.memory
            worker.send(
                commands, {"path": sys.path, "handle": memory.handle, "size": self._side.size, "package": _PACKAGE}
            )
            worker.send(commands, self._task)
            self._check(worker.receive(answers))
            while (block := self._queue.next()) is not None:
                worker.send(commands, self._side.put(block))
                self._check(worker.receive(answers))
                self._queue.done(block, *self._side.take(block))
        except (OSError, EOFError, ValueError, _ChildError) as error:
            if self._queue.stopped:
                return  # `end` has killed the process
            if block is not None:
                # This process computes it instead, and meets the same error if the block is at fault.
                self._queue.give_back(block)
            _logger.warning("worker process ended early (%s); shading goes on without", error or type(error).__name__)

    def _check(self, answer):
        if answer is not None:
            raise _ChildError(answer.strip().splitlines()[-1])

    def end(self):
        """End and reap the process, wherever it is."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(ENDING_SECONDS)
            self._thread.join(ENDING_SECONDS)
            for stream in (self._process.stdin, self._process.stdout):
                try:
                    stream.close()
                except OSError:
                    pass  # what could not be sent any more
        self._side.close()


class _ChildError(Exception):
    """A child met an error; the text is its last line."""
