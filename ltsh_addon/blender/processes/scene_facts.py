"""What a .blend says about the tasks in it: frame, camera and objects to bake. `answer` runs in the child."""

from __future__ import annotations

from pathlib import Path

from . import child


def ask(
    scene: Path, frames, objects, uv=None, *, scripts: bool = False, progress: child.Progress | None = None
) -> list[dict]:
    """For each of `frames` (None: the file's own) "frame", "camera" (name or None), names of "objects" to bake, and
    "tiles", the UDIM tiles by name of those of which each can be a task of its own.

    `objects` are names, "selected", "all", or None for none; `uv` is a UV map, None for the active ones;
    `scripts` of the file run only if asked for. Raises as `child.extract` does.
    """
    scene = Path(scene).absolute()
    child.check_readable(scene)
    job = {"task": "facts", "scene": str(scene), "frames": list(frames), "objects": objects, "uv": uv}
    job["scripts"] = scripts
    with child.temporary_folder() as folder:
        return child.run_child(job, folder, progress)["facts"]


def answer(job: dict, progress) -> dict:
    """Do the `job` of `ask` in the child; the manifest."""
    import bpy

    from ..pixels import cameras, extraction, render_settings
    from ..texels import texel_bake

    progress("open scene", 0.0)
    extraction.open_scene(Path(job["scene"]), [], job["scripts"])
    scene, facts, tiles = bpy.context.scene, [], {}
    view_layer = render_settings.choose_view_layer(scene, [])
    own = scene.frame_current
    for frame in job["frames"]:
        cameras.go_to_frame(scene, own if frame is None else frame)
        chosen = [] if job["objects"] is None else texel_bake.chosen_objects(scene, view_layer, job["objects"])
        name = scene.camera.name if scene.camera is not None else None
        for ob in chosen:
            if ob.name not in tiles:
                tiles[ob.name] = texel_bake.tiles_without_modifiers(ob, job["uv"])
        found = {"frame": scene.frame_current, "camera": name, "objects": [ob.name for ob in chosen]}
        facts.append({**found, "tiles": {ob.name: tiles[ob.name] for ob in chosen if len(tiles[ob.name]) > 1}})
    return {"facts": facts}
