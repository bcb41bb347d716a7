"""Writing files atomically: under a temporary name, which becomes the name of the file once it is whole.

A temporary name has the mark of this machine and eight random digits, `.room.exr.<mark>-1f2e3d4c.tmp`. The process
that writes the file holds its lock. A free lock means that this process is dead; the next process that writes the same
file then deletes the leftover. Names with the mark of another machine are left alone, since locks may not work across
machines. Temporary folders are treated in the same way.
"""

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from .reading import check_name

try:
    import fcntl
except ImportError:  # Windows, where an open file cannot be deleted anyway
    fcntl = None

SUFFIX = ".tmp"
RUN_PREFIX = "ltsh-run-"  # of temporary folders


class NotWritten(OSError):
    """A file could not be written; the message names the file and says why."""


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield an empty temporary file in the folder of `path` that takes the name `path` when the block succeeds.

    If the block raises, the temporary file is deleted and a file at `path` stays unchanged. A symbolic link at `path`
    is followed. Raises OSError with one line of text.
    """
    target = Path(os.path.realpath(path))
    temporary, lock = None, None
    try:
        check_name(target)
        if os.path.exists(target) and not target.is_file():
            raise OSError(f"{'a folder' if target.is_dir() else 'a device or a pipe'} has that name")
        # File names have at most 255 bytes.
        start = os.fsencode(target.name)[:100].decode(errors="ignore")
        temporary, lock = _locked_file(target.parent, f".{start}.")
        yield temporary
        if os.name == "nt":
            lock = _closed(lock)  # an open file cannot be renamed there
        os.replace(temporary, target)
    except NotWritten:
        raise  # another file, within the block
    except OSError as error:
        raise NotWritten(f"{path}: cannot be written: {_reason(error, target.parent)}") from error
    finally:
        _closed(lock)
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


@contextmanager
def replacing_by_copy(path: str | os.PathLike) -> Iterator[Path]:
    """As `replacing`, for programs like Blender that write a file of their own and rename it to the given name.

    The yielded path does not exist yet. The program's file has no lock, so it is copied into the locked one.
    """
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
    """Create the folder if needed, then create and delete an empty file in it. Raises OSError."""
    check_name(folder)
    Path(folder).mkdir(parents=True, exist_ok=True)
    path, lock = _locked_file(Path(folder), ".ltsh-write-test.")
    os.close(lock)
    path.unlink(missing_ok=True)  # another process may have deleted the unlocked file


@contextmanager
def no_empty_folder(folder: str | os.PathLike) -> Iterator[None]:
    """Context in which `folder` may be created; if the block raises, the new folder is deleted if it is empty."""
    path = Path(folder).absolute()
    missing = [parent for parent in (path, *path.parents) if not os.path.exists(parent)]
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for parent in missing:
                parent.rmdir()
        raise


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Context with a temporary folder that only this user may open; it is deleted at the end.

    Raises OSError. If the disk is full, its message names the folder and a remedy.
    """
    parent = tempfile.gettempdir()
    try:
        check_name(parent)
        path, lock = _locked_folder(Path(parent))
    except OSError as error:
        remedy = "let TMPDIR name another folder"
        raise OSError(f"{parent}: cannot hold temporary files: {error.strerror}; {remedy}") from error
    try:
        yield path
    except OSError as error:
        # Errors about other files come from `replacing`: they have no errno.
        if disk_is_full(error) and str(error.filename or path).startswith(str(path)):
            raise OSError(no_room(path, error)) from error
        raise
    finally:
        _closed(lock)  # first, since deleting may need its descriptor
        shutil.rmtree(path, ignore_errors=True)


def disk_is_full(error: OSError) -> bool:
    """True if the disk is full, a quota is used up, or a file has the largest size that is allowed."""
    return error.errno in (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", None))


def no_room(folder: Path, error: OSError) -> str:
    """Error text for a temporary folder whose disk is full."""
    remedy = "make room, or let TMPDIR name another folder"
    return f"{folder.parent}: no room for temporary files ({error.strerror}); {remedy}"


def check_room_after(path: Path) -> None:
    """Raise OSError if the file `path` cannot grow, because its writer may have hidden the same error."""
    with path.open("ab", buffering=0) as file:
        end, more = file.tell(), bytes(1 << 16)
        try:
            while more:
                more = more[file.write(more) :]
        finally:
            file.truncate(end)


def save_array(path: Path, values: np.ndarray) -> None:
    """Write `values` as .npy. Unlike that of `np.save`, the OSError for a full disk has its errno."""
    values = np.ascontiguousarray(values)
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
        file.write(values.data)


def _machine() -> str:
    """Eight hexadecimal digits for this machine, from its name and, on Linux, the ID of the installation."""
    number = ""
    with suppress(OSError):
        number = Path("/etc/machine-id").read_text(encoding="ascii")
    return hashlib.sha256(f"{platform.node()} {number}".encode()).hexdigest()[:8]


MACHINE = _machine()


def _locked_file(folder: Path, prefix: str) -> tuple[Path, int]:
    """A new empty file and the descriptor that holds its lock. Deletes leftovers first. Raises OSError."""
    _delete_leftovers(folder, prefix, SUFFIX, 0 if fcntl is None else os.O_WRONLY | os.O_NOFOLLOW)
    while True:
        path = Path(folder, f"{prefix}{MACHINE}-{secrets.token_hex(4)}{SUFFIX}")
        # Not tempfile.mkstemp: the finished file would keep its mode 0600; this one follows the umask.
        lock = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        if _is_held(path, lock):
            return path, lock
        os.close(lock)


def _locked_folder(folder: Path) -> tuple[Path, int | None]:
    """A new folder and the descriptor that holds its lock. Deletes leftovers first, except on Windows, which cannot
    lock folders. Raises OSError."""
    if fcntl is None:
        return Path(tempfile.mkdtemp(prefix=RUN_PREFIX, dir=folder)), None
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
    _delete_leftovers(folder, RUN_PREFIX, "", flags)
    while True:
        path = Path(folder, f"{RUN_PREFIX}{MACHINE}-{secrets.token_hex(4)}")
        path.mkdir(0o700)
        try:
            lock = os.open(path, flags)
        except FileNotFoundError:  # another process took it for a leftover
            continue
        except OSError:
            path.rmdir()
            raise
        if _is_held(path, lock):
            return path, lock
        os.close(lock)


def _is_held(path: Path, lock: int) -> bool:
    """Take the lock of the new file `path`; False if another process has taken the file for a leftover before."""
    try:
        _take(lock)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a file system without locks, where nobody deletes leftovers
    try:
        return os.path.samestat(os.fstat(lock), os.stat(path))
    except FileNotFoundError:
        return False


def _take(lock: int) -> None:
    if fcntl is not None:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _delete_leftovers(folder: Path, prefix: str, suffix: str, flags: int) -> None:
    """Delete what dead processes of this machine left, with what programs added to the names: `prefix...suffix*`."""
    pattern = re.compile(f"({re.escape(prefix)}{MACHINE}-[0-9a-f]{{8}}{re.escape(suffix)}).*")
    leftovers: dict[Path, list[Path]] = {}
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if match := pattern.fullmatch(entry.name):
                leftovers.setdefault(Path(folder, match[1]), []).append(Path(entry.path))
    for path, names in leftovers.items():
        lock = None
        # Files stay that are in use, belong to another user, or are on a file system without locks.
        with suppress(OSError):
            with suppress(FileNotFoundError):  # only what a program added is left
                lock = os.open(path, flags) if fcntl is not None else None
            if lock is not None:
                _take(lock)
            for name in sorted(names):
                if name.is_dir() and not name.is_symlink():
                    shutil.rmtree(name)
                else:
                    name.unlink()
        _closed(lock)


def _closed(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)


def _reason(error: OSError, folder: Path) -> str:
    if not folder.exists():
        return f"the folder {folder} does not exist"
    if not folder.is_dir():
        return f"{folder} is not a folder"
    if isinstance(error, PermissionError):
        return f"no permission to write in the folder {folder}"
    return error.strerror or str(error)
