"""What a frame of the viewport costs: `python tests/benchmarks/viewport_frame.py [--size 960x540] [--rounds N]`.

The example scene as its camera sees it, by technique, in turn so that a busy machine disturbs all alike. A frame is
what a moving camera asks for: surfaces, lighting, picture; without the surfaces it is what a moving light asks for.
At last frames under 32 lights of all kinds and, for comparison, under four rectangles.
Needs Blender 5.2, where a script without a window may use the graphics card. Where llvmpipe stands in for one, times
are those of the processor.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

import bpy
import gpu
import numpy as np
import random_surfaces
from surface_scenes import shifted

from ltsh_addon.blender.viewport.drawing import ViewCamera
from ltsh_addon.blender.viewport.mirror import SceneMirror
from ltsh_addon.blender.viewport.pictures import ShownPicture
from ltsh_addon.blender.viewport.renderer import ViewRenderer
from ltsh_addon.cli.commands import DEMO_SCENE
from ltsh_addon.scene import QuadLight

TECHNIQUES = ("ltc", "ltsh2", "ltsh4", "ltsh4c")
# In times of ltc.
TARGETS = {"ltsh2": 1.3, "ltsh4": 2.0, "ltsh4c": 2.6}
PUBLISHED = {"ltsh2": 2.7, "ltsh4": 5.5}  # Allmenröder and Peters 2021, on a graphics card
KINDS = ("plain", "disk", "ball", "facing disk", "spot", "bulb", "sun", "spot disk")
MANY, MOST_OF_FOUR = 32, 3.0


class Frames:
    """The example scene, ready to be drawn in `size` pixels."""

    def __init__(self, size):
        bpy.ops.wm.open_mainfile(filepath=str(DEMO_SCENE), load_ui=False)
        scene = bpy.context.scene
        depsgraph = bpy.context.evaluated_depsgraph_get()
        self.mirror = SceneMirror()
        self.mirror.sync(depsgraph)
        camera = scene.camera
        window = camera.calc_matrix_camera(depsgraph, x=size[0], y=size[1])
        first = ViewCamera.of(camera.matrix_world.inverted(), window, camera.data.type == "ORTHO")
        # A view that has moved: surfaces are drawn again.
        self.views = [first, replace(first, eye=first.eye + 1e-5)]
        self.size, self.renderer, self.moves = size, ViewRenderer(), 0
        self.target = gpu.types.GPUTexture(size, format="RGBA16F")
        self.buffer = gpu.types.GPUFrameBuffer(color_slots=[self.target])

    def seconds(self, technique, passes="combined", moving=True):
        """Time of one frame, to the end of what the card does for it."""
        shown = ShownPicture(technique, passes)
        self.moves += moving
        # Lights that are new, if equal: what has not changed is not drawn again.
        self.mirror.lights = tuple(list(self.mirror.lights))
        clock = time.process_time if is_software() else time.perf_counter
        start = clock()
        self.renderer.draw(self.mirror, self.views[self.moves % 2], self.size, shown, self.buffer)
        self.buffer.read_color(0, 0, 1, 1, 4, 0, "FLOAT")
        return clock() - start


def is_software():
    """Does the processor draw? Its own time is steadier than the clock."""
    return "llvmpipe" in gpu.platform.renderer_get()


def measure(frames, rounds):
    """{(passes, moving): {technique: [seconds]}}."""
    kinds = [("combined", True), ("combined", False), ("specular", False)]
    times = {kind: {name: [] for name in TECHNIQUES} for kind in kinds}
    for number in range(rounds + 1):
        for kind, by_name in times.items():
            for name in TECHNIQUES:
                seconds = frames.seconds(name, *kind)
                # The first round compiles.
                if number:
                    by_name[name].append(seconds)
    return times


def report(times):
    """Print medians, and medians of the ratios within a round."""
    names = (*TECHNIQUES, *(f"{name} / ltc" for name in TARGETS), "4c / 4")
    print(f"{'':<34}" + "".join(f"{name:>12}" for name in names).replace("ltsh4c / ltc", "   4c / ltc"))
    for (passes, moving), by_name in times.items():
        what = f"{passes}, {'frame' if moving else 'lighting and picture'}"
        medians = "".join(f"{1e3 * statistics.median(by_name[name]):>9.1f} ms" for name in TECHNIQUES)
        ratios = (np.median(np.divide(by_name[name], by_name["ltc"])) for name in TARGETS)
        last = np.median(np.divide(by_name["ltsh4c"], by_name["ltsh4"]))
        print(f"{what:<34}{medians}" + "".join(f"{ratio:>10.2f} x" for ratio in (*ratios, last)))
    print(f"{'target of a frame':<82}" + "".join(f"{ratio:>10.2f} x" for ratio in (*TARGETS.values(), 1.3)))
    print(f"{'published for the shading alone':<82}" + "".join(f"{ratio:>10.2f} x" for ratio in PUBLISHED.values()))


def many_lights(frames, rounds):
    """Print what MANY lights of all KINDS cost beside four rectangles."""
    generator = np.random.default_rng(3)
    many = [random_surfaces.light(KINDS[number % len(KINDS)], number, generator) for number in range(MANY)]
    lights = {"many": [shifted(light, (0.0, 0.0, 2.0)) for light in many]}
    lights["four"] = [QuadLight.like(light, spread=np.pi, children=()) for light in frames.mirror.lights[:4]]
    seconds = {}
    for name, own in lights.items():
        frames.mirror.lights = tuple(own)
        seconds[name] = statistics.median([frames.seconds("ltsh4") for _ in range(rounds + 1)][1:])
    ratio = seconds["many"] / seconds["four"]
    print(f"ltsh4, a frame under {MANY} lights of all kinds {1e3 * seconds['many']:.1f} ms, "
          f"{ratio:.2f} times that under {len(lights['four'])} rectangles (target {MOST_OF_FOUR:.0f})")  # fmt: skip


def main(arguments):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="960x540", help="width x height in pixels")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    size = tuple(int(number) for number in options.size.split("x"))
    if not hasattr(gpu, "init"):
        print("viewport_frame needs Blender 5.2 or later: no graphics card for scripts without a window before")
        return 1
    gpu.init()
    frames = Frames(size)
    lights = frames.mirror.lights
    corners = sum(len(light.polygon()) for light in lights)
    print(f"{gpu.platform.renderer_get()}, {gpu.platform.backend_type_get()}; {options.size} pixels, "
          f"{frames.mirror.triangles} triangles, {len(lights)} lights of {corners} edges in all")  # fmt: skip
    report(measure(frames, options.rounds))
    many_lights(frames, options.rounds)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
