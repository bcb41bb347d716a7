"""The bounced light of a lightmap: Cycles' indirect light, denoised island by island; and what a bake takes."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..cycles.texels import NOT_BAKED
from ..imaging.denoise import NoDenoiser, open_denoiser, smoothed
from ..imaging.exr import COMBINED
from ..imaging.seams import FRAMES, Islands, canvas_of, nearest_covered
from ..scene import PASSES, Light, SceneError
from ..workers.pool import cores
from .options import BakeOptions

# REST_TEXELS: the most that Cycles bakes at a time for the bounced light, since it reads the whole scene each time.
REST_TEXELS = 1 << 22
# Bytes that a large bake takes, as peaks of processes show: PROGRAM_BYTES for Python and Blender with a small scene,
# BLOCK_BYTES for the block of texels that each thread shades, LAYER_BYTES for those of each light by itself; and for
# each texel with bounces CANVAS_BYTES, PICTURE_BYTES for each picture of bounced light, CYCLES_BYTES for Cycles.
PROGRAM_BYTES, BLOCK_BYTES, LAYER_BYTES = 460e6, 200e6, 22e6
CANVAS_BYTES, PICTURE_BYTES, CYCLES_BYTES = 850, 37, 215
# Canvases are as large as what the islands cover; LEAST_BYTES of a texel are there in any case: its face and guides.
LEAST_BYTES = 32
# Memory is told from so many texels, or bytes, on.
TOLD_TEXELS, TOLD_BYTES = 1 << 24, 4 * 2**30
# DULL: a diffuse color below which Cycles' diffuse light, divided by it, says nothing.
DULL = 1e-3


SOFT = "soft"  # the kind of direct light that is denoised, beside the kinds of bounced light


def crisp_and_soft(lights: tuple[Light, ...], options: BakeOptions) -> tuple[list[Light], list[Light]]:
    """The lights that a bake shades as they are, and those whose diffuse light Cycles bakes with the bounces: the sky,
    and with it the sun that the same world shows.

    Through a window few rays meet it, of ours as of Cycles' samples, and its shadows are seldom crisp.
    """
    is_soft = options.bounces == "on" and "diffuse" in rest_passes(options.passes)
    soft = [light for light in lights if is_soft and light.is_side and light.affects_diffuse]
    names = {light.name for light in soft}
    return [_not_diffuse(one) if one.is_distant and one.name in names else one for one in lights], soft


def _not_diffuse(light: Light) -> Light:
    """The light, hidden from diffuse lobes with all that it is made of."""
    parts = {"children": tuple(map(_not_diffuse, light.children))} if light.children else {}
    return replace(light, affects_diffuse=False, **parts)


def diffuse_shares(albedo: np.ndarray, texel: np.ndarray) -> np.ndarray:
    """The shares (S, 3) of samples in the diffuse `albedo` (S, 3) of their sorted texels (S,); of one that is black,
    all is that of its first sample."""
    first, otherwise = first_samples(texel), np.zeros_like(albedo[:, :1])
    otherwise[first] = 1.0
    total = np.add.reduceat(albedo, first).repeat(np.diff(first, append=len(texel)), axis=0)
    return np.where(total > 0.0, albedo / np.where(total > 0.0, total, 1.0), otherwise)


def first_samples(texel: np.ndarray) -> np.ndarray:
    """The number of the first sample of each texel, of the sorted texels (S,) of samples."""
    return np.flatnonzero(np.concatenate([[True], texel[1:] != texel[:-1]])) if len(texel) else texel


def of_passes(light: dict[tuple[str, int], np.ndarray], texels: np.ndarray, color: np.ndarray) -> tuple[dict, dict]:
    """Denoised `light` by pass on the `texels` (Q,) of the diffuse `color` (Q, 3): bounced (R, Q, 3), and soft (Q, 3).

    Bounced light has a row for each light group that was baked by itself, else one for all.
    """
    rows: dict[str, list[np.ndarray]] = {}
    for (kind, _), image in light.items():
        rows.setdefault(kind, []).append(image.reshape(-1, 3)[texels])
    soft = rows.pop(SOFT, None)
    bounced = {kind: np.array(images) for kind, images in rows.items()}
    if "diffuse" in bounced:
        bounced["diffuse_light"], bounced["diffuse"] = bounced["diffuse"], color * bounced["diffuse"]
    bounced[COMBINED] = sum(bounced[name] for name in PASSES if name in bounced)
    if soft is None:
        return bounced, {}
    return bounced, {"diffuse_light": soft[0], "diffuse": color * soft[0], COMBINED: color * soft[0]}


def rest_rows(size: tuple[int, int]) -> int:
    """Rows of texels whose bounced light is baked at a time."""
    width, height = size
    return max(1, min(height, REST_TEXELS // width))


def rest_passes(passes: set[str]) -> tuple[str, ...]:
    """The passes of Cycles' indirect light from which that of the wanted `passes` follows."""
    kinds = {"specular": {"specular", "combined"}, "diffuse": {"diffuse", "diffuse_light", "combined"}}
    return tuple(kind for kind, wanted in kinds.items() if wanted & set(passes))


def memory_needed(options: BakeOptions, lights: int, canvas: float = CANVAS_BYTES) -> float:
    """About the most bytes of memory that a bake takes, with so many rows of lights. Objects take it one by one.

    `canvas` are the bytes of a texel for canvases, by default of a texture that islands fill.
    """
    texels, layers = math.prod(options.size), lights if options.per_light else 1
    shading, bounces, cycles = cores() * BLOCK_BYTES + layers * LAYER_BYTES, 0.0, 0.0
    if options.bounces == "on":
        kinds = rest_passes(options.passes)
        pictures = len(kinds) * layers + ("diffuse" in kinds)
        bounces = texels * (canvas + pictures * PICTURE_BYTES)
        cycles = min(texels, REST_TEXELS) * CYCLES_BYTES
    return PROGRAM_BYTES + max(shading, bounces) + cycles


def announced(options: BakeOptions, lights: int) -> list[str]:
    """What is told before a bake with so many rows of lights: its memory if it is much, and the time of the lights."""
    needed, notes = memory_needed(options, lights), []
    if math.prod(options.size) >= TOLD_TEXELS or needed >= TOLD_BYTES:
        there = machine_memory()
        less = (
            f", and this machine has {there / 2**30:.1f}: fewer texels take less" if needed > (there or needed) else ""
        )
        notes.append(f"The bake takes about {needed / 2**30:.1f} GiB of memory{less}")
    if options.per_light and options.bounces == "on":
        noun = "light" if lights == 1 else "lights"
        notes.append(f"{lights} {noun}: bounces take {max(0.5 * lights, 1.0):g} times as long as those of all at once")
    return notes


def check_memory(options: BakeOptions, lights: int) -> None:
    """Raises SceneError where the machine certainly has too little memory for a bake."""
    needed, there = memory_needed(options, lights, LEAST_BYTES), machine_memory()
    if there is not None and needed > there:
        less = "lower --size" + (", or leave out --per-light" if options.per_light else "")
        raise SceneError(
            f"a bake of {options.size[0]} x {options.size[1]} texels takes at least {needed / 2**30:.1f} GiB, "
            f"and this machine has {there / 2**30:.1f} GiB, swap included: {less}"
        )


def machine_memory() -> float | None:
    """Bytes of memory and swap of this machine; None where it cannot be told, or swap grows by itself."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        sizes = {name: 1024.0 * float(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)}
        return sizes["MemTotal"] + sizes["SwapTotal"]
    except (OSError, ValueError, LookupError):
        return None


def read_rest(
    folder: Path, tile: int, options: BakeOptions, groups: tuple[str, ...], has_soft: bool
) -> tuple[dict[tuple[str, int], np.ndarray], np.ndarray]:
    """Cycles' light (H, W, 3) of a tile by kind and row of lights, NOT_BAKED where there is none, and the mask (H, W)
    of where there is. Soft light counts as bounced where no light group asks for it."""
    keys = [*itertools.product(rest_passes(options.passes), range(len(groups) if options.per_light else 1))]
    keys += [(SOFT, 0)] if has_soft and groups != ("",) else []
    firsts, rest = range(0, options.size[1], rest_rows(options.size)), {}
    for kind, row in keys:
        rows = [np.load(folder / f"rest_{kind}_{row}_{tile}_{first}.npy") for first in firsts]
        rest[kind, row] = np.concatenate(rows)
    is_baked = next(iter(rest.values()))[..., 0] != np.float32(NOT_BAKED)
    return rest, is_baked


def denoised_rest(
    rest: dict[tuple[str, int], np.ndarray], guides: np.ndarray, islands: Islands, samples: int
) -> tuple[dict[tuple[str, int], np.ndarray], str]:
    """The light `rest` (H, W, 3) by kind and row of lights, each denoised by itself; and what denoised it.

    It is 0 where no island is. `guides` (H, W, 6) are the diffuse color and the normal. There are so many `samples`.
    """
    from ..blender.process.blender_process import denoiser_libraries

    canvas, is_covered = canvas_of(islands), islands.grid.triangle >= 0
    images, white = {}, np.concatenate([np.ones_like(guides[..., :3]), guides[..., 3:]], axis=-1)
    for key, light in rest.items():
        is_lit = (light[..., 0] != np.float32(NOT_BAKED)) & is_covered
        if key[0] != "specular":
            is_lit &= guides[..., :3].max(axis=-1) > DULL
        # Light without color owes nothing to that of the surface.
        images[key] = np.where(is_lit[..., None], light, 0.0), is_lit, guides if key[0] == "specular" else white
    try:
        with open_denoiser(denoiser_libraries(), cores()) as denoiser:
            done = {key: _on_canvas(canvas, *one, denoiser.guided) for key, one in images.items()}
            return done, denoiser.name
    except NoDenoiser as error:

        def smooth(light, albedo, normals):
            return smoothed(light, np.concatenate([albedo, normals, np.ones_like(light[..., :1])], axis=-1), samples)

        done = {key: _on_canvas(canvas, *one, smooth) for key, one in images.items()}
        return done, f"its bounced light is smoothed along the surface, not denoised: {error}"


def _on_canvas(canvas, light, is_lit, guides, denoise: Callable) -> np.ndarray:
    """The light (H, W, 3) of a texture, denoised on its canvas. `guides` are as for `denoised_rest`."""
    planes, mask = canvas.put(np.concatenate([light, guides, is_lit[..., None]], axis=-1))
    # Beyond lit texels the picture is mirrored: noise that is repeated would look like light. Texels between lit ones
    # and others count as others.
    lit = mask & (planes[..., -1] > 0.999)
    target, source = nearest_covered(lit, max(FRAMES))
    row, column = (
        2 * (source // lit.shape[1]) - target // lit.shape[1],
        2 * (source % lit.shape[1]) - target % lit.shape[1],
    )
    inside = (row >= 0) & (row < lit.shape[0]) & (column >= 0) & (column < lit.shape[1])
    mirrored = np.where(inside, row * lit.shape[1] + column, 0)
    source = np.where(inside & lit.reshape(-1)[mirrored], mirrored, source)
    flat, is_bare = planes.reshape(-1, planes.shape[-1]), ~mask.reshape(-1)
    flat[target, :3] = flat[source, :3]
    bare = is_bare[target]
    flat[target[bare], 3:-1] = flat[source[bare], 3:-1]
    return canvas.taken(denoise(planes[..., :3], planes[..., 3:6], planes[..., 6:9]), light)
