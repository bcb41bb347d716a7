"""Operators for looking at results, keeping them, and for help."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ...files import replacing
from ...scene import error_line, listed
from ..extract.apply import restore_materials, show_texture, shows_texture
from . import comparison, results
from .job import output_folder

MANUAL = Path(__file__).resolve().parents[3] / "docs" / "manual.md"
# Text editors show no pictures.
PICTURE_LINE = re.compile(r"^!\[.*\)\n\n?", re.MULTILINE)
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
    """Show the pictures in an Image Editor that is open, or in a window of their own"""

    bl_idname = "ltsh.open_results"
    bl_label = "Open in Image Editor"

    def execute(self, context):
        comparison.refresh(context.scene)
        if comparison.open_editor(context, context.scene):
            return {"FINISHED"}
        self.report({"ERROR"}, "No window could be opened: leave full screen, or find the pictures in the image list")
        return {"CANCELLED"}


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


class LTSH_OT_apply_bake(bpy.types.Operator):
    """Let the objects of the last bake show their textures: they get copies of their materials"""

    bl_idname = "ltsh.apply_bake"
    bl_label = "Apply Bake"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if context.scene is None or last_bake(context.scene) is None:
            cls.poll_message_set("There is no bake yet: bake first")
            return False
        return context.mode == "OBJECT"

    def execute(self, context):
        result, gone, shown = last_bake(context.scene), [], []
        for record in result.report["objects"]:
            ob = context.scene.objects.get(record["name"])
            if ob is None:
                gone.append(record["name"])
                continue
            try:
                show_texture(ob, baked_texture(result, record))
            except (OSError, RuntimeError, KeyError) as error:
                self.report({"ERROR"}, f"Object {ob.name!r} cannot show its texture ({error_line(error)}): bake again")
                continue
            shown.append(ob.name)
        if gone:
            self.report({"WARNING"}, f"Not in the scene any more: {listed(map(repr, gone))}")
        if not shown:
            return {"CANCELLED"}
        self.report({"INFO"}, f"Showing baked textures: {listed(shown)}")
        return {"FINISHED"}


class LTSH_OT_restore_materials(bpy.types.Operator):
    """Give objects that show baked textures their materials back"""

    bl_idname = "ltsh.restore_materials"
    bl_label = "Restore Materials"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if context.scene is None or not any(shows_texture(ob) for ob in context.scene.objects):
            cls.poll_message_set("No object shows a baked texture")
            return False
        return context.mode == "OBJECT"

    def execute(self, context):
        restored = [ob.name for ob in context.scene.objects if restore_materials(ob)]
        self.report({"INFO"}, f"Materials are back: {listed(restored)}")
        return {"FINISHED"}


def last_bake(scene):
    """The results of the last bake of `scene`; None where there is none."""
    result = results.result_in(str(output_folder(scene, "bake") / "images"))
    return result if result is not None and result.command == "bake" and result.report["objects"] else None


def baked_texture(result, record: dict) -> dict:
    """What `show_texture` takes: all baked light of the object of `record`, or its first pass. Copies the pictures to
    files of their own, which stay when the next bake replaces the pictures. Raises OSError."""
    files = []
    for number, tile in record["tiles"].items():
        stem = Path(tile["file"]).stem
        group = result.groups[stem]
        layer = f"{group['names'][0]}.{'combined' if 'combined' in group['passes'] else group['passes'][0]}"
        source = result.folder / group["files"][layer]
        name = f"{stem}.{layer}" if len(record["tiles"]) == 1 else f"{stem.rpartition('.')[0]}.{layer}.{number}"
        path = result.folder.parent / f"{name}.exr"
        with replacing(path) as temporary:
            shutil.copyfile(source, temporary)
        files.append({"path": str(path), "tile": int(number)})
    return {"name": f"{record['name']} {layer}", "uv": record["uv"], "files": files}


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
    LTSH_OT_apply_bake,
    LTSH_OT_restore_materials,
    LTSH_OT_manual,
)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
