"""What a bake takes: seconds and memory by size, and its time at equal error beside Cycles' bake; needs bpy.

python tests/benchmarks/bake_cost.py [time | cycles | shadows]

time: 1024^2 and 4096^2 under four lights, ltsh4, constant materials. cycles: part of `make
bench`; how long Cycles' bake takes to come as near to the truth as ltsh4, which the quadrature of `reference` tells.
shadows: processor seconds, with those of Blender, for a floor with shadows under one light and a constant world.
"""

import argparse
import json
import math
import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blender" / "helpers")]

import measure  # noqa: E402

# Size -> seconds of our own work and MiB that a bake may take.
LIMITS = {1024: (3.0, 4096.0), 4096: (60.0, 4096.0)}
# One block of rows: a bake of several blocks starts Cycles for each of them.
EQUAL_SIZE = 512
FACTOR = 30.0


def build_scene(path, textured=False, lights=4):
    """A glossy plane of 6 m under rectangles; `textured`: its color and roughness are procedural textures."""
    import scene_parts

    scene_parts.empty_scene()
    scene_parts.add_camera((0.0, -4.0, 3.0), (0.0, 0.0, 0.0))
    for number in range(lights):
        place = (1.6 * (number % 2) - 0.8, 1.6 * (number // 2) - 0.8, 1.5)
        scene_parts.add_area_light(location=place, rotation=(0.3, 0.0, 0.2))
    material, node = scene_parts.principled("Glossy", Roughness=0.35)
    node.inputs["Base Color"].default_value = (0.4, 0.3, 0.2, 1.0)
    if textured:
        tree = material.node_tree
        noise, places = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeTexCoord")
        tree.links.new(places.outputs["Object"], noise.inputs["Vector"])
        tree.links.new(noise.outputs["Color"], node.inputs["Base Color"])
        tree.links.new(noise.outputs[0], node.inputs["Roughness"])
    scene_parts.add_plane(material, name="Floor")
    scene_parts.save(path)


def build_shadows(path):
    """A floor of 6 m with boxes and balls on it, under one area light and a constant world."""
    import bpy
    import scene_parts

    build_scene(path)
    for ob in [ob for ob in bpy.data.objects if ob.type == "LIGHT"][1:]:
        bpy.data.objects.remove(ob)
    for number in range(5):
        place = (1.1 * (number % 3) - 1.2, 1.4 * (number // 3) - 0.9, 0.3)
        add = bpy.ops.mesh.primitive_cube_add if number % 2 else bpy.ops.mesh.primitive_uv_sphere_add
        add(location=place, scale=(0.3, 0.3, 0.3))
    scene_parts.add_world(Color=(0.3, 0.35, 0.5, 1.0))
    scene_parts.save(path)


def with_shadows(sizes=(512, 1024)):
    """Print the processor seconds of `bake` with shadows and without, by size, all processes together."""
    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as name:
        scene = _scene(Path(name), "shadows")
        for size in sizes:
            options = "--size", size, "--object", "Floor", "--shadows"
            with_them, without = (
                bake(scene, Path(name) / f"{size}{way}", *options, way)[1].processor for way in ("on", "off")
            )
            print(f"  {size:>5}^2: {with_them:.1f} processor s, {without:.1f} without shadows", flush=True)


def bake(scene, output, *options):
    """Run the command; its seconds by stage, and what the process took."""
    usage = measure.run("-m", "ltsh_addon", "bake", scene, "-o", output, "--quiet", *options)
    return json.loads((output / "timing.json").read_text())["seconds"], usage


def times():
    """Print seconds of our own work and the peak for every size of LIMITS; True where all are within them."""
    good = True
    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as name:
        scene = _scene(Path(name), "constant")
        for size, (limit, most) in LIMITS.items():
            # Twice the smaller one, of which the second counts: a busy machine disturbs it most.
            for _ in range(2 if size < 2048 else 1):
                seconds, usage = bake(scene, Path(name) / str(size), "--size", size)
            own = seconds["Floor.exr"]
            good &= own <= limit and usage.peak <= most
            text = (
                f"with Blender {seconds['total']:.1f} s, of processors {usage.processor:.1f} s; peak {usage.peak:.0f}"
            )
            print(f"  {size:>5}^2: {own:.1f} s (target {limit:.0f}), {text} MiB (target {most:.0f})", flush=True)
    return good


def equal_error(quick=False):
    """Print what ltsh4 takes and what Cycles' bake would take for its error; the smaller of the factors."""
    factors = []
    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as name:
        for kind in ("constant", "textured"):
            folder = Path(name) / kind
            folder.mkdir()
            factors.append(_equal_error(_scene(folder, kind), folder, kind, (8, 32) if quick else (16, 64)))
    return min(factors)


def _equal_error(scene, folder, kind, counts):
    small, size = ("--size", str(EQUAL_SIZE // 4)), ("--size", str(EQUAL_SIZE))
    common = ("--passes", "specular", "--margin", "0")
    bake(scene, folder / "truth", *small, *common, "--techniques", "ltsh4,reference")
    found, expected = _layers(folder / "truth", "ltsh4.specular", "reference.specular")
    error = math.sqrt(((found - expected) ** 2).sum() / (expected**2).sum())
    # The second time, so that what the first one read is in memory.
    for _ in range(2):
        seconds, _ = bake(scene, folder / "ours", *size, *common)
    ours = seconds["blender"] + seconds["Floor.exr"]
    noises, costs = [], []
    for count in counts:
        more, _ = bake(scene, folder / str(count), *size, *common, "--error", "--cycles-samples", str(2 * count))
        a, b = _layers(folder / str(count), "cycles_A.specular", "cycles_B.specular")
        noises.append(((a - b) ** 2).sum() / 2.0 / (a * b).sum())
        # Of one of two halves, beyond the extraction.
        costs.append(0.5 * (more["blender"] - seconds["blender"]))
    power = math.log(noises[0] / noises[1]) / math.log(counts[1] / counts[0])
    needed = counts[1] * (noises[1] / error**2) ** (1.0 / power)
    slope = (costs[1] - costs[0]) / (counts[1] - counts[0])
    cycles = costs[1] + slope * (needed - counts[1])
    measured = ", ".join(f"{n} samples {c:.1f} s {e**0.5:.2%}" for n, c, e in zip(counts, costs, noises, strict=True))
    print(f"  {kind} materials, {EQUAL_SIZE}^2, 4 lights, specular; load {os.getloadavg()[0]:.1f}")
    parts = f"extraction {seconds['blender']:.2f} s, shading and file {seconds['Floor.exr']:.2f} s"
    print(f"    ltsh4: error {error:.2%}, {parts}")
    print(f"    Cycles: {measured}: noise falls with power {power / 2.0:.2f}")
    factor = f"{cycles / ours:.0f} x our time (target {FACTOR:.0f} x)"
    print(f"    as near as ltsh4: {needed:.0f} samples, {cycles:.0f} s: {factor}", flush=True)
    return cycles / ours


def _layers(folder, *names):
    import numpy as np

    from ltsh_addon import imaging

    layers = imaging.read_layers(folder / "Floor.exr")
    return [layers[name].astype(np.float64) for name in names]


def _scene(folder, kind):
    """The file of a scene, built by a process of its own."""
    path = folder / "scene.blend"
    measure.run(__file__, "scene", path, "--kind", kind)
    return path


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("time", "cycles", "shadows", "scene"))
    parser.add_argument("path", nargs="?", type=Path)
    parser.add_argument("--kind", default="constant", choices=("constant", "textured", "shadows"))
    options = parser.parse_args()
    if options.what == "scene":
        if options.kind == "shadows":
            build_shadows(options.path)
        else:
            build_scene(options.path, options.kind == "textured")
    elif options.what == "shadows":
        with_shadows()
    elif options.what == "time" and not times():
        raise SystemExit("a bake takes too much")
    elif options.what == "cycles" and equal_error() < FACTOR:
        raise SystemExit("Cycles is not so much slower")


if __name__ == "__main__":
    main()
