"""Arguments of the command line, without Blender: what is misuse, what reaches the scene, what --help says."""

import json
from pathlib import Path

import pytest
from fake_scene import run

from ltsh_addon.scene import COMPARED_TECHNIQUES, DEFAULT_TECHNIQUE, TECHNIQUES, VERSION, listed


def assert_misuse(result, complaint):
    """Code 2, one line that holds `complaint` on stderr, nothing on stdout."""
    code, stdout, stderr = result
    assert (code, stdout) == (2, "") and len(stderr.splitlines()) == 1
    assert stderr.startswith("ltsh") and complaint in stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--techniques", "ltsh9"], "'ltsh9' is unknown, expected some of ltc, ltsh2, ltsh4, ltsh4c, reference"),
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
    ],
)  # fmt: skip
def test_wrong_values_are_misuse(capsys, child, room, out, arguments, complaint):
    assert_misuse(run(capsys, "compare", room, "-o", out, *arguments), complaint)
    assert child.asked == [] and not out.exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "COMMAND"),
        (["compare", "room.blend"], "-o"),
        (["compare", "-o", "out"], "SCENE.blend is missing"),
        (["shade", "-o", "out"], "SCENE.blend is missing"),
        (["demo"], "-o"),
        (["compare", "room.blend", "-o", "out", "--cycles-samples", "1"], "expected at least 2"),
        (["compare", "room.blend", "-o", "out", "--cycles-samples", "0"], "'0' was given"),
        ("shad room.blend -o out".split(), "ltsh: command 'shad' is unknown (expected one of demo, compare, "
         "shade, bake, view, render, relight, match, run, merge); see ltsh --help"),
        ("shade room.blend -o out --techniqes ltc".split(), "ltsh shade: option --techniqes is unknown here; see ltsh "
         "shade --help"),
        ("shade room.blend -o out --techniqes=ltc".split(), "option --techniqes is unknown here"),
        ("shade room.blend -o out --cycles-samples 8".split(),
         "--cycles-samples is unknown here (an option of demo, compare, bake, render, match)"),
        ("shade room.blend -o out hall.blend".split(),
         "'hall.blend' is not expected here (name all files one after another); see"),
        ("demo room.blend -o out".split(), "ltsh demo: 'room.blend' is not expected here; see ltsh demo --help"),
    ],
)  # fmt: skip
def test_wrong_calls_are_misuse(capsys, child, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    assert_misuse(run(capsys, *arguments), complaint)
    assert child.asked == [] and list(tmp_path.iterdir()) == []


def test_the_open_file_is_the_scene(capsys, child, room, out):
    """Blender's bpy.data.filepath is "" before a file is saved or opened."""
    assert_misuse(run(capsys, "shade", room, "-o", out, open_file="/a.blend"), "'/a.blend' open already")
    assert_misuse(run(capsys, "shade", "-o", out, open_file=""), "SCENE.blend is missing")
    assert child.asked == [] and not out.exists()
    assert run(capsys, "shade", "-o", out, "--quiet", open_file=room)[0] == 0
    assert child.asked[0].scene == Path(room)


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


@pytest.mark.parametrize("command", "demo compare shade bake render run merge".split())
def test_help_says_what_a_command_does_with_its_options_defaults_and_examples(capsys, command):
    code, stdout, stderr = run(capsys, *command.split(), "--help")
    description = stdout.split("\n\n")[1]
    assert (code, stderr) == (0, "") and description[0].isupper() and description.endswith(".")
    assert f"\n  ltsh {command} " in stdout.partition("examples:")[2]
    if command in ("demo", "compare", "shade"):
        options = "-o --techniques --passes --resolution --aa --frame --camera --json --quiet".split()
        options += [] if command == "shade" else ["--cycles-samples"]
        assert not [option for option in options if option not in stdout]
        chosen = {"demo": TECHNIQUES, "compare": COMPARED_TECHNIQUES, "shade": (DEFAULT_TECHNIQUE,)}[command]
        assert f"(default: {','.join(chosen)})" in " ".join(stdout.split())
        assert ("480x270" in stdout) == (command == "demo")


def test_the_main_help_names_the_commands_and_the_program_as_it_was_called(capsys, out):
    program = "blender --command ltsh"
    code, stdout, _ = run(capsys, "--help", program=program)
    assert code == 0 and all(f"\n    {command} " in stdout for command in ("demo", "compare", "shade", "bake"))
    assert f"{program} demo -o out/demo" in stdout
    assert run(capsys, "shade", "-o", out, program=program)[2].startswith(f"{program}: ")
    assert run(capsys, "--version")[:2] == (0, f"ltsh {VERSION}\n")


def test_some_of_many_names_are_listed_and_counted():
    text = listed(repr(f"Chair {number}") for number in range(20))
    assert text.startswith("'Chair 0', 'Chair 1', ") and text.count("'") == 2 * 8 and text.endswith(" and 12 more")
    assert listed(iter(("A", "B"))) == "A, B" and listed(()) == "none"
