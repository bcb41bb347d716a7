"""The output of the command line: a progress bar, a log, and documents on stdout."""

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
    """Context: a log in the file `path`; None: no log.

    A log that cannot be written does not stop the command: `problem` says why, and nothing more is written.
    """

    def __init__(self, path: Path | None):
        self._path, self._file, self.problem = path, None, None
        try:
            # Unbuffered, so that every line is a single write: several shards may write to one log.
            self._file = None if path is None else open(path, "ab", buffering=0)
        except OSError as error:
            self._fail(error)

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, *exception) -> None:
        if self._file is not None:
            self._file.close()

    def line(self, text: str) -> None:
        """Append a line, with the time."""
        if self._file is not None and self.problem is None:
            stamp = datetime.now().astimezone().isoformat(timespec="seconds")
            try:
                # File names may have bytes that are not UTF-8.
                self._file.write(f"{stamp} {' '.join(text.split())}\n".encode(errors="backslashreplace"))
            except OSError as error:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.problem = f"log {self._path}: cannot be written ({error.strerror}); choose another with --log"


BAR_WIDTH = 28
LONGEST_LINE = 1000
# Seconds between two updates: of the bar on a terminal, and of the lines of a long stage on other streams.
BAR_INTERVAL, LOG_INTERVAL = 0.1, 10.0


class ProgressBar:
    """Callable as progress(stage, fraction); `finish` ends the line.

    For a job with several tasks, announced by `begin_task`, it shows the progress of the job, with the stage beside it.
    """

    def __init__(self, stream, *, quiet: bool = False, log: RunLog | None = None):
        self._stream = stream
        self.log = log or RunLog(None)
        self._task, self._tasks = 0, 1
        self._quiet = quiet or stream is None  # print would take None for stdout
        self._terminal = bool(getattr(stream, "isatty", lambda: False)())
        self._stage, self._line_open = None, False
        self._stage_start = self._fraction = self._last_shown = 0.0
        self.watch: Callable = lambda state: None  # called with each `TaskState`

    def __call__(self, stage: str, fraction: float) -> bool:
        """Show the progress of `stage`, a fraction in [0, 1]. Always returns True, since a bar never stops the work."""
        if self._quiet:
            return True
        now = time.monotonic()
        if self._tasks > 1:
            if self._terminal and now - self._last_shown > BAR_INTERVAL:
                self._last_shown = now
                self._draw(f"{self._task} of {self._tasks} {stage}", (self._task - 1) / self._tasks, now)
            return True
        if stage != self._stage:
            if self._line_open and self._fraction < 1.0:  # many stages never report their end
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
        """Begin another job: print a line, unless quiet, and log it."""
        self._tasks, self._stage = 1, None
        self.remark(label)

    def begin_task(self, number: int, tasks: int) -> None:
        """Begin task `number` of `tasks`, counted from 1."""
        if number == 1:
            self.finish()
            self._stage_start = time.monotonic()
        self._task, self._tasks = number, tasks

    def end_task(self, name: str, seconds: float, failed: bool = False) -> None:
        """End the task: update the bar, or print a line if the stream is not a terminal; and log it."""
        name = f"{name} failed" if failed else name
        self.log.line(f"{self._task} of {self._tasks}: {name} in {seconds:.1f} s")
        if self._quiet or self._tasks == 1:
            return
        now, share = time.monotonic(), self._task / self._tasks
        if self._terminal:
            self._draw(f"{self._task} of {self._tasks} {name}", share, now)
        else:
            remaining = "" if self._task == self._tasks else self._remaining(share, now)
            self._say(f"{self._task} of {self._tasks}: {name} in {seconds:.1f} s {remaining}".rstrip())
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
        """Print a line that is not progress, even if quiet, and log it.

        Control characters are escaped, since names from other people's files must not control the terminal.
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
        left = elapsed / fraction - elapsed
        if left < 100.0:
            return f"({left:.0f} s left)"
        return f"({left / 60.0:.0f} min left)" if left < 6000.0 else f"({left / 3600.0:.1f} h left)"

    def finish(self) -> None:
        """End the current line, so that further output starts on a new one."""
        if self._line_open:
            self._write("\n")
            self._line_open = False

    def _say(self, text: str) -> None:
        self._write(f"{text}\n")

    def _write(self, text: str) -> None:
        """Write to the stream. If that fails (closed terminal, full disk), stay silent from then on."""
        if self._stream is not None:
            try:
                self._stream.write(_in_letters_of(self._stream, text))
                self._stream.flush()
            except OSError:
                self._stream, self._quiet = None, True


def print_out(text: str) -> None:
    """Print on stdout, if there is one, and flush. Raises OSError if that fails; later output is discarded then."""
    stdout = sys.stdout
    if stdout is None:
        return
    try:
        stdout.write(_in_letters_of(stdout, f"{text}\n"))
        stdout.flush()
    except OSError as error:
        # The rest of the buffer would raise again at the end of the process.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stdout.fileno())
        raise OSError(f"stdout: cannot be written ({error.strerror})") from error


def print_json(document) -> None:
    """Print a document on stdout, in ASCII: the encoding of a redirected stdout may lack characters of names."""
    print_out(json.dumps(json.loads(json_text(document)), indent=2))


def _in_letters_of(stream, text: str) -> str:
    """`text` with characters escaped that the encoding of the stream lacks."""
    encoding = stream.encoding or "ascii"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def reserve_stdout() -> None:
    """Reserve stdout for sys.stdout: from now on, Blender's own lines (from C) go to stderr."""
    if sys.stdout is None:
        return
    sys.stdout.flush()
    ours = os.dup(1)
    os.dup2(2, 1)
    sys.stdout = open(ours, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors, buffering=1)


REPORT_SECONDS = 0.1


class MessageProgress(ProgressBar):
    """Sends progress as {"stage", "fraction"} a few times per second, and collects all other lines as `notes`."""

    def __init__(self, send: Callable[[dict], None]):
        super().__init__(None)
        self._send, self._last = send, 0.0
        self.expect = lambda seconds: send({"expected": seconds})
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
        """Append the line to `notes`."""
        self.notes.append(text)
