"""One long job beside a running Blender: a second process, what it reports, and how it is stopped. Imports no bpy.

Nothing here waits: a thread reads what the process says, and `Job.poll` takes it from there.
"""

from __future__ import annotations

import importlib.util
import json
import queue
import shutil
import subprocess
import tempfile
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

from ..processes import blender_process
from .job_plan import Plan

SCRIPT = Path(__file__).resolve().parents[2] / "jobs" / "job_worker.py"
MESSAGE = "LTSH "
ENDING_SECONDS = 10.0
STARTING = "Starting"
SURE_SECONDS = 3.0  # before, nobody knows how long it will take


@dataclass
class Job:
    """A job that runs, has ended (`finished`), or was `cancelled`.

    `results` are the folders of pictures so far, `error` is "" or one line that says why there are no more. Of the
    results the window has `shown` so many; they belong to the scene with the session uid `scene`.
    """

    title: str
    plan: Plan
    folder: Path  # temporary, removed at the end
    command: str  # shade, compare or bake
    scene: int
    shown: int = 0
    output: Path | None = None  # where files for the user go
    stage: str = STARTING
    results: list[Path] = field(default_factory=list)
    error: str = ""
    finished: bool = False
    cancelled: bool = False
    started: float = field(default_factory=time.monotonic)

    def start(self, runs: list[dict], *, background: bool) -> None:
        """Start the process on command lines (see `job_steps.perform`); one in the `background` comes after this one.
        Raises SceneError and OSError."""
        job = self.folder / "job.json"
        document = {"runs": runs, "path": _library_folders(), "temporary": str(self.folder)}
        job.write_text(json.dumps(document), encoding="utf-8")
        self._messages: queue.SimpleQueue = queue.SimpleQueue()
        command = blender_process.child_command(job, SCRIPT)
        self._process = blender_process.start(command, self.folder, background=background)
        threading.Thread(target=self._listen, name="ltsh-job", daemon=True).start()

    def _listen(self) -> None:
        last_lines: deque[str] = deque(maxlen=blender_process.OUTPUT_LINES_KEPT)
        with self._process.stdout:
            for line in self._process.stdout:
                message = parsed(line)
                if message is not None:
                    self._messages.put(message)
                elif line.strip():
                    last_lines.append(line.strip())
        code = self._process.wait()
        self._process.stdin.close()
        if code != 0:
            output = " | ".join(last_lines) or "none"
            self._messages.put({"error": f"Blender ended with code {code}; its last output: {output}"})
        self._messages.put({"end": True})

    def poll(self) -> bool:
        """Take in what the process has said since; True where that is anything."""
        changed = False
        while not self.finished:
            try:
                message = self._messages.get_nowait()
            except queue.Empty:
                break
            changed = True
            self._take(message)
        return changed

    def _take(self, message: dict) -> None:
        if "stage" in message:
            self.stage = message["stage"]
            self.plan.report(self.stage, float(message["fraction"]))
        elif "result" in message:
            self.results.append(Path(message["result"]))
        elif "error" in message:
            self.error = self.error or message["error"]
        elif "end" in message:
            self.finished = True
            self.remove_folder()

    def wait(self, seconds: float = 0.05) -> None:
        """Poll until the job has ended."""
        while not self.finished:
            if not self.poll():
                time.sleep(seconds)

    def cancel(self) -> None:
        """Stop at once; the process ends, and its folder goes, in the background."""
        if self.finished:
            return
        self.finished = self.cancelled = True
        # No daemon: a Blender that quits now waits for it.
        threading.Thread(target=self._end, name="ltsh-job-end").start()

    def _end(self) -> None:
        # What the process has started itself ends with it: each of them reads the other end of a pipe.
        self._process.stdin.close()
        try:
            self._process.wait(ENDING_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.remove_folder()

    def end_now(self) -> None:
        """As `cancel`, for a Blender that is about to quit: everything is gone on return."""
        if not self.finished:
            self.finished = self.cancelled = True
            self._process.kill()
            self._end()

    def remove_folder(self) -> None:
        """Remove what the job wrote for itself."""
        shutil.rmtree(self.folder, ignore_errors=True)

    # -- what is shown ------------------------------------------------------------------------------------------------

    def seconds_left(self) -> float | None:
        """Until the end; None where nothing can be said yet."""
        return None if self.seconds() < SURE_SECONDS else self.plan.seconds_left()

    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self.started


def new_folder() -> Path:
    """A temporary folder for a job."""
    return Path(tempfile.mkdtemp(prefix="ltsh-"))


def parsed(line: str) -> dict | None:
    """The message that `line` carries, or None for anything else that a process prints."""
    if not line.startswith(MESSAGE):
        return None
    try:
        message = json.loads(line[len(MESSAGE) :])
    except ValueError:
        return None
    return message if isinstance(message, dict) else None


def clock(seconds: float) -> str:
    """`seconds` as 0:07 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _library_folders() -> list[str]:
    """Where the process finds what this Blender got with the extension."""
    spec = importlib.util.find_spec("OpenEXR")
    return [str(Path(spec.origin).parent)] if spec is not None and spec.origin else []
