"""The Flamenco job type, run by a JavaScript engine against a stub of Flamenco's interface; its tasks are commands that
our command line takes. That shards merged are the single run: tests/pipeline/test_jobs.py."""

import json
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from ltsh_addon.cli import commands as cli_commands
from ltsh_addon.scene import DEFAULT_TECHNIQUE

ROOT = Path(__file__).resolve().parents[2]
ENGINE = shutil.which("node") or shutil.which("qjs") or shutil.which("nodejs")
pytestmark = pytest.mark.skipif(ENGINE is None, reason="needs a JavaScript engine: apt-get install nodejs (or quickjs)")
SCENE = "/shared/room 1.blend"


def compiled(tmp_path, **settings):
    """What the job type makes of `settings`."""
    given = {"blendfile": SCENE, "output": "/shared/out", **settings}
    script = tmp_path / "job.js"
    texts = [(ROOT / name).read_text() for name in ("tests/farm/flamenco_stub.js", "farm/ltsh_bake.js")]
    script.write_text("\n".join([*texts, f"report({json.dumps(given)});\n"]), encoding="utf-8")
    done = subprocess.run([ENGINE, str(script)], capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


def commands(found):
    """The arguments of `ltsh` of each task."""
    arguments = []
    for task in found["tasks"]:
        (command,) = task["commands"]
        assert (task["type"], command["name"]) == ("blender", "exec")
        assert command["parameters"]["exe"] == "{blender}"
        first, second, *rest = command["parameters"]["args"]
        assert (first, second) == ("--command", "ltsh")
        arguments.append(rest)
    return arguments


def test_settings_have_labels_and_descriptions_and_are_refused_where_they_make_no_sense(tmp_path):
    settings = compiled(tmp_path)["settings"]
    assert all(setting["label"] for setting in settings)
    assert all(setting["description"] for setting in settings if setting.get("visible") != "hidden")
    keys = [setting["key"] for setting in settings]
    assert len(set(keys)) == len(keys) and {"blendfile", "output", "shards"} <= set(keys)
    commands = "bake, compare, shade, render, view"
    assert f"command is merge, expected one of {commands}" in compiled(tmp_path, command="merge")["error"]
    assert "cycles_samples is 1, expected 0, or 2 or more" in compiled(tmp_path, cycles_samples=1)["error"]
    for name, found in (("shards", "0, expected 1 or more"), ("output", "empty"), ("blendfile", "empty")):
        assert f"{name} is {found}" in compiled(tmp_path, **{name: 0 if name == "shards" else ""})["error"]


@pytest.mark.parametrize("count", [1, 4, 17])
def test_there_is_a_task_for_each_shard_and_a_merge_that_waits_for_all(tmp_path, count):
    found = compiled(tmp_path, shards=count)
    *shards, last = commands(found)
    assert [line[line.index("--shard") + 1] for line in shards] == [f"{i}/{count}" for i in range(1, count + 1)]
    assert all("--resume" in line for line in shards) and last == ["merge", "/shared/out"]
    *tasks, merge = found["tasks"]
    assert [task["dependencies"] for task in tasks] == [[]] * count and merge["dependencies"] == list(range(count))
    assert len({task["name"] for task in found["tasks"]}) == count + 1


BAKE = {"objects": "Floor; Big Wall;", "size": 256, "error": True, "apply": True, "cycles_samples": 64, "frames": "-3"}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, {"techniques": (DEFAULT_TECHNIQUE,), "passes": ("specular", "diffuse"), "objects": "all", "frames": ()}),
        (BAKE, {"objects": ("Floor", "Big Wall"), "size": (256, 256), "error": True, "apply": True,
                "cycles_samples": 64, "frames": (-3,)}),
        ({"passes": "diffuse_light,combined"}, {"passes": ("diffuse_light", "combined"), "error": False}),
        ({"command": "compare", "frames": "-2-1", "cycles_samples": 32, "arguments": " --aa 4  --camera Left"},
         {"frames": (-2, -1, 0, 1), "cycles_samples": 32, "sub_samples": 4, "cameras": ("Left",)}),
        ({"command": "shade", "techniques": "ltc,ltsh2", "arguments": "--resolution=96x54", "frames": ""},
         {"techniques": ("ltc", "ltsh2"), "resolution": (96, 54), "frames": ()}),
        ({"command": "compare"}, {"cycles_samples": 512}),
        ({"error": True}, {"error": True, "cycles_samples": 256}),
        ({"command": "render", "frames": "1-3"},
         {"techniques": (DEFAULT_TECHNIQUE,), "frames": (1, 2, 3), "cycles_samples": None, "budget": None}),
        ({"command": "render", "cycles_samples": 64, "arguments": "--denoise off"},
         {"cycles_samples": 64, "budget": None, "denoise": "off"}),
        ({"command": "render", "arguments": "--budget 30"}, {"cycles_samples": None, "budget": 30.0}),
        ({"command": "view", "techniques": "ltc,ltsh4", "arguments": "--refine 4", "cycles_samples": 64},
         {"techniques": ("ltc", "ltsh4"), "refine": 4}),
    ],
)  # fmt: skip
def test_every_task_is_a_command_line_that_ltsh_takes(tmp_path, settings, expected):
    for number, (command, *arguments) in enumerate(commands(compiled(tmp_path, shards=2, **settings))[:-1], 1):
        given = cli_commands.job_parsers()[command].parse_args(arguments)
        job = cli_commands.job_of(given, given.scenes)
        assert command == settings.get("command", "bake") and job.scenes == [SCENE]
        assert given.shard == (number, 2) and job.options.output == Path("/shared/out")
        found = {**vars(job.options), "frames": job.frames, "cameras": job.cameras}
        assert {name: found[name] for name in expected} == expected


def test_the_commands_are_those_that_a_job_file_may_have(tmp_path):
    (setting,) = (setting for setting in compiled(tmp_path)["settings"] if setting["key"] == "command")
    assert set(setting["choices"]) == set(cli_commands.job_parsers())


@pytest.mark.parametrize("command", sorted(cli_commands.job_parsers()))
def test_the_example_of_further_arguments_is_taken_by_every_command(tmp_path, command):
    (described,) = (s["description"] for s in compiled(tmp_path)["settings"] if s["key"] == "arguments")
    example = described.partition("such as ")[2]
    line, *_ = commands(compiled(tmp_path, command=command, arguments=example))
    given = cli_commands.job_parsers()[command].parse_args(line[1:])
    assert cli_commands.job_of(given, given.scenes).cameras == ("Left",)


# Under this name the add-on lets the manager check a job before it submits the file.
DUMMY = "dummy-for-job-check.blend"


@pytest.mark.parametrize(
    ("settings", "output", "expected"),
    [
        ({"folder": "/shared"}, "//ltsh", "/shared/ltsh"),
        ({"folder": "/shared", "blendfile": DUMMY}, "//ltsh", "/shared/ltsh"),
        ({"folder": "/shared", "blendfile": "{jobs}/room-1/room.flamenco.blend"}, "//../out", "/shared/../out"),
        ({"folder": "S:\\shows"}, "//ltsh\\bake", "S:\\shows/ltsh\\bake"),
        ({}, "//ltsh", "/shared/ltsh"),
        ({"blendfile": "S:\\shows\\room.blend"}, "//ltsh", "S:\\shows/ltsh"),
        ({"folder": "/elsewhere"}, "/shared/out", "/shared/out"),
    ],
)
def test_the_output_may_be_relative_to_the_scene(tmp_path, settings, output, expected):
    """That is the file which was submitted; a script that submits need not say where that lies."""
    found = compiled(tmp_path, output=output, **settings)
    *shards, merge = commands(found)
    assert all(line[line.index("-o") + 1] == expected for line in shards) and merge == ["merge", expected]
    assert found["given"]["output"] == expected  # what Flamenco shows of the job


def test_a_relative_output_needs_the_folder_of_the_scene(tmp_path):
    error = compiled(tmp_path, blendfile="room.blend", output="//ltsh")["error"]
    assert "output is //ltsh, but blendfile, room.blend, has no folder" in error


def evaluated(tmp_path, key, filepath, command="bake"):
    """What Flamenco's add-on makes of the expression of a setting: when the type is chosen and, where its button is
    linked, when the job is submitted."""
    (setting,) = (setting for setting in compiled(tmp_path)["settings"] if setting["key"] == key)
    if setting.get("visible") != "hidden":
        assert setting["evalInfo"]["showLinkButton"] and setting["evalInfo"]["description"]
    names = {
        "bpy": SimpleNamespace(data=SimpleNamespace(filepath=filepath)),
        "C": SimpleNamespace(scene=SimpleNamespace(frame_current=12)),
        "Path": Path,
        "settings": SimpleNamespace(command=command),
    }
    return eval(setting["eval"], {}, names)


def test_evaluated_settings_follow_the_scene(tmp_path):
    """In a file without a name there is no folder yet: the manager refuses the job, the add-on does not fail."""
    assert evaluated(tmp_path, "output", SCENE) == str(Path("/shared/ltsh/bake"))
    assert evaluated(tmp_path, "output", SCENE, "compare") == str(Path("/shared/ltsh/compare"))
    assert evaluated(tmp_path, "output", "") == ""
    assert evaluated(tmp_path, "frames", "") == "12"
    assert evaluated(tmp_path, "folder", SCENE) == str(Path("/shared"))
