"""Command lines behind the panels: a report where there is one, else the line that says what was wrong."""

import json

import fake_scene
import pytest

from ltsh_addon import panel_job
from ltsh_addon.cli.progress import MessageProgress
from ltsh_addon.scene import SceneError

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
        ([], SceneError("no area light\nthat renders"), "no area light that renders"),
        (["--aa", "none"], None, "ltsh shade: argument --aa: 'none' was given"),
        (["--camera", "A"], RuntimeError("what?"), "unexpected error: RuntimeError: what?"),
    ],
)
def test_a_command_that_fails_gives_the_line_that_says_why(monkeypatch, room, tmp_path, arguments, error, complaint):
    fake_scene.FakeChild(error=error).install(monkeypatch)
    arguments = ["shade", str(room), "-o", str(tmp_path / "out"), *SMALL, *arguments]
    report, line = panel_job._command(arguments, MessageProgress([].append))
    assert report is None and line.startswith(complaint)
