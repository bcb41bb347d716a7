"""Memory that `shade` takes beyond its samples, measured in a process of its own."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).parent)]

import measure  # noqa: E402
from bench_scenes import floor_scene  # noqa: E402

from ltsh_addon import shading  # noqa: E402
from ltsh_addon.workers import pool  # noqa: E402


def print_peak(count):
    """Print the peak of this process beyond what it has once the samples are there, and that of its child."""
    samples, lights = floor_scene(count, 8, "schlick")
    bytes_of_samples = sum(getattr(samples, name).nbytes for name in samples.__dataclass_fields__)
    before = measure.resident("self")
    # What making the samples took for a while must not count.
    Path("/proc/self/clear_refs").write_text("5")
    children, start = [], pool.subprocess.Popen

    def popen(*arguments, **options):
        children.append(start(*arguments, **options))
        return children[-1]

    pool.subprocess.Popen = popen
    peaks = {}

    def look(_):
        peaks.update({child.pid: measure.resident(child.pid, "VmHWM") for child in children})

    text = []
    for number in (1, 2):
        shading.shade(samples, lights, "ltsh4", workers=number, progress=look)
        text.append(f"{measure.resident('self', 'VmHWM') - before:.0f} MiB")
    text[1] += f" and {max(peaks.values(), default=0):.0f} MiB in the child"
    print(f"  {count} samples ({bytes_of_samples / 2**20:.0f} MiB): " + "; ".join(text))
