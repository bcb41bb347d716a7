"""What the light mixer takes at 960 x 540 with 8 lights; needs bpy.

python tests/benchmarks/light_mixer.py [--folder DIR]

Prints milliseconds of a change, all in this thread: of the light that was changed before, of another one, of all;
seconds until a picture can be mixed; those of a light that has moved. The picture is made once and stays in --folder.
"""

import argparse
import os
import time
from functools import partial
from pathlib import Path

import bake_cost
import measure
import numpy as np

from ltsh_addon.pipeline.mixer import LightPictures, Mixer, light_pictures, moved_light
from ltsh_addon.pipeline.relight import OCCLUDERS_SUFFIX, RELIGHT_SUFFIX, RelightData
from ltsh_addon.visibility import Occluders

RESOLUTION = "960x540"


def timed(work):
    """What `work` returns, and the seconds and processor seconds that it took."""
    start, before = time.perf_counter(), os.times()
    found = work()
    after = os.times()
    return found, time.perf_counter() - start, sum(after[:4]) - sum(before[:4])


def changes(mixer, rounds=20):
    """Milliseconds of processor time, median and longest, by kind of change."""
    random, factors, count = np.random.default_rng(1), np.ones((len(mixer.rows), 3)), len(mixer.rows)
    mixer.mixed(factors)
    found = {"of the same light": [], "of another light": [], "of all lights": []}
    for number in range(rounds * 3):
        kind = list(found)[number // rounds]
        if kind == "of all lights":
            factors = random.random((count, 3))
        else:
            factors[0 if kind == "of the same light" else number % count] = random.random(3)
        start = time.thread_time()
        mixer.mixed(factors)
        found[kind].append(1e3 * (time.thread_time() - start))
    return {kind: (np.median(times), max(times)) for kind, times in found.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("light-mixer"))
    out = parser.parse_args().folder.resolve()
    kept_file = out / f"shade{RELIGHT_SUFFIX}"
    if not kept_file.exists():
        out.mkdir(parents=True, exist_ok=True)
        bake_cost.build_scene(out / "room.blend", lights=8)
        words = ("--keep-visibility", "--resolution", RESOLUTION, "--techniques", "ltsh4")
        print("shade", measure.run("-m", "ltsh_addon", "shade", out / "room.blend", "-o", out, *words))
    print(f"kept {kept_file.stat().st_size / 2**20:.0f} MiB")
    kept, *took = timed(lambda: RelightData.load(kept_file))
    print("read what is kept: {:.2f} s, {:.2f} s of processor time".format(*took))
    pictures, *took = timed(lambda: light_pictures(kept))
    print("pictures of {} rows: {:.2f} s, {:.2f} s of processor time".format(len(pictures.rows), *took))
    _, *took = timed(lambda: pictures.save(out / "lights.npz"))
    print(f"write {(out / 'lights.npz').stat().st_size / 2**20:.0f} MiB: {took[0]:.2f} s")
    mixer, *took = timed(lambda: Mixer(LightPictures.load(out / "lights.npz")))
    print(f"open: {took[0]:.2f} s")
    for kind, (median, longest) in changes(mixer).items():
        print(f"change {kind}: {median:.1f} ms, at most {longest:.1f}")
    occluders = Occluders.load(out / f"shade{OCCLUDERS_SUFFIX}")
    for number in range(3):
        light = kept.extraction.lights[0]
        light = light.altered(center=light.center + (0.5, 0.2 * number, 0.0))
        took = timed(partial(moved_light, kept, occluders, light, mixer.rows[0], lambda share: True))[1:]
        print("a moved light: {:.2f} s, {:.2f} s of processor time".format(*took))


if __name__ == "__main__":
    main()
