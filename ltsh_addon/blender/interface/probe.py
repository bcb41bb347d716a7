"""The pixel probe: what each technique and Cycles have at a pixel."""

from __future__ import annotations

import bpy

from . import drawing, results, viewer

CYCLES = "cycles"
_active = {"on": False}


class LTSH_OT_probe(bpy.types.Operator):
    """Show the radiance of every picture at the pixel under the mouse. Click to leave the probe there, Esc to end"""

    bl_idname = "ltsh.probe"
    bl_label = "Pixel Probe"

    @classmethod
    def poll(cls, context):
        space = context.space_data
        if space is None or space.type != "IMAGE_EDITOR" or not viewer.is_viewer(space.image):
            cls.poll_message_set("Show the image LTSH Comparison first")
            return False
        return True

    def invoke(self, context, event):
        self._area = context.area
        _active["on"] = True
        context.window.cursor_modal_set("EYEDROPPER")
        context.window_manager.modal_handler_add(self)
        context.area.tag_redraw()
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        region = next(region for region in self._area.regions if region.type == "WINDOW")
        if event.type == "MOUSEMOVE":
            x, y = region.view2d.region_to_view(event.mouse_x - region.x, event.mouse_y - region.y)
            if context.scene.ltsh.mode == "SIDE":
                x = 2.0 * x % 1.0
            context.scene.ltsh.probe = min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)
            self._area.tag_redraw()
            return {"PASS_THROUGH"}
        if event.type in {"ESC", "RIGHTMOUSE"}:
            _active["on"] = False
            return self._end(context, {"CANCELLED"})
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            return self._end(context, {"FINISHED"})
        return {"PASS_THROUGH"}

    def cancel(self, context):
        """The window was closed."""
        _active["on"] = False

    def _end(self, context, outcome):
        context.window.cursor_modal_restore()
        self._area.tag_redraw()
        return outcome


def values_at(scene, result, choice, point) -> tuple[tuple[int, int], list[tuple[str, tuple[float, ...]]]]:
    """The pixel (column, row from below) at `point` in [0, 1]^2, and (label, RGB) of every picture there."""
    group = result.groups[choice.group]
    width, height = group["size"]
    column, row = (min(int(share * size), size - 1) for share, size in zip(point, (width, height), strict=True))
    rows = []
    for name in group["names"]:
        layer = f"{name}.{choice.pass_name}"
        if layer in group["files"]:
            pixels = results.pixels_of(results.layer_image(scene, result, choice.group, layer))
            if pixels.size:
                rows.append((group["labels"][name], tuple(float(value) for value in pixels[row, column, :3])))
    return (column, row), rows


def draw_probe(context, result, choice, corners) -> None:
    """A cross at the probed pixel and a table of its values, while the probe is on."""
    if not _active["on"]:
        return
    scene, scale = context.scene, context.preferences.system.ui_scale
    left, bottom, right, top = corners
    (column, row), rows = values_at(scene, result, choice, scene.ltsh.probe)
    share = 0.5 if scene.ltsh.mode == "SIDE" else 1.0
    x = left + share * scene.ltsh.probe[0] * (right - left)
    y = bottom + scene.ltsh.probe[1] * (top - bottom)
    half, arm, gap = 0.75 * scale, 9.0 * scale, 3.0 * scale
    for a, b in ((gap, arm), (-arm, -gap)):
        drawing.draw_rectangle(x + a, y - half, x + b, y + half, drawing.LINE)
        drawing.draw_rectangle(x - half, y + a, x + half, y + b, drawing.LINE)
    _draw_table(f"{column}, {row}", rows, x + 14.0 * scale, y - 14.0 * scale, scale)


def _draw_table(title: str, rows, x: float, top: float, scale: float) -> None:
    line, pad = 17.0 * scale, 8.0 * scale
    label = max([drawing.text_width(name, scale) for name, _ in rows] + [drawing.text_width(title, scale)])
    number = drawing.text_width("0000.0000", scale)
    width = 2.0 * pad + label + 3.0 * (number + 4.0 * scale)
    bottom = top - line * (len(rows) + 1) - pad
    drawing.draw_rectangle(x, bottom, x + width, top, (0.0, 0.0, 0.0, 0.75))
    y = top - line
    drawing.draw_text(x + pad, y, title, scale, (0.75, 0.75, 0.75, 1.0))
    for name, values in rows:
        y -= line
        drawing.draw_text(x + pad, y, name, scale)
        for index, value in enumerate(values):
            text = f"{value:.4f}"
            right = x + pad + label + (index + 1) * (number + 4.0 * scale)
            drawing.draw_text(right - drawing.text_width(text, scale), y, text, scale)


register, unregister = bpy.utils.register_classes_factory((LTSH_OT_probe,))
