"""What the child process runs: `worker.py job.json`, with pip's bpy or inside Blender (after `--`).

Writes manifest.json beside the job, with the result or with one line that says what is wrong.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import shutil
import sys
import threading
import traceback
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


def _listen(jobs: queue.SimpleQueue, temporary: list[Path]) -> None:
    """Put the paths of jobs that come on stdin into `jobs`. End this process as soon as the parent, which holds the
    other end, is gone, and remove the `temporary` folders that it made."""

    def listen():
        for line in iter(sys.stdin.buffer.readline, b""):
            jobs.put(Path(line.decode("utf-8", "surrogateescape").removesuffix("\n")))
        for folder in temporary:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(3)

    threading.Thread(target=listen, daemon=True).start()


def _progress(stage: str, fraction: float) -> None:
    _tell({"stage": stage, "fraction": fraction})


def _tell(report: dict) -> None:
    print("LTSH " + json.dumps(report), flush=True)


def _perform(job: dict, folder: Path) -> dict:
    if job["task"] == "demo":
        _progress("build scene", 0.0)
        _module("demo").build(Path(job["path"]))
        return {}
    if job["task"] == "bake":
        return _module("extract.bake").extract_bake(job, folder, _progress)
    if job["task"] == "facts":
        return _module("extract.facts").answer(job, _progress)
    if job["task"] == "apply":
        return _module("extract.apply").apply_bake(job, _progress)
    return _module("extract.pixels").extract(job, folder, _progress)


def _module(name: str):
    """A module of the package this file lies in; run as a script, it has no package to import relatively from."""
    return importlib.import_module(f"{PACKAGE_FOLDER.name}.blender.{name}")


def _do(job: dict, folder: Path) -> bool:
    """Do `job`, write manifest.json into `folder`; False where the manifest is an error."""
    process = _module("process.blender_process")
    try:
        return _write_manifest(folder, _made(job, folder))
    except OSError as error:
        # The manifest may not fit either.
        _tell({"error": process.no_room(folder, error) if process.disk_is_full(error) else str(error)})
        return False


def _made(job, folder) -> dict:
    """The manifest: what was made, or what is wrong. Raises OSError where the disk is full."""
    process = _module("process.blender_process")
    try:
        manifest = _perform(job, folder)
    except process.SceneError as error:
        manifest = {"error": str(error)}
    except Exception as error:
        if isinstance(error, OSError) and process.disk_is_full(error):
            raise
        traceback.print_exc()
        manifest = {"error": f"Blender failed with {type(error).__name__}: {error}"}
    return manifest


def _write_manifest(folder, manifest) -> bool:
    unfinished = folder / "manifest.tmp"
    unfinished.write_text(json.dumps(manifest), encoding="utf-8")
    os.replace(unfinished, folder / "manifest.json")
    return "error" not in manifest


def main() -> int:
    """Exit code 0, or 1 with the error in the manifest; with a parent, go on with the jobs that it hands over."""
    job_path = Path(sys.argv[-1])
    # Running a script puts its own folder first, where `lights` and others would be found as top-level modules.
    sys.path[:] = [str(PACKAGE_FOLDER.parent)] + [entry for entry in sys.path if entry != str(Path(__file__).parent)]
    _module("process.blender_process").weigh_session()
    jobs: queue.SimpleQueue = queue.SimpleQueue()
    temporary: list[Path] = []
    job = json.loads(job_path.read_text(encoding="utf-8"))
    if not job.get("watch_parent"):
        return 0 if _do(job, job_path.parent) else 1
    _listen(jobs, temporary)
    while True:
        temporary[:] = map(Path, job["temporary"])
        _do(job, job_path.parent)
        _tell({"done": True})
        job_path = jobs.get()
        job = json.loads(job_path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Nothing is left to save, and freeing a large scene takes time (bpy 4.5 can even hang there).
    os._exit(code)
