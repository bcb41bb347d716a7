"""A log of runs: lines with time stamps, appended to a file."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path


class RunLog:
    """Lines for the file `path`; without one they go nowhere. A context, which closes it. Raises OSError."""

    def __init__(self, path: Path | None):
        try:
            # Unbuffered, so that a line is one write, however long: several shards may write to one log.
            self._file = None if path is None else open(path, "ab", buffering=0)
        except OSError as error:
            raise OSError(f"log {path}: cannot be written ({error.strerror}); choose another with --log") from error

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *exception) -> None:
        if self._file is not None:
            self._file.close()

    def line(self, text: str) -> None:
        """Append a line, with the time."""
        if self._file is not None:
            stamp = datetime.now().astimezone().isoformat(timespec="seconds")
            # Names of files may hold bytes that are no UTF-8.
            self._file.write(f"{stamp} {' '.join(text.split())}\n".encode(errors="backslashreplace"))
