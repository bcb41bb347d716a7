"""Presets of the settings: ours, and those that an artist adds."""

from __future__ import annotations

from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bl_ui.utils import PresetPanel

SUBFOLDER = "ltsh"
KEPT = ("techniques", "passes", "resolution_percentage", "anti_aliasing", "cycles_samples",
        "bake_size", "bake_margin", "bake_view", "bake_passes", "bake_error")  # fmt: skip


class LTSH_OT_add_preset(AddPresetBase, bpy.types.Operator):
    """Add or remove a preset of these settings"""

    bl_idname = "ltsh.add_preset"
    bl_label = "Add LTSH Preset"
    preset_menu = "LTSH_PT_presets"
    preset_subdir = SUBFOLDER
    preset_defines = ["settings = bpy.context.scene.ltsh"]
    preset_values = [f"settings.{name}" for name in KEPT]


class LTSH_PT_presets(PresetPanel, bpy.types.Panel):
    """Settings by name"""

    bl_label = "LTSH Presets"
    preset_subdir = SUBFOLDER
    preset_operator = "script.execute_preset"
    preset_add_operator = "ltsh.add_preset"


_register, _unregister = bpy.utils.register_classes_factory((LTSH_OT_add_preset, LTSH_PT_presets))
# Blender looks for a folder "presets" in it.
FOLDER = str(Path(__file__).parent)


def register():
    _register()
    bpy.utils.register_preset_path(FOLDER)


def unregister():
    bpy.utils.unregister_preset_path(FOLDER)
    _unregister()
