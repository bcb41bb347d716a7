"""The fair reference: Cycles' direct light without occlusion, as two independent halves (runs in the child).

"No occlusion" means that no mesh is visible to any ray but the camera's; switching shadows off on the light would still
let meshes block the half of the estimate that samples the BSDF, and lose up to 60 % of a highlight.
"""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from ..lights.mesh_light_faces import SIDE_PROPERTY
from ..lights.mesh_light_shaders import let_light_through
from .cameras import shifted_pixels
from .inventory import SURFACE_TYPES
from .pixel_filter import pinned_pixel_filter, sub_pixel_offsets
from .render_settings import enable_passes, render_exr

SEEDS = {"A": 1, "B": 7919}
FIRST_CHUNK = 16
CHUNK_SECONDS = 4.0
MAX_CHUNKS = 8


def remove_occlusion(scene) -> None:
    """Make every surface, instances included, invisible to all rays but the camera's.

    Objects that shine must stay visible to the rays that they light: these go through them instead.
    """
    for ob in bpy.data.objects:
        if ob.type not in SURFACE_TYPES:
            continue
        ob.visible_shadow = ob.visible_transmission = False
        if SIDE_PROPERTY not in ob:
            ob.visible_diffuse = ob.visible_glossy = False
    let_light_through(scene)


def render_reference(scene, view_layer, folder: Path, cycles_samples: int, sub_samples: int, progress) -> list[list]:
    """For each half the list of [file name in `folder`, samples in it]; a half has cycles_samples / 2 samples.

    The camera rays are those of `render_pixel_samples`, so that edges agree: with several sub-samples each gets its
    share of the samples, at least one. A half is rendered in chunks of one sample sequence, because Cycles reports
    progress only about once a minute.
    """
    remove_occlusion(scene)
    enable_passes(view_layer, ("combined", "diffuse_direct", "diffuse_color", "glossy_direct", "glossy_color"))
    samples, offsets = max(1, cycles_samples // 2), sub_pixel_offsets(scene, sub_samples)
    share = max(1, samples // sub_samples)
    with pinned_pixel_filter(scene):
        if sub_samples == 1:
            return [_render_half(scene, folder, half, seed, samples, progress) for half, seed in SEEDS.items()]
        return [_render_shifted(scene, folder, half, seed, offsets, share, progress) for half, seed in SEEDS.items()]


def _render_shifted(scene, folder: Path, half: str, seed: int, offsets, share: int, progress) -> list[list]:
    """One file per sub-sample, each with the next `share` samples of one sequence."""
    cycles = scene.cycles
    cycles.seed, cycles.samples, cycles.use_sample_subset = seed, share * len(offsets), True
    files = []
    for index, offset in enumerate(offsets):
        progress(f"Cycles {half}", index / len(offsets))
        cycles.sample_offset, cycles.sample_subset_length = index * share, share
        files.append([f"cycles_{half}_{index:04d}.exr", share])
        with shifted_pixels(scene, offset):
            render_exr(scene, folder / files[-1][0])
    cycles.use_sample_subset = False
    return files


def _render_half(scene, folder: Path, half: str, seed: int, samples: int, progress) -> list[list]:
    cycles = scene.cycles
    cycles.seed, cycles.samples, cycles.use_sample_subset = seed, samples, True
    files, done, chunk = [], 0, min(FIRST_CHUNK, samples)
    while done < samples:
        progress(f"Cycles {half}", done / samples)
        started = time.monotonic()
        cycles.sample_offset, cycles.sample_subset_length = done, min(chunk, samples - done)
        name = f"cycles_{half}_{len(files):04d}.exr"
        render_exr(scene, folder / name)
        files.append([name, cycles.sample_subset_length])
        done += cycles.sample_subset_length
        if len(files) == 1 and done < samples:
            seconds_left = (time.monotonic() - started) * (samples - done) / done
            chunks = min(MAX_CHUNKS, max(1, round(seconds_left / CHUNK_SECONDS)))
            chunk = -(-(samples - done) // chunks)
    cycles.use_sample_subset = False
    return files
