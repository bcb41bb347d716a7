"""What an animation costs beside a single frame: time per frame, and memory of both processes over the frames.

python tests/benchmarks/animation.py [shade|render] [--frames N] [--scene FILE.blend]

Without a scene `shade` takes the example scene, and `render` five still balls. A single frame has Blender's start in
its time. Processor time, unlike that of the clock, hangs little on what else the machine does. Memory is read every
half second (Linux). Of `render` also how much pixels of still things flicker, beside Cycles with Open Image Denoise,
which gets another seed for each frame and no less time. Ends with 1 where memory grows with the frames, or where
pixels flicker more than a third as much as with Cycles.
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

import finished  # noqa: E402
import measure  # noqa: E402

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.cycles.lobes import read_layer  # noqa: E402

# Of either process, from the second quarter of the time to the last; a picture per frame would be 240 MiB and more.
MOST_GROWTH = 16.0


def run(arguments, readings):
    """Seconds that a command takes, and those of processors.

    `readings` receives seconds, MiB of the process, of its children, and processor seconds of all.
    """
    command = [sys.executable, "-m", "ltsh_addon", *map(str, arguments), "--quiet"]
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


# Of `render`: few, so that 240 frames end today.
QUALITY = {"shade": ["--techniques", "ltsh4"], "render": ["--aa", "5", "--cycles-samples", "16"]}
FLICKER, CYCLES_FRAMES = 1.0 / 3.0, 24


def report(command, frames, scene=None, resolution="64x36") -> str:
    """Print what `frames` frames cost; what is wrong."""
    with tempfile.TemporaryDirectory(prefix="ltsh-animation-") as name:
        folder = Path(name)
        size = tuple(map(int, resolution.split("x")))
        still = finished.Scene("arcade" if command == "shade" else "studio", folder, size, 0)
        common = [command, Path(scene or still.blend(0)).absolute(), *QUALITY[command], "--resolution", resolution]
        singles = [run([*common, "-o", folder / f"single_{n}", "--frames", 1], []) for n in range(3)]
        rows: list = []
        whole, processors = run([*common, "-o", folder / "all", "--frames", f"1-{frames}"], rows)
        records = json.loads((folder / "all" / "timing.json").read_text())["seconds"]
        if command == "render":
            flicker = _flicker_of_ours(folder / "all"), _flicker_of_cycles(still, scene, processors / frames)
    rows, each = np.array(rows), np.array([record["total"] for record in records.values()])
    single, of_single = map(min, zip(*singles, strict=True))
    print(f"  single frame with Blender's start      {single:7.2f} s, {of_single:7.2f} s of processors")
    print(f"  {frames:4} frames                            {whole:7.2f} s, {processors:7.2f} s of processors")
    print(f"  a frame of them beside a single one    {whole / frames / single:7.2f} x, "
          f"{processors / frames / of_single:7.2f} x    (target below 1.10)")  # fmt: skip
    print(f"  what is no frame's own work            {100.0 * (whole - each.sum()) / whole:7.1f} % of the time")
    if command == "render":
        print("  standard deviation of a pixel over the frames, by the mean radiance: "
              f"{100.0 * flicker[0]:.4f} %, Cycles with OIDN {100.0 * flicker[1]:.4f} %")  # fmt: skip
        if flicker[0] > FLICKER * flicker[1]:
            return "pixels flicker"
    return "memory grows with the frames" if not _over_time(rows, each) else ""


def _deviation(images) -> float:
    """Root mean square of the standard deviations of pixels over `images`, by the mean."""
    count, total, squares = 0, 0.0, 0.0
    for image in images:
        count, total, squares = count + 1, total + image.astype(float), squares + np.square(image, dtype=float)
    variance = np.maximum(squares / count - np.square(total / count), 0.0) * count / (count - 1)
    return float(np.sqrt(variance.mean()) / (total / count).mean())


def _flicker_of_ours(folder: Path) -> float:
    return _deviation(imaging.read_layers(path)["combined"][..., :3] for path in sorted(folder.rglob("*.exr")))


def _flicker_of_cycles(still: finished.Scene, scene: Path | None, seconds: float) -> float:
    """Of as many samples as the seconds of a frame of ours allow, the start of Blender and denoising left out."""
    one, more = (still.cycles(0, samples, blend=scene)[1] for samples in (1, 65))
    samples = max(round(64.0 * seconds / (more - one)), 1)
    renders = (still.cycles(number + 1, samples, blend=scene)[0] for number in range(CYCLES_FRAMES))
    return _deviation(read_layer(channels, "Combined", "RGB") for channels in renders)


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
    parser.add_argument("command", nargs="?", default="shade", choices=tuple(QUALITY))
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--resolution", default="64x36")
    options = parser.parse_args()
    print(f"animation by {options.command}, {options.resolution} pixels")
    if problem := report(options.command, options.frames, options.scene, options.resolution):
        raise SystemExit(problem)


if __name__ == "__main__":
    main()
