"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed anyway
    fcntl = None


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
    prefix = f".{target.name[:100]}."
    temporary, file = None, None
    try:
        if target.is_dir():
            raise OSError("a folder has that name")
        _remove_abandoned(target.parent, prefix)
        temporary, file = _locked(target.parent, prefix)
        yield temporary
        if fcntl is None:
            file = _closed(file)
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
    prefix = ".ltsh-write-test."
    _remove_abandoned(folder, prefix)
    path, file = _locked(folder, prefix)
    _closed(file)
    path.unlink(missing_ok=True)  # once closed, another process may take it for abandoned


def _locked(folder: Path, prefix: str) -> tuple[Path, int]:
    """A new file in `folder` and its descriptor, which holds the lock that tells others that somebody writes it."""
    while True:
        path = folder / f"{prefix}{secrets.token_hex(4)}.tmp"
        # Not tempfile.mkstemp: its 0600 would stay on the finished file; this one follows the umask.
        file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        try:
            _lock(file)
            taken = os.fstat(file).st_nlink == 0
        except BlockingIOError:
            taken = True
        except OSError:
            taken = False  # a file system without locks
        if not taken:
            return path, file
        os.close(file)  # another process took it for abandoned, before it was locked


def _remove_abandoned(folder: Path, prefix: str) -> None:
    """Remove temporary files with that prefix that nobody writes any more."""
    name, found = re.compile(re.escape(prefix) + r"[0-9a-f]{8}\.tmp@?"), []  # Blender writes to NAME@
    with suppress(OSError), os.scandir(folder) as entries:
        found = [entry for entry in entries if name.fullmatch(entry.name)]
    for entry in found:
        with suppress(OSError):
            if fcntl is None:
                os.unlink(entry.path)  # fails where it is open
                continue
            file = os.open(entry.path, os.O_WRONLY)
            try:
                _lock(file)
                os.unlink(entry.path)
            finally:
                os.close(file)


def _lock(file: int) -> None:
    """Take the lock of an open file; raises OSError where another process has it."""
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


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
