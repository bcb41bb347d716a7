"""Timing in rounds, time and memory of processes, and counting of what numpy writes."""

import gc
import os
import time
from pathlib import Path

import numpy as np

from ltsh_addon.lobes import moments32


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


class _Counted(np.ndarray):
    """Counts the elements that ufuncs write, or read where they reduce."""

    elements = 0
    calls = 0

    def __array_ufunc__(self, ufunc, method, *inputs, out=None, **options):
        plain = [np.asarray(value) if isinstance(value, np.ndarray) else value for value in inputs]
        if out is not None:
            options["out"] = tuple(np.asarray(value) for value in out)
        result = getattr(ufunc, method)(*plain, **options)
        _Counted.elements += plain[0].size if method == "reduce" else np.asarray(result).size
        _Counted.calls += 1
        if out is not None:
            return out[0]
        return result.view(_Counted) if isinstance(result, np.ndarray) else result


class CountingScratch(moments32.Scratch):
    """Arrays that count what is done to them."""

    def _view(self, name, shape):
        view = super()._view(name, shape).view(_Counted)
        self._views[name, shape] = view
        return view


def elements_per_polygon(function, count):
    """Array elements written per polygon, and calls of ufuncs, by function(scratch)."""
    _Counted.elements = _Counted.calls = 0
    function(CountingScratch())
    return _Counted.elements / count, _Counted.calls
