"""Views while they move: fewer pixels, drawn between."""

import bpy
import numpy as np
import pytest
import scene_parts as parts
from graphics_card import with_graphics
from view_pictures import OpenView

from ltsh_addon.blender.engine import redraws
from ltsh_addon.blender.viewport.drawing import float_texture
from ltsh_addon.blender.viewport.pictures import ShownPicture, ShownRest

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
    light, size = object(), redraws.PixelSize()

    def step(state, whole):
        chosen = size.follow(((light,), (state,)))
        if size.is_new:
            now[0] += whole / chosen**2
            size.note(whole / chosen**2)
        return chosen

    slow = 6.4 * redraws.FRAME_SECONDS
    assert [step(state, slow) for state in "abcc"] == [1, 4, 4, 4]
    # What is quicker gets more of its pixels, and all once nothing has changed for a while.
    assert step("d", slow / 2.0) == 4 and step("e", slow / 2.0) == 2
    assert 0.0 < size.end - now[0] <= redraws.MOVING_SECONDS
    now[0] = size.end
    assert step("e", slow) == 1 and not size.is_new
    assert step("f", slow) == 4
    # A drawing that fails keeps neither a view from being drawn nor one that moves from being quick.
    size.follow(((light,), ("g",)))
    assert size.is_new and step("g", slow) == 4 and size.end < now[0] + 1.0
    quick = [step(state, 0.9 * redraws.FRAME_SECONDS) for state in "hij"]
    assert quick == [4, 1, 1]


@pytest.mark.newest
def test_a_picture_with_fewer_pixels_is_interpolated_and_as_bright_and_leaves_nothing_behind():
    """While a view moves. The truth is numpy's interpolation of the picture of a smaller view, with the rest."""
    camera, shown, step = set_up_scene(), ShownPicture("ltsh4", "combined", transparent=True), 3

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
