"""The command line without Blender: arguments, exit codes, what goes to stdout and stderr, what is left in OUT."""

import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import fake_scene
import numpy as np
import pytest

from ltsh_addon import cli, files
from ltsh_addon.scene import Cancelled, SceneError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def run(capsys, *arguments, **options):
    """Exit code, stdout, stderr."""
    code = cli.main([str(argument) for argument in arguments], **options)
    return code, *capsys.readouterr()


def run_python(code):
    """Run `code` in an interpreter of its own."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)


def assert_failure(result, complaint):
    """Code 1 and, quiet, one line alone."""
    code, stdout, stderr = result
    assert (code, stdout) == (1, "") and len(stderr.splitlines()) == 1
    assert stderr.startswith("ltsh: ") and complaint in stderr


def test_with_json_a_mistake_is_a_document_too(capsys, child, room, out, tmp_path):
    cases = [
        (2, "--aa", ["shade", room, "-o", out, "--aa", "x"]),
        (2, "is missing", ["shade", "-o", out]),
        (1, "no such file", ["shade", tmp_path / "none.blend", "-o", out]),
        (1, "none.toml", ["run", tmp_path / "none.toml"]),
        (1, "cannot be written", ["shade", room, "-o", out, "--log", tmp_path / "no" / "log"]),
        (1, "no task has finished", ["merge", out]),
    ]
    for code, complaint, arguments in cases:
        found = run(capsys, *arguments, "--json", "--quiet")
        (line,) = json.loads(found[1])["errors"]
        assert found[0] == code and found[2] == f"{line}\n" and complaint in line and line.startswith("ltsh")


def test_the_demo_is_built_and_compared(capsys, child, out):
    code, stdout, _ = run(capsys, "demo", "-o", out, "--techniques", "ltc,reference", "--cycles-samples", "10")
    assert code == 0 and "written to" in stdout
    assert child.built == [out / "demo.blend"] and child.asked[0].scene == out / "demo.blend"
    assert (child.asked[0].width, child.asked[0].height, child.asked[0].cycles_samples) == (480, 270, 10)
    names = {path.name for path in out.iterdir()}
    assert names == {"demo.blend", "compare.exr", "compare.png", "report.json", "report.html", "timing.json", ".ltsh"}


def test_json_is_one_document_on_stdout_and_the_same_as_the_file(capsys, child, room, out):
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--json")
    assert code == 0 and json.loads(stdout) == json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert "samples: 100 %" in stderr


def test_what_stands_on_stdout_does_not_hang_on_its_encoding(monkeypatch, room, out):
    fake_scene.FakeChild(groups=("Schlüssel", "鍵")).install(monkeypatch)
    for arguments in ([], ["--json"]):
        stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
        monkeypatch.setattr(sys, "stdout", stdout)
        folder = out / "Bücher"
        assert cli.main(["compare", str(room), "-o", str(folder), "--techniques", "ltc", "--quiet", *arguments]) == 0
        text = stdout.buffer.getvalue().decode("ascii")
        assert "B\\xfccher" in text or json.loads(text)["lights"][1]["group"] == "鍵"


def test_closed_streams_do_no_harm(capsys, monkeypatch, child, room, out):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", None)
        code, stdout, _ = run(capsys, "compare", room, "-o", out, "--json")
        assert code == 0 and json.loads(stdout)
        assert run(capsys, "compare", room, "-o", out)[0] == 0
        patch.setattr(sys, "stdout", None)
        assert run(capsys, "compare", room, "-o", out)[0] == 0


def test_an_error_below_the_noise_is_not_shown_as_zero(capsys, child, room, out):
    """The halves lie symmetrically around the quadrature, so its squared error is negative."""
    stdout = run(capsys, "compare", room, "-o", out, "--quiet")[1]
    rows = [line for line in stdout.splitlines() if line.split()[0] == "reference"]
    assert len(rows) == 2 and all("in noise" in row and "0.00 %" not in row for row in rows)


def test_without_json_a_table_of_errors_is_printed_and_warnings_go_to_stderr(capsys, child, room, out):
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--quiet")
    assert code == 0 and stderr == f"warning: {fake_scene.WARNING}\n"
    rows = [line.split()[0] for line in stdout.splitlines()]
    table = ["technique", "ltc", "ltsh2", "ltsh4", "reference"]
    assert rows == ["specular,", *table, "diffuse,", *table, "written"]


def test_quiet_keeps_stderr_empty(capsys, child, room, out):
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--quiet", "--json")
    assert code == 0 and stderr == "" and json.loads(stdout)["warnings"] == [fake_scene.WARNING]


def test_a_camera_that_sees_nothing_is_a_warning(capsys, monkeypatch, room, out):
    fake_scene.FakeChild(empty=True).install(monkeypatch)
    code, _, stderr = run(capsys, "compare", room, "-o", out, "--quiet")
    assert code == 0 and stderr.startswith("warning: ") and "sees no surface" in stderr


@pytest.mark.parametrize("command", ["compare", "shade", "demo"])
def test_an_output_folder_that_is_a_file_fails_before_anything_runs(capsys, child, room, tmp_path, command):
    blocker = tmp_path / "blocker"
    blocker.write_text("mine")
    scene = [] if command == "demo" else [room]
    for folder in (blocker, blocker / "below"):
        assert_failure(run(capsys, command, *scene, "-o", folder, "--quiet"), "cannot be written")
    assert child.asked == child.built == [] and blocker.read_text() == "mine"


@pytest.mark.skipif(os.name != "posix", reason="permissions of folders as in POSIX")
def test_an_output_folder_without_permission_fails(capsys, child, room, tmp_path, monkeypatch):
    """The system's refusal is imitated: root, who may run the tests, is refused nothing."""

    def refuse(path, *arguments):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(files.os, "open", refuse)
    assert_failure(run(capsys, "shade", room, "-o", tmp_path, "--quiet"), "Permission denied")
    assert child.asked == []


def _empty(path):
    path.write_bytes(b"")


def _cut(path):
    whole = (ROOT / "tables" / "ltsh2.npz").read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def _flipped(path):
    data = bytearray((ROOT / "tables" / "ltsh2.npz").read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def _other_arrays(path):
    np.savez(path, position=np.zeros(3))


@pytest.mark.parametrize("command", ["compare", "shade", "demo"])
@pytest.mark.parametrize("damage", [None, _empty, _cut, _flipped, _other_arrays, Path.mkdir])
def test_a_broken_table_fails_before_anything_runs(capsys, child, room, out, tmp_path, command, damage):
    path = tmp_path / "broken.npz"
    if damage is not None:
        damage(path)
    scene = [] if command == "demo" else [room]
    result = run(capsys, command, *scene, "-o", out, "--quiet", "--techniques", f"ltc,{path}")
    assert_failure(result, f"lookup table {path}")
    assert child.asked == child.built == [] and not out.exists()


@pytest.mark.parametrize(
    "error", [SceneError("room.blend: no active camera"), OSError("disk\nis full"), Cancelled("x is full")]
)
def test_what_is_wrong_with_the_world_is_one_line(capsys, monkeypatch, room, out, error):
    fake_scene.FakeChild(error=error).install(monkeypatch)
    assert_failure(run(capsys, "compare", room, "-o", out, "--quiet"), " ".join(str(error).split()))
    assert list(out.iterdir()) == []


def test_interrupting_is_130(capsys, monkeypatch, room, out):
    fake_scene.FakeChild(error=KeyboardInterrupt()).install(monkeypatch)
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--quiet")
    assert (code, stdout, stderr) == (130, "", "ltsh: interrupted\n") and list(out.iterdir()) == []


def test_a_defect_of_ours_shows_its_traceback(capsys, monkeypatch, room, out, caplog):
    fake_scene.FakeChild(error=RuntimeError("this cannot be")).install(monkeypatch)
    assert run(capsys, "compare", room, "-o", out, "--quiet")[0] == 1
    assert "this cannot be" in caplog.text and "Traceback" in caplog.text


def test_memory_that_runs_out_has_a_line(capsys, monkeypatch, room, out):
    fake_scene.FakeChild(error=MemoryError()).install(monkeypatch)
    assert_failure(run(capsys, "compare", room, "-o", out, "--quiet"), "MemoryError")


def test_help_in_a_fresh_interpreter_loads_neither_blender_nor_scipy():
    code = (
        "import sys\nfrom ltsh_addon import cli\nassert cli.main(['compare', '--help']) == 0\n"
        "print('loaded', sorted({'bpy', 'scipy', 'OpenEXR'} & set(sys.modules)))\n"
    )
    done = run_python(code)
    assert done.stdout.splitlines()[-1] == "loaded []" and (done.returncode, done.stderr) == (0, "")


def test_without_bpy_a_line_says_what_to_install(room, out):
    code = f"""
import importlib.util as util, sys
find = util.find_spec
util.find_spec = lambda name, *rest: None if name == "bpy" else find(name, *rest)
from ltsh_addon import cli
sys.exit(cli.main(["compare", {str(room)!r}, "-o", {str(out)!r}, "--quiet"]))
"""
    done = run_python(code)
    assert (done.returncode, done.stdout) == (1, "") and len(done.stderr.splitlines()) == 1
    assert "no module bpy" in done.stderr and "pip install" in done.stderr and list(out.iterdir()) == []
