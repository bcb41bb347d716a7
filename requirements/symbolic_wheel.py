"""Linux wheels whose library calls its own functions, also inside a program that has functions of the same names.

Blender loads an OpenEXR of its own with its symbols visible to all. The C functions `exr_*` have no version in their
names, so the dynamic linker binds those of the wheel to Blender's: two versions then share structures of different
layout (seen with 3.5.3 inside Debian's Blender 5.2.2, which has 3.4.16). The flag DT_SYMBOLIC (System V ABI, chapter 5,
"Dynamic Section") makes a library look among its own symbols first; functions that it only imports, `malloc` above
all, stay those of the program. macOS and Windows bind to libraries by name and need nothing.

    python requirements/symbolic_wheel.py FOLDER        # sets the flag in the libraries of OpenEXR in FOLDER
"""

from __future__ import annotations

import base64
import hashlib
import os
import struct
import sys
import zipfile
from pathlib import Path

BUILD_TAG = "1"  # tells the changed wheel from the original
_HEADER_64_BIT_LITTLE_ENDIAN = b"\x7fELF\x02\x01"
_PT_DYNAMIC = 2
_DT_NULL, _DT_SYMBOLIC, _DT_RUNPATH = 0, 16, 29
_PROGRAM_HEADER = struct.Struct("<IIQQQQQQ")
_DYNAMIC_ENTRY = struct.Struct("<QQ")


def with_symbolic_flag(library: bytes, name: str) -> bytes:
    """The ELF library with DT_SYMBOLIC set, in place of its search path. Raises ValueError where it has none.

    The libraries of OpenEXR's wheels need system libraries only; their search path names folders of the machine that
    built them.
    """
    if not library.startswith(_HEADER_64_BIT_LITTLE_ENDIAN):
        raise ValueError(f"{name}: is no 64-bit little-endian ELF library, expected one from a Linux wheel")
    entries = _dynamic_entries(library)
    tags = {tag: offset for offset, tag in entries}
    if _DT_SYMBOLIC in tags:
        return library
    if _DT_RUNPATH not in tags:
        raise ValueError(f"{name}: has no search path whose place the flag DT_SYMBOLIC could take")
    changed = bytearray(library)
    _DYNAMIC_ENTRY.pack_into(changed, tags[_DT_RUNPATH], _DT_SYMBOLIC, 0)
    return bytes(changed)


def _dynamic_entries(library: bytes) -> list[tuple[int, int]]:
    """(offset in the file, tag) of the entries of the dynamic section."""
    (table,) = struct.unpack_from("<Q", library, 32)
    size, count = struct.unpack_from("<HH", library, 54)
    for index in range(count):
        kind, _, offset, _, _, length, _, _ = _PROGRAM_HEADER.unpack_from(library, table + index * size)
        if kind == _PT_DYNAMIC:
            entries = range(offset, offset + length, _DYNAMIC_ENTRY.size)
            return [(entry, _DYNAMIC_ENTRY.unpack_from(library, entry)[0]) for entry in entries]
    return []


def write_symbolic_wheel(wheel: Path, folder: Path) -> Path:
    """Write `wheel` with the flag set in its libraries into `folder`, with a build tag; its path."""
    parts = wheel.name.split("-")
    target = folder / "-".join([*parts[:2], BUILD_TAG, *parts[-3:]])
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(target, "w") as new:
        record = []
        (own,) = [entry for entry in old.infolist() if entry.filename.endswith(".dist-info/RECORD")]
        for entry in old.infolist():
            if entry is own:
                continue
            content, name = old.read(entry), entry.filename
            if name.endswith(".so"):
                content = with_symbolic_flag(content, f"{wheel.name}: {name}")
            elif name.endswith(".dist-info/WHEEL"):
                content = content.rstrip() + f"\nBuild: {BUILD_TAG}\n".encode()
            new.writestr(entry, content, compress_type=zipfile.ZIP_DEFLATED, compresslevel=9)
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            record.append(f"{name},sha256={digest},{len(content)}")
        lines = "\n".join([*record, f"{own.filename},,", ""])
        new.writestr(own, lines, compress_type=zipfile.ZIP_DEFLATED, compresslevel=9)
    return target


def main(folder: Path) -> None:
    for path in sorted(folder.glob("OpenEXR*-linux-gnu.so")):
        unfinished = path.with_name(f".{path.name}.part")
        unfinished.write_bytes(with_symbolic_flag(path.read_bytes(), str(path)))
        unfinished.chmod(0o755)
        os.replace(unfinished, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
