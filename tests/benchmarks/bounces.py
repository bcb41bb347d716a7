"""The view with bounces beside Cycles' Combined: `ltsh view --bounces on` with 64 points in five scenes; asked: 5 %.

python tests/benchmarks/bounces.py [--scenes NAME ...] [--size 320x180] [--samples 300] [--cache FOLDER]

Relative L2 without the noise of the truth, which are two halves of so many samples each. Of each scene also a PNG with
the picture, the truth and the difference of both, and the share of the worst pixels in the error.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import finished_scenes  # noqa: E402
from finished import figures  # noqa: E402
from scene_builders import (  # noqa: E402
    ball,
    box,
    camera,
    empty_scene,
    glass,
    lathe,
    material,
    panel,
    put,
    rod,
    softbox,
    wood,
    world,
)

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.cycles.lobes import read_layer  # noqa: E402
from ltsh_addon.imaging.exr import read_channels  # noqa: E402

MOST = 0.05


def artist():
    """A first hour's scene: a golden ball, a glass cylinder and a monkey on a floor, three soft lights."""
    panel("Floor", (-6, -6, 0), (12, 0, 0), (0, 12, 0), material("Floor", (0.35, 0.33, 0.3), 0.35))
    ball("Ball", material("Gold", (1.0, 0.75, 0.3), 0.2, Metallic=1.0), (-1.2, 0.0, 0.7), 0.7)
    rod("Cylinder", glass("Glass", 0.05, (0.7, 0.9, 1.0)), (1.3, -0.8, 0.6), (0.5, 1.0))
    monkey = put("monkey", "Monkey", material("Red", (0.7, 0.25, 0.2)), (0.4, 0.6, 0.75), (-0.5, 0.0, 0.6), size=1.4)
    monkey.modifiers.clear()
    softbox("Key", 300, (2.0, 2.0), (2.5, -2.0, 3.0), (0, 0, 0), (1.0, 0.8, 0.6))
    softbox("Fill", 120, (2.0, 2.0), (-3.0, -2.0, 2.5), (0, 0, 0), (0.5, 0.7, 1.0))
    softbox("Rim", 200, (2.0, 2.0), (0.0, 3.5, 2.5), (0, 0, 0))
    world((0.05, 0.05, 0.05))
    camera((7.36, -6.93, 4.96), (0.0, 0.0, 0.3), 50)


def mirrors():
    """A room with mirrors on two walls, a ball of chrome, a rough mirror; a lamp at the ceiling."""
    paint = material("Paint", (0.7, 0.68, 0.62), 0.8)
    panel("Floor", (-2, -2, 0), (4, 0, 0), (0, 4, 0), wood("Wood"))
    panel("Ceiling", (-2, 2, 2.6), (4, 0, 0), (0, -4, 0), paint)
    panel("Back", (-2, 2, 0), (4, 0, 0), (0, 0, 2.6), paint)
    panel("Left", (-2, -2, 0), (0, 4, 0), (0, 0, 2.6), material("Red", (0.6, 0.12, 0.1), 0.7))
    panel("Right", (2, 2, 0), (0, -4, 0), (0, 0, 2.6), material("Green", (0.15, 0.5, 0.2), 0.7))
    mirror = material("Mirror", (0.95, 0.95, 0.95), 0.0, Metallic=1.0)
    panel("Mirror", (-1.6, 1.98, 0.6), (2.0, 0, 0), (0, 0, 1.6), mirror)
    panel("Side", (1.98, 1.4, 0.5), (0, -1.8, 0), (0, 0, 1.7), material("Rough", (0.9, 0.9, 0.9), 0.15, Metallic=1.0))
    ball("Chrome", material("Chrome", (0.95, 0.95, 0.95), 0.03, Metallic=1.0), (-0.7, 0.4, 0.45), 0.45)
    box("Box", (0.4, 0.2, 0), (1.1, 0.9, 0.8), material("Blue", (0.1, 0.2, 0.6), 0.4), 0.03)
    softbox("Lamp", 80, (0.8, 0.8), (0.2, -0.4, 2.55), (0.2, -0.4, 0.0), (1.0, 0.93, 0.85))
    softbox("Front", 30, 1.0, (0.0, -1.9, 1.8), (0.0, 1.0, 0.8))
    camera((0.3, -1.9, 1.5), (-0.1, 1.0, 0.9), 24)


def shelf():
    """Glasses, a bottle and a ball of glass on boards of glass before a wall."""
    panel("Wall", (-2, 0.5, -1), (4, 0, 0), (0, 0, 4), material("Wall", (0.75, 0.7, 0.62), 0.8))
    panel("Floor", (-2, -3, -1), (4, 0, 0), (0, 3.5, 0), material("Floor", (0.4, 0.36, 0.32), 0.5))
    clear, green = glass("Clear"), glass("Green", 0.0, (0.6, 0.9, 0.7))
    for height in (0.0, 0.75):
        box("Board", (-1.2, -0.25, height - 0.03), (1.2, 0.35, height), green)
    cup = [(0.0, 0.0), (0.16, 0.0), (0.2, 0.4), (0.18, 0.4), (0.14, 0.04), (0.0, 0.04)]
    for x in (-0.8, -0.2):
        lathe("Cup", cup, clear, (x, 0.0, 0.001))
    lathe("Bottle", [(0.0, 0.0), (0.14, 0.0), (0.14, 0.35), (0.05, 0.45), (0.05, 0.6), (0.0, 0.6)], green,
          (0.45, 0.05, 0.001))  # fmt: skip
    ball("Marble", glass("Frosted", 0.3), (0.85, -0.05, 0.181), 0.18)
    ball("Ball", clear, (-0.5, 0.0, 0.951), 0.2)
    ball("Clay", material("Clay", (0.7, 0.3, 0.2), 0.5), (0.1, 0.0, 0.901), 0.15)
    box("Book", (0.5, -0.15, 0.751), (0.9, 0.2, 1.1), material("Cover", (0.1, 0.2, 0.4), 0.4), 0.01)
    softbox("Key", 120, (1.2, 0.8), (-1.6, -2.2, 2.2), (0, 0, 0.4), (1.0, 0.95, 0.88))
    softbox("Strip", 40, (0.2, 1.6), (1.9, -1.0, 0.8), (0, 0, 0.4), (0.8, 0.9, 1.0))
    world((0.25, 0.28, 0.32), 0.5)
    camera((0.1, -3.4, 0.75), (0.0, 0.0, 0.55), 42)


SCENES = {scene.__name__: scene for scene in (finished_scenes.product, artist, finished_scenes.arcade, mirrors, shelf)}


def save_scene(name: str, size: tuple[int, int], path: Path) -> None:
    """Save a scene as a .blend."""
    import bpy

    empty_scene(*size)
    SCENES[name]()
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


def truth_of(scene: Path, samples: int, path: Path) -> np.ndarray:
    """Two halves (2, H, W, 3) of Cycles' Combined, kept as `path`."""
    if not path.is_file():
        import bpy

        bpy.ops.wm.open_mainfile(filepath=str(scene))
        render, cycles = bpy.context.scene.render, bpy.context.scene.cycles
        render.engine, render.threads_mode, render.threads = "CYCLES", "FIXED", 1
        cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = samples, False, False
        cycles.light_sampling_threshold = 0.0
        settings, halves = render.image_settings, []
        if bpy.app.version >= (5, 0, 0):
            settings.media_type = "MULTI_LAYER_IMAGE"
        settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
        for seed in (7919, 7920):
            cycles.seed, render.filepath = seed, str(path.with_suffix(".exr"))
            bpy.ops.render.render(write_still=True)
            halves.append(read_layer(read_channels(path.with_suffix(".exr")), "Combined", "RGB"))
        np.save(path, np.array(halves))
    return np.load(path).astype(np.float64)


def main(arguments) -> int:
    folder = arguments.cache
    folder.mkdir(parents=True, exist_ok=True)
    size, errors = "x".join(map(str, arguments.size)), {}
    for name in arguments.scenes:
        scene = folder / f"{name}_{size}.blend"
        if not scene.is_file():
            save_scene(name, arguments.size, scene)
        halves = truth_of(scene, arguments.samples, folder / f"{name}_{size}_{arguments.samples}.npy")
        command = [sys.executable, "-m", "ltsh_addon", "view", scene, "-o", folder / name, "--bounces", "on",
                   "--refine", 64, "--rest-samples", 64, "--techniques", "ltsh4c", "--json", "--quiet"]  # fmt: skip
        done = subprocess.run(list(map(str, command)), cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr}")
        channels = read_channels(folder / name / "view.exr")
        picture = np.stack([channels[f"ltsh4c.combined.{letter}"] for letter in "RGB"], axis=-1).astype(np.float64)
        l2, l2_dim, flip = figures((picture, picture), halves)
        truth = halves.mean(axis=0)
        squares = np.sort((np.prod([picture - half for half in halves], axis=0)).sum(axis=-1).ravel())
        worst = squares[-len(squares) // 100 :].sum() / squares.sum()
        errors[name] = l2
        said = json.loads(done.stdout)
        print(f"{name}: L2 {l2:.4f}, without the brightest .2 % {l2_dim:.4f}, FLIP {flip:.4f}, "
              f"mean / mean {picture.mean() / truth.mean():.4f}; the worst 1 % of the pixels have {worst:.2f} of the "
              "squared error", flush=True)  # fmt: skip
        for line in said["warnings"]:
            print(f"    {line}")
        whole = np.concatenate([picture, truth, 0.5 + 2.0 * (picture - truth)], axis=1)
        imaging.write_png(folder / f"{name}.png", imaging.to_srgb8(whole))
    return int(max(errors.values()) > MOST)


def size_of(text: str) -> tuple[int, int]:
    """A width and a height."""
    width, height = map(int, text.split("x"))
    return width, height


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--size", type=size_of, default=(320, 180))
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "ltsh_bounces")
    sys.exit(main(parser.parse_args()))
