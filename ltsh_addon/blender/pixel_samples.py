"""Renders that carry one surface sample per pixel (runs in the child); `gbuffer` reads them."""

from __future__ import annotations

from pathlib import Path

from .materials import declare_aovs, remove_aovs
from .render_settings import enable_passes, render_exr, set_pixel_filter


def render_pixel_samples(
    scene, view_layer, folder: Path, sub_samples: int, progress, extra_passes: tuple[str, ...] = ()
) -> list[str]:
    """Names of the files in `folder`, one per sub-sample.

    With one sample Cycles always takes the pixel's center. Several come from single samples of one sequence of
    `sub_samples` + 1: sample 0, the center, is left out, the others are uniform over the pixel.
    """
    cycles = scene.cycles
    declare_aovs(view_layer)
    enable_passes(view_layer, ("combined", "diffuse_color", "z", *extra_passes))
    set_pixel_filter(scene, sub_samples)
    files = []
    for index in range(sub_samples):
        progress("samples", index / sub_samples)
        cycles.seed = 0
        cycles.samples = 1
        if sub_samples > 1:
            cycles.samples = sub_samples + 1
            cycles.use_sample_subset, cycles.sample_offset, cycles.sample_subset_length = True, index + 1, 1
        files.append(f"samples_{index:04d}.exr")
        render_exr(scene, folder / files[-1])
    cycles.use_sample_subset = False
    remove_aovs(view_layer)
    return files
