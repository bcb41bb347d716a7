"""The picture is the one that rendering the file gives: same size, same points, for every kind of camera and border."""

import bpy
import numpy as np
import pytest
import scene_parts

from ltsh_addon import imaging
from ltsh_addon.blender import render_settings
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.pipeline import PictureOptions, shade_scene
from ltsh_addon.scene import SceneError


def room(width=26, height=15):
    """A scene with something in every corner of the picture, seen by a perspective camera."""
    scene = scene_parts.empty_scene(width, height)
    scene_parts.add_plane(scene_parts.principled(Roughness=0.4)[0], size=40.0)
    scene_parts.add_sphere(scene_parts.principled("Ball")[0], location=(0.4, 0.2, 0.3))
    scene_parts.add_area_light("Key")
    scene_parts.add_camera((0.3, -3.0, 2.0), (0.9, 0.1, 0.2))
    return scene


def plain_positions(folder):
    """Position (H, W, 3) as a plain render of the open file shows it: its first sample is at the pixels' centers."""
    return read_layer(scene_parts.cycles_channels(folder, 1, ("combined", "position")), "Position", "XYZ")


def saved(folder):
    return scene_parts.save(folder / "scene.blend")


def positions(found):
    return found.film.image(found.samples.position)


def set_all(owner, **values):
    for name, value in values.items():
        setattr(owner, name, value)


def set_border(scene, *, crop, left=0.31, right=0.83, bottom=0.17, top=0.62):
    set_all(scene.render, use_border=True, use_crop_to_border=crop)
    set_all(scene.render, border_min_x=left, border_max_x=right, border_min_y=bottom, border_max_y=top)


def animate(scene):
    """Lens, shift and place of the camera change; one of them by a driver that reads the scene."""
    camera = scene.camera
    for frame, lens, shift, height in ((1, 50.0, 0.0, 2.0), (11, 30.0, 0.2, 3.0)):
        camera.data.lens, camera.data.shift_x, camera.location.z = lens, shift, height
        camera.data.keyframe_insert("lens", frame=frame)
        camera.data.keyframe_insert("shift_x", frame=frame)
        camera.keyframe_insert("location", frame=frame)
    driver = camera.data.driver_add("shift_y").driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id_type = "frame", "SCENE"
    variable.targets[0].id, variable.targets[0].data_path = scene, "frame_current"
    driver.expression = "frame * 0.01"
    scene.frame_set(7)


CASES = {
    "perspective": lambda scene, lens: None,
    "orthographic": lambda scene, lens: set_all(lens, type="ORTHO", ortho_scale=3.0),
    "shift": lambda scene, lens: set_all(lens, shift_x=0.3, shift_y=-0.2),
    "horizontal": lambda scene, lens: (set_all(lens, sensor_fit="HORIZONTAL"), set_all(scene.render, resolution_y=40)),
    "vertical": lambda scene, lens: set_all(lens, sensor_fit="VERTICAL", sensor_height=18.0, shift_x=0.1),
    "portrait": lambda scene, lens: set_all(scene.render, resolution_x=14, resolution_y=25),
    "percentage": lambda scene, lens: set_all(scene.render, resolution_x=71, resolution_y=43, resolution_percentage=37),
    "wide pixels": lambda scene, lens: set_all(scene.render, pixel_aspect_x=1.7),
    "tall pixels": lambda scene, lens: set_all(scene.render, pixel_aspect_y=2.2),
    "region": lambda scene, lens: set_border(scene, crop=False),
    "cropped": lambda scene, lens: set_border(scene, crop=True),
    "cropped at 50 %": lambda scene, lens: (
        set_border(scene, crop=True),
        set_all(scene.render, resolution_x=51, resolution_y=33, resolution_percentage=50, pixel_aspect_x=1.3),
    ),
    "animated": lambda scene, lens: animate(scene),
}


@pytest.mark.parametrize("case", CASES)
def test_the_picture_is_that_of_a_plain_render(tmp_path, case):
    scene = room()
    CASES[case](scene, scene.camera.data)
    path = saved(tmp_path)
    expected = plain_positions(tmp_path)
    found = extract_pixels(PixelJob(path))
    assert found.warnings == () and positions(found).shape == expected.shape
    # The first sample of a plain render is at the center as ours is, up to 1e-3 of a pixel by Cycles' table, which the
    # slope of the surface can magnify a few times; a pixel is 0.1 m and more.
    seen = np.linalg.norm(expected, axis=-1) > 0.0
    difference = np.linalg.norm(positions(found) - expected, axis=-1)
    assert seen.any() and np.array_equal(found.film.coverage() > 0.0, seen)
    # On the rim of the ball that much can be another surface.
    assert np.median(difference[seen]) < 2e-4 and np.count_nonzero(difference > 0.02) <= 0.02 * seen.sum()


def test_a_region_is_recorded_and_has_the_size_of_a_plain_render(tmp_path):
    scene = room()
    sizes = {}
    for crop in (False, True):
        set_border(scene, crop=crop)
        report = shade_scene(
            PictureOptions(saved(tmp_path), tmp_path / "out", techniques=("ltc",), passes=("diffuse",))
        )
        layers = imaging.read_layers(tmp_path / "out" / "shade.exr")
        sizes[crop] = layers["coverage.hit"]
        # 26 x 15 pixels: columns 8 to 20, rows 2 to 8 from below.
        place = {"left": 8, "top": 6, "width": 13, "height": 7, "full_width": 26, "full_height": 15}
        assert report["border"] == {**place, "cropped": crop}
        assert report["pixel_aspect"] == 1.0 and report["pixel_filter"] == "pixel centers"
        assert report["resolution"] == ([13, 7] if crop else [26, 15])
    assert np.array_equal(sizes[False][6:13, 8:21], sizes[True]) and sizes[True].all()
    assert sizes[False].sum() == sizes[True].sum()


def test_a_region_holds_for_anti_aliasing_and_for_the_reference(tmp_path):
    scene = room()
    set_border(scene, crop=True)
    whole = PixelJob(saved(tmp_path), sub_samples=4, cycles_samples=512)
    cropped = extract_pixels(whole)
    scene.render.use_border = False
    saved(tmp_path)
    full = extract_pixels(whole)
    assert np.abs(positions(full)[6:13, 8:21] - positions(cropped)).max() < 1e-4
    for name, image in full.cycles.reference.items():
        part, ours = image.mean(axis=0)[6:13, 8:21], cropped.cycles.reference[name].mean(axis=0)
        assert ours.shape == (7, 13, 3)
        # Another sequence of 512 samples per pixel: their noise.
        assert np.linalg.norm(part - ours) < 0.02 * np.linalg.norm(part)


def test_an_animated_lens_shows_the_same_sub_samples_as_one_that_stands_still(tmp_path):
    scene = room()
    animate(scene)
    moving = extract_pixels(PixelJob(saved(tmp_path), sub_samples=3))
    scene.camera.data.animation_data_clear()
    still = extract_pixels(PixelJob(saved(tmp_path), sub_samples=3))
    assert np.array_equal(moving.film.pixel, still.film.pixel)
    assert np.abs(moving.samples.position - still.samples.position).max() < 1e-4
    thirds = np.split(moving.samples.position, 3)
    assert np.median(np.abs(thirds[1] - thirds[0])) > 0.005


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("aspect", [(1.0, 1.0), (1.0, 1.9)])
def test_shifted_rays_are_the_pixels_of_a_finer_picture(tmp_path, fit, kind, aspect):
    """Pixel (5 c + i, 5 r + j) of a five times finer picture is point ((i - 2) / 5, (2 - j) / 5) of pixel (c, r)."""
    scene = room(20, 12)
    set_all(scene.camera.data, sensor_fit=fit, type=kind, ortho_scale=3.0, shift_x=0.05)
    set_all(scene.render, pixel_aspect_x=aspect[0], pixel_aspect_y=aspect[1])
    moved = {}
    for i, j in ((0, 2), (3, 4)):
        with render_settings.shifted_pixels(scene, np.array([i - 2, 2 - j]) / 5.0):
            moved[i, j] = plain_positions(tmp_path)
    scene.render.resolution_percentage = 500
    fine = plain_positions(tmp_path)
    for (i, j), coarse in moved.items():
        difference = np.linalg.norm(fine[j::5, i::5] - coarse, axis=-1)
        # A pixel is 0.15 m; its center is met to 1e-3 pixels, in either picture.
        assert np.median(difference) < 1e-3 and np.quantile(difference, 0.97) < 0.01


@pytest.mark.parametrize(("kind", "words"), [("PANO", "panoramic"), ("CUSTOM", "custom")])
def test_cameras_with_other_projections_are_refused(tmp_path, kind, words):
    scene = room()
    plain = scene.camera
    odd = scene_parts.add_camera(name="Odd")
    odd.data.type = kind
    path = saved(tmp_path)
    with pytest.raises(SceneError, match=f"camera 'Odd' is {words}.* expected a perspective or orthographic one"):
        extract_pixels(PixelJob(path))
    assert len(extract_pixels(PixelJob(path, camera=plain.name)).samples) > 0
    scene.camera = bpy.data.objects["Key"]
    with pytest.raises(SceneError, match="'Key' is a LIGHT object"):
        extract_pixels(PixelJob(saved(tmp_path)))


def test_markers_choose_the_camera_of_the_frame_and_a_named_one_wins(tmp_path):
    scene = room()
    first, (second, third) = scene.camera, (scene_parts.add_camera((x, -4.0, 2.0), name=f"At {x}") for x in (1.0, 2.0))
    for frame, camera in ((5, second), (20, third)):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    scene.camera = first
    path = saved(tmp_path)
    for frame, name in ((10, "At 1.0"), (20, "At 2.0")):
        scene.frame_set(frame)
        expected = plain_positions(tmp_path)
        assert scene.camera.name == name
        found = extract_pixels(PixelJob(path, frame=frame))
        assert found.picture.camera == name and np.abs(positions(found) - expected).max() < 0.01
    named = extract_pixels(PixelJob(path, frame=10, camera="Camera"))
    for marker in scene.timeline_markers:
        marker.camera = None
    scene.camera = first
    assert named.picture.camera == "Camera" and np.median(np.abs(positions(named) - plain_positions(tmp_path))) < 2e-4


def test_pictures_of_no_pixels_are_refused_in_one_line(tmp_path):
    scene = room()
    set_border(scene, crop=False, left=0.5, right=0.51)
    with pytest.raises(SceneError, match="^.*its render region is 0x7 of 26x15 pixels.*$"):
        extract_pixels(PixelJob(saved(tmp_path)))
    scene.render.use_border, scene.render.resolution_percentage = False, 2
    with pytest.raises(SceneError, match="^.*2 % of 26x15 pixels is less than one pixel.*$"):
        extract_pixels(PixelJob(saved(tmp_path)))


def test_a_given_size_replaces_the_percentage(tmp_path):
    scene = room()
    scene.render.resolution_percentage = 50
    path = saved(tmp_path)
    assert extract_pixels(PixelJob(path)).film.width == 13
    found = extract_pixels(PixelJob(path, width=52))
    assert (found.film.width, found.film.height) == (52, round(52 * 7 / 13))


def test_stereo_pictures_become_one_from_the_middle(tmp_path):
    scene = room()
    expected = plain_positions(tmp_path)
    scene.render.use_multiview = True
    found = extract_pixels(PixelJob(saved(tmp_path)))
    assert any("stereoscopy" in line for line in found.warnings)
    assert np.median(np.abs(positions(found) - expected)) < 2e-4
