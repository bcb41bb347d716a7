"""The .blend files that the second Blender opens: can a file be opened here? Imports no bpy."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from dataclasses import replace
from pathlib import Path

from ...reading import check_name
from ...scene import Progress, SceneError
from .blender_process import run_job

# The first bytes of a .blend: uncompressed, compressed by Blender since 3.0, and compressed before.
MAGIC_BYTES = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
# The header: pointer size, byte order and version; since 5.0 also the size of the header and the version of the format.
_HEADER = re.compile(rb"BLENDER(?:[-_][vV](\d{3})|\d\d-\d\dv(\d{4}))")
_HEADER_BYTES = 17

Version = tuple[int, int]


def run_scene_job(job, folder: Path, progress: Progress | None) -> dict:
    """Do `job`, which opens the .blend `job.scene`, as `run_job` does. First check that the file can be opened."""
    scene = Path(job.scene).absolute()
    check_readable(scene)
    return run_job(replace(job, scene=scene), folder, progress)


def check_readable(scene: Path) -> None:
    """Raise SceneError if a look at the file is enough to tell that it cannot be opened; Blender need not start."""
    try:
        check_name(scene)
        if not scene.exists():
            raise SceneError(f"{scene}: no such file, expected a .blend")
        if scene.is_dir():
            raise SceneError(f"{scene}: is a folder, expected a .blend")
        if not scene.is_file():  # reading a pipe or a device might never end
            raise SceneError(f"{scene}: is a device or a pipe, expected a .blend")
        with scene.open("rb") as file:
            start = file.read(_HEADER_BYTES)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"{str(scene)[:200]!r}: cannot be read: {reason}") from None
    if not start:
        raise SceneError(f"{scene}: the file is empty, expected a .blend")
    if not start.startswith(MAGIC_BYTES):
        raise SceneError(f"{scene}: is no .blend, it starts with {start[:7]!r}")
    saved, here = saved_with(start), running()
    if saved and here and saved > here:
        raise SceneError(newer(scene, saved, here))


def saved_with(start: bytes) -> Version | None:
    """Major and minor version of the Blender that saved a file with this `start`; None if it is compressed."""
    match = _HEADER.match(start)
    return divmod(int(match[1] or match[2]), 100) if match else None


def running() -> Version | None:
    """Major and minor version of the Blender that will open files; None if there is none."""
    bpy = sys.modules.get("bpy")
    if bpy is not None:
        return tuple(bpy.app.version[:2])
    try:
        version = importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        return None
    return tuple(int(number) for number in version.split(".")[:2])


def newer(path: Path, saved: Version, here: Version) -> str:
    """Error text for a file that was `saved` by a newer Blender than the one that is `here`."""
    saved, here = (".".join(map(str, version)) for version in (saved, here))
    return (
        f"{path}: was saved by Blender {saved}, but this is Blender {here}, which may miss parts of it: use Blender "
        f"{saved}, or save the file with {here}"
    )
