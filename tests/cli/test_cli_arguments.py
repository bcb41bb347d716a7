"""Arguments of the command line, without Blender: what is misuse, what reaches the scene, what --help says."""

import json
from pathlib import Path

import pytest
from fake_scene import run

from ltsh_addon import shading
from ltsh_addon.cli import commands
from ltsh_addon.pipeline.options import techniques
from ltsh_addon.scene import VERSION


def assert_misuse(result, complaint):
    """Code 2, one line that holds `complaint` on stderr, nothing on stdout."""
    code, stdout, stderr = result
    assert (code, stdout) == (2, "") and len(stderr.splitlines()) == 1
    assert stderr.startswith("ltsh") and complaint in stderr


@pytest.mark.parametrize("command", ["compare", "shade"])
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--techniques", "ltsh9"], "'ltsh9' is unknown, expected some of ltc, ltsh2, ltsh4, reference"),
        (["--techniques", ""], "is unknown"),
        (["--techniques", "ltc,ltsh2.exr"], "'ltsh2.exr' is unknown"),
        (["--passes", "glossy"], "passes are 'glossy', expected some of specular, diffuse"),
        (["--passes", ","], "expected some of"),
        *((["--resolution", text], f"resolution is {text!r}, expected WIDTHxHEIGHT")
          for text in ("480", "0x270", "480x", "x", "8x-8", "4.5x4", "480x270x1", "3x3", "65537x8", "480X270")),
        (["--aa", "0"], "'0' was given, expected a whole number above 0"),
        (["--aa", "-1"], "expected"),
        (["--aa", "two"], "'two' was given"),
        (["--frame", "1.5"], "frame is '1.5', expected a whole number"),
        (["--frame", "1048575"], "frame is '1048575'"),
        (["--reference-samples", "0"], "'0' was given"),
        (["--no-such-option"], "--no-such-option"),
    ],
)  # fmt: skip
def test_wrong_values_are_misuse(capsys, child, room, out, command, arguments, complaint):
    assert_misuse(run(capsys, command, room, "-o", out, *arguments), complaint)
    assert child.asked == [] and not out.exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "COMMAND"),
        (["render"], "'render'"),
        (["compare", "room.blend"], "-o"),
        (["compare", "-o", "out"], "SCENE.blend is missing"),
        (["shade", "-o", "out"], "SCENE.blend is missing"),
        (["demo"], "-o"),
        (["demo", "room.blend", "-o", "out"], "room.blend"),
        (["compare", "room.blend", "-o", "out", "--cycles-samples", "1"], "expected at least 2"),
        (["compare", "room.blend", "-o", "out", "--cycles-samples", "0"], "'0' was given"),
        (["shade", "room.blend", "-o", "out", "--cycles-samples", "8"], "--cycles-samples"),
        (["tables"], "action"),
        (["tables", "burn"], "'burn'"),
    ],
)
def test_wrong_calls_are_misuse(capsys, child, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    assert_misuse(run(capsys, *arguments), complaint)
    assert child.asked == [] and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["compare", "shade"])
def test_a_scene_beside_an_open_file_is_misuse(capsys, child, room, out, command):
    result = run(capsys, command, room, "-o", out, open_file="/scenes/open.blend")
    assert_misuse(result, "'/scenes/open.blend' open already")
    assert child.asked == [] and not out.exists()


def test_the_open_file_is_the_scene(capsys, child, room, out):
    assert run(capsys, "shade", "-o", out, "--quiet", open_file=room)[0] == 0
    assert child.asked[0].scene == Path(room)


def test_an_empty_name_of_the_open_file_means_none(capsys, child, out):
    """Blender's bpy.data.filepath is "" before a file is saved or opened."""
    assert_misuse(run(capsys, "shade", "-o", out, open_file=""), "SCENE.blend is missing")


def test_tables_outside_a_checkout_are_misuse(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(commands, "__file__", str(tmp_path / "site" / "ltsh_addon" / "commands" / "tables_command.py"))
    assert_misuse(run(capsys, "tables", "fit"), "needs the source checkout")


def test_options_reach_the_scene(capsys, child, room, out):
    arguments = ["--techniques", "ltsh4,ltc,ltsh4", "--passes", "diffuse", "--resolution", "640x360", "--aa", "4",
                 "--frame", "-12", "--camera", "Side", "--cycles-samples", "32", "--json"]  # fmt: skip
    code, stdout, _ = run(capsys, "compare", room, "-o", out, *arguments)
    asked, report = child.asked[0], json.loads(stdout)
    assert code == 0 and asked.scene == Path(room)
    assert (asked.width, asked.height, asked.sub_samples, asked.frame) == (640, 360, 4, -12)
    assert (asked.camera, asked.cycles_samples) == ("Side", 32)
    assert list(report["passes"]) == ["diffuse"] and list(report["tables"]) == ["ltsh4", "ltc"]


def test_left_out_options_mean_as_in_the_file(capsys, child, room, out):
    assert run(capsys, "shade", room, "-o", out)[0] == 0
    asked = child.asked[0]
    assert (asked.width, asked.height, asked.sub_samples, asked.frame, asked.camera) == (None, None, 1, None, None)


def test_the_program_is_named_as_it_was_called(capsys, out):
    stderr = run(capsys, "shade", "-o", out, program="blender --command ltsh")[2]
    assert stderr.startswith("blender --command ltsh: ")


def test_version(capsys):
    code, stdout, _ = run(capsys, "--version")
    assert (code, stdout) == (0, f"ltsh {VERSION}\n")


@pytest.mark.parametrize("command", ["demo", "compare", "shade"])
def test_help_names_every_option_and_default(capsys, command):
    code, stdout, stderr = run(capsys, command, "--help")
    assert (code, stderr) == (0, "")
    options = ["-o", "--techniques", "--passes", "--resolution", "--aa", "--frame", "--camera", "--json", "--quiet"]
    options += [] if command == "shade" else ["--cycles-samples"]
    assert not [option for option in options if option not in stdout]
    assert "ltc,ltsh2,ltsh4,reference" in stdout and ("480x270" in stdout) == (command == "demo")


def test_the_main_help_names_the_commands_and_examples(capsys):
    code, stdout, _ = run(capsys, "--help", program="blender --command ltsh")
    assert code == 0 and all(f"\n    {command} " in stdout for command in ("demo", "compare", "shade", "tables"))
    assert "blender --command ltsh demo -o out/demo" in stdout


def test_every_shipped_table_is_a_technique():
    assert techniques(",".join(shading.SHIPPED_TABLES)) == shading.SHIPPED_TABLES
