"""How much memory a picture or a bake takes, estimated before it is begun, and how much there may be. Needs no bpy."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from ...scene import SceneError

# The preferences of the extension set it, a farm may.
VARIABLE = "LTSH_MEMORY_MIB"
MIB = 1 << 20
# Measured on 4.5 and 5.2 at 1280 x 800: bytes per pixel of this process and of Blender together.
_PIXEL, _SUB_SAMPLE, _TECHNIQUE = 1000, 400, 40
_COMPARED, _COMPARED_TECHNIQUE = 110, 130
# Of a bake, at 512 x 512: bytes per texel of a block, of each of its channels, beside Cycles, and of the rows between
# which margins are filled.
_TEXEL, _CHANNEL, _COMPARED_TEXEL, _MARGIN_TEXEL = 620, 15, 370, 40
# Numpy, Blender and the loaded libraries.
_PROCESSES = 400 * MIB


def estimate(pixels: int, sub_samples: int, techniques: int, compared: bool) -> int:
    """Bytes that a picture takes at least: surfaces of one lobe, no geometry, no textures."""
    each = _PIXEL + _SUB_SAMPLE * sub_samples + _TECHNIQUE * techniques
    if compared:
        each += _COMPARED + _COMPARED_TECHNIQUE * techniques
    return _PROCESSES + pixels * each


@dataclass(frozen=True)
class BakeParts:
    """What of a bake is in memory at a time."""

    texels: int  # that are shaded, by all cores
    channels: int  # of the techniques
    margin_texels: int  # between whose rows margins are filled
    compared: bool  # beside Cycles

    def shading(self) -> int:
        """Bytes of what is shaded."""
        return self.texels * (_TEXEL + _CHANNEL * self.channels + _COMPARED_TEXEL * self.compared)

    def margin(self) -> int:
        """Bytes of what is written."""
        return self.margin_texels * _MARGIN_TEXEL

    def estimate(self) -> int:
        """Bytes that the bake takes at least: surfaces of one lobe, no geometry, no textures."""
        return _PROCESSES + max(self.shading(), self.margin())


def limit(wanted_mib: int = 0) -> int | None:
    """Bytes that a job may take: what is `wanted`, else what the environment says, else what the machine has free.

    None where nobody knows.
    """
    given = os.environ.get(VARIABLE, "").strip()
    mib = wanted_mib or (int(given) if given.isdecimal() else 0)
    return mib * MIB if mib else _free()


def _free() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = dict(line.split(":", 1) for line in lines if ":" in line)
    return int(found["MemAvailable"].split()[0]) << 10 if "MemAvailable" in found else None


def check(width: int, height: int, sub_samples: int, techniques: int, compared: bool, wanted_mib: int = 0) -> None:
    """Raise SceneError where a picture needs more than there may be."""
    needed, allowed = estimate(width * height, sub_samples, techniques, compared), limit(wanted_mib)
    if allowed is None or needed <= allowed:
        return
    points = "" if sub_samples == 1 else f" with {sub_samples} points each"
    raise SceneError(
        f"a picture of {width}x{height} pixels{points} takes about {size(needed)} of memory, {size(allowed)} may be "
        f"used: reduce --resolution{' or --aa' if sub_samples > 1 else ''}, or raise --memory-limit"
    )


def check_bake(what: str, parts: BakeParts, wanted_mib: int = 0) -> None:
    """Raise SceneError where a bake of `what` needs more than there may be."""
    needed, allowed = parts.estimate(), limit(wanted_mib)
    if allowed is None or needed <= allowed:
        return
    remedy = "--margin" if parts.margin() > parts.shading() else "--size below 512, or the cores (LTSH_CORES)"
    raise SceneError(
        f"a bake of {what} takes about {size(needed)} of memory, {size(allowed)} may be used: reduce {remedy}, or "
        "raise --memory-limit"
    )


def size(count: int) -> str:
    """Bytes as people read them: 512 MiB, 3.2 GiB."""
    mib = count / MIB
    return f"{mib:.0f} MiB" if mib < 1024.0 else f"{mib / 1024.0:.1f} GiB"
