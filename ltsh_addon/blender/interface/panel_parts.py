"""Pieces that several panels draw: wrapped text, problems with their fixes, the progress of a job."""

from __future__ import annotations

import textwrap

import bpy
from bpy.app.translations import pgettext_iface as translated

from . import job_stages, operators, preflight
from .job import clock

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
    _draw_right(row, clock(job.seconds()))
    column.progress(factor=job.plan.share(), text=job_stages.progress_text(job))
    row = column.row()
    row.active = False
    row.label(text=job_stages.stage_title(job), translate=False)
    _draw_right(row, f"{job.plan.number} / {job.plan.count}")
    column.operator("ltsh.cancel", text="Cancel", icon="X")
    return True


def _draw_right(row, text: str) -> None:
    side = row.row()
    side.alignment, side.active = "RIGHT", False
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
