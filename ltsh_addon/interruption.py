"""Ctrl-C and SIGTERM as exceptions, so that any command cleans up and ends within seconds."""

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# PATIENCE_SECONDS: after a signal the process is ended if it has not cleaned up by then.
PATIENCE_SECONDS = 3.0
_WORDS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "the terminal is gone"}
_NUMBERS = {getattr(signal, name): text for name, text in _WORDS.items() if hasattr(signal, name)}


class Interrupted(KeyboardInterrupt):
    """A signal has arrived; `code` is its conventional exit code, 128 + its number."""

    def __init__(self, number: int):
        super().__init__(_NUMBERS[number])
        self.code = 128 + number


def exit_code(error: KeyboardInterrupt) -> int:
    """130 for Ctrl-C, 143 for SIGTERM."""
    return getattr(error, "code", 128 + signal.SIGINT)


def message(error: KeyboardInterrupt) -> str:
    """What happened, in a few words: "interrupted", "terminated"."""
    return str(error) or _NUMBERS[signal.SIGINT]


@contextmanager
def raised(program: str) -> Iterator[None]:
    """Context in which the first signal raises Interrupted in the main thread; further signals are ignored.

    If cleaning up takes too long, `program` says so on stderr and the process ends at once; child processes then end by
    themselves. Ignored signals stay ignored. Outside of the main thread, or within another `raised`, it does nothing.
    """
    handlers = {number: signal.getsignal(number) for number in _NUMBERS}
    ours = any(getattr(handler, "raises", False) for handler in handlers.values())
    if ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: handler for number, handler in handlers.items() if handler != signal.SIG_IGN}
    received = []

    def stop(number, frame):
        if not received:
            received.append(number)
            raise Interrupted(number)

    stop.raises = True
    with _watched(program):
        for number in handlers:
            signal.signal(number, stop)
        try:
            yield
        finally:
            for number, handler in handlers.items():
                # None is Blender's own handler, which Python cannot restore; Blender quits after the command anyway.
                signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def _watched(program):
    """Context with a thread that ends this process PATIENCE_SECONDS after a signal.

    It is needed because the main thread may be in C code, where no exception is raised.
    """
    reading, writing = socket.socketpair()
    writing.setblocking(False)
    finished = threading.Event()

    def watch():
        with reading:
            number = next((byte[0] for byte in iter(lambda: reading.recv(1), b"") if byte[0] in _NUMBERS), None)
            if number is None or finished.wait(PATIENCE_SECONDS):
                return
        if sys.stderr is not None:
            os.write(2, f"{program}: {_NUMBERS[number]}\n".encode())
        os._exit(128 + number)

    before = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=watch, name="ltsh-signals", daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        signal.set_wakeup_fd(before)
        writing.close()  # the end of what the thread reads
