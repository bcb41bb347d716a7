"""What the second process of Blender's panels runs: `job_worker.py job.json`, with pip's bpy or inside Blender."""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def main() -> None:
    """Perform the job; what there is to say goes to stdout, in lines that start with LTSH."""
    job = json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))
    # Running a script puts its own folder first, where `scene` and others would be found as top-level modules.
    inherited = [entry for entry in sys.path if entry != str(PACKAGE_FOLDER)]
    sys.path[:] = [str(PACKAGE_FOLDER.parent), *inherited, *job["path"]]
    importlib.import_module(f"{PACKAGE_FOLDER.name}.jobs.job_steps").perform(job, sys.stdout)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    sys.stderr.flush()
    # As in blender/worker.py: nothing is left to save, and bpy 4.5 can hang at the end.
    os._exit(0)
