"""The program of a worker process, started by path: it does one piece of work after another until its input ends.

Messages are pickles, each after its length. The first message has the search path and names the class that does the
work. The second is the task. Each later one goes to the class's `shade`, for example that of
`workers.pool.ChildSide`. The answer is the result, or the text of an error.
"""

from __future__ import annotations

import importlib
import io
import os
import pickle
import struct
import sys
import traceback
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
# Name of the package in this process: its folder's name, except in the parent, where Blender may use another name.
PACKAGE = (__package__ or "").rpartition(".")[0] or PACKAGE_FOLDER.name
_LENGTH = struct.Struct("<Q")


def packed(message) -> bytes:
    """A message in the form that `send` accepts too. Use it if the message may change before it is sent."""
    return pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)


def send(stream, message) -> None:
    """Write one message."""
    data = message if isinstance(message, bytes) else packed(message)
    stream.write(_LENGTH.pack(len(data)))
    stream.write(data)
    stream.flush()


class _Unpickler(pickle.Unpickler):
    """Finds modules of the other process, which knows the package as `package`, under their name in this process."""

    def __init__(self, stream, package):
        super().__init__(stream)
        self.package = package

    def find_class(self, module, name):
        if self.package and (module + ".").startswith(self.package + "."):
            module = PACKAGE + module[len(self.package) :]
        return super().find_class(module, name)


def receive(stream, package: str = ""):
    """Read one message from a process that knows the package as `package`. Raises EOFError if that process is gone."""
    header = stream.read(_LENGTH.size)
    if len(header) < _LENGTH.size:
        raise EOFError("the other process has ended")
    (length,) = _LENGTH.unpack(header)
    data = stream.read(length)
    if len(data) < length:
        raise EOFError("the other process has ended")
    return _Unpickler(io.BytesIO(data), package).load()


def _serve(commands, answers) -> None:
    first = receive(commands)
    # Use the parent's search path, so that numpy is the same. A script would put its own folder first.
    sys.path[:] = [str(PACKAGE_FOLDER.parent), *first["path"]]
    module, _, name = first["side"].rpartition(".")
    side_class = getattr(importlib.import_module(f"{PACKAGE_FOLDER.name}.{module}"), name)
    side = side_class(receive(commands, first["package"]), *first["arguments"])
    send(answers, None)
    while True:
        message = receive(commands, first["package"])
        try:
            answer = side.shade(message)
        except Exception:
            answer = traceback.format_exc()
        send(answers, answer)


def main() -> None:
    """Serve the parent on standard input and output. Whatever else is printed goes to the error output."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        _serve(sys.stdin.buffer, answers)
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        pass
    # Nothing is left to save. An orderly end might print, and the reader may be gone with the parent.
    os._exit(0)


if __name__ == "__main__":
    main()
