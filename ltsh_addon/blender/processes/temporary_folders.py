"""Temporary folders that go with the process that made them, however it ends: at the latest when the next one starts.

Imports no bpy.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ... import ownership

PREFIX = "ltsh-run-"


@contextlib.contextmanager
def locked_folder() -> Iterator[Path]:
    """A temporary folder that is there meanwhile; those of processes that were killed are removed. Raises OSError."""
    path, lock = ownership.new_folder(Path(tempfile.gettempdir()), PREFIX)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        if lock is not None:
            os.close(lock)
