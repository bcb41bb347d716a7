"""Timing in rounds, time and memory of processes."""

import gc
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]


def ratios(cases, base, rounds=5):
    """Median seconds of every case {name: function}, and {name: median over the rounds of time / time of `base`}; cases
    are taken in turn so that a busy machine disturbs all alike."""
    for function in cases.values():
        function()
    times = {name: [] for name in cases}
    gc.disable()
    for _ in range(rounds):
        for name, function in cases.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    gc.enable()
    medians = {name: float(np.median(values)) for name, values in times.items()}
    return medians, {name: float(np.median(np.divide(times[name], times[base]))) for name in times}


def interleaved(cases, rounds=5):
    """Median seconds of every case."""
    return ratios(cases, next(iter(cases)), rounds)[0]


def children(pid):
    """Numbers of the processes that a process has started; Linux only, as all below."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def processor_seconds(pid):
    """User and system time of a process so far, its children left out; 0 where it has ended."""
    try:
        user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    except OSError:
        return 0.0
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def resident(pid, kind="VmRSS"):
    """MiB of a process that are resident, or its peak, "VmHWM"; 0 where it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return max((int(line.split()[1]) / 1024.0 for line in status if kind in line), default=0.0)


@dataclass(frozen=True)
class Usage:
    """Of a process and all that it has started: seconds, processor seconds; MiB at the peak of the process itself, and
    of the largest of all."""

    seconds: float
    processor: float
    own_peak: float
    peak: float


def run(*command) -> Usage:
    """Run Python with these words to the end. Raises RuntimeError with what it says."""
    # Without compiled modules on disk, every Blender would compile those that it imports; an installed one has them.
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    start, own = time.perf_counter(), 0.0
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [sys.executable, *map(str, command)], cwd=ROOT, env=variables, stdout=output, stderr=output
        )
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            own = max(own, resident(process.pid, "VmHWM"))
            time.sleep(0.01)
        process.returncode, usage = os.waitstatus_to_exitcode(ended[1]), ended[2]
        if process.returncode:
            output.seek(0)
            raise RuntimeError(f"{command}: {output.read().decode(errors='replace')[-2000:]}")
    return Usage(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, own, usage.ru_maxrss / 1024.0)
