"""Comparisons beside earlier ones: what got worse is named, and what cannot be compared is refused."""

import copy
import json

import pytest

from ltsh_addon import cli
from ltsh_addon.cli import arguments as arguments_module
from ltsh_addon.pipeline import PictureOptions, compare_scene, shade_scene
from ltsh_addon.pipeline.picture import Baseline, Tolerance


@pytest.fixture
def report(child, tmp_path):
    """What report.json of a comparison of one picture holds."""
    options = {"techniques": ("ltc", "reference"), "cycles_samples": 8}
    compare_scene(PictureOptions(tmp_path / "room.blend", tmp_path / "out", **options))
    return json.loads((tmp_path / "out" / "report.json").read_text())


def baseline(folder, document):
    path = folder / "baseline.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return Baseline.read(path)


def changed(report, difference, *keys):
    """The report with one of its errors made larger."""
    report = copy.deepcopy(report)
    place = report["passes"]
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] += difference
    return report


REFERENCE = ("specular", "techniques", "ltc", "against_reference")


@pytest.mark.parametrize(
    ("keys", "place"),
    [
        (("specular", "techniques", "ltc", "against_cycles", "unbiased_relative_error"),
         "specular of ltc against Cycles"),
        ((*REFERENCE, "relative_l2"), "specular of ltc against the reference:"),
        ((*REFERENCE, "metals", "relative_l2"), "specular of ltc against the reference on metals"),
        ((*REFERENCE, "dielectrics", "relative_l2"), "specular of ltc against the reference on dielectrics"),
    ],
)  # fmt: skip
def test_what_got_worse_is_named_with_its_place(report, tmp_path, keys, place):
    before, now = baseline(tmp_path, report), changed(report, 0.01, *keys)
    (line,) = before.worse(now, Tolerance(0.009))
    assert line.startswith("room.blend, camera 'Camera', frame 7: ") and place in line and "tolerance 0.90 %" in line
    assert before.worse(now, Tolerance(0.011)) == []
    # What is the same or better is never worse.
    for document in (now, report):
        assert baseline(tmp_path, document).worse(report, Tolerance(0.0)) == []


def test_a_tolerance_is_absolute_or_relative():
    assert Tolerance(0.002).allows(0.01, 0.0119) and not Tolerance(0.002).allows(0.01, 0.0121)
    assert Tolerance(0.1, relative=True).allows(0.01, 0.0109) and not Tolerance(0.1, relative=True).allows(0.01, 0.0111)
    assert arguments_module.tolerance("0.002") == Tolerance(0.002)
    assert arguments_module.tolerance("10%") == Tolerance(0.1, relative=True)
    for text in ("", "x", "-1", "nan", "inf", "%", "1%%"):
        with pytest.raises(Exception, match="tolerance is"):
            arguments_module.tolerance(text)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"resolution": [9, 9]}, "resolution is [9, 9]"),
        ({"cycles_samples": 16}, "cycles_samples is 16"),
        ({"sub_samples": 4}, "sub_samples is 4"),
        ({"frame": 8}, "has no picture of room.blend, camera 'Camera', frame 7"),
        ({"camera": "Other"}, "has no picture of"),
        ({"scene": "hall.blend"}, "has no picture of"),
        ({"reference": None}, "reference is None"),
    ],
)
def test_other_pictures_are_no_baseline(report, tmp_path, change, complaint):
    before = baseline(tmp_path, {**report, **change})
    with pytest.raises(ValueError, match="baseline .*baseline.json: ") as error:
        before.worse(report, Tolerance())
    assert complaint in str(error.value)


@pytest.mark.parametrize("document", ["", "{", "[]", "{}", "3", '{"passes": 3}', '{"reports": [{}]}', '{"a": []}'])
def test_what_is_no_report_is_refused(tmp_path, document):
    with pytest.raises(ValueError, match="is not the report of a comparison"):
        baseline(tmp_path, document)


def test_a_report_without_cycles_is_refused(child, tmp_path):
    shade_scene(PictureOptions(tmp_path / "room.blend", tmp_path / "out", techniques=("ltc",)))
    with pytest.raises(ValueError, match="has no errors against Cycles"):
        Baseline.read(tmp_path / "out" / "report.json")


def test_several_pictures_are_told_apart_and_a_technique_without_baseline_is_refused(report, tmp_path):
    second = {**copy.deepcopy(report), "frame": 8}
    before = baseline(tmp_path, {"command": "compare", "reports": [report, second]})
    now = {"command": "compare", "reports": [report, changed(second, 0.01, *REFERENCE, "relative_l2")]}
    (line,) = before.worse(now, Tolerance(0.0))
    assert "frame 8" in line and before.worse(report, Tolerance(0.0)) == []
    del second["passes"]["specular"]["techniques"]["ltc"]
    with pytest.raises(ValueError, match="has no specular of ltc against Cycles"):
        baseline(tmp_path, second).worse(now["reports"][1], Tolerance())


def test_the_command_ends_with_1_where_something_got_worse(capsys, child, room, tmp_path):
    arguments = ["compare", str(room), "--techniques", "ltc,reference", "--quiet"]
    assert cli.main([*arguments, "-o", str(tmp_path / "first")]) == 0
    path = tmp_path / "first" / "report.json"
    with_baseline = [*arguments, "-o", str(tmp_path / "second"), "--baseline", str(path)]
    assert cli.main([*with_baseline, "--tolerance", "0"]) == 0
    # The technique's error is 7e-3: half of that now is twice the baseline's.
    document = changed(json.loads(path.read_text()), -3e-3, *REFERENCE, "relative_l2")
    path.write_text(json.dumps(document))
    capsys.readouterr()
    assert cli.main([*with_baseline, "--tolerance", "0", "--json"]) == 1
    stdout, stderr = capsys.readouterr()
    assert len(json.loads(stdout)["worse"]) == 1 and "worse: room.blend, camera 'Camera', frame 7: specular" in stderr
    assert cli.main([*with_baseline, "--tolerance", "200%"]) == 0
    assert cli.main(["merge", str(tmp_path / "second"), "--baseline", str(path), "--tolerance", "0"]) == 1
    asked = len(child.asked)
    assert cli.main([*with_baseline[:-1], str(tmp_path / "none.json")]) == 1 and len(child.asked) == asked
    assert cli.main([*with_baseline, "--shard", "1/2"]) == 2
