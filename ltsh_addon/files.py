"""How files are written: under temporary names, renamed when whole; leftovers of dead processes are deleted."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import numpy as np

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


SUFFIX = ".tmp"


class NotWritten(OSError):
    """A file could not be written; the text names it and says why."""


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield an empty temporary file in the folder of `path` that takes the name `path` when the block succeeds.

    When the block raises, the temporary file is removed and whatever stood at `path` is untouched; what a process that
    was killed has left of the same file is removed too. A symbolic link at `path` is followed. Raises OSError, one
    line, when the folder is missing or not writable, the disk is full, ...
    """
    target = Path(os.path.realpath(path))
    temporary, file = None, None
    try:
        if target.is_dir():
            raise OSError("a folder has that name")
        temporary, file = new_file(target.parent, _prefix(target.name), SUFFIX)
        yield temporary
        if os.name == "nt":
            file = _closed(file)  # what is open cannot be renamed there
        os.replace(temporary, target)
    except NotWritten:
        raise  # another file, within the block
    except OSError as error:
        raise NotWritten(f"{path}: cannot be written: {_reason(error, target.parent)}") from error
    finally:
        _closed(file)
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


@contextmanager
def replacing_by_copy(path: str | os.PathLike) -> Iterator[Path]:
    """As `replacing`, for programs that put a file of their own in the place of the one that they are given, as Blender
    does: it is copied then, since nobody holds its lock. What is yielded does not exist yet."""
    with replacing(path) as temporary:
        made = temporary.with_name(f"{temporary.name}.saved")
        try:
            yield made
            shutil.copyfile(made, temporary)
        finally:
            made.unlink(missing_ok=True)


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write `data` to the file `path`, all or nothing (see `replacing`)."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def check_takes_files(folder: str | os.PathLike) -> None:
    """Make the folder where it is missing, and an empty file in it that goes again; raises OSError where that fails.

    Processes that do so in one folder at a time do not meet: each file has a name of its own.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path, file = new_file(folder, ".ltsh-write-test.", SUFFIX)
    _closed(file)
    path.unlink(missing_ok=True)  # once closed, another process may take it for abandoned


def _prefix(name: str) -> str:
    """What the names of temporary files of the file `name` begin with; names have 255 bytes at most."""
    return f".{os.fsencode(name)[:100].decode(errors='ignore')}."


def _closed(file: int | None) -> None:
    if file is not None:
        os.close(file)


def _reason(error: OSError, folder: Path) -> str:
    if not folder.exists():
        return f"the folder {folder} does not exist"
    if not folder.is_dir():
        return f"{folder} is not a folder"
    if isinstance(error, PermissionError):
        return f"no permission to write in the folder {folder}"
    return error.strerror or str(error)


PREFIX = "ltsh-run-"


@contextlib.contextmanager
def locked_folder() -> Iterator[Path]:
    """A temporary folder that is there meanwhile; those of processes that were killed are removed. Raises OSError."""
    path, lock = new_folder(Path(tempfile.gettempdir()), PREFIX)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def save_array(path: Path, values: np.ndarray) -> None:
    """Write `values` as .npy. Raises OSError, with its number also where the disk is full, unlike `np.save`."""
    values = np.ascontiguousarray(values)
    unfinished = path.with_suffix(".tmp")
    with unfinished.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
        file.write(values.data)
    unfinished.replace(path)
