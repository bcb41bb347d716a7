"""Runs the benchmarks of the viewport, each in a process of its own: they need Blender's graphics."""

import subprocess
import sys
from pathlib import Path


def frames(rounds: int, size: str) -> None:
    """Frames of the example scene by technique."""
    _run("viewport_frame.py", "--rounds", str(rounds), "--size", size)


def sync(triangles: int) -> None:
    """Keeping 100 objects under 32 lights in step."""
    _run("viewport_sync.py", str(triangles), "100", "32")


def _run(name, *arguments):
    # What was printed before must come before; Blender writes to stderr what is no concern of ours.
    sys.stdout.flush()
    command = [sys.executable, str(Path(__file__).with_name(name)), *arguments]
    code = subprocess.run(command, stderr=subprocess.DEVNULL, timeout=1200).returncode
    if code:
        print(f"  {name} ended with exit code {code}; run it alone to see why")
