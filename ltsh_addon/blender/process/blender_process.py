"""Processes in the background leave the processor to the window. Imports no bpy."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable
from contextvars import ContextVar
from pathlib import Path

from ...scene import Cancelled, Progress, SceneError

NICENESS = 10
# Linux weighs sessions against each other, and niceness only within one (sched(7), "The autogroup feature").
AUTOGROUP = Path("/proc/self/autogroup")
# It takes one change in so many seconds, from all users together.
AUTOGROUP_SECONDS = 0.1
_TRIES = 5


def background_options() -> dict:
    """Options of `subprocess.Popen` for a process that comes after this one; `yield_to_us` does the rest."""
    flags = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)  # Windows: its own children inherit it
    return {"creationflags": flags} if flags else {}


def yield_to_us(pid: int) -> None:
    """Let the process `pid`, which was started just now, come after this one; threads that it starts inherit that."""
    if hasattr(os, "setpriority"):
        with contextlib.suppress(OSError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, pid, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)


def weigh_session() -> None:
    """Give the session that this process leads the weight that its niceness says."""
    niceness = os.nice(0) if hasattr(os, "nice") else 0
    for _ in range(_TRIES if niceness > 0 else 0):
        try:
            AUTOGROUP.write_text(str(niceness), encoding="ascii")
            return
        except BlockingIOError:
            time.sleep(AUTOGROUP_SECONDS)
        except OSError:  # no Linux, or one without sessions' weights
            return


MOST = 8


def listed(names: Iterable[str]) -> str:
    """At most 8 of `names` in quotes and how many more there are; "none" for no names."""
    names = list(names)
    text = ", ".join(map(repr, names[:MOST])) or "none"
    return f"{text} and {len(names) - MOST} more" if len(names) > MOST else text


WORKER = Path(__file__).with_name("worker.py")
OUTPUT_LINES_KEPT = 12
BPY_FOR_PYTHON = {(3, 11): "4.5.15", (3, 13): "5.2.3"}


def disk_is_full(error: OSError) -> bool:
    """True where nothing more can be written: the disk is full, or the quota, or the file as large as may be."""
    return error.errno in (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", None))


def no_room(folder: Path, error: OSError) -> str:
    """What to say of an error that is `disk_is_full` in a temporary folder."""
    remedy = "make room, or let TMPDIR name another folder"
    return f"{folder.parent}: no room for temporary files ({error.strerror}); {remedy}"


def child_command(job: Path, script: Path = WORKER) -> list[str]:
    """The command that runs `script` on `job`: this Blender's own binary, or this Python with pip's bpy."""
    bpy = sys.modules.get("bpy")
    binary = bpy.app.binary_path if bpy is not None else ""
    if binary:
        return [
            *(binary, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1"),
            *("--python", str(script), "--", str(job)),
        ]
    if bpy is None and importlib.util.find_spec("bpy") is None:
        wanted = BPY_FOR_PYTHON.get(sys.version_info[:2])
        other = "use Python 3.13 and pip install bpy==5.2.3, or run inside Blender"
        remedy = f"pip install bpy=={wanted}" if wanted else other
        raise SceneError(f"{sys.executable} has no module bpy, which opens .blend files: {remedy}")
    return [sys.executable, str(script), str(job)]


def start(command: list[str], folder: Path, *, background: bool = False) -> subprocess.Popen:
    """`command` as a process whose own files go to `folder`; the end of its stdin tells it that we are gone.

    One in the `background` comes after this process wherever both want the processor.
    """
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        cwd=folder,
        # The user's preferences and start-up files have no say in the result.
        # Blender leaves its own temporary folder behind when it is ended: ours goes with all that is in it.
        env={
            **os.environ,
            **dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder)),
            "BLENDER_USER_RESOURCES": str(folder / "user"),
            "PYTHONUNBUFFERED": "1",
        },
        # Ctrl-C goes to the parent alone, which ends the child.
        start_new_session=True,
        **(background_options() if background else {}),
    )
    if background:
        yield_to_us(process.pid)
    return process


class BlenderProcess:
    """Runs worker.py, from the first job on; `folder` takes all that Blender writes on its own."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._child: subprocess.Popen | None = None

    def do(self, job: dict, folder: Path, progress: Progress | None) -> dict:
        """Do `job` in `folder`, report its progress; the manifest that was written. After an error Blender is ended."""
        job_path = folder / "job.json"
        temporary = [str(self._folder), str(folder)]
        job_path.write_text(json.dumps({**job, "watch_parent": True, "temporary": temporary}), encoding="utf-8")
        last_lines: deque[str] = deque(maxlen=OUTPUT_LINES_KEPT)
        try:
            self._hand_over(job_path)
            self._follow(progress, last_lines)
            return self._read_manifest(folder / "manifest.json", last_lines)
        except BaseException:
            self.end()
            raise

    def _hand_over(self, job_path: Path) -> None:
        """Give the job to the Blender that waits, or to a new one."""
        if self._child is not None:
            try:
                self._child.stdin.write(f"{job_path}\n")
                self._child.stdin.flush()
                return
            except OSError:  # it is gone
                self.end()
        self._child = start(child_command(job_path), self._folder)

    def _follow(self, progress, last_lines) -> None:
        """Report progress until the job is done, or Blender has ended."""
        for line in self._child.stdout:
            if line.startswith("LTSH "):
                report = json.loads(line[len("LTSH ") :])
                if "done" in report:
                    return
                if "error" in report:
                    raise SceneError(report["error"])
                if progress is not None and progress(report["stage"], report["fraction"]) is False:
                    raise Cancelled(f"cancelled at {report['stage']}")
            elif line.strip():
                last_lines.append(line.strip())
        self._child.wait()

    def _read_manifest(self, path: Path, last_lines) -> dict:
        if not path.is_file():
            output = " | ".join(last_lines) or "none"
            raise SceneError(f"Blender ended with code {self._child.poll()} and no result; its last output: {output}")
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if "error" in manifest:
            raise SceneError(manifest["error"])
        return manifest

    def end(self) -> None:
        """End and reap Blender, whatever state it is in. It has nothing to save, so it is not asked."""
        child, self._child = self._child, None
        if child is None:
            return
        if child.poll() is None:
            if hasattr(os, "killpg"):
                os.killpg(child.pid, signal.SIGKILL)  # it leads a group of its own
            else:
                child.kill()
            child.wait()
        with contextlib.suppress(OSError):  # what was not handed over yet
            child.stdin.close()
        child.stdout.close()


_kept: ContextVar[BlenderProcess | None] = ContextVar("kept Blender", default=None)


@contextlib.contextmanager
def kept_blender(folder: Path):
    """Meanwhile one Blender does all jobs of this thread, which saves its start; `folder` is its temporary one."""
    process = BlenderProcess(folder)
    token = _kept.set(process)
    try:
        yield
    finally:
        _kept.reset(token)
        process.end()


def run_child(job: dict, folder: Path, progress: Progress | None) -> dict:
    """Do `job` in `folder` in the kept Blender, or in one of its own; its manifest.

    Raises SceneError with what was wrong in one line, Cancelled when `progress(stage, fraction)` returned False.
    """
    kept = _kept.get()
    if kept is not None:
        return kept.do(job, folder, progress)
    process = BlenderProcess(folder)
    try:
        return process.do(job, folder, progress)
    finally:
        process.end()
