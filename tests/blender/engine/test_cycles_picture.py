"""The Cycles picture beside the viewport's: where it lies, what it is averaged to, when there is none and why."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from ltsh_addon.blender.engine.cycles_picture import (
    Reference,
    averaged,
    camera_frame,
    content,
    is_outdated,
    reference_of,
)
from ltsh_addon.imaging.exr import write_channels
from ltsh_addon.imaging.report import write_index
from ltsh_addon.scene import QuadLight

SIZE = parts.SIZE
PIXELS = np.random.default_rng(3).random((SIZE[1], SIZE[0], 3)).astype(np.float32)


def projection_of(camera, size):
    """World to clip space (4, 4) of a picture of `size` through `camera`."""
    matrix = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=size[0], y=size[1])
    return np.array(matrix @ camera.matrix_world.inverted())


def test_smaller_pictures_are_means_over_areas_and_larger_ones_repeat():
    image = np.random.default_rng(2).random((6, 8, 3))
    blocks = image.reshape(3, 2, 4, 2, 3).mean(axis=(1, 3))
    for expected in (blocks, image, image.repeat(2, axis=0).repeat(2, axis=1)):
        height, width = expected.shape[:2]
        found = averaged(image, (0.0, 0.0, width, height), (width, height))
        np.testing.assert_allclose(found[::-1, :, :3], expected, rtol=1e-12)
        assert (found[..., 3] == 1.0).all()


def test_outside_the_frame_there_is_no_picture():
    image = np.ones((4, 4, 3))
    found = averaged(image, (2.5, 1.0, 6.5, 5.0), (10, 8))
    # Columns 2 and 6 are cut by the frame.
    assert (found[1:5, 3:6] == 1.0).all()
    found[1:5, 3:6] = 0.0
    assert (found == 0.0).all()


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_the_frame_holds_what_the_camera_renders(kind):
    scene = parts.empty_scene(32, 20)
    camera = parts.add_camera((0.4, -3.0, 2.0), (0.9, 0.1, 0.2))
    camera.data.type, camera.data.shift_x, camera.data.shift_y = kind, 0.1, -0.07
    bpy.context.view_layer.update()
    # A region of another shape than the picture shows more than it.
    size = (90, 90)
    projection = projection_of(camera, size)
    left, bottom, right, top = camera_frame(camera, scene, projection, size)
    for point in (Vector((0.2, 0.3, 0.0)), Vector((-0.5, 0.1, 0.4))):
        clip = projection @ np.array([*point, 1.0])
        x, y = ((0.5 + 0.5 * clip[axis] / clip[3]) * size[axis] for axis in (0, 1))
        expected = world_to_camera_view(scene, camera, point)
        found = (x - left) / (right - left), (y - bottom) / (top - bottom)
        np.testing.assert_allclose(found, expected[:2], atol=1e-5)


@pytest.fixture
def found(addon, tmp_path):
    """A function that writes a comparison of one Cycles picture and tells what a view finds."""
    camera = parts.add_camera()
    bpy.context.view_layer.update()

    def find(view="CAMERA", passes="combined", **facts):
        write_channels(tmp_path / "cycles.exr", {letter: PIXELS[..., i] for i, letter in enumerate("RGB")})
        report = {"camera": "Camera", "frame": 1, "resolution": SIZE, "pixel_aspect": 1.0, "border": None,
                  "exposure": 1.0, **facts}  # fmt: skip
        group = {"files": {"cycles.combined": "cycles.exr"}, "names": ["cycles"],
                 "labels": {"cycles": "Cycles"}, "passes": ["combined"], "scales": {"combined": 1.0}}  # fmt: skip
        write_index(tmp_path, {"command": "compare", "partial": "", "groups": {"": group}, "report": report})
        context = SimpleNamespace(
            space_data=SimpleNamespace(use_local_camera=False, camera=None),
            region_data=SimpleNamespace(view_perspective=view),
            region=SimpleNamespace(width=SIZE[0], height=SIZE[1]),
        )
        addon.ltsh.output_folder = str(tmp_path / "none")
        addon.ltsh.result_folder = facts.get("folder", str(tmp_path))
        return reference_of(context, addon, passes, projection_of(camera, SIZE))

    return find


def test_the_picture_of_this_camera_is_found(found):
    reference = found(exposure=2.0)
    np.testing.assert_allclose(reference.pixels, PIXELS / 2.0, rtol=1e-6)
    np.testing.assert_allclose(reference.frame, (0.0, 0.0, *SIZE), atol=1e-3)


def lit_by(*lights):
    """The content of a scene with nothing but lights."""
    return content(SimpleNamespace(lights=lights, instances=[]))


def lamp(x=0.0):
    sides = {"half_u": (0.5, 0.0, 0.0), "half_v": (0.0, 0.5, 0.0), "direction": (0.0, 0.0, -1.0)}
    return QuadLight("Lamp", center=(x, 0.0, 1.0), radiance=np.ones(3), **sides)


def test_a_change_of_the_scene_makes_the_picture_outdated_until_it_is_undone(tmp_path):
    reference = Reference(np.ones((2, 2, 3)), (0.0, 0.0, 2.0, 2.0), (str(tmp_path), 1))
    assert not is_outdated(reference, lit_by(lamp()))
    known = lamp()
    assert known.area_vector.any() and not is_outdated(reference, lit_by(known))  # what was computed of it is no change
    assert is_outdated(reference, lit_by(lamp(0.1)))
    assert is_outdated(reference, lit_by())
    assert not is_outdated(reference, lit_by(lamp()))
    made_again = Reference(np.ones((2, 2, 3)), (0.0, 0.0, 2.0, 2.0), (str(tmp_path), 2))
    assert not is_outdated(made_again, lit_by(lamp(0.1)))
    assert is_outdated(made_again, lit_by(lamp()))


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"view": "PERSP"}, "look through the camera"),
        ({"camera": "Other"}, "of camera 'Other', this is 'Camera'"),
        ({"frame": 7}, "of frame 7, this is 1"),
        ({"passes": "diffuse"}, "has no diffuse pass"),
        ({"resolution": [SIZE[0], 2 * SIZE[1]]}, "does not fill the camera's frame"),
        ({"folder": ""}, "press Compare with Cycles"),
    ],
)
def test_what_is_in_the_way_is_said(found, facts, reason):
    assert reason in str(found(**facts))
