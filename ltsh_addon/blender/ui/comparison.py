"""The picture of a comparison in the Image Editor: composes two results, and draws the wipe line."""

import functools
import logging

import bpy
import numpy as np

from ...cycles.texels import srgb_decode
from ...imaging.color import LUMINANCE_WEIGHTS, color_bar, signed_error_colors
from ...pipeline.mixer import LightPictures
from ...pipeline.relight import RelightData
from ...scene import error_line
from ..saving import is_working_copy
from . import results
from .overlay import LINE, PAPER, ROW, draw_gradient, draw_handle, draw_label, draw_rectangle, label_places, text_width

NAME = "LTSH Comparison"
SETTLE_SECONDS = 1.0
PANEL_REGIONS = {"VIEW_3D": "UI", "IMAGE_EDITOR": "UI", "PROPERTIES": "WINDOW"}
GRIP_PIXELS = 12.0
_LOOKUP_SIZE = 1024
_state = {"settling": set(), "paths": [], "dragged": None}


def changed(settings, context=None) -> None:
    """Called by Blender when a setting of the view changes. The panels say that a picture is gone when the results are
    shown again."""
    if settings.mode != "MIX":
        settings.mode_before_mix = settings.mode
    try:
        refresh(settings.id_data)
    except RuntimeError as error:
        logging.getLogger(__name__).warning("%s", error_line(error))


def mixed(item, context) -> None:
    """Called by Blender when a value of the light mixer changes; shows the mix at once."""
    settings = item.id_data.ltsh
    if results.state["is_silent"]:
        return
    if settings.mode == "MIX":
        changed(settings, context)
    else:
        settings.mode = "MIX"
    put_in_editor(context, item.id_data)


def mix_render(name: str, pictures: LightPictures, relight_data: RelightData) -> None:
    """Give the mixer the lights of a final render of the scene `name`; called while Blender renders."""

    def take() -> None:
        scene = bpy.data.scenes.get(name)
        if scene is not None:
            results.mix_render(scene, pictures, relight_data)
            redraw_editors("IMAGE_EDITOR")
            redraw_panels()

    bpy.app.timers.register(take, first_interval=0.0)


def refresh(scene) -> bool:
    """Update the image of `scene`; False where there are no results."""
    mixture = results.mixed_pixels(scene) if scene.ltsh.mode == "MIX" else None
    if mixture is not None:
        _show(scene, mixture, True)
        return True
    result = results.result_of(scene)
    if result is None:
        return False
    choice = results.choice_of(scene.ltsh, result)
    results.images_of_pass(scene, result, choice)
    group = result.groups[choice.group]
    pictures = [results.pixels_of(image) for image in _chosen_images(scene, result, choice)]
    if len(pictures) < 2 or pictures[0].shape != pictures[1].shape or not pictures[0].size:
        return False
    pixels = compose(*pictures, choice.mode, split_of(scene), error_scale(scene.ltsh, group, choice))
    _show(scene, pixels, choice.mode != "ERROR")
    return True


def _show(scene, pixels: np.ndarray, as_render: bool) -> None:
    _store(viewer_image(scene), pixels, as_render)
    # The image is packed once nothing has changed for a moment: else Blender asks to save it when it quits.
    _state["settling"].add(scene.name)
    if not bpy.app.background:
        if bpy.app.timers.is_registered(settle):
            bpy.app.timers.unregister(settle)
        bpy.app.timers.register(settle, first_interval=SETTLE_SECONDS)
    redraw_editors("IMAGE_EDITOR")


def _chosen_images(scene, result, choice) -> list:
    """The two images that are compared; [] where the results lack one of them."""
    layers = [f"{name}.{choice.pass_name}" for name in (choice.first, choice.second)]
    if any(layer not in result.groups[choice.group]["files"] for layer in layers):
        return []
    return [results.layer_image(scene, result, choice.group, layer) for layer in layers]


def read_a_picture(scene) -> bool:
    """Read the pixels of one picture that `refresh` needs; False where it needs no more."""
    result = results.result_of(scene)
    images = [] if result is None else _chosen_images(scene, result, results.choice_of(scene.ltsh, result))
    unread = next((image for image in images if not results.is_read(image)), None)
    return unread is not None and results.pixels_of(unread).size > 0


def split_of(scene) -> float:
    """Position of the wipe line as a share of the width, also while the mouse drags it."""
    return scene.ltsh.split if _state["dragged"] is None else _state["dragged"]


def drag_split(scene, position: float | None) -> None:
    """Show the line at `position` while it is dragged; None: at its place in the settings.

    If the settings changed at every step of the mouse, Blender would evaluate the scene and redraw all windows each
    time.
    """
    _state["dragged"] = None if position is None else min(max(position, 0.0), 1.0)
    changed(scene.ltsh)


def compose(first: np.ndarray, second: np.ndarray, mode: str, split: float, scale: float) -> np.ndarray:
    """The picture (H, W', 4) of two pictures (H, W, 4) in linear colors; W' is 2 W side by side, else W."""
    if mode in ("A", "MIX"):
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
    """The difference at the ends of the color scale: the artist's, or that of the report."""
    return settings.error_scale if settings.error_scale > 0.0 else group["scales"][choice.pass_name]


def viewer_image(scene):
    """The image of `scene`, created if needed."""
    for image in results.our_images(scene):
        if image[results.LAYER] == "":
            return image
    image = bpy.data.images.new(NAME, 4, 4, alpha=False, float_buffer=True)
    image[results.LAYER], image[results.SCENE] = "", scene.name
    return image


def is_viewer(image) -> bool:
    """True for an image that this module made."""
    return image is not None and image.get(results.LAYER) == "" and results.SCENE in image


def _store(image, pixels: np.ndarray, as_render: bool) -> None:
    height, width = pixels.shape[:2]
    # Changing the color space or the size makes new pixels, so both come before the pixels are written.
    if image.colorspace_settings.name != results.linear_space():
        image.colorspace_settings.name = results.linear_space()
    if tuple(image.size) != (width, height):
        image.source, image.generated_width, image.generated_height = "GENERATED", width, height
    image.use_view_as_render = as_render
    image.pixels.foreach_set(np.ascontiguousarray(pixels).ravel())
    image.update()


def _lookup_index(difference: np.ndarray, scale: float) -> np.ndarray:
    """Index into the table of colors; NaN and Inf have the last one."""
    finite = np.isfinite(difference)
    position = np.clip(np.where(finite, difference, 0.0) / scale, -1.0, 1.0)
    index = np.rint((0.5 + 0.5 * position) * (_LOOKUP_SIZE - 2)).astype(np.int32)
    return np.where(finite, index, _LOOKUP_SIZE - 1)


@functools.cache
def _error_lookup() -> np.ndarray:
    """Linear colors (N, 3) that Blender's default display shows as the colors of `signed_error_colors`."""
    values = np.append(np.linspace(-1.0, 1.0, _LOOKUP_SIZE - 1), np.nan)
    return srgb_decode(signed_error_colors(values[None], 1.0)[0]).astype(np.float32)


def settle() -> None:
    """Pack the images that have changed."""
    for name in _state["settling"]:
        scene = bpy.data.scenes.get(name)
        if scene is not None:
            image = viewer_image(scene)
            if image.is_dirty:
                image.pack()
    _state["settling"].clear()


ARRANGE_SECONDS, ARRANGE_TRIES = 0.2, 50


def put_in_editor(context, scene) -> bool:
    """Show the image of `scene` in an Image Editor that is empty or shows a render or one of our pictures.

    The window of `context` comes first. Returns False where there is no such editor.
    """
    windows = [] if context.window is None else [context.window, *bpy.context.window_manager.windows]
    for area in (area for window in windows for area in window.screen.areas):
        if area.ui_type == "IMAGE_EDITOR":
            space = area.spaces.active
            if space.image is None or space.image.type == "RENDER_RESULT" or results.LAYER in space.image:
                space.image = viewer_image(scene)
                return True
    return False


def open_editor(context, scene) -> bool:
    """Show the image of `scene` in an Image Editor, if needed in a new window; False where none can be opened."""
    if put_in_editor(context, scene):
        return True
    windows = bpy.context.window_manager.windows
    if context.window is None:
        return False
    try:
        with bpy.context.temp_override(window=context.window):
            bpy.ops.wm.window_new()
    except RuntimeError:
        return False  # the window is in full screen
    window = windows[-1]
    area = window.screen.areas[0]
    area.ui_type = "IMAGE_EDITOR"
    area.spaces.active.image = viewer_image(scene)
    area.spaces.active.show_region_ui = True
    # Blender knows the size and the tabs of the new area only after drawing it.
    tries = iter(range(ARRANGE_TRIES))
    bpy.app.timers.register(lambda: _arrange(area, next(tries, None)), first_interval=ARRANGE_SECONDS)
    return True


def _arrange(area, attempt: int | None) -> float | None:
    """Fit the picture into its new area and open our tab. Returns the seconds until the next attempt; None: done."""
    # To read an area that has been closed ends Blender: its memory is gone. To compare it with others reads nothing.
    windows = bpy.context.window_manager.windows
    window = next((one for one in windows if area in one.screen.areas[:]), None)
    if window is None:
        return None
    try:
        regions = {region.type: region for region in area.regions}
        regions["UI"].active_panel_category = "LTSH"
        with bpy.context.temp_override(window=window, area=area, region=regions["WINDOW"]):
            bpy.ops.image.view_all(fit_view=True)
    except TypeError:
        return None if attempt is None else ARRANGE_SECONDS
    except (ReferenceError, KeyError, RuntimeError):
        pass  # the area shows something else
    return None


def redraw_editors(*kinds: str) -> None:
    """Draw all areas of these kinds again: Blender does not redraw 3D views for properties of add-ons."""
    for area in _areas():
        if area.type in kinds:
            area.tag_redraw()


def redraw_panels() -> None:
    """Draw all regions again that show progress, and no others: a viewport may take long."""
    for area in _areas():
        wanted = PANEL_REGIONS.get(area.type)
        for region in area.regions:
            if region.type == wanted:
                region.tag_redraw()


def _areas() -> list:
    return [area for window in bpy.context.window_manager.windows for area in window.screen.areas]


@bpy.app.handlers.persistent
def _shrink(path="", *_):
    """Before saving as `path`, remove pixels that can be made again from the file, and let paths begin at `path`."""
    if is_working_copy():
        return
    owners = [(scene.ltsh, "result_folder") for scene in bpy.data.scenes]
    owners += [(last, "folder") for scene in bpy.data.scenes for last in scene.ltsh.last_results]
    _state["paths"] = [(*owner, bpy.path.abspath(getattr(*owner))) for owner in owners if getattr(*owner)]
    _write_paths(path)
    for scene in bpy.data.scenes:
        for image in results.our_images(scene):
            if is_viewer(image) and results.result_of(scene) is not None:
                _store(image, np.zeros((4, 4, 4), dtype=np.float32), image.use_view_as_render)
                image.pack()


def _write_paths(blend: str) -> None:
    """Let the paths of results begin at the file `blend`."""
    for owner, name, path in _state["paths"]:
        setattr(owner, name, results.blender_path(path, blend))


@bpy.app.handlers.persistent
def _restore(*_):
    """After saving and loading, make the pixels again."""
    if is_working_copy():
        return
    _write_paths(bpy.data.filepath)
    _state["paths"].clear()
    for scene in bpy.data.scenes:
        is_shown = any(is_viewer(image) for image in results.our_images(scene))
        if is_shown or results.result_of(scene) is not None:
            refresh(scene)
    settle()


def _compared_in(context):
    """Result and choice if the space of `context` shows the comparison of its scene, else None."""
    space, scene = context.space_data, context.scene
    if space is None or space.type != "IMAGE_EDITOR" or not is_viewer(space.image):
        return None
    if not results.belongs(space.image, scene):
        return None
    result = results.result_of(scene)
    return None if result is None else (result, results.choice_of(scene.ltsh, result))


def line_position(context) -> float:
    """Position of the wipe line in pixels from the left of the region."""
    return context.region.view2d.view_to_region(split_of(context.scene), 0.0, clip=False)[0]


class LTSH_GT_wipe(bpy.types.Gizmo):
    """The line itself; `_draw` shows it, so that it looks the same where gizmos are switched off."""

    bl_idname = "LTSH_GT_wipe"

    def draw(self, context):
        """Draw nothing: `_draw` shows the line."""

    def test_select(self, context, location):
        grip = GRIP_PIXELS * context.preferences.system.ui_scale
        return 0 if abs(location[0] - line_position(context)) <= grip else -1

    def invoke(self, context, event):
        context.window.cursor_modal_set("MOVE_X")
        return {"RUNNING_MODAL"}

    def modal(self, context, event, tweak):
        drag_split(context.scene, context.region.view2d.region_to_view(event.mouse_region_x, 0.0)[0])
        return {"RUNNING_MODAL"}

    def exit(self, context, cancel):
        context.window.cursor_modal_restore()
        settings, position = context.scene.ltsh, split_of(context.scene)
        if not cancel and position != settings.split:
            settings.split = position
            bpy.ops.ed.undo_push(message="Drag Split")
        drag_split(context.scene, None)


class LTSH_GGT_wipe(bpy.types.GizmoGroup):
    """Takes the mouse at the line before any tool of the Image Editor does"""

    bl_idname = "LTSH_GGT_wipe"
    bl_label = "Split of the Comparison"
    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "WINDOW"
    bl_options = {"PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context):
        shown = None if context.scene is None else _compared_in(context)
        return shown is not None and shown[1].mode == "WIPE"

    def setup(self, context):
        self.gizmos.new(LTSH_GT_wipe.bl_idname)


def _draw() -> None:
    """Draw over the picture; called by Blender for every Image Editor."""
    context = bpy.context
    shown = _compared_in(context)
    if shown is None:
        return
    result, choice = shown
    scale, region, settings = context.preferences.system.ui_scale, context.region, context.scene.ltsh
    labels = result.groups[choice.group]["labels"]
    first, second = labels[choice.first], labels[choice.second]
    left, bottom = region.view2d.view_to_region(0.0, 0.0, clip=False)
    right, top = region.view2d.view_to_region(1.0, 1.0, clip=False)
    rows = 2 if choice.mode == "ERROR" else 1
    start, end, below, above = label_places((left, bottom, right, top), context.area, region, scale, rows)
    title = f"{first} \u2212 {second}" if choice.mode == "ERROR" else first
    draw_label(start, below, results.mix_label(context.scene) if choice.mode == "MIX" else title, scale)
    if choice.mode == "WIPE":
        _draw_line(line_position(context), bottom, top, scale)
        draw_label(end, below, second, scale, align=1.0)
    elif choice.mode == "SIDE":
        draw_label(max((left + right) / 2.0, start), below, second, scale)
    elif choice.mode == "ERROR":
        limit = error_scale(settings, result.groups[choice.group], choice)
        _draw_legend(start, below - ROW * scale, limit, scale)
    if results.lacks(result):
        draw_label(start, above, results.lacks(result), scale)


def _draw_line(x: float, bottom: float, top: float, scale: float) -> None:
    half = 0.75 * scale
    draw_rectangle(x - 2.0 * half, bottom, x + 2.0 * half, top, PAPER)
    draw_rectangle(x - half, bottom, x + half, top, LINE)
    draw_handle(x, (bottom + top) / 2.0, scale)


def _draw_legend(left: float, below: float, limit: float, scale: float) -> None:
    """Draw the color scale of the difference with its ends, from `left` on."""
    width, height, gap = 160.0 * scale, 20.0 * scale, 12.0 * scale
    start, end = f"too dark \u2212{limit:g}", f"+{limit:g} too bright"
    draw_label(left, below, start, scale)
    bar = left + text_width(start, scale) + gap
    draw_gradient(bar, below, bar + width, below + height, color_bar(65, 1)[0])
    draw_label(bar + width, below, end, scale)


@bpy.app.handlers.persistent
def _mix_again(*_):
    """After undo and redo the settings may have other values than the picture that is shown."""
    images = {area.spaces.active.image for area in _areas() if area.type == "IMAGE_EDITOR"}
    for scene in bpy.data.scenes:
        if scene.ltsh.mode == "MIX" or any(is_viewer(image) and results.belongs(image, scene) for image in images):
            refresh(scene)


@bpy.app.handlers.persistent
def _forget_file(*_):
    """Before loading, forget the file: the next one may have scenes of the same names."""
    results.forget_renders()
    _state["settling"].clear()
    _state["dragged"] = None


HANDLERS = (
    ("load_pre", _forget_file),
    ("save_pre", _shrink), ("save_post", _restore), ("load_post", _restore),
    ("undo_post", _mix_again), ("redo_post", _mix_again),
)  # fmt: skip


def register() -> None:
    """Add the drawing over pictures."""
    _state["drawing"] = bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister() -> None:
    """Remove it, and end what goes on."""
    bpy.types.SpaceImageEditor.draw_handler_remove(_state["drawing"], "WINDOW")
    if bpy.app.timers.is_registered(settle):
        bpy.app.timers.unregister(settle)
    results.forget_renders()
