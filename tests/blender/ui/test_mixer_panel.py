"""The light mixer in Blender: what it shows, what it writes to the lights of the scene, lights that have moved."""

import queue
import threading
import time
from dataclasses import replace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from job_window import Events, image_pixels
from recorded_layout import Layout, buttons, drawn, stand_in

from ltsh_addon import imaging
from ltsh_addon.blender.ui import mixer, results
from ltsh_addon.pipeline.mixer import REST, LightPictures, MixerRow

HEIGHT, WIDTH = 6, 10
NAMES = ("Key", "Fill", "Lamp", REST)


def shown():
    return image_pixels("LTSH Comparison")


@pytest.fixture
def pictures(addon, tmp_path, show_results):
    """Layers (R, H, W, 3) of two lights of the scene, of a lamp that is none, and of the rest."""
    key = parts.add_area_light("Key", color=(1.0, 0.5, 0.25), energy=50.0)
    fill = parts.add_area_light("Fill", energy=20.0, exposure=1.0)
    parts.save(tmp_path / "room.blend")
    show_results(addon, tmp_path)
    layers = np.random.default_rng(5).random((4, HEIGHT, WIDTH, 3), np.float32)
    rows = [
        MixerRow(ob.name, (ob.name,), tuple(ob.data.color),
            {ob.name: [ob.data.energy, ob.data.exposure, *ob.data.color]}) for ob in (key, fill)
    ]  # fmt: skip
    rows += [MixerRow("Lamp", ("Lamp",)), MixerRow(REST, ())]
    show(addon, rows, layers)
    return layers


def show(scene, rows, layers):
    """Put pictures of lights beside the results, and show these anew."""
    folder = results.result_of(scene).folder
    facts = {"camera": "Camera", "frame": 1, "technique": "ltsh4c", "notes": []}
    LightPictures(tuple(rows), layers, np.ones((HEIGHT, WIDTH), np.float32), facts).save(folder / "lights.npz")
    results._mixer["stamp"] = None
    results.show(scene, folder)


@pytest.fixture
def scene(addon, pictures):
    return addon


def items(scene):
    return {item.name: item for item in scene.ltsh.mixed}


def test_values_change_the_picture_at_once(scene, pictures):
    assert scene.ltsh.mode != "MIX" and set(items(scene)) == set(NAMES)
    factors = np.ones((4, 3))

    def check():
        assert scene.ltsh.mode == "MIX"
        np.testing.assert_allclose(shown(), np.einsum("rc,rhwc->hwc", factors, pictures), rtol=1e-5, atol=1e-6)

    own = items(scene)
    own["Key"].power, factors[0] = 2.5, 2.5
    check()
    own["Fill"].exposure, factors[1] = -1.5, 2.0**-1.5
    check()
    own["Key"].color = (1.0, 1.0, 0.0)
    factors[0] = (2.5, 5.0, 0.0)
    check()
    own["Lamp"].muted, factors[2] = True, 0.0
    check()
    before, own["Key"].solo = factors.copy(), True
    factors[1:] = 0.0
    check()
    own["Lamp"].solo = True  # which is muted all the same
    check()
    own["Key"].solo = own["Lamp"].solo = False
    factors[:] = before
    check()
    assert bpy.ops.ltsh.reset_mixer() == {"FINISHED"}
    factors[:] = 1.0
    check()


def test_apply_writes_what_is_shown_and_only_that(scene):
    key, fill = (bpy.data.objects[name] for name in ("Key", "Fill"))
    own = items(scene)
    own["Key"].power, own["Key"].exposure, own["Key"].color = 2.0, 0.5, (0.5, 1.0, 0.5)
    fill.data.energy = 33.0  # by the artist, meanwhile
    assert mixer.applied(scene) == []
    assert key.data.exposure == 0.5 and fill.data.energy == 33.0 and not key.hide_render
    np.testing.assert_allclose(key.data.energy * np.array(key.data.color), 100.0 * np.array([0.5, 1.0, 0.5]), rtol=1e-6)
    # Again it changes nothing; back at the picture's values it writes those.
    values = key.data.energy, tuple(key.data.color)
    mixer.applied(scene)
    assert (key.data.energy, tuple(key.data.color)) == values
    own["Key"].power, own["Key"].exposure, own["Key"].color = 1.0, 0.0, (1.0, 0.5, 0.25)
    mixer.applied(scene)
    assert key.data.energy == pytest.approx(50.0) and tuple(key.data.color) == pytest.approx((1.0, 0.5, 0.25))
    own["Fill"].muted = True
    mixer.applied(scene)
    assert fill.hide_render and not key.hide_render
    own["Fill"].muted = False
    mixer.applied(scene)
    assert not fill.hide_render


def test_colors_beyond_white_go_into_the_power(scene):
    key = bpy.data.objects["Key"]
    items(scene)["Key"].color = (4.0, 1.0, 1.0)
    mixer.applied(scene)
    assert max(key.data.color) <= 1.0 + 1e-6
    np.testing.assert_allclose(key.data.energy * np.array(key.data.color), (200.0, 50.0, 50.0), rtol=1e-6)


def test_channels_that_a_light_has_not_got_are_left_alone(scene, pictures):
    """By its nodes the light is red, whatever its color."""
    key = bpy.data.objects["Key"]
    rows = [replace(results.mixer_pairs(scene)[0][0], color=(1.0, 0.0, 0.0)), MixerRow("Panel", ("Panel",), light={})]
    show(scene, rows, pictures[:2])
    results.reset_mixer(scene)
    items(scene)["Key"].power, items(scene)["Key"].color = 2.0, (0.5, 1.0, 1.0)
    assert mixer.applied(scene) == []
    np.testing.assert_allclose(key.data.energy * np.array(key.data.color), (50.0, 50.0, 25.0), rtol=1e-6)
    assert [mixer.state_of(*pair)[1] for pair in results.mixer_pairs(scene)] == ["", ""]


def test_what_cannot_be_written_is_named(scene):
    for item in scene.ltsh.mixed:
        item.power = 0.5
    asis = "no light object, so it is as it was; change its material or the world"
    assert mixer.applied(scene) == [f"Lamp: {asis}", f"{REST}: {asis}"]
    bpy.data.objects["Key"].data.keyframe_insert("energy", frame=1)
    copy = bpy.data.objects.new("Lamp", bpy.data.objects["Fill"].data)
    scene.collection.objects.link(copy)
    bpy.data.objects["Fill"].name = "Elsewhere"
    problems = mixer.applied(scene)
    assert problems[0].startswith("Key: its settings are animated") and problems[1] == "Fill: not in the scene any more"


def test_a_redraw_looks_at_files_once_not_for_every_row(scene, monkeypatch):
    looks, look = [], results.result_of
    monkeypatch.setattr(results, "result_of", lambda scene: looks.append(scene) or look(scene))
    shown = drawn(mixer.LTSH_PT_IMAGE_mixer)
    assert "ltsh.apply_mixer" in buttons(shown)
    of_panel = len(looks)
    for item in scene.ltsh.mixed:
        layout = Layout()
        stand_in(mixer.LTSH_UL_mixer)().draw_item(bpy.context, layout, scene.ltsh, item, 0, None, "", 0)
        assert [one.what for one in layout.shown] == ["muted", "solo", item.name, "power", "color"]
        assert layout.shown[2].icon == ("INFO" if item.name == REST else "LIGHT")
    assert len(looks) == of_panel <= 2


def test_lights_that_share_data_must_get_the_same(scene):
    bpy.data.objects["Fill"].data = bpy.data.objects["Key"].data
    items(scene)["Key"].power = 2.0
    items(scene)["Fill"].power = 3.0
    (problem,) = mixer.applied(scene)
    assert problem.startswith("Fill: it shares its data") and bpy.data.objects["Key"].data.energy == 100.0


def test_changed_and_lost_lights_are_named_where_the_list_is(scene):
    rows = {row.name: (row, item) for row, item in results.mixer_pairs(scene)}
    assert [mixer.state_of(*rows[name])[1] for name in ("Key", "Fill", "Lamp")] == ["", "", ""]
    bpy.data.objects["Key"].data.energy = 51.0
    assert "changed in the scene since" in mixer.state_of(*rows["Key"])[1]
    items(scene)["Key"].power = 51.0 / 50.0  # which is what the scene has now
    assert mixer.state_of(*rows["Key"]) == ("LIGHT", "")
    bpy.data.objects.remove(bpy.data.objects["Fill"])
    assert mixer.state_of(*rows["Fill"]) == ("ERROR", "Fill: not in the scene any more")


def test_values_outlast_a_new_picture_but_not_of_lights_that_have_them_now(scene, pictures):
    for item in scene.ltsh.mixed:
        item.power = 3.0
    bpy.data.objects["Key"].data.energy = 150.0
    rows = [row for row, _ in results.mixer_pairs(scene)]
    rows[0].settings["Key"][0] = 150.0
    show(scene, rows[:3], pictures[:3])
    powers = {name: item.power for name, item in items(scene).items()}
    assert powers == {"Key": 1.0, "Fill": 3.0, "Lamp": 3.0, REST: 3.0}


def test_values_are_in_the_file_and_the_mix_is_shown_after_loading(scene, pictures, tmp_path):
    items(scene)["Fill"].power = 2.0
    before = shown()
    bpy.ops.wm.save_mainfile()
    assert np.array_equal(shown(), before)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "room.blend"))
    assert items(bpy.context.scene)["Fill"].power == 2.0 and bpy.context.scene.ltsh.mode == "MIX"
    np.testing.assert_array_equal(shown(), before)


@pytest.fixture
def shaded(tmp_path):
    """The scene of a room that was shaded with its lights kept."""
    from job_window import add_on_in_room

    with add_on_in_room(tmp_path / "room.blend") as scene:
        scene.ltsh.techniques = {"ltsh4c"}
        fill = parts.add_area_light("Fill", location=(-1.0, 0.5, 1.5), size=0.5)
        parts.link(parts.new_light("Sun", "SUN"), rotation=(0.5, 0.0, 0.0))
        parts.add_sphere(parts.principled("Ball")[0], smooth=False, radius=0.3, location=(0.0, 0.0, 0.6))
        assert bpy.ops.ltsh.shade() == {"FINISHED"}
        yield scene, fill


def picture_of(scene):
    layers = imaging.read_layers(results.result_of(scene).folder.parent / "shade.exr")
    return layers["ltsh4c.specular"] + layers["ltsh4c.diffuse"]


@pytest.mark.newest
def test_a_moved_light_is_shaded_where_it_is_and_the_others_stay(shaded):
    scene, fill = shaded
    before = picture_of(scene)
    scene.ltsh.mode = "MIX"
    np.testing.assert_allclose(shown(), before, rtol=1e-5, atol=1e-5)
    assert set(items(scene)) == {"Light", "Fill", "Sun"}
    assert mixer.moved_rows(bpy.context, [row for row, _ in results.mixer_pairs(scene)]) == {}
    fill.location.x, fill.rotation_euler.y, fill.data.size = -0.2, 0.6, 0.8
    bpy.context.view_layer.update()
    row, item = next(pair for pair in results.mixer_pairs(scene) if pair[0].name == "Fill")
    assert mixer.state_of(row, item)[1].startswith("Fill: moved since this picture")
    layout = drawn(mixer.LTSH_PT_IMAGE_mixer) and Layout()
    stand_in(mixer.LTSH_UL_mixer)().draw_item(bpy.context, layout, scene.ltsh, item, 0, None, "", 0)
    assert [one.icon for one in layout.shown if one.kind == "label"] == ["ERROR"]
    assert bpy.ops.ltsh.update_moved_lights() == {"FINISHED"}
    assert [mixer.state_of(*pair)[1] for pair in results.mixer_pairs(scene)] == ["", "", ""]
    found = shown()
    assert mixer.moved_rows(bpy.context, [row for row, _ in results.mixer_pairs(scene)]) == {}
    # The file has it too.
    results._mixer["stamp"] = None
    np.testing.assert_array_equal(results.mixed_pixels(scene)[::-1, :, :3], found)
    assert bpy.ops.ltsh.shade() == {"FINISHED"}
    expected = picture_of(scene)
    # Noise at the edges of shadows is of other rays.
    assert np.sqrt(np.square(found - expected).sum() / np.square(expected).sum()) < 0.01
    assert np.sqrt(np.square(before - expected).sum() / np.square(expected).sum()) > 0.05


class MovedLights(Events, stand_in(mixer.LTSH_OT_update_moved_lights)):
    """The operator of the button."""


@pytest.fixture
def go_on(monkeypatch):
    """An event for which updates of moved lights wait before they end, until they are stopped."""
    event, work = threading.Event(), results.Update._work

    def waiting(self):
        class Queue(queue.SimpleQueue):
            def put(queue, one):
                while one[0] is None and not event.is_set() and not self.is_finished:
                    time.sleep(0.01)
                super().put(one)

        self._made = Queue()
        work(self)

    monkeypatch.setattr(results.Update, "_work", waiting)
    return event


@pytest.mark.newest
def test_a_moved_light_is_followed_and_taken_back(shaded, go_on):
    scene, fill = shaded
    scene.ltsh.mode = "MIX"
    before = shown()
    fill.location.x = 0.3
    bpy.context.view_layer.update()
    hand = MovedLights().start()
    names = buttons(drawn(mixer.LTSH_PT_IMAGE_mixer))
    assert "ltsh.cancel_moved_lights" in names and "ltsh.update_moved_lights" not in names
    assert not mixer.LTSH_OT_update_moved_lights.poll(bpy.context)
    update = results.state["update"]
    hand.until(lambda: not np.array_equal(shown(), before))
    first = shown()
    # Moved once more: the picture is of another place.
    fill.location.x = -0.2
    bpy.context.view_layer.update()
    hand.until(lambda: results.state["update"] is not update)
    assert not np.array_equal(first, before) and hand.outcome == {"RUNNING_MODAL"}
    go_on.set()
    hand.until(lambda: False)
    assert hand.outcome == {"FINISHED"} and hand.reports == [] and hand.context.timers == []
    found = shown()
    assert mixer.moved_rows(bpy.context, [row for row, _ in results.mixer_pairs(scene)]) == {}
    # Esc: as it was.
    go_on.clear()
    fill.location.x = 0.6
    bpy.context.view_layer.update()
    hand = MovedLights().start()
    hand.until(lambda: not np.array_equal(shown(), found))
    assert hand.send("ESC", "PRESS") == {"FINISHED"} and np.array_equal(shown(), found)
    # The cross, and another file.
    for end in (bpy.ops.ltsh.cancel_moved_lights, results.forget_renders):
        hand = MovedLights().start()
        end()
        hand.until(lambda: False)
        assert np.array_equal(shown(), found) and results.state["update"] is None
        assert hand.reports == [] and hand.context.timers == []
    assert bpy.ops.ltsh.shade() == {"FINISHED"}


@pytest.mark.newest
def test_pictures_without_kept_lights_say_so(shaded):
    scene, _ = shaded
    scene.ltsh.keep_lights = False
    assert bpy.ops.ltsh.shade() == {"FINISHED"}
    assert results.mixer_of(scene) is None and results.mix_label(scene) == "No lights were kept: shade again"
    assert not bpy.ops.ltsh.reset_mixer.poll()


@pytest.mark.parametrize("colors", [False, True])
def test_lights_are_matched_to_a_painted_target(scene, pictures, colors):
    factors = np.array([[0.25, 0.5, 0.5], [3.0, 2.0, 1.0], [0.0] * 3, [1.0] * 3]) if colors else np.ones((4, 3))
    factors[:3] = factors[:3] if colors else np.array([0.5, 2.0, 0.0])[:, None]
    assert bpy.ops.ltsh.paint_target() == {"FINISHED"}
    target = scene.ltsh.match_target
    np.testing.assert_allclose(image_pixels(target.name), pictures.sum(axis=0), rtol=1e-5)
    wanted = np.einsum("rc,rhwc->hwc", factors, pictures)
    pixels = np.ones((HEIGHT, WIDTH, 4), np.float32)
    pixels[..., :3] = wanted[::-1]
    target.pixels.foreach_set(pixels.ravel())
    scene.ltsh.match_colors = colors
    assert bpy.ops.ltsh.match_target() == {"FINISHED"}
    # The solver draws factors a little to 1, more where layers look alike: these random ones do within squares.
    np.testing.assert_allclose(shown(), wanted, atol=0.02)
    own = items(scene)
    for name, factor in zip(NAMES, factors, strict=True):
        np.testing.assert_allclose(results._factor(scene, row_of(scene, name), own[name]), factor, atol=0.02)
    assert scene.ltsh.mode == "MIX"
    bpy.ops.ltsh.reset_mixer()
    np.testing.assert_allclose(shown(), pictures.sum(axis=0), rtol=1e-5)


def row_of(scene, name):
    return next(row for row in results.mixer_of(scene).rows if row.name == name)


def test_a_target_of_another_size_is_named_and_changes_nothing(scene):
    scene.ltsh.match_target = bpy.data.images.new("Small", 3, 2)
    items(scene)["Key"].power = 3.0
    with pytest.raises(RuntimeError, match="image 'Small' is 3x2 pixels, expected 10x6 as the picture"):
        bpy.ops.ltsh.match_target()
    assert items(scene)["Key"].power == 3.0
    scene.ltsh.match_target = None
    assert not bpy.ops.ltsh.match_target.poll()


def test_lights_move_to_a_target_also_without_a_picture(addon):
    shown = drawn(mixer.LTSH_PT_IMAGE_mixer)
    assert "match_target" in {item.what for item in shown} and "ltsh.match_move" in buttons(shown)
    assert not bpy.ops.ltsh.match_move.poll()
    addon.ltsh.match_target = bpy.data.images.new("Target", WIDTH, HEIGHT)
    assert bpy.ops.ltsh.match_move.poll()
