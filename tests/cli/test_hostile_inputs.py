"""Inputs that nobody meant, as far as no Blender is needed to refuse them: one line, the right exit code, at once.

Those that are scenes: tests/blender/pipeline/test_hostile_scenes.py.
"""

import os
import re
from pathlib import Path

import fake_scene
import numpy as np
import pytest

from ltsh_addon import cli, imaging
from ltsh_addon.blender.process import client

ROOT = Path(__file__).resolve().parents[2]
TABLE = (ROOT / "tables" / "ltsh2.npz").read_bytes()
SHADE = ["shade", "room.blend", "-o", "out"]
COMPARE = ["compare", "room.blend", "-o", "out"]
BAKE = ["bake", "room.blend", "-o", "out"]
NUMBERS = np.random.default_rng(7)
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


def foreign_table(path):
    np.savez(path, anything=np.zeros(3))


def table_of_objects(path):
    """Reading it would run what its pickle says."""
    np.savez(path, anything=np.array([{"a": 1}], dtype=object), metadata=np.array([{"b": 2}], dtype=object))


def newer_scene(header=b"BLENDER17-01v0999"):
    """A .blend of Blender 9.99: the header as it is since 5.0, or as it was before."""
    return data(header + NUMBERS.bytes(9999))


NEWER = "was saved by Blender 9.99, but this is Blender {}[.]{}".format(*client.running())
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
    "missing baseline": (None, [*COMPARE, "--baseline", "no.json"], 1, "baseline no.json: cannot be read"),
    "damaged baseline": (("b.json", text('{"passes": ')), [*COMPARE, "--baseline", "b.json"], 1, "baseline b.json"),
    "missing job file": (None, ["run", "no.toml"], 1, "no.toml: cannot be read"),
    "job file of noise": (("j.toml", data(b"\xff\xfe" * 99)), ["run", "j.toml"], 2, "j.toml: is no text in UTF-8"),
    "deep job file": (("j.toml", text("a = " + "[" * 9999)), ["run", "j.toml"], 2, "more than 32 lists"),
    "NUL in a job file": (
        ("j.toml", text(JOB.replace('"out"', '"a\\u0000b"'))), ["run", "j.toml"], 2, "job 1: output is",
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
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    code = cli.main(arguments)
    stdout, stderr = capsys.readouterr()
    line = stderr.splitlines()[-1]
    assert (code, stdout) == (expected, "") and re.search(complaint, line), stderr
    assert line.startswith("ltsh") and "Traceback" not in stderr and child.asked == []
    # One line, below the usage where that is what was wrong with the arguments.
    assert len(stderr.splitlines()) == 1 or (code == 2 and stderr.startswith("usage: ")), stderr
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
