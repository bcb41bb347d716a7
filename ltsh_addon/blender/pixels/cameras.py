"""Which camera renders which picture: choice, frame, size, border, and rays through a given point of every pixel.

Runs in the child, on the copy of the scene in memory. Size and border follow Blender's own rounding, so that the
picture is the one that rendering the file gives.
"""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np

from ...scene import Border
from ..processes.child import SceneError
from ..processes.missing_names import listed

CAMERA_TYPES = ("PERSP", "ORTHO")
CAMERA_KINDS = {"PANO": "panoramic", "CUSTOM": "custom (Open Shading Language)"}


def go_to_frame(scene, frame: int | None) -> None:
    """Evaluate the animation at `frame`, or at the file's own; a camera bound to a marker becomes the scene's."""
    if frame is None:
        scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)
    else:
        scene.frame_set(frame)


def choose_camera(scene, name: str | None):
    """The camera object to render from: by `name`, or the scene's at its current frame."""
    if name is None:
        camera = scene.camera
        if camera is None:
            raise SceneError(f"scene {scene.name!r} has no active camera: set one, or name one")
    else:
        camera = scene.objects.get(name)
        if camera is None or camera.type != "CAMERA":
            cameras = listed((ob.name for ob in scene.objects if ob.type == "CAMERA"), name)
            raise SceneError(f"camera {name!r} is not in scene {scene.name!r}; cameras there: {cameras}")
    if camera.type != "CAMERA":
        raise SceneError(
            f"scene {scene.name!r}: its camera {camera.name!r} is a {camera.type} object, expected a camera"
        )
    if camera.data.type not in CAMERA_TYPES:
        kind = CAMERA_KINDS.get(camera.data.type, camera.data.type)
        raise SceneError(
            f"camera {camera.name!r} is {kind}, expected a perspective or orthographic one; "
            "change its type, or name another camera"
        )
    # A render switches to the camera of the last marker, whatever the scene says.
    for marker in scene.timeline_markers:
        marker.camera = None
    scene.camera = camera
    return camera


def hold_still(scene, camera) -> None:
    """Keep scene and lens at their values of this frame: a render evaluates them again, and would undo what is set."""
    for owner in (scene, camera.data):
        if owner.animation_data is not None:
            owner.animation_data_clear()


def picture_size(scene) -> tuple[int, int]:
    """Width and height of the whole picture in pixels, without regard to a border."""
    render = scene.render
    share = render.resolution_percentage
    return render.resolution_x * share // 100, render.resolution_y * share // 100


def set_resolution(scene, width: int | None, height: int | None) -> tuple[int, int]:
    """Set and return the size of the whole picture in pixels; a missing side keeps the file's aspect."""
    own_width, own_height = picture_size(scene)
    if own_width < 1 or own_height < 1:
        raise SceneError(
            f"scene {scene.name!r}: {scene.render.resolution_percentage} % of {scene.render.resolution_x}x"
            f"{scene.render.resolution_y} pixels is less than one pixel; raise the percentage"
        )
    if width is None and height is None:
        return own_width, own_height
    if width is None:
        width = max(1, round(height * own_width / own_height))
    elif height is None:
        height = max(1, round(width * own_height / own_width))
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    if (render.resolution_x, render.resolution_y) != (width, height):
        raise SceneError(
            f"resolution {width}x{height} is not possible in Blender, the nearest is "
            f"{render.resolution_x}x{render.resolution_y}"
        )
    return width, height


def render_border(scene) -> Border | None:
    """The part of the picture that is rendered, None for all of it.

    Raises SceneError for a border of less than a pixel, which Blender does not render.
    """
    render, (width, height) = scene.render, picture_size(scene)
    if not render.use_border:
        return None

    def cut(share, size):
        return int(np.float32(share) * np.float32(size))

    left, right = cut(render.border_min_x, width), cut(render.border_max_x, width)
    bottom, top = cut(render.border_min_y, height), cut(render.border_max_y, height)
    if right <= left or top <= bottom:
        raise SceneError(
            f"scene {scene.name!r}: its render region is {max(right - left, 0)}x{max(top - bottom, 0)} of "
            f"{width}x{height} pixels, expected at least one; make it larger or switch it off"
        )
    return Border(
        left=left,
        top=height - top,
        width=right - left,
        height=top - bottom,
        full_width=width,
        full_height=height,
        cropped=render.use_crop_to_border,
    )


@contextmanager
def shifted_pixels(scene, offset: np.ndarray):
    """Meanwhile the rays of `scene` go through the points `offset` (2,) pixels from the pixels' centers."""
    render, lens = scene.render, scene.camera.data
    size = picture_size(scene)
    width, height = size[0] * render.pixel_aspect_x, size[1] * render.pixel_aspect_y
    fits_width = lens.sensor_fit == "HORIZONTAL" or (lens.sensor_fit == "AUTO" and width >= height)
    unit = width if fits_width else height
    before = lens.shift_x, lens.shift_y
    try:
        lens.shift_x += offset[0] * render.pixel_aspect_x / unit
        lens.shift_y += offset[1] * render.pixel_aspect_y / unit
        yield
    finally:
        lens.shift_x, lens.shift_y = before
