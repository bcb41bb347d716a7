"""The lighting pass on the back end of the window, OpenGL or Vulkan, against the integrator in double precision."""

import importlib
import sys

import gpu
import numpy as np
from hands import ADDON

SECONDS = 600
WIDTH, HEIGHT = 32, 16
TECHNIQUES = ("ltc", "ltsh2", "ltsh4")
# As in test_gpu_lighting.py.
RELATIVE, ABSOLUTE = 1e-3, 1e-5
KINDS = ("plain", "horizon", "tiny", "disk", "polygon", "linked", "spread")


def main(rig):
    yield 1
    rig.fact("graphics", f"{gpu.platform.backend_type_get()}, {gpu.platform.renderer_get()}")
    for name in ("", ".scene", ".cycles", ".cycles.closures", ".blender.viewport.drawing"):
        sys.modules[f"ltsh_addon{name}"] = importlib.import_module(f"{ADDON}{name}")
    import random_surfaces
    import uploaded_samples

    shading = importlib.import_module(f"{ADDON}.shading")
    lighting = importlib.import_module(f"{ADDON}.blender.viewport.lighting")
    target = gpu.types.GPUTexture((WIDTH, HEIGHT), format="RGBA32F")
    buffer = gpu.types.GPUFrameBuffer(color_slots=[target])
    for technique in TECHNIQUES:
        drawing = lighting.LightingPass(technique)
        for surface in ("plain", "tilted"):
            if technique != "ltsh4" and surface == "tilted":
                continue
            for kind in KINDS:
                random = np.random.default_rng([len(kind), *map(ord, kind + surface)])
                samples = random_surfaces.samples(surface, WIDTH * HEIGHT, random)
                lights = [random_surfaces.light(kind, number, random) for number in range(3)]
                drawing.set_lights(lights)
                gbuffer = uploaded_samples.upload_samples(samples, WIDTH)
                drawing.draw(gbuffer, buffer, "combined", view=(*random_surfaces.EYE, 1.0))
                values = target.read()
                values.dimensions = WIDTH * HEIGHT * 4
                found = np.array(values, np.float64).reshape(-1, 4)[:, :3]
                expected = shading.shade(samples, lights, technique, workers=1, dtype=np.float64).combined
                relative = 3.0 * RELATIVE if kind == "spread" else RELATIVE
                times = np.abs(found - expected) / (ABSOLUTE + relative * np.abs(expected))
                rig.fact(f"{technique}, {surface}, {kind}: worst, of what is allowed", round(float(times.max()), 3))
                rig.check(bool((times <= 1.0).all()), f"{technique}, {surface}, {kind}: as the integrator has it")
                yield 0.1
        del drawing
