"""Which tasks a job has, without Blender: frames, names of files, shards."""

import shutil

import pytest
from fake_scene import run
from fake_scene import small_job as job

from ltsh_addon.pipeline import PictureOptions, tasks
from ltsh_addon.pipeline.options import frames
from ltsh_addon.pipeline.tasks import shard_of, tasks_of

SMALL = ["--techniques", "ltc", "--passes", "diffuse", "--quiet"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(("7", (7,)), ("-3", (-3,)), ("1-4", (1, 2, 3, 4)), ("5-5", (5,)), ("3,1,2-3", (3, 1, 2))),
        *(("1-9:3,300", (1, 4, 7, 300)), ("-2-1", (-2, -1, 0, 1)), ("-4--2", (-4, -3, -2))),
    ],
)
def test_frames_are_ranges_and_single_ones_each_once(text, expected):
    assert frames(text) == expected


@pytest.mark.parametrize(
    ("option", "text", "complaint"),
    [
        *(("--frames", text, "frame is") for text in ("", "1,", "1..4", "1-4:x", "a-b", "1048575", "1-1048575", "+1")),
        *(("--frames", text, "upwards, STEP above 0") for text in ("4-1", "1-4:0")),
        *(("--shard", text, "expected I/N") for text in ("0/4", "5/4", "1", "1/0", "-1/4", "a/b", "1/4/2", "/")),
        *(("--name", text, "is unknown, expected fields") for text in ("{object}", "{0}", "{}", "{frame!r}", "{x.y}")),
        *(("--name", text, "expected names below the output folder")
          for text in ("../x", "/x", "a//b", "a/../../b", ".hidden", "x/.y", "x.", "a/")),
        *(("--name", text, "letter") for text in ("a\\b", "c:x", "a*", "x\ny")),
        ("--name", "{frame:q}", "name '{frame:q}'"),
        ("--name", "{frame", "name '{frame'"),
        ("--name", "", "0 letters"),
    ],
)  # fmt: skip
def test_wrong_values_are_misuse(capsys, child, room, tmp_path, option, text, complaint):
    code, stdout, stderr = run(capsys, "shade", room, "-o", tmp_path / "out", f"{option}={text}")
    assert (code, stdout) == (2, "") and complaint in stderr.splitlines()[-1] and not (tmp_path / "out").exists()


def test_stems_differ_in_any_case_and_hold_no_separators():
    names = ["Floor", "floor", "a/b", "a:b", "../../x", "", "Bücher", "x" * 300, "x" * 301]
    stems = tasks.file_stems(names)
    assert len({stem.casefold() for stem in stems}) == len(names) and stems[0] == "Floor" and stems[6] == "Bücher"
    assert not [stem for stem in stems if set(stem) & set("/\\:.") or not stem.strip() or len(stem) > 110]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ["shade"]),
        ({"frames": (5,)}, ["shade"]),
        ({"frames": (1, -20)}, ["shade_0001", "shade_-020"]),
        ({"cameras": ("A", "B")}, ["shade_A", "shade_B"]),
        ({"cameras": ("A", "B"), "frames": (1, 2)}, ["shade_A_0001", "shade_A_0002", "shade_B_0001", "shade_B_0002"]),
        ({"cameras": ("A",), "frames": (1,), "name": "{scene}/{camera}.{frame}"}, ["room/A.1"]),
        ({"cameras": ("../A", "..:A"), "name": "{camera}"}, ["___A", "___A_2"]),
    ],
)
def test_names_have_what_there_is_several_of(room, tmp_path, changes, expected):
    assert [task.name for task in tasks_of(job(room, tmp_path, **changes))] == expected


def test_scenes_of_one_name_get_different_names(room, tmp_path):
    (tmp_path / "other").mkdir()
    other = shutil.copy(room, tmp_path / "other")
    assert [task.name for task in tasks_of(job(room, tmp_path, scenes=(room, other)))] == ["shade_room", "shade_room_2"]


def test_tasks_that_would_write_the_same_file_are_misuse(capsys, child, room, tmp_path):
    code, _, stderr = run(capsys, "shade", room, "-o", tmp_path / "out", "--frames", "1-2", "--name", "x", *SMALL)
    assert code == 2 and "the same name 'x'; add {frame}" in stderr and child.asked == []


def test_names_of_the_file_are_asked_for_where_the_pattern_needs_them(monkeypatch, capsys, child, room, tmp_path):
    from ltsh_addon.blender.process import bake

    found = {"frame": 12, "camera": "Main/1", "objects": [], "tiles": {}, "lights": 1}
    monkeypatch.setattr(bake, "scene_facts", lambda *arguments, **options: [found])
    name = "{camera}_{frame:03d}"
    assert run(capsys, "shade", room, "-o", tmp_path / "out", "--name", name, *SMALL)[0] == 0
    assert (tmp_path / "out" / "Main_1_012.exr").is_file() and child.asked[0].frame is None


def test_shards_are_disjoint_and_together_everything(room, tmp_path):
    tasks = tasks_of(job(room, tmp_path, frames=tuple(range(23))))
    for count in (1, 2, 4, 23, 40):
        shards = [shard_of(tasks, (number, count)) for number in range(1, count + 1)]
        assert sorted((task for shard in shards for task in shard), key=tasks.index) == tasks
        assert max(map(len, shards)) - min(map(len, shards)) <= 1


def test_a_changed_file_has_another_digest(tmp_path):
    room = tmp_path / "room.blend"
    room.write_bytes(b"BLENDER")
    options = PictureOptions(room, tmp_path, techniques=("ltc",))
    first = tasks.contents_digest(options)
    assert tasks.contents_digest(options) == first
    room.write_bytes(b"BLENDER, other")
    assert tasks.contents_digest(options) != first
