"""LTSH's view with bounces beside Cycles' own viewport with its denoiser and EEVEE with ray tracing, while one works.

Pictures of the screen are taken MOMENTS seconds after the view is opened again, a light is moved, the view is turned
and a color is changed, with the processor seconds that Blender and the processes that it started have used by then.
Where Blender has no denoiser, a folder "oidn" beside the driver may have the library for the second Blender.
`tests/benchmarks/beside.py` runs this on a scene, renders the truth of each state and makes the table.
"""

import os
import subprocess
import sys
import time

import _cycles
import bpy
import eyes
from hands import over
from mathutils import Matrix

SIZE = "960x540"
SECONDS = 900
MOMENTS = (1, 2, 5, 10)
ENGINES = {"ltsh": "LTSH", "cycles": "CYCLES", "eevee": "BLENDER_EEVEE"}
DARKER = 2.0  # stops
COLD_SECONDS, EEVEE_SECONDS, IDLE_SECONDS = 20, 60, 1.0

# Another process takes the pictures: this one may be busy with drawing.
WATCHER = """
import os, pathlib, subprocess, sys, time
begin, name, pid, moments = float(sys.argv[1]), sys.argv[2], sys.argv[3], list(map(float, sys.argv[4:]))
def below(pid):
    try:
        words = pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        words = []
    return [pid] + [one for word in words if int(word) != os.getpid() for one in below(word)]
def used():
    total = 0
    for one in below(pid):
        try:
            total += sum(map(int, pathlib.Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()[11:13]))
        except OSError:
            pass
    return total / os.sysconf("SC_CLK_TCK")
before = used()
for moment in moments:
    time.sleep(max(begin + moment - time.monotonic(), 0))
    seconds = used() - before
    subprocess.run(["import", "-window", "root", f"{name}_{moment:g}.png"], check=True)
    print(moment, round(seconds, 2), flush=True)
"""


def watched(rig, name, moments, change):
    """Change the scene, and take pictures so many seconds later."""
    begin = time.monotonic()
    command = [sys.executable, "-c", WATCHER, begin, rig.out / name, os.getpid(), *moments]
    with open(rig.out / f"{name}.txt", "w") as out:
        watcher = subprocess.Popen(list(map(str, command)), stdout=out)
        change()
        while watcher.poll() is None:
            yield 0.1
    lines = (rig.out / f"{name}.txt").read_text().split("\n")
    used = [float(line.split()[1]) for line in lines if line]
    rig.fact(f"{name}: processor seconds after {moments} s", used)
    rig.check(len(used) == len(moments), f"{name}: pictures are taken")
    yield IDLE_SECONDS


class Work:
    """What an artist changes, one after another; and all of it back."""

    def __init__(self, rig):
        self.rig, self.view = rig, rig.space.region_3d
        self.light = next(ob for ob in bpy.data.objects if ob.type == "LIGHT")
        nodes = [
            node
            for ob in bpy.context.scene.objects
            for slot in ob.material_slots
            if slot.material is not None and ob.type == "MESH"
            for node in slot.material.node_tree.nodes
            if node.bl_idname == "ShaderNodeBsdfPrincipled" and not node.inputs["Base Color"].is_linked
        ]
        # The most colorful one.
        self.socket = max((node.inputs["Base Color"] for node in nodes), key=lambda one: _saturation(one.default_value))
        self.before = self.light.location.copy(), self.view.view_matrix.copy(), tuple(self.socket.default_value)

    def light_moved(self):
        self.light.location.x += 0.8

    def orbit(self):
        turn = Matrix.Rotation(0.3, 4, "Z")
        self.view.view_matrix = self.view.view_matrix @ turn

    def color(self):
        red, green, blue, alpha = self.socket.default_value
        self.socket.default_value = (blue, red, green, alpha)

    def back(self):
        self.light.location, self.view.view_matrix, self.socket.default_value = self.before

    @property
    def steps(self):
        return {"light": self.light_moved, "orbit": self.orbit, "color": self.color}


def _saturation(color):
    return max(color[:3]) - min(color[:3])


def main(rig):
    with rig.override():
        bpy.ops.screen.screen_full_area(use_hide_panels=True)
    yield 1
    yield from over(rig)
    eyes.bare_view(rig)
    if (rig.here / "oidn").is_dir():
        os.environ["LD_LIBRARY_PATH"] = str(rig.here / "oidn")  # of the second Blender
    scene = bpy.context.scene
    rig.fact("exposure", scene.view_settings.exposure)
    # Noise that is clipped could not be denoised.
    eyes.plain_colors(scene, scene.view_settings.exposure - DARKER)
    rig.fact("stops darker", DARKER)
    scene.eevee.use_raytracing = scene.cycles.use_preview_denoising = True
    rig.fact("Cycles has its denoiser", _cycles.with_openimagedenoise)
    eyes.free_view(rig, scene.camera)
    yield 1
    work = Work(rig)
    region = rig.region()
    rig.fact("region", (region.x, region.y, region.width, region.height))
    render, size = scene.render, (scene.render.resolution_x, scene.render.resolution_y)
    original = scene.camera
    for number, (name, change) in enumerate({"open": None, **work.steps}.items()):
        if change is not None:
            change()
        yield 0.5
        camera = eyes.camera_like_view(rig, f"Truth {number}")
        scene.camera = camera
        scene.render.engine = "CYCLES"
        bpy.ops.wm.save_as_mainfile(filepath=str(rig.out / f"truth_{name}.blend"), copy=True)
        scene.camera = original
        bpy.data.objects.remove(camera)
    render.resolution_x, render.resolution_y = size
    work.back()
    for short, engine in ENGINES.items():
        rig.space.shading.type = "SOLID"
        scene.render.engine = engine
        yield 1

        def opened():
            rig.space.shading.type = "RENDERED"

        cold = EEVEE_SECONDS if short == "eevee" else COLD_SECONDS
        yield from watched(rig, f"{short}_cold", (*MOMENTS, cold), opened)
        rig.space.shading.type = "SOLID"
        yield 2
        yield from watched(rig, f"{short}_open", MOMENTS, opened)
        for name, change in work.steps.items():
            yield from watched(rig, f"{short}_{name}", MOMENTS, change)
        rig.space.shading.type = "SOLID"
        work.back()
