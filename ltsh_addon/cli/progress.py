"""What the command line says: a bar and lines of a log meanwhile, documents on stdout."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from ..imaging.report import json_text
from ..scene import shortened


class RunLog:
    """Lines for the file `path`; without one they go nowhere. A context, which closes it.

    A log that cannot be written does not end what it is about: `problem` then says why, and no more is written.
    """

    def __init__(self, path: Path | None):
        self._path, self._file, self.problem = path, None, None
        try:
            # Unbuffered, so that a line is one write, however long: several shards may write to one log.
            self._file = None if path is None else open(path, "ab", buffering=0)
        except OSError as error:
            self._fail(error)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *exception) -> None:
        if self._file is not None:
            self._file.close()

    def line(self, text: str) -> None:
        """Append a line, with the time."""
        if self._file is not None and self.problem is None:
            stamp = datetime.now().astimezone().isoformat(timespec="seconds")
            try:
                # Names of files may hold bytes that are no UTF-8.
                self._file.write(f"{stamp} {' '.join(text.split())}\n".encode(errors="backslashreplace"))
            except OSError as error:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.problem = f"log {self._path}: cannot be written ({error.strerror}); choose another with --log"


BAR_WIDTH = 28
LONGEST_LINE = 1000
# Seconds between two drawings of the bar, and between two lines of a log that tell that a long stage goes on.
BAR_INTERVAL, LOG_INTERVAL = 0.1, 10.0


class ProgressBar:
    """Callable as progress(stage, fraction); `finish` ends the line.

    Of a job with several tasks, announced by `begin_task`, it shows where the job stands, and the stage beside it.
    """

    def __init__(self, stream, *, quiet: bool = False, log: RunLog | None = None):
        self._stream = stream
        self.log = log or RunLog(None)
        self._task, self._tasks = 0, 1
        self._quiet = quiet or stream is None  # print would take None for stdout
        self._terminal = bool(getattr(stream, "isatty", lambda: False)())
        self._stage = None
        self._stage_start = 0.0
        self._fraction = 0.0
        self._last_shown = 0.0
        self._line_open = False

    def __call__(self, stage: str, fraction: float) -> bool:
        """Show where `stage` stands, fraction in [0, 1]; returns True: a bar never stops the work."""
        if self._quiet:
            return True
        now = time.monotonic()
        if self._tasks > 1:
            if self._terminal and now - self._last_shown > BAR_INTERVAL:
                self._last_shown = now
                self._draw(f"{self._task} of {self._tasks} {stage}", (self._task - 1) / self._tasks, now)
            return True
        if stage != self._stage:
            if self._line_open and self._fraction < 1.0:  # many stages end without a last word
                self._draw(self._stage, 1.0, now)
            self.finish()
            self._stage, self._stage_start, self._last_shown = stage, now, -1e9
        self._fraction = fraction
        if fraction >= 1.0 or now - self._last_shown > (BAR_INTERVAL if self._terminal else LOG_INTERVAL):
            self._last_shown = now
            if self._terminal:
                self._draw(stage, fraction, now)
            else:
                self._say(f"{stage}: {100.0 * fraction:.0f} % {self._remaining(fraction, now)}".rstrip())
        return True

    def begin_job(self, label: str) -> None:
        """Another job begins: a line, unless quiet."""
        self.finish()
        self._tasks, self._stage = 1, None
        self.log.line(label)
        if not self._quiet:
            self._say(label)

    def begin_task(self, number: int, tasks: int) -> None:
        """Task `number`, from 1, of so many begins."""
        if number == 1:
            self.finish()
            self._stage_start = time.monotonic()
        self._task, self._tasks = number, tasks

    def end_task(self, name: str, seconds: float, failed: bool = False) -> None:
        """The task has ended; where the stream is no terminal, that is a line."""
        name = f"{name} failed" if failed else name
        self.log.line(f"{self._task} of {self._tasks}: {name} in {seconds:.1f} s")
        if self._quiet or self._tasks == 1:
            return
        now, share = time.monotonic(), self._task / self._tasks
        if self._terminal:
            self._draw(f"{self._task} of {self._tasks} {name}", share, now)
        else:
            left = "" if self._task == self._tasks else self._remaining(share, now)
            self._say(f"{self._task} of {self._tasks}: {name} in {seconds:.1f} s {left}".rstrip())
        if self._task == self._tasks:
            self.finish()
            self._tasks = 1

    def remark(self, text: str) -> None:
        """Print a line, unless quiet, and log it."""
        self.finish()
        self.log.line(text)
        if not self._quiet:
            self._say(text)

    def note(self, text: str) -> None:
        """Print a line that is no progress, also when quiet, and log it.

        It may hold names from files of others: those do not speak to the terminal.
        """
        self.finish()
        text = shortened(" ".join(text.split()), LONGEST_LINE)
        text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
        self._say(text)
        self.log.line(text)

    def _draw(self, stage, fraction, now):
        filled = round(min(max(fraction, 0.0), 1.0) * BAR_WIDTH)
        bar = "#" * filled + "-" * (BAR_WIDTH - filled)
        text = f"{stage:<24.24} [{bar}] {100.0 * fraction:3.0f} % {self._remaining(fraction, now)}"
        self._write(f"\r{text:<79}")
        self._line_open = True

    def _remaining(self, fraction, now) -> str:
        elapsed = now - self._stage_start
        if fraction >= 1.0:
            return f"({elapsed:.1f} s)"
        if elapsed < 1.0 or fraction < 0.02:
            return ""
        return f"({duration(elapsed / fraction - elapsed)} left)"

    def finish(self) -> None:
        """End the current line, so that what follows starts on its own."""
        if self._line_open:
            self._write("\n")
            self._line_open = False

    def _say(self, text: str) -> None:
        self._write(f"{text}\n")

    def _write(self, text: str) -> None:
        """Nobody is left to be told where the stream takes no more: its terminal is closed, its disk is full."""
        if self._stream is not None:
            try:
                self._stream.write(_in_letters_of(self._stream, text))
                self._stream.flush()
            except OSError:
                self._stream, self._quiet = None, True


def duration(seconds: float) -> str:
    """Seconds as people read them: 40 s, 12 min, 3.3 h."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"


def print_out(text: str) -> None:
    """Print on stdout, if there is one, at once. Raises OSError where it takes no more, and nothing goes there then."""
    stdout = sys.stdout
    if stdout is None:
        return
    try:
        stdout.write(_in_letters_of(stdout, f"{text}\n"))
        stdout.flush()
    except OSError as error:
        # What is left in its buffer would raise again at the end of the process.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stdout.fileno())
        raise OSError(f"stdout: cannot be written ({error.strerror})") from error


def print_json(document) -> None:
    """One document on stdout, in ASCII: a redirected stdout may lack the letters of a light's name."""
    print_out(json.dumps(json.loads(json_text(document)), indent=2))


def _in_letters_of(stream, text: str) -> str:
    """Letters that the encoding of the stream lacks are spelled out."""
    encoding = stream.encoding or "ascii"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def reserve_stdout() -> None:
    """Keep stdout for what sys.stdout prints: from now on, Blender's own lines (from C) go to stderr."""
    if sys.stdout is None:
        return
    sys.stdout.flush()
    ours = os.dup(1)
    os.dup2(2, 1)
    sys.stdout = open(ours, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors, buffering=1)


REPORT_SECONDS = 0.1


class MessageProgress(ProgressBar):
    """Sends progress as {"stage", "fraction"} a few times per second; keeps the commands' other lines as `notes`."""

    def __init__(self, send: Callable[[dict], None]):
        super().__init__(None)
        self._send, self._last = send, 0.0
        self.notes: list[str] = []

    def __call__(self, stage: str, fraction: float) -> bool:
        now = time.monotonic()
        if stage != self._stage:
            self._stage, self._last = stage, 0.0
        if fraction >= 1.0 or now - self._last >= REPORT_SECONDS:
            self._last = now
            self._send({"stage": stage, "fraction": fraction})
        return True

    def note(self, text: str) -> None:
        """Keep the line."""
        self.notes.append(text)
