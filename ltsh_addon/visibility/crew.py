"""Blocks of samples on all cores: this process and child processes that trace rays take them from one list.

Embree is called with Python's lock held, so threads would not help. Children are started as in `workers.pool`, and
each opens its own tracer. What happens in a block does not depend on who takes it.
The children of a `Company` stay: each keeps some of the blocks, which one light after another lights. A `Mate` stays
too: it takes blocks as the children of `run` do, and keeps them from one picture to the next.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..scene import Cancelled, Film, Light, Progress, SurfaceSamples
from ..shading import LookupTable, shade
from ..workers import pool, worker
from .occluders import Occluders
from .rays import open_tracer

_STAGE = "shadows"


@dataclass(frozen=True)
class Errand:
    """The first message to a child."""

    task: object
    occluders: Occluders
    library: str


class ChildSide:
    """Answers each block (samples, film) with what the task finds in it."""

    def __init__(self, errand: Errand):
        self._task, self._tracer = errand.task, open_tracer(errand.occluders, [errand.library])

    def shade(self, block):
        """The result of `task.shares`, with the tracer of this process."""
        return self._task.shares(*block, self._tracer)


def run(task, tracer, blocks: Sequence, workers: int | None, progress: Progress | None) -> Iterator[tuple]:
    """Yield (number, task.shares(*block, tracer)) for each of `blocks`, in any order.

    `workers` is the total number of processes; None: as many as there are cores. `progress` is called from this thread;
    if it returns False, Cancelled is raised. No child is left when this ends.
    """
    wanted = min(pool.cores() if workers is None else workers, len(blocks)) - 1
    if pool.interpreter() is None:
        wanted = 0
    queue = _Queue(len(blocks))
    with pool.helpers(queue) as children:
        # Pack it in this thread, before tracing adds cached values to the task.
        errand = worker.packed(Errand(task, tracer.occluders, tracer.library)) if wanted > 0 else b""
        for _ in range(wanted):
            children.append(_Tracing(errand, blocks, queue))
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


class _Queue(pool.Queue):
    """The numbers of the blocks that are left, and the results that children found."""

    def __init__(self, count: int):
        super().__init__(range(count))
        self._found = []

    def done(self, number, found):
        with self._changed:
            self._found.append((number, found))
            self._changed.notify_all()

    def found(self, wait: bool) -> list:
        """The results since the last call. With `wait`, waits a while for a result or for work to do."""
        with self._changed:
            if wait and not self._found and not self._left:
                self._changed.wait(pool.PATIENCE_SECONDS)
            found, self._found = self._found, []
            return found


class _Tracing(pool.Helper):
    """A child that finds shares for blocks."""

    side = "visibility.crew.ChildSide"

    def __init__(self, errand: bytes, blocks: Sequence, queue: _Queue):
        self._blocks = blocks
        super().__init__(queue, (errand,))

    def _do(self, number):
        return (self.ask(self._blocks[number]),)


# Processes that stay:

# Blocks that a mate is asked for in advance: two keep it busy, and few are lost when a picture is stopped.
AHEAD = 2


class KeptBlocks:
    """Answers blocks of samples with what a task finds in them. Keeps the blocks, and where their rays start, by
    key."""

    def __init__(self, errand: Errand, tracer=None):
        self._tracer = open_tracer(errand.occluders, [errand.library]) if tracer is None else tracer
        self._blocks: dict[tuple, dict[int, tuple]] = {}

    def shade(self, message):
        """The answer to (run, task, key, number, block, normal): run, number, and what the task finds in the block
        (samples, film) with `normal` as its geometric normals. A block that is kept may be left out. Without a key, no
        block is kept."""
        run, task, key, number, block, normal = message
        blocks = {} if key is None else _kept_of(self._blocks, key)
        if number not in blocks:
            blocks[number] = *block, self._tracer.starts(block[0])
        samples, film, starts = blocks[number]
        return run, number, task.shares(replace(samples, geometric_normal=normal), film, self._tracer, starts)


def _kept_of(kept: dict[tuple, dict], key: tuple) -> dict:
    """The blocks kept for `key`, empty at first. Those of other pictures (the first part of a key) are forgotten."""
    for other in [other for other in kept if other[0] != key[0]]:
        del kept[other]
    return kept.setdefault(key, {})


class Mate:
    """A process that traces beside this one, picture after picture, past the occluders of `tracer`, until `close`.

    Both processes keep the samples of a picture by its `key`, the picture and one of its layers. So samples are sent
    only once, except for their geometric normals, which depend on the lights. The process is started when it is worth
    it.
    """

    def __init__(self, tracer):
        self._tracer, self._own = tracer, KeptBlocks(None, tracer)
        self._child: pool.Keeper | None = None
        self._is_possible = pool.cores() > 1 and pool.interpreter() is not None
        self._is_up, self._run = False, 0
        self._sent: dict[tuple, dict[int, bool]] = {}
        self.key: tuple | None = None

    def run(self, task, blocks: Sequence, is_worth: bool, progress: Progress | None) -> Iterator[tuple]:
        """As the function `run`, for blocks of `key`. `is_worth` says whether a process is worth its start."""
        if is_worth and self._child is None and self._is_possible:
            errand = Errand(None, self._tracer.occluders, self._tracer.library)
            self._child, self._is_up = pool.Keeper("visibility.crew.KeptBlocks", worker.packed(errand)), False
        self._run += 1
        left, asked, missing = deque(range(len(blocks))), deque(), set(range(len(blocks)))
        while missing:
            if progress is not None and progress(_STAGE, 1.0 - len(missing) / len(blocks)) is False:
                raise Cancelled("shadows were stopped")
            # The last block is left to this process.
            while self._child is not None and len(asked) < AHEAD and len(left) > 1:
                asked.append(left.pop())
                self._ask(task, asked[-1], blocks[asked[-1]])
            # What the process has not begun is begun here at once.
            found = self._answers(wait=not left and len(asked) < AHEAD)
            if not found and (left or asked):
                number = left.popleft() if left else asked.pop()
                found = [self._own.shade(self._message(task, number, blocks[number], True))[1:]]
            for number, shares in found:
                if number in asked:
                    asked.remove(number)
                if number in missing:
                    missing.remove(number)
                    yield number, shares

    def _message(self, task, number, block, is_whole):
        return self._run, task, self.key, number, block if is_whole else None, block[0].geometric_normal

    def _ask(self, task, number, block):
        sent = {} if self.key is None else _kept_of(self._sent, self.key)
        self._child.put(self._message(task, number, block, number not in sent))
        sent[number] = True

    def _answers(self, wait: bool) -> list:
        """The answers of the process for this run. With `wait`, waits a little for one."""
        found = []
        while self._child is not None:
            answer = self._child.poll(pool.PATIENCE_SECONDS if wait and self._is_up and not found else 0.0)
            if answer is None:
                break
            self._is_up = True
            if answer[0] == self._run:
                found.append(answer[1:])
        if self._child is not None and self._child.is_gone:
            self._is_possible = False
            self.close()
        return found

    def close(self) -> None:
        """End the process. A later run may start another one."""
        if self._child is not None:
            self._child.end()
        self._child, self._sent = None, {}


# With fewer samples, starting a process takes longer than its help saves.
SAMPLES_WORTH_A_CHILD = 1 << 13


@dataclass(frozen=True)
class Setting:
    """Blocks of samples by number, which one light after another lights, and how to light them.

    A block is: samples (B), relative to the origin of the occluders; the samples (Q) from which rays start; their film;
    and for each of the former the number (B,) of the one whose shares it takes.
    """

    blocks: dict[int, tuple[SurfaceSamples, SurfaceSamples, Film, np.ndarray]]
    table: LookupTable
    passes: tuple[str, ...]


class LitBlocks:
    """Answers a light, and the task that finds its shares, with the radiance (B, 3) by pass of a block.

    The `setting` comes with the occluders and the library that traces; both are None if everything is visible.
    """

    def __init__(self, setting: tuple[Setting, Occluders | None, str | None], tracer=None):
        self._setting, occluders, library = setting
        self._tracer = tracer
        if tracer is None and occluders is not None:
            self._tracer = open_tracer(occluders, [library])
        self._starts: dict = {}

    def shade(self, message) -> tuple[int, int, dict[str, np.ndarray]]:
        """The answer to (run, number, light, task): run, number, and radiance."""
        run, number, light, task = message
        return run, number, self._lit(number, light, task)

    def _lit(self, number: int, light: Light, task) -> dict[str, np.ndarray]:
        own, (samples, starting, film, place) = self._setting, self._setting.blocks[number]
        radiance = {name: np.zeros((len(samples), 3), np.float32) for name in own.passes}
        shares = dict.fromkeys(own.passes, np.float32(1.0))
        if task is not None:
            if number not in self._starts:
                self._starts[number] = self._tracer.starts(starting)
            found = task.shares(starting, film, self._tracer, self._starts[number])
            shares = {name: getattr(found, name)[0][place, None] for name in own.passes}
        if any(share.any() for share in shares.values()):
            lit = shade(samples, [light], own.table, passes=own.passes, workers=1)
            radiance = {name: shares[name] * getattr(lit, name)[0] for name in own.passes}
        return radiance


class Company:
    """This process and others, one per core in all, which keep the blocks of a setting until `close`.

    `tracer` knows what stands in the way; None if nothing does.
    """

    def __init__(self, setting: Setting, tracer):
        occluders, library = (None, None) if tracer is None else (tracer.occluders, tracer.library)
        count = min(pool.cores(), len(setting.blocks))
        samples = sum(len(block[0]) for block in setting.blocks.values())
        if pool.interpreter() is None or samples < SAMPLES_WORTH_A_CHILD:
            count = 1
        # This process knows all blocks. After its own, it does those that others have not begun.
        self._own, self._count, self._run = LitBlocks((setting, occluders, library), tracer), count, 0
        parts = [{n: block for n, block in setting.blocks.items() if n % count == own} for own in range(1, count)]
        self._children = [
            pool.Keeper("visibility.crew.LitBlocks", worker.packed((replace(setting, blocks=part), occluders, library)))
            for part in parts
        ]

    def lit(self, light: Light, task, numbers: Sequence[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Yield what the blocks `numbers` reflect of a light, see `LitBlocks`, roughly in that order.

        If the caller stops early, only work that has begun is left behind.
        """
        self._run += 1
        missing, own = set(numbers), deque()
        for number in numbers:
            child = number % self._count
            message = self._run, number, light, task
            if child == 0:
                own.append(message)
            else:
                self._children[child - 1].put(message)
        try:
            while missing:
                message = own.popleft() if own else self._taken_back()
                found = [] if message is None else [self._own.shade(message)]
                for child in self._children:
                    is_idle = message is None and not found
                    found += child.answers(pool.PATIENCE_SECONDS if is_idle else 0.0)
                for run, number, radiance in found:
                    if run == self._run and number in missing:
                        missing.remove(number)
                        yield number, radiance
                if message is None and not found:
                    # Do what a process that is gone had begun.
                    gone = [number for number in missing if self._children[number % self._count - 1].is_gone]
                    own.extend((self._run, number, light, task) for number in gone)
        finally:
            while self._taken_back() is not None:
                pass

    def _taken_back(self):
        """A message that no process has begun to answer; None if there is none."""
        return next((message for child in self._children if (message := child.take_back()) is not None), None)

    def close(self) -> None:
        """End the other processes."""
        for child in self._children:
            child.end()
