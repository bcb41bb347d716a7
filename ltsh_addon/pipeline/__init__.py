"""A .blend in, files out: the functions for scripts, which do the same as the commands of these names.

    from pathlib import Path
    from ltsh_addon.pipeline import CompareOptions, compare_scene

    report = compare_scene(CompareOptions(Path("room.blend"), Path("out/room")))

Blender runs in a process of its own, so nothing here imports bpy.
"""

from .bake import bake_scene
from .options import BakeOptions, CompareOptions, PictureOptions, RenderOptions
from .picture import compare_scene, shade_scene
from .render import render_scene

__all__ = [
    "BakeOptions",
    "CompareOptions",
    "PictureOptions",
    "RenderOptions",
    "bake_scene",
    "compare_scene",
    "render_scene",
    "shade_scene",
]
