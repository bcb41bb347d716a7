"""Makes docs/bake.png: the floor of the example scene, baked with each technique and by Cycles, and the signed errors.

make demo && python docs/bake_picture.py [--size N] [--cycles-samples N]
"""

import argparse
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.imaging.sheet import Tile, comparison_sheet  # noqa: E402

SCENE, OBJECT = ROOT / "out" / "demo" / "demo.blend", "floor"
TECHNIQUES = {"ltc": "LTC", "ltsh2": "LTSH N=2", "ltsh4": "LTSH N=4"}


def bake(output: Path, size: int, cycles_samples: int) -> dict:
    """Layers of the baked floor."""
    options = ["--object", OBJECT, "--size", str(size), "--passes", "specular", "--techniques", ",".join(TECHNIQUES)]
    options += ["--error", "--cycles-samples", str(cycles_samples)]
    command = [sys.executable, "-m", "ltsh_addon", "bake", str(SCENE), "-o", str(output), *options]
    subprocess.run(command, cwd=ROOT, check=True)
    return imaging.read_layers(output / f"{OBJECT}.exr")


def main() -> None:
    """Bake, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=360)
    parser.add_argument("--cycles-samples", type=int, default=256)
    options = parser.parse_args()
    layers = bake(ROOT / "out" / "bake_picture", options.size, options.cycles_samples)
    tiles = [
        Tile(label, layers[f"{name}.specular"], layers[f"error_{name}.specular"]) for name, label in TECHNIQUES.items()
    ]
    notes = (f"{options.size} x {options.size} texels, specular", f"Cycles: {options.cycles_samples} samples")
    sheet = comparison_sheet("A floor, baked", ("Cycles", layers["cycles.specular"]), tiles, notes=notes)
    imaging.write_png(ROOT / "docs" / "bake.png", sheet)


if __name__ == "__main__":
    main()
