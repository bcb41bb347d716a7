"""What Cycles alone makes of a .blend, in a process of its own; needs bpy.

python tests/benchmarks/cycles_picture.py FILE.blend OUT.exr WIDTH HEIGHT SAMPLES SEED [passes]

Denoised by Blender with its default settings; with `passes` not denoised, with direct light and the denoiser's guides.
"""

import os
import sys

import bpy

PASSES = ("combined", "diffuse_direct", "diffuse_color", "glossy_direct", "glossy_color")


def main(path: str, out: str, width: str, height: str, samples: str, seed: str, passes: str = "") -> None:
    bpy.ops.wm.open_mainfile(filepath=path)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    render, cycles = scene.render, scene.cycles
    render.resolution_x, render.resolution_y, render.resolution_percentage = int(width), int(height), 100
    render.threads_mode, render.threads = "FIXED", len(os.sched_getaffinity(0))
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = int(samples), False, not passes
    cycles.seed = int(seed)
    if passes:
        layer.cycles.denoising_store_passes = True
        for name in PASSES:
            setattr(layer, f"use_pass_{name}", True)
    settings = render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    if hasattr(settings, "use_exr_interleave"):
        settings.use_exr_interleave = True
    render.filepath = out
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
