"""A scene of many lights, and what it takes; needs bpy.

python tests/benchmarks/many_lights.py [--lights N] [--lamp FACES] [shade options ...]

N area lights of 0.5 to 1 m hang 5 to 9 m over a floor of 60 m with six monkeys on it; or a lamp of that many faces
instead. Prints seconds, processor time and peak memory of `ltsh shade` to its end. The files stay in --folder.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blender" / "helpers"), str(Path(__file__).parent)]

import measure  # noqa: E402

FLOOR = 60.0


def build_scene(path, lights, lamp_faces=0):
    """Save the scene."""
    import bpy
    import scene_parts

    scene_parts.empty_scene()
    scene_parts.add_camera((0.0, -34.0, 12.0), (1.25, 0.0, 0.0))
    floor, _ = scene_parts.principled("Floor", Roughness=0.4)
    scene_parts.add_plane(floor, name="Floor", size=FLOOR)
    for number, roughness in enumerate((0.15, 0.2, 0.3, 0.45, 0.6, 0.8)):
        material, node = scene_parts.principled(f"Monkey {number}", Roughness=roughness, Metallic=float(number % 2))
        node.inputs["Base Color"].default_value = (0.8, 0.5 + 0.1 * (number % 3), 0.4, 1.0)
        bpy.ops.mesh.primitive_monkey_add(size=4.0, location=(8.0 * (number % 3 - 1), 6.0 * (number // 3) - 12.0, 2.0))
        bpy.context.object.data.materials.append(material)
        for polygon in bpy.context.object.data.polygons:
            polygon.use_smooth = True
    choose = random.Random(1)
    for number in range(lights):
        data = bpy.data.lights.new(f"Lamp {number}", "AREA")
        data.size = choose.uniform(0.5, 1.0)
        data.energy = 60_000.0 / lights * choose.uniform(0.3, 1.7)
        data.color = [choose.uniform(0.5, 1.0) for _ in range(3)]
        lamp = bpy.data.objects.new(data.name, data)
        half = 0.5 * FLOOR
        lamp.location = (choose.uniform(-half, half), choose.uniform(-half, half), choose.uniform(5.0, 9.0))
        lamp.rotation_euler = (choose.gauss(0.0, 0.3), choose.gauss(0.0, 0.3), choose.uniform(0.0, 3.0))
        bpy.context.scene.collection.objects.link(lamp)
    if lamp_faces:
        _add_lamp(lamp_faces)
    scene_parts.save(path)


def _add_lamp(faces):
    """A glowing ball of about that many faces over the floor."""
    import bpy

    rings = max(int((faces / 2) ** 0.5), 3)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=2 * rings, ring_count=rings, radius=2.0, location=(0.0, -4.0, 7.0))
    material = bpy.data.materials.new("Glow")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Strength"].default_value = 20.0
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    bpy.context.object.data.materials.append(material)


def shade(scene, output, *options):
    """Seconds, processor seconds and the peak in MiB of `ltsh shade`, all its processes together."""
    command = [
        sys.executable,
        "-m",
        "ltsh_addon",
        "shade",
        str(scene),
        "-o",
        str(output),
        "--json",
        "--quiet",
        *options,
    ]
    start, before = time.perf_counter(), os.times()
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    peak = 0.0
    while process.poll() is None:
        peak = max(peak, sum(measure.resident(pid) for pid in (process.pid, *measure.children(process.pid))))
        time.sleep(0.1)
    after = os.times()
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    found = {"seconds": time.perf_counter() - start, "processor": processor, "peak MiB": peak}
    seconds = json.loads((output / "timing.json").read_text())["seconds"]
    for technique, passes in seconds.pop("techniques").items():
        seconds |= {f"{technique} {name}": value for name, value in passes.items()}
    return found | seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lights", type=int, default=5000)
    parser.add_argument("--lamp", type=int, default=0, metavar="FACES")
    parser.add_argument("--folder", type=Path, default=Path("many-lights"))
    options, others = parser.parse_known_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    scene = (options.folder / f"{options.lights}-{options.lamp}.blend").resolve()
    if not scene.exists():
        build_scene(scene, 0 if options.lamp else options.lights, options.lamp)
    found = shade(scene, options.folder.resolve() / "out", *others)
    print("; ".join(f"{name} {value:.1f}" for name, value in found.items()))


if __name__ == "__main__":
    main()
