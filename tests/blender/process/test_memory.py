"""A picture that would not fit into memory is refused before it is begun, with the number and what to change."""

import os
import re
import subprocess
import sys
from pathlib import Path

import bpy
import pytest
import scene_parts

from ltsh_addon import cli
from ltsh_addon.blender.process import memory
from ltsh_addon.scene import SceneError

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def room(tmp_path):
    scene_parts.empty_scene()
    scene_parts.add_plane(scene_parts.principled(Metallic=1.0, Roughness=0.4)[0])
    scene_parts.add_area_light("Key")
    scene_parts.add_top_camera()
    path = tmp_path / "room.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.mark.parametrize(
    ("options", "limit", "complaint"),
    [
        (["--resolution", "65536x65536"], None, r"65536x65536 pixels takes about \d{4}\.\d GiB of memory"),
        (["--resolution", "640x360", "--aa", "100000"], None, "100000 points each takes about .* --resolution or --aa"),
        (["--resolution", "640x360", "--memory-limit", "500M"], None, "takes about 7.. MiB of memory, 500 MiB may be"),
        (["--resolution", "640x360"], "500", "takes about 7.. MiB of memory, 500 MiB may be used"),
    ],
)
def test_too_large_pictures_are_refused(room, tmp_path, capsys, monkeypatch, options, limit, complaint):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    if limit is not None:
        monkeypatch.setenv(memory.VARIABLE, limit)
    capsys.readouterr()
    code = cli.main(["shade", str(room), "-o", str(tmp_path / "out"), "--techniques", "ltsh4", "--quiet", *options])
    (line,) = capsys.readouterr().err.splitlines()
    assert code == 1 and re.search(complaint, line) and "raise --memory-limit" in line
    assert list((tmp_path / "out").iterdir()) == []


def test_the_option_wins_over_the_environment_and_that_over_the_machine(monkeypatch):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    free = memory.limit()
    assert free is None or free > 64 * memory.MIB
    monkeypatch.setenv(memory.VARIABLE, "300")
    assert memory.limit() == 300 * memory.MIB and memory.limit(7) == 7 * memory.MIB
    memory.check(8, 8, 1, 1, False, 1000)
    with pytest.raises(SceneError, match="reduce --resolution, or"):
        memory.check(8, 8, 1, 1, False)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and ru_maxrss in KiB")
@pytest.mark.skipif(bool(bpy.app.binary_path), reason="starts this Python")
@pytest.mark.parametrize("command", ["shade", "compare"])
def test_the_estimate_is_what_a_picture_takes(room, tmp_path, command):
    width, height = 640, 400
    options = [command, str(room), "-o", str(tmp_path / "out"), "--resolution", f"{width}x{height}", "--quiet"]
    options += ["--techniques", "ltc,ltsh4", *(["--cycles-samples", "2"] if command == "compare" else [])]
    check_estimate(options, memory.estimate(width * height, 1, 2, command == "compare"))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and ru_maxrss in KiB")
@pytest.mark.skipif(bool(bpy.app.binary_path), reason="starts this Python")
def test_the_estimate_is_what_a_bake_takes(room, tmp_path):
    options = ["bake", str(room), "-o", str(tmp_path / "out"), "--size", "512", "--quiet", "--techniques", "ltsh4"]
    check_estimate(options, memory.BakeParts(512 * 512, 6, 512 * 512, False).estimate())


def check_estimate(options, needed):
    """The peaks of both processes together, which are not at the same time: from a half to 1.3 of the estimate."""
    code = (
        "import os, resource, sys\nfrom ltsh_addon import cli\n"
        f"assert cli.main({options!r}) == 0\n"
        # What the system counts for a process itself begins with the size of the one that started it.
        "own = next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM'))\n"
        "print(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)\n"
    )
    run = [sys.executable, "-c", code]
    environment = {**os.environ, "LTSH_CORES": "1"}
    done = subprocess.run(run, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=True)
    taken = sum(int(number) << 10 for number in done.stdout.splitlines()[-1].split())
    assert 0.5 * needed < taken < 1.3 * needed, (taken >> 20, needed >> 20)
