"""What the command line says about commands, options and names that do not exist."""

import pytest

from ltsh_addon import cli
from ltsh_addon.scene import listed


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("shad room.blend -o out", "ltsh: command 'shad' is unknown (expected one of demo, compare, "
         "shade, bake, run, merge, tables); see ltsh --help"),
        ("shade room.blend -o out --techniqes ltc", "ltsh shade: option --techniqes is unknown here; see ltsh "
         "shade --help"),
        ("shade room.blend -o out --techniqes=ltc", "option --techniqes is unknown here"),
        ("shade room.blend -o out --cycles-samples 8", "--cycles-samples is unknown here (an option of demo, compare, "
         "bake)"),
        ("shade room.blend -o out hall.blend", "'hall.blend' is not expected here (name all files one "
         "after another); see"),
        ("demo room.blend -o out", "ltsh demo: 'room.blend' is not expected here; see ltsh demo --help"),
        ("tables export -o out --jsn", "option --jsn is unknown here"),
    ],
)  # fmt: skip
def test_one_line_says_what_was_meant(capsys, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments.split()) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and len(stderr.splitlines()) == 1 and complaint in stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["demo", "compare", "shade", "bake", "run", "merge", "tables", "tables export"])
def test_help_says_what_a_command_does_and_gives_examples(capsys, command):
    assert cli.main([*command.split(), "--help"]) == 0
    text = capsys.readouterr().out
    description = text.split("\n\n")[1]
    assert description[0].isupper() and description.endswith(".")
    assert f"\n  ltsh {command} " in text.partition("examples:")[2]


def test_some_of_many_names_are_listed_and_counted():
    text = listed(repr(f"Chair {number}") for number in range(20))
    assert text.startswith("'Chair 0', 'Chair 1', ") and text.count("'") == 2 * 8 and text.endswith(" and 12 more")
    assert listed(iter(("A", "B"))) == "A, B" and listed(()) == "none"
