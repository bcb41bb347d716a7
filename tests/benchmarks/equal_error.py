"""Time at equal error against Cycles on the example scene; needs bpy."""

import tempfile
import time
from pathlib import Path

import numpy as np

from ltsh_addon import shading
from ltsh_addon.blender.process import client

SIZE = (480, 270)


def report(cycles_samples):
    """Print what ltsh4 takes, and what Cycles takes to reach ltsh4's error, on the specular pass."""
    with tempfile.TemporaryDirectory(prefix="ltsh-bench-") as folder:
        scene = Path(folder) / "demo.blend"
        client.build_demo(scene)
        extraction = client.extract(
            client.ExtractOptions(scene, width=SIZE[0], height=SIZE[1], cycles_samples=cycles_samples)
        )
    start = time.perf_counter()
    shaded = shading.shade(extraction.samples, extraction.lights, "ltsh4", passes=["specular"])
    shade_seconds = time.perf_counter() - start
    image = extraction.film.image(shaded.combined)
    a, b = (half.astype(np.float64) for half in extraction.reference["specular"])
    energy = (a * b).sum()
    # Halves with different seeds: their noise cancels in the product, and their difference is nothing else.
    error = ((image - a) * (image - b)).sum() / energy
    noise = 0.25 * ((a - b) ** 2).sum() / energy
    needed = cycles_samples * noise / max(error, 1e-12)
    per_sample = extraction.seconds["cycles"] / cycles_samples
    ours = extraction.seconds["samples"] + shade_seconds
    cycles = f"{cycles_samples} samples in {extraction.seconds['cycles']:.1f} s, noise {noise**0.5:.2%}"
    size = f"{len(extraction.samples)} samples, {len(extraction.lights)} lights"
    print(f"  Cycles: {cycles}")
    print(f"  ltsh4: error {error**0.5:.2%}, sample extraction {extraction.seconds['samples']:.2f} s")
    print(f"         shading {shade_seconds:.2f} s ({size})")
    factor = f"{needed * per_sample / ours:.1f} x our time (target 20 x)"
    print(f"  Cycles needs {needed:.0f} samples, {needed * per_sample:.1f} s, for that error: {factor},")
    print(f"         {needed * per_sample / shade_seconds:.0f} x the shading alone")
