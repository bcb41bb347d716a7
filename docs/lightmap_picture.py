"""Makes docs/lightmap.png: the room of tests/benchmarks/lightmaps.py as it shows its baked textures, and their atlas.

python docs/lightmap_picture.py [--size 512] [--samples 64]

Needs bpy and matplotlib.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "benchmarks")]

import lightmaps  # noqa: E402

from ltsh_addon import imaging  # noqa: E402

matplotlib.use("Agg")
WIDTH, HEIGHT, SHOWN_SAMPLES = 960, 640, 64


def render(scene: Path, picture: Path) -> None:
    """Render the baked scene from a corner of the room. All materials shine as their textures say."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=str(scene))
    context = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    context.collection.objects.link(camera)
    camera.location, camera.rotation_euler, camera.data.lens = (1.75, -1.8, 1.75), (1.31, 0.0, 0.72), 20.0
    context.camera, context.world = camera, None
    for light in [ob for ob in context.objects if ob.type == "LIGHT"]:
        light.hide_render = True
    render = context.render
    render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", WIDTH, HEIGHT, 100
    context.cycles.samples, context.cycles.max_bounces, context.cycles.use_denoising = SHOWN_SAMPLES, 0, False
    render.image_settings.file_format, render.filepath = "OPEN_EXR", str(picture)
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ltsh-picture-") as name:
        folder = Path(name)
        lightmaps.build(folder / "room.blend")
        words = ["--atlas", str(options.size), "--size", str(options.size), "--bounces", "on"]
        words += ["--rest-samples", str(options.samples), "--passes", "combined", "--view", "above", "--apply"]
        command = [sys.executable, "-m", "ltsh_addon", "bake", str(folder / "room.blend"), "-o", str(folder), *words]
        subprocess.run(command, cwd=ROOT, check=True)
        render(folder / "room_baked.blend", folder / "room.exr")
        room = imaging.read_layers(folder / "room.exr")
        atlas = imaging.read_layers(next(folder.glob("*.combined.exr")))
    pictures = {"The room shows what was baked": room, "Its atlas": atlas}
    images = [next(iter(layers.values()))[..., :3] for layers in pictures.values()]
    exposure = imaging.exposure_factor(images[0])
    ratios = [WIDTH / HEIGHT, 1.0]
    figure, axes = plt.subplots(1, 2, figsize=(10.0, 4.2), width_ratios=ratios, constrained_layout=True)
    for axis, title, image in zip(axes, pictures, images, strict=True):
        axis.imshow(imaging.to_srgb8(exposure * image))
        axis.set_title(title)
        axis.axis("off")
    figure.savefig(ROOT / "docs" / "lightmap.png", dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    main()
