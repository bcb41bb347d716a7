"""`WorkerPool`: this process and worker processes do jobs of one list.

Threads do not pay off here: numpy's calls are too short, and Embree is called with Python's lock held. Workers are
interpreters started by path, never forked: inside Blender, a fork would copy a process with threads and a window. What
happens in a job does not depend on who does it, so the results do not depend on the number of processes. If no worker
can be started, this process does everything.
"""

import logging
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, Protocol

from . import worker

PATIENCE_SECONDS = 0.1
ENDING_SECONDS = 5.0
CORES_VARIABLE = "LTSH_CORES"
NICENESS = 10  # of processes that work while somebody waits for this one
# For `subprocess.Popen`, of such processes; elsewhere than on Windows `lower_priority` is needed as well.
BACKGROUND = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
_logger = logging.getLogger(__name__)


def cores() -> int:
    """Number of cores that this process may use, at most the environment's LTSH_CORES."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(CORES_VARIABLE, "").strip()
    return min(available, int(limit)) if limit.isdecimal() and int(limit) > 0 else available


def interpreter() -> str | None:
    """The Python that runs workers; inside Blender, the one that Blender brings along. None if there is none."""
    path = sys.executable
    if not path or not Path(path).stem.lower().startswith("python"):
        return None
    return path


def lower_priority(process: subprocess.Popen) -> None:
    """Give a process that was just started, and those that it will start, a lower priority than this one."""
    if hasattr(os, "setpriority"):
        os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)


class WorkerTask(Protocol):
    """What a pool does with each job. Workers have copies of it, by pickle."""

    def do(self, job: Any, context: Any) -> Any:
        """The result of `job`; arrays in it and in the job may be overwritten once it is stored. `context` is the
        pool's."""
        ...


class WorkerPool:
    """This process and others, `processes` in all (None: `cores`), which do jobs until `close`.

    `context` is what all tasks need; each worker gets a copy when it starts, by pickle. In the `background` workers
    have a lower priority than this process. Use the pool as a context manager, or call `close`. One thread at a time
    may run it.
    """

    def __init__(self, context: Any = None, processes: int | None = None, *, background: bool = False):
        self._context, self._count = context, cores() if processes is None else processes
        self._background = background
        self._task, self._packed_task = None, b""
        self._run: _Run | None = None
        self._workers: list[Worker] = []
        self.changed, self._is_closed = threading.Condition(), False

    def __enter__(self) -> "WorkerPool":
        return self

    def __exit__(self, *error) -> None:
        self.close()

    def run(
        self,
        task: WorkerTask,
        count: int,
        job: Callable[[int], Any],
        store: Callable[[int, Any], None],
        starts_workers: bool = True,
    ) -> Iterator[int]:
        """Yield how many of `count` jobs are done, each time that this process has done one or waited for the others.

        For each number, store(number, task.do(job(number), context)) is called from any thread, roughly in order. If
        `starts_workers` is False, only workers that run already take part. If the caller stops early, jobs that have
        not begun never do.
        """
        if starts_workers and not self._workers and min(self._count, count) > 1 and interpreter() is not None:
            self._start(min(self._count, count) - 1)
        # Pack in this thread, before work adds cached values to the task.
        if self._workers and task is not self._task:
            self._task, self._packed_task = task, worker.packed(task)
        run = _Run(self.changed, self._packed_task, count, job, store)
        with self.changed:
            self._run = run
            self.changed.notify_all()
        try:
            done = 0
            while done < count:
                number = run.next()
                if number is None:
                    run.wait(PATIENCE_SECONDS)
                else:
                    run.finish(number, task.do(job(number), self._context))
                done = run.done
                yield done
        finally:
            run.stop()

    def _start(self, count: int) -> None:
        self._is_closed, context = False, worker.packed(self._context)
        self._workers = [Worker(self, context, self._background) for _ in range(count)]

    def next_job(self) -> "tuple[_Run, int] | None":
        """The run and number of the next job for a worker; waits for one. None if the pool is closed."""
        with self.changed:
            while not self._is_closed:
                if self._run is not None and (number := self._run.next()) is not None:
                    return self._run, number
                self.changed.wait()
        return None

    @property
    def is_closed(self) -> bool:
        return self._is_closed

    def close(self) -> None:
        """End the workers, whatever they are doing. A later run may start others."""
        with self.changed:
            self._is_closed = True
            self.changed.notify_all()
        while self._workers:
            self._workers.pop().end()
        self._task, self._run = None, None


def opened(workers: int | WorkerPool | None, context: Any = None):
    """Context manager of `workers` if that is a pool, else of a new one of so many processes."""
    return nullcontext(workers) if isinstance(workers, WorkerPool) else WorkerPool(context, workers)


class _Run:
    """The jobs of one call of `WorkerPool.run`, shared by its threads."""

    def __init__(self, changed, packed_task: bytes, count: int, job, store):
        self._changed, self._waiting = changed, deque(range(count))
        self.packed_task, self.job, self._store = packed_task, job, store
        self.done, self._is_stopped = 0, False

    def next(self) -> int | None:
        """The number of a job that nobody has begun; None if there is none."""
        with self._changed:
            return self._waiting.popleft() if self._waiting and not self._is_stopped else None

    def give_back(self, number: int) -> None:
        """Leave a job to others."""
        with self._changed:
            self._waiting.append(number)
            self._changed.notify_all()

    def finish(self, number: int, result) -> None:
        """Store the result of a job, unless nobody waits for it any more."""
        if not self._is_stopped:
            self._store(number, result)
        with self._changed:
            self.done += 1
            self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Wait until a job is done or given back, at most `seconds`."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(seconds)

    def stop(self) -> None:
        """Forget the jobs that nobody has begun, and the results of the others."""
        with self._changed:
            self._is_stopped = True


class Worker:
    """A child process that does jobs of a pool, and the thread that feeds it."""

    def __init__(self, pool: WorkerPool, context: bytes, background: bool):
        self._pool, self._process, self._context = pool, None, context
        self._thread = threading.Thread(target=self._serve, name="ltsh-worker", daemon=True)
        try:
            self._process = subprocess.Popen(
                [interpreter(), worker.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # Nothing here uses BLAS, and its threads take time to start.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                # Ctrl-C goes to the parent alone, which ends the worker. No console window on Windows.
                process_group=0,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0) | (BACKGROUND if background else 0),
            )
            if background:
                lower_priority(self._process)
        except OSError as error:
            _logger.warning("worker process: %s cannot be started (%s); this one goes on alone", interpreter(), error)
            return
        self._thread.start()

    def _serve(self) -> None:
        run = number = None
        try:
            channel = worker.Channel(self._process.stdin, self._process.stdout, worker.PACKAGE_FOLDER.name)
            channel.send((sys.path, worker.PACKAGE))
            self._ask(channel, self._context)
            self._context, packed_task = b"", None
            while (following := self._pool.next_job()) is not None:
                run, number = following
                new_task = None if run.packed_task is packed_task else run.packed_task
                result = self._ask(channel, (new_task, run.job(number)))
                packed_task = run.packed_task
                run.finish(number, result)
                run = None
        except Exception as error:
            if self._pool.is_closed:
                return  # `end` has killed the process
            # Others do the job instead, and meet the same error if the job is at fault.
            if run is not None:
                run.give_back(number)
            _logger.warning("worker process ended early (%s); the others go on", error or type(error).__name__)

    @staticmethod
    def _ask(channel: worker.Channel, message):
        """The worker's answer to a message."""
        channel.send(message)
        problem, result = channel.receive()
        if problem:
            raise RuntimeError(problem.strip().splitlines()[-1])
        return result

    def end(self) -> None:
        """End and reap the process, whatever it is doing."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(ENDING_SECONDS)
            self._thread.join(ENDING_SECONDS)
            for stream in (self._process.stdin, self._process.stdout):
                with suppress(OSError):  # data that could not be sent any more
                    stream.close()
