"""What keeping the viewport in step costs: `python tests/benchmarks/viewport_sync.py [TRIANGLES OBJECTS LIGHTS]`.

Needs Blender 5.2, where a script without a window may use the graphics card. Printed are medians in ms; then how long
all shadows of one moved light take, without the drawing, and by how much the thread of the window is late meanwhile.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import bpy
import numpy as np

from ltsh_addon.blender.extract.occluders import collect_occluders
from ltsh_addon.blender.viewport.mirror import SceneMirror
from ltsh_addon.blender.viewport.pictures import ShownPicture
from ltsh_addon.blender.viewport.renderer import ViewRenderer
from ltsh_addon.blender.viewport.shadows import LiveShadows
from ltsh_addon.blender.viewport.still import view_of_camera

REPEATS = 9
SIZE, NAP = (960, 540), 0.005


def build(triangles: int, objects: int, lights: int):
    """A scene of `objects` bumpy grids, each with a mesh of its own, under `lights` area lights."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    side = max(round((triangles / objects / 2.0) ** 0.5), 1)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, side + 1), np.linspace(0, 1, side + 1)))
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    quads = np.stack([corner, corner + 1, corner + side + 2, corner + side + 1], axis=1).astype(np.int32)
    for number in range(objects):
        mesh = bpy.data.meshes.new(f"Grid {number}")
        mesh.vertices.add(len(x))
        height = 0.02 * np.sin(40.0 * x + number) * np.sin(40.0 * y)
        mesh.vertices.foreach_set("co", np.stack([x, y, height], axis=1).astype(np.float32).ravel())
        mesh.loops.add(quads.size)
        mesh.loops.foreach_set("vertex_index", quads.ravel())
        mesh.polygons.add(len(quads))
        mesh.polygons.foreach_set("loop_start", np.arange(0, quads.size, 4, dtype=np.int32))
        mesh.update(calc_edges=True)
        mesh.shade_smooth()
        ob = bpy.data.objects.new(mesh.name, mesh)
        ob.location = (number % 10, number // 10, 0.0)
        scene.collection.objects.link(ob)
    for number in range(lights):
        data = bpy.data.lights.new(f"Light {number}", "AREA")
        ob = bpy.data.objects.new(data.name, data)
        ob.location = (number % 8, number // 8, 3.0)
        scene.collection.objects.link(ob)
    return scene


def measure(scene) -> dict[str, tuple[float, float]]:
    """Median seconds by the clock and of this process for a first sync and for those after typical edits."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    first = []
    for _ in range(3):
        mirror = SceneMirror()
        first.append(_seconds(lambda mirror=mirror: mirror.sync(depsgraph)))
    result = {f"first sync, {mirror.triangles} triangles": _medians(first)}
    grid, light = scene.objects["Grid 0"], scene.objects["Light 0"]

    def move(ob):
        ob.location.z += 0.01

    edits = {
        "object moved": lambda: move(grid),
        "light moved": lambda: move(light),
        "light brighter": lambda: setattr(light.data, "energy", light.data.energy + 1.0),
        "one mesh changed": lambda: grid.data.update_tag(),
    }
    times: list[tuple[float, float]] = []

    def sync(scene, depsgraph):
        # Blender tells what has changed to handlers and render engines alone.
        times.append(_seconds(lambda: mirror.sync(depsgraph)))

    bpy.app.handlers.depsgraph_update_post.append(sync)
    try:
        for name, edit in edits.items():
            times.clear()
            for _ in range(REPEATS):
                edit()
                bpy.context.view_layer.update()
            result[name] = _medians(times)
    finally:
        bpy.app.handlers.depsgraph_update_post.remove(sync)
    return result


def measure_shadows(scene) -> tuple[float, float, float]:
    """Seconds until all pixels have the shadows of one light that has moved, by the clock and of both processes, and
    the most by which this thread woke up late.

    Every seventh object is raised: it throws shadows. There are two lights: one that stays costs nothing but at first.
    """
    import gpu

    for number, ob in enumerate(scene.objects):
        ob.location.z += 0.6 if ob.type == "MESH" and number % 7 == 0 else 0.0
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (5.0, -6.0, 7.0), (0.8, 0.0, 0.0)
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    bpy.context.view_layer.update()
    depsgraph, mirror, live, renderer = (
        bpy.context.evaluated_depsgraph_get(),
        SceneMirror(),
        LiveShadows(),
        ViewRenderer(),
    )
    mirror.sync(depsgraph)
    view, renderer.shadows = view_of_camera(camera.evaluated_get(depsgraph), depsgraph, SIZE), live
    texture = gpu.types.GPUTexture(SIZE, format="RGBA32F")
    buffer = gpu.types.GPUFrameBuffer(color_slots=[texture])
    shown = ShownPicture("ltsh4", "combined", transparent=True)

    def draw():
        live.follow((0,), lambda: collect_occluders(depsgraph, None, lambda text: None))
        renderer.draw(mirror, view, SIZE, shown, buffer)
        buffer.read_color(0, 0, 1, 1, 4, 0, "FLOAT")

    first, *others = mirror.lights[:2]
    try:
        for step in range(3):  # at first all is traced, then a process starts: the last one counts
            mirror.lights = (replace(first, center=first.center + [0.1 * step, 0.0, 0.0]), *others)
            draw()
            start, late = (time.perf_counter(), _processor(live)), 0.0
            while live.is_busy:
                while not live.has_news:
                    before = time.perf_counter()
                    time.sleep(NAP)
                    late = max(late, time.perf_counter() - before - NAP)
                end = time.perf_counter(), _processor(live)
                draw()
        return end[0] - start[0], end[1] - start[1], late
    finally:
        live.stop()
        renderer.free()


def _processor(live) -> float:
    """Processor seconds of this process and of the one that traces with it (Linux)."""
    seconds, pool = time.process_time(), live._traced_scene.tracing.pool
    for worker in [] if pool is None else pool._workers:
        fields = Path(f"/proc/{worker._process.pid}/stat").read_text().rpartition(")")[2].split()
        seconds += (int(fields[11]) + int(fields[12])) / 100.0
    return seconds


def _memory() -> float:
    """The most memory that this process has had at once, in MiB; without a card its graphics memory is part of it."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 10)  # Linux counts in KiB


def _seconds(work) -> tuple[float, float]:
    start = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - start[0], time.process_time() - start[1]


def _medians(times) -> tuple[float, float]:
    return tuple(statistics.median(column) for column in zip(*times, strict=True))


def main(arguments: list[str]) -> int:
    """Print the table."""
    import gpu

    if not hasattr(gpu, "init"):
        print("viewport_sync needs Blender 5.2 or later: no graphics card for scripts without a window before")
        return 1
    counts = [int(argument) for argument in arguments] or [1_000_000, 100, 32]
    scene = build(*counts)
    gpu.init()
    before = _memory()
    print(f"{'':<42}{'clock':>10}{'processor':>13}")
    for name, (clock, processor) in measure(scene).items():
        print(f"{name:<42}{1000.0 * clock:10.1f} ms{1000.0 * processor:10.1f} ms")
    clock, processor, late = measure_shadows(scene)
    print(f"{'shadows of one moved light':<42}{1000.0 * clock:10.1f} ms{1000.0 * processor:10.1f} ms, "
          f"this thread at most {1000.0 * late:.0f} ms late")  # fmt: skip
    print(f"most memory of this process: {before:.0f} MiB with the scene, {_memory():.0f} MiB with view and shadows")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
