"""The button "Preview with LTSH": shows the scene with our engine and gives back the artist's afterwards.

Files are saved with the artist's engine, so that they render elsewhere as they did before.
"""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import engine_snapshot
from .view_properties import ENGINE


def is_previewing(scene) -> bool:
    """True where the engine of `scene` is lent."""
    return scene.render.engine == ENGINE and bool(scene.ltsh_view.artist_engine)


class LTSH_OT_preview(bpy.types.Operator):
    """Show the scene in this view with LTSH; once more: give the former engine and shading back"""

    bl_idname = "ltsh.preview"
    bl_label = "Preview with LTSH"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return context.scene is not None

    def execute(self, context):
        scene = context.scene
        settings = scene.ltsh_view
        shading = _shading(context)
        if is_previewing(scene):
            stop_preview(scene)
            if shading is not None and settings.artist_shading:
                shading.type = settings.artist_shading
            return {"FINISHED"}
        if scene.render.engine != ENGINE:
            settings.artist_engine = scene.render.engine
            scene.render.engine = ENGINE
        if shading is not None:
            settings.artist_shading = shading.type
            shading.type = "RENDERED"
        return {"FINISHED"}


def _shading(context):
    """Shading settings of the 3D view of `context`, or of the window's first one."""
    space = context.space_data
    if space is None or space.type != "VIEW_3D":
        screen = context.screen
        areas = screen.areas if screen is not None else ()
        space = next((area.spaces.active for area in areas if area.type == "VIEW_3D"), None)
    return None if space is None else space.shading


def stop_preview(scene) -> None:
    """Give `scene` the artist's engine back."""
    wanted = scene.ltsh_view.artist_engine
    scene.ltsh_view.artist_engine = ""
    try:
        scene.render.engine = wanted
    except TypeError:
        # The engine that was there is not registered any more.
        scene.render.engine = "CYCLES"


_saved: list[str] = []


@persistent
def _before_saving(*_) -> None:
    # A copy for a render of our own keeps the engine: the render has begun.
    if engine_snapshot.is_saving():
        return
    _saved.clear()
    for scene in bpy.data.scenes:
        if is_previewing(scene):
            _saved.append(scene.name)
            scene.render.engine = scene.ltsh_view.artist_engine


@persistent
def _after_saving(*_) -> None:
    for name in _saved:
        if name in bpy.data.scenes:
            bpy.data.scenes[name].render.engine = ENGINE
    _saved.clear()


@persistent
def _after_loading(*_) -> None:
    """Files that were saved during a preview have the artist's engine, and no preview."""
    for scene in bpy.data.scenes:
        if scene.render.engine != ENGINE:
            scene.ltsh_view.artist_engine = ""
    _subscribe()


def _engine_changed() -> None:
    """Whoever chooses another engine by hand has ended the preview; Blender calls this when all that is done."""
    for scene in bpy.data.scenes:
        if scene.render.engine != ENGINE and scene.ltsh_view.artist_engine:
            scene.ltsh_view.artist_engine = ""


_subscriber = object()


def _subscribe() -> None:
    """Blender forgets who wants to hear of changes when it opens a file."""
    bpy.msgbus.clear_by_owner(_subscriber)
    bpy.msgbus.subscribe_rna(
        key=(bpy.types.RenderSettings, "engine"), owner=_subscriber, args=(), notify=_engine_changed
    )


HANDLERS = (
    ("save_pre", _before_saving),
    ("save_post", _after_saving),
    ("save_post_fail", _after_saving),
    ("load_post", _after_loading),
)


def register() -> None:
    """Add the operator and the handlers."""
    bpy.utils.register_class(LTSH_OT_preview)
    for name, function in HANDLERS:
        getattr(bpy.app.handlers, name).append(function)
    _subscribe()


def unregister() -> None:
    """Give all scenes their engines back; remove operator and handlers."""
    bpy.msgbus.clear_by_owner(_subscriber)
    for scene in bpy.data.scenes:
        if is_previewing(scene):
            stop_preview(scene)
    for name, function in HANDLERS:
        functions = getattr(bpy.app.handlers, name)
        if function in functions:
            functions.remove(function)
    bpy.utils.unregister_class(LTSH_OT_preview)
