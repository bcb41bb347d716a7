"""What tells that a task is done: one small JSON file per task, in a hidden folder beside the results.

A record names the task, the digest of all it was made from, and its files with sizes and digests. It appears after
the files, at once, and holds no times: whoever does the task again writes the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from glob import escape
from pathlib import Path, PurePath

from .. import __version__
from ..imaging import write_json

_digests: dict[tuple, str] = {}

FOLDER = ".ltsh"
FORMAT = 1
# What says where results go, which of them are wanted and what becomes of old ones, not what is in them.
_NO_INFLUENCE = ("output", "scene", "resume", "objects", "name", "page", "memory_mib")


def contents_digest(options) -> str:
    """Digest of the files that a task reads: the scene and tables. Libraries and textures of the scene do not count."""
    tables = [Path(name) for name in options.techniques if name.endswith(".npz")]
    return " ".join(_known_digest(path) for path in (Path(options.scene), *tables))


def _known_digest(path: Path) -> str:
    """`file_digest`, computed again only where the file has changed: it is asked for every object of a bake."""
    status = path.stat()
    key = str(path.absolute()), status.st_mtime_ns, status.st_size, status.st_ino
    if key not in _digests:
        _digests[key] = file_digest(path)
    return _digests[key]


def options_digest(command: str, options, contents: str) -> str:
    """Digest of the options of a task (a dataclass), the version and `contents_digest`."""
    values = {name: value for name, value in asdict(options).items() if name not in _NO_INFLUENCE}
    found = [__version__, command, values, contents]
    return hashlib.sha256(json.dumps(found, sort_keys=True, default=str).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Records:
    """Records of one kind ("tasks", "tiles") in the folder `output`."""

    def __init__(self, output: Path, kind: str):
        self.output, self._folder = Path(output), Path(output) / FOLDER / kind

    def write(self, name: str, key: str, task: dict, files: Iterable[str], **found) -> dict:
        """Write the record `name`: the task's `files`, by names below the folder, are there; returns it.

        What was `found` is stored with it, "report" or "problem".
        """
        digests = {}
        for file in sorted(files):
            path = self.output / file
            digests[file] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        record = {"format": FORMAT, "key": key, "task": task, "files": digests, **found}
        path = self._path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, record)
        # As it will be read: numbers and letters are what JSON makes of them.
        return json.loads(path.read_text(encoding="utf-8"))

    def read(self, name: str) -> dict | None:
        """The record `name`, or None where there is none that can be read."""
        return _read(self._path(name))

    def whole(self, name: str, key: str | None) -> dict | None:
        """The record `name` if its key is `key` (None: any) and all of its files are as they were written."""
        record = self.read(name)
        if record is None or (key is not None and record["key"] != key) or not self.has_files(record):
            return None
        return record

    def has_files(self, record: dict) -> bool:
        """True where the files are there, with the sizes and digests of the record."""
        try:
            return all(
                (self.output / file).stat().st_size == facts["bytes"]
                and file_digest(self.output / file) == facts["sha256"]
                for file, facts in record["files"].items()
            )
        except OSError:
            return False

    def all_whole(self, key: str, stems: Iterable[str] | None = None) -> list[dict]:
        """All records with that key whose files are whole, or those that are named "<stem>.<anything>"."""
        if stems is None:
            paths = sorted(self._folder.rglob("*.json"))
        else:
            # A name may hold anything that a pattern would take for more.
            found = (self._path(stem).parent.glob(f"{escape(PurePath(stem).name)}.*.json") for stem in stems)
            paths = sorted(path for group in found for path in group)
        records = map(_read, paths)
        return [record for record in records if record and record["key"] == key and self.has_files(record)]

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"


def _read(path: Path) -> dict | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None  # absent, or not ours: the task is done again
    known = isinstance(record, dict) and record.get("format") == FORMAT
    return record if known and isinstance(record.get("files"), dict) and "key" in record else None
