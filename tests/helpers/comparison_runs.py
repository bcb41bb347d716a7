"""Comparisons of the scene in fake_scene: their options, and what they wrote."""

from pathlib import Path

import numpy as np

from ltsh_addon import imaging
from ltsh_addon.pipeline import PictureOptions

TECHNIQUES = ("ltc", "ltsh4", "reference")
# Images pass through float32 once; sums of a few of them differ by a few roundings.
FLOAT32 = 4 * float(np.finfo(np.float32).eps)


def options(folder, **changes):
    given = {"scene": Path("room.blend"), "techniques": TECHNIQUES, "cycles_samples": 64, **changes}
    return PictureOptions(output=folder / "out", **given)


def written(folder, name="compare.exr"):
    return imaging.read_layers(folder / "out" / name)
