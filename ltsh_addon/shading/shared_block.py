"""Memory that a parent and one child process share, and arrays laid out in it.

On Linux and macOS it is a file without a name that the child inherits, on Windows a named mapping: in either case the
system frees it as soon as both processes are gone, however they end.
"""

from __future__ import annotations

import mmap
import os
import sys
import tempfile
import uuid

import numpy as np

_ALIGNMENT = 64


class SharedBlock:
    """`size` bytes of shared memory; `handle` is what a child process needs to attach to them."""

    def __init__(self, size: int):
        self._file = None
        if sys.platform == "win32":
            self.handle = f"ltsh-{uuid.uuid4().hex}"
            self._memory = mmap.mmap(-1, size, tagname=self.handle)
            return
        if hasattr(os, "memfd_create"):
            self._file = os.fdopen(os.memfd_create("ltsh"), "r+b")
        else:
            self._file = tempfile.TemporaryFile()
        self.handle = self._file.fileno()
        os.ftruncate(self.handle, size)
        self._memory = mmap.mmap(self.handle, size)

    @property
    def inherited(self) -> tuple[int, ...]:
        """File descriptors that the child must inherit."""
        return () if self._file is None else (self.handle,)

    def arrays(self, layout) -> dict[str, np.ndarray]:
        return arrays_in(self._memory, layout)

    def close(self) -> None:
        """Let go of the memory; arrays in it keep it until they are gone."""
        self._memory = None
        if self._file is not None:
            self._file.close()


def attach(handle, size: int) -> mmap.mmap:
    """The memory of a parent's SharedBlock."""
    if isinstance(handle, str):
        return mmap.mmap(-1, size, tagname=handle)
    return mmap.mmap(handle, size)


def layout_of(arrays: dict[str, tuple[tuple[int, ...], np.dtype]]) -> tuple[list, int]:
    """Layout [(name, shape, type, offset)] of arrays given by shape and type, and its size in bytes."""
    layout, offset = [], 0
    for name, (shape, dtype) in arrays.items():
        layout.append((name, shape, np.dtype(dtype).str, offset))
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        offset += -(-size // _ALIGNMENT) * _ALIGNMENT
    return layout, max(offset, mmap.PAGESIZE)


def arrays_in(memory, layout) -> dict[str, np.ndarray]:
    """Arrays by name in a buffer."""
    return {name: np.ndarray(shape, dtype, memory, offset) for name, shape, dtype, offset in layout}
