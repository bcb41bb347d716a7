"""The table of `tests/gui/drive_beside.py`: how far views are from Cycles' pictures.

python tests/gui/run_drivers.py --runner ... --scene FILE.blend --out OUT tests/gui/drive_beside.py
python tests/benchmarks/beside.py OUT/drive_beside [--samples 256]

Renders the truth of each state with so many samples, denoised with its accurate guides (kept beside the pictures), and
compares what the screen showed with it: the root of the mean squared difference of its colors between 0 and 1, in
percent. If that Blender has no denoiser, pictures of Cycles' viewport are denoised here with the guides of the truth,
which costs Cycles no time. In brackets: the processor seconds that were used by then.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT)]

from ltsh_addon.blender.process.blender_process import denoiser_libraries  # noqa: E402
from ltsh_addon.cycles.lobes import read_layer  # noqa: E402
from ltsh_addon.imaging import write_png  # noqa: E402
from ltsh_addon.imaging.denoise import open_denoiser  # noqa: E402
from ltsh_addon.imaging.exr import read_channels  # noqa: E402

ENGINES, STATES, MOMENTS = ("ltsh", "cycles", "eevee"), ("open", "light", "orbit", "color"), (1, 2, 5, 10)
EDGE = 12  # pixels at the edge of the region, over which Blender draws its rounded corners
GUIDES = "Denoising Albedo", "Denoising Normal"


def srgb(linear: np.ndarray) -> np.ndarray:
    """Colors of the screen (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear(colors: np.ndarray) -> np.ndarray:
    """Scene-linear colors behind those of the screen."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def screen(path: Path) -> np.ndarray:
    """Colors (H, W, 3) between 0 and 1 of a picture of the screen, row 0 on top."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    flat = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(flat)
    pixels = flat.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]
    bpy.data.images.remove(image)
    return pixels


def truth_of(path: Path, samples: int) -> tuple[np.ndarray, ...]:
    """Cycles' picture of a .blend with `samples`, denoised, and its guides: linear, (H, W, 3) each."""
    kept = path.with_name(f"{path.stem}_{samples}.npy")
    if not kept.is_file():
        bpy.ops.wm.open_mainfile(filepath=str(path))
        scene, layer = bpy.context.scene, bpy.context.view_layer
        render, cycles, settings = scene.render, scene.cycles, scene.render.image_settings
        render.threads_mode, render.threads = "FIXED", 1
        cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = samples, False, True
        cycles.denoising_prefilter, cycles.light_sampling_threshold = "ACCURATE", 0.0
        layer.cycles.denoising_store_passes = True
        if bpy.app.version >= (5, 0, 0):
            settings.media_type = "MULTI_LAYER_IMAGE"
        settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
        render.filepath = str(kept.with_suffix(".exr"))
        bpy.ops.render.render(write_still=True)
        channels = read_channels(kept.with_suffix(".exr"))
        names = ("Combined", "RGB"), (GUIDES[0], "RGB"), (GUIDES[1], "XYZ")
        np.save(kept, np.array([read_layer(channels, *name) for name in names]))
    return tuple(np.load(kept))


def main(arguments) -> None:
    folder, errors = arguments.folder, {}
    facts = json.loads((folder / "result.json").read_text())["facts"]
    brighter = 2.0 ** facts["stops darker"]
    for state in STATES:
        truth, *guides = truth_of(folder / f"truth_{state}.blend", arguments.samples)
        truth = truth * 2.0 ** facts["exposure"]
        write_png(folder / f"truth_{state}.png", np.rint(255.0 * srgb(truth)).astype(np.uint8))
        for engine in ENGINES:
            for moment in MOMENTS:
                light = brighter * linear(screen(folder / f"{engine}_{state}_{moment}.png"))
                if engine == "cycles" and not facts["Cycles has its denoiser"]:
                    with open_denoiser(denoiser_libraries(), 1) as denoiser:
                        light = denoiser.quickly_denoised(light.astype(np.float32), *guides)
                picture = srgb(light)
                write_png(folder / f"shown_{engine}_{state}_{moment}.png", np.rint(255.0 * picture).astype(np.uint8))
                difference = (picture - srgb(truth))[EDGE:-EDGE, EDGE:-EDGE]
                errors[engine, state, moment] = 100.0 * math.sqrt(np.mean(difference**2))
    print("| state | engine |" + "".join(f" {moment} s |" for moment in MOMENTS))
    print("|---|---|" + "---|" * len(MOMENTS))
    for state in STATES:
        for engine in ENGINES:
            used = next(value for key, value in facts.items() if key.startswith(f"{engine}_{state}:"))
            cells = [f" {errors[engine, state, one]:.2f} ({use:.0f}) |" for one, use in zip(MOMENTS, used, strict=True)]
            print(f"| {state} | {engine} |" + "".join(cells))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=256)
    main(parser.parse_args())
