"""Scenes that nobody meant: what cannot be done ends with one line, what is merely odd is done, with a warning."""

import gzip
import json
import os
import re
from pathlib import Path

import bpy
import hostile_scenes
import numpy as np
import pytest
import scene_parts
from fake_scene import run

from ltsh_addon import cli, imaging
from ltsh_addon.blender.extract import pixels
from ltsh_addon.blender.process.blender_process import saved_with
from ltsh_addon.scene import SceneError

# `make soak` takes 10,000.
MANY = int(os.environ.get("LTSH_MANY_LIGHTS", "500"))

# id: scene, command, exit code, what stderr must say ("": nothing)
CASES = {
    "no camera": ("no_camera", "shade", 1, "has no active camera"),
    "no light": ("no_light", "compare", 1, "no light that renders, found no lights at all"),
    "no light to bake": ("no_light", "bake", 1, "no light that renders"),
    "nothing to bake": ("nothing_at_all", "bake", 1, "no mesh that renders"),
    "no object": ("no_object", "shade", 0, "sees no surface"),
    "other lights only": ("other_lights_only", "shade", 0, ""),
    "light of no size": ("light_of_no_size", "shade", 1, "light 'Key': its size or scale is zero"),
    "second light of no size": ("second_light_of_no_size", "compare", 0, "light 'Dot': its size or scale is zero"),
    "light scaled to nothing": ("light_scaled_to_nothing", "shade", 1, "its size or scale is zero"),
    "light without power": ("light_without_power", "shade", 1, "no light that renders"),
    "negative light": ("light_of_negative_power", "shade", 0, "negative power -50 W subtracts light"),
    "endless power": ("light_of_endless_power", "shade", 1, "light 'Key': its power or color is not finite"),
    "power NaN": ("light_of_power_that_is_no_number", "bake", 1, "light 'Key': its power or color is not finite"),
    "light nowhere": ("light_that_is_nowhere", "shade", 1, "no light that renders"),
    "second light nowhere": ("second_light_that_is_nowhere", "shade", 0, "light 'Lost': it is farther away"),
    "object nowhere": ("object_that_is_nowhere", "compare", 0, ""),
    "object nowhere, baked": ("object_that_is_nowhere", "bake", 1, "not baked: object 'Lost'"),
    "endless object": ("object_of_endless_size", "shade", 0, ""),
    "endless object, baked": ("object_of_endless_size", "bake", 1, "object 'Lost' is farther away, or larger, than"),
    "object of no size": ("object_of_no_size", "bake", 1, "object 'Flat': its transform has no inverse"),
    "camera nowhere": ("camera_that_is_nowhere", "shade", 0, "sees no surface"),
    "vertices nowhere": ("vertices_that_are_nowhere", "shade", 0, ""),
    "far away": ("far_away", "shade", 0, ""),
    "empty meshes": ("empty_meshes", "shade", 0, ""),
    "empty meshes, baked": ("empty_meshes", "bake", 1, "object 'Empty' has no faces"),
    "one pixel": ("one_pixel", "compare", 0, ""),
    "paths as names": ("path_as_name", "bake", 0, ""),
    "newline in names": ("newline_in_a_name", "bake", 0, "light 'Key.nLight': its size or scale is zero"),
    "long names": ("long_names", "shade", 0, ""),
    "long names, baked": ("long_names", "bake", 0, ""),
    "no UV map": ("no_uv_map", "bake", 1, "object 'Plane' has no UV map, found none"),
    "UV NaN": ("uv_that_is_no_number", "bake", 1, "all of UV map 'UVMap' lies outside"),
    "missing files": ("missing_files", "shade", 0, "//nowhere/lost.png is missing"),
    "missing library": ("lost_library", "shade", 0, "library 'props.blend': .* is missing"),
    "volume": ("volume", "shade", 0, "volume 'Smoke' is not shaded"),
}
OPTIONS = {
    "shade": ["--techniques", "ltsh4"],
    "compare": ["--techniques", "ltsh4", "--cycles-samples", "2"],
    "bake": ["--techniques", "ltsh4", "--size", "64"],
}


def saved(name: str, folder: Path, *arguments) -> Path:
    """A scene of hostile_scenes as a file."""
    (hostile_scenes.SCENES.get(name) or getattr(hostile_scenes, name))(*arguments)
    return scene_parts.save(folder / "scene.blend")


@pytest.mark.parametrize("case", CASES)
def test_a_hostile_scene(capsys, tmp_path, case):
    scene, command, expected, complaint = CASES[case]
    path, out = saved(scene, tmp_path), tmp_path / "a" / "b"
    before = path.read_bytes()
    code, stdout, stderr = run(capsys, command, path, "-o", out, "--quiet", *OPTIONS[command])
    assert code == expected and re.search(complaint, stderr) and "Traceback" not in stderr, stderr
    assert bool(stderr) == bool(complaint) and stdout.isprintable() == ("\n" not in stdout), stderr
    made = {"a"} if out.exists() else set()
    assert path.read_bytes() == before and {item.name for item in tmp_path.iterdir()} == {"scene.blend"} | made
    assert [item.name for item in (tmp_path / "a").glob("*")] == ["b"] * len(made)
    files = list(out.glob("*.exr"))
    if code == 0:
        assert files and json.loads((out / "report.json").read_text(encoding="utf-8"))
    for file in files:
        assert all(np.isfinite(plane).all() for plane in imaging.read_channels(file).values()), file.name
    if command != "bake" and code == 1:
        assert len(stderr.splitlines()) == 1 and not out.exists()


def zstandard_packed(data):
    return pytest.importorskip("zstandard").compress(data)


PACKING = {"plain": bytes, "gzip": gzip.compress, "Zstandard": zstandard_packed}


@pytest.mark.parametrize("packing", PACKING)
@pytest.mark.parametrize("share", [1.0, 0.5, 40])
def test_a_scene_is_opened_however_it_is_packed_and_refused_where_it_is_cut(capsys, tmp_path, packing, share):
    """All of it, half of it, or its first bytes."""
    hostile_scenes.plain()
    path, out = tmp_path / "scene.blend", tmp_path / "out"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=False)
    whole = PACKING[packing](path.read_bytes())
    cut = whole[: int(share if share > 1 else share * len(whole))]
    path.write_bytes(cut)
    code, _, stderr = run(capsys, "shade", path, "-o", out, "--quiet", *OPTIONS["shade"])
    if cut == whole:
        assert (code, stderr) == (0, "") and (out / "shade.exr").is_file()
        return
    (line,) = stderr.splitlines()
    assert code == 1 and line.startswith(f"ltsh: {path}: Blender {bpy.app.version_string} cannot open it, is it whole?")
    assert line.count(str(path)) == 1 and not out.exists()


def test_a_newer_file_is_refused_also_where_its_header_cannot_be_read_before(tmp_path):
    hostile_scenes.plain()
    path = tmp_path / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=False)
    data = path.read_bytes()
    version = saved_with(data)
    digits = b"0999" if data[7:9].isdigit() else b"999"
    end = 17 if data[7:9].isdigit() else 12
    path.write_bytes(data[: end - len(digits)] + digits + data[end:])
    assert version == bpy.app.version[:2] and saved_with(path.read_bytes()) == (9, 99)
    expected = f"scene.blend: was saved by Blender 9.99, but this is Blender {version[0]}.{version[1]}, "
    with pytest.raises(SceneError, match=expected):
        pixels.open_scene(path, [])


def test_many_lights_add_up(capsys, tmp_path):
    """The sum over small lights in closed form: each sends P / (pi d^2) (h / d)^2 to a point of the plane below, which
    reflects 1 / pi of it. 1 % leaves room for their size, 0.02 m at 1.5 m, and for what the specular lobe takes off."""
    path, out = saved("many_lights", tmp_path, MANY), tmp_path / "out"
    code, _, stderr = run(capsys, "shade", path, "-o", out, "--techniques", "ltsh4", "--passes", "diffuse", "--quiet")
    assert (code, stderr) == (0, "")
    layers = imaging.read_layers(out / "shade.exr")
    position, albedo = layers["samples.position"], layers["samples.diffuse_albedo"]
    places = hostile_scenes.places_of_lights(MANY)
    across = ((position[..., None, :2] - places[:, :2]) ** 2).sum(axis=-1)
    height = places[:, 2]
    irradiance = (0.01 / np.pi * height**2 / (across + height**2) ** 2).sum(axis=-1)
    assert np.allclose(layers["ltsh4.diffuse"], irradiance[..., None] * albedo / np.pi, rtol=0.01)


@pytest.mark.parametrize("command", ["shade", "bake"])
@pytest.mark.parametrize("allowed", [False, True])
def test_scripts_in_a_file_run_only_when_asked_for(tmp_path, monkeypatch, own_blender, command, allowed):
    mark = tmp_path / "mark"
    monkeypatch.setenv(hostile_scenes.MARK, str(mark))
    path = saved("scripts", tmp_path)
    mark.unlink(missing_ok=True)
    options = ["--enable-autoexec"] if allowed else []
    code = cli.main([command, str(path), "-o", str(tmp_path / "out"), "--quiet", *OPTIONS[command], *options])
    assert code == 0 and mark.exists() == allowed
    if allowed:
        assert "script" in mark.read_text()
