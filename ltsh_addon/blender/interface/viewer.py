"""The image "LTSH Comparison": two pictures with a wipe, side by side, or their difference in colors.

It is an image like any other, so that exposure, view transform, zoom and scopes of the Image Editor are Blender's own.
"""

from __future__ import annotations

import contextlib
import logging

import bpy
import numpy as np

from ...imaging.false_color import signed_error_colors
from ...imaging.tone import LUMINANCE_WEIGHTS
from . import results

NAME = "LTSH Comparison"
SETTLE_SECONDS = 1.0
PANEL_REGIONS = {"VIEW_3D": "UI", "IMAGE_EDITOR": "UI", "PROPERTIES": "WINDOW"}
_LOOKUP_SIZE = 1024
_state = {"lookup": None, "settling": set(), "kept": False, "dragged": None}


def changed(settings, context) -> None:
    """Called by Blender when a setting of the view changes."""
    try:
        refresh(settings.id_data)
    except RuntimeError as error:
        _warn(error)


def _warn(error: RuntimeError) -> None:
    """A picture is gone; the panels say so when the results are shown anew."""
    logging.getLogger(__name__).warning("%s", " ".join(str(error).split()))


def refresh(scene) -> bool:
    """Bring the image up to date; False where there are no results."""
    result = results.result_of(scene)
    if result is None:
        return False
    choice = results.choice_of(scene.ltsh, result)
    results.images_of_pass(scene, result, choice)
    group = result.groups[choice.group]
    pictures = [results.pixels_of(image) for image in _chosen_images(scene, result, choice)]
    if len(pictures) < 2 or pictures[0].shape != pictures[1].shape or not pictures[0].size:
        return False
    mode = scene.ltsh.mode
    pixels = compose(*pictures, mode, split_of(scene), error_scale(scene.ltsh, group, choice))
    _store(viewer_image(scene), pixels, mode != "ERROR")
    _settle_later(scene)
    redraw_image_editors()
    return True


def _chosen_images(scene, result, choice) -> list:
    """The two images that are compared; none where the results lack one."""
    layers = [f"{name}.{choice.pass_name}" for name in (choice.first, choice.second)]
    if any(layer not in result.groups[choice.group]["files"] for layer in layers):
        return []
    return [results.layer_image(scene, result, choice.group, layer) for layer in layers]


def read_a_picture(scene) -> bool:
    """Read the pixels of a picture that `refresh` needs; False where it has them all."""
    result = results.result_of(scene)
    images = [] if result is None else _chosen_images(scene, result, results.choice_of(scene.ltsh, result))
    unread = next((image for image in images if not results.is_read(image)), None)
    return unread is not None and results.pixels_of(unread).size > 0


def split_of(scene) -> float:
    """Where the line of the wipe is, as a share of the width: also while the mouse drags it."""
    return scene.ltsh.split if _state["dragged"] is None else _state["dragged"]


def drag_split(scene, position: float | None) -> None:
    """Show the line at `position` meanwhile; None: where the settings have it.

    With the settings themselves Blender would evaluate the scene anew and draw all windows for every step of the mouse.
    """
    _state["dragged"] = None if position is None else min(max(position, 0.0), 1.0)
    try:
        refresh(scene)
    except RuntimeError as error:
        _warn(error)


def compose(first: np.ndarray, second: np.ndarray, mode: str, split: float, scale: float) -> np.ndarray:
    """The picture (H, W', 4) of both (H, W, 4): linear colors; W' is 2 W side by side."""
    if mode == "A":
        return first
    if mode == "SIDE":
        return np.concatenate([first, second], axis=1)
    if mode == "ERROR":
        difference = (first[..., :3] - second[..., :3]) @ LUMINANCE_WEIGHTS.astype(np.float32)
        colors = np.ones_like(first)
        colors[..., :3] = _error_lookup()[_lookup_index(difference, scale)]
        return colors
    columns = round(split * first.shape[1])
    return np.concatenate([first[:, :columns], second[:, columns:]], axis=1)


def error_scale(settings, group: dict, choice) -> float:
    """The difference at which the colors end: the artist's own, or that of the report."""
    return settings.error_scale if settings.error_scale > 0.0 else group["scales"][choice.pass_name]


def viewer_image(scene):
    """The image of `scene`, made where it is not there yet."""
    for image in results.our_images(scene):
        if image[results.LAYER] == "":
            return image
    image = bpy.data.images.new(NAME, 4, 4, alpha=False, float_buffer=True)
    image[results.LAYER], image[results.SCENE] = "", scene.name
    image.use_fake_user = True
    return image


def is_viewer(image) -> bool:
    """True for an image that this module made."""
    return image is not None and image.get(results.LAYER) == "" and results.SCENE in image


def _store(image, pixels: np.ndarray, as_render: bool) -> None:
    height, width = pixels.shape[:2]
    # Either makes new pixels, so neither may come after they are written.
    if image.colorspace_settings.name != results.linear_space():
        image.colorspace_settings.name = results.linear_space()
    if tuple(image.size) != (width, height):
        image.source, image.generated_width, image.generated_height = "GENERATED", width, height
    image.use_view_as_render = as_render
    image.pixels.foreach_set(np.ascontiguousarray(pixels).ravel())
    image.update()


def _lookup_index(difference: np.ndarray, scale: float) -> np.ndarray:
    """Index into the colors; the last one is for what is not finite."""
    finite = np.isfinite(difference)
    position = np.clip(np.where(finite, difference, 0.0) / scale, -1.0, 1.0)
    index = np.rint((0.5 + 0.5 * position) * (_LOOKUP_SIZE - 2)).astype(np.int32)
    return np.where(finite, index, _LOOKUP_SIZE - 1)


def _error_lookup() -> np.ndarray:
    """Linear colors (N, 3) that Blender's default display shows as those of `signed_error_colors`."""
    if _state["lookup"] is None:
        values = np.append(np.linspace(-1.0, 1.0, _LOOKUP_SIZE - 1), np.nan)
        colors = signed_error_colors(values[None], 1.0)[0]
        linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
        _state["lookup"] = linear.astype(np.float32)
    return _state["lookup"]


def _settle_later(scene) -> None:
    """Pack the image once nothing has changed for a moment: Blender would else ask to save it before it quits."""
    _state["settling"].add(scene.name)
    if not bpy.app.background:
        if bpy.app.timers.is_registered(settle):
            bpy.app.timers.unregister(settle)
        bpy.app.timers.register(settle, first_interval=SETTLE_SECONDS)


def settle() -> None:
    """Pack the images that have changed."""
    for name in _state["settling"]:
        scene = bpy.data.scenes.get(name)
        if scene is not None:
            image = viewer_image(scene)
            if image.is_dirty:
                image.pack()
    _state["settling"].clear()


def put_in_editor(context, scene) -> bool:
    """Show the image of `scene` in an Image Editor of the window that shows nothing or a picture of ours."""
    screen = context.window.screen if context.window is not None else None
    for area in screen.areas if screen is not None else ():
        if area.type == "IMAGE_EDITOR":
            space = area.spaces.active
            if space.image is None or results.LAYER in space.image:
                space.image = viewer_image(scene)
                return True
    return False


def redraw_image_editors() -> None:
    """Draw all Image Editors again."""
    for area in _areas():
        if area.type == "IMAGE_EDITOR":
            area.tag_redraw()


def redraw_panels() -> None:
    """Draw everything again that shows progress, and nothing else: a viewport may take long."""
    for area in _areas():
        wanted = PANEL_REGIONS.get(area.type)
        for region in area.regions:
            if region.type == wanted:
                region.tag_redraw()


def _areas() -> list:
    return [area for window in bpy.context.window_manager.windows for area in window.screen.areas]


@contextlib.contextmanager
def kept_as_it_is():
    """Meanwhile saving leaves the images alone: for a copy that no artist opens, in which they do not matter."""
    _state["kept"] = True
    try:
        yield
    finally:
        _state["kept"] = False


@bpy.app.handlers.persistent
def _shrink(*_):
    """Before saving: pixels that can be made again have no place in the file."""
    for scene in bpy.data.scenes if not _state["kept"] else ():
        for image in results.our_images(scene):
            if is_viewer(image) and results.result_of(scene) is not None:
                _store(image, np.zeros((4, 4, 4), dtype=np.float32), image.use_view_as_render)
                image.pack()


@bpy.app.handlers.persistent
def _restore(*_):
    """After saving and loading."""
    if _state["kept"]:
        return
    for scene in bpy.data.scenes:
        if any(is_viewer(image) for image in results.our_images(scene)):
            refresh(scene)
    settle()


def register():
    bpy.app.handlers.save_pre.append(_shrink)
    for handlers in (bpy.app.handlers.save_post, bpy.app.handlers.load_post):
        handlers.append(_restore)


def unregister():
    if bpy.app.timers.is_registered(settle):
        bpy.app.timers.unregister(settle)
    for handlers in (bpy.app.handlers.save_pre, bpy.app.handlers.save_post, bpy.app.handlers.load_post):
        for function in (_shrink, _restore):
            if function in handlers:
                handlers.remove(function)
