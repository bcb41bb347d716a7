"""What shading costs: `make bench`. Prints tables; every row is the median of interleaved runs.

python tests/benchmarks/run.py [--large] [--no-cycles] [--quick] [SECTION ...]
"""

import argparse
import os
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import bake_cost  # noqa: E402
import measure  # noqa: E402
from bench_scenes import WORLDS, floor_scene, metals_of_product, random_polygons, world  # noqa: E402
from textbook_ltc import TextbookLtc  # noqa: E402
from zonal_harmonics import ZonalHarmonics  # noqa: E402

from ltsh_addon import shading  # noqa: E402
from ltsh_addon.cli.commands import DEMO_SCENE  # noqa: E402
from ltsh_addon.lobes.polygon import project_to_sphere, split_at_horizon  # noqa: E402
from ltsh_addon.scene import EllipseLight, PolygonLight  # noqa: E402
from ltsh_addon.workers import pool  # noqa: E402

TABLES = {name: shading.load_table(name) for name in shading.SHIPPED_TABLES}


def heading(text):
    print(f"\n{text}\n{'-' * len(text)}")


def row(name, nanoseconds, ratio=None, note=""):
    print(f"  {name:<42}{nanoseconds:>9.1f} ns{'' if ratio is None else f'{ratio:>8.2f} x'}  {note}")


def compared(cases, base, rounds, per):
    """Print the time of every case, by `per` polygons or samples, and its ratio to the case `base`; the ratios."""
    medians, ratio = measure.ratios(cases, base, rounds)
    for name, seconds in medians.items():
        row(name, seconds / per * 1e9, ratio[name])
    return ratio


def polygons(options):
    """`integrate_polygon` alone: lookup, clip and integral of one lobe per rectangle."""
    count = 20_000 if options.quick else 100_000
    for kind in ("whole", "mixed"):
        heading(f"integrate_polygon, {count} rectangles, {kind}, float32: ns per polygon, ratio to our LTC")
        data = random_polygons(count, kind)
        cases = {"textbook LTC": partial(TextbookLtc(TABLES["ltc"]).integrate_polygon, *data)}
        for name, table in TABLES.items():
            cases[name] = partial(shading.integrate_polygon, table, *data)
        for degree in (2, 4):
            peer = ZonalHarmonics(degree)
            cases[f"zonal harmonics N={degree} (peer)"] = partial(zonal, peer, TABLES[f"ltsh{degree}"], *data)
        ratio = compared(cases, "ltc", 3 if options.quick else 5, count)
        targets(ratio)
        print(f"  peer, target >= 5 x ltsh4: {ratio['zonal harmonics N=4 (peer)'] / ratio['ltsh4']:.1f}")


def targets(ratio):
    print(f"  ltc, target <= 1.1 x textbook: {ratio['ltc'] / ratio['textbook LTC']:.2f}")
    print(f"  ltsh2, target <= 1.3 x ltc: {ratio['ltsh2']:.2f}; ltsh4, target <= 2.0 x ltc: {ratio['ltsh4']:.2f}")


def zonal(peer, table, cosine, roughness, vertices):
    """As `integrate_polygon`, with the peer's integrals."""
    result = np.zeros(len(cosine), np.float32)
    for start in range(0, len(cosine), 4096):
        part = slice(start, start + 4096)
        lobe = table.lookup(cosine[part], roughness[part], curves=1)
        for index, polygon in split_at_horizon(np.ascontiguousarray(vertices[part].transpose(2, 1, 0))):
            chosen = lobe.take(index)
            unit = project_to_sphere(chosen.to_original_domain(polygon))
            result[part][index] = peer.integrate(unit, chosen.coefficients[0].astype(np.float32))
    return np.abs(result)


def shade(options):
    """`shade` with four rectangles: frames, lookup, clip and integrals, one process."""
    count = 50_000 if options.quick else 200_000
    for fresnel, label in (("white", "F = 1"), ("schlick", "Schlick"), ("f82", "F82"),
                           ("dielectric", "dielectric, one IOR"), ("both", "Schlick + dielectric")):  # fmt: skip
        samples, lights = floor_scene(count, 4, fresnel)
        heading(f"shade, {count} samples, 4 rectangles, specular, {label}: ns per sample and light")
        cases = {}
        if fresnel == "white":
            cases["textbook LTC"] = partial(TextbookLtc(TABLES["ltc"]).shade, samples, lights)
            cases["diffuse"] = partial(in_one_row, samples, lights, "ltc", passes=["diffuse"])
        for name, table in TABLES.items():
            cases[name] = partial(in_one_row, samples, lights, table)
        ratio = compared(cases, "ltc", 3 if options.quick else 5, 4 * count)
        if fresnel == "white":
            targets(ratio)


def light_kinds(options):
    """What shapes, spread and light linking cost."""
    count = 10_000 if options.quick else 40_000
    heading(f"kinds of lights: ltsh4, F = 1, {count} samples, 4 lights, one process: ns per sample and light")
    samples, lights = floor_scene(count, 4)
    samples = replace(samples, receiver=np.arange(count) % 2)
    hexagon = [PolygonLight.like(light, corners=EllipseLight.like(light).polygon(6)) for light in lights]
    kinds = {
        "rectangle": lights,
        "rectangle, half of the samples": [replace(light, receivers=(1,)) for light in lights],
        "hexagon": hexagon,
        "ellipse": [EllipseLight.like(light) for light in lights],
        "rectangle, spread 90 degrees": [replace(light, spread=0.5 * np.pi) for light in lights],
        "ellipse, spread 90 degrees": [EllipseLight.like(light, spread=0.5 * np.pi) for light in lights],
        "rectangle, spread 15 degrees": [replace(light, spread=np.pi / 12) for light in lights],
    }
    for part in ("specular", "diffuse"):
        cases = {
            f"{name}, {part}": partial(shading.shade, samples, its, TABLES["ltsh4"], passes=[part], workers=1)
            for name, its in kinds.items()
        }
        compared(cases, f"rectangle, {part}", 3, 4 * count)


def worlds(options):
    """What anisotropic lobes and worlds that vary cost beside isotropic ones under a constant world."""
    count = 10_000 if options.quick else 100_000
    isotropic, lamps = metals_of_product(count, 0.0)
    surfaces = {"isotropic": isotropic, "anisotropic": metals_of_product(count, 0.53)[0]}
    for others, label in (([], "the world alone"), (lamps, "the world and three rectangles")):
        heading(f"{label}: ltsh4c, specular, {count} samples of brushed metal, one process: ns per sample")
        cases = {
            f"{name}, {kind}": partial(in_one_row, samples, [*world(kind), *others], TABLES["ltsh4c"])
            for kind in WORLDS for name, samples in surfaces.items()
        }  # fmt: skip
        ratio = compared(cases, "isotropic, constant", 3, count)
        print(f"  targets: anisotropic <= 2: {ratio['anisotropic, constant']:.2f}; gradient <= 2: "
              f"{ratio['isotropic, gradient']:.2f}; both <= 3: {ratio['anisotropic, gradient']:.2f}")  # fmt: skip


def in_one_row(samples, lights, table, **options):
    options = {"passes": ["specular"], "workers": 1, "rows": [0] * len(lights), **options}
    return shading.shade(samples, lights, table, **options)


def processes(options):
    """One and two processes, and peak memory."""
    count = 300_000 if options.quick else 2_000_000
    samples, lights = floor_scene(count, 8, "schlick")
    for name in ("ltc", "ltsh4"):
        heading(f"processes: {name}, Schlick, {count} samples, 8 lights")
        speed_up(name, samples, lights)
    sizes = (500_000, 2_000_000, *((8_294_400,) if options.large else ()))
    heading("peak memory beyond the samples: ltsh4, both passes, 8 lights, 1 and 2 processes")
    for size in sizes[: 1 if options.quick else None]:
        code = f"import peak_memory; peak_memory.print_peak({size})"
        subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True, timeout=600)


def speed_up(name, samples, lights):
    """Print what two workers gain over one."""
    found, cpu = {}, {}

    def run(number):
        before = cpu_seconds()
        found[number] = in_one_row(samples, lights, TABLES[name], workers=number).specular
        cpu[number] = cpu_seconds() - before

    cases = {"1 process": partial(run, 1), "2 processes": partial(run, 2)}
    medians, ratio = measure.ratios(cases, "1 process", 3)
    for case, seconds in medians.items():
        row(case, seconds / len(samples) / 8 * 1e9, note=f"{seconds:.2f} s")
    reached = 1.0 / ratio["2 processes"]
    same = np.array_equal(found[1], found[2])
    print(f"  speed-up, target 1.8: {reached:.2f} at a load of {os.getloadavg()[0]:.1f}; same bits: {same}")
    print(f"  processor time of two against one: {cpu[2] / cpu[1]:.2f}")


def cpu_seconds():
    """Processor time of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def cycles(options):
    """Time at equal error: the samples Cycles needs to come as close to the truth as ltsh4, times its time for one."""
    from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels

    heading("time at equal error on the demo scene, ltsh4 against Cycles (specular)")
    count = 64 if options.quick else 128
    extraction = extract_pixels(PixelJob(DEMO_SCENE, width=480, height=270, cycles_samples=count))
    start = time.perf_counter()
    shaded = shading.shade(extraction.samples, extraction.lights, "ltsh4", passes=["specular"])
    shade_seconds = time.perf_counter() - start
    image = extraction.film.image(shaded.combined)
    a, b = (half.astype(np.float64) for half in extraction.cycles.reference["specular"])
    energy = (a * b).sum()
    # Halves with different seeds: their noise cancels in the product, and their difference is nothing else.
    error = ((image - a) * (image - b)).sum() / energy
    noise = 0.25 * ((a - b) ** 2).sum() / energy
    needed = count * noise / max(error, 1e-12)
    per_sample = extraction.times.stages["cycles"] / count
    ours = extraction.times.stages["samples"] + shade_seconds
    cycles = f"{count} samples in {extraction.times.stages['cycles']:.1f} s, noise {noise**0.5:.2%}"
    size = f"{len(extraction.samples)} samples, {len(extraction.lights)} lights"
    print(f"  Cycles: {cycles}")
    print(f"  ltsh4: error {error**0.5:.2%}, sample extraction {extraction.times.stages['samples']:.2f} s")
    print(f"         shading {shade_seconds:.2f} s ({size})")
    factor = f"{needed * per_sample / ours:.1f} x our time (target 20 x)"
    print(f"  Cycles needs {needed:.0f} samples, {needed * per_sample:.1f} s, for that error: {factor},")
    print(f"         {needed * per_sample / shade_seconds:.0f} x the shading alone")
    heading("time at equal error of a bake, ltsh4 against Cycles' bake")
    bake_cost.equal_error(options.quick)


def finished(options):
    """Finished pictures beside Cycles with its denoiser, at equal processor time (see finished.py)."""
    import finished as measured

    heading("finished pictures: errors against converged Cycles; times are processor time of the whole process")
    quick = "--scenes product --budgets 8 --seeds 1 --true-samples 512".split()
    measured.main(quick if options.quick else ())


def shadows(options):
    """Shadows beside Cycles: errors, error at equal time, rays, memory (see shadows.py)."""
    import shadows as measured

    settings = measured.QUICK if options.quick else measured.LARGE if options.large else measured.Settings()
    heading("shadows: errors without noise against Cycles with shadows; times are processor time")
    measured.report(settings)


def animation(options):
    """Frames of an animation beside a single one."""
    from animation import report

    frames = 16 if options.quick else 48
    heading(f"{frames} frames of the demo scene, 64 x 36 pixels, ltsh4 (240 of them: make soak)")
    if problem := report("shade", frames):
        print(f"  wrong: {problem}")


def viewport(options):
    """Frames of the viewport by technique, and keeping it in step with a large scene."""
    size = "1920x1080" if options.large else "960x540"
    heading("viewport: frames of the example scene")
    in_blender("viewport_frame.py", "--rounds", "2" if options.quick else "5", "--size", size)
    heading("viewport: keeping in step; targets: first sync 2000 ms, object moved 50 ms")
    in_blender("viewport_sync.py", "100000" if options.quick else "1000000", "100", "32")


def in_blender(name, *arguments):
    """Run a benchmark in a process of its own, which has Blender's graphics."""
    sys.stdout.flush()
    command = [sys.executable, str(Path(__file__).with_name(name)), *arguments]
    code = subprocess.run(command, stderr=subprocess.DEVNULL, timeout=1200).returncode
    if code:
        print(f"  {name} ended with exit code {code}; run it alone to see why")


SECTIONS = {
    "polygons": polygons,
    "shade": shade,
    "lights": light_kinds,
    "worlds": worlds,
    "processes": processes,
    "cycles": cycles,
    "shadows": shadows,
    "finished": finished,
    "animation": animation,
    "viewport": viewport,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"default: all of {', '.join(SECTIONS)}")
    parser.add_argument("--large", action="store_true", help="also memory of 3840 x 2160, frames of 1080p")
    parser.add_argument("--quick", action="store_true", help="fewer samples and rounds")
    parser.add_argument("--no-cycles", action="store_true", help="leave out what needs bpy")
    options = parser.parse_args()
    unknown = set(options.sections) - set(SECTIONS)
    if unknown:
        parser.error(f"unknown sections {', '.join(sorted(unknown))}; expected some of {', '.join(SECTIONS)}")
    # Children print too, each in its turn.
    sys.stdout.reconfigure(line_buffering=True)
    start = time.perf_counter()
    print(f"Python {sys.version.split()[0]}, numpy {np.__version__}, {os.cpu_count()} cores, "
          f"load {os.getloadavg()[0]:.1f}, children run on {pool.interpreter()}")  # fmt: skip
    for name in options.sections or SECTIONS:
        if not (name in ("cycles", "finished", "shadows", "animation", "viewport") and options.no_cycles):
            SECTIONS[name](options)
    print(f"\n{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
