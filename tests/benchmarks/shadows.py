"""Shadows beside Cycles: errors, rays per second, memory; part of `make bench`, needs bpy.

python tests/benchmarks/shadows.py [SCENE ...] [--size WxH] [--cycles-samples N] [--most-rays N]

Errors are noise-cancelled: against two halves of Cycles, and two runs of our own that share no random number, so that
neither noise counts. Times are processor time, that of child processes and of starting them included.
"""

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent), str(ROOT / "tests" / "helpers")]

import measure  # noqa: E402
from surface_scenes import shifted  # noqa: E402

from ltsh_addon import imaging, shading, visibility  # noqa: E402
from ltsh_addon.blender.process.blender_process import embree_libraries  # noqa: E402
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels  # noqa: E402
from ltsh_addon.pipeline import lighting  # noqa: E402
from ltsh_addon.pipeline.options import PictureOptions  # noqa: E402
from ltsh_addon.scene import PASSES  # noqa: E402

NAMES = ("contact", "highlight", "leaves", "arcade")
# Of the error without the noise of Cycles and our own.
MOST_BIAS = {"specular": 0.02, "diffuse": 0.005}
RAYS_PER_SECOND, MOST_NUMPY = 4e6, 2.0
# The most that a pair of a sample and a light may take: few, as by default, and many.
FEW, DEFAULT, MANY = 16, PictureOptions.shadow_rays, 512
# Moves everything, so that the rays of each sample are other ones.
SHIFT = np.array([0.0625, 0.03125, 0.046875])


@dataclass(frozen=True)
class Settings:
    """How long the measurement takes, and how much can be believed of it."""

    size: tuple[int, int] = (192, 108)
    cycles_samples: int = 1024
    most_rays: int = MANY
    rays: int = DEFAULT

    @property
    def resolution(self):
        return f"{self.size[0]}x{self.size[1]}"


QUICK = Settings(size=(128, 72), cycles_samples=128, most_rays=256)
LARGE = Settings(size=(640, 360), cycles_samples=4096, most_rays=1024)


# Errors:


@dataclass(frozen=True)
class Error:
    """Relative, without noise: the estimate, and what it is above and below with 97.5 % each."""

    estimate: float
    least: float
    limit: float

    def __str__(self):
        return f"{self.estimate:6.2%} (< {self.limit:.2%})"


def unbiased(first, second, halves, mask) -> Error:
    """Of two independent images (H, W, 3) against two independent halves (2, H, W, 3)."""
    first, second, (a, b) = first[mask], second[mask], halves[:, mask].astype(np.float64)
    products = 0.5 * ((first - a) * (second - b) + (first - b) * (second - a)).sum(axis=1)
    norm = (a * b).sum()
    squared, deviation = products.sum() / norm, products.std() * math.sqrt(len(products)) / norm
    values = squared, squared - 1.96 * deviation, max(squared, 0.0) + 1.96 * deviation
    return Error(*(math.sqrt(max(0.0, value)) for value in values))


def own_noise(first, second, mask):
    """Of one of two independent images."""
    return np.linalg.norm((first - second)[mask]) / np.linalg.norm((first + second)[mask]) * math.sqrt(2.0)


class Measured:
    """A scene with its Cycles reference, and our own pictures of it in this process."""

    def __init__(self, path, settings):
        self.settings = settings
        width, height = settings.size
        options = PixelJob(path, width=width, height=height, cycles_samples=settings.cycles_samples, shadows="on")
        self.extraction = extract_pixels(options)
        self.halves = self.extraction.cycles.reference
        self.mask = self.extraction.film.coverage() > 0.0

    @cached_property
    def unshadowed(self):
        return self._images({name: 1.0 for name in PASSES})

    def pictures(self, rays, count=2):
        """`count` times what was found with different rays."""
        found = []
        for number in range(count):
            tracer, samples = self.tracer(number)
            with tracer:
                found.append(tracer.trace(samples, visibility.ShadowSampling(PASSES, rays, self.extraction.film)))
        return [self._images({name: self._of_lights(shadows, name) for name in PASSES}) for shadows in found], found

    def exact_specular(self, shadows):
        """The specular image (H, W, 3) of shadows, by quadrature of the light."""
        return self._image("specular", self._of_lights(shadows, "specular"), self._by_quadrature)

    def tracer(self, number):
        """A tracer of the scene, moved by `number` times SHIFT, and the samples there."""
        extraction, shift = self.extraction, number * SHIFT
        occluders = extraction.occluders
        matrices = occluders.matrices.copy()
        matrices[:, :, 3] += shift
        lights = [shifted(light, shift) for light in extraction.lights]
        tracer = lighting.ShadowTracer(replace(occluders, matrices=matrices), lights)
        return tracer, replace(extraction.samples, position=extraction.samples.position + shift)

    @cached_property
    def _by_technique(self):
        return self._by_light("ltsh4", PASSES)

    @cached_property
    def _by_quadrature(self):
        return self._by_light("reference", ("specular",))

    def _by_light(self, technique, passes):
        """Radiance (L, P, 3) of every light, all of it seen."""
        lights = self.extraction.lights
        return shading.shade(self.extraction.samples, lights, technique, passes=passes, rows=range(len(lights)))

    def _of_lights(self, shadows, name):
        """Shares (L, P) of a pass."""
        shares = np.empty((len(self.extraction.lights), len(self.extraction.samples)), np.float32)
        for own, share in zip(shadows.numbers, shadows.shares[name], strict=True):
            shares[list(own)] = share
        return shares

    def _images(self, shares):
        return {name: self._image(name, shares[name], self._by_technique) for name in PASSES}

    def _image(self, name, shares, radiance):
        values = (np.broadcast_to(shares, getattr(radiance, name).shape[:2])[..., None] * getattr(radiance, name)).sum(
            0
        )
        return self.extraction.picture.exposure * self.extraction.film.image(values).astype(np.float64)

    def error(self, image, other=None, name=None) -> Error:
        """Of images of a pass, or of their sum."""
        halves = self.halves[name] if name else sum(self.halves.values())
        return unbiased(image, image if other is None else other, halves, self.mask)


def errors(scene: Measured):
    """Print the errors by pass."""
    most, few, default = scene.settings.most_rays, FEW, scene.settings.rays
    runs = {rays: scene.pictures(rays) for rays in sorted({few, default, most})}
    counts = [f"bias at {most} rays (limit)", *(f"{rays}: bias (limit), noise, told" for rays in (default, few))]
    print(f"    {'':<9} {'unshadowed':>11}{counts[0]:>26}{counts[1]:>34}{counts[2]:>34}")
    for name in PASSES:
        cells = []
        for rays in (default, few):
            (first, second), shadows = runs[rays]
            bias = scene.error(first[name], second[name], name)
            noise = own_noise(first[name], second[name], scene.mask)
            cells.append(f"{bias!s:>18} {noise:>6.2%} {shadows[0].noise[name]:>6.2%}")
        first, second = (images[name] for images in runs[most][0])
        bias = scene.error(first, second, name)
        plain = scene.error(scene.unshadowed[name], name=name).estimate
        verdict, most_bias = "", MOST_BIAS[name]
        if bias.estimate > most_bias:
            verdict = f"  MISSED{', or noise' if bias.least <= most_bias else ''}: target {most_bias:.1%};"
        if name == "specular":
            exact = scene.error(*map(scene.exact_specular, runs[most][1]), name)
            verdict += f"  by quadrature instead of ltsh4: {exact}"
        print(f"    {name:<9} {plain:>11.1%}{bias!s:>26}{cells[0]:>34}{cells[1]:>34}{verdict}")
    every = [(name, images[name]) for pair, _ in runs.values() for images in pair for name in PASSES]
    brighter = sum((image > scene.unshadowed[name] * (1.0 + 1e-5)).sum() for name, image in every)
    finite = all(np.isfinite(image).all() for _, image in every)
    print(f"    values above the unshadowed picture: {brighter}; all finite: {finite}")


# Cost:


class TimedTracer:
    """A tracer that counts its rays and the processor time that they take."""

    def __init__(self, tracer):
        self._tracer, self.rays, self.seconds = tracer, 0, 0.0

    def __getattr__(self, name):
        return getattr(self._tracer, name)

    def transmittance(self, origins, *arguments, **options):
        start = time.thread_time()
        found = self._tracer.transmittance(origins, *arguments, **options)
        self.seconds += time.thread_time() - start
        self.rays += len(origins)
        return found


def terrain(triangles=300_000, seed=0):
    """Hills of so many triangles, 10 m wide, and points (P, 3) a little above them."""
    side = round(math.sqrt(triangles / 2)) + 1
    x, y = np.meshgrid(np.linspace(-5.0, 5.0, side), np.linspace(-5.0, 5.0, side), indexing="ij")
    z = 0.4 * np.sin(3.0 * x) * np.cos(2.6 * y) + 0.1 * np.sin(17.0 * x + 3.0 * y) * np.sin(13.0 * y)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = [corner, corner + side, corner + side + 1], [corner, corner + side + 1, corner + 1]
    mesh = visibility.OccluderMesh(vertices, np.concatenate([np.stack(face, axis=-1) for face in faces]))
    occluders = visibility.Occluders((mesh,), np.zeros(1, int), np.eye(3, 4)[None])
    return occluders, vertices.reshape(side, side, 3)


def triangle_count(occluders) -> int:
    """Number of triangles over all instances."""
    return sum(len(occluders.meshes[mesh].triangles) for mesh in occluders.mesh)


def ray_speed(blocks=6, size=1 << 16):
    """Print how many rays one core traces in a second."""
    generator = np.random.default_rng(0)
    start = time.process_time()
    occluders, grid = terrain()
    with visibility.open_tracer(occluders, embree_libraries()) as tracer:
        build, rates, blocked = time.process_time() - start, [], []
        side = 1 << (size.bit_length() - 1) // 2
        for number in range(blocks):
            # A window of the grid, 1 ray for each of its points, to an area light: as a picture's rays are.
            row, column = generator.integers(0, len(grid) - side // 2, 2)
            points = grid[row : row + side // 2, column : column + side // 2].reshape(-1, 3)
            points = np.repeat(points + (0.0, 0.0, 1e-3), size // len(points), axis=0)
            target = np.array([4.0 * math.cos(number), 4.0 * math.sin(number), 2.0])
            to_light = target + generator.uniform(-0.5, 0.5, points.shape) - points
            length = np.linalg.norm(to_light, axis=1)
            arguments = [v.astype(np.float32) for v in (points, to_light / length[:, None], length * 0.9999)]
            start = time.process_time()
            found = tracer.transmittance(*arguments)
            rates.append(len(points) / (time.process_time() - start))
            blocked.append(1.0 - found.mean())
        rate = float(np.median(rates))
        verdict = "" if rate >= RAYS_PER_SECOND else "  MISSED"
        print(f"  {triangle_count(occluders)} triangles: {rate / 1e6:.2f} million rays/s of one core, best "
              f"{max(rates) / 1e6:.2f} (target {RAYS_PER_SECOND / 1e6:.0f}){verdict}; {np.mean(blocked):.0%} blocked; "
              f"{build:.2f} s for the mesh and its tree; {tracer.description}")  # fmt: skip


def ray_counts(scene: Measured):
    """Print processor time by number of rays, and how much of it is not spent on them."""
    rows = {}
    for rays in (FEW, DEFAULT, MANY):
        tracer, samples = scene.tracer(0)
        start = time.process_time()
        with tracer:
            grown = time.process_time()
            timed = TimedTracer(tracer._tracer)
            sampling = visibility.ShadowSampling(rays=rays, film=scene.extraction.film)
            found = visibility.trace_visibility(samples, tracer._lights, timed, sampling, workers=1)
            end = time.process_time()
        rows[rays] = end - start, found.rays
        numpy_share = (end - grown) / timed.seconds - 1.0 if timed.seconds else math.nan
        verdict = "" if numpy_share <= MOST_NUMPY else "  MISSED"
        print(f"  {rays:>4} rays: {rows[rays][0]:.2f} s, {rows[rays][1]:>9} traced, "
              f"{rows[rays][0] / max(1, rows[rays][1]) * 1e9:.0f} ns each; tree {grown - start:.2f} s, "
              f"rays {timed.seconds:.2f} s, "
              f"numpy {numpy_share:.2f} times that (target {MOST_NUMPY:.0f}){verdict}")  # fmt: skip
    (t0, n0), (t1, n1), (t2, n2) = rows.values()
    print(f"  seconds per million rays more: {(t1 - t0) / (n1 - n0) * 1e6:.3f} from {FEW} to {DEFAULT}, "
          f"{(t2 - t1) / (n2 - n1) * 1e6:.3f} from {DEFAULT} to {MANY} (linear: the same)")  # fmt: skip


def memory(path, folder, settings):
    """Print peaks of `ltsh shade` for two sizes, with and without shadows."""
    for factor in (1, 2):
        size = "x".join(str(factor * length) for length in settings.size)
        words = "-m", "ltsh_addon", "shade", path, "-o", folder / "m", "--quiet", "--resolution", size, "--shadows"
        without, peaks = (measure.run(*words, way) for way in ("off", "on"))
        print(f"  {size}: peak of our process {peaks.own_peak:.0f} MiB, without shadows {without.own_peak:.0f} MiB; of "
              f"the largest process {peaks.peak:.0f} MiB")  # fmt: skip


def report(settings: Settings, names=NAMES):
    """Print all of it."""
    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as name:
        folder = Path(name)
        for name in names:
            start, path = time.perf_counter(), folder / f"{name}_0.blend"
            measure.run(Path(__file__).with_name("finished_scenes.py"), name, folder, 0)
            scene = Measured(path, settings)
            extraction = scene.extraction
            noise = [f"{imaging.reference_noise(*scene.halves[part], scene.mask):.2%} {part}" for part in PASSES]
            counts = f"{len(extraction.samples)} samples, {len(extraction.lights)} lights"
            counts += f", {triangle_count(extraction.occluders)} triangles"
            print(f"  {name}, {settings.resolution}, {counts}; noise of"
                  f" Cycles, {settings.cycles_samples} samples: {', '.join(noise)}")  # fmt: skip
            errors(scene)
            print(f"    {time.perf_counter() - start:.0f} s", flush=True)
        print(f"  cost, scene {name}")
        ray_counts(scene)
        memory(path, folder, settings)
    ray_speed()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"default: {', '.join(NAMES)}")
    parser.add_argument("--size", default=Settings().resolution)
    parser.add_argument("--cycles-samples", type=int, default=Settings.cycles_samples)
    parser.add_argument("--rays", type=int, default=DEFAULT, help="of a pair of a sample and a light")
    parser.add_argument("--most-rays", type=int, default=Settings.most_rays, help="where our noise is to vanish")
    options = parser.parse_args()
    size = tuple(map(int, options.size.split("x")))
    if unknown := set(options.scenes) - set(NAMES):
        parser.error(f"unknown scenes {', '.join(sorted(unknown))}; expected some of {', '.join(NAMES)}")
    settings = Settings(size, options.cycles_samples, options.most_rays, options.rays)
    report(settings, options.scenes or NAMES)


if __name__ == "__main__":
    main()
