"""The operators that run jobs: their pictures, and what happens when something goes wrong."""

from dataclasses import asdict
from pathlib import Path

import bpy
import numpy as np
import pytest
from job_window import Hand, image_pixels

from ltsh_addon import cli, imaging
from ltsh_addon.blender.process import blender_process
from ltsh_addon.blender.ui import job, operators, preflight, results
from ltsh_addon.blender.ui.job import Job, Plan
from ltsh_addon.imaging.exr import write_channels
from ltsh_addon.pipeline import display_layers
from ltsh_addon.pipeline.mixer import MixerRow


@pytest.fixture
def reported(monkeypatch):
    """Stages that jobs report, each as often as it begins."""
    stages, report = [], Plan.report

    def note(plan, stage, fraction):
        if stages[-1:] != [stage]:
            stages.append(stage)
        report(plan, stage, fraction)

    monkeypatch.setattr(Plan, "report", note)
    return stages


def planned(command):
    """The stages of a job on a scene without bumps."""
    steps = job.steps(job.runs_of(bpy.context, command, Path("room.blend")))
    return [step.stage for step in steps if step.stage != "horizons"]


def command_line(*arguments):
    assert cli.main([*map(str, arguments), "--quiet"]) == 0


@pytest.mark.newest
def test_a_comparison_shows_what_the_command_line_writes(scene, tmp_path, reported):
    assert bpy.ops.ltsh.compare() == {"FINISHED"}
    assert [job.STARTING, *reported] == planned("compare")
    command_line("compare", tmp_path / "room.blend", "-o", tmp_path / "out", "--techniques", "ltc,ltsh4c",
                 "--cycles-samples", "4")  # fmt: skip
    expected = imaging.read_layers(tmp_path / "out" / "compare.exr")
    for name in ("ltc", "ltsh4c", "cycles", "error_ltsh4c"):
        np.testing.assert_array_equal(image_pixels(f"LTSH {name}.combined"), expected[f"{name}.combined"][..., :3])
    scene.ltsh.pass_name = "specular"
    for name in ("ltsh4c", "cycles", "error_ltc"):
        np.testing.assert_array_equal(image_pixels(f"LTSH {name}.specular"), expected[f"{name}.specular"])
    assert not expected["ltsh4c.specular"].max() == 0.0
    assert bpy.data.images["LTSH error_ltsh4c.combined"].colorspace_settings.name == "Non-Color"
    files = [tmp_path / folder / "compare.exr" for folder in ("ltsh/compare", "out")]
    assert files[0].read_bytes() == files[1].read_bytes() and operators.running_job() is None


def test_shading_and_baking_show_what_the_command_line_writes(scene, tmp_path, reported):
    scene.ltsh_view.technique, scene.ltsh.anti_aliasing, scene.ltsh.resolution_percentage = "ltsh2", 2, 50
    assert bpy.ops.ltsh.shade() == {"FINISHED"}
    assert [job.STARTING, *reported] == planned("shade")
    command_line("shade", tmp_path / "room.blend", "-o", tmp_path / "out", "--techniques", "ltsh2", "--aa", "2",
                 "--resolution", "12x8")  # fmt: skip
    expected = imaging.read_layers(tmp_path / "out" / "shade.exr")["ltsh2.diffuse"]
    scene.ltsh.pass_name = "diffuse"
    np.testing.assert_array_equal(image_pixels("LTSH ltsh2.diffuse"), expected)
    bpy.data.objects["Floor"].select_set(True)
    scene.ltsh.bake_view, scene.ltsh.bake_passes = "above", {"specular"}
    reported.clear()
    assert bpy.ops.ltsh.bake() == {"FINISHED"}
    # Materials without textures need no maps.
    assert [job.STARTING, *reported] == [stage for stage in planned("bake") if stage != "bake Floor"]
    command_line("bake", tmp_path / "room.blend", "-o", tmp_path / "out", "--object", "Floor", "--size", "256",
                 "--aa", "2", "--margin", "2", "--view", "above", "--passes", "specular",
                 "--techniques", "ltsh2")  # fmt: skip
    expected = imaging.read_layers(tmp_path / "out" / "Floor.exr")["ltsh2.specular"]
    np.testing.assert_array_equal(image_pixels("LTSH Floor ltsh2.specular"), expected)
    # Pictures of the other job go from the list of images, not from the disk: one click shows them again.
    assert "LTSH ltsh2.diffuse" not in bpy.data.images
    assert bpy.ops.ltsh.show_results(command="shade") == {"FINISHED"} and "LTSH ltsh2.diffuse" in bpy.data.images


def baked(scene, tmp_path):
    """A bake of the floor as the job leaves it: specular and diffuse of LTSH 4c; their sum (H, W, 3)."""
    output = tmp_path / "ltsh" / "bake"
    output.mkdir(parents=True)
    pictures = np.random.default_rng(5).random((2, 6, 10, 3), np.float32)
    layers = {f"ltsh4c.{part}": picture for part, picture in zip(("specular", "diffuse"), pictures, strict=True)}
    channels = {f"{layer}.{letter}": picture[..., index] for layer, picture in layers.items()
                for index, letter in enumerate("RGB")}  # fmt: skip
    write_channels(output / "Floor.exr", channels)
    record = {"name": "Floor", "uv": "UVMap", "tiles": {"1001": {"file": "Floor.exr"}}}
    results.show(scene, display_layers.write("bake", output, {"objects": [record], "warnings": []}))
    return pictures.sum(axis=0)


def test_a_bake_is_shown_in_the_scene_and_taken_back(scene, tmp_path):
    floor = bpy.data.objects["Floor"]
    former, materials = floor.material_slots[0].material, set(bpy.data.materials)
    assert not bpy.ops.ltsh.apply_bake.poll() and not bpy.ops.ltsh.restore_materials.poll()
    expected = baked(scene, tmp_path)
    for _ in range(2):  # once more replaces it
        assert bpy.ops.ltsh.apply_bake() == {"FINISHED"}
        (slot,) = floor.material_slots
        (group,) = [node.node_tree for node in slot.material.node_tree.nodes if node.type == "GROUP"]
        (texture,) = [node for node in group.nodes if node.type == "TEX_IMAGE"]
        assert (
            Path(bpy.path.abspath(texture.image.filepath)) == tmp_path / "ltsh" / "bake" / "Floor.ltsh4c.combined.exr"
        )
        np.testing.assert_array_equal(image_pixels(texture.image.name), expected)
        assert slot.link == "OBJECT" and floor.data.materials[0] == former
        assert len(set(bpy.data.materials) - materials) == 1
    floor.select_set(True)
    (problem,) = preflight.problems(bpy.context, "bake")
    assert problem.blocks and problem.fix == "ltsh.restore_materials"
    # Several are named together, since one click restores them all.
    twin = floor.copy()
    scene.collection.objects.link(twin)
    twin.select_set(True)
    (problem,) = preflight.problems(bpy.context, "bake")
    assert problem.text == "2 objects show baked textures in place of their materials" and problem.blocks
    bpy.data.objects.remove(twin)
    assert bpy.ops.ltsh.restore_materials() == {"FINISHED"}
    assert (slot.link, slot.material) == ("DATA", former) and set(bpy.data.materials) == materials
    assert preflight.problems(bpy.context, "bake") == []


def test_the_mixer_changes_a_bake_of_each_light(scene, tmp_path):
    output = tmp_path / "ltsh" / "bake"
    output.mkdir(parents=True)
    pictures = np.random.default_rng(6).random((2, 6, 10, 3), np.float32)
    lamp = next(ob for ob in scene.objects if ob.type == "LIGHT")
    names = [lamp.name, "World"]
    layers = {"ltsh4c.diffuse_light": pictures.sum(axis=0)}
    layers |= {f"ltsh4c.diffuse_light@{name}": picture for name, picture in zip(names, pictures, strict=True)}
    channels = {f"{layer}.{letter}": picture[..., index] for layer, picture in layers.items()
                for index, letter in enumerate("RGB")}  # fmt: skip
    write_channels(output / "Floor.exr", channels)
    settings = {lamp.name: [lamp.data.energy, lamp.data.exposure, *lamp.data.color]}
    rows = [asdict(MixerRow(name, (name,), settings=settings if name == lamp.name else {})) for name in names]
    record = {"name": "Floor", "uv": "UVMap", "tiles": {"1001": {"file": "Floor.exr"}}}
    report = {"objects": [record], "warnings": [], "light_rows": rows, "frame": 1, "camera": ""}
    folder = display_layers.write("bake", output, report)
    display_layers.write_lights(folder, ["bake"], report)
    results.show(scene, folder)
    assert [item.name for item in scene.ltsh.mixed] == names
    scene.ltsh.mixed[lamp.name].power = 2.5
    expected = 2.5 * pictures[0] + pictures[1]
    assert scene.ltsh.mode == "MIX"
    np.testing.assert_allclose(results.mixed_pixels(scene)[::-1, :, :3], expected, rtol=1e-6)
    assert bpy.ops.ltsh.apply_bake() == {"FINISHED"}
    written = imaging.read_layers(output / "Floor.ltsh4c.diffuse_light.exr")[""]
    np.testing.assert_allclose(written, expected, rtol=1e-6)
    # A bake without --per-light has no mixer, and none that an earlier one left.
    display_layers.write_lights(folder, ["bake"], {**report, "light_rows": []})
    assert results.mixer_of(scene) is None


@pytest.mark.newest
def test_a_scene_that_is_renamed_or_removed_meanwhile(scene):
    scene.name = "Before"
    hand = Hand("shade").start()
    scene.name = "After"
    hand.until(lambda: False)
    assert hand.outcome == {"FINISHED"} and hand.reports[0][0] == "INFO" and results.result_of(scene) is not None
    hand = Hand("shade").start()
    bpy.data.scenes.new("Other")
    bpy.data.scenes.remove(scene)
    hand.send()
    hand.send("ESC", "PRESS")
    assert hand.outcome == {"CANCELLED"} and hand.reports[0][0] == "WARNING"


def faults_of(operator) -> str:
    with pytest.raises(RuntimeError) as caught:
        operator()
    text = str(caught.value)
    assert text.startswith("Error: ") and text.count("\n") == 1 and "Traceback" not in text, text
    assert operators.running_job() is None
    return text


def fail(*arguments, **options):
    raise OSError("cannot\nread")


def test_a_process_that_dies_is_told(scene):
    hand = Hand("shade").start()
    operators.running_job()._process.kill()
    hand.until(lambda: False)
    ((kind, text),) = hand.reports
    assert kind == "ERROR" and "Blender ended with code" in text and "\n" not in text
    assert hand.outcome == {"CANCELLED"} and hand.context.timers == []


@pytest.mark.newest
def test_what_cannot_be_shaded_or_started_is_told(scene, monkeypatch):
    bpy.data.objects["Light"].data.energy = 0.0
    assert "no light" in faults_of(bpy.ops.ltsh.shade)
    monkeypatch.setattr(blender_process, "start", fail)
    assert "cannot read" in faults_of(bpy.ops.ltsh.compare)


@pytest.mark.newest
def test_an_unexpected_fault_ends_the_job_with_one_line(scene, monkeypatch):
    monkeypatch.setattr(results, "show", fail)
    hand = Hand("shade").start().until(lambda: False)
    assert hand.outcome == {"CANCELLED"} and hand.reports == [("ERROR", "shade failed: cannot read")]
    assert hand.context.timers == [] and operators.running_job() is None
    monkeypatch.setattr(Job, "wait", fail)
    assert "Shade Camera View failed: cannot read" in faults_of(bpy.ops.ltsh.shade)


def test_the_scene_and_its_file_stay_as_they_were(scene, tmp_path):
    def state():
        names = [item.name for item in (*bpy.data.objects, *scene.view_layers)]
        files = (tmp_path / "room.blend").read_bytes(), bpy.data.filepath, sorted(tmp_path.iterdir())
        return names, files, scene.render.engine, scene.frame_current

    scene.frame_set(7)
    before = state()
    Hand("shade").start().send("ESC", "PRESS")
    assert state() == before


def test_a_file_that_was_never_saved_uses_the_folder_of_the_preferences(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("ltsh_addon.blender.ui.settings.default_output_folder", lambda: tmp_path / "own")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    assert job.output_folder(scene, "shade") == Path(bpy.data.filepath).parent / "ltsh" / "shade"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert job.output_folder(bpy.context.scene, "shade") == tmp_path / "own" / "untitled" / "shade"
    bpy.data.scenes.new("Second")
    assert job.output_folder(bpy.data.scenes["Second"], "bake").parts[-3:] == ("untitled", "Second", "bake")
