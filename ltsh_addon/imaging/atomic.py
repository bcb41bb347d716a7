"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .. import ownership

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
        temporary, file = ownership.new_file(target.parent, _prefix(target.name), SUFFIX)
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
    path, file = ownership.new_file(folder, ".ltsh-write-test.", SUFFIX)
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
