"""What a bake will take, told before it starts: memory, and the time of lights by themselves."""

from __future__ import annotations

import math
from pathlib import Path

from ..scene import SceneError
from ..workers.pool import cores
from .options import BakeOptions

# REST_TEXELS: the most that Cycles bakes at a time for the bounced light, since it reads the whole scene each time.
REST_TEXELS = 1 << 22
# Bytes that a large bake takes, as peaks of processes show: PROGRAM_BYTES for Python and Blender with a small scene,
# BLOCK_BYTES for the block of texels that each thread shades, LAYER_BYTES for those of each light by itself; and for
# each texel with bounces CANVAS_BYTES, PICTURE_BYTES for each picture of bounced light, CYCLES_BYTES for Cycles.
PROGRAM_BYTES, BLOCK_BYTES, LAYER_BYTES = 460e6, 200e6, 22e6
CANVAS_BYTES, PICTURE_BYTES, CYCLES_BYTES = 850, 37, 215
# Memory is told from so many texels, or bytes, on. A bake that needs MOST_OF_MACHINE times what there is cannot work:
# the estimate is right within this factor.
TOLD_TEXELS, TOLD_BYTES, MOST_OF_MACHINE = 1 << 24, 4 * 2**30, 1.5


def rest_passes(passes: set[str]) -> tuple[str, ...]:
    """The passes of Cycles' indirect light from which that of the wanted `passes` follows."""
    kinds = {"specular": {"specular", "combined"}, "diffuse": {"diffuse", "diffuse_light", "combined"}}
    return tuple(kind for kind, wanted in kinds.items() if wanted & set(passes))


def memory_needed(options: BakeOptions, lights: int) -> float:
    """About the most bytes of memory that a bake takes, with so many rows of lights. Objects take it one by one."""
    texels, layers = math.prod(options.size), lights if options.per_light else 1
    shading, bounces, cycles = cores() * BLOCK_BYTES + layers * LAYER_BYTES, 0.0, 0.0
    if options.bounces == "on":
        kinds = rest_passes(options.passes)
        pictures = len(kinds) * layers + ("diffuse" in kinds)
        bounces = texels * (CANVAS_BYTES + pictures * PICTURE_BYTES)
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
    needed, there = memory_needed(options, lights), machine_memory()
    if there is not None and needed > MOST_OF_MACHINE * there:
        less = "lower --size" + (", or leave out --per-light" if options.per_light else "")
        raise SceneError(
            f"a bake of {options.size[0]} x {options.size[1]} texels takes about {needed / 2**30:.1f} GiB of memory, "
            f"this machine has {there / 2**30:.1f}, swap included: {less}"
        )


def machine_memory() -> float | None:
    """Bytes of memory and swap of this machine; None where it cannot be told, or swap grows by itself."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        sizes = {name: 1024.0 * float(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)}
        return sizes["MemTotal"] + sizes["SwapTotal"]
    except (OSError, ValueError, LookupError):
        return None
