"""Jobs come after the window: niceness, and what Linux weighs instead of it between sessions."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ltsh_addon.blender.process import blender_process

pytestmark = pytest.mark.skipif(not hasattr(os, "setpriority"), reason="Windows has classes of priority instead")
ROOT = Path(__file__).resolve().parents[3]
# What the child of a job does, and what Blender does as its child.
SCRIPT = f"""
import os, subprocess, sys
sys.path.insert(0, {str(ROOT)!r})
from ltsh_addon.blender.process import blender_process as priority
priority.weigh_session()
group = open("/proc/self/autogroup").read() if os.path.exists("/proc/self/autogroup") else ""
print(os.nice(0), group.rpartition(" ")[2].strip(), os.getsid(0), flush=True)
if len(sys.argv) < 2:
    subprocess.run([sys.executable, __file__, "again"], start_new_session=True, check=True)
"""


@pytest.mark.parametrize("background", [True, False])
def test_a_job_and_what_it_starts_come_after_this_process(tmp_path, background):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    process = blender_process.start([sys.executable, str(script)], tmp_path, background=background)
    output, _ = process.communicate(timeout=60)
    lines = [line.split(" ") for line in output.splitlines()]
    own = os.getpriority(os.PRIO_PROCESS, 0)
    niceness = min(own + blender_process.NICENESS, 19) if background else own
    assert [int(line[0]) for line in lines] == [niceness, niceness], output
    assert len({line[2] for line in lines}) == 2, "each has a session of its own, as in a job"
    if blender_process.AUTOGROUP.exists() and niceness > 0:
        assert [line[1] for line in lines] == [str(niceness)] * 2, output


def test_a_process_that_has_ended_already_is_no_error():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    blender_process.yield_to_us(process.pid)


def test_a_busy_kernel_is_asked_again_and_one_without_weights_is_left_alone(monkeypatch):
    answers = [BlockingIOError(), BlockingIOError(), 2]
    asked = []

    class Group:
        def write_text(self, text, encoding):
            asked.append(text)
            answer = answers.pop(0)
            if isinstance(answer, OSError):
                raise answer
            return answer

    monkeypatch.setattr(blender_process, "AUTOGROUP", Group())
    monkeypatch.setattr(blender_process, "AUTOGROUP_SECONDS", 0.0)
    monkeypatch.setattr(os, "nice", lambda by: 10)
    blender_process.weigh_session()
    assert asked == ["10"] * 3
    answers[:] = [FileNotFoundError()]
    blender_process.weigh_session()
    assert answers == [] and len(asked) == 4
    monkeypatch.setattr(os, "nice", lambda by: 0)
    blender_process.weigh_session()
    assert len(asked) == 4
