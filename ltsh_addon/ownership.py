"""Temporary files and folders: whose each is, and whether it is nobody's any more.

A name carries the machine, and the process holds a lock as long as it lives: what can be locked was left by a process
that was killed. Network file systems may keep locks within a machine (NFS without a lock manager, some of SMB), so
what carries the name of another one has also to be old. Standard library only.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed anyway
    fcntl = None

# What nobody has modified for so long is not being written, by the clock of its file system.
ABANDONED_SECONDS = 24 * 3600.0
_MARK = "([0-9a-f]{12})-[0-9a-f]{8}"


@cache
def machine() -> str:
    """Twelve hexadecimal digits for this machine, within which locks hold; others after it has started anew."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        boot = ""
    return hashlib.sha256(f"{boot} {platform.node()}".encode()).hexdigest()[:12]


def new_file(folder: Path, prefix: str, suffix: str) -> tuple[Path, int]:
    """An empty file in `folder` with a new name, and the descriptor that holds its lock. What such files are left of
    processes that are gone is removed, with all whose names go on after `suffix`. Raises OSError."""

    def make(path):
        # Not tempfile.mkstemp: its 0600 would stay on the finished file; this one follows the umask.
        return os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)

    return _new(folder, prefix, suffix, make)


def new_folder(folder: Path, prefix: str) -> tuple[Path, int | None]:
    """The same for a folder, which only this user may open; no descriptor on Windows."""

    def make(path):
        os.mkdir(path, 0o700)
        return None if fcntl is None else _opened(path)

    return _new(folder, prefix, "", make)


def _new(folder, prefix, suffix, make: Callable[[Path], int | None]) -> tuple[Path, int | None]:
    undecided = []
    for path, (owner, names) in _left(folder, prefix, suffix).items():
        if owner != machine() or not _remove_unlocked(path, names):
            undecided.append((path, names))
    path, lock = _made(folder, prefix, suffix, make)
    # Clocks of machines differ, the file system has one.
    now = path.stat().st_mtime if undecided else 0.0
    for other, names in undecided:
        if now - max(map(_modified, names)) > ABANDONED_SECONDS and not _remove_unlocked(other, names):
            _remove(names)
    return path, lock


def _left(folder, prefix, suffix) -> dict[Path, tuple[str, list[Path]]]:
    """Names that `_new` may have given: the machine, and all that belongs to each."""
    pattern = re.compile(f"({re.escape(prefix)}{_MARK}{re.escape(suffix)}).*")
    found: dict[Path, tuple[str, list[Path]]] = {}
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if match := pattern.fullmatch(entry.name):
                found.setdefault(Path(folder, match[1]), (match[2], []))[1].append(Path(entry.path))
    return found


def _made(folder, prefix, suffix, make) -> tuple[Path, int | None]:
    while True:
        path = Path(folder, f"{prefix}{machine()}-{secrets.token_hex(4)}{suffix}")
        try:
            lock = make(path)
        except FileNotFoundError:
            if not Path(folder).is_dir():
                raise
            continue  # another process took it for abandoned
        if lock is None or _hold(path, lock):
            return path, lock
        os.close(lock)


def _hold(path, lock: int) -> bool:
    """Take the lock; False where another process took `path` for abandoned before that."""
    try:
        _lock(lock)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a file system without locks, where nobody can take it
    try:
        return os.path.samestat(os.fstat(lock), os.stat(path))
    except OSError:
        return False


def _remove_unlocked(path: Path, names: list[Path]) -> bool:
    """Remove `names` if the lock of `path`, one of them or gone, is free; False where there are no locks."""
    lock = None
    try:
        if fcntl is not None:
            with suppress(FileNotFoundError):
                lock = _opened(path)
        if lock is not None:
            _lock(lock)
        _remove(names)
    except (BlockingIOError, PermissionError):
        pass  # in use, or another user's
    except OSError:
        return False
    finally:
        if lock is not None:
            os.close(lock)
    return True


def _remove(names: list[Path]) -> None:
    for path in names:
        with suppress(OSError):
            status = path.lstat()
            if not stat.S_ISDIR(status.st_mode):
                path.unlink()  # fails on Windows where it is open
            elif fcntl is not None and status.st_uid == os.getuid():
                shutil.rmtree(path, ignore_errors=True)


def _opened(path: Path) -> int:
    flags = os.O_RDONLY | os.O_DIRECTORY if path.is_dir() else os.O_WRONLY
    return os.open(path, flags | os.O_NOFOLLOW)


def _lock(file: int) -> None:
    """Take the lock of an open file or folder; raises BlockingIOError where another process has it."""
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _modified(path: Path) -> float:
    """When `path`, or anything in that folder, was modified last, in seconds; infinity where it is gone."""
    try:
        inside = (Path(folder, name) for folder, _, files in os.walk(path) for name in [".", *files])
        return max([path.lstat().st_mtime, *(each.lstat().st_mtime for each in inside)])
    except OSError:
        return float("inf")
