"""Which files of an interrupted bake are finished: every EXR says which job it belongs to, and what was found."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from . import __version__
from .imaging.exr import read_metadata

JOB, RECORD = "ltsh:job", "ltsh:record"


def job_key(options) -> str:
    """Digest of all that a result depends on: the options, the scene's bytes, the version."""
    values = asdict(options)
    for name in ("output", "scene", "resume"):
        values.pop(name)
    digest = hashlib.sha256(json.dumps([__version__, values], sort_keys=True, default=str).encode())
    with Path(options.scene).open("rb") as file:
        digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def job_metadata(key: str, record: dict) -> dict[str, str]:
    """What an EXR needs so that `finished_tiles` knows it."""
    return {JOB: key, RECORD: json.dumps(record, sort_keys=True)}


def finished_tiles(output: Path, key: str) -> dict[tuple[str, int], dict]:
    """Records by (object, tile) of the files in `output` that a job with the same key has written."""
    found = {}
    for path in sorted(output.glob("*.exr")):
        try:
            metadata = read_metadata(path)
            if metadata.get(JOB) == key:
                record = json.loads(metadata[RECORD])
                found[metadata["ltsh:object"], int(metadata["ltsh:tile"])] = record
        except (OSError, ValueError, KeyError):
            continue  # not ours: it is written anew
    return found
