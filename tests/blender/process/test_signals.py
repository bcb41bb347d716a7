"""Ctrl-C and SIGTERM in every phase of a command: the exit code, one line, no file and no process left."""

import os
import signal
import subprocess
import threading
import time
from pathlib import Path

import programs
import pytest
import scene_parts
from kills import children, is_blenders_own

ROOT = Path(__file__).resolve().parents[3]
LINES = {signal.SIGINT: "ltsh: interrupted", signal.SIGTERM: "ltsh: terminated"}
LARGE = "--reference-samples", "1000000"
# Less than what the commands below would take.
SECONDS = 60.0
pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="processes as Linux tells them")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return scene_parts.metal_room(tmp_path_factory.mktemp("scene") / "room.blend")


class Running:
    """A command that has got to the stage whose line starts with `stage`."""

    def __init__(self, stage, *arguments):
        command = programs.command_line(*arguments)
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            # A shell that runs the tests in the background has Ctrl-C ignored, which would be inherited.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip
        self._watchdog = threading.Timer(90.0, self.process.kill)
        self._watchdog.start()
        for line in self.process.stderr:
            if line.startswith(stage):
                return
        raise AssertionError(f"{stage} did not come, code {self.process.wait()}")

    def close(self):
        self._watchdog.cancel()
        self.process.kill()
        self.process.communicate()


def ends(process: int, seconds: float) -> bool:
    """True where the process has ended and was reaped, within `seconds`."""
    limit = time.monotonic() + seconds
    while os.path.exists(f"/proc/{process}"):
        if time.monotonic() > limit:
            return False
        time.sleep(0.02)
    return True


def left_over(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*") if not is_blenders_own(path)]


def compare(room, out):
    return "compare", room, "-o", out, "--resolution", "640x360", "--cycles-samples", "100000"


def shade(room, out):
    """Quadrature on all cores for longer than anybody waits."""
    return "shade", room, "-o", out, "--resolution", "720x400", "--techniques", "reference", *LARGE


@pytest.mark.parametrize(
    ("stage", "arguments", "number"),
    [
        ("Cycles A", compare, signal.SIGTERM),
        ("Reference", shade, signal.SIGINT),
        ("Cycles A", compare, signal.SIGKILL),
        ("Reference", shade, signal.SIGKILL),
    ],
)
def test_signals_end_a_command_and_all_its_processes_and_leave_nothing(
    room, tmp_path, temporary_root, stage, arguments, number
):
    """The children of a killed one see that the other end of a pipe is closed; Blender removes their folder."""
    out, killed = tmp_path / "out", number == signal.SIGKILL
    running = Running(stage, *arguments(room, out))
    try:
        time.sleep(0.5)  # into the stage
        others = children(running.process.pid)
        running.process.send_signal(number)
        running.process.send_signal(number)  # an impatient second one does not disturb
        stdout, stderr = running.process.communicate(timeout=SECONDS)
    finally:
        running.close()
    assert others and all(ends(child, 20.0 if killed else 0.0) for child in others)
    assert left_over(out) == left_over(temporary_root) == []
    assert running.process.returncode == (-number if killed else 128 + number)
    if not killed:
        assert programs.said_nothing(stdout) and "Traceback" not in stderr and stderr.splitlines()[-1] == LINES[number]
