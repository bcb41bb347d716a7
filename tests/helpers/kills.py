"""Programs that are ended from outside and begun again: what is there in the end must be what one run leaves."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
MARK = "LTSH_TEST_RUN"
# Seconds within which processes see that the one which started them is gone, also on a busy machine.
PATIENCE = 60.0

# command(output, *more) is the command line that writes to the folder `output`.
Command = Callable[..., list[str]]


class Runs:
    """Runs of programs whose temporary files go to the folder `temporary` and whose processes are known by it."""

    def __init__(self, temporary: Path):
        self.temporary = temporary
        temporary.mkdir(parents=True)

    def start(self, command: list[str], **options) -> subprocess.Popen:
        """`command` as a process; what it prints goes nowhere, or where `options` say."""
        folder = str(self.temporary)
        environment = {**os.environ, "TMPDIR": folder, MARK: folder}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(command, cwd=ROOT, env=environment, **{**quiet, **options})

    def finish(self, command: list[str], limit: float = 300.0, **options) -> tuple[int, str]:
        """Run `command` to its end: the exit code and what it wrote to stderr."""
        process = self.start(command, stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace", **options)
        try:
            _, said = process.communicate(timeout=limit)
        finally:
            process.kill()
            process.wait()
        return process.returncode, said

    def end_after(self, command: list[str], seconds: float, number: int = signal.SIGKILL) -> bool:
        """Run `command` and send it the signal `number` after `seconds`; False where it had ended by then."""
        limit = time.monotonic() + seconds
        return self.end_when(command, lambda: time.monotonic() >= limit, number)

    def end_when(self, command: list[str], moment: Callable[[], bool], number: int = signal.SIGKILL) -> bool:
        """Run `command` and send it the signal `number` when moment() is true; False where it ended before."""
        process = self.start(command)
        try:
            while process.poll() is None:
                if moment():
                    process.send_signal(number)
                    process.wait(PATIENCE)
                    return True
                time.sleep(0.001)
            return False
        finally:
            process.kill()
            process.wait()

    def survivors(self) -> list[int]:
        """Ids of processes of these runs that are still there after PATIENCE, in which they may end; needs Linux."""
        limit = time.monotonic() + PATIENCE
        while (found := self._processes()) and time.monotonic() < limit:
            time.sleep(0.05)
        return found

    def _processes(self):
        mark, found = f"{MARK}={self.temporary}".encode(), []
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (path / "environ").read_bytes().split(b"\0"):
                    found.append(int(path.name))
            except OSError:
                continue  # it has ended, or belongs to another user
        return found


def moments(seed: int, count: int, seconds: float) -> np.ndarray:
    """`count` random moments (count,) of a run that takes `seconds`, in seconds from its start."""
    return np.random.default_rng(seed).uniform(0.02, 1.0, count) * seconds


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes by name of all files below `folder` but for times."""
    files = (path for path in folder.rglob("*") if path.is_file() and "timing" not in str(path.relative_to(folder)))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def differences(found: dict[str, bytes], expected: dict[str, bytes]) -> list[str]:
    """What two folders differ in, a line for each file; empty where they are equal."""
    lines = [f"{name} is missing" for name in sorted(expected.keys() - found.keys())]
    lines += [f"{name} is too much" for name in sorted(found.keys() - expected.keys())]
    return lines + [f"{name} differs" for name in sorted(expected) if found.get(name, expected[name]) != expected[name]]


def is_writing(output: Path) -> bool:
    """True while a file in the folder `output`, or below, is being written under its temporary name."""
    return any(output.rglob(".*.tmp"))


def all_ended(processes):
    return all(process.returncode is not None for process in processes)


def is_running(pid):
    """True for processes that are there and not zombies, which only wait to be reaped by whoever inherits them."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")
    return not status.is_file() or status.read_text().rpartition(")")[2].split()[0] != "Z"


def children(process: int) -> list[int]:
    """Ids of the children of all threads of a process; needs Linux."""
    threads = Path(f"/proc/{process}/task").iterdir()
    return [int(word) for thread in threads for word in (thread / "children").read_text().split()]


def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """What a fixture needs that mounts a disk of this size as `folder`; skips where this user may not."""
    import pytest

    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", folder]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small disk")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


def is_blenders_own(path: Path) -> bool:
    """True for the empty folder that a real Blender leaves when it is killed."""
    return path.name.startswith("blender_") and path.is_dir() and not any(path.iterdir())


class Trial:
    """One run that nobody disturbs, in `folder`/whole, against which others are held; `seconds` is what it took."""

    def __init__(self, command: Command, folder: Path, *, exit_code: int = 0):
        self.command, self.folder, self.exit_code = command, folder, exit_code
        self.runs = Runs(folder / "temporary")
        start = time.monotonic()
        code, said = self.runs.finish(command(folder / "whole"))
        self.seconds = time.monotonic() - start
        assert code == exit_code, f"exit code {code}, expected {exit_code}: {said}"
        self.expected = contents(folder / "whole")

    def end_after(self, name: str, seconds: float, number: int = signal.SIGKILL) -> bool:
        """Begin, or go on with, `folder`/name and end it by a signal after `seconds`; False where it had ended."""
        return self.runs.end_after(self.command(self.folder / name, "--resume"), seconds, number)

    def end_while_writing(self, name: str, number: int = signal.SIGKILL) -> bool:
        """The same, as soon as a file is half written."""
        output = self.folder / name
        return self.runs.end_when(self.command(output, "--resume"), lambda: is_writing(output), number)

    def end_by_limit(self, name: str, blocks: int) -> tuple[int, str]:
        """Begin, or go on with, `folder`/name where no file may be larger than so many KiB, as if the disk were full;
        the exit code and what it wrote to stderr."""
        limited = ["bash", "-c", 'ulimit -f "$0" && exec "$@"', str(blocks)]
        return self.runs.finish([*limited, *self.command(self.folder / name, "--resume")])

    def left(self, name: str) -> list[str]:
        """Names of temporary files in `folder`/name."""
        return sorted(path.name for path in (self.folder / name).rglob(".*.tmp*"))

    def check(self, name: str) -> None:
        """Go on with `folder`/name to the end: it must hold what `whole` holds, and nothing may be left elsewhere."""
        output = self.folder / name
        code, said = self.runs.finish(self.command(output, "--resume"))
        assert code == self.exit_code, f"exit code {code}, expected {self.exit_code}: {said}"
        wrong = differences(contents(output), self.expected)
        wrong += [f"process {number} is still there" for number in self.runs.survivors()]
        left = (path for path in sorted(self.runs.temporary.rglob("*")) if not is_blenders_own(path))
        wrong += [f"{path} is left over" for path in left]
        assert not wrong, "; ".join(wrong)
