"""What a bake takes: seconds and memory by size, and its time at equal error beside Cycles' bake; needs bpy.

python tests/benchmarks/bake_cost.py [memory | time | cycles]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SIZE = 256
GROWTH_LIMIT = 0.1


def build_scene(path, rotation=(0.3, 0.0, 0.2)):
    """A glossy plane of 6 m under four rectangles."""
    import bpy
    import numpy as np

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, scene.camera = (0.0, -4.0, 3.0), camera
    for number in range(4):
        light = bpy.data.lights.new("Light", "AREA")
        light.shape, light.size, light.size_y, light.energy = "RECTANGLE", 1.2, 0.7, 100.0
        ob = bpy.data.objects.new("Light", light)
        scene.collection.objects.link(ob)
        ob.location = (1.6 * (number % 2) - 0.8, 1.6 * (number // 2) - 0.8, 1.5)
        ob.rotation_euler = rotation
    mesh = bpy.data.meshes.new("Floor")
    mesh.from_pydata([(-3, -3, 0), (3, -3, 0), (3, 3, 0), (-3, 3, 0)], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32([0, 0, 1, 0, 1, 1, 0, 1]))
    material = bpy.data.materials.new("Glossy")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    node = material.node_tree.nodes["Principled BSDF"]
    node.inputs["Base Color"].default_value = (0.4, 0.3, 0.2, 1.0)
    node.inputs["Roughness"].default_value = 0.35
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("Floor", mesh))
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


def bake(scene, output, *options):
    """Run the command; its report, and the peak resident size in MiB of it and of the Blender it starts."""
    command = [sys.executable, "-m", "ltsh_addon", "bake", str(scene), "-o", str(output), "--json", "--quiet", *options]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    peaks = {}
    while process.poll() is None:
        for kind, pid in [("own", process.pid), *(("Blender", child) for child in _children(process.pid))]:
            peaks[kind] = max(peaks.get(kind, 0.0), _peak(pid))
        time.sleep(0.02)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    json.loads(process.stdout.read())
    return json.loads((output / "timing.json").read_text())["seconds"], peaks


def _children(pid):
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def _peak(pid):
    """Largest resident size of a process so far in MiB; 0 where it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return max((int(line.split()[1]) / 1024.0 for line in status if "VmHWM" in line), default=0.0)


def memory(sizes, *options):
    """Print the peaks for every size, and how much the last has more than the one before."""
    own = []
    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as name:
        folder = Path(name)
        subprocess.run([sys.executable, __file__, "scene", str(folder / "scene.blend")], check=True, timeout=120)
        for size in sizes:
            seconds, peaks = bake(folder / "scene.blend", folder / str(size), "--size", str(size), *options)
            own.append(peaks["own"])
            text = ", ".join(f"{kind} {peak:.0f} MiB" for kind, peak in peaks.items())
            print(f"  {size:>5}^2: peak {text}; {seconds['total']:.1f} s, load {os.getloadavg()[0]:.1f}", flush=True)
    growth = own[-1] / own[-2] - 1.0
    print(f"  {sizes[-1]}^2 against {sizes[-2]}^2: {growth:+.1%} of our own process (target below {GROWTH_LIMIT:.0%})")
    return growth


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("memory", "scene"))
    parser.add_argument("path", nargs="?", type=Path)
    parser.add_argument("--sizes", default="4096,8192")
    options, more = parser.parse_known_args()
    if options.what == "scene":
        build_scene(options.path)
    elif memory([int(size) for size in options.sizes.split(",")], *more) > GROWTH_LIMIT:
        raise SystemExit("the peak grows with the size")


if __name__ == "__main__":
    main()
