"""What an animation costs beside a single frame: time per frame, and memory of both processes over the frames.

python tests/benchmarks/animation.py [--frames N] [--scene FILE.blend]

Without a scene the example scene is taken. A single frame is `ltsh shade` of one frame, with Blender's start. Processor
time, unlike that of the clock, hangs little on what else the machine does. Memory is read every half second (Linux).
Ends with 1 where it grows with the frames.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import measure  # noqa: E402

# Of either process, from the second quarter of the time to the last; a picture per frame would be 240 MiB and more.
MOST_GROWTH = 16.0


def run(arguments, readings):
    """Seconds that `ltsh shade` takes, and those of processors.

    `readings` receives seconds, MiB of the process, of its children, and processor seconds of all.
    """
    command = [sys.executable, "-m", "ltsh_addon", "shade", *map(str, arguments), "--quiet"]
    start, used = time.perf_counter(), _of_children()
    program = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        while program.poll() is None:
            below = measure.children(program.pid)
            memory = measure.resident(program.pid), sum(map(measure.resident, below))
            seconds = sum(map(measure.processor_seconds, (program.pid, *below)))
            readings.append((time.perf_counter() - start, *memory, seconds))
            time.sleep(0.5 if readings[-1][0] > 20.0 else 0.05)
    finally:
        program.kill()
        said = program.communicate()[1]
    if program.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit code {program.returncode}\n{said}")
    return time.perf_counter() - start, _of_children() - used


def _of_children():
    """Processor seconds of all processes that have ended below this one."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def report(frames, scene=None, resolution="64x36") -> bool:
    """Print what `frames` frames cost; True where memory stays as it is."""
    with tempfile.TemporaryDirectory(prefix="ltsh-animation-") as name:
        folder = Path(name)
        if scene is None:
            from ltsh_addon.blender.process import client

            scene = folder / "demo.blend"
            client.build_demo(scene)
        common = [Path(scene).absolute(), "--techniques", "ltsh4", "--resolution", resolution]
        singles = [run([*common, "-o", folder / f"single_{n}", "--frames", 1], []) for n in range(3)]
        rows: list = []
        whole, processors = run([*common, "-o", folder / "all", "--frames", f"1-{frames}"], rows)
        records = json.loads((folder / "all" / "timing.json").read_text())["seconds"]
    rows, each = np.array(rows), np.array([record["total"] for record in records.values()])
    single, of_single = map(min, zip(*singles, strict=True))
    print(f"  single frame with Blender's start      {single:7.2f} s, {of_single:7.2f} s of processors")
    print(f"  {frames:4} frames                            {whole:7.2f} s, {processors:7.2f} s of processors")
    print(f"  a frame of them beside a single one    {whole / frames / single:7.2f} x, "
          f"{processors / frames / of_single:7.2f} x    (target below 1.10)")  # fmt: skip
    print(f"  what is no frame's own work            {100.0 * (whole - each.sum()) / whole:7.1f} % of the time")
    return _over_time(rows, each)


def _over_time(rows, each) -> bool:
    """Processor time per frame and memory by quarters of the frames."""
    # The time of a process is gone with it.
    processors = np.maximum.accumulate(rows[:, 3])
    # Frames end one after another; what lies between them is spread evenly.
    ends = np.cumsum(each) * rows[-1, 0] / each.sum()
    borders = np.linspace(0, len(each), 5).astype(int)
    kept = []
    for first, last in zip(borders[:-1], borders[1:], strict=True):
        begin, end = ends[first], ends[last - 1]
        inside = rows[(rows[:, 0] >= begin) & (rows[:, 0] <= end)]
        used = np.interp([begin, end], rows[:, 0], processors)
        used = (used[1] - used[0]) / (last - 1 - first)
        kept.append(inside[:, 1:3].max(axis=0))
        print(f"  frames {first + 1:4} to {last:4}: {used:5.2f} s of processors each, "
              f"at most {kept[-1][0]:6.1f} MiB, Blender {kept[-1][1]:6.1f} MiB")  # fmt: skip
    return bool((kept[-1] - kept[1] < MOST_GROWTH).all())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--resolution", default="64x36")
    options = parser.parse_args()
    print(f"animation, {options.resolution} pixels")
    if not report(options.frames, options.scene, options.resolution):
        raise SystemExit("memory grows with the frames")


if __name__ == "__main__":
    main()
