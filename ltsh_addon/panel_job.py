"""Entry point of the process that a panel starts: `panel_job.py job.json`, with pip's bpy or inside Blender."""

import contextlib
import importlib
import io
import json
import os
import sys
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parent


def perform(job: dict) -> None:
    """Run the command lines of job["runs"] until one fails; each is {"arguments", "output", "partial"}.

    job["temporary"] is the temporary folder of the job.
    """
    from .blender.process.blender_process import listen_to_parent, tell
    from .cli.progress import MessageProgress
    from .pipeline import display_layers

    listen_to_parent([Path(job["temporary"])])
    stdout = sys.stdout  # the commands' own output goes elsewhere

    def send(message: dict) -> None:
        tell(message, stdout)

    progress = MessageProgress(send)
    for run in job["runs"]:
        baked = _BakedObjects(Path(run["output"]), send)
        progress.watch = baked.follow
        report, complaint = _command(run["arguments"], progress)
        if report is None:
            send({"error": complaint})
            return
        if run["arguments"][0] == "match":
            continue
        progress("images", 0.0)
        try:
            output = Path(run["output"])
            folder = display_layers.write(run["arguments"][0], output, report, run["partial"], baked.groups)
            display_layers.write_lights(folder, run["arguments"], report, progress)
        except (OSError, ValueError, MemoryError) as error:
            send({"error": str(error) or type(error).__name__})
            return
        send({"result": str(folder)})


class _BakedObjects:
    """Tells the state of the objects of a bake, and shows each as soon as it is done."""

    def __init__(self, output: Path, send):
        self._output, self._send = output, send
        self._reports: list[dict] = []
        self.groups: dict = {}  # of the pictures that are written

    def follow(self, state) -> None:
        """Take a `TaskState`."""
        from .pipeline import batch, display_layers

        if state.object is None:
            return
        is_bad = state.problem is not None
        ended = "unchanged" if state.number == 0 else "failed" if is_bad else "done"
        is_running = state.number > 0 and state.seconds is None
        if state.report is not None and state.report["objects"]:
            self._reports.append(state.report)
            report = batch.joined_bakes(self._reports)
            if 0 < state.number < state.tasks:
                folder = display_layers.write("bake", self._output, report, "Not complete: more objects", self.groups)
                self._send({"result": str(folder)})
        self._send({"object": state.object, "state": "baking" if is_running else ended})


def _command(arguments: list[str], progress) -> tuple[dict | None, str]:
    """The report of a command line, None if it failed; and the last line of its messages."""
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
    # A bake that leaves objects out ends with code 1, but has a report.
    return (None, complaint.removeprefix("ltsh: ")) if "errors" in document else (document, complaint)


def main() -> None:
    """Perform the job; messages go to stdout (see `blender_process`)."""
    job = json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))
    # Python puts the folder of a script first, where it would find `scene` and others as top-level modules.
    inherited = [entry for entry in sys.path if entry != str(PACKAGE_FOLDER)]
    sys.path[:] = [str(PACKAGE_FOLDER.parent), *inherited, *job["path"]]
    importlib.import_module(f"{PACKAGE_FOLDER.name}.panel_job").perform(job)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    sys.stderr.flush()
    # As in worker.py: there is nothing left to save, and bpy 4.5 can hang at exit.
    os._exit(0)
