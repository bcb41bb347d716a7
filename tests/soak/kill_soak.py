"""Commands that are killed at random moments and gone on with by --resume: the files must be those of one run, to the
byte, and no other file or process may be left. Part of `make soak`; needs Linux and pip's bpy.

python tests/soak/kill_soak.py [--kills N] [--seed S] [COMMAND ...]
"""

import argparse
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers"), str(ROOT / "tests" / "blender" / "helpers")]

import bake_scenes  # noqa: E402
import kills  # noqa: E402

SIGNALS = (signal.SIGKILL, signal.SIGTERM)
# In KiB, at random between these: what the largest file may have where the disk is to be full.
LIMITS = 1, 400
# Of each command the function that builds its scene, and the options.
CASES = {
    "bake": (bake_scenes.textured_scene, "--size 64 --margin 3 --error --cycles-samples 4 --quiet"),
    "shade": (bake_scenes.textured_scene, "--frames 1-2 --resolution 64x48 --quiet"),
    "render": (bake_scenes.textured_scene, "--frames 1-2 --resolution 32x24 --aa 3 --cycles-samples 4 --quiet"),
    "compare": (bake_scenes.textured_scene, "--frames 1-2 --resolution 64x48 --cycles-samples 4 --quiet"),
}


def soak(command, folder, count, seed):
    """Kill `command` `count` times, each time from the start, and half of the times once more after that."""
    build, options = CASES[command]
    build()
    scene = bake_scenes.save(folder)

    def line(output, *more):
        return [sys.executable, "-m", "ltsh_addon", command, str(scene), "-o", str(output), *options.split(), *more]

    trial = kills.Trial(line, folder)
    print(f"{command}: {trial.seconds:.1f} s, {len(trial.expected)} files, seed {seed}", flush=True)
    killed, generator = 0, np.random.default_rng(seed)
    for number, moment in enumerate(kills.moments(seed, count, trial.seconds)):
        name, signal_number = f"killed_{number}", SIGNALS[number % len(SIGNALS)]
        if number % 4 == 3:
            ended = trial.end_while_writing(name, signal_number)
        elif number % 4 == 2:
            ended = full_disk(trial, name, generator.integers(*LIMITS))
        else:
            ended = trial.end_after(name, moment, signal_number)
        if number % 3 == 1:
            ended |= trial.end_after(name, 0.7 * moment, signal_number)
        trial.check(name)
        shutil.rmtree(folder / name)
        killed += ended
        how = (f"{moment:.2f} s", f"{moment:.2f} s", "full disk", "while writing")[number % 4]
        print(f"  {number + 1} of {count}: {how}, {signal_number.name}, same", flush=True)
    print(f"{command}: killed {killed} of {count} times, always the same bytes")
    print(f"{command}: ended at most {trial.runs.slowest_end:.2f} s after a signal")
    return killed


def full_disk(trial, name, blocks) -> bool:
    """Run with a limit for files; False where all fitted."""
    code, said = trial.end_by_limit(name, blocks)
    # A bake goes on with its other objects.
    assert code in (0, 1) and "Traceback" not in said, said
    assert trial.left(name) == [], trial.left(name)
    return code == 1


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help=f"default: all of {', '.join(CASES)}")
    parser.add_argument("--kills", type=int, default=30, help="of each command (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    start = time.monotonic()
    for command in options.commands or CASES:
        with tempfile.TemporaryDirectory(prefix="ltsh-soak-") as name:
            if soak(command, Path(name), options.kills, options.seed) < options.kills / 2:
                raise SystemExit(f"{command}: most runs had ended before they were killed")
    print(f"passed, {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
