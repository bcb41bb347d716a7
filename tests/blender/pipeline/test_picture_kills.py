"""Comparisons ended at random moments, or by a full disk, and gone on with: byte for byte what one run gives."""

import json
import shutil
import signal
import sys

import bake_scenes
import kills
import numpy as np
import programs
import pytest

from ltsh_addon import cli, imaging

OPTIONS = "--frames 1-2 --resolution 64x48 --techniques ltc,ltsh4 --cycles-samples 4 --quiet".split()

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes as Linux tells of them")


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trial")
    bake_scenes.textured_scene()
    path = bake_scenes.save(folder)

    def command(output, *more):
        return programs.command_line("compare", path, "-o", output, *OPTIONS, *more)

    return kills.Trial(command, folder)


def test_after_signals_at_random_moments_resume_gives_the_same_bytes(trial):
    assert {"compare_0001.exr", "compare_0002.png", "report.html", "report.json"} < set(trial.expected)
    for number, moment in zip((signal.SIGKILL, signal.SIGTERM), kills.moments(5, 2, trial.seconds), strict=True):
        trial.end_after("random", moment, number)
    trial.check("random")
    assert trial.end_while_writing("writing")
    trial.check("writing")


def test_an_animation_of_finished_pictures_stands_still_and_goes_on_after_a_kill(tmp_path):
    """Frames of a scene that does not move are the same to the last bit: they have the same noise."""
    bake_scenes.textured_scene()
    path, options = bake_scenes.save(tmp_path), "--frames 1-2 --resolution 32x24 --cycles-samples 4 --aa 3 --quiet"

    def command(output, *more):
        return programs.command_line("render", path, "-o", output, *options.split(), *more)

    trial = kills.Trial(command, tmp_path)
    first, second = (imaging.read_layers(path) for path in sorted((tmp_path / "whole").glob("*.exr")))
    assert first["rest"].any() and first["ltsh4c.diffuse"].any()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    half = tmp_path / "half"
    assert trial.runs.end_when(command(half, "--resume"), lambda: (half / "render_0001.exr").exists())
    trial.check("half")


@pytest.mark.soak
@pytest.mark.parametrize(("command", "options"), [
    ("bake", "--size 64 --margin 3 --error --cycles-samples 4"), ("shade", "--frames 1-2 --resolution 64x48"),
    ("render", "--frames 1-2 --resolution 32x24 --aa 3 --cycles-samples 4"),
    ("compare", "--frames 1-2 --resolution 64x48 --cycles-samples 4"),
])  # fmt: skip
def test_after_many_kills_at_random_moments_resume_gives_the_same_bytes(command, options, tmp_path):
    """Half of them while a file is written, or by a disk that is full; a third are killed once more after that."""
    bake_scenes.textured_scene()
    path = bake_scenes.save(tmp_path)

    def line(output, *more):
        return programs.command_line(command, path, "-o", output, *options.split(), "--quiet", *more)

    trial, generator = kills.Trial(line, tmp_path), np.random.default_rng(1)
    ended, kinds = 0, (signal.SIGKILL, signal.SIGTERM)
    for number, moment in enumerate(kills.moments(1, 30, trial.seconds)):
        name, kind = f"killed_{number}", kinds[number % 2]
        if number % 4 == 3:
            ended += trial.end_while_writing(name, kind)
        elif number % 4 == 2:
            code, said = trial.end_by_limit(name, generator.integers(1, 400))
            # A bake goes on with its other objects.
            assert code in (0, 1) and "Traceback" not in said and trial.left(name) == [], said
            ended += code
        else:
            ended += trial.end_after(name, moment, kind)
        if number % 3 == 1:
            trial.end_after(name, 0.7 * moment, kind)
        trial.check(name)
        shutil.rmtree(tmp_path / name)
    assert ended > 15, "most runs had ended before they were killed"


@pytest.fixture
def small_disk(tmp_path):
    yield from kills.small_disk(tmp_path / "disk", "100k")


@pytest.mark.parametrize("command", ["shade", "compare"])
def test_a_full_disk_is_one_line_and_no_half_file(child, room, small_disk, capsys, command):
    (small_disk / "other").write_bytes(bytes(90 << 10))
    assert cli.main([command, str(room), "-o", str(small_disk / "out"), "--quiet", "--techniques", "ltc"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"ltsh: {small_disk}/out/") and line.endswith("cannot be written: No space left on device")
    assert not kills.is_writing(small_disk) and not (small_disk / "out" / "report.json").exists()


@pytest.mark.parametrize("kept", [True, False])
def test_a_folder_that_vanishes_meanwhile(child, room, tmp_path, capsys, monkeypatch, kept):
    """It is made again where it may be, else named: something else has its name now."""
    from ltsh_addon.blender.process import pixels
    from ltsh_addon.blender.process.pixels import extract_pixels

    extract, out = extract_pixels, tmp_path / "out"

    def vanishing(*arguments, **options):
        found = extract(*arguments, **options)
        shutil.rmtree(out)
        if not kept:
            out.write_text("mine")
        return found

    monkeypatch.setattr(pixels, "extract_pixels", vanishing)
    code = cli.main(["compare", str(room), "-o", str(out), "--quiet", "--techniques", "ltc"])
    said = capsys.readouterr().err
    if kept:
        assert code == 0 and json.loads((out / "report.json").read_text())["lights"]
    else:
        assert code == 1 and len(said.splitlines()) == 1 and str(out) in said and out.read_text() == "mine"
