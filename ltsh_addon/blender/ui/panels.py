"""Panels of the 3D viewport's sidebar, of the render properties and of the image editor."""

from __future__ import annotations

import textwrap

import bpy
from bpy.app.translations import pgettext_iface as translated

from . import comparison, operators, preflight, results
from .job import clock, output_folder, progress_text, stage_title
from .preflight import APPROXIMATED, EXACT, LEFT_OUT, overview
from .preview import is_previewing
from .view_operators import COMMANDS

LETTER_PIXELS = 6.6  # mean width of a letter of Blender's interface at scale 1
MARGIN_PIXELS = 70.0  # icon, scroll bar and borders
BUTTON_PIXELS = 50.0  # of a button beside text, without its label
TEXT_PIXELS = 110.0  # the least width of text beside a button
TOGGLE_PIXELS = 85.0
SPLIT_PIXELS = 250.0


def draw_text(layout, context, text: str, icon: str = "NONE", reserved: float = 0.0) -> None:
    """`text` in as many lines as the region needs; `reserved` pixels are taken by something beside it."""
    width = region_width(context) - MARGIN_PIXELS - reserved
    column = layout.column(align=True)
    column.scale_y = 0.85
    lines = textwrap.wrap(text, max(16, int(width / LETTER_PIXELS))) or [""]
    column.label(text=lines[0], icon=icon, translate=False)
    for line in lines[1:]:
        column.label(text=line, icon="BLANK1" if icon != "NONE" else "NONE", translate=False)


def draw_problems(layout, context, command: str) -> bool:
    """What stands in the way of `command`, each with its fix; True where nothing does."""
    found = preflight.problems(context, command)
    if found:
        box = layout.box()
        for problem in found:
            _draw_problem(box, context, problem)
    return not any(problem.blocks for problem in found)


def _draw_problem(layout, context, problem) -> None:
    """The text, and the button beside it where there is room for both."""
    label = translated(problem.fix_label)
    button = LETTER_PIXELS * len(label) + BUTTON_PIXELS if problem.fix else 0.0
    beside = region_width(context) - MARGIN_PIXELS - button >= TEXT_PIXELS
    row = layout.row() if beside else layout.column()
    icon = "ERROR" if problem.blocks else "INFO"
    draw_text(row.column(), context, problem.text, icon, button if beside else 0.0)
    if problem.fix:
        side = row.row()
        side.alignment = "RIGHT" if beside else "EXPAND"
        fix = side.operator(problem.fix, text=label)
        for name, value in problem.fix_values.items():
            setattr(fix, name, value)


def toggles(layout, context, count: int):
    """A layout for `count` buttons of a set of choices: one row where they fit, else two columns."""
    fits = region_width(context) >= TOGGLE_PIXELS * count
    return layout.grid_flow(row_major=True, columns=count if fits else 2, even_columns=True, align=True)


def split_names(layout, context) -> None:
    """Names of properties beside their fields, as Blender's panels have them, or inside where that is too narrow."""
    layout.use_property_split = region_width(context) >= SPLIT_PIXELS
    layout.use_property_decorate = False


def region_width(context) -> float:
    """Of the region that is drawn, in pixels at interface scale 1."""
    return context.region.width / context.preferences.system.ui_scale


def draw_job(layout) -> bool:
    """The job that runs, with its Cancel button; False where none does."""
    job = operators.running_job()
    if job is None:
        return False
    column = layout.box().column()
    row = column.row()
    row.label(text=job.title, icon="RENDER_STILL")
    draw_right(row, clock(job.seconds()))
    column.progress(factor=job.plan.share(), text=progress_text(job))
    row = gray(column)
    row.label(text=stage_title(job), translate=False)
    draw_right(row, f"{job.plan.number} / {job.plan.count}")
    column.operator("ltsh.cancel", text="Cancel", icon="X")
    return True


def gray(layout):
    """A row for what is less important."""
    row = layout.row()
    row.active = False
    return row


def draw_shadows(layout, settings) -> None:
    """What stands in the way of light."""
    column = layout.column(align=True)
    column.prop(settings, "shadows")
    row = column.row()
    row.active = settings.shadows
    row.prop(settings, "shadow_rays")


def draw_right(layout, text: str) -> None:
    """Gray text at the right end."""
    side = gray(layout)
    side.alignment = "RIGHT"
    side.label(text=text, translate=False)


def draw_button(layout, context, operator: str, icon: str, ready: bool) -> None:
    """A large button, gray while it cannot run."""
    row = layout.row()
    row.scale_y = 1.4
    row.enabled = ready
    row.operator(operator, icon=icon)


def in_both_places(panel: type, name: str, parent: str = "") -> tuple[type, type]:
    """The mixin `panel` as a class for the 3D viewport's sidebar and one for the render properties."""
    places = {
        "VIEW3D": {"bl_space_type": "VIEW_3D", "bl_region_type": "UI", "bl_category": "LTSH"},
        "RENDER": {"bl_space_type": "PROPERTIES", "bl_region_type": "WINDOW", "bl_context": "render"},
    }
    classes = []
    for place, values in places.items():
        identifier = f"LTSH_PT_{place}_{name}"
        family = {"bl_parent_id": f"LTSH_PT_{place}_{parent}"} if parent else {}
        # Blender reads the docstring of a panel's own class.
        members = {**values, **family, "bl_idname": identifier, "__doc__": panel.__doc__}
        classes.append(type(identifier, (panel, bpy.types.Panel), members))
    return tuple(classes)


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
        running = draw_job(layout)
        column = layout.column()
        column.label(text="Techniques")
        toggles(column, context, 4).prop(settings, "techniques")
        column.separator(factor=0.5)
        column.label(text="Passes")
        column.row(align=True).prop(settings, "passes")
        split_names(layout, context)
        column = layout.column(align=True)
        column.prop(settings, "resolution_percentage", slider=True)
        draw_right(column, "{} × {} px".format(*preflight.picture_of(context.scene)))
        column = layout.column(align=True)
        column.prop(settings, "anti_aliasing")
        column.prop(settings, "cycles_samples")
        draw_shadows(layout, settings)
        if not running:
            ready = draw_problems(layout, context, "shade")
            draw_button(layout, context, "ltsh.shade", "RENDER_STILL", ready)
            draw_button(layout, context, "ltsh.compare", "MOD_MIRROR", ready)
            # During the preview the panel of the viewport has the button that ends it.
            if not is_previewing(context.scene):
                draw_button(layout, context, "ltsh.preview", "SHADING_RENDERED", True)


class _Bake:
    bl_label = "Bake"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, settings = self.layout, context.scene.ltsh
        column = layout.column()
        toggles(column, context, 4).prop(settings, "bake_passes")
        split_names(layout, context)
        column = layout.column()
        column.prop(settings, "bake_size")
        column.prop(settings, "anti_aliasing")
        column.prop(settings, "bake_margin")
        column.prop(settings, "bake_view")
        ob = context.object
        if ob is not None and ob.type == "MESH":
            column.prop_search(settings, "bake_uv_map", ob.data, "uv_layers", icon="GROUP_UVS")
        column.prop(settings, "bake_error")
        draw_shadows(layout, settings)
        if operators.running_job() is None:
            ready = draw_problems(layout, context, "bake")
            count = len(preflight.bake_objects(context)[0])
            if count:
                text = translated("1 object") if count == 1 else translated("{} objects").format(count)
                gray(layout).label(text=text, icon="OBJECT_DATA", translate=False)
            draw_button(layout, context, "ltsh.bake", "RENDER_RESULT", ready)


class _Entries:
    """A list with a sign for each entry, and why where it is not exact."""

    bl_options = {"DEFAULT_CLOSED"}
    key = ""

    def draw_header_preset(self, context):
        entries = getattr(overview(context.scene), self.key)
        noted = sum(entry.state != EXACT for entry in entries)
        gray(self.layout).label(text=str(len(entries)), translate=False)
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
            draw_right(row, translated(entry.kind.capitalize()))
            for note in entry.notes:
                draw_text(gray(column), context, note, "BLANK1")
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
        split_names(layout, context)
        layout.prop(context.scene.ltsh, "output_folder")
        draw_text(gray(layout), context, str(output_folder(context.scene, "").parent))


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
    if region_width(context) >= TABLE_PIXELS:
        _draw_table(column, rows)
    else:
        for label, row in rows:
            values = (_figure(key, row.get(key), "\u00a0%") for key, _ in FIGURES)
            named = (f"{name}\u00a0{value}" for name, value in zip(("L2", "bias", "FLIP"), values, strict=True))
            draw_text(column, context, f"{label}: {', '.join(named)}")
    if figures.get("noise") is not None:
        draw_text(gray(column), context, _noise_text(group, figures))


def _draw_table(layout, rows) -> None:
    split = layout.split(factor=0.34)
    column = split.column(align=True)
    gray(column).label(text="vs Cycles")
    for label, _ in rows:
        column.label(text=label, translate=False)
    side = split.row()
    for key, title in FIGURES:
        column = side.column(align=True)
        column.alignment = "RIGHT"
        draw_right(column, title)
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
            draw_text(layout, context, "None yet: shade, compare or bake first", "INFO")
            return
        if result.partial:
            draw_text(layout.box(), context, result.partial, "ERROR")
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
                draw_text(body, context, warning, "DOT")


class LTSH_PT_IMAGE_results(_Results, bpy.types.Panel):
    """Two pictures of the results and how they differ"""

    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "UI"
    bl_category = "LTSH"
    bl_label = "Comparison"

    def draw_choice(self, context, result):
        layout, settings = self.layout, context.scene.ltsh
        if not comparison.is_viewer(context.space_data.image):
            layout.operator("ltsh.open_results", text="Show Comparison", icon="IMAGE_DATA")
        column = layout.column()
        toggles(column, context, 5).prop(settings, "mode", expand=True)
        if settings.mode == "MIX":
            column.prop(context.scene.view_settings, "exposure", text="Exposure of the Scene")
            return
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


CLASSES = (
    *in_both_places(_Main, "main"),
    *in_both_places(_Bake, "bake", "main"),
    *in_both_places(_Lights, "lights", "main"),
    *in_both_places(_Materials, "materials", "main"),
    *in_both_places(_Output, "output", "main"),
    *in_both_places(_Results, "results", "main"),
    LTSH_PT_IMAGE_results,
)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
