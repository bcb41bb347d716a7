"""Whether an EXR that Blender has just written is whole: where the disk is full it says nothing. Needs no bpy."""

from __future__ import annotations

import struct
from pathlib import Path

ZIP_ROWS = 16
_MULTI_PART = 0x1000
_HEADERS_BYTES = 1 << 22


def is_whole(path: Path) -> bool:
    """True where every chunk of the scanline EXR `path`, of ZIP compression, is there to its end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        data = file.read(_HEADERS_BYTES)
        try:
            counts, position, several = _headers(data)
            offsets = struct.unpack_from(f"<{sum(counts)}Q", data, position)
            if min(offsets) < position:
                return False
            file.seek(max(offsets) + (8 if several else 4))
            return file.tell() + 4 + struct.unpack("<I", file.read(4))[0] <= size
        except (ValueError, IndexError, KeyError, struct.error):
            return False


def _headers(data: bytes) -> tuple[list[int], int, bool]:
    """Chunks of every part, where the table of their places begins, and whether there may be several parts."""
    several = bool(struct.unpack_from("<I", data, 4)[0] & _MULTI_PART)
    position, counts = 8, []
    while True:
        attributes = {}
        while data[position]:
            name_end = data.index(0, position)
            type_end = data.index(0, name_end + 1)
            (length,) = struct.unpack_from("<I", data, type_end + 1)
            start = type_end + 5
            attributes[data[position:name_end]] = data[start : start + length]
            position = start + length
        position += 1
        counts.append(_chunks(attributes))
        if not several:
            return counts, position, several
        if not data[position]:
            return counts, position + 1, several


def _chunks(attributes) -> int:
    if b"chunkCount" in attributes:
        return struct.unpack("<I", attributes[b"chunkCount"])[0]
    _, low, _, high = struct.unpack("<4i", attributes[b"dataWindow"])
    return -(-(high - low + 1) // ZIP_ROWS)
