"""Jobs of many tasks without Blender: names, order, shards, what is kept, what is named as missing."""

import json
from dataclasses import replace

import fake_scene
import pytest
from fake_scene import small_job as job
from kills import contents

from ltsh_addon import cli
from ltsh_addon.pipeline import batch, tasks
from ltsh_addon.pipeline.batch import merge
from ltsh_addon.scene import SceneError

SMALL = ["--techniques", "ltc", "--passes", "diffuse", "--quiet"]


def run(capsys, *arguments):
    """Exit code, stdout, and stderr without the warnings about the scene."""
    code = cli.main([str(argument) for argument in arguments])
    stdout, stderr = capsys.readouterr()
    return code, stdout, stderr.replace(f"warning: {fake_scene.WARNING}\n", "")


@pytest.mark.parametrize("command", ["shade", "compare"])
def test_shards_merged_are_the_single_run_byte_for_byte(capsys, child, room, tmp_path, command):
    arguments = [command, room, "--frames", "1-3,9", "--camera", "A", "--camera", "B", *SMALL]
    assert run(capsys, *arguments, "-o", tmp_path / "one")[0] == 0
    for number in (3, 1, 4, 2):
        assert run(capsys, *arguments, "-o", tmp_path / "four", "--shard", f"{number}/4")[0] == 0
    assert run(capsys, "merge", tmp_path / "four", "--quiet")[0] == 0
    one = contents(tmp_path / "one")
    assert contents(tmp_path / "four") == one
    report = json.loads(one["report.json"])
    assert [(entry["camera"], entry["frame"]) for entry in report["reports"]] == [
        (camera, frame) for camera in "AB" for frame in (1, 2, 3, 9)
    ]
    assert all((tmp_path / "four" / name).is_file() for entry in report["reports"] for name in entry["files"])
    timing = json.loads((tmp_path / "four" / "timing.json").read_text())["seconds"]
    assert len(timing) == 8 and all(seconds["total"] > 0.0 for seconds in timing.values())


def test_the_page_of_many_comparisons_links_those_of_each(capsys, child, room, tmp_path):
    out = tmp_path / "out"
    name = "{camera}/p {frame:03d}"
    assert run(capsys, "compare", room, "-o", out, "--frames", "1-2", "--camera", "<A>", "--name", name, *SMALL)[0] == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'href="_A_/p%20001.html"' in page and "&lt;A&gt;" in page and "2 comparisons" in page
    picture = (out / "_A_" / "p 001.html").read_text(encoding="utf-8")
    assert 'src="p%20001.png"' in picture and 'href="../report.json"' in picture


def test_merging_names_what_is_missing(capsys, child, room, tmp_path):
    out = tmp_path / "out"
    code, _, stderr = run(capsys, "merge", tmp_path)
    assert code == 1 and "no task has finished there" in stderr and "-o" in stderr
    assert run(capsys, "shade", room, "-o", out, "--frames", "1-5", "--shard", "1/2", *SMALL)[0] == 0
    code, _, stderr = run(capsys, "merge", out, "--quiet")
    assert code == 1 and stderr.splitlines() == ["missing: shade_0002", "missing: shade_0004"]
    assert json.loads((out / "report.json").read_text())["missing"] == ["shade_0002", "shade_0004"]
    assert run(capsys, "shade", room, "-o", out, "--frames", "1-5", "--shard", "2/2", *SMALL)[0] == 0
    assert run(capsys, "merge", out, "--quiet")[0] == 0
    (out / "shade_0003.exr").write_bytes((out / "shade_0002.exr").read_bytes())
    assert run(capsys, "merge", out, "--quiet")[2] == "missing: shade_0003\n"
    (out / ".ltsh" / "job.json").write_text("{")
    code, _, stderr = run(capsys, "merge", out, "--quiet")
    assert code == 1 and "job.json: is no JSON" in stderr


def test_shards_of_other_options_or_scenes_are_missing(capsys, child, room, tmp_path):
    out, arguments = tmp_path / "out", ["shade", room, "-o", tmp_path / "out", "--frames", "1-2", *SMALL]
    assert run(capsys, *arguments, "--shard", "1/2", "--aa", "2")[0] == 0
    assert run(capsys, *arguments, "--shard", "2/2")[0] == 0
    assert run(capsys, "merge", out)[2] == "missing: shade_0001\n"
    room.write_bytes(b"BLENDER2")
    assert run(capsys, *arguments, "--shard", "1/2")[0] == 0
    assert run(capsys, "merge", out)[2] == "missing: shade_0002\n"


def test_a_fault_of_one_task_leaves_the_others(child, room, tmp_path, monkeypatch):
    perform = batch._perform

    def faulty(job, task, *others):
        if task.frame == 2:
            raise ValueError("zero-size array")
        return perform(job, task, *others)

    monkeypatch.setattr(batch, "_perform", faulty)
    result = batch.run_tasks(job(room, tmp_path / "out", frames=(1, 2, 3)))
    assert result.problems == ("shade_0002: unexpected error: ValueError: zero-size array",) and result.done == 3
    assert {path.name for path in (tmp_path / "out").glob("*.exr")} == {"shade_0001.exr", "shade_0003.exr"}


def test_resuming_keeps_what_the_same_job_has_done(child, room, tmp_path):
    wanted = job(room, tmp_path / "out", frames=(1, 2, 3))
    assert batch.run_tasks(wanted).done == 3
    before = contents(tmp_path / "out")
    assert batch.run_tasks(wanted, existing=batch.RESUME).finished_before == 3 and len(child.asked) == 3
    (tmp_path / "out" / "shade_0002.exr").unlink()
    done = batch.run_tasks(wanted, existing=batch.RESUME)
    assert (done.done, done.finished_before, child.asked[-1].frame) == (1, 2, 2)
    assert contents(tmp_path / "out") == before
    # More frames of the same job keep what is there; other options do not.
    assert batch.run_tasks(replace(wanted, frames=(3, 4)), existing=batch.RESUME).finished_before == 1
    changed = replace(wanted, options=replace(wanted.options, passes=("specular",)))
    assert batch.run_tasks(changed, existing=batch.RESUME).finished_before == 0
    assert batch.run_tasks(wanted, existing=batch.SKIP).finished_before == 3 and merge(tmp_path / "out").missing == ()
    assert batch.run_tasks(wanted).finished_before == 0


@pytest.mark.parametrize("damage", ["cut", "changed", "report", "key", "files", "{", '{"format": 99}', ""])
def test_what_is_not_whole_is_done_again(child, room, tmp_path, damage):
    wanted = job(room, tmp_path / "out", frames=(1, 2))
    batch.run_tasks(wanted)
    before = contents(tmp_path / "out")
    image = tmp_path / "out" / "shade_0001.exr"
    record = tmp_path / "out" / tasks.FOLDER / "tasks" / "shade_0001.json"
    if damage in ("cut", "changed"):
        image.write_bytes(image.read_bytes()[:-1] + (b"" if damage == "cut" else b"x"))
    elif damage.isalpha():
        whole = json.loads(record.read_text())
        record.write_text(json.dumps({name: value for name, value in whole.items() if name != damage}))
    else:
        record.write_text(damage)
    done = batch.run_tasks(wanted, existing=batch.SKIP if damage == "cut" else batch.RESUME)
    assert (done.done, done.finished_before) == (1, 1)
    after = contents(tmp_path / "out")
    after.pop(".ltsh/job.json"), before.pop(".ltsh/job.json")
    assert after == before


def test_a_scene_that_fails_is_named_and_the_others_are_done(capsys, monkeypatch, room, tmp_path):
    fake = fake_scene.FakeChild().install(monkeypatch)
    extract = fake.extract

    def fail_at_two(options, *, progress=None, look=None):
        if options.frame == 2:
            raise SceneError("room.blend: no light\nat this frame")
        return extract(options, progress=progress)

    from ltsh_addon.blender.process import pixels

    monkeypatch.setattr(pixels, "extract_pixels", fail_at_two)
    arguments = ["shade", room, "--frames", "1-3", *SMALL]
    code, _, stderr = run(capsys, *arguments, "-o", tmp_path / "one")
    assert code == 1 and "failed: shade_0002: room.blend: no light at this frame" in stderr.splitlines()
    stderr = run(capsys, *arguments[:-1], "-o", tmp_path / "told")[2]
    assert "2 of 3: shade_0002 failed in " in stderr and "3 of 3: shade_0003 in " in stderr
    codes = [run(capsys, *arguments, "-o", tmp_path / "two", "--shard", shard)[0] for shard in ("1/2", "2/2")]
    assert codes == [0, 1] and run(capsys, "merge", tmp_path / "two")[0] == 1
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    monkeypatch.setattr(pixels, "extract_pixels", extract)
    code, _, stderr = run(capsys, *arguments[:-1], "-o", tmp_path / "one", "--resume")
    assert (code, [options.frame for options in fake.asked[-1:]]) == (0, [2]) and "failed" not in stderr
    assert "2 of 3 tasks were there already\n" in stderr


def test_results_of_different_versions_are_not_mixed(child, room, tmp_path):
    batch.run_tasks(job(room, tmp_path / "out", frames=(1, 2)))
    path = tmp_path / "out" / tasks.FOLDER / "tasks" / "shade_0002.json"
    path.write_text(path.read_text().replace("5.2.3", "4.5.15"))
    (problem,) = merge(tmp_path / "out").problems
    assert "different versions" in problem and "5.2.3" in problem and "4.5.15" in problem


def test_two_jobs_in_one_folder_leave_each_others_files(child, room, tmp_path):
    first, second = (job(room, tmp_path / "out", command, frames=(1, 2)) for command in ("shade", "compare"))
    batch.run_tasks(first)
    before = contents(tmp_path / "out")
    batch.run_tasks(second)
    after = contents(tmp_path / "out")
    assert all(after[name] == data for name, data in before.items() if name != ".ltsh/job.json")
    assert batch.run_tasks(first, existing=batch.RESUME).finished_before == 2
    assert batch.run_tasks(second, existing=batch.RESUME).finished_before == 2
