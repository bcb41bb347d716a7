"""The script that the second Blender runs: `worker.py job.json`, with pip's bpy or inside Blender (after `--`).

It does this job, and then the jobs whose paths come on stdin. The result of a job is manifest.json beside it.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import sys
import time
import traceback
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


def _module(name: str):
    """A module of the package around this file. As a script, this file has no package for relative imports."""
    return importlib.import_module(f"{PACKAGE_FOLDER.name}.{name}")


def main() -> None:
    """Do jobs until the parent ends this process or is gone."""
    # Python puts the folder of a script first, where `client` and others would be found as top-level modules.
    sys.path[:] = [str(PACKAGE_FOLDER.parent)] + [entry for entry in sys.path if entry != str(Path(__file__).parent)]
    process = _module("blender.process.blender_process")
    jobs: queue.SimpleQueue = queue.SimpleQueue()
    temporary: list[Path] = []
    process.listen_to_parent(temporary, jobs.put)

    def progress(stage: str, fraction: float) -> None:
        process.tell({"stage": stage, "fraction": fraction})

    path = Path(sys.argv[-1])
    while True:
        job = json.loads(path.read_text(encoding="utf-8"))
        temporary[:] = map(Path, job["temporary"])
        process.tell(_answer(job, path.parent, progress))
        path = Path(jobs.get())


_told = [0.0]


def _answer(job: dict, folder: Path, progress) -> dict:
    """Do `job` and write its manifest; returns the message for the parent: done, or an error."""
    files = _module("files")
    try:
        manifest = _perform(job, folder, progress)
        # Counted since the last manifest; the first one includes the start of Blender.
        manifest["processor_seconds"] = time.process_time() - _told[0]
        _told[0] = time.process_time()
        (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
        return {"done": True}
    except _module("scene").SceneError as error:
        return {"error": str(error)}
    except Exception as error:
        if isinstance(error, OSError) and files.disk_is_full(error):
            return {"error": files.no_room(folder, error)}
        traceback.print_exc()
        return {"error": f"Blender failed with {type(error).__name__}: {error}"}


def _perform(job: dict, folder: Path, progress) -> dict:
    if job["task"] == "demo":
        progress("build scene", 0.0)
        _module("blender.demo").build(Path(job["path"]))
        return {}
    if job["task"] == "bake":
        return _module("blender.extract.bake").extract_bake(job, folder, progress)
    if job["task"] == "facts":
        return _module("blender.extract.bake").scene_facts(job, progress)
    if job["task"] == "finished":
        return _module("blender.extract.finished").render_finished(job, folder, progress)
    if job["task"] == "show":
        return _module("blender.extract.finished").show_finished(job, folder, progress)
    if job["task"] == "view":
        return _module("blender.viewport.still").draw_view(job, folder, progress)
    if job["task"] == "world":
        return _module("blender.viewport.live_cycles").show_world(job, folder)
    if job["task"] == "lamps":
        return _module("blender.viewport.live_cycles").show_lamps(job, folder, progress)
    if job["task"] == "apply":
        return _module("blender.extract.apply").apply_bake(job, progress)
    return _module("blender.extract.pixels").extract({**job, "since": _told[0]}, folder, progress)


if __name__ == "__main__":
    try:
        main()
    except BaseException:
        traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        # There is nothing to save, and bpy 4.5 can hang at exit.
        os._exit(1)
