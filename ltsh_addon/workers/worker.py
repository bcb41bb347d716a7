"""The program of a worker process, started by path: it does one job after another until its input ends.

Messages are pickles, each after its length. Large arrays in them go through memory that both processes share. The
first message has the search path. The second is what the tasks of all jobs need. Each later one has a job, and the task
if that is a new one. The answer is the text of an error, or None, and what `task.do` returned.
"""

from __future__ import annotations

import importlib
import io
import mmap
import os
import pickle
import struct
import sys
import tempfile
import traceback
import uuid
from pathlib import Path
from pickle import Pickler

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
# Name of the package in this process: its folder's name, except in the parent, where Blender may use another name.
PACKAGE = (__package__ or "").rpartition(".")[0] or PACKAGE_FOLDER.name
_LENGTH = struct.Struct("<Q")
# Bytes of the smallest array that goes through shared memory, and of the boundaries at which arrays begin there.
SMALLEST, _ALIGNMENT = 1 << 12, 64


class SharedMemory:
    """Bytes that this process shares with one other. Either may enlarge them.

    On Linux and macOS this is a file without a name that the child inherits, on Windows a named mapping. In either case
    the system frees it as soon as both processes are gone, however they end.
    """

    def __init__(self, handle: int | None = None):
        """New memory, or that of the other process, whose file descriptor is `handle`."""
        self._file, self._bytes, self.handle = None, b"", handle
        if handle is None and sys.platform != "win32":
            is_linux = hasattr(os, "memfd_create")
            self._file = os.fdopen(os.memfd_create("ltsh"), "r+b") if is_linux else tempfile.TemporaryFile()
            self.handle = self._file.fileno()

    @property
    def size(self) -> int:
        """Number of bytes."""
        return len(self._bytes)

    def follow(self, handle: int | str | None, size: int) -> None:
        """Use the memory of the other process, which may have enlarged it to `size` bytes."""
        if isinstance(handle, str) and handle != self.handle:
            self.handle, self._bytes = handle, mmap.mmap(-1, size, tagname=handle)
        elif size != self.size:
            self._bytes = mmap.mmap(self.handle, size)

    def enlarge(self, size: int) -> None:
        """Make this memory at least `size` bytes large. What was in it may be lost."""
        if size <= self.size:
            return
        size = max(mmap.PAGESIZE, 1 << (size - 1).bit_length())
        if sys.platform == "win32":
            self.handle = f"ltsh-{uuid.uuid4().hex}"
            self._bytes = mmap.mmap(-1, size, tagname=self.handle)
        else:
            os.ftruncate(self.handle, size)
            self._bytes = mmap.mmap(self.handle, size)

    def view(self, start: int, end: int) -> memoryview:
        """The bytes from `start` to `end`."""
        return memoryview(self._bytes)[start:end]

    def close(self) -> None:
        """Release the memory. Arrays in it keep it alive until they are gone."""
        self._bytes = b""
        if self._file is not None:
            self._file.close()


class _Pickler(Pickler):
    """Sends the value alone of an array that repeats one value, and equal views once."""

    def __init__(self, file, buffer_callback):
        super().__init__(file, pickle.HIGHEST_PROTOCOL, buffer_callback=buffer_callback)
        self._views: dict[tuple, object] = {}

    def reducer_override(self, value):
        numpy = sys.modules.get("numpy")
        if numpy is None or type(value) is not numpy.ndarray or value.nbytes < SMALLEST or value.dtype.hasobject:
            return NotImplemented
        if not any(value.strides):
            return numpy.broadcast_to, (value.flat[0], value.shape)
        key = value.__array_interface__["data"][0], value.shape, value.strides, value.dtype.str
        first = self._views.setdefault(key, value)
        return NotImplemented if first is value else (numpy.asarray, (first,))


def packed(message, buffers: list | None = None) -> bytes:
    """A pickle of a message. Large arrays are appended to `buffers` if there is such a list."""

    def is_small(buffer) -> bool:
        if buffer.raw().nbytes >= SMALLEST:
            buffers.append(buffer.raw())
        return buffer.raw().nbytes < SMALLEST

    stream = io.BytesIO()
    _Pickler(stream, None if buffers is None else is_small).dump(message)
    return stream.getvalue()


class _Unpickler(pickle.Unpickler):
    """Finds modules of the other process, which knows the package as `package`, under their name in this process."""

    def __init__(self, stream, package, buffers=()):
        super().__init__(stream, buffers=buffers)
        self.package = package

    def find_class(self, module, name):
        if self.package and (module + ".").startswith(self.package + "."):
            module = PACKAGE + module[len(self.package) :]
        return super().find_class(module, name)


def unpacked(data: bytes, package: str):
    """What `packed` was given by a process that knows the package as `package`."""
    return _Unpickler(io.BytesIO(data), package).load()


class Channel:
    """Messages to and from one other process, which knows the package as `package`."""

    def __init__(self, output, source, memory: SharedMemory, package: str = ""):
        self._output, self._source, self._memory, self.package = output, source, memory, package
        self._end = 0  # of what the latest message received has in the memory

    def send(self, message) -> None:
        """Write one message. Arrays of the latest message received stay as they are."""
        buffers: list[memoryview] = []
        data, spans = packed(message, buffers), []
        for buffer in buffers:
            start = -(-(spans[-1][1] if spans else self._end) // _ALIGNMENT) * _ALIGNMENT
            spans.append((start, start + buffer.nbytes))
        memory = self._memory
        if spans and spans[-1][1] > memory.size:
            memory.enlarge(spans[-1][1])
        for span, buffer in zip(spans, buffers, strict=True):
            memory.view(*span)[:] = buffer
        self._end = 0
        for block in (packed((memory.handle, memory.size, spans)), data):
            self._output.write(_LENGTH.pack(len(block)))
            self._output.write(block)
        self._output.flush()

    def receive(self):
        """Read one message. Its large arrays are valid until the answer to the next `send`.

        Raises EOFError if the other process is gone.
        """
        handle, size, spans = unpacked(self._read(), "")
        self._memory.follow(handle, size)
        self._end = spans[-1][1] if spans else 0
        buffers = [self._memory.view(*span) for span in spans]
        return _Unpickler(io.BytesIO(self._read()), self.package, buffers).load()

    def _read(self) -> bytes:
        header = self._source.read(_LENGTH.size)
        length = _LENGTH.unpack(header)[0] if len(header) == _LENGTH.size else 0
        data = self._source.read(length)
        if not length or len(data) < length:
            raise EOFError("the other process has ended")
        return data


def _serve(channel: Channel) -> None:
    path, channel.package = channel.receive()
    # Use the parent's search path, so that numpy is the same. A script would put its own folder first.
    sys.path[:] = [str(PACKAGE_FOLDER.parent), *path]
    importlib.import_module(PACKAGE_FOLDER.name)
    context, task = unpacked(channel.receive(), channel.package), None
    channel.send((None, None))
    while True:
        new_task, job = channel.receive()
        try:
            if new_task is not None:
                task = unpacked(new_task, channel.package)
            answer = None, task.do(job, context)
        except Exception:
            answer = traceback.format_exc(), None
        channel.send(answer)


def main() -> None:
    """Serve the parent on standard input and output. Whatever else is printed goes to the error output."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    handle = int(sys.argv[1]) if sys.argv[1:] else None
    try:
        _serve(Channel(answers, sys.stdin.buffer, SharedMemory(handle)))
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        pass
    # Nothing is left to save. An orderly end might print, and the reader may be gone with the parent.
    os._exit(0)


if __name__ == "__main__":
    main()
