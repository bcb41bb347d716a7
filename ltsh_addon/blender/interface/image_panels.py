"""The tab LTSH of the Image Editor, and the results in the other two places."""

from __future__ import annotations

import bpy

from . import panel_parts, results, viewer
from .job_arguments import output_folder
from .operators_view import COMMANDS

FIGURES = (("relative_l2", "L2 %"), ("bias", "Bias %"), ("flip", "FLIP"))
TABLE_PIXELS = 270.0  # below, there is a sentence for each technique


def draw_figures(layout, context, result, choice) -> None:
    """Errors of the pass that is shown against Cycles, a row for each technique."""
    group = result.groups[choice.group]
    figures = group["figures"].get(choice.pass_name, {})
    if not figures:
        return
    rows = [(group["labels"][name], row) for name, row in figures["techniques"].items()]
    column = layout.column()
    if panel_parts.region_width(context) >= TABLE_PIXELS:
        _draw_table(column, rows)
    else:
        for label, row in rows:
            values = (_figure(key, row.get(key), "\u00a0%") for key, _ in FIGURES)
            named = (f"{name}\u00a0{value}" for name, value in zip(("L2", "bias", "FLIP"), values, strict=True))
            panel_parts.draw_text(column, context, f"{label}: {', '.join(named)}")
    if figures.get("noise") is not None:
        notes = column.column()
        notes.active = False
        panel_parts.draw_text(notes, context, _noise_text(group, figures))


def _draw_table(layout, rows) -> None:
    split = layout.split(factor=0.34)
    column = split.column(align=True)
    title = column.row()
    title.active = False
    title.label(text="vs Cycles")
    for label, _ in rows:
        column.label(text=label, translate=False)
    side = split.row()
    for key, title in FIGURES:
        column = side.column(align=True)
        column.alignment = "RIGHT"
        head = column.row()
        head.alignment, head.active = "RIGHT", False
        head.label(text=title)
        for _, row in rows:
            cell = column.row()
            cell.alignment = "RIGHT"
            cell.label(text=_figure(key, row.get(key)), translate=False)


def _noise_text(group, figures) -> str:
    """How much of the error is the noise of Cycles, and what is left without it."""
    rest = []
    for name, row in figures["techniques"].items():
        squared = row.get("unbiased_squared_error")
        if squared is not None:
            value = "in noise" if squared < 0.0 else f"{100.0 * squared**0.5:.2f} %"
            rest.append(f"{group['labels'][name]} {value}".replace(" ", "\u00a0"))
    return f"Noise of Cycles {100.0 * figures['noise']:.2f}\u00a0%. Error without it: {', '.join(rest)}"


def _figure(key: str, value: float | None, unit: str = "") -> str:
    if value is None:
        return "\u2013"
    if key == "flip":
        return f"{value:.4f}"
    return (f"{100.0 * value:+.2f}" if key == "bias" else f"{100.0 * value:.2f}") + unit


class _Results:
    bl_label = "Results"

    def draw(self, context):
        layout, scene = self.layout, context.scene
        row = layout.row(align=True)
        result = results.result_of(scene)
        for command, title, _ in COMMANDS:
            cell = row.row(align=True)
            cell.enabled = results.result_in(str(output_folder(scene, command) / "images")) is not None
            shown = result is not None and result.command == command
            cell.operator("ltsh.show_results", text=title, depress=shown).command = command
        if result is None:
            panel_parts.draw_text(layout, context, "None yet: shade, compare or bake first", "INFO")
            return
        if result.partial:
            panel_parts.draw_text(layout.box(), context, result.partial, "ERROR")
        if len(result.groups) > 1:
            layout.prop_search(scene.ltsh, "group", scene.ltsh, "groups", icon="TEXTURE")
        self.draw_choice(context, result)
        draw_figures(layout, context, result, results.choice_of(scene.ltsh, result))
        self.draw_warnings(context, result)
        if context.space_data.type != "IMAGE_EDITOR":
            layout.operator("ltsh.open_results", icon="IMAGE_DATA")
        row = layout.row(align=True)
        row.operator("ltsh.save_exr", icon="FILE_TICK")
        row.operator("ltsh.open_folder", text="", icon="FILE_FOLDER")

    def draw_choice(self, context, result):
        """Which pictures; in the Image Editor, where they are seen."""

    def draw_warnings(self, context, result):
        warnings = [*result.report.get("problems", ()), *result.report["warnings"]]
        if not warnings:
            return
        header, body = self.layout.panel("ltsh_warnings", default_closed=True)
        header.label(text=f"Warnings ({len(warnings)})", icon="ERROR", translate=False)
        if body is not None:
            for warning in warnings:
                panel_parts.draw_text(body, context, warning, "DOT")


class LTSH_PT_IMAGE_results(_Results, bpy.types.Panel):
    """Two pictures of the results and how they differ"""

    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "UI"
    bl_category = "LTSH"
    bl_label = "Comparison"

    def draw_choice(self, context, result):
        layout, settings = self.layout, context.scene.ltsh
        if not viewer.is_viewer(context.space_data.image):
            layout.operator("ltsh.open_results", text="Show Comparison", icon="IMAGE_DATA")
        column = layout.column()
        panel_parts.toggles(column, context, 4).prop(settings, "mode", expand=True)
        group = result.groups[results.choice_of(settings, result).group]
        self._draw_names(column, settings, "first", "A", group)
        if settings.mode != "A":
            self._draw_names(column, settings, "second", "B", group)
        row = column.row(align=True)
        for name in group["passes"]:
            row.prop_enum(settings, "pass_name", name)
        if settings.mode == "WIPE":
            row = column.row(align=True)
            row.prop(settings, "split", slider=True)
            row.operator("ltsh.swap", text="", icon="ARROW_LEFTRIGHT")
        elif settings.mode == "ERROR":
            column.prop(settings, "error_scale", text="Scale (0: Automatic)")
        view = context.scene.view_settings
        column.prop(view, "exposure", text="Exposure of the Scene")
        layout.operator("ltsh.probe", icon="EYEDROPPER")

    def _draw_names(self, column, settings, key, label, group):
        split = column.split(factor=0.1)
        split.label(text=label, translate=False)
        row = split.row(align=True)
        for name in group["names"]:
            if name in settings.bl_rna.properties[key].enum_items:
                row.prop_enum(settings, key, name)


CLASSES = (*panel_parts.in_both_places(_Results, "results", "main"), LTSH_PT_IMAGE_results)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
