"""The index of a folder of pictures: what there is to look at, in which files, and the report that goes with it."""

from __future__ import annotations

import json
from pathlib import Path

from .report import write_json

FILE = "index.json"


def write_index(folder: Path, index: dict) -> None:
    """Write the index. Raises OSError."""
    write_json(Path(folder) / FILE, index)


def read_index(folder: Path) -> dict:
    """The index in `folder`. Raises OSError, and ValueError, naming the file, where it is damaged."""
    path = Path(folder) / FILE
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
        complete = isinstance(index["report"], dict) and {"command", "partial"} <= set(index)
        needed = {"files", "multilayer", "names", "labels", "passes", "scales"}
        complete = complete and all(needed <= set(group) for group in index["groups"].values())
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: is damaged ({error}); shade or bake again") from error
    if not complete or not index["groups"]:
        raise ValueError(f"{path}: is damaged (parts are missing); shade or bake again")
    return index


def index_stamp(folder: Path) -> tuple[int, int]:
    """Changes when the index does. Raises OSError."""
    status = (Path(folder) / FILE).stat()
    return status.st_mtime_ns, status.st_size
