"""Jobs in the background get the processor after the window, as does all that they start."""

import os
import sys
from pathlib import Path

import pytest

from ltsh_addon.blender.process import blender_process
from ltsh_addon.workers.pool import NICENESS

pytestmark = pytest.mark.skipif(not hasattr(os, "setpriority"), reason="Windows has classes of priority instead")
ROOT = Path(__file__).resolve().parents[3]
# Says its niceness, session and group, and starts what Blender is to a job.
SCRIPT = f"""
import os, sys
from pathlib import Path
sys.path.insert(0, {str(ROOT)!r})
from ltsh_addon.blender.process import blender_process
print(os.nice(0), os.getsid(0), os.getpgid(0), flush=True)
if len(sys.argv) < 2:
    print(blender_process.start([sys.executable, __file__, "again"], Path.cwd()).communicate()[0])
"""


@pytest.mark.parametrize("background", [True, False])
def test_a_job_and_what_it_starts_come_after_this_process(tmp_path, background):
    """In our session, within which niceness counts, and out of our group, to which Ctrl-C goes."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    process = blender_process.start([sys.executable, str(script)], tmp_path, background=background)
    output, _ = process.communicate(timeout=60)
    lines = [[int(word) for word in line.split()] for line in output.splitlines() if line]
    own = os.getpriority(os.PRIO_PROCESS, 0)
    niceness = min(own + NICENESS, 19) if background else own
    assert [line[:2] for line in lines] == [[niceness, os.getsid(0)]] * 2, output
    assert len({os.getpgid(0), *(line[2] for line in lines)}) == 3, output
