"""The command line with real child processes: small pictures, few samples."""

import json
import subprocess
from pathlib import Path

import bpy
import numpy as np
import programs
import pytest
import scene_parts
from fake_scene import run

from ltsh_addon import imaging

ROOT = Path(__file__).resolve().parents[3]
ALWAYS = ("report.json", "timing.json", ".ltsh")
SMALL = ["--resolution", "32x18", "--cycles-samples", "8"]


@pytest.fixture
def room(tmp_path):
    return scene_parts.metal_room(tmp_path / "room.blend")


def test_compare_as_a_program(room, out, temporary_root):
    before = room.read_bytes()
    command = programs.command_line("compare", room, "-o", out, *SMALL, "--json", "--quiet")
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, encoding="utf-8", timeout=600, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    report = programs.document(done.stdout)
    assert report == json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["resolution"] == [32, 18] and report["surface_samples"] == 32 * 18 and report["warnings"] == []
    assert report["versions"]["blender"] == bpy.app.version_string
    layers = imaging.read_layers(out / "compare.exr")
    assert layers["cycles.specular"].any() and np.allclose(layers["samples.roughness"], 0.4)
    assert {path.name for path in out.iterdir()} == {"compare.exr", "compare.png", "report.html", *ALWAYS}
    assert room.read_bytes() == before and list(temporary_root.glob("ltsh-*")) == []


def test_an_unknown_camera_is_one_line(capsys, room, out):
    code, _, stderr = run(capsys, "shade", room, "-o", out, "--camera", "Nobody", "--quiet")
    assert code == 1 and "'Nobody'" in stderr and "'Camera'" in stderr and not out.exists()


def test_the_demo_end_to_end(capsys, out):
    """`reference` against 16 samples of Cycles only has to lie within their noise; ltsh4 beats ltc without noise."""
    code, stdout, _ = run(
        capsys, "demo", "-o", out, "--resolution", "48x27", "--cycles-samples", "16",
        "--techniques", "ltc,ltsh4,reference", "--json", "--quiet",
    )  # fmt: skip
    report = json.loads(stdout)
    assert code == 0 and report["warnings"] == [] and report["resolution"] == [48, 27]
    names = {path.name for path in out.iterdir()}
    assert names == {"compare.exr", "compare.png", "demo.blend", "report.html", "unshadowed", *ALWAYS}
    assert {light["shape"] for light in report["lights"]} == {"SQUARE", "RECTANGLE", "DISK", "ELLIPSE"}
    layers = imaging.read_layers(out / "compare.exr")
    assert all(np.isfinite(plane).all() for plane in layers.values())
    assert layers["coverage.hit"].mean() > 0.9
    for figures in report["passes"].values():
        for row in figures["techniques"].values():
            assert row["against_cycles"]["not_finite"] == 0
    # How good lobes are is told without shadows: with, the largest errors may lie in the dark.
    specular = report["unshadowed"]["passes"]["specular"]["techniques"]
    ltc, ltsh4 = (specular[name]["against_reference"] for name in ("ltc", "ltsh4"))
    for part in (lambda row: row, lambda row: row["metals"], lambda row: row["dielectrics"]):
        assert part(ltsh4)["relative_l2"] < 0.5 * part(ltc)["relative_l2"]
    noise = report["unshadowed"]["passes"]["specular"]["noise"]
    # Half the difference of two halves is the noise of their mean, so a right image is that far from it.
    assert specular["reference"]["against_cycles"]["relative_l2"] < 1.3 * noise
