"""What 240 frames cost beside one: memory of both processes over the frames, and time per frame.

python tests/benchmarks/animation.py [--frames N] [--scene FILE.blend]

Without a scene the example scene is taken. A single frame is `ltsh shade` of one frame, with Blender's start; frames of
the animation are timed by their records in timing.json, and their memory is read every half second (Linux).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
MIB = 1 << 20


def run(arguments, memory=None):
    """Seconds that `ltsh shade` with `arguments` takes; `memory` receives (seconds, resident bytes of each process)."""
    command = [sys.executable, "-m", "ltsh_addon", "shade", *map(str, arguments), "--quiet"]
    start = time.perf_counter()
    program = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while program.poll() is None:
            if memory is not None:
                memory.append((time.perf_counter() - start, *resident(program.pid)))
            threading.Event().wait(0.5 if memory is not None else 0.02)
    finally:
        program.kill()
        program.wait()
    if program.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit code {program.returncode}")
    return time.perf_counter() - start


def resident(parent):
    """Resident bytes of the process and of its children together."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    try:
        below = [int(number) for number in children.read_text().split()]
        return _bytes(parent), sum(map(_bytes, below))
    except OSError:
        return 0, 0


def _bytes(process):
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--resolution", default="64x36")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ltsh-animation-") as name:
        folder = Path(name)
        scene = options.scene
        if scene is None:
            from ltsh_addon.blender import child

            scene = folder / "demo.blend"
            child.build_demo(scene)
        common = [scene.absolute(), "--techniques", "ltsh4", "--resolution", options.resolution]
        single = [run([*common, "-o", folder / "single", "--frames", 1]) for _ in range(3)]
        memory: list = []
        whole = run([*common, "-o", folder / "all", "--frames", f"1-{options.frames}"], memory)
        seconds = json.loads((folder / "all" / "timing.json").read_text())["seconds"]
    print(f"single frame, with start: {min(single):.2f} s; {options.frames} frames: {whole:.1f} s", flush=True)
    print(f"per frame {whole / options.frames:.3f} s, {whole / options.frames / min(single):.2f} of a single one")
    each = np.array([record["total"] for record in seconds.values()])
    quarter = len(each) // 4
    print(f"median of the first quarter {np.median(each[:quarter]):.3f} s, last {np.median(each[-quarter:]):.3f} s")
    print(f"outside of tasks {(whole - each.sum()) / options.frames:.3f} s per frame")
    rows = np.array(memory)
    for part in np.array_split(rows[len(rows) // 10 :], 4):
        own, below = part[:, 1:].max(axis=0) / MIB
        print(f"{part[0, 0]:6.1f} to {part[-1, 0]:6.1f} s: at most {own:6.1f} MiB, Blender {below:6.1f} MiB")


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main()
