"""Panels of the 3D viewport's sidebar, of the render properties and of the image editor."""

import textwrap

import bpy
from bpy.app.translations import pgettext_iface as translated

from ...imaging import on_screen
from . import comparison, operators, preflight, results
from .job import clock, output_folder, progress_text, stage_title
from .operators import COMMANDS
from .preflight import APPROXIMATED, EXACT, LEFT_OUT, overview
from .preview import ENGINE, active_light, environment_of, is_previewing, lights_of, looks_through, view_of

# Widths in pixels at interface scale 1.
LETTER_PIXELS = 6.6  # mean width of a letter of Blender's interface
MARGIN_PIXELS = 70.0  # icon, scroll bar and borders
BUTTON_PIXELS = 50.0  # a button beside text, without its label
TEXT_PIXELS = 110.0  # the least width of text beside a button
TOGGLE_PIXELS, SHORT_PIXELS = 85.0, 62.0  # a button, and one with a short name
SPLIT_PIXELS = 250.0  # the least width of a region that shows names of properties beside their fields


def draw_text(layout, context, text: str, icon: str = "NONE", reserved: float = 0.0) -> None:
    """Draw `text`, wrapped to the width of the region; `reserved` pixels are left for something beside it."""
    width = region_width(context) - MARGIN_PIXELS - reserved
    column = layout.column(align=True)
    column.scale_y = 0.85
    lines = textwrap.wrap(text, max(16, int(width / LETTER_PIXELS))) or [""]
    column.label(text=lines[0], icon=icon, translate=False)
    for line in lines[1:]:
        column.label(text=line, icon="BLANK1" if icon != "NONE" else "NONE", translate=False)


def draw_problems(layout, context, command: str) -> bool:
    """Draw the problems of `command`, each with its fix; True if none of them blocks it."""
    problems = preflight.problems(context, command)
    if problems:
        box = layout.box()
        for problem in problems:
            _draw_problem(box, context, problem)
    return not any(problem.blocks for problem in problems)


def _draw_problem(layout, context, problem) -> None:
    """Draw the text of a problem, and its button beside it if there is room for both, else below."""
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


def toggles(layout, context, count: int, width: float = TOGGLE_PIXELS):
    """A layout for `count` buttons of `width` pixels: one row if they fit, else two columns."""
    fits = region_width(context) >= width * count
    return layout.grid_flow(row_major=True, columns=count if fits else 2, even_columns=True, align=True)


def split_names(layout, context) -> None:
    """Show names of properties beside their fields, as in Blender's panels, or inside if the region is too narrow."""
    layout.use_property_split = region_width(context) >= SPLIT_PIXELS
    layout.use_property_decorate = False


def region_width(context) -> float:
    """Width of the region that is drawn, in pixels at interface scale 1."""
    return context.region.width / context.preferences.system.ui_scale


def draw_job(layout, *commands: str) -> bool:
    """Draw the progress of the job that runs and its Cancel button, if it is one of `commands`; else return False.

    It takes two rows, as high as the buttons that it replaces, so that nothing else in the panel moves.
    """
    job = operators.running_job()
    if job is None or job.command not in commands:
        return False
    row = layout.row(align=True)
    row.scale_y = LARGE
    row.progress(factor=job.plan.share(), text=progress_text(job.plan, job.seconds()))
    row.operator("ltsh.cancel", text="", icon="X")
    row = layout.row()
    row.label(text=stage_title(job.stage), translate=False)
    draw_right(row, clock(job.seconds()))
    return True


def draw_share(layout, *commands: str) -> None:
    """Draw the percentage of a job that is done into the header of its panel, which may be closed."""
    job = operators.running_job()
    if job is not None and job.command in commands:
        gray(layout).label(text=f"{100.0 * job.plan.share():.0f} %", translate=False)


def gray(layout):
    """A gray row, for less important things."""
    row = layout.row()
    row.active = False
    return row


def draw_right(layout, text: str) -> None:
    """Draw gray text at the right end."""
    side = gray(layout)
    side.alignment = "RIGHT"
    side.label(text=text, translate=False)


def draw_button(layout, operator: str, icon: str, ready: bool, scale: float = 1.0) -> None:
    """Draw a button, gray while it cannot run."""
    row = layout.row()
    row.scale_y = scale
    row.enabled = ready and operators.running_job() is None
    row.operator(operator, icon=icon)


def in_both_places(panel: type, name: str, parent: str = "") -> tuple[type, type]:
    """The mixin `panel` as a class for the 3D viewport's sidebar and one for the render properties."""
    editors = {
        "VIEW3D": {"bl_space_type": "VIEW_3D", "bl_region_type": "UI", "bl_category": "LTSH"},
        "RENDER": {"bl_space_type": "PROPERTIES", "bl_region_type": "WINDOW", "bl_context": "render"},
    }
    classes = []
    for editor, values in editors.items():
        identifier = f"LTSH_PT_{editor}_{name}"
        family = {"bl_parent_id": f"LTSH_PT_{editor}_{parent}"} if parent else {}
        # Blender reads the docstring of a panel's own class.
        members = {**values, **family, "bl_idname": identifier, "__doc__": panel.__doc__}
        classes.append(type(identifier, (panel, bpy.types.Panel), members))
    return tuple(classes)


STATE_ICONS = {EXACT: "CHECKMARK", APPROXIMATED: "ERROR", LEFT_OUT: "CANCEL"}
ENTRIES_SHOWN = 24


LARGE, LARGEST = 1.4, 1.8  # heights of buttons


class _Main:
    bl_label = "LTSH"

    def draw_header_preset(self, context):
        layout = self.layout
        layout.emboss = "NONE"
        layout.popover(panel="LTSH_PT_presets", icon="PRESET", text="")
        layout.operator("ltsh.manual", text="", icon="QUESTION")

    def draw(self, context):
        layout, scene = self.layout, context.scene
        row = layout.row()
        row.scale_y = LARGEST
        if is_previewing(scene):
            row.operator("ltsh.preview", text="End Preview with LTSH", icon="LOOP_BACK", depress=True)
        else:
            row.operator("ltsh.preview", icon="SHADING_RENDERED")
        draw_view_settings(layout, context)


def draw_view_settings(layout, context) -> None:
    """Draw the technique, and with our engine what the view shows."""
    scene, view = context.scene, context.scene.ltsh_view
    column = layout.column()
    toggles(column, context, 4, SHORT_PIXELS).prop(view, "technique", expand=True)
    if scene.render.engine == ENGINE:
        toggles(column, context, 3).prop(view, "shown", expand=True)
        toggles(column, context, 3).prop(view, "mode", expand=True)
        if view.mode != "single":
            column.prop(view, "second_technique", text="")
        if view.mode == "split":
            column.prop(view, "split_position", slider=True)
        elif view.mode == "difference":
            column.prop(view, "difference_scale")
    row = toggles(layout, context, 3)
    row.prop(scene.ltsh, "shadows")
    if scene.render.engine == ENGINE:
        row.prop(view, "world")
        row.prop(view, "bounces")


class _Compare:
    bl_label = "Compare"

    def draw_header_preset(self, context):
        draw_share(self.layout, "compare", "shade")

    def draw(self, context):
        layout, settings = self.layout, context.scene.ltsh
        ready = draw_problems(layout, context, "compare")
        if not draw_job(layout, "compare", "shade"):
            draw_button(layout, "ltsh.compare", "MOD_MIRROR", ready, LARGE)
            draw_button(layout, "ltsh.shade", "RENDER_STILL", ready)
        header, body = layout.panel("ltsh_compare_settings", default_closed=True)
        header.label(text="Settings")
        if body is not None:
            toggles(body, context, 4).prop(settings, "techniques")
            split_names(body, context)
            column = body.column(align=True)
            column.prop(settings, "resolution_percentage", slider=True)
            draw_right(column, "{} × {} px".format(*preflight.picture_of(context.scene)))


class _Bake:
    bl_label = "Bake"
    bl_options = {"DEFAULT_CLOSED"}

    def draw_header_preset(self, context):
        draw_share(self.layout, "bake")

    def draw(self, context):
        layout = self.layout
        ready = draw_problems(layout, context, "bake")
        if sum(ob.type == "MESH" for ob in context.selected_objects) > 1:
            scene = context.scene
            layout.template_list("LTSH_UL_baked", "", scene, "objects", scene.ltsh, "bake_active", rows=3)
        count = len(preflight.bake_objects(context)[0])
        if count:
            text = translated("1 object") if count == 1 else translated("{} objects").format(count)
            gray(layout).label(text=text, icon="OBJECT_DATA", translate=False)
        if not draw_job(layout, "bake"):
            draw_button(layout, "ltsh.bake", "RENDER_RESULT", ready, LARGE)
            row = layout.row(align=True)
            row.operator("ltsh.apply_bake", icon="MATERIAL")
            row.operator("ltsh.restore_materials", text="", icon="LOOP_BACK")
        header, body = layout.panel("ltsh_bake_settings", default_closed=True)
        header.label(text="Settings")
        if body is not None:
            self.draw_settings(body, context)

    def draw_settings(self, layout, context):
        """Draw the settings of bakes."""
        settings, ob = context.scene.ltsh, context.object
        toggles(layout, context, 4).prop(settings, "bake_passes")
        split_names(layout, context)
        column = layout.column()
        for name in ("bake_size", "bake_atlas", "bake_margin", "bake_view"):
            column.prop(settings, name)
        if ob is not None and ob.type == "MESH" and not settings.bake_atlas:
            column.prop_search(settings, "bake_uv_map", ob.data, "uv_layers", icon="GROUP_UVS")
        column.prop(settings, "bake_bounces")
        if settings.bake_bounces:
            column.prop(settings, "bake_rest_samples")
        column.prop(settings, "bake_per_light")
        column.prop(settings, "bake_error")
        column.prop(settings, "bake_changed")


# Settings of the view layer, and their short names.
DATA_PASSES = (("z", "Depth"), ("normal", "Normal"), ("position", "Position"),
               ("object_index", "Object"), ("material_index", "Material"))  # fmt: skip


class _Final:
    """F12 with our engine."""

    bl_label = "Final Render"

    @classmethod
    def poll(cls, context):
        return context.scene.render.engine == ENGINE

    def draw(self, context):
        layout, view, layer = self.layout, context.scene.ltsh_view, context.view_layer
        layout.prop(view, "complete")
        if view.complete:
            text = "{} Cycles Samples, see Quality and Output"
            draw_text(gray(layout), context, translated(text).format(context.scene.ltsh.cycles_samples), "INFO")
        else:
            layout.prop(view, "technique_passes")
        grid = toggles(layout, context, 3)
        for name, label in DATA_PASSES:
            grid.prop(layer, f"use_pass_{name}", text=label, toggle=True)


class _Quality:
    """What previews at rest, pictures and bakes share."""

    bl_label = "Quality and Output"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, settings = self.layout, context.scene.ltsh
        split_names(layout, context)
        column = layout.column(align=True)
        column.prop(settings, "anti_aliasing")
        column.prop(settings, "cycles_samples")
        row = column.row(align=True)
        row.active = settings.shadows
        row.prop(settings, "shadow_rays")
        layout.prop(settings, "output_folder")
        draw_text(gray(layout), context, str(output_folder(context.scene, "").parent))


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
        # Entries with notes come first.
        for entry in sorted(entries, key=lambda entry: entry.state == EXACT)[:ENTRIES_SHOWN]:
            row = column.row()
            row.label(text=entry.name, icon=STATE_ICONS[entry.state], translate=False)
            draw_right(row, translated(entry.kind.capitalize()))
            for note in entry.notes:
                draw_text(gray(column), context, note, "BLANK1")
        if len(entries) > ENTRIES_SHOWN:
            layout.label(text=translated("and {} more").format(len(entries) - ENTRIES_SHOWN), translate=False)


LIGHT_ICONS = {"AREA": "LIGHT_AREA", "POINT": "LIGHT_POINT", "SPOT": "LIGHT_SPOT", "SUN": "LIGHT_SUN"}
# Widths in a row of the list, in Blender's interface units.
NAME_UNITS, POWER_UNITS, COLOR_UNITS = 4.2, 3.8, 1.2
LIGHT_ROWS = 4


class LTSH_UL_lights(bpy.types.UIList):
    """Lights with what an artist changes most."""

    def filter_items(self, context, data, name):
        """Lights alone, those whose names have what is searched for."""
        objects, wanted = getattr(data, name), self.filter_name.lower()
        shown = [ob.type == "LIGHT" and (wanted in ob.name.lower()) != self.use_filter_invert for ob in objects]
        order = bpy.types.UI_UL_list.sort_items_by_name(objects) if self.use_filter_sort_alpha else []
        return [self.bitflag_filter_item * is_shown for is_shown in shown], order

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flag=0):
        """Name, power, color, solo and mute of a light."""
        settings, light = item.ltsh_light, item.data
        row = layout.row(align=True)
        name = row.row()
        name.active, name.ui_units_x = not item.hide_render, NAME_UNITS
        name.prop(item, "name", text="", emboss=False, icon=_light_icon(context, item))
        # In narrow regions the name needs the room of the power, since it tells lights apart.
        fields = (("energy", POWER_UNITS), ("color", COLOR_UNITS))
        for key, units in fields if region_width(context) >= SPLIT_PIXELS else fields[1:]:
            field = row.row()
            field.ui_units_x = units
            field.prop(light, key, text="")
        row.prop(settings, "solo", text="", icon="SOLO_ON" if settings.solo else "SOLO_OFF", emboss=False)
        row.prop(settings, "mute", text="", icon="HIDE_ON" if settings.mute else "HIDE_OFF", emboss=False)


def _light_icon(context, ob) -> str:
    """The icon of a light: its type, or a sign that it is not exact."""
    entry = _entry_of(context, ob)
    noted = entry is not None and entry.state != EXACT
    return STATE_ICONS[entry.state] if noted else LIGHT_ICONS[ob.data.type]


def _entry_of(context, ob):
    """The entry of the light `ob` in the overview; None if it is hidden in renders."""
    return next((entry for entry in overview(context.scene).lights if entry.name == ob.name), None)


# Labels of Blender's own panel.
SHORT_NAMES = {"shadow_soft_size": "Radius", "spot_size": "Spot Size", "spot_blend": "Blend"}


def light_properties(light) -> dict[str, str]:
    """The properties of a light of this type and shape, with their labels."""
    names, labels = ["energy", "exposure", "color"], dict(SHORT_NAMES)
    if light.type == "AREA":
        names += ["shape", "size"]
        if light.shape in ("RECTANGLE", "ELLIPSE"):
            names.append("size_y")
            labels["size"] = "Size X"
    elif light.type == "SUN":
        names.append("angle")
    else:
        names += ["shadow_soft_size", *(["spot_size", "spot_blend"] if light.type == "SPOT" else [])]
    known = light.bl_rna.properties
    return {name: labels.get(name, known[name].name) for name in names if name in known}


class _Lights(_Entries):
    bl_label = "Lights"
    bl_options = set()
    key = "lights"

    def draw(self, context):
        layout, scene = self.layout, context.scene
        layout.template_list("LTSH_UL_lights", "", scene, "objects", scene.ltsh, "active_light", rows=LIGHT_ROWS)
        row, ob = layout.row(align=True), active_light(context)
        is_pressed = looks_through(view_of(context)) is not None
        row.operator("ltsh.look_through_light", text="", icon="OUTLINER_OB_CAMERA", depress=is_pressed)
        for gesture, icon in (("highlight", "LIGHT_POINT"), ("shadow", "OVERLAY"), ("brightness", "LIGHT_SUN")):
            row.operator(f"ltsh.drag_{gesture}", text="", icon=icon)
        row.operator("ltsh.add_light", icon="ADD")
        row.operator("ltsh.duplicate_light", text="", icon="DUPLICATE")
        row.operator("ltsh.delete_light", text="", icon="TRASH")
        if ob is None:
            gray(layout).label(text="Click a light to select it" if lights_of(scene) else "No light in the scene")
        entry = None if ob is None else _entry_of(context, ob)
        for note in entry.notes if entry is not None else ():
            draw_text(layout, context, note, STATE_ICONS[entry.state])
        split_names(layout, context)
        column = layout.column()
        for name, label in (light_properties(ob.data) if ob is not None else {}).items():
            column.prop(ob.data, name, text=label)
        background, texture = environment_of(scene.world)
        if texture is None:
            layout.operator("ltsh.open_environment", icon="WORLD")
        else:
            layout.template_ID(texture, "image", open="image.open")
            layout.prop(background.inputs["Strength"], "default_value", text="Strength")


class _Materials(_Entries):
    bl_label = "Materials"
    key = "materials"


FIGURES = (("relative_l2", "L2 %"), ("bias", "Bias %"), ("flip", "FLIP"))
TABLE_PIXELS = 270.0  # narrower regions show a sentence for each technique


def draw_figures(layout, context, result, choice) -> None:
    """Draw the errors of the shown pass against Cycles, a row for each technique."""
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
    """The noise of Cycles, and the errors without it."""
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
            cell.enabled = results.result_in(str(operators.last_folder(scene, command))) is not None
            shown = result is not None and result.command == command
            cell.operator("ltsh.show_results", text=title, depress=shown).command = command
        if result is None:
            draw_text(layout, context, "None yet: shade, compare or bake first", "INFO")
            return
        if results.lacks(result):
            draw_text(layout.box(), context, results.lacks(result), "INFO")
        if len(result.groups) > 1:
            layout.prop_search(scene.ltsh, "group", scene.ltsh, "groups", icon="TEXTURE")
        self.draw_choice(context, result)
        draw_figures(layout, context, result, results.choice_of(scene.ltsh, result))
        self.draw_warnings(context, result)
        if context.space_data.type != "IMAGE_EDITOR":
            layout.operator("ltsh.open_results", icon="IMAGE_DATA")
        folder = layout.operator("wm.path_open", text="Open Folder of Files", icon="FILE_FOLDER")
        folder.filepath = str(result.folder.parent)

    def draw_choice(self, context, result):
        """Draw the choice of pictures; only the Image Editor, which shows them, has it."""

    def draw_warnings(self, context, result):
        warnings = [*result.report.get("problems", ()), *result.report["warnings"]]
        if not warnings:
            return
        header, body = self.layout.panel("ltsh_warnings", default_closed=True)
        header.label(text=f"Warnings ({len(warnings)})", icon="ERROR", translate=False)
        if body is not None:
            for warning in on_screen(warnings):
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
        choice = results.choice_of(settings, result)
        group = result.groups[choice.group]
        modes = toggles(column, context, 5)
        for item in settings.bl_rna.properties["mode"].enum_items:
            row = modes.row(align=True)
            row.enabled = len(group["names"]) > 1 or item.identifier in results.OF_ONE_PICTURE
            row.enabled &= item.identifier != "MIX" or results.has_mixer(context.scene, result)
            _draw_choices(row, settings, choice, "mode", (item.identifier,))
        view = context.scene.view_settings
        if choice.mode == "MIX":
            column.prop(view, "exposure", text="Exposure of the Scene")
            return
        for key, label in (("first", "A"), ("second", "B"))[: 1 if choice.mode == "A" else 2]:
            split = column.split(factor=0.1)
            split.label(text=label, translate=False)
            _draw_choices(split.row(align=True), settings, choice, key, group["names"])
        _draw_choices(column.row(align=True), settings, choice, "pass_name", group["passes"])
        if choice.mode == "WIPE":
            row = column.row(align=True)
            row.prop(settings, "split", slider=True)
            row.operator("ltsh.swap", text="", icon="ARROW_LEFTRIGHT")
        elif choice.mode == "ERROR":
            column.prop(settings, "error_scale", text="Scale (0: Automatic)")
        column.prop(view, "exposure", text="Exposure of the Scene")


def _draw_choices(row, settings, choice, key: str, names) -> None:
    """Draw a button for each name that the property `key` offers; pressed is the one of `choice`, which is shown."""
    items = settings.bl_rna.properties[key].enum_items
    for item in (items[name] for name in names if name in items):
        pressed = getattr(choice, key) == item.identifier
        button = row.operator("ltsh.choose", text=item.name, icon=item.icon, depress=pressed)
        button.key, button.value = key, item.identifier


CLASSES = (
    LTSH_UL_lights,
    *in_both_places(_Main, "main"),
    *in_both_places(_Lights, "lights", "main"),
    *in_both_places(_Compare, "compare", "main"),
    *in_both_places(_Bake, "bake", "main"),
    *in_both_places(_Results, "results", "main"),
    *in_both_places(_Final, "final", "main"),
    *in_both_places(_Quality, "quality", "main"),
    *in_both_places(_Materials, "materials", "main"),
    LTSH_PT_IMAGE_results,
)
