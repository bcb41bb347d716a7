"""Final renders of the engine LTSH as Blender drives them: animations, compositing, render regions, stopping."""

import os
import tempfile
import threading
import time

import bpy
import numpy as np
import pytest
import scene_parts as parts

import ltsh_addon
from ltsh_addon import shading
from ltsh_addon.blender.engine import render as render_module
from ltsh_addon.blender.engine.render import stoppable
from ltsh_addon.blender.process import client
from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.scene import Cancelled

SIZE = (28, 18)


@pytest.fixture
def scene(tmp_path):
    """A lit plane and a sphere in a file of their own, rendered by LTSH into float EXRs."""
    scene = parts.empty_scene(*SIZE)
    ltsh_addon.register()
    parts.add_plane(parts.principled("Shiny", Base_Color=(0.6, 0.3, 0.1, 1.0), Roughness=0.3)[0], size=3.0)
    parts.add_sphere(parts.principled("Smooth", Roughness=0.2)[0], location=(0.4, 0.5, 0.6), segments=16)
    parts.add_area_light()
    parts.add_camera()
    scene.render.engine = "LTSH"
    scene.ltsh_view.render_samples, scene.ltsh_view.technique = 1, "ltsh2"
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    yield scene
    ltsh_addon.unregister()


def colors(path):
    """The picture (H, W, 3) in an EXR of one layer."""
    channels = read_channels(path)
    return np.stack([channels[letter] for letter in "RGB"], axis=-1)


def shaded(path, passes=shading.PASSES, **options):
    """What shading the samples of a .blend gives, (H, W, 3)."""
    extraction = client.extract(client.ExtractOptions(scene=path, **options))
    result = shading.shade(extraction.samples, extraction.lights, "ltsh2", passes=passes)
    return extraction.exposure * extraction.film.image(result.combined)


def saved(tmp_path):
    path = tmp_path / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    return path


def leftovers(folder):
    return [name for name in os.listdir(folder) if name.startswith("ltsh-")]


def test_every_frame_of_an_animation_is_its_own_picture(scene, tmp_path):
    light = next(ob for ob in scene.objects if ob.type == "LIGHT")
    for frame, x in ((1, -1.0), (2, 1.0)):
        light.location.x = x
        light.keyframe_insert("location", frame=frame)
    scene.frame_start, scene.frame_end = 1, 2
    scene.render.filepath = str(tmp_path / "frame_")
    bpy.ops.render.render(animation=True)
    pictures = [colors(tmp_path / f"frame_000{frame}.exr") for frame in (1, 2)]
    path = saved(tmp_path)
    for frame, found in zip((1, 2), pictures, strict=True):
        # Both take the same samples; the pictures are float32.
        np.testing.assert_allclose(found, shaded(path, frame=frame), rtol=1e-6, atol=1e-7)
    assert np.abs(pictures[0] - pictures[1]).max() > 0.01


def composited(scene, pass_name):
    """Make a pass of the first view layer the composited picture."""
    if bpy.app.version >= (5, 0, 0):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        output = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        output = tree.nodes.new("CompositorNodeComposite")
    layers = tree.nodes.new("CompositorNodeRLayers")
    layers.scene = scene
    tree.links.new(layers.outputs[pass_name], output.inputs[0])


def test_the_compositor_has_the_passes(scene, tmp_path):
    path = saved(tmp_path)
    composited(scene, "LTSH Specular")
    scene.render.filepath = str(tmp_path / "composited.exr")
    bpy.ops.render.render(write_still=True)
    found = colors(tmp_path / "composited.exr")
    np.testing.assert_allclose(found, shaded(path, ("specular",)), rtol=1e-6, atol=1e-7)
    assert found.max() > 0.01


@pytest.mark.parametrize("cropped", [True, False])
def test_the_render_region_is_a_part_of_the_whole_picture(scene, tmp_path, cropped):
    scene.render.filepath = str(tmp_path / "whole.exr")
    bpy.ops.render.render(write_still=True)
    render = scene.render
    render.use_border, render.use_crop_to_border = True, cropped
    # Columns 7 to 21 and, counted from below, rows 3 to 12.
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 3 / 18, 12 / 18
    render.filepath = str(tmp_path / "part.exr")
    bpy.ops.render.render(write_still=True)
    whole, part = (colors(tmp_path / name) for name in ("whole.exr", "part.exr"))
    inside = np.s_[6:15, 7:21]
    np.testing.assert_allclose(part if cropped else part[inside], whole[inside], rtol=1e-5, atol=1e-6)
    if not cropped:
        part[inside] = 0.0
        assert (part == 0.0).all()


def test_a_stopped_render_is_no_error_and_leaves_nothing(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    asked, failures = [], []

    def stop(stage, fraction):
        asked.append(stage)
        return False

    monkeypatch.setattr(render_module.LTSH_RenderEngine, "_progress", lambda self: stop)
    monkeypatch.setattr(render_module.LTSH_RenderEngine, "_fail", lambda self, error: failures.append(error))
    bpy.ops.render.render()
    assert asked and not failures
    assert not render_module._copy
    # The work ends, and with it its temporary folders, after the render.
    end = time.monotonic() + 60
    while leftovers(tmp_path) and time.monotonic() < end:
        time.sleep(0.05)
    assert leftovers(tmp_path) == []


def test_progress_grows_to_the_end_and_can_stop(scene, tmp_path):
    path, stages = saved(tmp_path), []
    job = render_module.FinalJob(scene.name, "ViewLayer", None, 2, "ltsh2", "combined", ("ltc", "ltsh4"))
    render_module.final_picture(job, path, lambda stage, fraction: stages.append((fraction, stage)))
    fractions = [fraction for fraction, _ in stages]
    assert fractions == sorted(fractions) and fractions[0] >= 0.0 and 0.9 < fractions[-1] <= 1.0
    assert {"LTC", "LTSH 2", "LTSH 4"} <= {stage for _, stage in stages}
    with pytest.raises(Cancelled):
        render_module.final_picture(job, path, lambda stage, fraction: fraction < 0.9)


def test_work_that_never_asks_is_left_at_once():
    begun, go_on, ended = threading.Event(), threading.Event(), threading.Event()

    def work(report):
        report("waiting", 0.5)
        begun.set()
        go_on.wait(60)
        if report("later", 0.6) is False:
            ended.set()

    with pytest.raises(Cancelled, match="cancelled at waiting"):
        stoppable(work, lambda stage, fraction: not begun.is_set())
    assert not ended.is_set()
    go_on.set()
    # At its next report the work learns that nobody waits.
    assert ended.wait(60)


def test_what_the_work_returns_and_raises_arrives():
    assert stoppable(lambda report: 7, lambda stage, fraction: True) == 7
    with pytest.raises(ZeroDivisionError):
        stoppable(lambda report: 1 / 0, lambda stage, fraction: True)


def test_an_unexpected_error_fails_the_render(scene, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("made for this test")

    monkeypatch.setattr(render_module, "final_picture", broken)
    with pytest.raises(RuntimeError, match="LTSH: ZeroDivisionError: made for this test"):
        bpy.ops.render.render()
    monkeypatch.undo()
    assert bpy.ops.render.render() == {"FINISHED"}
