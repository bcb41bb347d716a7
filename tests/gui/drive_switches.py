"""A view is left twenty times for Solid, its area is closed, another file is opened: all that it had is freed at once.
Before that, how soon the preview of the example scene has its first shadows."""

import gc
import itertools
import os
import statistics
import subprocess
import time
import weakref
from pathlib import Path

import bpy
import eyes
import hands

SECONDS = 1500
SIZE = "1280x760"
SWITCHES = 20
MEBIBYTE = 1 << 20
MOST_GROWTH = 600.0  # MiB; by views that stay it was 3000


def main(rig):
    rig.camera_view()
    yield 1
    yield from first_shadows(rig)
    yield from switched(rig)
    yield from closed(rig)
    yield from another_file(rig)


def first_shadows(rig):
    """With as many points as artists have."""
    engine, ticks = hands.module("engine.redraws"), []

    def tick():
        ticks.append(time.monotonic())
        return 0.01

    bpy.app.timers.register(tick)
    bpy.context.scene.render.engine = "LTSH"
    start = time.monotonic()
    rig.space.shading.type = "RENDERED"
    yield from hands.until(lambda: drawn(engine), 300)
    rig.fact("first picture, s", round(time.monotonic() - start, 1))
    yield from hands.until(lambda: drawn(engine) and all(one._pixel_size.step == 1 for one in engine.open_views), 300)
    rig.fact("first picture with all pixels, s", round(time.monotonic() - start, 1))
    gaps = sorted((round(after - before, 2) for before, after in itertools.pairwise(ticks)), reverse=True)
    rig.fact("longest times until then in which the window did not answer, s", gaps[:8])
    bpy.app.timers.unregister(tick)
    yield from hands.until(lambda: any(shown._shadows._grid for shown in engine.open_views), 300)
    rig.fact("first shadows, s", round(time.monotonic() - start, 1))
    rig.check(any(shown._shadows._grid for shown in engine.open_views), "shadows come")
    yield from hands.until(lambda: any(fine(shown._shadows._known) for shown in engine.open_views), 300)
    rig.fact("fine shadows, s", round(time.monotonic() - start, 1))
    yield 1
    rig.shot("1_shadows.png")


def fine(known):
    """Does every light have fine shadows?"""
    return bool(known) and all(1 in levels for levels in known.values())


def drawn(engine):
    return any(shown._renderer is not None and shown._renderer.samples for shown in engine.open_views)


def switched(rig):
    engine = hands.module("engine.redraws")
    gc.disable()
    sizes, left, helpers = [], [], []
    for _ in range(SWITCHES):
        rig.space.shading.type = "SOLID"
        yield 0.5
        left.append(len(engine.open_views))
        sizes.append(resident())
        helpers.append(children())
        rig.space.shading.type = "RENDERED"
        yield from hands.until(lambda: drawn(engine), 120)
        yield 1.5
    rig.fact("memory after switches to Solid, MiB", [round(size) for size in sizes])
    rig.fact("other processes then", helpers)
    rig.check(not any(left), f"no view is kept: {left}")
    # One view takes some 300 MiB; the processor's allocator and a graphics driver that is a program keep a part.
    grown = statistics.median(sizes[-5:]) - statistics.median(sizes[5:10])
    rig.check(grown < MOST_GROWTH, f"memory does not grow by a view in ten switches: {grown:.0f} MiB")


def closed(rig):
    """A second 3D view is made and closed."""
    engine = hands.module("engine.redraws")
    known = set(rig.window.screen.areas)
    hands.operate(rig, bpy.ops.screen.area_split, direction="VERTICAL", factor=0.5)
    for area in rig.window.screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.shading.type = "RENDERED"
    yield from hands.until(lambda: len(engine.open_views) == 2, 60)
    rig.check(len(engine.open_views) == 2, f"two areas have a view each: {len(engine.open_views)}")
    yield 2
    rig.shot("2_two_views.png")
    area = next(area for area in rig.window.screen.areas if area not in known)
    with bpy.context.temp_override(window=rig.window, area=area):
        bpy.ops.screen.area_close()
    yield from hands.until(lambda: len(engine.open_views) == 1, 10)
    rig.check(len(engine.open_views) == 1, f"that of a closed area is gone: {len(engine.open_views)}")


def another_file(rig):
    engine = hands.module("engine.redraws")
    rig.space.shading.type = "RENDERED"
    before = [weakref.ref(view) for view in engine.open_views]
    bpy.ops.wm.open_mainfile(filepath=hands.file_copy())
    yield 1
    rig.check(not any(view() for view in before), "those of another file are gone when it is opened")
    gc.enable()
    yield from eyes.settled(rig, "3_other_file.png", 20)


def resident():
    """MiB of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MEBIBYTE


def children():
    """Processes that this one has started, programs of the driver itself apart."""
    command = ["ps", "--ppid", str(os.getpid()), "-o", "comm="]
    found = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    return sum(name not in ("ps", "import", "xdotool") for name in found)
