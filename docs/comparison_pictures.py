"""Makes docs/demo.png and docs/bake.png: pictures by technique and by Cycles, and the signed errors below.

make demo && python docs/comparison_pictures.py [demo] [bake] [--size N] [--cycles-samples N]

`demo` shows out/demo/compare.exr, `bake` the floor of the example scene, baked. Needs matplotlib.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.imaging.color import color_bar  # noqa: E402
from ltsh_addon.imaging.report import common_error_scale  # noqa: E402

matplotlib.use("Agg")
DEMO, OBJECT = ROOT / "out" / "demo", "floor"
TECHNIQUES = {"ltc": "LTC", "ltsh2": "LTSH N=2", "ltsh4": "LTSH N=4", "ltsh4c": "LTSH N=4c"}
WIDTH = 3.6  # inches of a picture


def bake(output: Path, size: int, cycles_samples: int) -> dict:
    """Layers of the baked floor."""
    options = ["--object", OBJECT, "--size", str(size), "--passes", "specular", "--techniques", "ltc,ltsh2,ltsh4"]
    options += ["--error", "--cycles-samples", str(cycles_samples)]
    command = [sys.executable, "-m", "ltsh_addon", "bake", str(DEMO / "demo.blend"), "-o", str(output), *options]
    subprocess.run(command, cwd=ROOT, check=True)
    return imaging.read_layers(output / f"{OBJECT}.exr")


def draw(title: str, layers: dict, light: str, path: Path) -> None:
    """Write a picture of the techniques in `layers` beside Cycles, in the pass `light`."""
    labels = {name: label for name, label in TECHNIQUES.items() if f"{name}.{light}" in layers}
    pictures = {label: layers[f"{name}.{light}"][..., :3] for name, label in {"cycles": "Cycles", **labels}.items()}
    errors = [layers[f"error_{name}.{light}"] for name in labels]
    exposure, scale = imaging.exposure_factor(pictures["Cycles"]), common_error_scale(errors, pictures["Cycles"])
    height, width = pictures["Cycles"].shape[:2]
    size = WIDTH * len(pictures), 2.0 * WIDTH * height / width + 0.6
    figure, (above, below) = plt.subplots(2, len(pictures), figsize=size, constrained_layout=True)
    for axis, (label, image) in zip(above, pictures.items(), strict=True):
        axis.imshow(imaging.to_srgb8(exposure * image))
        axis.set_title(f"{title}: Cycles" if label == "Cycles" else label)
    below[0].imshow(color_bar(200, 12))
    below[0].set_title(f"\u2212{scale:g} to +{scale:g}: technique \u2212 Cycles, radiance", fontsize=10)
    for axis, error in zip(below[1:], errors, strict=True):
        axis.imshow(imaging.signed_error_colors(error, scale))
    for axis in (*above, *below):
        axis.axis("off")
    figure.savefig(path)


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help="demo or bake; default: both")
    parser.add_argument("--size", type=int, default=360)
    parser.add_argument("--cycles-samples", type=int, default=256)
    options = parser.parse_args()
    wanted = options.pictures or ("demo", "bake")
    if "demo" in wanted:
        layers = imaging.read_layers(DEMO / "compare.exr")
        draw("All direct light", layers, "combined", ROOT / "docs" / "demo.png")
    if "bake" in wanted:
        layers = bake(ROOT / "out" / "bake_picture", options.size, options.cycles_samples)
        draw("A floor, baked", layers, "specular", ROOT / "docs" / "bake.png")


if __name__ == "__main__":
    main()
