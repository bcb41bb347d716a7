"""The line of the split view, which the mouse drags."""

from __future__ import annotations

import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from .view_properties import ENGINE

REACH = 8.0  # pixels of an unscaled interface
HANDLE = 12.0


def is_split(context) -> bool:
    """True in 3D views that show a split picture."""
    space = context.space_data
    shown = space is not None and space.type == "VIEW_3D" and space.shading.type == "RENDERED"
    return shown and context.engine == ENGINE and context.scene.ltsh_view.mode == "split"


def _line_place(context) -> float:
    return context.scene.ltsh_view.split_position * context.region.width


class LTSH_GT_split(bpy.types.Gizmo):
    """A vertical line that moves sideways."""

    bl_idname = "LTSH_GT_split"

    def test_select(self, context, location):
        reach = REACH * context.preferences.system.ui_scale
        return 0 if abs(location[0] - _line_place(context)) <= reach else -1

    def draw(self, context):
        """Draw the handle, an arrow to either side; the line is part of the picture."""
        size = HANDLE * context.preferences.system.ui_scale * (1.25 if self.is_highlight else 1.0)
        x, y = _line_place(context), 0.5 * context.region.height
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        gpu.state.blend_set("ALPHA")
        shader.bind()
        for grown, color in ((0.3 * size, (0.0, 0.0, 0.0, 0.6)), (0.0, (0.95, 0.95, 0.95, 1.0))):
            shader.uniform_float("color", color)
            corners = []
            for side in (-1.0, 1.0):
                inner, tip = x + side * (0.4 * size - 0.5 * grown), x + side * (1.2 * size + grown)
                corners += [(inner, y + 0.8 * size + grown), (inner, y - 0.8 * size - grown), (tip, y)]
            batch_for_shader(shader, "TRIS", {"pos": [(*corner, 0.0) for corner in corners]}).draw(shader)
        gpu.state.blend_set("NONE")

    def invoke(self, context, event):
        self.start = context.scene.ltsh_view.split_position
        return {"RUNNING_MODAL"}

    def modal(self, context, event, tweak):
        width = max(context.region.width, 1)
        context.scene.ltsh_view.split_position = min(max(event.mouse_region_x / width, 0.0), 1.0)
        return {"RUNNING_MODAL"}

    def exit(self, context, cancel):
        if cancel:
            context.scene.ltsh_view.split_position = self.start


class LTSH_GGT_split(bpy.types.GizmoGroup):
    """The line in every 3D view that is split."""

    bl_idname = "LTSH_GGT_split"
    bl_label = "LTSH split view"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context):
        return is_split(context)

    def setup(self, context):
        self.line = self.gizmos.new(LTSH_GT_split.bl_idname)
        self.line.use_draw_modal = True


CLASSES = (LTSH_GT_split, LTSH_GGT_split)


def register() -> None:
    """Add the gizmo."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Remove it."""
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
