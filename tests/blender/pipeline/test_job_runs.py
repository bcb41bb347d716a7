"""Jobs with real children: one Blender for many frames, shards, several cameras, bakes; bytes are what is compared."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import programs
import pytest
import scene_parts
from kills import contents

from ltsh_addon.blender.process import blender_process
from ltsh_addon.blender.process.bake import BakeFactsJob, scene_facts
from ltsh_addon.cli import main
from ltsh_addon.pipeline import BakeOptions, PictureOptions, batch
from ltsh_addon.pipeline.batch import merge
from ltsh_addon.pipeline.picture import make_picture
from ltsh_addon.pipeline.tasks import BatchJob, tasks_of

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def room(tmp_path):
    """A light that moves from frame 1 to 5, two cameras, and planes: with a texture, one that cannot be baked, one that
    is not rendered."""
    scene = scene_parts.empty_scene(16, 12)
    material, node = scene_parts.principled("Wave", Roughness=0.4)
    texture = material.node_tree.nodes.new("ShaderNodeTexWave")
    material.node_tree.links.new(texture.outputs["Color"], node.inputs["Base Color"])
    scene_parts.add_plane(material, name="Floor")
    scene_parts.add_plane(scene_parts.principled("Metal", Metallic=1.0)[0], size=1.0, location=(0, 0, 0.3), name="Slab")
    scene_parts.add_mesh("Bare", [(0, 0, 1), (0.2, 0, 1), (0, 0.2, 1)], [(0, 1, 2)])
    drafts = bpy.data.collections.new("Drafts")
    drafts.hide_render = True
    scene.collection.children.link(drafts)
    draft = scene_parts.add_plane(name="Draft")
    scene.collection.objects.unlink(draft)
    drafts.objects.link(draft)
    scene_parts.add_area_light("Key")
    light = bpy.data.objects["Key"]
    light.keyframe_insert("location", frame=1)
    light.location.x += 1.0
    light.keyframe_insert("location", frame=5)
    scene_parts.add_camera(name="Side")
    scene_parts.add_top_camera()
    scene.frame_current = 3
    return scene_parts.save(tmp_path / "room.blend")


def run(command):
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)


def job(room, output, cycles_samples=4, **changes):
    options = PictureOptions(room, output, techniques=("ltsh4",), cycles_samples=cycles_samples)
    return BatchJob("compare", options, **{"scenes": (room,), **changes})


def test_one_blender_for_all_frames_gives_the_bytes_of_one_for_each(room, tmp_path, monkeypatch, own_blender):
    starts = []
    command = blender_process.child_command
    monkeypatch.setattr(blender_process, "child_command", lambda path: starts.append(path) or command(path))
    wanted = job(room, tmp_path / "kept", frames=(1, 3, 5), cameras=("Side", "Camera"))
    assert batch.run_tasks(wanted).problems == () and len(starts) == 1
    for task in tasks_of(wanted)[1::3]:
        made = make_picture(task.options(job(room, tmp_path / "fresh", frames=(1, 3))), True)
        for name in made.files:
            assert (tmp_path / "fresh" / name).read_bytes() == (tmp_path / "kept" / name).read_bytes(), name
    assert len(starts) == 3
    frames = [(tmp_path / "kept" / f"compare_Side_000{frame}.exr").read_bytes() for frame in (1, 3, 5)]
    assert len(set(frames)) == 3


@pytest.mark.parametrize("pattern", ["compare_{scene}", "{scene}_{camera}"])
def test_after_an_error_the_next_task_gets_a_new_blender(room, tmp_path, own_blender, pattern):
    """Also where the name of the task is only in the file."""
    bad = tmp_path / "bad.blend"
    bad.write_bytes(b"BLENDER no more\n" * 9)
    wanted = job(room, tmp_path / "out", scenes=(bad, room), name=pattern)
    (problem,) = batch.run_tasks(wanted).problems
    assert "bad.blend" in problem and "cannot open it" in problem
    merged = merge(tmp_path / "out")
    (report,) = merged.report["reports"]
    assert merged.problems == (problem,) and report["name"] == pattern.format(scene="room", camera="Camera")
    with pytest.raises(blender_process.SceneError, match="cannot open it"):
        batch.run_tasks(job(room, tmp_path / "alone", scenes=(bad,), name=pattern))


def test_a_killed_blender_is_one_failed_task(room, tmp_path, own_blender):
    """As when the system is out of memory."""
    done, killed = [], []

    def progress(stage, fraction):
        if stage == "samples" and len(done) == 1 and not killed:
            (process,) = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
            killed.append(int(process))
            os.kill(int(process), 9)

    def tell(state):
        if state.seconds is not None:
            done.append(state.problem)

    # Many samples, so that Blender is still at work when it is killed.
    wanted = job(room, tmp_path / "out", cycles_samples=4096, frames=(1, 2, 3))
    (problem,) = batch.run_tasks(wanted, progress=progress, tell=tell).problems
    assert "compare_0002: Blender ended with code -9" in problem and done == [None, problem, None]
    assert batch.run_tasks(wanted, existing=batch.RESUME).finished_before == 2
    assert merge(tmp_path / "out").problems == ()


def test_facts_are_those_of_the_frame_and_of_the_file(room):
    facts = scene_facts(BakeFactsJob(room, [1, None], "all"))
    assert [(fact["frame"], fact["camera"]) for fact in facts] == [(1, "Camera"), (3, "Camera")]
    assert [fact["lights"] for fact in facts] == [1, 1]
    assert all(sorted(fact["objects"]) == ["Bare", "Floor", "Slab"] for fact in facts)
    assert scene_facts(BakeFactsJob(room, [None]))[0]["objects"] == []
    with pytest.raises(blender_process.SceneError, match="object 'Roof' is not in scene"):
        scene_facts(BakeFactsJob(room, [None], ("Roof",)))


def test_shards_at_the_same_time_in_one_folder_are_the_single_run(room, tmp_path):
    """Two shards of an animation, and the first of them twice, all at once."""
    common = ["shade", room, "--frames", "1-3", "--camera", "Side", "--camera", "Camera", "--techniques", "ltsh4"]
    common += ["--quiet", "-o"]

    def start(*arguments):
        command = programs.command_line(*arguments)
        return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    assert main([*map(str, common), str(tmp_path / "one")]) == 0
    shards = [start(*common, tmp_path / "two", "--shard", f"{number}/2") for number in (1, 2, 1)]
    assert [shard.communicate(timeout=600)[1] for shard in shards] == [b""] * 3
    assert [shard.returncode for shard in shards] == [0] * 3
    assert merge(tmp_path / "two").missing == ()
    assert contents(tmp_path / "two") == contents(tmp_path / "one") and len(contents(tmp_path / "one")) == 20


def add_tiles_and_group():
    """A plane over two UDIM tiles, and one of the same material, whose color comes from within a group."""
    material, node = scene_parts.principled("Grouped")
    group, _, end = scene_parts.new_group({}, {"Color": "Color"})
    group.links.new(group.nodes.new("ShaderNodeTexWave").outputs["Color"], end.inputs[0])
    outer = scene_parts.add_group(material.node_tree, group)
    material.node_tree.links.new(outer.outputs[0], node.inputs["Base Color"])
    corners = [(x, y, 0.5) for y in (0.0, 1.0) for x in (-1.0, 0.0, 1.0)]
    tiles = scene_parts.add_mesh("Tiles", corners, [(0, 1, 4, 3), (1, 2, 5, 4)])
    square = np.array([(0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)])
    uv = np.concatenate([square, square + (1.0, 0.0)]).astype(np.float32)
    tiles.data.uv_layers.new(name="UVMap").data.foreach_set("uv", uv.ravel())
    tiles.data.materials.append(material)
    scene_parts.add_plane(material, size=0.5, location=(0, 0, 0.7), name="Other")


def test_shards_of_a_bake_merged_are_the_single_run(room, tmp_path):
    """Two frames of five objects, of which one cannot be baked and one has two UDIM tiles, each a task of its own."""
    bpy.ops.wm.open_mainfile(filepath=str(room))
    add_tiles_and_group()
    bpy.ops.wm.save_as_mainfile(filepath=str(room))
    loads = []

    def progress(stage, fraction):
        loads.extend([stage] if stage == "open scene" else [])

    def bake(output, **shard):
        options = BakeOptions(
            room, output, size=(64, 64), margin=2, techniques=("ltsh4",), error=True, cycles_samples=2
        )
        return batch.run_tasks(BatchJob("bake", options, (room,), frames=(1, 5)), progress=progress, **shard)

    assert len(bake(tmp_path / "one").problems) == 2
    # Once for the list of objects, and once for all objects of each frame.
    assert len(loads) == 3
    report = merge(tmp_path / "one").report
    shards = [bake(tmp_path / "four", shard=(number, 4)) for number in (4, 2, 3, 1)]
    assert [shard.tasks for shard in shards] == [3, 3, 3, 3]
    assert len(sum((shard.problems for shard in shards), ())) == 2
    merged = merge(tmp_path / "four")
    assert contents(tmp_path / "four") == contents(tmp_path / "one")
    assert merged.missing == () and "'Bare' has no UV map" in merged.problems[0]
    stems = ("Floor", "Slab", "Other", "Tiles")
    for frame, entry in zip((1, 5), report["reports"], strict=True):
        assert sorted(item["name"] for item in entry["objects"]) == sorted(stems)
        (item,) = [item for item in entry["objects"] if item["name"] == "Tiles"]
        files = {number: tile["file"] for number, tile in item["tiles"].items()}
        assert files == {str(tile): f"Tiles_000{frame}.{tile}.exr" for tile in (1001, 1002)}
    names = {path.name for path in (tmp_path / "one").glob("*.exr")}
    assert names == {tile["file"] for e in report["reports"] for o in e["objects"] for tile in o["tiles"].values()}


def test_a_bake_with_apply_is_finished_by_merge(room, tmp_path):
    def bake(output, **shard):
        options = BakeOptions(room, output, objects=("Slab", "Floor"), size=(64, 64), margin=2, apply=True)
        return batch.run_tasks(BatchJob("bake", options, (room,)), **shard)

    for number in (1, 2):
        assert bake(tmp_path / "out", shard=(number, 2)).problems == ()
    report = merge(tmp_path / "out").report
    assert report["applied"] == "room_baked.blend" and [item["name"] for item in report["objects"]] == ["Slab", "Floor"]
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out" / "room_baked.blend"))
    for name in ("Floor", "Slab"):
        assert bpy.data.objects[name].material_slots[0].material.name.endswith(f"(baked {name})")


def test_json_is_alone_on_stdout_whatever_blender_prints():
    code = (
        "import os, sys\nfrom ltsh_addon.cli.progress import reserve_stdout\n"
        "print('before', flush=True)\nreserve_stdout()\n"
        "os.write(1, b'from C\\n')\nprint('{}')\nos.write(1, b'at the end\\n')\n"
    )
    done = run([sys.executable, "-c", code])
    assert done.stdout == "before\n{}\n" and done.stderr == "from C\nat the end\n"


def test_the_command_in_blender_answers_with_one_document(room, tmp_path):
    """As Blender calls it, with the file open: the same document as with pip's bpy."""
    code = f"""
import sys, bpy
bpy.ops.wm.open_mainfile(filepath={str(room)!r})
handlers = []
bpy.utils.register_cli_command = lambda name, run: handlers.append(run) or run
bpy.utils.unregister_cli_command = lambda handle: None
import ltsh_addon, os
ltsh_addon.register()
code = handlers[0](["shade", "-o", {str(tmp_path / "a")!r}, "--techniques", "ltc", "--json", "--quiet"])
os.write(1, b"Blender quit\\n")
sys.stdout.flush()
os._exit(code)
"""
    done = run(programs.python(code))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout[done.stdout.index("{\n") :])
    arguments = ("shade", room, "-o", tmp_path / "b", "--techniques", "ltc", "--json", "--quiet")
    other = run(programs.command_line(*arguments))
    assert found == programs.document(other.stdout) and "Blender quit" in done.stderr
    assert (tmp_path / "a" / "shade.exr").read_bytes() == (tmp_path / "b" / "shade.exr").read_bytes()
