"""What the child process runs: `worker.py job.json`, with pip's bpy or inside Blender (after `--`).

Writes manifest.json beside the job, with the result or with one line that says what is wrong.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
import traceback
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def end_with_parent() -> None:
    """End this process as soon as the parent, which holds the other end of stdin, is gone."""

    def watch():
        while os.read(0, 4096):
            pass
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def _progress(stage: str, fraction: float) -> None:
    print("LTSH " + json.dumps({"stage": stage, "fraction": fraction}), flush=True)


def _perform(job: dict, folder: Path) -> dict:
    if job["task"] == "demo":
        _progress("build scene", 0.0)
        _module("demo_scene").build(Path(job["path"]))
        return {}
    if job["task"] == "bake":
        return _module("bake_extraction").extract_bake(job, folder, _progress)
    if job["task"] == "apply":
        return _module("bake_apply").apply_bake(job, folder, _progress)
    return _module("extraction").extract(job, folder, _progress)


def _module(name: str):
    """A module of the package this file lies in; run as a script, it has no package to import relatively from."""
    return importlib.import_module(f"{PACKAGE_FOLDER.name}.blender.{name}")


def main() -> int:
    """Exit code 0, or 1 with the error in the manifest."""
    job_path = Path(sys.argv[-1])
    job = json.loads(job_path.read_text(encoding="utf-8"))
    if job.get("watch_parent"):
        end_with_parent()
    # Running a script puts its own folder first, where `lights` and others would be found as top-level modules.
    sys.path[:] = [str(PACKAGE_FOLDER.parent)] + [entry for entry in sys.path if entry != str(Path(__file__).parent)]
    scene_error = _module("child").SceneError
    try:
        manifest = _perform(job, job_path.parent)
    except scene_error as error:
        manifest = {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        manifest = {"error": f"Blender failed with {type(error).__name__}: {error}"}
    unfinished = job_path.with_name("manifest.tmp")
    unfinished.write_text(json.dumps(manifest), encoding="utf-8")
    os.replace(unfinished, job_path.with_name("manifest.json"))
    return 1 if "error" in manifest else 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Nothing is left to save, and freeing a large scene takes time (bpy 4.5 can even hang there).
    os._exit(code)
