"""Lightmaps beside Cycles' own bake in the same processor time, as it is and denoised by the same denoiser; needs bpy.

python tests/benchmarks/lightmaps.py [--scene corridor] [--size 256] [--samples 64] [--points 1] [--objects A B]

Scenes: a room of twelve objects with a window and two lamps; a corridor; an artist's first hour's scene. Printed for
each object: the errors beside two converged bakes of Cycles, relative to the light and without their noise, what
ours are of the others, and how uncertain ours are by that noise. Processor seconds are of all processes, with starting
Blender and reading the scene, of both with denoising. Texels of Cycles' bake are means over the texel: with more
`--points` ours are, too, and at edges of shadows they are anyway.
"""

import argparse
import math
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blender" / "helpers"), str(Path(__file__).parent)]
PAINTS = {"White": (0.8,) * 3, "Red": (0.7, 0.15, 0.1), "Oak": (0.45, 0.3, 0.15)}
# What is baked of each scene by default.
OBJECTS = {"room": ["Floor", "Back", "Table", "Ball"], "corridor": ["Floor", "Left"], "artist": ["Floor", "Monkey"]}


def build(path, scene="room"):
    """Save a scene."""
    import scene_parts as parts

    parts.empty_scene()
    for name, color in PAINTS.items():
        parts.principled(name, Base_Color=(*color, 1.0), Roughness=1.0)
    {"room": room, "corridor": corridor, "artist": artist}[scene](parts)
    parts.save(path)


def wall(name, corners, paint="White"):
    """Add a quad that fills its texture."""
    import bpy
    import scene_parts as parts

    ob = parts.add_mesh(name, corners, [(0, 1, 2, 3)])
    layer = ob.data.uv_layers.get("UVMap") or ob.data.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    ob.data.materials.append(bpy.data.materials[paint])


def box(name, location, size, paint):
    """Add a box."""
    import bpy

    bpy.ops.mesh.primitive_cube_add(size=1.0, location=location, scale=size)
    bpy.context.object.name = name
    bpy.context.object.data.materials.append(bpy.data.materials[paint])


def room(parts):
    """Floor, ceiling, four walls, a table, two boxes, two balls and a rug."""
    import bpy

    wall("Floor", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], "Oak")
    wall("Ceiling", [(-2, 2, 2.5), (2, 2, 2.5), (2, -2, 2.5), (-2, -2, 2.5)])
    wall("Back", [(-2, 2, 0), (2, 2, 0), (2, 2, 2.5), (-2, 2, 2.5)])
    wall("Front", [(2, -2, 0), (-2, -2, 0), (-2, -2, 2.5), (2, -2, 2.5)])
    wall("Left", [(-2, -2, 0), (-2, 2, 0), (-2, 2, 2.5), (-2, -2, 2.5)], "Red")
    # Its upper part is the window.
    wall("Right", [(2, 2, 0), (2, -2, 0), (2, -2, 1.2), (2, 2, 1.2)])
    box("Table", (0.3, 0.4, 0.7), (1.4, 0.8, 0.05), "Oak")
    box("Chest", (-1.3, 1.2, 0.4), (0.8, 0.6, 0.8), "White")
    box("Stool", (0.9, -0.9, 0.25), (0.4, 0.4, 0.5), "Red")
    box("Rug", (-0.5, -0.8, 0.01), (1.6, 1.0, 0.02), "Red")
    for name, place, radius in (("Ball", (0.5, 0.4, 0.925), 0.2), ("Globe", (-1.3, 1.2, 1.05), 0.25)):
        parts.add_sphere(bpy.data.materials["White"], radius=radius, name=name, location=place)
    parts.add_area_light("Lamp", (0.0, 0.5, 2.4), (0.0, 0.0, 0.0), energy=30.0)
    parts.add_area_light("Sconce", (-1.9, -0.5, 1.6), (0.0, -1.2, 0.0), energy=12.0)
    parts.add_world(Color=(0.6, 0.75, 1.0, 1.0), Strength=1.5)


def corridor(parts):
    """Ten metres with three lamps, pillars along a wall, and a door that is open at the end."""
    wall("Floor", [(-1, 0, 0), (1, 0, 0), (1, 10, 0), (-1, 10, 0)], "Oak")
    wall("Ceiling", [(-1, 10, 2.4), (1, 10, 2.4), (1, 0, 2.4), (-1, 0, 2.4)])
    wall("Left", [(-1, 0, 0), (-1, 10, 0), (-1, 10, 2.4), (-1, 0, 2.4)])
    wall("Right", [(1, 10, 0), (1, 0, 0), (1, 0, 2.4), (1, 10, 2.4)], "Red")
    wall("End", [(1, 0, 0), (-1, 0, 0), (-1, 0, 2.4), (1, 0, 2.4)])
    for number in range(4):
        box(f"Pillar {number}", (-0.85, 1.2 + 2.4 * number, 1.2), (0.3, 0.3, 2.4), "White")
    for number in range(3):
        parts.add_area_light(f"Lamp {number}", (0.2, 1.6 + 3.2 * number, 2.35), (0.0, 0.0, 0.0), energy=12.0)
    parts.add_world(Color=(0.6, 0.75, 1.0, 1.0), Strength=1.0)


def artist(parts):
    """The scene of bounces.py of this name, unwrapped."""
    import bounces
    import bpy

    bounces.artist()
    for name in OBJECTS["artist"]:
        ob = bpy.data.objects[name]
        for other in bpy.context.scene.objects:
            other.select_set(other is ob)
        bpy.context.view_layer.objects.active = ob
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.uv.smart_project(island_margin=0.01)
        bpy.ops.object.mode_set(mode="OBJECT")


def by_cycles(scene, size, names, samples, seed, path):
    """Bake diffuse light without color by Cycles, in a process of its own; (objects, H, W, 3), row 0 at the bottom."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=str(scene))
    context = bpy.context.scene
    context.render.engine, context.cycles.samples, context.cycles.seed = "CYCLES", samples, seed
    context.cycles.use_adaptive_sampling, light = False, []
    # Seen from above, faces whose smooth normals turn away show the light of their other side.
    context.render.bake.view_from = "ACTIVE_CAMERA"
    context.camera = bpy.data.objects.new("Bake", bpy.data.cameras.new("Bake"))
    context.camera.data.type = "ORTHO"
    context.collection.objects.link(context.camera)
    image = bpy.data.images.new("bake", size, size, alpha=True, float_buffer=True, is_data=True)
    for material in bpy.data.materials:
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image, material.node_tree.nodes.active = image, node
    for name in names:
        for ob in context.objects:
            ob.select_set(ob.name == name)
        bpy.context.view_layer.objects.active = context.objects[name]
        bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT", "INDIRECT"}, margin=0, use_clear=True)
        pixels = np.empty(size * size * 4, np.float32)
        image.pixels.foreach_get(pixels)
        light.append(pixels.reshape(size, size, 4)[..., :3].copy())
    np.save(path, np.array(light))


def cycles_process(folder, options, samples, seed):
    """The light of `by_cycles`, and the processor seconds of its process."""
    path, before = folder / f"cycles_{samples}_{seed}.npy", _processor_seconds()
    words = ["--cycles", str(folder / "scene.blend"), str(path), str(samples), str(seed)]
    words += ["--size", str(options.size), "--objects", *options.objects]
    subprocess.run([sys.executable, __file__, *words], check=True, stdout=subprocess.DEVNULL)
    return np.load(path), _processor_seconds() - before


def _processor_seconds() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def ours(folder, options, points):
    """Our light by object as `by_cycles` has it, the arguments of each denoising, and processor seconds: of all, and of
    denoising one picture of each object."""
    from ltsh_addon import imaging
    from ltsh_addon.pipeline import BakeOptions, bake_scene, lightmap

    calls, denoised, before, taken = [], lightmap.denoised_rest, _processor_seconds(), []

    def noted(rest, *arguments):
        calls.append(arguments)
        start = _processor_seconds()
        done = denoised(rest, *arguments)
        taken.append((_processor_seconds() - start) / len(rest))
        return done

    lightmap.denoised_rest = noted
    bake_scene(
        BakeOptions(
            scene=folder / "scene.blend", output=folder / "ours", objects=tuple(options.objects), margin=0,
            view="above", size=(options.size, options.size), passes=("diffuse_light",), bounces="on",
            rest_samples=options.samples, sub_samples=points,
        )
    )  # fmt: skip
    lightmap.denoised_rest = denoised
    layers = [imaging.read_layers(folder / "ours" / f"{name}.exr") for name in options.objects]
    light = np.array([one["ltsh4c.diffuse_light"][::-1] for one in layers])
    covered = np.array([one["coverage.hit"].reshape(light.shape[1:3])[::-1] > 0.0 for one in layers])
    return light, covered, calls, (_processor_seconds() - before, sum(taken))


def error(light, halves) -> tuple[float, float]:
    """The error of light (N, 3) beside halves (2, N, 3), without the noise of these; and its standard deviation."""
    light, a, b = light.astype(float), *halves.astype(float)
    squared, power = ((light - a) * (light - b)).mean(axis=1), (a * b).mean()
    found = math.sqrt(max(squared.mean(), 0.0) / power)
    return found, squared.std() / math.sqrt(len(squared)) / (2.0 * power * max(found, 1e-9))


def main(options):
    """Print the errors."""
    from ltsh_addon.pipeline.lightmap import denoised_rest

    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as name:
        folder = Path(name)
        build(folder / "scene.blend", options.scene)
        costs = [cycles_process(folder, options, samples, 1)[1] for samples in (8, 24)]
        slope = (costs[1] - costs[0]) / 16
        truth = np.array([cycles_process(folder, options, options.truth, seed)[0] for seed in (3, 4)])
        for points in options.points:
            light, covered, calls, (seconds, denoising) = ours(folder, options, points)
            samples = max(1, round(8 + (seconds - denoising - costs[0]) / slope))
            noisy, took = cycles_process(folder, options, samples, 2)
            print(f"{options.scene}, {options.size}^2, {options.samples} bounce samples, {points} points", end="; ")
            print(f"load {os.getloadavg()[0]:.0f}")
            cycles = f"Cycles {samples} samples, {took + denoising:.0f} s ({slope:.2f} s a sample)"
            print(f"  ours {seconds:.0f} processor s; {cycles}")
            for number, name in enumerate(options.objects):
                hit, halves = covered[number], truth[:, number][:, covered[number]]
                (smooth,) = denoised_rest({("diffuse", 0): noisy[number]}, *calls[number][:2], samples)[0].values()
                pictures = light[number], noisy[number], smooth.reshape(noisy[number].shape)
                (mine, off), (plain, _), (best, _) = (error(one[hit], halves) for one in pictures)
                others = f"Cycles {plain:.2%} ({mine / plain:.2f} of it), denoised {best:.2%} ({mine / best:.2f} of it)"
                print(f"  {name:<8} {mine:.2%} +- {off:.2%}, {others}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", nargs=4, help=argparse.SUPPRESS)
    for flag, default in (("--size", 256), ("--samples", 64), ("--truth", 128)):
        parser.add_argument(flag, type=int, default=default)
    parser.add_argument("--points", type=int, nargs="+", default=[1])
    parser.add_argument("--scene", choices=list(OBJECTS), default="room")
    parser.add_argument("--objects", nargs="+")
    chosen = parser.parse_args()
    chosen.objects = chosen.objects or OBJECTS[chosen.scene]
    if chosen.cycles:
        scene, path, count, seed = chosen.cycles
        by_cycles(scene, chosen.size, chosen.objects, int(count), int(seed), path)
    else:
        main(chosen)
