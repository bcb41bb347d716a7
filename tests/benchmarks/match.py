"""`ltsh match --move` from lights beside their places: how many come back to where Cycles rendered the target.

python tests/benchmarks/match.py [--scenes N ...] [--from near far three] [--cache FOLDER]

Scenes are made in code: a floor, sometimes walls, and objects that throw shadows. "near" starts .2 m and 10 degrees
beside the true place, "far" .3 to 1 m and 20 degrees, both with half or twice the power; "three" moves three lights at
once from "near". A light is back where it is within 3 % of its distance from the aim and its power within 3 %. Scenes
with even numbers were tuned on, those with odd ones only looked at.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import scene_builders as build  # noqa: E402

from ltsh_addon.pipeline.match import match_scene  # noqa: E402
from ltsh_addon.pipeline.options import MatchOptions  # noqa: E402

SIZE = 192, 108
SCENES = 20
NEARBY = 0.03  # of the distance from the aim, and of the power
TRUE_SAMPLES = 128
STARTS = {"near": ((0.2, 0.2), 10.0), "far": ((0.3, 1.0), 20.0), "three": ((0.2, 0.2), 10.0)}
KINDS = "DISK", "RECTANGLE", "SQUARE", "ELLIPSE", "DISK", "RECTANGLE", "SPOT", "SQUARE", "DISK", "POINT"


def make_scene(number: int, lights: int) -> dict:
    """Open a scene with so many lights at their true places. Returns the aim of each."""
    rng = np.random.default_rng([number, lights])
    build.empty_scene(*SIZE)

    def surface(name, low, high):
        metal = {"Metallic": 1.0} if rng.random() < 0.2 and name != "Floor" else {}
        return build.material(name, tuple(rng.uniform(low, high, 3)), rng.uniform(0.15, 0.8), **metal)

    floor = surface("Floor", 0.35, 0.75)
    build.panel("Floor", (-6, -6, 0), (12, 0, 0), (0, 12, 0), floor)
    if rng.random() < 0.5:
        build.panel("Wall", (-6, 2.2, 0), (12, 0, 0), (0, 0, 5), surface("Wall", 0.4, 0.8))
    for index in range(rng.integers(3, 6)):
        place, turn = (rng.uniform(-1.6, 1.6), rng.uniform(-1.0, 1.4)), rng.uniform(0, 6.3)
        kind, size, look = rng.choice(["ball", "box", "rod", "monkey"]), rng.uniform(0.25, 0.5), surface("S", 0.15, 0.8)
        if kind == "ball":
            build.ball(f"Ball {index}", look, (*place, size), size)
        elif kind == "monkey":
            build.put("monkey", f"Monkey {index}", look, (*place, size), (-0.6, 0, turn), size=2.0 * size)
        elif kind == "box":
            scale = rng.uniform(0.6, 1.6, 3) * size
            build.put("cube", f"Box {index}", look, (*place, scale[2] / 2), (0, 0, turn), tuple(scale), size=1)
        else:
            build.rod(f"Rod {index}", look, (*place, 1.2 * size), (0.4 * size, 2.4 * size))
    build.camera((rng.uniform(-2, 2), -6.0, rng.uniform(2.2, 3.5)), (0, 0, 0.4), 45.0)
    build.world((1, 1, 1), 0.02 * rng.integers(0, 2))
    aims = {}
    for index in range(lights):
        name, aim = f"Light {'ABC'[index]}", np.array([rng.uniform(-0.8, 0.8), rng.uniform(-0.6, 0.8), 0.2])
        around, up = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(25, 75))
        way = np.array([math.cos(around) * math.cos(up), math.sin(around) * math.cos(up), math.sin(up)])
        way[1] = min(way[1], 0.45)
        place = aim + rng.uniform(2.2, 4.0) * way
        kind, power, color = KINDS[(number + index) % len(KINDS)], rng.uniform(60, 250), rng.uniform(0.6, 1.0, 3)
        color = color / color.max()
        if kind == "POINT":
            build.lamp(kind, name, power, place, None, color, shadow_soft_size=rng.uniform(0.05, 0.3))
        elif kind == "SPOT":
            cone = {"spot_size": rng.uniform(0.7, 1.3), "spot_blend": 0.5, "shadow_soft_size": rng.uniform(0.05, 0.2)}
            build.lamp(kind, name, 2 * power, place, tuple(aim), color, **cone)
        else:
            size = rng.uniform(0.2, 1.0, 2)
            build.lamp("AREA", name, power, place, tuple(aim), color, shape=kind, size=size[0], size_y=size[1])
        aims[name] = aim.tolist()
    return aims


def displace(start: str, number: int, names) -> None:
    """Take the lights to where they start."""
    (low, high), degrees = STARTS[start]
    rng = np.random.default_rng([number, list(STARTS).index(start)])
    for name in names:
        ob, (way, axis) = bpy.data.objects[name], rng.normal(size=(2, 3))
        ob.location += build.Vector(rng.uniform(low, high) * way / np.linalg.norm(way))
        turn = build.mathutils.Quaternion(axis, math.radians(degrees))
        ob.rotation_euler = (turn @ ob.rotation_euler.to_quaternion()).to_euler()
        ob.data.energy *= 2.0 ** rng.choice([-1, 1])


def prepare(folder: Path, start: str, number: int) -> dict:
    """Write target.exr, start.blend and truth.json of a scene into `folder`, unless they are there; the truth."""
    truth = folder / "truth.json"
    if not truth.exists():
        folder.mkdir(parents=True, exist_ok=True)
        aims, scene = make_scene(number, 3 if start == "three" else 1), bpy.context.scene
        bpy.context.view_layer.update()
        lights = {}
        for name, aim in aims.items():
            ob = bpy.data.objects[name]
            axis = ob.matrix_world.col[2].xyz
            lights[name] = {"aim": aim, "place": list(ob.location), "power": ob.data.energy, "axis": list(axis)}
        scene.cycles.samples, scene.cycles.use_denoising = TRUE_SAMPLES, False
        scene.render.threads_mode, scene.render.threads = "FIXED", 1
        if bpy.app.version >= (5, 0, 0):
            scene.render.image_settings.media_type = "IMAGE"
        scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
        scene.render.filepath = str(folder / "target.exr")
        bpy.ops.render.render(write_still=True)
        displace(start, number, aims)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "start.blend"))
        truth.write_text(json.dumps(lights))
    return json.loads(truth.read_text())


def errors(blend: Path, truth: dict) -> list[tuple[float, float, float]]:
    """Of each light of a .blend: the distance from its place, relative to that from the aim; the relative error of its
    power; and the angle between its axes in degrees."""
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    rows = []
    for name, true in truth.items():
        ob, place = bpy.data.objects[name], np.array(true["place"])
        off = np.linalg.norm(np.array(ob.matrix_world.translation) - place) / np.linalg.norm(place - true["aim"])
        cosine = np.dot(ob.matrix_world.col[2].xyz.normalized(), true["axis"])
        rows.append((off, ob.data.energy / true["power"] - 1.0, math.degrees(math.acos(min(cosine, 1.0)))))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, nargs="*", default=list(range(SCENES)))
    parser.add_argument("--from", dest="starts", nargs="*", default=list(STARTS), choices=STARTS)
    parser.add_argument("--cache", type=Path, default=Path("out/match"))
    arguments = parser.parse_args()
    for start in arguments.starts:
        back = 0
        scenes = [number for number in arguments.scenes if start != "three" or number < SCENES // 2]
        for number in scenes:
            folder = arguments.cache / f"{start}{number}"
            truth = prepare(folder, start, number)
            options = MatchOptions(
                scene=folder / "start.blend", output=folder / "out", target=folder / "target.exr", move=True
            )
            report = match_scene(options)
            rows = errors(folder / "out" / "matched.blend", truth)
            is_back = all(off < NEARBY and abs(power) < NEARBY for off, power, _ in rows)
            back += is_back
            cells = "  ".join(f"{100 * off:5.1f} % {100 * power:+6.1f} % {angle:5.1f}°" for off, power, angle in rows)
            left, seconds = 100 * report["error_after"], report["search"]["processor_s"]
            print(
                f"{start:5} {number:3}  {cells}  error {left:5.2f} %  {seconds:5.1f} s {'' if is_back else '  <--'}",
                flush=True,
            )
        print(f"{start}: {back} of {len(scenes)} back", flush=True)


if __name__ == "__main__":
    main()
