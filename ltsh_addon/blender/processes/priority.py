"""Processes in the background leave the processor to the window. Imports no bpy."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from pathlib import Path

NICENESS = 10
# Linux weighs sessions against each other, and niceness only within one (sched(7), "The autogroup feature").
AUTOGROUP = Path("/proc/self/autogroup")
# It takes one change in so many seconds, from all users together.
AUTOGROUP_SECONDS = 0.1
_TRIES = 5


def background_options() -> dict:
    """Options of `subprocess.Popen` for a process that comes after this one; `yield_to_us` does the rest."""
    flags = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)  # Windows: its own children inherit it
    return {"creationflags": flags} if flags else {}


def yield_to_us(pid: int) -> None:
    """Let the process `pid`, which was started just now, come after this one; threads that it starts inherit that."""
    if hasattr(os, "setpriority"):
        with contextlib.suppress(OSError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, pid, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)


def weigh_session() -> None:
    """Give the session that this process leads the weight that its niceness says."""
    niceness = os.nice(0) if hasattr(os, "nice") else 0
    for _ in range(_TRIES if niceness > 0 else 0):
        try:
            AUTOGROUP.write_text(str(niceness), encoding="ascii")
            return
        except BlockingIOError:
            time.sleep(AUTOGROUP_SECONDS)
        except OSError:  # no Linux, or one without sessions' weights
            return
