"""Temporary folders that go with the process that made them, however it ends: at the latest when the next one starts.

Each is locked as long as its process lives; a folder that can be locked is nobody's. Imports no bpy.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

PREFIX = "ltsh-run-"


@contextlib.contextmanager
def locked_folder() -> Iterator[Path]:
    """A temporary folder that is there meanwhile; those of processes that were killed are removed. Raises OSError."""
    _remove_abandoned(Path(tempfile.gettempdir()))
    path, lock = _made()
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _made() -> tuple[Path, int | None]:
    """A new folder and the descriptor that holds its lock, None on Windows."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=PREFIX))
        if fcntl is None:
            return path, None
        try:
            lock = _opened(path)
        except FileNotFoundError:
            continue  # another process took it for abandoned, before it was locked
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            taken = os.fstat(lock).st_nlink == 0
        except BlockingIOError:
            taken = True
        except OSError:
            taken = False  # a file system without locks
        if not taken:
            return path, lock
        os.close(lock)


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"{PREFIX}*") if fcntl is not None else ():
        with contextlib.suppress(OSError):  # locked, or another user's
            lock = _opened(path)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_uid == os.getuid():
                    shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(lock)


def _opened(path: Path) -> int:
    return os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
