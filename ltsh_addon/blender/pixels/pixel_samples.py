"""Renders that carry one surface sample per pixel (runs in the child); `gbuffer` reads them."""

from __future__ import annotations

from pathlib import Path

from ..materials.aov_injection import declare_aovs, remove_aovs
from .cameras import shifted_pixels
from .pixel_filter import pinned_pixel_filter, sub_pixel_offsets
from .render_settings import enable_passes, render_exr


def render_pixel_samples(
    scene, view_layer, folder: Path, sub_samples: int, progress, extra_passes: tuple[str, ...] = ()
) -> list[str]:
    """Names of the files in `folder`, one per sub-sample; the points are `sub_pixel_offsets`."""
    declare_aovs(view_layer)
    enable_passes(view_layer, ("combined", "diffuse_color", "z", *extra_passes))
    scene.cycles.seed, scene.cycles.samples, scene.cycles.use_sample_subset = 0, 1, False
    files, offsets = [], sub_pixel_offsets(scene, sub_samples)
    with pinned_pixel_filter(scene):
        for index, offset in enumerate(offsets):
            progress("samples", index / sub_samples)
            files.append(f"samples_{index:04d}.exr")
            with shifted_pixels(scene, offset):
                render_exr(scene, folder / files[-1])
    remove_aovs(view_layer)
    return files
