"""The tab LTSH of the 3D viewport's sidebar, and the same in the render properties."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as translated

from ..engine.engine_preview import is_previewing
from . import panel_parts, preflight
from .job_arguments import output_folder
from .overview import APPROXIMATED, EXACT, LEFT_OUT, overview

STATE_ICONS = {EXACT: "CHECKMARK", APPROXIMATED: "ERROR", LEFT_OUT: "CANCEL"}
ENTRIES_SHOWN = 24


class _Main:
    bl_label = "LTSH"

    def draw_header_preset(self, context):
        layout = self.layout
        layout.emboss = "NONE"
        layout.popover(panel="LTSH_PT_presets", icon="PRESET", text="")
        layout.operator("ltsh.manual", text="", icon="QUESTION")

    def draw(self, context):
        layout, settings = self.layout, context.scene.ltsh
        running = panel_parts.draw_job(layout)
        column = layout.column()
        column.label(text="Techniques")
        panel_parts.toggles(column, context, 4).prop(settings, "techniques")
        column.separator(factor=0.5)
        column.label(text="Passes")
        column.row(align=True).prop(settings, "passes")
        panel_parts.split_names(layout, context)
        column = layout.column(align=True)
        column.prop(settings, "resolution_percentage", slider=True)
        row = column.row()
        row.alignment, row.active = "RIGHT", False
        row.label(text="{} × {} px".format(*preflight.picture_of(context.scene)), translate=False)
        column = layout.column(align=True)
        column.prop(settings, "anti_aliasing")
        column.prop(settings, "cycles_samples")
        if not running:
            ready = panel_parts.draw_problems(layout, context, "shade")
            panel_parts.draw_button(layout, context, "ltsh.shade", "RENDER_STILL", ready)
            panel_parts.draw_button(layout, context, "ltsh.compare", "MOD_MIRROR", ready)
            # During the preview the panel of the viewport has the button that ends it.
            if not is_previewing(context.scene):
                panel_parts.draw_button(layout, context, "ltsh.preview", "SHADING_RENDERED", True)


class _Bake:
    bl_label = "Bake"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, settings = self.layout, context.scene.ltsh
        column = layout.column()
        panel_parts.toggles(column, context, 4).prop(settings, "bake_passes")
        panel_parts.split_names(layout, context)
        column = layout.column()
        column.prop(settings, "bake_size")
        column.prop(settings, "bake_margin")
        column.prop(settings, "bake_view")
        ob = context.object
        if ob is not None and ob.type == "MESH":
            column.prop_search(settings, "bake_uv_map", ob.data, "uv_layers", icon="GROUP_UVS")
        column.prop(settings, "bake_error")
        if panel_parts.operators.running_job() is None:
            ready = panel_parts.draw_problems(layout, context, "bake")
            count = len(preflight.bake_objects(context)[0])
            if count:
                row = layout.row()
                row.active = False
                text = translated("1 object") if count == 1 else translated("{} objects").format(count)
                row.label(text=text, icon="OBJECT_DATA", translate=False)
            panel_parts.draw_button(layout, context, "ltsh.bake", "RENDER_RESULT", ready)


class _Entries:
    """A list with a sign for each entry, and why where it is not exact."""

    bl_options = {"DEFAULT_CLOSED"}
    key = ""

    def draw_header_preset(self, context):
        entries = getattr(overview(context.scene), self.key)
        noted = sum(entry.state != EXACT for entry in entries)
        row = self.layout.row()
        row.active = False
        row.label(text=str(len(entries)), translate=False)
        if noted:
            self.layout.label(text=str(noted), icon="ERROR", translate=False)

    def draw(self, context):
        layout = self.layout
        entries = getattr(overview(context.scene), self.key)
        if not entries:
            layout.label(text="None that render")
        column = layout.column()
        # What there is something to say about comes first.
        for entry in sorted(entries, key=lambda entry: entry.state == EXACT)[:ENTRIES_SHOWN]:
            row = column.row()
            row.label(text=entry.name, icon=STATE_ICONS[entry.state], translate=False)
            side = row.row()
            side.alignment, side.active = "RIGHT", False
            side.label(text=translated(entry.kind.capitalize()), translate=False)
            for note in entry.notes:
                notes = column.column()
                notes.active = False
                panel_parts.draw_text(notes, context, note, "BLANK1")
        if len(entries) > ENTRIES_SHOWN:
            layout.label(text=translated("and {} more").format(len(entries) - ENTRIES_SHOWN), translate=False)


class _Lights(_Entries):
    bl_label = "Lights"
    key = "lights"


class _Materials(_Entries):
    bl_label = "Materials"
    key = "materials"


class _Output:
    bl_label = "Output"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        panel_parts.split_names(layout, context)
        layout.prop(context.scene.ltsh, "output_folder")
        row = layout.row()
        row.active = False
        panel_parts.draw_text(row, context, str(output_folder(context.scene, "").parent))


MAIN = panel_parts.in_both_places(_Main, "main")
PARTS = (
    *panel_parts.in_both_places(_Bake, "bake", "main"),
    *panel_parts.in_both_places(_Lights, "lights", "main"),
    *panel_parts.in_both_places(_Materials, "materials", "main"),
    *panel_parts.in_both_places(_Output, "output", "main"),
)
register, unregister = bpy.utils.register_classes_factory((*MAIN, *PARTS))
