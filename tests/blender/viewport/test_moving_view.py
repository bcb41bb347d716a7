"""Views while they move: fewer pixels, drawn between, and shadows that are near at once."""

import gc
import math
import weakref
from dataclasses import replace
from types import SimpleNamespace

import bpy
import gpu
import numpy as np
import pytest
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from view_pictures import OpenView

from ltsh_addon.blender.engine import redraws, view
from ltsh_addon.blender.render_settings import balanced_points, sub_pixel_offsets
from ltsh_addon.blender.viewport import drawing, shadow_rays, shadows, surfaces
from ltsh_addon.blender.viewport.drawing import (
    ShadersMissing,
    float_texture,
    forget_shaders,
    new_shaders_until,
    read_texture,
)
from ltsh_addon.blender.viewport.mirror import Changes
from ltsh_addon.blender.viewport.pictures import SampleSum, ShownPicture, ShownRest
from ltsh_addon.blender.viewport.shadow_rays import ShadowRays, ViewTracer, view_occluders
from ltsh_addon.blender.viewport.shadows import LiveShadows, ShadowRequest
from ltsh_addon.lobes.lookup_table import LookupTable

SIZE = (72, 48)


def set_up_scene():
    """A shiny ball on a floor, before a wall, under two lights; its camera."""
    parts.empty_scene(*SIZE)
    gray, metal = parts.principled("gray", Roughness=0.4)[0], parts.principled("metal", Metallic=1.0, Roughness=0.3)[0]
    parts.add_plane(gray, size=9.0)
    parts.add_plane(gray, name="Wall", size=9.0, location=(0.0, 3.0, 2.0), rotation=(1.57, 0.0, 0.0))
    parts.add_sphere(metal, radius=0.8, location=(-0.4, 0.2, 0.8))
    parts.add_area_light(location=(1.5, -1.0, 2.5), rotation=(0.4, 0.5, 0.0), size=1.0, size_y=0.5)
    parts.add_area_light("Left", location=(-3.0, 0.0, 1.0), rotation=(0.0, -1.3, 0.0), shape="DISK", size=1.5)
    camera = parts.add_camera((0.3, -4.0, 2.6), (1.02, 0.1, 0.05))
    bpy.context.view_layer.update()
    return camera


def test_pictures_of_what_moves_have_as_many_pixels_as_the_time_allows(monkeypatch):
    """Of 64 s^-2 units of time at step s, with a goal of 10: at first whole, then 1 of 4 x 4 pixels while it moves."""
    now = [0.0]
    monkeypatch.setattr(redraws.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(redraws.PixelSize, "last_seconds", 0.0)
    light, size = object(), redraws.PixelSize()

    def step(state, whole):
        chosen = size.follow(((light,), (state,)))
        if size.is_new:
            now[0] += whole / chosen**2
            size.note(whole / chosen**2)
        return chosen

    slow = 6.4 * redraws.FRAME_SECONDS
    assert [step(state, slow) for state in "abcc"] == [1, 4, 4, 4]
    # Nothing is known after shaders were compiled: it begins with few pixels, and is whole soon.
    size.begin_small()
    assert step("c", slow) == 4
    now[0] += redraws.MOVING_SECONDS
    assert step("c", slow) == 1
    # What is quicker gets more of its pixels, and all once nothing has changed for a while.
    assert step("d", slow / 2.0) == 4 and step("e", slow / 2.0) == 2
    assert 0.0 < size.end - now[0] <= redraws.MOVING_SECONDS
    now[0] = size.end
    assert size.follow(((light,), ("e",)), wait=0.1) == 2, "shadows are traced while nothing is drawn"
    assert step("e", slow) == 1 and not size.is_new
    assert step("f", slow) == 4
    # A drawing that fails keeps neither a view from being drawn nor one that moves from being quick.
    size.follow(((light,), ("g",)))
    assert size.is_new and step("g", slow) == 4 and size.end < now[0] + 1.0
    quick = [step(state, 0.9 * redraws.FRAME_SECONDS) for state in "hij"]
    assert quick == [4, 1, 1]
    # Another view of a slow machine begins with few pixels.
    step("k", slow)
    assert redraws.PixelSize().follow(((light,), ("k",))) == 4


@pytest.mark.parametrize(
    ("news", "step", "seconds", "samples", "is_whole", "passed", "is_due"),
    [
        (True, 1, 1.0, 0, False, 1.0, False),
        (True, 1, 1.0, 0, False, redraws.BOUNCES_SECONDS, True),
        (True, 4, 1.0, 0, False, 1.0, True),  # few pixels take no time
        (True, 1, 0.01, 0, False, 1.0, True),  # nor do all of a quick machine
        (True, 1, 1.0, 1, False, 1.0, True),
        (False, 1, 1.0, 1, False, 9.0, False),
        (True, 1, 1.0, 1, True, 1.0, False),  # samples improve what is shown, and shadows do not
        (True, 1, 1.0, view.WHOLE_SAMPLES, True, 1.0, True),
    ],
)
def test_new_shadows_of_slow_pictures_wait_for_bounces(
    monkeypatch, news, step, seconds, samples, is_whole, passed, is_due
):
    now = 100.0
    monkeypatch.setattr(redraws.time, "monotonic", lambda: now)
    monkeypatch.setattr(redraws, "moments", {"drawn": now - passed})
    size = redraws.PixelSize()
    size.note(seconds)
    size.step, size._changed = step, now - passed
    parts_of_view = SimpleNamespace(
        _pixel_size=size,
        _shadows=SimpleNamespace(has_news=news),
        _renderer=SimpleNamespace(shows_whole=is_whole),
        rest=SimpleNamespace(lacks=lambda count: samples < count),
    )
    for name in ("_has_better_to_come", "_held_until"):
        setattr(parts_of_view, name, getattr(view.EngineView, name).fget(parts_of_view))
    assert view.EngineView.has_new_shadows.fget(parts_of_view) is is_due


def test_a_picture_that_is_wanted_sooner_does_not_wait_for_a_later_one(monkeypatch):
    """Timers of Blender keep the time that they were given first."""
    timers = {}
    calls = SimpleNamespace(
        is_registered=timers.__contains__,
        unregister=timers.pop,
        register=lambda timer, first_interval: timers.__setitem__(timer, first_interval),
    )
    monkeypatch.setattr(redraws, "bpy", SimpleNamespace(app=SimpleNamespace(timers=calls)))
    monkeypatch.setattr(redraws, "moments", {"next": 0.0})
    now = redraws.time.monotonic()
    for seconds in (20.0, 0.1, 5.0):
        redraws.redraw_at(now + seconds)
        assert timers[redraws.redraw] <= seconds


@pytest.mark.newest
def test_a_picture_with_fewer_pixels_is_interpolated_and_as_bright_and_leaves_nothing_behind(monkeypatch):
    """While a view moves. The truth is numpy's interpolation of the picture of a smaller view, with the rest."""
    camera, shown, step = set_up_scene(), ShownPicture("ltsh4", "combined", transparent=True), 3
    monkeypatch.setattr(surfaces, "MOST_WIDENING", 0.0)  # smaller views keep narrow lobes

    def draw():
        with OpenView(camera, SIZE) as opened:
            before = opened.draw(shown)
            opened.renderer.wait()  # the picture was drawn with depths alone
            opened.renderer.step = step
            moving = opened.draw(shown)
            opened.renderer.has_bounces, added = True, float_texture(np.full((4, 6, 4), (0.5, 0.25, 0.125, 0.0)))
            opened.renderer.rest = ShownRest(added, opened.view)
            with_rest = opened.draw(shown)
            opened.renderer.step, opened.renderer.has_bounces = 1, False
            after = opened.draw(shown)
        with OpenView(camera, tuple(side // step for side in SIZE)) as opened:
            return before, moving, with_rest, after, opened.draw(shown)

    before, moving, with_rest, after, small = with_graphics(draw)
    assert np.array_equal(before, after) and moving.shape == before.shape
    for axis in (0, 1):
        count = small.shape[axis]
        at = np.clip((np.arange(count * step) + 0.5) / step - 0.5, 0.0, count - 1.0)
        low = np.minimum(at.astype(int), count - 2)
        share = np.expand_dims(at - low, tuple(other for other in range(3) if other != axis))
        small = (1.0 - share) * small.take(low, axis) + share * small.take(low + 1, axis)
    assert np.abs(moving - small).max() < 1e-5 * small.max()
    # 1 of 9 pixels: the mean of a smooth picture is that of all of them.
    assert abs(moving[..., :3].mean() / before[..., :3].mean() - 1.0) < 0.01
    assert np.abs(with_rest[..., :3] - moving[..., :3] - (0.5, 0.25, 0.125)).max() < 1e-5 * small.max()


def live_steps(is_held):
    """A view with live shadows that moves and comes to rest: exact pictures, and after each step of the thread the
    levels that it did, and the picture; and what many rays at every pixel give. If it `is_held`, the last level waits
    until it may begin."""
    camera, shown, live = set_up_scene(), ShownPicture("ltsh4", "combined", transparent=True), LiveShadows()

    def collect():
        return view_occluders(bpy.context.evaluated_depsgraph_get(), lambda text: None)

    with OpenView(camera, SIZE) as opened:
        renderer = opened.renderer

        def drawn(step, shadows):
            live.follow((0,), collect)
            renderer.step, renderer.shadows = step, shadows
            return opened.draw(shown)[..., :3].astype(np.float64)

        try:
            exact, plain = drawn(1, ShadowRays(ViewTracer(collect()), 256)), drawn(1, None)
            drawn(2, live)
            live._thread.join()
            drawn(2, live)
            is_done = not live.is_busy  # the smaller picture gets no finer ones
            live.hold(is_held)
            coarse = drawn(1, live)
            live._thread.join()
            done = [(request.level, len(outcome)) for request, outcome in live._outcomes]
            last = [] if is_held else [live._outcomes.pop()]
            quick = drawn(1, live)
            if is_held:
                is_done &= not live.is_busy
                live.hold(False)
                drawn(1, live)
                live._thread.join()
                done += [(request.level, len(outcome)) for request, outcome in live._outcomes]
            live._outcomes.extend(last)
            live.take_news()
            return exact, plain, is_done, done, coarse, quick, drawn(1, live)
        finally:
            live.stop()


@edits_with_graphics
@pytest.mark.parametrize("is_held", [False, True])
def test_shadows_of_what_has_moved_are_near_at_once_and_need_few_rays(monkeypatch, is_held):
    monkeypatch.setattr(shadows, "MANY_POINTS", 1000)
    points, traced = [], ShadowRequest._traced
    monkeypatch.setattr(
        ShadowRequest, "_traced", lambda self, *given: (points.append(len(given[0])), traced(self, *given))[1]
    )
    exact, plain, is_done, done, *pictures = with_graphics(lambda: live_steps(is_held))
    without, coarse, quick, fine = (np.linalg.norm(one - exact) / np.linalg.norm(exact) for one in (plain, *pictures))
    assert is_done and done == [(shadows.QUICK, 2), (1, 2)]
    # The coarse ones of the smaller picture are shown in the whole one; those of every 16th pixel, with the pixels
    # around which they differ, are within the 3 % that a view may be off 5 s after an orbit.
    assert without > 0.07 and coarse < 0.5 * without and quick < 0.03 and fine < 0.02
    assert points[1] + points[2] < 0.7 * points[3]


def test_shares_are_smoothed_along_surfaces_and_shadows_stay_sharp():
    """Noise in a plane becomes .45 times as large or less: weights 4, 2 and 1 have the deviation .375. What lies beside
    it, in another plane or as another share, is left alone."""
    noise = np.random.default_rng(1).normal(0.0, 0.05, (40, 60, 2))
    values, position, normal = 0.5 + noise, np.ones((40, 60, 4)), np.zeros((40, 60, 3))
    position[..., 1], position[..., 0] = np.mgrid[:40, :60]
    position[..., 2], normal[..., 2] = 0.0, 1.0
    values[:, 30:] += 2.0
    found = shadows._smoothed(values, position, normal)
    assert np.abs(found[:, :30] - 0.5).std() < 0.45 * 0.05 and np.abs(found[:, 30:] - 2.5).max() < 0.2
    same = shadows._smoothed(values * 0.0 + values[:1, :1], position, normal)
    np.testing.assert_allclose(same, np.broadcast_to(values[:1, :1], same.shape), rtol=1e-6)
    # A wall from row 20 on: nothing goes across.
    position[20:, :, 2], position[20:, :, 1], normal[20:] = position[20:, :, 1] - 19.5, 20.0, (0.0, -1.0, 0.0)
    position[5, 5, 3] = 0.0
    values[...] = 0.3
    values[20:] = 0.5
    values[5, 5] = 0.6
    found = shadows._smoothed(values, position, normal)
    np.testing.assert_allclose(np.delete(found, 5, axis=1), np.delete(values, 5, axis=1), atol=2e-3)
    np.testing.assert_allclose(found[4, 4], 0.3, atol=1e-6)


def drawn_in_steps(camera, shown, most, unfinished=lambda drawings: None):
    """The number of drawings without time before the last of at most `most`, and its picture. `unfinished` is called
    with the number of those before each that ends without a picture."""
    with OpenView(camera, SIZE) as opened:
        for drawings in range(most):
            try:
                with new_shaders_until(0.0):
                    return drawings, opened.draw(shown)
            except ShadersMissing:
                unfinished(drawings)
    raise AssertionError(f"{most} drawings made no picture")


@pytest.mark.newest
def test_a_drawing_that_has_no_time_compiles_one_shader_at_most_and_the_last_one_has_the_picture():
    camera, shown = set_up_scene(), ShownPicture("ltsh4", "combined")

    def draw():
        with OpenView(camera, SIZE) as opened:
            expected = opened.draw(shown)
        forget_shaders()
        return *drawn_in_steps(camera, shown, 40), expected

    drawings, picture, expected = with_graphics(draw)
    # At least those of two steps of the horizons and of the lighting are missing; every other drawing compiles one.
    assert drawings >= 4
    np.testing.assert_array_equal(picture, expected)


@edits_with_graphics
def test_masks_mark_anisotropic_surfaces_and_change_no_picture():
    """The ball is brushed, floor and wall are not; the shader of anisotropic lobes runs where a mask is 1."""
    camera = set_up_scene()
    ball = bpy.data.objects["Sphere"].data.materials[0]
    ball.node_tree.nodes["Principled BSDF"].inputs["Anisotropic"].default_value = 0.8
    bpy.context.view_layer.update()

    def draw():
        with OpenView(camera, SIZE) as opened:
            opened.draw(ShownPicture("ltsh4", "specular"))
            layer, lighting = opened.renderer._surfaces, opened.renderer._lighting["ltsh4"]
            gbuffer = layer.lobe(0, opened.mirror, opened.view, opened.renderer._lights)
            buffer = gpu.types.GPUFrameBuffer(depth_slot=gbuffer.mask)
            with buffer.bind():
                depth = buffer.read_depth(0, 0, *SIZE)
            depth.dimensions = SIZE[0] * SIZE[1]
            masks, pictures = np.array(depth).reshape(SIZE[::-1]), []
            for one in (gbuffer, replace(gbuffer, mask=None)):
                target = SampleSum(SIZE)
                lighting.draw(one, target.within(one.mask), "specular", view=opened.view.homogeneous_eye)
                pictures.append(read_texture(target.texture))
            return masks, *(read_texture(one)[..., 3] for one in (gbuffer.position, gbuffer.tangent)), *pictures

    mask, receiver, anisotropy, within, without = with_graphics(draw)
    brushed = anisotropy != 0.0
    assert 100 < brushed.sum() < 0.5 * brushed.size
    np.testing.assert_array_equal(mask, np.where(receiver > 0.0, np.where(brushed, 1.0, 0.75), 0.0))
    np.testing.assert_array_equal(within, without)
    assert (within[brushed].max(axis=-1) > 0.0).any()


@edits_with_graphics
def test_views_that_are_left_are_freed_at_once_with_their_tables():
    """The garbage collector, which would free cycles of references, comes late: a table with its weights is 5 MiB."""
    camera = set_up_scene()

    def left():
        opened = OpenView(camera, SIZE)
        opened.draw(ShownPicture("ltsh4c", "combined"))
        return weakref.ref(opened.renderer)

    def draw():
        gc.disable()
        try:
            views = [left() for _ in range(3)]
            tables = {id(one) for one in gc.get_objects() if isinstance(one, LookupTable) and one.name == "ltsh4c"}
            return [view() for view in views], tables
        finally:
            gc.enable()

    views, tables = with_graphics(draw)
    assert views == [None] * 3 and len(tables) == 1


@pytest.mark.newest
def test_a_drawing_that_has_no_time_loads_one_slow_image(monkeypatch):
    """The floor and the ball have an image each; with each of them a drawing ends, and the last one has the picture."""
    camera, shown, loaded = set_up_scene(), ShownPicture("ltsh4", "combined"), []
    for number, name in enumerate(("gray", "metal")):
        tree = bpy.data.materials[name].node_tree
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = bpy.data.images.new(f"image {number}", 8, 8)
        node.image.generated_color = (0.2, 0.5 * number, 0.7, 1.0)
        tree.links.new(node.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    bpy.context.view_layer.update()
    of_image = gpu.texture.from_image
    monkeypatch.setattr(gpu.texture, "from_image", lambda image: loaded.append(image.name) or of_image(image))

    def draw():
        with OpenView(camera, SIZE) as opened:
            expected = opened.draw(shown)
        loaded.clear()
        monkeypatch.setattr(drawing, "SLOW_SECONDS", -1.0)

        def one_more(drawings):
            assert len(loaded) == drawings + 1

        return *drawn_in_steps(camera, shown, 9, one_more), expected

    drawings, picture, expected = with_graphics(draw)
    assert drawings == 2 and sorted(loaded) == ["image 0", "image 1"]
    np.testing.assert_array_equal(picture, expected)


@pytest.mark.newest
def test_highlights_smaller_than_the_pixels_of_a_moving_view_are_there():
    """Metal balls of a few pixels, once drawn with fewer pixels, beside many points of lobes as narrow as they are."""
    parts.empty_scene(*SIZE)
    metal = parts.principled("Metal", Metallic=1.0, Roughness=0.2)[0]
    for number in range(15):
        row, column = divmod(number, 5)
        parts.add_sphere(metal, radius=0.28, name=f"Ball {number}", location=(0.57 * column - 1.2, 0.6 * row - 0.6, 0))
    parts.add_area_light(location=(0.5, -1.0, 3.0), rotation=(0.3, 0.0, 0.0), size=0.3)
    camera, step = parts.add_camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0)), 3
    bpy.context.view_layer.update()

    def picture(step, size, count=1):
        with OpenView(camera, size) as opened:
            opened.renderer.step = step
            points = sub_pixel_offsets(bpy.context.scene, count, balanced_points)
            for _ in points:
                pixels = opened.light("ltsh4c", "specular", points)
            return pixels

    def draw():
        large, small = (144, 96), (144 // step, 96 // step)
        return picture(step, large), picture(1, small), picture(1, small, 101)

    moving, narrow, truth = with_graphics(draw)
    errors = [np.linalg.norm(each - truth) / np.linalg.norm(truth) for each in (moving, narrow)]
    # Lobes that are Gaussians and curvatures that are even would leave nothing.
    assert errors[0] < 0.6 * errors[1], errors
    assert abs(moving.sum() / truth.sum() - 1.0) < 0.5 * abs(narrow.sum() / truth.sum() - 1.0)


@edits_with_graphics
def test_shadows_stay_fine_while_colors_change_and_are_coarse_again_once_an_object_moves(monkeypatch):
    """Levels that the thread begins after each change; and the picture at once after a new color, beside the last."""
    monkeypatch.setattr(shadow_rays, "QUICK_SECONDS", math.inf)  # collect at once on busy machines, too
    camera, shown, live = set_up_scene(), ShownPicture("ltsh4", "combined", transparent=True), LiveShadows()
    base = bpy.data.materials["gray"].node_tree.nodes["Principled BSDF"].inputs["Base Color"]

    def draw():
        pictures, levels = [], []
        with OpenView(camera, SIZE) as opened:
            opened.renderer.shadows = live

            def drawn(version):
                live.follow((version,), lambda: view_occluders(depsgraph(), lambda text: None))
                pictures.append(opened.draw(shown)[..., :3].astype(np.float64))

            def settled(version):
                done = []
                drawn(version)
                while live._thread is not None:
                    live._thread.join()
                    done += [request.level for request, _ in live._outcomes]
                    drawn(version)
                levels.append(done)

            try:
                settled(0)
                tracer = live._traced_scene.tracing
                # Twice as bright, which shadows do not depend on.
                base.default_value = (0.4, 0.4, 0.4, 1.0)
                opened.mirror.sync(depsgraph(), changes=Changes(materials={"gray"}))
                settled(1)
                assert live._traced_scene.tracing is tracer
                bpy.data.objects["Sphere"].location.x += 0.5
                opened.mirror.sync(depsgraph(), changes=Changes(instances=True))
                settled(2)
                assert live._traced_scene.tracing is not tracer
            finally:
                live.stop()
        return pictures, levels

    def depsgraph():
        bpy.context.view_layer.update()
        return bpy.context.evaluated_depsgraph_get()

    base.default_value = (0.8, 0.8, 0.8, 1.0)
    pictures, levels = with_graphics(draw)
    assert levels == [[0, 1], [1], [0, 1]]
    at_once, finest = pictures[3:5]
    # Both have noise of 32 rays; those of 8 rays at some pixels are four times as far off.
    assert np.linalg.norm(at_once - finest) < 0.02 * np.linalg.norm(finest)


@edits_with_graphics
def test_lights_keep_coarse_shadows_where_a_picture_of_another_pixel_size_follows():
    """A light moves while pictures become smaller: the other light's coarse shadows are those of more pixels."""
    camera, shown, live = set_up_scene(), ShownPicture("ltsh4", "combined", transparent=True), LiveShadows()

    def draw():
        with OpenView(camera, SIZE) as opened:
            opened.renderer.shadows = live

            def drawn(step):
                live.follow((0,), lambda: view_occluders(depsgraph(), lambda text: None))
                opened.renderer.step = step
                return opened.draw(shown)[..., :3].astype(np.float64)

            def settled(step):
                drawn(step)
                while live._thread is not None:
                    live._thread.join()
                    picture = drawn(step)
                return picture

            try:
                settled(2)
                bpy.data.objects["Left"].location.x += 0.1
                opened.mirror.sync(depsgraph(), changes=Changes(lights=True))
                return settled(3), [values.shape for values in live._sources]
            finally:
                live.stop()

    def depsgraph():
        bpy.context.view_layer.update()
        return bpy.context.evaluated_depsgraph_get()

    picture, shapes = with_graphics(draw)
    assert len(set(shapes)) == 2 and live.problem == "" and np.isfinite(picture).all()
