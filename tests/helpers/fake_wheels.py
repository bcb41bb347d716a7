"""Wheels and libraries with nothing inside, for the tests of packaging."""

import struct
import zipfile
from pathlib import Path


def fake_library(*tags: int) -> bytes:
    """An ELF file of nothing but a dynamic section with these tags."""
    offset = 64 + 56
    header = b"\x7fELF\x02\x01" + bytes(26) + struct.pack("<Q", 64) + bytes(14) + struct.pack("<HH", 56, 1) + bytes(6)
    program = struct.pack("<IIQQQQQQ", 2, 0, offset, 0, 0, 16 * (len(tags) + 1), 0, 0)
    return header + program + b"".join(struct.pack("<QQ", tag, 7) for tag in (*tags, 0))


def fake_wheel(path: Path, library: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("Imath.py", "x = 1\n")
        archive.writestr("OpenEXR.cpython-313-x86_64-linux-gnu.so", library)
        archive.writestr("openexr-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nTag: cp313-cp313-x\n\n")
        archive.writestr("openexr-1.0.dist-info/RECORD", "Imath.py,sha256=x,1\n")
    return path
