"""The button "Preview with LTSH": shows the scene with our engine, and restores the artist's engine afterwards.

Files are saved with the artist's engine and viewport shading, so that they open and render elsewhere as before.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
from bpy.app.handlers import persistent

from ..saving import keeps_engine

ENGINE = "LTSH"


def is_previewing(scene) -> bool:
    """True while `scene` has our engine for a preview."""
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
        if is_previewing(scene):
            stop_preview(scene)
            return {"FINISHED"}
        space = view_of(context)
        if scene.render.engine != ENGINE:
            if space is not None:
                _lent_views[space.as_pointer()] = _LentView(scene.session_uid, space.shading.type)
            scene.ltsh_view.artist_engine = scene.render.engine
            scene.render.engine = ENGINE
        if space is not None:
            space.shading.type = "RENDERED"
        return {"FINISHED"}


@dataclass
class _LentView:
    """A 3D view that shows a preview, or has shown one that undo or redo may bring back."""

    scene: int  # its session_uid
    former: str  # the shading to restore
    shows: bool = True  # the preview, now


# By the address of the view. Kept only in memory, since undo does not change views, and files are saved without
# previews.
_lent_views: dict[int, _LentView] = {}


def view_of(context):
    """The 3D view of `context`, or the window's first one."""
    space = context.space_data
    if space is None or space.type != "VIEW_3D":
        screen = context.screen or (context.window.screen if context.window else None)
        areas = screen.areas if screen is not None else ()
        space = next((area.spaces.active for area in areas if area.type == "VIEW_3D"), None)
    return space


def _views_of(scene) -> list[tuple]:
    """The 3D views that were lent to the preview of `scene`, each with its `_LentView`."""
    spaces = [space for screen in bpy.data.screens for area in screen.areas for space in area.spaces]
    views = [(space, _lent_views.get(space.as_pointer())) for space in spaces if space.type == "VIEW_3D"]
    return [(space, lent) for space, lent in views if lent is not None and lent.scene == scene.session_uid]


def _let_views_follow(scene) -> None:
    """Show the preview of `scene` in its views, or restore them, after its engine has changed.

    Views whose shading was changed by hand since then stay as they are.
    """
    shows = is_previewing(scene)
    for space, lent in _views_of(scene):
        if space.shading.type != ("RENDERED" if lent.shows else lent.former):
            del _lent_views[space.as_pointer()]
        elif shows != lent.shows:
            space.shading.type, lent.shows = "RENDERED" if shows else lent.former, shows


def stop_preview(scene) -> None:
    """End the preview of `scene`: restore the artist's engine and the shading of views."""
    wanted = scene.ltsh_view.artist_engine
    scene.ltsh_view.artist_engine = ""
    _let_views_follow(scene)
    try:
        scene.render.engine = wanted
    except TypeError:
        # The former engine is not registered any more.
        scene.render.engine = "CYCLES"


_saved: list[str] = []


@persistent
def _before_saving(*_) -> None:
    # A copy for a render of our own keeps the engine: the render has begun.
    if keeps_engine():
        return
    _saved[:] = [scene.name for scene in bpy.data.scenes if is_previewing(scene)]
    for scene in (bpy.data.scenes[name] for name in _saved):
        scene.render.engine = scene.ltsh_view.artist_engine
        _let_views_follow(scene)


@persistent
def _after_saving(*_) -> None:
    for scene in (bpy.data.scenes[name] for name in _saved if name in bpy.data.scenes):
        scene.render.engine = ENGINE
        _let_views_follow(scene)
    _saved.clear()


@persistent
def _after_undo(*_) -> None:
    """Undo and redo may end a preview or bring it back: they restore the engine, but not the views."""
    for scene in bpy.data.scenes:
        _let_views_follow(scene)


@persistent
def _after_loading(*_) -> None:
    """Files that were saved during a preview have the artist's engine, and no preview."""
    _lent_views.clear()
    for scene in bpy.data.scenes:
        if scene.render.engine != ENGINE:
            scene.ltsh_view.artist_engine = ""
    _subscribe()


def _engine_changed() -> None:
    """End the preview if another engine was chosen by hand; called by Blender after every change of the engine."""
    for scene in bpy.data.scenes:
        if scene.render.engine != ENGINE and scene.ltsh_view.artist_engine:
            scene.ltsh_view.artist_engine = ""
            for space, _ in _views_of(scene):
                del _lent_views[space.as_pointer()]


_subscriber = object()


def _subscribe() -> None:
    """Subscribe to changes of the engine; needed again after loading, when Blender drops subscriptions."""
    bpy.msgbus.clear_by_owner(_subscriber)
    bpy.msgbus.subscribe_rna(
        key=(bpy.types.RenderSettings, "engine"), owner=_subscriber, args=(), notify=_engine_changed
    )


HANDLERS = (
    ("save_pre", _before_saving),
    ("save_post", _after_saving),
    ("save_post_fail", _after_saving),
    ("undo_post", _after_undo),
    ("redo_post", _after_undo),
    ("load_post", _after_loading),
)
register = _subscribe


def unregister() -> None:
    """End all previews."""
    bpy.msgbus.clear_by_owner(_subscriber)
    for scene in bpy.data.scenes:
        if is_previewing(scene):
            stop_preview(scene)
