"""What is said where something is asked for by a name that nothing has. Imports no bpy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

MOST = 8


def listed(names: Iterable[str], wanted: str) -> str:
    """At most 8 of `names` in quotes, those most like `wanted` first, and how many more there are; else "none"."""
    names = list(names)
    near = difflib.get_close_matches(wanted, names, MOST)
    chosen = [*near, *(name for name in names if name not in near)][:MOST]
    text = ", ".join(map(repr, chosen)) or "none"
    return f"{text} and {len(names) - MOST} more" if len(names) > MOST else text
