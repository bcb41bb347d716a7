"""Blocks of samples on all cores: this process and child processes take them from one list.

Threads do not pay off here, because numpy's calls are too short. Children are interpreters started by path, never
forked: inside Blender, a fork would copy a process with threads and a window. Neither the blocks nor what happens in
each depends on the number of processes, so the result does not either. If no child can be started, this process does
everything. Each block and its radiance go through memory that both processes share. When all blocks are done, all
processes take the pairs of a sample and a light that the blocks left for double precision, many together.
"""

from __future__ import annotations

import logging
import mmap
import os
import subprocess
import sys
import tempfile
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from queue import Empty, SimpleQueue

import numpy as np

from ..lobes import moments32
from ..lobes.lobe_integrals import FLOAT64_CHUNK
from ..scene import SCALAR_FIELDS, Cancelled, SurfaceSamples
from . import worker

# A child takes about 0.2 s to start, so shorter tasks are done in this process alone.
SECONDS_WORTH_A_CHILD = 0.5
# An anisotropic sample takes about as long as this many isotropic ones.
ANISOTROPIC_EFFORT = 6
PATIENCE_SECONDS = 0.1
ENDING_SECONDS = 5.0
CORES_VARIABLE = "LTSH_CORES"
_logger = logging.getLogger(__name__)
# Fields of SurfaceSamples that only one pass reads. Tasks without that pass need not send them.
_ONLY_DIFFUSE = {
    "diffuse_normal", "smooth_normal", "bump_alpha2", "diffuse_albedo", "diffuse_roughness", "diffuse_rebound",
    "sheen_a", "sheen_b",
}  # fmt: skip
_ONLY_SPECULAR = {
    "normal", "geometric_normal", "roughness", "specular_f0", "specular_f90", "specular_dip", "dielectric", "ior",
    "anisotropy", "tangent",
}  # fmt: skip
_ALIGNMENT = 64


class SharedBlock:
    """`size` bytes of shared memory; a child process attaches to them with `handle`.

    On Linux and macOS this is a file without a name that the child inherits, on Windows a named mapping. In either case
    the system frees it as soon as both processes are gone, however they end.
    """

    def __init__(self, size: int):
        self._file = None
        if sys.platform == "win32":
            self.handle = f"ltsh-{uuid.uuid4().hex}"
            self._memory = mmap.mmap(-1, size, tagname=self.handle)
            return
        if hasattr(os, "memfd_create"):
            self._file = os.fdopen(os.memfd_create("ltsh"), "r+b")
        else:
            self._file = tempfile.TemporaryFile()
        self.handle = self._file.fileno()
        os.ftruncate(self.handle, size)
        self._memory = mmap.mmap(self.handle, size)

    @property
    def inherited(self) -> tuple[int, ...]:
        """File descriptors that the child must inherit."""
        return () if self._file is None else (self.handle,)

    def arrays(self, layout) -> dict[str, np.ndarray]:
        return arrays_in(self._memory, layout)

    def close(self) -> None:
        """Release the memory. Arrays in it keep it alive until they are gone."""
        self._memory = None
        if self._file is not None:
            self._file.close()


def attach(handle, size: int) -> mmap.mmap:
    """The memory of a parent's SharedBlock."""
    if isinstance(handle, str):
        return mmap.mmap(-1, size, tagname=handle)
    return mmap.mmap(handle, size)


def layout_of(arrays: dict[str, tuple[tuple[int, ...], np.dtype]]) -> tuple[list, int]:
    """Layout [(name, shape, type, offset)] of arrays given by shape and type, and its size in bytes."""
    layout, offset = [], 0
    for name, (shape, dtype) in arrays.items():
        layout.append((name, shape, np.dtype(dtype).str, offset))
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        offset += -(-size // _ALIGNMENT) * _ALIGNMENT
    return layout, max(offset, mmap.PAGESIZE)


def arrays_in(memory, layout) -> dict[str, np.ndarray]:
    """Arrays by name in the buffer `memory`."""
    return {name: np.ndarray(shape, dtype, memory, offset) for name, shape, dtype, offset in layout}


@dataclass(frozen=True)
class Pairs:
    """Samples, each to be shaded under one light, in one pass; fewer than two FLOAT64_CHUNK of them."""

    name: str
    index: np.ndarray  # (N,) of the samples; some occur several times
    number: np.ndarray  # (N,) of the lights


def _index(work):
    return work.index if isinstance(work, Pairs) else work


def _size(work):
    return len(work.index) if isinstance(work, Pairs) else work.stop - work.start


class ParentSide:
    """Sends blocks and pairs of `samples` to one child that works on `task`, at most `block_size` samples at a time."""

    def __init__(self, task, samples: SurfaceSamples, block_size: int):
        self.samples = samples
        unread = set()
        if "diffuse" not in task.passes:
            unread |= _ONLY_DIFFUSE
        if "specular" not in task.passes:
            unread |= _ONLY_SPECULAR
        if all(light.receivers is None for light in task.lights):
            unread.add("receiver")
        self.sent, self.same, first = [], {}, {}
        for field in fields(samples):
            values = getattr(samples, field.name)
            # A field that is left out is 0 on the other side.
            if field.name in unread or _is_zero_everywhere(values):
                continue
            # Equal normals are one array, which is sent once.
            if id(values) in first:
                self.same[field.name] = first[id(values)]
            else:
                first[id(values)] = field.name
                self.sent.append(field.name)
        self.task = task
        self.memory = SharedBlock(self._layouts(block_size)[2])
        self.size = self._layouts(block_size)[2]

    def _layouts(self, count):
        """Layout of the samples, layout of samples and results, and the size of both in bytes."""
        arrays = {}
        for name in self.sent:
            values = getattr(self.samples, name)
            arrays[f"in {name}"] = ((count, *values.shape[1:]), values.dtype)
        shape = (self.task.row_count, count, 3)
        for name in self.task.passes:
            arrays[f"out {name}"] = (shape, self.task.dtype)
        if self.task.has_error:
            arrays["error"] = ((count,), np.float64)
        layout, size = layout_of(arrays)
        return [entry for entry in layout if entry[0].startswith("in ")], layout, size

    def put(self, work: slice | Pairs) -> dict:
        """Copy the samples of `work` into the shared memory, and return the message for the child."""
        inputs, layout, _ = self._layouts(_size(work))
        for name, values in self.memory.arrays(inputs).items():
            np.copyto(values, getattr(self.samples, name.removeprefix("in "))[_index(work)])
        pairs = (work.name, work.number) if isinstance(work, Pairs) else None
        return {"layout": layout, "same": self.same, "count": _size(work), "pairs": pairs}

    def take(self, work: slice | Pairs, leftovers):
        """The task's result, as views of the shared memory, once the child has answered with `leftovers`."""
        _, layout, _ = self._layouts(_size(work))
        arrays = self.memory.arrays([entry for entry in layout if not entry[0].startswith("in ")])
        if isinstance(work, Pairs):
            return (arrays[f"out {work.name}"][0],)
        return {name: arrays[f"out {name}"] for name in self.task.passes}, arrays.get("error"), leftovers

    def close(self) -> None:
        self.memory.close()


class ChildSide:
    """Shades the samples that the parent puts into the shared memory."""

    def __init__(self, task, handle, size: int):
        self.task = task
        self.memory = attach(handle, size)
        self.scratch = moments32.Scratch()

    def shade(self, message: dict) -> dict:
        """Shade what `message` describes. The result goes into the memory; the leftovers are returned."""
        arrays, count = arrays_in(self.memory, message["layout"]), message["count"]
        values = {name.removeprefix("in "): array for name, array in arrays.items() if name.startswith("in ")}
        values.update({name: values[other] for name, other in message["same"].items()})
        for field in fields(SurfaceSamples):
            if field.name not in values:
                values[field.name] = np.broadcast_to(0.0, (count,) if field.name in SCALAR_FIELDS else (count, 3))
        samples = SurfaceSamples(**values)
        if message["pairs"]:
            name, number = message["pairs"]
            arrays[f"out {name}"][0] = self.task.shade_pairs(samples, name, number)
            return {}
        found, estimates, leftovers = self.task.shade(samples, self.scratch)
        for name, radiance in found.items():
            arrays[f"out {name}"][:] = radiance
        if estimates is not None:
            arrays["error"][:] = estimates
        return leftovers


def _is_zero_everywhere(values) -> bool:
    """True for a single zero broadcast to all elements, which `SurfaceSamples` uses for fields that are left out."""
    return values.size > 0 and not any(values.strides) and not values.flat[0]


def run(
    task,
    samples: SurfaceSamples,
    blocks: list[slice],
    workers: int | None,
    result,
    progress: Callable[[float], bool | None] | None = None,
) -> None:
    """Call result.keep(block, *task.shade()) for every block, from any thread. Then call result.pairs() once, and
    result.keep_pairs(pairs, task.shade_pairs()) for all pairs that it returns.

    `workers` is the total number of processes (None: `cores`). After every block, `progress` is called from this
    thread; if it returns False, Cancelled is raised. No child is left when this returns or raises.
    """
    queue = _Queue(blocks, result)
    with helpers(queue) as children:
        effort = len(samples) + ANISOTROPIC_EFFORT * np.count_nonzero(samples.anisotropy)
        wanted = _children_wanted(task, effort, blocks, workers)
        # Pack it in this thread, before shading adds cached values to the task.
        packed = worker.packed(task) if wanted else b""
        for _ in range(wanted):
            most = max(2 * FLOAT64_CHUNK if task.single else 0, *map(_size, blocks))
            children.append(_Shader(packed, ParentSide(task, samples, most), queue))
        _work(task, samples, queue, progress)


@contextmanager
def helpers(queue) -> Iterator[list[Child]]:
    """A list for children that work for `queue`; they are ended in any case."""
    children: list[Child] = []
    try:
        yield children
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
    """Number of cores that this process may use, at most the environment's LTSH_CORES."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(CORES_VARIABLE, "").strip()
    return min(there, int(limit)) if limit.isdecimal() and int(limit) > 0 else there


def interpreter() -> str | None:
    """The Python that runs children; inside Blender, the one that Blender brings along. None if there is none."""
    path = sys.executable
    if not path or not Path(path).stem.lower().startswith("python"):
        return None
    return path


def _work(task, samples, queue, progress):
    """Shade blocks and pairs in this thread until all are done, by any process."""
    scratch = moments32.Scratch()
    while not queue.finished():
        work = queue.next()
        if work is None:
            queue.wait(PATIENCE_SECONDS)
        elif isinstance(work, Pairs):
            queue.done(work, task.shade_pairs(samples.take(work.index), work.name, work.number))
        else:
            queue.done(work, *task.shade(samples.take(work), scratch))
        if progress is not None and progress(queue.share()) is False:
            raise Cancelled("shading was stopped")


class Queue:
    """The work left to do, shared by several threads."""

    def __init__(self, work):
        self._left = deque(work)
        self._changed = threading.Condition()
        self.stopped = False

    def next(self):
        """A piece of work that nobody has taken, or None."""
        with self._changed:
            return self._left.popleft() if self._left and not self.stopped else None

    def next_for_child(self):
        """As `next`; None means that the child is not needed any more."""
        return self.next()

    def give_back(self, work):
        with self._changed:
            self._left.append(work)
            self._changed.notify_all()

    def stop(self):
        with self._changed:
            self.stopped = True


class _Queue(Queue):
    """The blocks, then the pairs that they leave."""

    def __init__(self, blocks, result):
        super().__init__(blocks)
        self._result, self._done = result, 0
        self._blocks = self._total = len(blocks)

    def next_for_child(self):
        while (work := self.next()) is None and not self.stopped and not self.finished():
            self.wait(PATIENCE_SECONDS)
        return work

    def done(self, work, *found):
        (self._result.keep_pairs if isinstance(work, Pairs) else self._result.keep)(work, *found)
        with self._changed:
            self._done += 1
            if self._done == self._blocks:
                pairs = self._result.pairs()
                self._left.extend(pairs)
                self._total += len(pairs)
            self._changed.notify_all()

    def wait(self, seconds):
        """Wait until something changes, at most `seconds`."""
        with self._changed:
            if not self._left and self._done < self._total:
                self._changed.wait(seconds)

    def share(self) -> float:
        """Share of the blocks that is done. What they leave takes little time and does not count."""
        return min(self._done / self._blocks, 1.0)

    def finished(self) -> bool:
        return self._done == self._total


class Child:
    """A worker process, and the thread that feeds it in `_feed`. `side` names the class of the package that does the
    work in that process."""

    side = ""

    def __init__(self, inherited: tuple[int, ...] = ()):
        self._process = None
        self._thread = threading.Thread(target=self._run, name="ltsh-worker", daemon=True)
        try:
            self._process = subprocess.Popen(
                [interpreter(), worker.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                pass_fds=inherited,
                # Nothing here uses BLAS, and its threads take time to start.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                # Ctrl-C goes to the parent alone, which ends the child. No console window on Windows.
                process_group=0,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            _logger.warning("worker process: %s cannot be started (%s); this one goes on alone", interpreter(), error)
            return
        self._thread.start()

    def _run(self):
        try:
            self._feed()
        except (OSError, EOFError, ValueError, _ChildError) as error:
            if self._is_unwanted():
                return  # `end` has killed the process
            # Others compute the work instead, and meet the same error if the samples are at fault.
            self._give_back()
            _logger.warning("worker process ended early (%s); the others go on", error or type(error).__name__)

    def _feed(self):
        """Call `begin`, then `ask` again and again."""
        raise NotImplementedError

    def _is_unwanted(self) -> bool:
        """True if nobody waits for the child any more."""
        raise NotImplementedError

    def _give_back(self) -> None:
        """Leave the child's unfinished work to others."""
        raise NotImplementedError

    def begin(self, task: bytes, *arguments) -> None:
        """Send the task, as `worker.packed` returns it, and the other `arguments` of the class at `side`."""
        first = {"path": sys.path, "package": worker.PACKAGE, "side": self.side, "arguments": arguments}
        worker.send(self._process.stdin, first)
        self.ask(task)

    def ask(self, message):
        """The child's answer to a message."""
        worker.send(self._process.stdin, message)
        answer = worker.receive(self._process.stdout, worker.PACKAGE_FOLDER.name)
        if isinstance(answer, str):
            raise _ChildError(answer.strip().splitlines()[-1])
        return answer

    def end(self):
        """End and reap the process, whatever it is doing."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(ENDING_SECONDS)
            self._thread.join(ENDING_SECONDS)
            for stream in (self._process.stdin, self._process.stdout):
                try:
                    stream.close()
                except OSError:
                    pass  # data that could not be sent any more


class Helper(Child):
    """A child that takes work from `queue` and gives it the results of `_do`. `first` are the arguments of `begin`."""

    def __init__(self, queue, first: tuple, inherited: tuple[int, ...] = ()):
        self._queue, self._first, self._work = queue, first, None
        super().__init__(inherited)

    def _feed(self):
        self.begin(*self._first)
        while (work := self._queue.next_for_child()) is not None:
            self._work = work
            self._queue.done(work, *self._do(work))
            self._work = None

    def _do(self, work) -> tuple:
        """The results of `work`, done by the child."""
        raise NotImplementedError

    def _is_unwanted(self):
        return self._queue.stopped

    def _give_back(self):
        if self._work is not None:
            self._queue.give_back(self._work)


class _Shader(Helper):
    """A child that shades blocks and pairs of `samples`."""

    side = "workers.pool.ChildSide"

    def __init__(self, task: bytes, side: ParentSide, queue):
        self._side = side
        super().__init__(queue, (task, side.memory.handle, side.size), side.memory.inherited)

    def _do(self, work):
        return self._side.take(work, self.ask(self._side.put(work)))

    def end(self):
        super().end()
        self._side.close()


class Keeper(Child):
    """A child that keeps its task and answers one question after another until `end`."""

    def __init__(self, side: str, task: bytes):
        self.side, self._task = side, task
        self._questions: SimpleQueue = SimpleQueue()
        self._answers: SimpleQueue = SimpleQueue()
        self._is_ended = False
        super().__init__()

    def put(self, question) -> None:
        """Ask; `poll` returns the answer."""
        self._questions.put(question)

    def take_back(self):
        """A question that the child has not been asked yet; None if there is none."""
        with suppress(Empty):
            return self._questions.get_nowait()
        return None

    def answers(self, seconds: float) -> list:
        """All answers so far. If there are none, waits up to `seconds` for one."""
        found = []
        while (answer := self.poll(0.0 if found else seconds)) is not None:
            found.append(answer)
        return found

    def poll(self, seconds: float):
        """The next answer; None if there is none within `seconds`."""
        with suppress(Empty):
            return self._answers.get(timeout=seconds) if seconds > 0.0 else self._answers.get_nowait()
        return None

    @property
    def is_gone(self) -> bool:
        """True if there will be no answer any more."""
        return not self._thread.is_alive() and self._answers.empty()

    def _feed(self):
        self.begin(self._task)
        self._task = b""
        while not self._is_ended:
            self._answers.put(self.ask(self._questions.get()))

    def _is_unwanted(self):
        return self._is_ended

    def _give_back(self):
        pass  # `is_gone` tells the caller

    def end(self):
        self._is_ended = True
        # Wakes the thread; nobody reads what it sends then.
        self._questions.put(None)
        super().end()


class _ChildError(Exception):
    """A child met an error. The text is the last line of its report."""
