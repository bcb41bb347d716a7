"""What is drawn over the image "LTSH Comparison", and the line in it that the mouse drags."""

from __future__ import annotations

import bpy

from ...imaging.false_color import color_bar
from . import drawing, results, viewer
from .probe import draw_probe

GRIP_PIXELS = 12.0
HANDLE_PIXELS = 9.0
_state = {"handle": None}


def _shown(context):
    """Result and choice where the space of `context` shows the comparison of its scene, else None."""
    space, scene = context.space_data, context.scene
    if space is None or space.type != "IMAGE_EDITOR" or not viewer.is_viewer(space.image):
        return None
    if not results.belongs(space.image, scene):
        return None
    result = results.result_of(scene)
    return None if result is None else (result, results.choice_of(scene.ltsh, result))


def line_position(context) -> float:
    """Where the line is, in pixels from the left of the region."""
    return context.region.view2d.view_to_region(viewer.split_of(context.scene), 0.0, clip=False)[0]


class LTSH_GT_wipe(bpy.types.Gizmo):
    """The line itself; `_draw` shows it, so that it looks the same where gizmos are switched off."""

    bl_idname = "LTSH_GT_wipe"

    def draw(self, context):
        """Nothing beside what `_draw` shows."""

    def test_select(self, context, location):
        grip = GRIP_PIXELS * context.preferences.system.ui_scale
        return 0 if abs(location[0] - line_position(context)) <= grip else -1

    def invoke(self, context, event):
        context.window.cursor_modal_set("MOVE_X")
        return {"RUNNING_MODAL"}

    def modal(self, context, event, tweak):
        viewer.drag_split(context.scene, context.region.view2d.region_to_view(event.mouse_region_x, 0.0)[0])
        return {"RUNNING_MODAL"}

    def exit(self, context, cancel):
        context.window.cursor_modal_restore()
        settings, position = context.scene.ltsh, viewer.split_of(context.scene)
        if not cancel and position != settings.split:
            settings.split = position
            bpy.ops.ed.undo_push(message="Drag Split")
        viewer.drag_split(context.scene, None)


class LTSH_GGT_wipe(bpy.types.GizmoGroup):
    """Takes the mouse at the line before any tool of the Image Editor does"""

    bl_idname = "LTSH_GGT_wipe"
    bl_label = "Split of the Comparison"
    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "WINDOW"
    bl_options = {"PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context):
        return context.scene is not None and context.scene.ltsh.mode == "WIPE" and _shown(context) is not None

    def setup(self, context):
        self.gizmos.new(LTSH_GT_wipe.bl_idname)


def _draw() -> None:
    """Called by Blender for every Image Editor."""
    context = bpy.context
    shown = _shown(context)
    if shown is None:
        return
    result, choice = shown
    scale, region, settings = context.preferences.system.ui_scale, context.region, context.scene.ltsh
    labels = result.groups[choice.group]["labels"]
    first, second = labels[choice.first], labels[choice.second]
    left, bottom = region.view2d.view_to_region(0.0, 0.0, clip=False)
    right, top = region.view2d.view_to_region(1.0, 1.0, clip=False)
    below, gap = bottom - 26.0 * scale, 6.0 * scale
    if settings.mode == "WIPE":
        _draw_line(line_position(context), bottom, top, scale)
        drawing.draw_label(left, below, first, scale)
        drawing.draw_label(right, below, second, scale, align=1.0)
    elif settings.mode == "SIDE":
        drawing.draw_label(left, below, first, scale)
        drawing.draw_label((left + right) / 2.0, below, second, scale)
    elif settings.mode == "A":
        drawing.draw_label(left, below, first, scale)
    else:
        drawing.draw_label(left, below, f"{first} \u2212 {second}", scale)
        limit = viewer.error_scale(settings, result.groups[choice.group], choice)
        _draw_legend(left, below - 26.0 * scale, limit, scale)
    if result.partial:
        drawing.draw_label(left, top + gap, result.partial, scale)
    draw_probe(context, result, choice, (left, bottom, right, top))


def _draw_line(x: float, bottom: float, top: float, scale: float) -> None:
    half, handle = 0.75 * scale, HANDLE_PIXELS * scale
    drawing.draw_rectangle(x - 2.0 * half, bottom, x + 2.0 * half, top, drawing.PAPER)
    drawing.draw_rectangle(x - half, bottom, x + half, top, drawing.LINE)
    middle = (bottom + top) / 2.0
    drawing.draw_rectangle(x - handle, middle - handle, x + handle, middle + handle, drawing.PAPER)
    for offset in (-3.0 * scale, 3.0 * scale):
        drawing.draw_rectangle(
            x + offset - half, middle - 0.6 * handle, x + offset + half, middle + 0.6 * handle, drawing.LINE
        )


def _draw_legend(left: float, below: float, limit: float, scale: float) -> None:
    """The colors of the difference between their ends, from `left` on."""
    width, height, gap = 160.0 * scale, 20.0 * scale, 12.0 * scale
    start, end = f"too dark \u2212{limit:g}", f"+{limit:g} too bright"
    drawing.draw_label(left, below, start, scale)
    bar = left + drawing.text_width(start, scale) + gap
    drawing.draw_gradient(bar, below, bar + width, below + height, color_bar(65, 1)[0])
    drawing.draw_label(bar + width, below, end, scale)


CLASSES = (LTSH_GT_wipe, LTSH_GGT_wipe)
_register, _unregister = bpy.utils.register_classes_factory(CLASSES)


def register():
    _register()
    _state["handle"] = bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister():
    bpy.types.SpaceImageEditor.draw_handler_remove(_state["handle"], "WINDOW")
    _unregister()
