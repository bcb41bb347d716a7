"""The command line without Blender: arguments, exit codes, what goes to stdout and stderr, what is left in OUT."""

import io
import json
import subprocess
import sys
from pathlib import Path

import fake_scene
import pytest
from fake_scene import run

from ltsh_addon import cli, panel_job
from ltsh_addon.cli.commands import DEMO_SCENE
from ltsh_addon.cli.progress import MessageProgress
from ltsh_addon.scene import COMPARED_TECHNIQUES, Cancelled, SceneError

ROOT = Path(__file__).resolve().parents[2]


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


def test_the_demo_is_written_and_compared(capsys, child, out):
    code, stdout, _ = run(capsys, "demo", "-o", out, "--techniques", "ltc,reference", "--cycles-samples", "10")
    assert code == 0 and "written to" in stdout
    assert (out / "demo.blend").read_bytes() == DEMO_SCENE.read_bytes() and child.asked[0].scene == out / "demo.blend"
    assert (child.asked[0].width, child.asked[0].height, child.asked[0].cycles_samples) == (480, 270, 10)
    names = {path.name for path in out.iterdir()}
    assert names == {"demo.blend", "compare.exr", "compare.png", "report.json", "report.html", "timing.json", ".ltsh",
                     "unshadowed"}  # fmt: skip
    assert [options.shadows for options in child.asked] == ["on", "off"]
    assert {path.name for path in (out / "unshadowed").iterdir()} == names - {"demo.blend", "unshadowed"}


@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
def test_json_is_one_document_on_stdout_and_the_same_as_the_file(capsys, child, room, out, quiet):
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--json", *quiet)
    assert code == 0 and json.loads(stdout) == json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert stderr == "" if quiet else "samples: 100 %" in stderr
    assert json.loads(stdout)["warnings"] == [fake_scene.WARNING]


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
    stdout = run(capsys, "compare", room, "-o", out, "--techniques", "reference", "--quiet")[1]
    rows = [line for line in stdout.splitlines() if line.split()[0] == "reference"]
    assert len(rows) == 2 and all("in noise" in row and "0.00 %" not in row for row in rows)


def test_without_json_a_table_of_errors_is_printed_and_warnings_go_to_stderr(capsys, child, room, out):
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--quiet")
    assert code == 0 and stderr == f"warning: {fake_scene.WARNING}\n"
    rows = [line.split()[0] for line in stdout.splitlines()]
    table = ["technique", *COMPARED_TECHNIQUES]
    assert rows == ["specular,", *table, "diffuse,", *table, "written"]


@pytest.mark.parametrize(
    ("error", "expected", "complaint"),
    [
        (SceneError("room.blend: no active camera"), 1, "room.blend: no active camera"),
        (OSError("disk\nis full"), 1, "disk is full"),
        (Cancelled("x is full"), 1, "x is full"),
        (MemoryError(), 1, "MemoryError"),
        (KeyboardInterrupt(), 130, "ltsh: interrupted\n"),
    ],
)
def test_what_is_wrong_with_the_world_is_one_line(capsys, monkeypatch, room, out, error, expected, complaint):
    fake_scene.FakeChild(error=error).install(monkeypatch)
    code, stdout, stderr = run(capsys, "compare", room, "-o", out, "--quiet")
    assert (code, stdout) == (expected, "") and len(stderr.splitlines()) == 1 and not out.exists()
    assert stderr.startswith("ltsh: ") and complaint in stderr


def test_a_defect_of_ours_shows_its_traceback(capsys, monkeypatch, room, out, caplog):
    fake_scene.FakeChild(error=RuntimeError("this cannot be")).install(monkeypatch)
    assert run(capsys, "compare", room, "-o", out, "--quiet")[0] == 1
    assert "this cannot be" in caplog.text and "Traceback" in caplog.text


def test_without_bpy_a_line_says_what_to_install(room, out):
    code = f"""
import importlib.util as util, sys
find = util.find_spec
util.find_spec = lambda name, *rest: None if name == "bpy" else find(name, *rest)
from ltsh_addon import cli
sys.exit(cli.main(["compare", {str(room)!r}, "-o", {str(out)!r}, "--quiet"]))
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "") and len(done.stderr.splitlines()) == 1
    assert "no module bpy" in done.stderr and "pip install" in done.stderr and not out.exists()


SMALL = ["--techniques", "ltc", "--passes", "diffuse"]


def test_a_command_that_works_gives_its_report_and_its_progress(monkeypatch, room, tmp_path):
    fake_scene.FakeChild().install(monkeypatch)
    sent = []
    arguments = ["shade", str(room), "-o", str(tmp_path / "out"), *SMALL]
    report, _ = panel_job._command(arguments, MessageProgress(sent.append))
    assert report == json.loads((tmp_path / "out" / "report.json").read_text()) and report["resolution"]
    stages = list(dict.fromkeys(message["stage"] for message in sent))
    assert stages[0] == "samples" and stages[-2:] == ["LTC", "write"] and sent[-1]["fraction"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "error", "complaint"),
    [
        ([], SceneError("no light\nthat renders"), "no light that renders"),
        (["--aa", "none"], None, "ltsh shade: argument --aa: 'none' was given"),
        (["--camera", "A"], RuntimeError("what?"), "unexpected error: RuntimeError: what?"),
    ],
)
def test_a_command_that_fails_gives_the_line_that_says_why(monkeypatch, room, tmp_path, arguments, error, complaint):
    fake_scene.FakeChild(error=error).install(monkeypatch)
    arguments = ["shade", str(room), "-o", str(tmp_path / "out"), *SMALL, *arguments]
    report, line = panel_job._command(arguments, MessageProgress([].append))
    assert report is None and line.startswith(complaint)
