"""What the command line says about commands, options and names that do not exist."""

import pytest

from ltsh_addon import cli
from ltsh_addon.blender.process.blender_process import listed


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("shad room.blend -o out", "ltsh: command 'shad' is unknown (did you mean shade?); see ltsh --help"),
        ("frobnicate", "expected one of demo, compare, shade, bake, run, merge, tables"),
        ("shade room.blend -o out --techniqes ltc", "ltsh shade: option --techniqes is unknown here (did you mean "
         "--techniques?); see ltsh shade --help"),
        ("shade room.blend -o out --techniqes=ltc", "did you mean --techniques?"),
        ("shade room.blend -o out --cycles-samples 8", "--cycles-samples is unknown here (an option of demo, compare, "
         "bake)"),
        ("shade room.blend -o out --zzz", "option --zzz is unknown here; see ltsh shade --help"),
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


def test_names_are_listed_from_the_most_similar_one_and_not_all():
    names = [f"Chair {number}" for number in range(20)] + ["Floor"]
    text = listed(names, "floor")
    assert text.startswith("'Floor', 'Chair 0', ") and text.count("'") == 2 * 8 and text.endswith(" and 13 more")
    assert listed(iter(("A", "B")), "Z") == "'A', 'B'" and listed((), "Z") == "none"
