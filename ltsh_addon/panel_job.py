"""What the second process of Blender's panels runs: `panel_job.py job.json`, with pip's bpy or inside Blender."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import shutil
import sys
import threading
from pathlib import Path


def perform(job: dict, stream) -> None:
    """Run the command lines of job["runs"], each {"arguments", "output", "partial"}, until one fails; job["temporary"]
    is the folder of the job."""
    from .blender.process.blender_process import weigh_session
    from .cli.progress import LineProgress
    from .pipeline import display_layers

    _end_with_parent(Path(job["temporary"]))
    weigh_session()
    progress = LineProgress(stream)
    for run in job["runs"]:
        report, complaint = _command(run["arguments"], progress)
        if report is None:
            progress.send({"error": complaint})
            return
        progress("images", 0.0)
        try:
            folder = display_layers.write(run["arguments"][0], Path(run["output"]), report, run["partial"])
        except (OSError, ValueError, MemoryError) as error:
            progress.send({"error": str(error) or type(error).__name__})
            return
        progress.send({"result": str(folder)})


def _end_with_parent(folder: Path) -> None:
    """End this process as soon as the Blender that started it closes our stdin, or is gone; its temporary `folder` goes
    too, since one that was killed cannot remove it."""

    def watch():
        while sys.stdin.buffer.read(1):
            pass
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def _command(arguments: list[str], progress) -> tuple[dict | None, str]:
    """The report of a command line, None where it failed, and the last thing that it said."""
    from . import cli

    progress.notes.clear()
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([*arguments, "--json"], bar=progress)
    lines = progress.notes or [line.strip() for line in err.getvalue().splitlines() if line.strip()]
    complaint = lines[-1] if lines else f"the command ended with code {code}"
    try:
        document = json.loads(out.getvalue())
    except ValueError:
        document = {"errors": lines}
    # A bake that left objects out ends with code 1 and has a report all the same.
    return (None, complaint.removeprefix("ltsh: ")) if "errors" in document else (document, complaint)


PACKAGE_FOLDER = Path(__file__).resolve().parent


def main() -> None:
    """Perform the job; what there is to say goes to stdout, in lines that start with LTSH."""
    job = json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))
    # Running a script puts its own folder first, where `scene` and others would be found as top-level modules.
    inherited = [entry for entry in sys.path if entry != str(PACKAGE_FOLDER)]
    sys.path[:] = [str(PACKAGE_FOLDER.parent), *inherited, *job["path"]]
    importlib.import_module(f"{PACKAGE_FOLDER.name}.panel_job").perform(job, sys.stdout)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    sys.stderr.flush()
    # As in blender/worker.py: nothing is left to save, and bpy 4.5 can hang at the end.
    os._exit(0)
