"""What a .blend says about the tasks in it: frame, camera and objects to bake. `answer` runs in the child."""

from __future__ import annotations

from pathlib import Path

from . import child


def ask(scene: Path, frames, objects, *, progress: child.Progress | None = None) -> list[dict]:
    """For each of `frames` (None: the file's own) "frame", "camera" (name or None) and names of "objects" to bake.

    `objects` are names, "selected", "all", or None for none. Raises as `child.extract` does.
    """
    scene = Path(scene).absolute()
    child.check_readable(scene)
    job = {"task": "facts", "scene": str(scene), "frames": list(frames), "objects": objects}
    with child.temporary_folder() as folder:
        return child.run_child(job, folder, progress)["facts"]


def answer(job: dict, progress) -> dict:
    """Do the `job` of `ask` in the child; the manifest."""
    import bpy

    from . import cameras, extraction, render_settings, texel_bake

    progress("open scene", 0.0)
    extraction.open_scene(Path(job["scene"]), [])
    scene, facts = bpy.context.scene, []
    view_layer = render_settings.choose_view_layer(scene, [])
    for frame in job["frames"]:
        cameras.go_to_frame(scene, frame)
        chosen = [] if job["objects"] is None else texel_bake.chosen_objects(scene, view_layer, job["objects"])
        name = scene.camera.name if scene.camera is not None else None
        facts.append({"frame": scene.frame_current, "camera": name, "objects": [ob.name for ob in chosen]})
    return {"facts": facts}
