"""The program of a worker process, started by path: it does one job after another until its input ends.

Messages are pickles, each after its length. The first message has the search path. The second is what the tasks of all
jobs need. Each later one has a job, and the task if that is a new one. The answer is the text of an error, or None, and
what `task.do` returned.
"""

import importlib
import io
import os
import pickle
import struct
import sys
import traceback
from pathlib import Path
from pickle import Pickler

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
# Name of the package in this process: its folder's name, except in the parent, where Blender may use another name.
PACKAGE = (__package__ or "").rpartition(".")[0] or PACKAGE_FOLDER.name
_LENGTH = struct.Struct("<Q")
SMALLEST = 1 << 12  # bytes of the smallest array that is sent in another way than numpy's own


class _Pickler(Pickler):
    """Sends the value alone of an array that repeats one value, and equal views once."""

    def __init__(self, file):
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
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


def packed(message) -> bytes:
    """A pickle of a message."""
    stream = io.BytesIO()
    _Pickler(stream).dump(message)
    return stream.getvalue()


class _Unpickler(pickle.Unpickler):
    """Finds modules of the other process, which knows the package as `package`, under their name in this process."""

    def __init__(self, stream, package):
        super().__init__(stream)
        self.package = package

    def find_class(self, module, name):
        if self.package and (module + ".").startswith(self.package + "."):
            module = PACKAGE + module[len(self.package) :]
        return super().find_class(module, name)


def unpacked(data: bytes, package: str):
    """What `packed` was given by a process that knows the package as `package`."""
    return _Unpickler(io.BytesIO(data), package).load()


class Channel:
    """Messages to and from one other process, which knows the package as `package`.

    Through memory that both processes share, `shade` would save less than a hundredth of its processor time.
    """

    def __init__(self, output, source, package: str = ""):
        self._output, self._source, self.package = output, source, package

    def send(self, message) -> None:
        """Write one message."""
        data = packed(message)
        self._output.write(_LENGTH.pack(len(data)))
        self._output.write(data)
        self._output.flush()

    def receive(self):
        """Read one message. Raises EOFError if the other process is gone."""
        header = self._source.read(_LENGTH.size)
        length = _LENGTH.unpack(header)[0] if len(header) == _LENGTH.size else 0
        data = self._source.read(length)
        if not length or len(data) < length:
            raise EOFError("the other process has ended")
        return unpacked(data, self.package)


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
    try:
        _serve(Channel(answers, sys.stdin.buffer))
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        pass
    # Nothing is left to save. An orderly end might print, and the reader may be gone with the parent.
    os._exit(0)


if __name__ == "__main__":
    main()
