"""The script that the second Blender runs: `worker.py job.json`, with pip's bpy or inside Blender (after `--`).

It does this job, and then the jobs whose paths come on stdin. The result of a job is manifest.json beside it.
"""

import importlib
import json
import os
import queue
import sys
import traceback
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


def _module(name: str):
    """A module of the package around this file. As a script, this file has no package for relative imports."""
    return importlib.import_module(f"{PACKAGE_FOLDER.name}.{name}")


def main() -> None:
    """Do jobs until the parent ends this process or is gone."""
    # Python puts the folder of a script first, where `pixels` and others would be found as top-level modules.
    sys.path[:] = [str(PACKAGE_FOLDER.parent)] + [entry for entry in sys.path if entry != str(Path(__file__).parent)]
    process = _module("blender.process.blender_process")
    jobs: queue.SimpleQueue = queue.SimpleQueue()
    temporary: list[Path] = []
    process.listen_to_parent(temporary, jobs.put)

    def progress(stage: str, fraction: float) -> None:
        process.tell({"stage": stage, "fraction": fraction})

    path = Path(sys.argv[-1])
    while True:
        record = json.loads(path.read_text(encoding="utf-8"))
        temporary[:] = map(Path, record["temporary"])
        sys.path += [folder for folder in record["path"] if folder not in sys.path]
        process.tell(_answer(record, path.parent, progress))
        path = Path(jobs.get())


# Job -> the module in `blender.process` with its class; the module in `blender` and the function in it that does it.
JOBS = {
    "PixelJob": ("pixels", "extract.pixels", "extract_pixels"),
    "FinishedJob": ("finished", "extract.finished", "render_finished"),
    "ShowJob": ("finished", "extract.finished", "show_finished"),
    "BakeJob": ("bake", "extract.bake", "extract_bake"),
    "BakeFactsJob": ("bake", "extract.bake", "scene_facts"),
    "ApplyJob": ("bake", "extract.apply", "apply_bake"),
    "ExportJob": ("bake", "extract.apply", "export_objects"),
    "TargetJob": ("match", "extract.match", "read_target"),
    "LightsJob": ("match", "extract.match", "save_lights"),
    "ViewJob": ("view", "viewport.still", "draw_view"),
    "RestJob": ("view", "viewport.rest", "render_rest"),
    "LiveRestJob": ("view", "viewport.rest", "render_live_rest"),
    "WorldJob": ("view", "viewport.live_cycles", "render_world"),
    "NodeLightJob": ("view", "viewport.live_cycles", "render_node_lights"),
}


def _answer(record: dict, folder: Path, progress) -> dict:
    """Do the job of `record` and write its manifest; returns the message for the parent: done, or an error."""
    files = _module("files")
    try:
        job_module, module, function = JOBS[record["job"]]
        job = getattr(_module(f"blender.process.{job_module}"), record["job"])(**record["fields"])
        manifest = getattr(_module(f"blender.{module}"), function)(job, folder, progress)
        manifest["processor_seconds"] = _module("blender.process.blender_process").end_job()
        (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
        return {"done": True}
    except _module("scene").SceneError as error:
        return {"error": str(error)}
    except Exception as error:
        if isinstance(error, OSError) and files.disk_is_full(error):
            return {"error": files.no_room(folder, error)}
        traceback.print_exc()
        return {"error": f"Blender failed with {type(error).__name__}: {error}"}


if __name__ == "__main__":
    try:
        main()
    except BaseException:
        traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        # There is nothing to save, and bpy 4.5 can hang at exit.
        os._exit(1)
