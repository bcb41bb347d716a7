"""The extension installed in a real Blender, as its zip: `make test-blender BLENDER=path`, else all is skipped.

Every Blender here has a profile of its own in a temporary folder. The scenes are built by this Python's bpy; where a
result is compared, the other side is `python -m ltsh_addon` of this Python.
"""

import json
import os
import platform
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from ltsh_addon import imaging
from ltsh_addon.imaging.exr import read_channels
from requirements import build_extension

ROOT = Path(__file__).resolve().parents[2]
BLENDER = os.environ.get("LTSH_BLENDER", "")
SECONDS = 300
NO_SCENE_NEEDED = ["--help"], ["--version"], ["shade", "--help"]
pytestmark = pytest.mark.skipif(not BLENDER, reason="needs a real Blender: LTSH_BLENDER names its program")

# What Blender runs before it renders a frame.
SMALL_FRAMES = """
import bpy
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 64, 36, 100
scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
scene.ltsh.anti_aliasing = 2
"""


class InstalledBlender:
    """A Blender with a profile of its own, into which the zip was installed."""

    def __init__(self, folder: Path):
        self.profile, self.zip = folder / "profile", this_platforms_zip()
        self.profile.mkdir()
        installing = ("--command", "extension", "install-file", "-r", "user_default", "--enable")
        self.installation = self.run(*installing, self.zip)

    def environment(self) -> dict:
        return {**os.environ, "BLENDER_USER_RESOURCES": str(self.profile), "PYTHONDONTWRITEBYTECODE": "1"}

    def run(self, *arguments) -> subprocess.CompletedProcess:
        return subprocess.run(
            [BLENDER, *map(str, arguments)], env=self.environment(), capture_output=True, text=True, encoding="utf-8",
            timeout=SECONDS, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip

    def ltsh(self, *arguments, before=()) -> subprocess.CompletedProcess:
        return self.run(*before, "--command", "ltsh", *arguments)


def this_platforms_zip() -> Path:
    system = {"Linux": "linux", "Darwin": "macos", "Windows": "windows"}[platform.system()]
    machine = "arm64" if platform.machine().lower() in ("arm64", "aarch64") else "x64"
    (found,) = [path for path in build_extension.build(ROOT / "build") if path.stem.endswith(f"{system}_{machine}")]
    return found


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    return InstalledBlender(tmp_path_factory.mktemp("installed"))


@pytest.fixture(scope="module")
def demo(blender, tmp_path_factory):
    """The example scene, shaded and compared by the installed extension."""
    out = tmp_path_factory.mktemp("demo")
    done = blender.ltsh("demo", "-o", out, "--resolution", "64x36", "--cycles-samples", "16", "--quiet", "--json")
    return out, done


def python(*arguments) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "ltsh_addon", *map(str, arguments)],
        cwd=ROOT, capture_output=True, text=True, encoding="utf-8", timeout=SECONDS, check=False,
    )  # fmt: skip


def document(stdout: str) -> dict:
    """The JSON document on stdout; Blender itself may have said something before our command ran."""
    return json.loads(stdout[stdout.index("{\n") :])


def test_the_zip_installs_and_is_enabled(blender):
    assert blender.installation.returncode == 0, blender.installation.stdout + blender.installation.stderr
    expression = "import bpy, OpenEXR; print('LTSH', 'bl_ext.user_default.ltsh' in bpy.context.preferences.addons)"
    told = blender.run("--background", "--python-exit-code", "3", "--python-expr", expression)
    assert told.returncode == 0 and "LTSH True" in told.stdout, told.stdout + told.stderr


def test_help_is_the_same_as_from_python(blender):
    for arguments in NO_SCENE_NEEDED:
        done, expected = blender.ltsh(*arguments), python(*arguments)
        assert (done.returncode, expected.returncode) == (0, 0)
        ours = done.stdout.replace("blender --command ltsh", "ltsh")
        assert sorted(expected.stdout.split()) == sorted(word for word in expected.stdout.split() if word in ours)


def test_demo_writes_what_python_writes(demo, tmp_path):
    out, done = demo
    # Nothing else on stderr: a library that calls Blender's OpenEXR instead of its own would complain there.
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    same = python("compare", out / "demo.blend", "-o", tmp_path, "--resolution", "64x36", "--cycles-samples", "16",
                  "--quiet", "--json")  # fmt: skip
    assert same.returncode == 0, same.stderr
    names = {path.name for path in out.iterdir()} - {"demo.blend"}
    assert names == {path.name for path in tmp_path.iterdir()}
    ours, theirs = document(done.stdout), json.loads(same.stdout)
    assert ours.keys() == theirs.keys() and ours["warnings"] == theirs["warnings"]
    first, second = (imaging.read_layers(folder / "compare.exr") for folder in (out, tmp_path))
    assert first.keys() == second.keys()
    # Two builds of Blender: the same surfaces to float32, but for the few pixels at edges that a rounding decides.
    differs = np.abs(first["samples.position"] - second["samples.position"]).max(axis=-1) > 1e-3
    assert differs.mean() < 0.01
    for name in ("ltsh4.specular", "ltc.diffuse"):
        a, b = first[name][~differs], second[name][~differs]
        assert np.sqrt(((a - b) ** 2).sum() / (b**2).sum()) < 1e-3, name


def test_shade_takes_the_file_that_blender_has_open(blender, demo, tmp_path):
    scene = demo[0] / "demo.blend"
    options = ("--techniques", "ltsh4", "--resolution", "64x36", "--quiet")
    given = blender.ltsh("shade", scene, "-o", tmp_path / "given", *options)
    opened = blender.ltsh("shade", "-o", tmp_path / "opened", *options, before=[scene])
    assert (given.returncode, opened.returncode) == (0, 0), given.stderr + opened.stderr
    first, second = (imaging.read_layers(tmp_path / name / "shade.exr") for name in ("given", "opened"))
    assert all(np.array_equal(first[name], second[name], equal_nan=True) for name in first | second)
    assert first["ltsh4.specular"].max() > 0.0


def test_bake_works(blender, demo, tmp_path):
    options = ("--object", "floor", "--size", "64", "--techniques", "ltsh4", "--quiet")
    done = blender.ltsh("bake", demo[0] / "demo.blend", "-o", tmp_path, *options)
    assert done.returncode == 0, done.stdout + done.stderr
    assert list(tmp_path.glob("*.exr"))


def test_blender_renders_frames_with_the_engine(blender, demo, tmp_path):
    scene = demo[0] / "demo.blend"
    frame = tmp_path / "frame_"
    done = blender.run("-b", scene, "--python-expr", SMALL_FRAMES, "-E", "LTSH", "-o", frame, "-f", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    channels = read_channels(tmp_path / "frame_0001.exr")
    found = np.stack([channels[letter] for letter in "RGB"], axis=-1)
    options = ("--techniques", "ltsh4", "--resolution", "64x36", "--aa", "2", "--quiet")
    shaded = blender.ltsh("shade", scene, "-o", tmp_path / "shaded", *options)
    assert shaded.returncode == 0, shaded.stderr
    layers = imaging.read_layers(tmp_path / "shaded" / "shade.exr")
    expected = layers["ltsh4.specular"] + layers["ltsh4.diffuse"]
    # Both take the same samples, and the world of the scene is black.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert expected.max() > 0.1


def test_a_frame_that_cannot_be_rendered_is_an_error(blender, demo, tmp_path):
    no_lights = "import bpy\nfor light in list(bpy.data.lights): bpy.data.lights.remove(light)"
    done = blender.run(
        *("-b", demo[0] / "demo.blend", "--python-expr", no_lights, "-E", "LTSH", "-o", tmp_path / "dark_", "-f", "1")
    )
    assert done.returncode == 1
    assert "LTSH: scene 'Scene': no light that renders" in done.stdout + done.stderr
    assert not list(tmp_path.glob("dark_*"))


def test_exit_codes(blender, demo, tmp_path):
    scene = demo[0] / "demo.blend"
    cases = [
        (1, ["shade", tmp_path / "missing.blend", "-o", tmp_path / "out"], [], "no such file"),
        (1, ["shade", scene, "-o", scene], [], "demo.blend"),
        (2, ["shade", scene, "-o", tmp_path / "out", "--aa", "0"], [], "above 0"),
        (2, ["shade", scene, "-o", tmp_path / "out"], [scene], "has"),
        (2, ["shade", "-o", tmp_path / "out"], [], "SCENE"),
        (2, ["nonsense"], [], "nonsense"),
    ]
    for code, arguments, before, complaint in cases:
        done = blender.ltsh(*arguments, before=before)
        assert done.returncode == code, (arguments, done.stdout, done.stderr)
        assert complaint in done.stderr and "Traceback" not in done.stderr, (arguments, done.stderr)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_end_it_also_while_cycles_renders(blender, demo, tmp_path, number, code):
    running = subprocess.Popen(
        [BLENDER, "--command", "ltsh", "compare", str(demo[0] / "demo.blend"), "-o", str(tmp_path / "out"),
         "--resolution", "640x360", "--cycles-samples", "100000"],
        env=blender.environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    watchdog = threading.Timer(SECONDS, running.kill)
    watchdog.start()
    said = ""
    try:
        for line in running.stdout:
            said += line
            if "Cycles A" in line:
                break
        running.send_signal(number)
        assert running.wait(60) == code, said
    finally:
        watchdog.cancel()
        running.kill()
        running.stdout.close()
        running.wait()


def test_enabling_disabling_and_uninstalling_leaves_nothing(tmp_path):
    installed = InstalledBlender(tmp_path)
    script = Path(__file__).with_name("enable_and_disable.py")
    background = ("--background", "--python-exit-code", "3", "--python", script)
    done = installed.run(*background, "--", ROOT / "tests" / "blender" / "helpers")
    assert done.returncode == 0, done.stdout + done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("LTSH-REPORT ")]
    report = json.loads(line.removeprefix("LTSH-REPORT "))
    assert report["enabled_at_start"]
    for turn in ("first", "second"):
        assert report[turn]["enabled"] and "classes" in report[turn]["added"] and report[turn]["left"] == {}
        assert {"cores", "output_folder", "log_level"} <= set(report[turn]["preferences"])
    assert report["uninstalled"] == {"left": {}, "paths": [], "modules": [], "handlers": 0}
    left = [path.name for path in installed.profile.rglob("*") if "ltsh" in path.name.lower() or path.suffix == ".so"]
    told = installed.ltsh("--version")
    assert left == [] and told.returncode == 1 and "nrecognized command" in told.stdout + told.stderr, told
