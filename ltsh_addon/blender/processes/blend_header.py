"""Which Blender has saved a .blend, read from its first bytes, and which one runs here. Imports no bpy."""

from __future__ import annotations

import contextlib
import importlib.metadata
import re
import sys
import zlib
from pathlib import Path

# Of a .blend as it is, or compressed by Blender since 3.0 and before.
PLAIN, ZSTANDARD, GZIP = b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b"
STARTS = (PLAIN, ZSTANDARD, GZIP)
# Pointers, byte order and version, since 5.0 with the size of the header and the version of the format before.
_HEADER = re.compile(rb"BLENDER(?:[-_][vV](\d{3})|\d\d-\d\dv(\d{4}))")
_HEADER_BYTES = 17
# More than a first block of either compression has.
_READ_BYTES = 1 << 18

Version = tuple[int, int]


def saved_with(path: Path) -> Version | None:
    """Major and minor version of the Blender that saved the file; None where that cannot be told."""
    with path.open("rb") as file:
        start = file.read(_READ_BYTES)
    match = _HEADER.match(_unpacked(start))
    return divmod(int(match[1] or match[2]), 100) if match else None


def running() -> Version | None:
    """Major and minor version of the Blender that will open files; None where there is none."""
    bpy = sys.modules.get("bpy")
    if bpy is not None:
        return tuple(bpy.app.version[:2])
    try:
        found = importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        return None
    return tuple(int(part) for part in found.split(".")[:2])


def newer(path: Path, saved: Version, here: Version) -> str:
    """What is wrong with a file that was `saved` by a newer Blender than the one that is `here`."""
    saved, here = (".".join(map(str, version)) for version in (saved, here))
    return (
        f"{path}: was saved by Blender {saved}, but this is Blender {here}, which may miss parts of it: use Blender "
        f"{saved}, or save the file with {here}"
    )


def _unpacked(start: bytes) -> bytes:
    """The header of a file that starts with `start`; less of it where it cannot be unpacked."""
    if start.startswith(GZIP):
        with contextlib.suppress(zlib.error):
            return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, _HEADER_BYTES)
        return b""
    if start.startswith(ZSTANDARD):
        return _unpacked_zstandard(start)
    return start[:_HEADER_BYTES]


def _unpacked_zstandard(start):
    try:
        import zstandard  # comes with Blender, but for that of some Linux distributions
    except ImportError:
        return b""
    with contextlib.suppress(zstandard.ZstdError):
        return zstandard.ZstdDecompressor().stream_reader(start).read(_HEADER_BYTES)
    return b""
