"""Operators for looking at results, keeping them, and for help."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ...files import replacing
from . import comparison, results
from .job import output_folder

MANUAL = Path(__file__).resolve().parents[3] / "docs" / "manual.md"
# Text editors show no pictures.
PICTURE_LINE = re.compile(r"^!\[.*\)\n\n?", re.MULTILINE)
ARRANGE_SECONDS, ARRANGE_TRIES = 0.2, 50
COMMANDS = (
    ("shade", "Shade", "What Shade Camera View left last"),
    ("compare", "Compare", "What Compare with Cycles left last"),
    ("bake", "Bake", "What Bake Selected left last"),
)


class _NeedsResults:
    @classmethod
    def poll(cls, context):
        if context.scene is None or results.result_of(context.scene) is None:
            cls.poll_message_set("There are no results yet: shade, compare or bake first")
            return False
        return True


class LTSH_OT_open_results(_NeedsResults, bpy.types.Operator):
    """Show the pictures in an Image Editor; where none is free, half of the largest area becomes one"""

    bl_idname = "ltsh.open_results"
    bl_label = "Open in Image Editor"

    def execute(self, context):
        comparison.refresh(context.scene)
        if comparison.put_in_editor(context, context.scene):
            return {"FINISHED"}
        if context.window is None:
            self.report({"ERROR"}, "There is no window: pictures are in the image list")
            return {"CANCELLED"}
        screen = context.window.screen
        known = set(screen.areas)
        largest = max(screen.areas, key=lambda area: area.width * area.height)
        with context.temp_override(area=largest, region=largest.regions[-1]):
            if "FINISHED" not in bpy.ops.screen.area_split(direction="VERTICAL", factor=0.5):
                self.report({"ERROR"}, "The area cannot be split: leave full screen first")
                return {"CANCELLED"}
        area = next(area for area in screen.areas if area not in known)
        area.type = "IMAGE_EDITOR"
        area.spaces.active.image = comparison.viewer_image(context.scene)
        area.spaces.active.show_region_ui = True
        window = context.window
        # Blender knows the size and the tabs of the new area after it has drawn it.
        tries = iter(range(ARRANGE_TRIES))
        bpy.app.timers.register(lambda: _arrange(window, area, next(tries, None)), first_interval=ARRANGE_SECONDS)
        return {"FINISHED"}


def _arrange(window, area, attempt: int | None) -> float | None:
    """Fit the picture into its new area and open our tab; seconds until the next attempt where it is not drawn."""
    try:
        regions = {region.type: region for region in area.regions}
        regions["UI"].active_panel_category = "LTSH"
        with bpy.context.temp_override(window=window, area=area, region=regions["WINDOW"]):
            bpy.ops.image.view_all(fit_view=True)
    except TypeError:
        return None if attempt is None else ARRANGE_SECONDS
    except (ReferenceError, KeyError, RuntimeError):
        pass  # the area has been closed meanwhile, or shows something else
    return None


class LTSH_OT_show_results(bpy.types.Operator):
    """Look at what this command left last"""

    bl_idname = "ltsh.show_results"
    bl_label = "Show Results"
    bl_options = {"UNDO"}

    command: EnumProperty(name="Command", description="Whose results", items=COMMANDS)

    def execute(self, context):
        folder = output_folder(context.scene, self.command) / "images"
        if results.result_in(str(folder)) is None:
            self.report({"ERROR"}, f"{folder} holds no results: run the command first")
            return {"CANCELLED"}
        results.show(context.scene, folder)
        comparison.refresh(context.scene)
        comparison.put_in_editor(context, context.scene)
        return {"FINISHED"}


class LTSH_OT_swap(_NeedsResults, bpy.types.Operator):
    """Exchange the two pictures"""

    bl_idname = "ltsh.swap"
    bl_label = "Swap A and B"
    bl_options = {"UNDO"}

    def execute(self, context):
        settings = context.scene.ltsh
        settings.first, settings.second = settings.second, settings.first
        return {"FINISHED"}


class LTSH_OT_save_exr(_NeedsResults, ExportHelper, bpy.types.Operator):
    """Save all layers of these results as one multi-layer OpenEXR file of 32-bit floats"""

    bl_idname = "ltsh.save_exr"
    bl_label = "Save As Multi-Layer EXR"

    filename_ext = ".exr"
    filter_glob: StringProperty(default="*.exr", options={"HIDDEN"})

    def invoke(self, context, event):
        self.filepath = self._source(context).name
        return super().invoke(context, event)

    def execute(self, context):
        source = self._source(context)
        try:
            if Path(self.filepath).exists() and Path(self.filepath).samefile(source):
                return {"FINISHED"}
            with replacing(self.filepath) as temporary:
                shutil.copyfile(source, temporary)
        except OSError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Saved {self.filepath}")
        return {"FINISHED"}

    def _source(self, context) -> Path:
        result = results.result_of(context.scene)
        group = result.groups[results.choice_of(context.scene.ltsh, result).group]
        return result.folder.parent / group["multilayer"]


class LTSH_OT_open_folder(_NeedsResults, bpy.types.Operator):
    """Open the folder of the results in the system's file browser"""

    bl_idname = "ltsh.open_folder"
    bl_label = "Open Folder"

    def execute(self, context):
        bpy.ops.wm.path_open(filepath=str(results.result_of(context.scene).folder.parent))
        return {"FINISHED"}


class LTSH_OT_manual(bpy.types.Operator):
    """Read the manual of LTSH, one page, in a new window"""

    bl_idname = "ltsh.manual"
    bl_label = "Manual"

    def execute(self, context):
        text = next((text for text in bpy.data.texts if text.name == "LTSH Manual"), None)
        if text is None:
            try:
                content = MANUAL.read_text(encoding="utf-8")
            except OSError as error:
                self.report({"ERROR"}, f"{MANUAL}: cannot be read: {error.strerror}; install the extension again")
                return {"CANCELLED"}
            text = bpy.data.texts.new("LTSH Manual")
            text.write(PICTURE_LINE.sub("", content))
            text.cursor_set(0)
        if context.window is None:
            return {"FINISHED"}
        bpy.ops.wm.window_new()
        area = context.window_manager.windows[-1].screen.areas[0]
        area.type = "TEXT_EDITOR"
        space = area.spaces.active
        space.text, space.top = text, 0
        space.show_word_wrap, space.show_line_numbers, space.show_syntax_highlight = True, False, False
        return {"FINISHED"}


CLASSES = (
    LTSH_OT_open_results,
    LTSH_OT_show_results,
    LTSH_OT_swap,
    LTSH_OT_save_exr,
    LTSH_OT_open_folder,
    LTSH_OT_manual,
)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
