"""The Slurm scripts: what they refuse, and with `make test-farm` an array on a real Slurm of this machine."""

import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import slurm_cluster
from kills import contents

from ltsh_addon.cli.commands import job_parsers

ROOT = Path(__file__).resolve().parents[2]
FARM = ROOT / "farm"
WANTED = os.environ.get("LTSH_TEST_SLURM") == "1"
LTSH = [sys.executable, "-m", "ltsh_addon"]
SECONDS = 600.0


def script(name, *arguments, **environment):
    """A script without Slurm, in which `ltsh` and sbatch only say how they were called."""
    return subprocess.run(
        ["bash", str(FARM / name), *map(str, arguments)], env={"PATH": os.environ["PATH"], **environment},
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip


def program(path, text):
    path.write_text(text)
    path.chmod(0o755)
    return path


ARRAY = {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_MAX": "4",
         "SLURM_ARRAY_TASK_COUNT": "4"}  # fmt: skip
ONE = {**ARRAY, "SLURM_ARRAY_TASK_MIN": "3", "SLURM_ARRAY_TASK_MAX": "3", "SLURM_ARRAY_TASK_COUNT": "1"}


@pytest.mark.parametrize(
    ("environment", "complaint"),
    [(ARRAY, ""), ({**ONE, "LTSH_SHARDS": "4"}, ""), ({}, "is no task of an array"), (ONE, "LTSH_SHARDS")],
)
def test_a_task_of_an_array_is_a_shard_where_their_number_is_known(environment, complaint):
    done = script("slurm_bake.sh", "bake", "a b.blend", "-o", "out", LTSH="printf %s|", **environment)
    expected = (2, "") if complaint else (0, "bake|a b.blend|-o|out|--shard|3/4|--resume|")
    assert (done.returncode, done.stdout) == expected and complaint in done.stderr


@pytest.mark.parametrize(("code", "restarts", "requeued"), [
    (1, 0, True), (1, 1, True), (1, 2, False), (137, 0, True), (2, 0, False), (0, 0, False),
])  # fmt: skip
def test_a_failed_task_goes_back_into_the_queue_but_for_wrong_arguments(tmp_path, code, restarts, requeued):
    for name, text in (("ltsh", f"exit {code}"), ("scontrol", f'echo "$@" >{tmp_path}/called'), ("sleep", "")):
        program(tmp_path / name, f"#!/bin/bash\n{text}\n")
    path = f"{tmp_path}:{os.environ['PATH']}"
    environment = {**ARRAY, "SLURM_JOB_ID": "77", "SLURM_RESTART_COUNT": str(restarts), "PATH": path, "LTSH": "ltsh"}
    assert script("slurm_bake.sh", "bake", "a.blend", **environment).returncode == code
    called = tmp_path / "called"
    assert called.exists() == requeued and (not requeued or called.read_text() == "requeue 77\n")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "SHARDS is ''"),
        (["0", "bake", "a.blend", "-o", "x"], "SHARDS is '0'"),
        (["four", "bake"], "SHARDS is 'four'"),
        (["4", "merge", "-o", "x"], "the command is 'merge'"),
        (["4", "bake", "a.blend"], "-o OUT is missing"),
        (["4", "bake", "a.blend", "-o"], "-o OUT is missing"),
        (["4", "run", "none.toml"], "JOB.toml is 'none.toml'"),
    ],
)
def test_what_cannot_be_submitted_is_refused_with_the_usage(arguments, complaint):
    done = script("slurm_submit.sh", *arguments)
    assert (done.returncode, done.stdout) == (2, "") and complaint in done.stderr and "usage: " in done.stderr


OBJECTS = ["floor", "back wall", "left wall", "right wall"]
OBJECTS += [f"cabinet left {number} plastic screen" for number in (1, 2, 3, 4)]


@pytest.mark.parametrize(
    ("arguments", "logs", "merged"),
    [
        (["bake", "a b.blend", "-o", "{out}/x y"], "{out}/x y", "{out}/x y"),
        (["shade", "a.blend", "-o{out}/x", "--aa", "4"], "{out}/x", "{out}/x"),
        *(([command, "a.blend", "-o", "{out}/x"], "{out}/x", "{out}/x") for command in sorted(job_parsers())),
        (["run", "{out}/night.toml", "--quiet"], "{out}", "{out}/night.toml"),
    ],
)
def test_an_array_and_a_merge_that_waits_for_it_are_submitted(tmp_path, arguments, logs, merged):
    (tmp_path / "night.toml").write_text("")
    answer = 'echo "7$#;farm"\n'
    program(tmp_path / "sbatch", f'#!/bin/bash\necho "${{LTSH_SHARDS:-}}" "${{@@Q}}" >>{tmp_path}/called\n{answer}')
    *arguments, logs, merged = (text.format(out=tmp_path) for text in (*arguments, logs, merged))
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = script("slurm_submit.sh", 3, *arguments, PATH=path, SBATCH_OPTIONS="--partition=night --mem=8G")
    array, merge = (shlex.split(line) for line in (tmp_path / "called").read_text().splitlines())
    common = ["--parsable", "--partition=night", "--mem=8G"]
    output = f"--output={logs}/slurm_%A_%a.log"
    assert array == ["3", *common, "--array=1-3", output, f"{FARM}/slurm_bake.sh", *arguments]
    number = f"7{len(array) - 1}"
    assert merge == [*common, f"--dependency=afterok:{number}", "--kill-on-invalid-dep=yes",
                     f"--output={logs}/slurm_%j_merge.log", f"{FARM}/slurm_merge.sh", merged]  # fmt: skip
    assert done.returncode == 0 and done.stdout == f"{number} 7{len(merge)}\n" and Path(logs).is_dir()


FAILS_AT_FIRST = """#!/bin/bash
# `ltsh` whose shard 2 ends with 1 at first, and whose shard 3 is killed when it has done the first of its two objects.
case "$*" in
    *"--shard 2/4"*) mkdir {folder}/failed 2>/dev/null && exit 1 ;;
    *"--shard 3/4"*)
        if mkdir {folder}/killed 2>/dev/null; then
            {ltsh} "$@" & process=$!
            until [ -e "{folder}/four/.ltsh/tasks/left wall.json" ] || ! kill -0 $process; do sleep 0.02; done
            kill -KILL $process
            exit 137
        fi ;;
esac
exec {ltsh} "$@"
"""


@pytest.mark.skipif(not WANTED, reason="needs a Slurm of its own: make test-farm")
def test_an_array_with_failing_tasks_is_the_single_run_byte_for_byte():
    assert slurm_cluster.missing_programs() == []
    with tempfile.TemporaryDirectory(prefix="ltsh-slurm-") as name:
        folder = Path(name)
        scene = folder / "one" / "demo.blend"
        quick = ["--resolution", "16x9", "--techniques", "ltc", "--cycles-samples", "2", "--quiet"]
        subprocess.run([*LTSH, "demo", "-o", scene.parent, *quick], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        ltsh = program(folder / "ltsh", FAILS_AT_FIRST.format(folder=folder, ltsh=" ".join(LTSH)))
        wanted = ["bake", scene, "--size", "64", "--margin", "2", *(f"--object={name}" for name in OBJECTS)]
        (folder / "slurm").mkdir()
        with slurm_cluster.cluster(folder / "slurm") as farm:
            submit = [FARM / "slurm_submit.sh", "4", *wanted, "-o", folder / "four"]
            array, merge = farm.run(*submit, LTSH=str(ltsh), LTSH_RETRIES="1", PYTHONPATH=str(ROOT)).split()
            states = farm.wait(SECONDS)
        for name, (state, code, restarts) in states.items():
            print(f"{name}: {state}, exit code {code}, {restarts} restarts")
        said = "\n".join(path.read_text() for path in sorted((folder / "four").glob("slurm_*.log")))
        assert {name: row[:2] for name, row in states.items()} == dict.fromkeys(
            [*(f"{array}_{number}" for number in (1, 2, 3, 4)), merge], ("COMPLETED", "0:0")
        ), said
        assert [states[f"{array}_{number}"][2] for number in (1, 2, 3, 4)] == [0, 1, 1, 0], said
        assert "exit code 1, back into the queue" in said and "exit code 137, back into the queue" in said
        subprocess.run([*LTSH, *wanted, "-o", folder / "single", "--quiet"], cwd=ROOT, check=True)
        for path in (folder / "four").glob("slurm_*"):
            path.unlink()
        single, merged = contents(folder / "single"), contents(folder / "four")
        assert merged == single and sum(name.endswith(".exr") for name in single) == len(OBJECTS)
        print(f"{len(single)} files of {sum(map(len, single.values()))} bytes are those of the single run")
