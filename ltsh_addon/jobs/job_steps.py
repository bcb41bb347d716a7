"""The work behind Blender's panels, in a second process: command lines one after another, their results as images.

Every line on stdout that starts with "LTSH " carries a JSON document: {"stage", "fraction"} while a command works,
{"result": folder} once the images of a command are there, {"error": text} where it failed.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
import threading
import time
from pathlib import Path

from .. import cli
from ..commands.progress_bar import ProgressBar
from ..comparison import display_layers

MESSAGE = "LTSH "
REPORT_SECONDS = 0.1


class LineProgress(ProgressBar):
    """Progress as messages on a stream, a few per second.

    `notes` are what the commands had to say besides.
    """

    def __init__(self, stream):
        super().__init__(None)
        self._messages, self._last = stream, 0.0
        self.notes: list[str] = []

    def __call__(self, stage: str, fraction: float) -> bool:
        now = time.monotonic()
        if stage != self._stage:
            self._stage, self._last = stage, 0.0
        if fraction >= 1.0 or now - self._last >= REPORT_SECONDS:
            self._last = now
            self.send({"stage": stage, "fraction": fraction})
        return True

    def note(self, text: str) -> None:
        """Keep the line."""
        self.notes.append(text)

    def send(self, document: dict) -> None:
        """One message; all of it or, where the reader is gone, nothing."""
        self._messages.write(MESSAGE + json.dumps(document) + "\n")
        self._messages.flush()


def perform(job: dict, stream) -> None:
    """Run the command lines of job["runs"], each {"arguments", "output", "partial"}, until one fails; job["temporary"]
    is the folder of the job."""
    from ..blender.processes.priority import weigh_session

    _end_with_parent(Path(job["temporary"]))
    weigh_session()
    progress = LineProgress(stream)
    for run in job["runs"]:
        report, complaint = _command(run["arguments"], progress)
        if report is None:
            progress.send({"error": complaint})
            return
        progress("images", 0.0)
        try:
            folder = display_layers.write(run["arguments"][0], Path(run["output"]), report, run["partial"])
        except (OSError, ValueError, MemoryError) as error:
            progress.send({"error": str(error) or type(error).__name__})
            return
        progress.send({"result": str(folder)})


def _end_with_parent(folder: Path) -> None:
    """End this process as soon as the Blender that started it closes our stdin, or is gone; its temporary `folder` goes
    too, since one that was killed cannot remove it."""

    def watch():
        while sys.stdin.buffer.read(1):
            pass
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def _command(arguments: list[str], progress: LineProgress) -> tuple[dict | None, str]:
    """The report of a command line, None where it failed, and the last thing that it said."""
    progress.notes.clear()
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([*arguments, "--json"], bar=progress)
    lines = progress.notes or [line.strip() for line in err.getvalue().splitlines() if line.strip()]
    complaint = lines[-1] if lines else f"the command ended with code {code}"
    try:
        document = json.loads(out.getvalue())
    except ValueError:
        document = {"errors": lines}
    # A bake that left objects out ends with code 1 and has a report all the same.
    return (None, complaint.removeprefix("ltsh: ")) if "errors" in document else (document, complaint)
