"""stdout for one document alone, in a Blender that prints on it too. Imports no bpy."""

from __future__ import annotations

import os
import sys


def reserve() -> None:
    """From now on to the end of the process what is not printed through sys.stdout goes to stderr: Blender's own lines,
    from C, also those that it prints when it ends."""
    sys.stdout.flush()
    ours = os.dup(1)
    os.dup2(2, 1)
    sys.stdout = open(ours, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors, buffering=1)
