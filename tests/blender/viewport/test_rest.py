"""Bounces of a view: with them the view is Cycles' whole picture, and the second Blender follows the scene by its
changes."""

import json
import math
import time
from dataclasses import asdict, replace
from itertools import pairwise
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from fake_scene import run
from graphics_card import edits_with_graphics, with_graphics
from view_pictures import OpenView

from ltsh_addon.blender.process.view import OWN_ERROR, RestJob, RestView, WholePictureError, marked_depth
from ltsh_addon.blender.render_settings import render_exr, show_as_views
from ltsh_addon.blender.viewport import rest
from ltsh_addon.blender.viewport.drawing import float_texture, read_texture
from ltsh_addon.blender.viewport.pictures import ShownPicture, ShownRest
from ltsh_addon.blender.viewport.shadow_rays import ShadowRays, ViewTracer, view_occluders
from ltsh_addon.blender.viewport.shadows import FIRST_POINTS
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.scene import DEFAULT_TECHNIQUE

SIZE = (48, 32)
# Cycles' steps between float32 sums of other seeds' order, and rounding of matrices that were set.
SAME = {"rtol": 1e-3, "atol": 1e-3}


def room():
    """A gray corner with chrome, wood by nodes, glass before them, and a sign that shines; the camera."""
    scene = parts.empty_scene(*SIZE)
    parts.add_plane(parts.principled("paper", Roughness=0.9)[0], size=4.0)
    red = {"Base Color": (0.8, 0.2, 0.1, 1.0), "Roughness": 0.8}
    wall = parts.principled("wall", **red)[0]
    parts.add_plane(wall, name="Wall", size=4.0, location=(0, 1.2, 0), rotation=(1.5708, 0, 0))
    chrome = parts.principled("chrome", Metallic=1.0, Roughness=0.4)[0]
    parts.add_sphere(chrome, radius=0.45, name="Chrome", location=(-0.7, 0.3, 0.45))
    wood, node = parts.principled("wood", Roughness=0.6)
    noise = wood.node_tree.nodes.new("ShaderNodeTexWave")
    wood.node_tree.links.new(noise.outputs["Color"], node.inputs["Base Color"])
    parts.add_plane(wood, name="Wood", size=0.8, location=(0.4, 0.5, 0.5), rotation=(0.9, 0, 0))
    glass = parts.principled("glass", **{"Transmission Weight": 1.0, "Roughness": 0.1})[0]
    parts.add_sphere(glass, radius=0.3, name="Glass", location=(0.6, -0.5, 0.35))
    sign = parts.principled("sign", **{"Emission Color": (0.1, 0.4, 1.0, 1.0), "Emission Strength": 0.7})[0]
    parts.add_plane(sign, name="Sign", size=0.4, location=(0.0, 1.1, 0.9), rotation=(1.5708, 0, 0))
    parts.add_area_light(location=(0.6, -1.0, 2.2), energy=60.0)
    parts.add_world(Color=(0.3, 0.4, 0.6, 1.0), Strength=0.4)
    scene.cycles.use_adaptive_sampling = False
    camera = parts.add_camera((0.0, -3.4, 1.6), (1.25, 0.0, 0.0))
    camera.data.shift_x = 0.03
    bpy.context.view_layer.update()
    return camera


def test_a_view_with_bounces_is_the_picture_of_cycles(tmp_path, capsys):
    with_graphics(lambda: None)
    room()
    path = parts.save(tmp_path / "room.blend")
    options = ("--techniques", "ltsh4c", "--shadow-rays", 256, "--json", "--quiet")
    errors = {}
    # Two halves with noise of their own: the product of the differences from them has no noise on average.
    renders = [parts.cycles_channels(tmp_path, 150, seed=seed) for seed in (1, 2)]
    halves = [read_layer(one, "Combined", "RGB").astype(float) for one in renders]
    for bounces, points in (("on", 17), ("off", 1)):
        arguments = ("--refine", points, "--bounces", bounces, "--rest-samples", 64)
        code, stdout, _ = run(capsys, "view", path, "-o", tmp_path / bounces, *options, *arguments)
        assert code == 0
        channels = read_channels(tmp_path / bounces / "view.exr")
        picture = np.stack([channels[f"ltsh4c.combined.{letter}"] for letter in "RGB"], axis=-1)
        products = np.prod([picture - half for half in halves], axis=0)
        errors[bounces] = np.sqrt(products.sum() / np.prod(halves, axis=0).sum())
        report = json.loads(stdout)
        assert ("rest_s" in report) == (bounces == "on")
        # What Cycles shows of the materials itself needs no excuse.
        assert any("not resolved" in line for line in report["warnings"]) == (bounces == "off")
    # 64 samples, denoised, and 17 points at the edges of highlights leave some percent; without, a fifth is missing.
    assert errors["on"] < 0.06 and errors["off"] > 0.2, errors


@pytest.mark.parametrize("samples", [8, 64])
def test_outlines_of_what_is_cycles_alone_have_the_light_of_both_sides(tmp_path, capsys, samples):
    """Before a lit wall stand a sign that shines and a card by nodes. Samples of a pixel are of one side or the other:
    products of means would have f (1 - f) of the difference of both sides, up to a quarter of it."""
    with_graphics(lambda: None)
    parts.empty_scene(*SIZE)
    wall = parts.principled("wall", **{"Base Color": (0.6, 0.6, 0.6, 1.0), "Specular IOR Level": 0.0})[0]
    parts.add_plane(wall, size=9.0)
    sign = parts.bsdf_material("ShaderNodeEmission", "sign", Color=(1.0, 0.5, 0.2, 1.0))[0]
    parts.add_plane(sign, size=0.7, location=(-0.5, 0.0, 0.2), rotation=(0.0, 0.0, 0.3))
    card, node = parts.principled("card", **{"Specular IOR Level": 0.0})
    wave = card.node_tree.nodes.new("ShaderNodeTexWave")
    card.node_tree.links.new(wave.outputs["Color"], node.inputs["Base Color"])
    parts.add_plane(card, size=0.7, location=(0.5, 0.0, 0.2), rotation=(0.0, 0.0, 0.3))
    parts.add_area_light(location=(0.0, -0.3, 4.0), energy=40.0)
    parts.add_camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    path = parts.save(tmp_path / "cards.blend")
    arguments = ("--refine", 64, "--bounces", "on", "--rest-samples", samples, "--techniques", "ltsh4c", "--quiet")
    assert run(capsys, "view", path, "-o", tmp_path, *arguments)[0] == 0
    channels = read_channels(tmp_path / "view.exr")
    picture = np.stack([channels[f"ltsh4c.combined.{letter}"] for letter in "RGB"], axis=-1)
    expected = read_layer(parts.cycles_channels(tmp_path, 256), "Combined", "RGB")
    sides = [np.roll(expected, step, axis) for axis in (0, 1) for step in (-1, 1)]
    contrast = np.ptp([expected, *sides], axis=0)
    edges = contrast > 0.15
    assert 100 < edges.sum() < 1000
    bias = np.mean((picture - expected)[edges]) / np.mean(contrast[edges])
    assert abs(bias) < 0.04, bias  # 8 samples leave .15 of noise in some 100 pixels


def test_linked_objects_that_have_the_name_of_a_local_one_are_rendered(tmp_path):
    parts.empty_scene()
    lamps = bpy.data.collections.new("Lamps")
    bpy.context.scene.collection.children.link(lamps)
    lamps.objects.link(parts.add_area_light("Key"))
    library = str(parts.save(tmp_path / "library.blend"))
    scene = parts.empty_scene()
    parts.add_area_light("Key")
    with bpy.data.libraries.load(library, link=True) as (_, wanted):
        wanted.collections = ["Lamps"]
    place = parts.link(bpy.data.objects.new("Place", None))
    place.instance_type, place.instance_collection = "COLLECTION", wanted.collections[0]
    show_as_views(scene, bpy.context.view_layer, ())
    keys = [ob for ob in bpy.data.objects if ob.name == "Key"]
    assert len(keys) == 2 and not any(ob.hide_render for ob in keys)
    show_as_views(scene, bpy.context.view_layer, ("Key",))
    assert {ob.library is None: ob.hide_render for ob in keys} == {True: True, False: False}


def test_grease_pencil_is_not_in_the_rest():
    scene = parts.empty_scene()
    kinds = bpy.data.grease_pencils_v3 if hasattr(bpy.data, "grease_pencils_v3") else bpy.data.grease_pencils
    strokes = parts.link(bpy.data.objects.new("Strokes", kinds.new("Strokes")))
    light = parts.add_area_light()
    # Jobs with other frames, or things to hide, choose again.
    for _ in range(2):
        show_as_views(scene, bpy.context.view_layer, ())
        assert strokes.hide_render and not light.hide_render


@pytest.mark.newest
@pytest.mark.parametrize("kind", ["shifted", "parallel"])
def test_the_camera_of_a_region_has_its_matrices(kind):
    scene, (width, height) = (parts.empty_scene(), (64, 40))
    camera = parts.add_camera((1.0, -4.0, 2.0), (1.1, 0.1, 0.4))
    camera.data.lens, camera.data.shift_x, camera.data.shift_y = 35.0, 0.2, -0.1
    if kind == "parallel":
        camera.data.type, camera.data.ortho_scale = "ORTHO", 5.0
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    window = camera.calc_matrix_camera(depsgraph, x=width, y=height)
    view = camera.matrix_world.inverted()
    rest._look_through(scene, view, window, (width, height))
    made = scene.camera
    bpy.context.view_layer.update()
    seen = made.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=width, y=height)
    # A point in front of the camera is at the same place of the picture; depth may differ in parallel views.
    for place in (0.3, -0.4, -3.0), (-1.0, 0.2, -9.0):
        point = np.array(view.inverted()) @ [*place, 1.0]
        clips = [np.array(window @ view) @ point, np.array(seen @ made.matrix_world.inverted()) @ point]
        places = [clip[:2] / clip[3] for clip in clips]
        np.testing.assert_allclose(places[0], places[1], atol=1e-4)


def followed(live, context, monkeypatch, world=True):
    """Let `live` do its steps until it rests; the last picture, and the jobs that were done."""
    jobs, pixels, begin = [], None, rest.LiveRest._begin

    def noted(self):
        begin(self)
        jobs.append(self._run.job)

    monkeypatch.setattr(rest.LiveRest, "_begin", noted)
    live.follow(context, SimpleNamespace(scene=bpy.context.scene, view_layer=bpy.context.view_layer), world)
    end = time.monotonic() + 120.0
    while live.is_busy and time.monotonic() < end:
        if live.step() and live.has_news:
            pixels = live._picture.rest
        time.sleep(0.02)
    monkeypatch.setattr(rest.LiveRest, "_begin", begin)
    assert not live.problem and not live.is_busy
    return pixels, jobs


def picture_of_cycles(folder):
    """Cycles' own picture (H, W, 3) of the open scene, with 64 samples."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 64, False
    render_exr(scene, folder / "own.exr", "NONE")
    return read_layer(read_channels(folder / "own.exr"), "Combined", "RGB")


def context_of(camera):
    """A region that sees what `camera` sees."""
    window = camera.calc_matrix_camera(bpy.context.view_layer.depsgraph, x=SIZE[0], y=SIZE[1])
    view = SimpleNamespace(view_matrix=camera.matrix_world.inverted(), window_matrix=window)
    region = SimpleNamespace(width=SIZE[0], height=SIZE[1])
    return SimpleNamespace(region=region, region_data=view, space_data=SimpleNamespace(local_view=None))


def test_changes_are_handed_over_by_themselves_and_show_what_a_whole_file_shows(monkeypatch):
    monkeypatch.setattr(rest, "REST_SECONDS", 0.0)
    camera = room()
    context, live = context_of(camera), rest.LiveRest()
    handlers = bpy.app.handlers.depsgraph_update_post
    note = lambda scene, depsgraph: live.note(depsgraph)  # noqa: E731
    live.note(bpy.context.view_layer.depsgraph)
    handlers.append(note)
    try:
        first, jobs = followed(live, context, monkeypatch)
        assert [job.scene is None for job in jobs] == [False]
        light, chrome = bpy.data.objects["Light"], bpy.data.objects["Chrome"]
        light.data.energy *= 2.0
        light.location.x -= 0.5
        chrome.location.z += 0.1
        bpy.data.materials["wall"].node_tree.nodes[-1].inputs["Base Color"].default_value = (0.1, 0.7, 0.2, 1.0)
        bpy.data.materials["wood"].node_tree.nodes["Wave Texture"].inputs["Scale"].default_value = 9.0
        bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.8
        bpy.context.view_layer.update()
        second, jobs = followed(live, context, monkeypatch)
        assert all(job.scene is None for job in jobs) and jobs[0].changes["moved"]
        # Selecting renders nothing; what cannot be told piece by piece goes as a whole.
        chrome.select_set(True)
        bpy.context.view_layer.update()
        assert followed(live, context, monkeypatch)[1] == []
        child = live._blender.process._child
        live.stop()
        assert child.poll() is not None
        live.note(bpy.context.view_layer.depsgraph)
        whole, jobs = followed(live, context, monkeypatch)
        assert jobs[0].scene is not None
        # Without the light of the world the rest is that of a world that only the camera sees.
        without, _ = followed(live, context, monkeypatch, world=False)
        bpy.context.scene.world.cycles_visibility.diffuse = bpy.context.scene.world.cycles_visibility.glossy = False
        bpy.context.scene.world.cycles_visibility.transmission = False
        # The next view takes the second Blender of one that was left.
        live.stop(keeps=True)
        (left,), live = rest.spare, rest.LiveRest()
        child = left.process._child
        live.note(bpy.context.view_layer.depsgraph)
        unseen, _ = followed(live, context, monkeypatch)
        assert live._blender is left and left.process._child is child and not rest.spare
        chrome.modifiers.new("Wave", "SUBSURF")
        bpy.context.view_layer.update()
        assert live._changes.everything
    finally:
        handlers.remove(note)
        live.stop()
    assert np.abs(first - whole).max() > 0.05
    np.testing.assert_allclose(second[..., :3], whole[..., :3], **SAME)
    np.testing.assert_allclose(without[..., :3], unseen[..., :3], **SAME)
    assert without[..., :3].mean() < 0.9 * whole[..., :3].mean()


@pytest.mark.newest
def test_the_second_blender_goes_on_while_the_window_draws(monkeypatch, tmp_path):
    """One look at it brings the last picture, with the whole one of Cycles; what is not wanted any more ends after its
    step."""
    monkeypatch.setattr(rest, "REST_SECONDS", 0.0)
    camera = room()
    context, live = context_of(camera), rest.LiveRest()
    scene = SimpleNamespace(scene=bpy.context.scene, view_layer=bpy.context.view_layer)
    live.note(bpy.context.view_layer.depsgraph)
    try:
        live.follow(context, scene, has_whole=True)
        live.step()
        live._run.thread.join(120.0)
        assert live.step() and live._samples == rest.TOTALS[-1] and not live.is_busy
        path, last = live._blender.folder, round(math.log2(rest.TOTALS[-1]))
        files = [(path / name.format(last)).exists() for name in (rest.LIVE_REST, rest.LIVE_WHOLE)]
        assert files == [False, False], "files of pictures that were read are removed"
        # 48 x 32 pixels after 64 samples, denoised: the noise in the mean is below 1 %.
        picture = live._picture
        own, whole, part = (
            one[..., :3].mean(axis=(0, 1)) for one in (picture_of_cycles(tmp_path), picture.whole, picture.rest)
        )
        np.testing.assert_allclose(whole, own, rtol=0.03)
        assert np.all(whole > 1.1 * part)
        live._picture.shown = ShownRest(None, None, whole="whole")
        assert live.shown().whole == "whole"
        camera.location.x += 0.1
        bpy.context.view_layer.update()
        live.follow(context_of(camera), scene)
        assert live.shown().whole is None, "the whole picture is of no other view"
        live.step()
        run = live._run
        live.pause()
        live.step()
        run.thread.join(60.0)
        assert not run.thread.is_alive() and not run.error
        assert run.picture is None or run.picture.total < rest.TOTALS[-1]
    finally:
        live.stop()


@pytest.mark.newest
def test_a_step_takes_what_there_is_time_for_and_pictures_come_with_more_and_more_pixels():
    """Each picture has all its samples, whatever the share of a picture that a step takes."""
    one, other = RestView(scene="one"), RestView(scene="other")
    for share, shrinks in ((0.02, [4, 2, 1]), (0.13, [4, 2, 1]), (0.3, [2, 1]), (1.0, [1]), (5.0, [1])):
        job, rendered, pictures = RestJob(None, other, 16), 0.0, []
        while not pictures or pictures[-1] != (1, 64):
            job = rest.next_job(job, one, share)
            samples = job.samples * (job.rows[1] - job.rows[0])
            assert job.view == one and 0.0 < samples <= 1.02 * share * job.shrink**2
            rendered = rendered + samples if job.continues else samples
            if rest.makes_picture(job):
                pictures.append((job.shrink, job.total))
                assert rendered == pytest.approx(job.total)
        assert pictures == [*((shrink, 1) for shrink in shrinks), *((1, 2**power) for power in range(1, 7))]


@pytest.mark.newest
def test_rows_that_are_rendered_apart_are_those_of_the_whole_picture(tmp_path):
    camera = room()
    path, sums = parts.save(tmp_path / "room.blend"), []
    context = context_of(camera)
    matrices = tuple(tuple(map(tuple, getattr(context.region_data, name))) for name in ("view_matrix", "window_matrix"))
    for shares in ((0.0, 1.0), (0.0, 0.3, 0.9, 1.0), (0.0, 0.1, 0.17, 0.4, 0.55, 0.68, 0.71, 1.0)):
        bands = [*pairwise(shares)]
        for number, rows in enumerate(bands):
            view = asdict(RestView(matrices=matrices, size=SIZE))
            job = RestJob(None if sums or number else path, view, 2, rows=rows, continues=number > 0)
            rest.render_step(job, tmp_path, lambda *stage: None)
        sums.append(rest._sum[0])
    assert [one.samples for one in sums] == [2, 2, 2]
    for name in ("light", "guides", "depth"):
        whole, *others = (getattr(one, name) for one in sums)
        for other in others:
            np.testing.assert_array_equal(other, whole)


@pytest.mark.newest
def test_samples_of_several_steps_are_those_of_one(tmp_path):
    """Of one sequence; but where a pixel shows several materials, whose light times color is that of means."""
    room()
    path, sums = parts.save(tmp_path / "room.blend"), []
    for counts in ((8,), (1, 1, 2, 4)):
        for done, samples in zip((0, *np.cumsum(counts)), counts, strict=False):
            view = asdict(RestView(size=SIZE))
            job = RestJob(None if sums or done else path, view, samples, int(done), continues=done > 0)
            rest.render_step(job, tmp_path, lambda *stage: None)
        sums.append(rest._sum[0])
    assert (np.abs(sums[1].light - sums[0].light).max(axis=-1) < 1e-4).mean() > 0.9


@edits_with_graphics
def test_cycles_whole_picture_gives_way_to_points_under_fine_shadows():
    """It stands for few pixels, for coarse shadows and for drawings that fail; never for a technique that is chosen."""
    camera, whole, default = room(), np.full((*SIZE[::-1], 4), (0.5, 0.25, 0.125, 1.0)), DEFAULT_TECHNIQUE
    points = np.zeros((2 * FIRST_POINTS, 2))
    occluders = view_occluders(bpy.context.evaluated_depsgraph_get(), lambda text: None)

    def pictures():
        with OpenView(camera, SIZE) as opened:
            renderer = opened.renderer
            renderer.shadows, renderer.has_bounces = ShadowRays(ViewTracer(occluders), 8), True
            black = float_texture(np.zeros_like(whole))
            shown = ShownRest(black, opened.view)
            renderer.rest, renderer.shadows.is_fine, found = shown, True, {}
            found["own"] = opened.draw(ShownPicture(default, "combined"))
            renderer.rest = replace(shown, whole=float_texture(whole))
            found["errs more"] = opened.draw(ShownPicture(default, "combined"))
            renderer.rest = replace(renderer.rest, whole_errs_less=True)
            found["one point"] = opened.draw(ShownPicture(default, "combined"))
            found["other"] = opened.draw(ShownPicture("ltsh4", "combined"))
            renderer.shadows.is_fine = False
            found["coarse"] = opened.draw(ShownPicture(default, "combined"), points)
            while renderer.samples < FIRST_POINTS:
                found["coarse, points"] = opened.draw(ShownPicture(default, "combined"), points)
            renderer.shadows.is_fine = True
            found["fine"] = opened.draw(ShownPicture(default, "combined"), points[:FIRST_POINTS])
            renderer.step = 4
            found["few pixels"] = opened.draw(ShownPicture(default, "combined"))
            with opened.canvas.buffer.bind():
                opened.canvas.buffer.clear(color=(0.0, 0.0, 0.0, 0.0))
            assert renderer.show_whole(opened.view, ShownPicture(default, "combined"), opened.canvas.buffer)
            found["failed"] = opened.canvas.read()
            renderer.rest = shown
            assert not renderer.show_whole(opened.view, ShownPicture(default, "combined"), opened.canvas.buffer)
            return {name: picture[..., :3] for name, picture in found.items()}

    found, whole = with_graphics(pictures), whole[..., :3]
    share = 1.0 / FIRST_POINTS
    np.testing.assert_allclose(found["one point"], (1.0 - share) * whole + share * found["own"], atol=1e-5)
    np.testing.assert_array_equal(found["errs more"], found["own"])
    np.testing.assert_allclose(found["fine"], found["own"], atol=1e-4)
    assert np.abs(found["other"] - whole).mean() > 0.05
    for name in ("coarse", "coarse, points", "few pixels", "failed"):
        np.testing.assert_allclose(found[name], whole, atol=1e-6, err_msg=name)


@edits_with_graphics
def test_a_moved_view_keeps_the_rest_where_its_surface_was_seen():
    """A constant rest on a plane: there it is added; beside, and where another surface was, its color tells."""
    parts.empty_scene(*SIZE)
    parts.add_plane(parts.principled("paper", Roughness=0.9)[0], size=40.0)
    glass = parts.principled("glass", **{"Transmission Weight": 1.0})[0]
    parts.add_plane(glass, size=0.1, name="Beside", location=(15.0, 0.0, 0.5))  # in the scene, not in sight
    parts.add_area_light()
    camera = parts.add_camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    bpy.context.view_layer.update()

    def pictures():
        with OpenView(camera, SIZE) as opened:
            shown = ShownPicture("ltsh4", "combined")
            camera_before, added = opened.view, {}
            # The plane is 3 m deep, where it is not another surface.
            for name, depth, x in (("same", 9.0, 0.0), ("moved", 3.0, 0.3), ("hidden", 9.0, 0.3)):
                texels = np.full((SIZE[1], SIZE[0], 4), 0.25, np.float32)
                texels[..., 3] = depth
                opened.renderer.rest = ShownRest(float_texture(texels), camera_before, ambient=(0.5, 0.5, 0.5))
                camera.location.x = x
                bpy.context.view_layer.update()
                opened.view = OpenView(camera, SIZE).view
                opened.renderer.has_bounces = False
                plain = opened.draw(shown)
                opened.renderer.has_bounces = True
                added[name] = (opened.draw(shown) - plain)[..., :3]
            return added

    added = with_graphics(pictures)
    np.testing.assert_allclose(added["same"], 0.25, atol=1e-5)
    inside, outside = np.s_[2:-2, 2:40], np.s_[2:-2, -3:]
    np.testing.assert_allclose(added["moved"][inside], 0.25, atol=1e-5)
    for name, pixels in (("moved", outside), ("hidden", inside)):
        # Half of the color of the diffuse lobe, .8 but for what the specular one reflects, and of that, .04.
        change = added[name][pixels]
        assert np.all((change > 0.35) & (change < 0.42)), name


@edits_with_graphics
def test_light_of_few_pixels_stays_on_its_surface():
    """A bright plane over a dark floor, in a quarter of the pixels: the floor beside it stays dark."""
    parts.empty_scene(*SIZE)
    paper = parts.principled("paper", Roughness=0.9)[0]
    parts.add_plane(paper, size=40.0)
    parts.add_plane(paper, size=0.4, name="Table", location=(0.03, 0.02, 1.0))
    parts.add_area_light()
    camera = parts.add_camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    bpy.context.view_layer.update()

    def drawn():
        with OpenView(camera, SIZE) as opened:
            shown = ShownPicture("ltsh4", "combined")
            plain, positions = opened.draw(shown), read_texture(opened.renderer._surfaces.position)
            is_table = positions[..., 2] > 0.5
            # Each pixel has the mean of the light of its 4 x 4, and the depth of one of them.
            light, depth = np.where(is_table, 1.0, 0.1), np.where(is_table, 2.0, 3.0)[2::4, 1::4]
            light = light.reshape(SIZE[1] // 4, 4, SIZE[0] // 4, 4).mean(axis=(1, 3))
            texels = np.stack([light, light, light, marked_depth(depth)], axis=-1).astype(np.float32)
            opened.renderer.rest, opened.renderer.has_bounces = ShownRest(float_texture(texels), opened.view), True
            return is_table, (opened.draw(shown) - plain)[..., 0]

    is_table, added = with_graphics(drawn)
    assert 0.05 < is_table.mean() < 0.5
    np.testing.assert_allclose(added, np.where(is_table, 1.0, 0.1), atol=1e-3)


@pytest.mark.newest
def test_the_depth_of_a_mirror_is_its_own(tmp_path):
    """Not that of what it shows, after all samples: a moved view finds its light by the place of its surface."""
    parts.empty_scene(*SIZE)
    mirror = parts.principled("mirror", Metallic=1.0, Roughness=0.0)[0]
    parts.add_plane(mirror, size=40.0)
    parts.add_plane(parts.principled("paper")[0], size=40.0, name="Above", location=(0.0, 0.0, 9.0))
    parts.add_area_light()
    parts.add_camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    path = parts.save(tmp_path / "mirror.blend")
    view = asdict(RestView(size=SIZE))
    for job in (RestJob(path, view, 2), RestJob(None, view, 2, 2, continues=True)):
        rest.render_step(job, tmp_path, lambda *stage: None)
    np.testing.assert_allclose(rest._sum[0].picture()[..., 3], 3.0, rtol=1e-5)


@pytest.mark.newest
@pytest.mark.parametrize("noise", [(0.02, 0.05), (0.03, 0.03)])
def test_the_excess_of_cycles_whole_picture_is_measured_by_two_samples(noise):
    """Of pictures whose noise is known; on a screen, around a gray whose slope is known, too."""
    random, light = np.random.default_rng(3), 0.4
    samples = [[random.normal(scale=size, size=(200, 200, 3)) for size in noise] for _ in range(2)]
    error = WholePictureError()
    assert not error.is_small(1e6) and error.lacks(1.0) and not error.lacks(0.25)
    (rest_1, whole_1), (rest_2, whole_2) = samples
    error.add(1.0, rest_1, light + whole_1, 1.0)
    error.add(2.0, 0.5 * (rest_1 + rest_2), light + 0.5 * (whole_1 + whole_2), 1.0)
    # The slope of sRGB (IEC 61966-2-1) at this light; its bend counts 1 % at such noise.
    slope = 1.055 / 2.4 * light ** (1.0 / 2.4 - 1.0)
    expected = slope**2 * (noise[1] ** 2 - noise[0] ** 2)
    np.testing.assert_allclose(error.excess, expected, rtol=0.05, atol=0.03 * (slope * noise[1]) ** 2)
    assert error.is_small(1.0) == (expected < OWN_ERROR**2) and error.is_small(10.0) and not error.lacks(1.0)
    error.is_old = True
    assert error.lacks(1.0) and error.is_small(10.0), "what is known holds until it is measured again"
