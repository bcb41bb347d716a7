"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield an empty temporary file in the folder of `path` that takes the name `path` when the block succeeds.

    When the block raises, the temporary file is removed and whatever stood at `path` is untouched. A symbolic link at
    `path` is followed. Raises OSError, one line, when the folder is missing or not writable, the disk is full, ...
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.tmp")
    try:
        if target.is_dir():
            raise OSError("a folder has that name")
        # Not tempfile.mkstemp: its 0600 would stay on the finished file; this one follows the umask.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {_reason(error, target.parent)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write `data` to the file `path`, all or nothing (see `replacing`)."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _reason(error: OSError, folder: Path) -> str:
    if not folder.exists():
        return f"the folder {folder} does not exist"
    if not folder.is_dir():
        return f"{folder} is not a folder"
    if isinstance(error, PermissionError):
        return f"no permission to write in the folder {folder}"
    return error.strerror or str(error)
