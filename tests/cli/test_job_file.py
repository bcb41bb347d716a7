"""Job files: what they do, and that every mistake in them is named with its job and key before anything starts."""

import json

import pytest
from fake_scene import run


@pytest.fixture
def folder(tmp_path):
    for name in ("room", "hall"):
        (tmp_path / f"{name}.blend").write_bytes(b"BLENDER")
    return tmp_path


def written(folder, text):
    path = folder / "night.toml"
    path.write_text(text, encoding="utf-8")
    return path


GOOD = """
[defaults]
techniques = ["ltc"]
passes = "diffuse"
cycles-samples = 4      # shade has no such option, and does not mind

[[job]]
command = "shade"
scene = "room.blend"
output = "out/shade"
frames = [3, 1]

[[job]]
command = "compare"
scenes = ["room.blend", "hall.blend"]
output = "out/compare"
camera = ["A", "B"]
techniques = "ltc,reference"
resolution = "64x36"
"""


def test_all_jobs_are_done_with_paths_beside_the_file(capsys, monkeypatch, child, folder, tmp_path_factory):
    path = written(folder, GOOD)
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    code, stdout, stderr = run(capsys, "run", path)
    assert code == 0 and "job 1 of 2 (shade, " in stderr and "written to" in stdout
    names = sorted(path.name for path in (folder / "out").rglob("*.exr"))
    pictures = [f"compare_{scene}_{camera}.exr" for scene in ("hall", "room") for camera in "AB"]
    assert names == [*pictures, "shade_0001.exr", "shade_0003.exr"]
    assert [(options.frame, options.cycles_samples) for options in child.asked[:2]] == [(3, 0), (1, 0)]
    assert {(options.camera, options.cycles_samples, options.width) for options in child.asked[2:]} == {
        ("A", 4, 64), ("B", 4, 64)
    }  # fmt: skip


def test_a_job_file_can_be_sharded_resumed_and_merged(capsys, child, folder):
    path = written(folder, GOOD)
    assert run(capsys, "run", path, "--shard", "1/2", "--quiet")[0] == 0
    code, _, stderr = run(capsys, "merge", path, "--quiet")
    assert code == 1 and "missing: shade_0001" in stderr and "missing: compare_room_B" in stderr
    assert run(capsys, "run", path, "--shard", "2/2", "--quiet")[0] == 0
    asked = len(child.asked)
    assert run(capsys, "merge", path, "--quiet")[0] == 0
    code, stdout, _ = run(capsys, "run", path, "--resume", "--json", "--quiet")
    document = json.loads(stdout)
    assert code == 0 and len(child.asked) == asked == 6
    assert [len(job["reports"]) for job in document["jobs"]] == [2, 4]


def test_a_job_that_fails_does_not_keep_the_others(capsys, child, folder):
    text = GOOD.replace('output = "out/shade"', 'output = "blocked/shade"')
    (folder / "blocked").write_text("a file")
    code, stdout, stderr = run(capsys, "run", written(folder, text), "--json", "--quiet")
    assert code == 1 and "failed: job 1 of 2 (shade, " in stderr and "cannot be written" in stderr
    jobs = json.loads(stdout)["jobs"]
    assert "cannot be written" in jobs[0]["error"] and len(jobs[1]["reports"]) == 4


SHADE = '[[job]]\ncommand = "shade"\nscene = "room.blend"\noutput = "out"\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["night.toml: no job is there, expected at least one [[job]]"]),
        ("[[job]]\n", ["job 1: command is None, expected one of shade, compare, bake"]),
        ('\n[[job]]\ncommand = "rend"\n', ["job 1: command is 'rend'"]),
        (SHADE + "frams = 3\n", ["job 1: option 'frams' is unknown here; expected some of", "frames", "scene"]),
        (SHADE + 'frames = "1-"\n', ["job 1: frames: frame is '1-', expected a whole number"]),
        (SHADE + "frames = 1.5\n", ["job 1: frames: frame is '1.5'"]),
        (SHADE + "frames = true\n", ["job 1: frames is True, expected text, a number or a list"]),
        (SHADE + "frames = []\n", ["job 1: frames is [], expected"]),
        (SHADE + 'resolution = "480"\n', ["job 1: resolution is '480', expected WIDTHxHEIGHT"]),
        (SHADE + "cycles-samples = 4\n", ["job 1: option 'cycles-samples' is unknown here"]),
        (SHADE + "resume = true\n", ["job 1: option 'resume' is unknown here; give it to `ltsh run`"]),
        (SHADE + "[defaults]\ntechnique = 1\n", ["defaults: option 'technique' is unknown here", "techniques"]),
        (SHADE + '[defaults]\naa = "x"\n', ["defaults: aa: 'x' was given, expected a whole number"]),
        (SHADE + "[job2]\n", ["night.toml: table 'job2' is unknown here; expected defaults and job"]),
        (SHADE.replace("room.blend", "cellar.blend"), ["job 1:", "cellar.blend: no such file"]),
        (SHADE + 'techniques = ["mine.npz"]\n', ["job 1:", "mine.npz"]),
        (SHADE.replace('"out"', "3"), ["job 1: output is 3, expected a folder"]),
        (SHADE.replace('output = "out"\n', ""), ["job 1: output is missing"]),
        (SHADE.replace('"room.blend"', "[]"), ["job 1: scene is [], expected the name of a .blend"]),
        (SHADE + 'scenes = ["hall.blend"]\n', ["job 1: scene and scenes are both there"]),
        (SHADE + SHADE, ["job 2: output is 'out', as of job 1; expected a folder for each job"]),
        (SHADE.replace("shade", "bake") + "error = 1\n", ["job 1: error is 1, expected true or false"]),
        (SHADE.replace("shade", "bake") + "all = true\nselected = true\n", ["job 1:", "not allowed with"]),
        (SHADE.replace("shade", "bake") + "apply = true\ncamera = ['A', 'B']\n", ["job 1: --apply"]),
        (SHADE + 'shadows = "none"\n', ["job 1: shadows is 'none', expected"]),
        (SHADE + "frames = \n", ["is no TOML", "line 5"]),
        ("defaults = 3\n" + SHADE, ["night.toml: defaults: expected a table"]),
        ("job = 3\n", ["night.toml: no job is there"]),
    ],
)
def test_a_mistake_is_named_with_its_job(capsys, child, folder, text, expected):
    path = written(folder, text)
    code, stdout, stderr = run(capsys, "run", path)
    of_the_world = "no such file" in stderr or "mine.npz" in stderr
    assert (code, stdout) == (1 if of_the_world else 2, "") and len(stderr.splitlines()) == 1
    assert stderr.startswith(f"ltsh: {path}") and all(part in stderr for part in expected), stderr
    assert child.asked == [] and not (folder / "out").exists()


def test_all_mistakes_are_named_in_the_order_of_jobs(capsys, child, folder):
    text = "[defaults]\nmargin = -1\n" + SHADE + "aa = 0\nframs = 1\n"
    text += 2 * "[[job]]\ncommand = 'bake'\nscene = 'room.blend'\nsize = 3\n"
    code, _, stderr = run(capsys, "run", written(folder, text))
    found = [line.partition(", ")[2].split()[:3] for line in stderr.splitlines()]
    assert code == 2 and found == [
        ["job", "1:", "aa:"], ["job", "1:", "option"], ["job", "2:", "output"], ["job", "2:", "size"],
        ["defaults:", "margin", "is"], ["job", "3:", "output"], ["job", "3:", "size"],
    ]  # fmt: skip
