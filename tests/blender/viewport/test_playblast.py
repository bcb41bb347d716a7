"""Several frames of `ltsh view`: what stays from one to the next is kept, and no picture shows it."""

import shutil

import bpy
import numpy as np
import pytest
import scene_parts as parts
from fake_scene import run
from graphics_card import with_graphics

from ltsh_addon import imaging

SMALL = ("--resolution", "36x24", "--techniques", "ltsh2", "--quiet")


def set_up_scene():
    """A metal ball on a floor beside a glowing sign, under two lights; its camera."""
    parts.empty_scene()
    parts.add_plane(parts.principled("floor", Roughness=0.4)[0])
    metal = parts.bsdf_material("ShaderNodeBsdfAnisotropic", "metal", Color=(0.9, 0.7, 0.4, 1.0), Roughness=0.3)[0]
    parts.add_sphere(metal, location=(-0.4, 0.2, 0.8))
    glowing = parts.principled("glowing", **{"Emission Color": (0.1, 0.2, 0.4, 1.0), "Emission Strength": 0.5})[0]
    parts.add_plane(glowing, name="Sign", size=0.7, location=(1.2, 0.6, 0.6), rotation=(1.2, 0.0, -0.4))
    parts.add_area_light(location=(1.5, -1.0, 2.5), rotation=(0.4, 0.5, 0.0), size=1.0, size_y=0.5)
    parts.add_area_light("Left", location=(-3.0, 0.0, 1.0), rotation=(0.0, -1.3, 0.0), shape="DISK", size=1.5)
    return parts.add_camera((0.3, -4.0, 2.6), (1.02, 0.1, 0.05))


def frames(capsys, path, count, *options):
    """Of each frame of a file its number, and the layers as in a playblast and alone, as a shard of a fresh file."""
    folder, alone, one = (path.parent / name for name in ("frames", "alone", "frame.blend"))
    command = ("view", "--frames", f"1-{count}", *options)
    assert run(capsys, *command, path, "-o", folder)[0] == 0
    for frame in range(1, count + 1):
        shutil.copy(path, one)
        assert run(capsys, *command, one, "-o", alone, "--shard", f"{frame}/{count}")[0] == 0
        yield frame, *(imaging.read_layers(each / f"view_{frame:04d}.exr") for each in (folder, alone))


@pytest.mark.newest
def test_frames_of_a_playblast_are_those_drawn_by_themselves(capsys, tmp_path):
    """Whatever changes, from each frame to the next something else: a light, the camera, a cut to another one, an
    object, its shape, its material, the world, what is there, and nothing. The truth are files opened for one frame,
    as a shard. Where only lights change, the sums of their light have another order."""
    with_graphics(lambda: None)
    camera = set_up_scene()
    scene, (light, sphere, sign) = bpy.context.scene, (bpy.data.objects[name] for name in ("Light", "Sphere", "Sign"))
    sky = parts.add_world(Strength=0.1)[1]
    sphere.shape_key_add(name="Basis")
    flat = sphere.shape_key_add(name="Flat")
    flat.value = 0.0
    for point in flat.data:
        point.co.z *= 0.3
    other = parts.add_camera((-1.5, -3.0, 2.2), (1.0, 0.0, -0.4), name="Other")
    metal = next(node for node in sphere.data.materials[0].node_tree.nodes if "Roughness" in node.inputs)
    strength, roughness = sky.inputs["Strength"], metal.inputs["Roughness"]
    changes = [(light, "location", (0.0, -1.0, 2.0)), (light.data, "energy", 300.0),
               (camera, "location", (0.5, -3.5, 2.6)), (camera.data, "lens", 40.0),
               (sphere, "location", (0.4, 0.2, 0.8)), (flat, "value", 1.0), (roughness, "default_value", 0.6),
               (strength, "default_value", 0.5), (sign, "hide_viewport", True)]  # fmt: skip
    for frame, (block, path, value) in enumerate(changes, 1):
        block.keyframe_insert(path, frame=frame)
        setattr(block, path, value)
        block.keyframe_insert(path, frame=frame + 1)
    last = len(changes) + 3  # with a frame for the cut and one where nothing changes
    for frame, one in ((1, camera), (last - 1, other)):
        scene.timeline_markers.new(f"cut {frame}", frame=frame).camera = one
    path = parts.save(tmp_path / "room.blend")
    options = ("--refine", 2, "--shadow-rays", 8, *SMALL)
    for choice in ("on", "off"):
        before = None
        for frame, layers, expected in frames(
            capsys, path, last if choice == "on" else 2, "--shadows", choice, *options
        ):
            bound = 1e-5 * (frame in (2, 3))
            assert all(np.abs(layers[name] - expected[name]).max() <= bound for name in expected), frame
            has_changed = before is not None and not np.array_equal(before, expected["ltsh2.combined"])
            assert has_changed == (1 < frame < last), f"frame {frame} tests nothing"
            before = expected["ltsh2.combined"]


@pytest.mark.newest
def test_bounces_of_a_playblast_are_those_of_its_frames(capsys, tmp_path):
    """A light moves, then a metal becomes so smooth that Cycles alone shows it, then another camera looks."""
    with_graphics(lambda: None)
    camera = set_up_scene()
    light, sphere = (bpy.data.objects[name] for name in ("Light", "Sphere"))
    metal = next(node for node in sphere.data.materials[0].node_tree.nodes if "Roughness" in node.inputs)
    changes = ((light, "location", (0.0, -1.0, 2.0)), (metal.inputs["Roughness"], "default_value", 0.02))
    for frame, (block, path, value) in enumerate(changes, 1):
        block.keyframe_insert(path, frame=frame)
        setattr(block, path, value)
        block.keyframe_insert(path, frame=frame + 1)
    for frame, one in ((1, camera), (4, parts.add_camera((-1.5, -3.0, 2.2), (1.0, 0.0, -0.4), name="Other"))):
        bpy.context.scene.timeline_markers.new(f"cut {frame}", frame=frame).camera = one
    path, before = parts.save(tmp_path / "room.blend"), None
    options = ("--refine", 1, "--shadows", "off", "--bounces", "on", "--rest-samples", 4, *SMALL)
    for frame, layers, expected in frames(capsys, path, 4, *options):
        picture = expected["ltsh2.combined"]
        assert np.linalg.norm(layers["ltsh2.combined"] - picture) < 1e-4 * np.linalg.norm(picture), frame
        assert before is None or np.linalg.norm(picture - before) > 0.02 * np.linalg.norm(before), (
            f"frame {frame} tests nothing"
        )
        before = picture


@pytest.mark.newest
def test_shadows_of_a_small_playblast_are_those_of_a_still(capsys, tmp_path):
    """A ball on a floor: its shadow is thinner than what larger pictures skip of rays."""
    with_graphics(lambda: None)
    parts.empty_scene()
    parts.add_plane(parts.principled("floor", Roughness=0.9)[0], size=6.0)
    parts.add_sphere(parts.principled("ball", Roughness=0.9)[0], radius=0.5, location=(0.0, 0.0, 0.5))
    parts.add_area_light(location=(-0.3, -0.4, 3.0), size=0.3)
    parts.add_camera((0.3, -4.0, 2.6), (1.02, 0.1, 0.05))
    path = parts.save(tmp_path / "ball.blend")
    pictures = []
    for count in (1, 2):
        command = ("view", path, "-o", tmp_path / str(count), "--frames", f"1-{count}", "--resolution", "96x64")
        assert run(capsys, *command, "--techniques", "ltsh2", "--refine", 1, "--shadow-rays", 256, "--quiet")[0] == 0
        (file,) = (tmp_path / str(count)).glob("view*1.exr" if count == 2 else "view.exr")
        pictures.append(imaging.read_layers(file)["ltsh2.combined"])
    # 32 rays in place of 256: the deviation of a stratified penumbra is below .05 of the light.
    off = np.abs(pictures[1] - pictures[0]).max() / pictures[0].max()
    assert off < 0.12, off
