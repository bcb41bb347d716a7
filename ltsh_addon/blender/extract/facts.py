"""What a job needs to know of a scene before it is cut into tasks (runs in the child)."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..render_settings import choose_view_layer, go_to_frame
from .bake import chosen_objects, tiles_without_modifiers
from .pixels import open_scene


def answer(job: dict, progress) -> dict:
    """Do the `job` of `client.scene_facts` in the child; the manifest."""
    progress("open scene", 0.0)
    open_scene(Path(job["scene"]), [], job["scripts"])
    scene, facts, tiles = bpy.context.scene, [], {}
    view_layer = choose_view_layer(scene, [])
    own = scene.frame_current
    for frame in job["frames"]:
        go_to_frame(scene, own if frame is None else frame)
        chosen = [] if job["objects"] is None else chosen_objects(scene, view_layer, job["objects"])
        name = scene.camera.name if scene.camera is not None else None
        for ob in chosen:
            if ob.name not in tiles:
                tiles[ob.name] = tiles_without_modifiers(ob, job["uv"])
        found = {"frame": scene.frame_current, "camera": name, "objects": [ob.name for ob in chosen]}
        facts.append({**found, "tiles": {ob.name: tiles[ob.name] for ob in chosen if len(tiles[ob.name]) > 1}})
    return {"facts": facts}
