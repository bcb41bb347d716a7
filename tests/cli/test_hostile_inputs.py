"""Inputs that nobody meant, as far as no Blender is needed to refuse them: one line, the right exit code, at once.

Those that are scenes: tests/blender/pipeline/test_hostile_scenes.py.
"""

import json
import os
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import fake_scene
import numpy as np
import pytest

from ltsh_addon import cli, imaging
from ltsh_addon.blender.process.blender_process import running
from ltsh_addon.cli import progress

ROOT = Path(__file__).resolve().parents[2]
TABLE = (ROOT / "tables" / "ltsh2.npz").read_bytes()
SHADE = ["shade", "room.blend", "-o", "out"]
COMPARE = ["compare", "room.blend", "-o", "out"]
BAKE = ["bake", "room.blend", "-o", "out"]
NUMBERS = np.random.default_rng(7)
DIGITS = "is no way to write it, expected"
NESTED = "more than 32 lists or tables"
JOB = '[[job]]\ncommand = "shade"\nscene = "room.blend"\noutput = "out"\n'


def text(content):
    return lambda path: path.write_text(content, encoding="utf-8")


def data(content):
    return lambda path: path.write_bytes(content)


def exr(path):
    imaging.write_layers(path, {"a": np.zeros((4, 4, 3), np.float32)})


def damaged_table(path):
    content = bytearray(TABLE)
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def table(**changes):
    """The shipped table with other arrays, or with other bytes in their place."""

    def write(path):
        with np.load(ROOT / "tables" / "ltsh2.npz") as arrays, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
            for name in arrays.files:
                content = changes.get(name, arrays[name])
                with new.open(f"{name}.npy", "w") as file:
                    file.write(content) if isinstance(content, bytes) else np.save(file, content)

    return write


def claim(*shape):
    """The start of an array that says it has so many float32."""
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def below(write):
    """Write the file into folders that are not there yet."""
    return lambda path: (path.parent.mkdir(parents=True), write(path))


def finished(**changes):
    """job.json of a job of one task, with changes."""
    task = {"scene": "a", "camera": None, "frame": 1, "object": None, "name": "a", "key": "k", "tile": None}
    job = {"format": 1, "command": "shade", "single": True, "any_key": False, "applied_layer": None, "tasks": [task]}
    task |= changes.pop("task", {})
    return ("done/.ltsh/job.json", below(text(json.dumps(job | changes))))


def foreign_table(path):
    np.savez(path, anything=np.zeros(3))


def table_of_objects(path):
    """Reading it would run what its pickle says."""
    np.savez(path, anything=np.array([{"a": 1}], dtype=object), metadata=np.array([{"b": 2}], dtype=object))


def newer_scene(header=b"BLENDER17-01v0999"):
    """A .blend of Blender 9.99: the header as it is since 5.0, or as it was before."""
    return data(header + NUMBERS.bytes(9999))


NEWER = "was saved by Blender 9.99, but this is Blender {}[.]{}".format(*running())
SHADE_A = ["shade", "a.blend", "-o", "out"]

# id: how to make which file (None: none is needed), the arguments, the exit code, what the line must say
CASES = {
    "missing scene": (None, ["shade", "none.blend", "-o", "out"], 1, r"none\.blend: no such file"),
    "empty scene": (("a.blend", data(b"")), ["shade", "a.blend", "-o", "out"], 1, r"a\.blend: the file is empty"),
    "text as scene": (("a.blend", text("hello\n")), ["shade", "a.blend", "-o", "out"], 1, r"a\.blend: is no \.blend"),
    "EXR as scene": (("a.blend", exr), ["compare", "a.blend", "-o", "out"], 1, r"a\.blend: is no \.blend"),
    "newer scene": (("a.blend", newer_scene()), SHADE_A, 1, NEWER),
    "newer scene, old header": (("a.blend", newer_scene(header=b"BLENDER-v999")), SHADE_A, 1, NEWER),
    "newer scene, next header": (("a.blend", newer_scene(header=b"BLENDER19-02v0999")), SHADE_A, 1, NEWER),
    "newer scene in a job file": (("room.blend", newer_scene()), ["run", "job.toml"], 1, f"job 1: .*{NEWER}"),
    "folder as scene": (("a.blend", Path.mkdir), ["bake", "a.blend", "-o", "out"], 1, r"a\.blend: is a folder"),
    "pipe as scene": (("a.blend", os.mkfifo), ["shade", "a.blend", "-o", "out"], 1, "is a device or a pipe"),
    "device as scene": (None, ["shade", "/dev/zero", "-o", "out"], 1, "/dev/zero: is a device or a pipe"),
    "name of a scene too long": (None, ["shade", "x" * 300, "-o", "out"], 1, "File name too long"),
    "output is a file": (("file", text("mine")), ["shade", "room.blend", "-o", "file"], 1, "output folder file"),
    "output that cannot be": (None, ["shade", "room.blend", "-o", "/proc/ltsh"], 1, "output folder /proc/ltsh"),
    "output too long": (None, ["compare", "room.blend", "-o", "x" * 300], 1, "File name too long"),
    "output without a name": (None, ["shade", "room.blend", "-o", ""], 2, "name of the folder is empty"),
    "log is a folder": (None, [*SHADE, "--log", "."], 1, "log .: cannot be written"),
    "huge texture": (None, [*BAKE, "--size", "1000000"], 2, "each from 64 to 8192"),
    "negative margin": (None, [*BAKE, "--margin", "-1"], 2, "expected a whole number from 0 to 512"),
    "view that is no number": (None, [*BAKE, "--view", "nan,0,0"], 2, "view is 'nan,0,0'"),
    "endless Cycles": (None, [*COMPARE, "--cycles-samples", "9" * 30], 2, "expected at most 33554432"),
    "frames beyond Blender's": (None, [*SHADE, "--frames", "1-99999999999"], 2, "frame is '1-99999999999'"),
    "a million frames": (None, [*SHADE, "--frames=-524288-524288"], 2, "expected at most 100000 of them"),
    "missing table": (None, [*SHADE, "--techniques", "no.npz"], 1, "lookup table no.npz"),
    "cut table": (("t.npz", data(TABLE[:9999])), [*SHADE, "--techniques", "t.npz"], 1, "lookup table t.npz"),
    "damaged table": (("t.npz", damaged_table), [*BAKE, "--techniques", "t.npz"], 1, "lookup table t.npz"),
    "foreign table": (("t.npz", foreign_table), [*COMPARE, "--techniques", "t.npz"], 1, "lookup table t.npz"),
    "table of objects": (("t.npz", table_of_objects), [*SHADE, "--techniques", "t.npz"], 1, "lookup table t.npz"),
    "claims of a table": (("t.npz", table(warp=claim(16384, 16384, 3) + bytes(9999))),
                          [*SHADE, "--techniques", "t.npz"], 1, "warp has shape .16384, 16384, 3. of float32, but"),
    "huge table": (("t.npz", table(warp=claim(65 << 18) + bytes(65 << 20))), [*SHADE, "--techniques", "t.npz"], 1,
                   r"holds 6\d MiB of arrays, expected at most 64 MiB"),
    "flat table": (("t.npz", table(warp=np.zeros((1, 64, 3), np.float32))), [*SHADE, "--techniques", "t.npz"], 1,
                   r"warp has shape \(1, 64, 3\), expected at least \(2, 2, 3\)"),
    "pipe as table": (("t.npz", os.mkfifo), [*SHADE, "--techniques", "t.npz"], 1, "lookup table t.npz: no such file"),
    "endless digits": (None, [*SHADE, "--name", "{frame:0999999999d}"], 2, DIGITS),
    "a name of 5 MB": (None, [*SHADE, "--name", "{frame:05000000d}"], 2, DIGITS),
    "field in a field": (None, [*SHADE, "--name", "{frame:{scene}}"], 2, DIGITS),
    "letters of many bytes": (None, [*SHADE, "--name", "\U0001f986" * 90], 2, "360 bytes long, expected at most 200"),
    "output that is no UTF-8": (None, ["shade", "room.blend", "-o", "o\udcff"], 2, "argument .* not UTF-8"),
    "scene that is no UTF-8": (("s\udcff", data(b"BLENDER")), ["shade", "s\udcff", "-o", "out"], 2, "not UTF-8"),
    "folder that is no UTF-8": (("d\udcff", Path.mkdir), ["merge", "d\udcff"], 2, "not UTF-8"),
    "full log": (None, [*SHADE, "--log", "/dev/full"], 1, "log /dev/full: cannot be written .No space left"),
    "device as baseline": (None, [*COMPARE, "--baseline", "/dev/zero"], 1, "is a device or a pipe"),
    "deep baseline": (("b.json", text("[" * 200_000)), [*COMPARE, "--baseline", "b.json"], 1, NESTED),
    "wide baseline": (("b.json", text("[" + "[]," * 4_000_001)), [*COMPARE, "--baseline", "b.json"], 1, "values"),
    "baseline of long numbers": (("b.json", text("9" * 9999)), [*COMPARE, "--baseline", "b.json"], 1, "4300 digits"),
    "baseline with half letters": (
        ("b.json", text('{"scene": "\\ud800"}')), [*COMPARE, "--baseline", "b.json"], 1, "no Unicode",
    ),
    "missing baseline": (None, [*COMPARE, "--baseline", "no.json"], 1, "baseline no.json: cannot be read"),
    "damaged baseline": (("b.json", text('{"passes": ')), [*COMPARE, "--baseline", "b.json"], 1, "baseline b.json"),
    "missing job file": (None, ["run", "no.toml"], 1, "no.toml: cannot be read"),
    "job file of noise": (("j.toml", data(b"\xff\xfe" * 99)), ["run", "j.toml"], 2, "j.toml: is no text in UTF-8"),
    "deep job file": (("j.toml", text("a = " + "[" * 9999)), ["run", "j.toml"], 2, "more than 32 lists"),
    "NUL in a job file": (
        ("j.toml", text(JOB.replace('"out"', '"a\\u0000b"'))), ["run", "j.toml"], 2, "job 1: output is",
    ),
    "dotted job file": (("j.toml", text("a." * 200_000 + "a = 1")), ["run", "j.toml"], 2, "more than 32 parts"),
    "large job file": (("j.toml", text("#" * 2_000_000)), ["run", "j.toml"], 2, "has more than 1 MiB"),
    "pipe as job file": (("j.toml", os.mkfifo), ["run", "j.toml"], 2, "is a device or a pipe"),
    "large number in a job file": (
        ("j.toml", text(f"{JOB}aa = 0x{'f' * 99}")), ["run", "j.toml"], 2, "does not fit into 64 bits",
    ),
    "scripts in a job file": (
        ("j.toml", text(f"{JOB}enable-autoexec = true")), ["run", "j.toml"], 2,
        "job 1: option 'enable-autoexec' is unknown here; give it to `ltsh run` on the command line",
    ),
    "scripts in all jobs": (
        ("j.toml", text(f"[defaults]\nenable-autoexec = true\n{JOB}")), ["run", "j.toml"], 2,
        "defaults: option 'enable-autoexec' is unknown here",
    ),
    "merge of a deep job": (("done/.ltsh/job.json", below(text("[" * 200_000))), ["merge", "done"], 1, NESTED),
    "merge of no tasks": (finished(tasks=[]), ["merge", "done"], 1, "job.json: tasks is empty"),
    "merge of tasks of numbers": (finished(tasks=[3]), ["merge", "done"], 1, r"tasks\[0\] is 3, expected a table"),
    "merge of another command": (finished(command="rm"), ["merge", "done"], 1, "command is 'rm', expected 'shade' or"),
    "merge of a job of the future": (finished(format=2), ["merge", "done"], 1, "another version of LTSH, expected"),
    "merge of files elsewhere": (
        finished(task={"name": "../../etc/passwd"}), ["merge", "done"], 1, "expected a name below the folder",
    ),
    "merge of a frame of text": (
        finished(task={"frame": "1"}), ["merge", "done"], 1, "frame is '1', expected a whole number or nothing",
    ),
    "merge of a file": (("file", text("mine")), ["merge", "file"], 1, "file: no task has finished there"),
    "merge of nothing": (None, ["merge", "none"], 1, "none: no task has finished there"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_hostile_input_is_refused_in_one_line(capsys, monkeypatch, tmp_path, case):
    file, arguments, expected, complaint = CASES[case]
    child = fake_scene.FakeChild().install(monkeypatch)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.blend").write_bytes(b"BLENDER")
    (tmp_path / "job.toml").write_text(JOB, encoding="utf-8")
    if file is not None:
        file[1](tmp_path / file[0])
    before = contents(tmp_path)
    code = cli.main(arguments)
    stdout, stderr = capsys.readouterr()
    line = stderr.splitlines()[-1]
    assert (code, stdout) == (expected, "") and re.search(complaint, line), stderr
    assert line.startswith("ltsh") and "Traceback" not in stderr and child.asked == []
    # One line, below the usage where that is what was wrong with the arguments.
    assert len(stderr.splitlines()) == 1 or (code == 2 and stderr.startswith("usage: ")), stderr
    assert contents(tmp_path) == before


def contents(folder):
    """All paths below a folder, with the bytes of files."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def ended(folder, *arguments, **options):
    """Exit code and stderr of a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "ltsh_addon", *arguments]
    options = {"stdout": subprocess.DEVNULL, **options}
    done = subprocess.run(command, cwd=folder, env=environment, stderr=subprocess.PIPE, timeout=60, **options)
    return done.returncode, done.stderr.decode()


@pytest.mark.parametrize("arguments", [["--help"], ["merge", "out", "--json", "--quiet"]])
@pytest.mark.parametrize("stream", ["full", "broken pipe"])
def test_a_stdout_that_takes_nothing_is_said_in_one_line(capsys, child, room, tmp_path, arguments, stream):
    assert fake_scene.run(capsys, "shade", room, "-o", tmp_path / "out", "--techniques", "ltc")[0] == 0
    reading, writing = os.pipe()
    os.close(reading)
    with open("/dev/full", "wb") as full, open(writing, "wb") as broken:
        code, stderr = ended(tmp_path, *arguments, stdout=full if stream == "full" else broken)
    reason = "No space left on device" if stream == "full" else "Broken pipe"
    assert (code, stderr) == (1, f"ltsh: stdout: cannot be written ({reason})\n")


def test_an_interrupt_while_modules_are_loaded_is_one_line(tmp_path):
    command = [sys.executable, "-X", "importtime", "-m", "ltsh_addon", "--help"]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=ROOT, text=True, **pipes) as process:
        for line in process.stderr:  # numpy has more modules to come
            if "numpy" in line:
                break
        process.send_signal(signal.SIGINT)
        rest = [line for line in process.stderr if not line.startswith("import time:")]
    assert (process.returncode, rest) == (130, ["ltsh: interrupted\n"])


def test_a_log_that_fills_its_disk_does_not_end_the_work(capsys, monkeypatch, child, room, tmp_path):
    line = progress.RunLog.line

    def fill(log, text):
        line(log, text)
        with open("/dev/full", "ab") as full:
            os.dup2(full.fileno(), log._file.fileno())

    monkeypatch.setattr(progress.RunLog, "line", fill)
    arguments = ["shade", room, "-o", tmp_path / "out", "--techniques", "ltc", "--log", tmp_path / "log"]
    code, stdout, stderr = fake_scene.run(capsys, *arguments)
    assert code == 1 and "written to" in stdout and stderr.count("cannot be written (No space left on device)") == 1
    assert (tmp_path / "out" / "shade.exr").is_file() and len((tmp_path / "log").read_text().splitlines()) == 1


def test_a_job_file_may_begin_with_a_byte_order_mark_and_scripts_are_allowed_by_the_command_line(
    capsys, child, room, tmp_path
):
    (tmp_path / "j.toml").write_bytes(b"\xef\xbb\xbf" + JOB.encode() + b'techniques = "ltc"\r\n')
    assert fake_scene.run(capsys, "run", tmp_path / "j.toml")[0] == 0
    assert fake_scene.run(capsys, "run", tmp_path / "j.toml", "--enable-autoexec")[0] == 0
    assert [options.scripts for options in child.asked] == [False, True]


def test_a_folder_whose_path_is_no_utf8_is_refused(tmp_path):
    """OpenEXR ended the process."""
    folder = tmp_path / "d\udcff"
    folder.mkdir()
    (folder / "room.blend").write_bytes(b"BLENDER")
    code, stderr = ended(folder, "shade", "room.blend", "-o", "out")
    assert code == 1 and "bytes that are not UTF-8" in stderr and stderr.count("\n") == 1
    with pytest.raises(OSError, match="bytes that are not UTF-8"):
        imaging.write_layers(folder / "a.exr", {"a": np.zeros((4, 4, 3), np.float32)})
    assert sorted(path.name for path in folder.iterdir()) == ["room.blend"]


def test_cases_at_random_end_as_they_should():
    """Some of those that `make soak` tries."""
    command = [sys.executable, str(ROOT / "tests" / "soak" / "fuzz.py"), "--cases", "36", "--seed", "7"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
