"""Where a job stands as a whole: its stages in order, what they cost, and how long those took that are over.

The share that is done never falls, and stages that report nothing go on by what they are expected to take. No bpy here.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

# Costs count as if so many seconds had been measured.
PRIOR_SECONDS = 5.0
# Below, what a stage reports says too little about its length.
LEAST_FRACTION, LEAST_SECONDS = 0.02, 1.0
# An end that is not reported is not shown.
MOST = 0.99


@dataclass(frozen=True)
class Step:
    """A stage of a job; of its `cost`, about seconds, only the proportion to that of the others matters."""

    stage: str
    cost: float


class Plan:
    """Follows a job through its `steps`; the first begins at once, some may never be reported."""

    def __init__(self, steps: Sequence[Step], now: Callable[[], float] = time.monotonic):
        self._steps, self._now = tuple(steps), now
        self._at, self._share = 0, 0.0
        self._measured: dict[str, float] = {}
        self._done_cost = self._done_seconds = 0.0
        self._started = self._stage_started = self._reported = now()
        self._fraction = 0.0

    @property
    def number(self) -> int:
        """Of the step that runs, from 1."""
        return self._at + 1

    @property
    def count(self) -> int:
        """Of all steps."""
        return len(self._steps)

    def report(self, stage: str, fraction: float) -> None:
        """`stage` has done `fraction` of its work."""
        later = range(self._at, self.count)
        at = next((index for index in later if self._steps[index].stage == stage), self._at)
        self._reported = self._now()
        if at != self._at:
            self._end_step()
            self._at, self._stage_started = at, self._reported
        self._fraction = min(max(fraction, 0.0), 1.0) if self._steps[self._at].stage == stage else 0.0

    def _end_step(self) -> None:
        step, seconds = self._steps[self._at], self._reported - self._stage_started
        self._measured[step.stage] = seconds
        self._done_cost += step.cost
        self._done_seconds += seconds

    def share(self) -> float:
        """Of the whole job that is done, in [0, `MOST`]."""
        elapsed = self._now() - self._started
        whole = elapsed + self.seconds_left()
        self._share = max(self._share, min(elapsed / whole, MOST) if whole > 0.0 else 0.0)
        return self._share

    def seconds_left(self) -> float:
        """Until the job will have ended, as far as can be told."""
        return self._rest_of_step() + sum(map(self._expected, self._steps[self._at + 1 :]))

    def _expected(self, step: Step) -> float:
        """Seconds: as long as the same stage took before, or by its cost."""
        pace = (self._done_seconds + PRIOR_SECONDS) / (self._done_cost + PRIOR_SECONDS)
        return self._measured.get(step.stage, step.cost * pace)

    def _rest_of_step(self) -> float:
        """Seconds; between reports the rest melts away and never becomes nothing."""
        done = self._reported - self._stage_started
        if self._fraction >= LEAST_FRACTION and done >= LEAST_SECONDS:
            rest, since = done / self._fraction - done, self._reported
        else:
            rest, since = self._expected(self._steps[self._at]), self._stage_started
        return rest * math.exp(-(self._now() - since) / rest) if rest > 0.0 else 0.0
