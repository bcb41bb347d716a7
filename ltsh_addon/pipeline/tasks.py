"""Tasks of a job: the names of their files, shards, and records of finished tasks."""

import hashlib
import json
import os
import platform
import string
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..imaging import write_json
from ..reading import Malformed, check, file_name, read_json, some
from ..scene import ATLAS, VERSION, Cancelled, Progress, SceneError, error_line, shortened
from . import lightmap
from .options import child_job, what_matters

FOLDER = ".ltsh"
FORMAT = 1
# Limits in bytes: of a stem from a name in the scene, and of a name in a path. File systems allow 255, suffixes
# included.
LONGEST_STEM, LONGEST_NAME = 100, 200
# Shapes that documents must have (see `reading.check`).
_TASK = {
    **dict.fromkeys(("scene", "key"), str),
    **dict.fromkeys(("camera", "object", "problem?"), str | None),
    **dict.fromkeys(("frame", "tile"), int | None),
    "name": file_name,
}
JOB = {
    "command": ("shade", "compare", "bake", "view", "render"),
    **dict.fromkeys(("single", "any_key"), bool),
    "applied_layer": str | None,
    "exported_layers?": {str: [str]},
    "tasks": some([_TASK]),
}


def _check_files(files, name) -> None:
    check(files, {str: {"bytes": int, "sha256": str}}, name)
    for file in files:
        file_name(file, name)


_RECORD = {"key": str, "files": _check_files, "problem?": str}
TASK_RECORD = {"task": _TASK}
_digests: dict[tuple, str] = {}


@dataclass(frozen=True)
class BatchJob:
    """One command for every combination of scene, camera and frame (and object of a bake)."""

    command: str  # "shade", "compare", "bake", "view" or "render"
    options: Any  # Picture-, Bake-, View- or RenderOptions; each task sets its own scene, camera, frame and name
    scenes: tuple[Path, ...]
    cameras: tuple[str, ...] = ()  # empty: the camera of the file
    frames: tuple[int, ...] = ()  # empty: the frame of the file
    name: str | None = None  # pattern of file names; None: the default

    @property
    def single(self) -> bool:
        """True where the job is one picture, or one bake of some objects."""
        return len(self.scenes) == 1 and not self.varying

    @property
    def varying(self) -> list[str]:
        """The fields of names of which the job has several."""
        values = {"scene": self.scenes, "camera": self.cameras, "frame": self.frames}
        return [name for name, several in values.items() if len(several) > 1]

    @property
    def pattern(self) -> str:
        """The pattern of the names of files, by default such as compare, or compare_{frame:04d}."""
        first = "{object}" if self.command == "bake" else self.command
        texts = {"scene": "{scene}", "camera": "{camera}", "frame": "{frame:04d}"}
        return self.name or "_".join([first, *(text for name, text in texts.items() if name in self.varying)])


@dataclass(frozen=True)
class BatchTask:
    """One picture, one object of a bake, or one of several UDIM tiles of such an object."""

    scene: str
    camera: str | None
    frame: int | None
    object: str | None
    name: str  # stem of its files, below the output folder
    key: str  # digest of all that its results depend on, see `options_digest`
    tile: int | None = None
    problem: str | None = None  # of a file whose tasks are unknown; it has no other task

    @property
    def stem(self) -> str:
        """`name` without the tile."""
        return self.name if self.tile is None else self.name.removesuffix(f".{self.tile}")

    @property
    def unit(self) -> tuple:
        """Scene, camera and frame: the same for all objects of one bake."""
        return self.scene, self.camera, self.frame

    def options(self, job: BatchJob) -> Any:
        """The job's options for this task."""
        options = replace(job.options, scene=Path(self.scene), camera=self.camera, frame=self.frame)
        if self.object is not None:
            return replace(options, objects=options.objects if options.atlas else (self.object,), name=self.stem)
        if job.command in ("view", "render"):
            return replace(options, name=self.name)
        return replace(options, name=self.name, page="report.html" if job.single else f"{self.name}.html")


@dataclass(frozen=True)
class TaskResult:
    """The result of a task: its report, the seconds it took, and the names of its files below the output folder."""

    report: dict
    seconds: dict
    files: tuple[str, ...]


def write_reports(result: TaskResult, output: Path) -> dict:
    """Write report.json and timing.json of the only task into `output`; returns the report, with times as "seconds"."""
    write_json(Path(output) / "report.json", result.report)
    write_json(Path(output) / "timing.json", {"seconds": result.seconds})
    return {**result.report, "seconds": result.seconds}


def check_before_writing(progress: Progress | None) -> None:
    """Report that files are about to be written. Raises Cancelled."""
    if progress is not None and progress("write", 0.0) is False:
        raise Cancelled("stopped before the files were written")


def versions(blender_version: str) -> dict[str, str]:
    """Versions that a result depends on."""
    import OpenEXR

    return {
        "ltsh": VERSION,
        "blender": blender_version,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "OpenEXR": getattr(OpenEXR, "__version__", "unknown"),
    }


class NameClash(ValueError):
    """Several tasks would get the same name, or one gets a name that is too long."""


def tasks_of(job: BatchJob, progress=None, *, resumed: bool = False) -> list[BatchTask]:
    """All tasks of `job`. Opens the files in Blender if tasks or names depend on their contents.

    Where the job is `resumed`, it is told if changes cannot be judged object by object. Where one of several files
    fails, its only task is its problem.

    Raises NameClash where two tasks would write the same file, or a name is too long, SceneError, OSError.
    """
    from ..blender.process.blender_process import check_readable

    for scene in job.scenes:
        check_readable(Path(scene))
    tasks = []
    camera_stems = file_stems(job.cameras) or [None]
    for scene, stem in zip(job.scenes, file_stems(Path(scene).stem for scene in job.scenes), strict=True):
        try:
            facts = _facts(job, scene, progress)
        except SceneError as error:
            if len(job.scenes) == 1:
                raise
            tasks.append(BatchTask(str(scene), None, None, None, stem, "", problem=error_line(error)))
            continue
        if job.command == "bake":
            _announce(job.options, max((of_frame["lights"] for of_frame in facts), default=0), progress)
            if (unknown := facts[0]["not_judged"]) and resumed and progress is not None:
                progress.remark(f"{unknown}: all objects are baked again, unless {scene} is the same file")
        for camera, camera_stem in zip(job.cameras or (None,), camera_stems, strict=True):
            for frame, of_frame in zip(job.frames or (None,), facts, strict=True):
                fields = {
                    "scene": stem,
                    "camera": camera_stem or file_stems([of_frame.get("camera") or "camera"])[0],
                    "frame": of_frame.get("frame", 0) if frame is None else frame,
                }
                tasks += _tasks(job, (scene, camera, frame), fields, of_frame)
    _check_names(job, tasks)
    return tasks


def _announce(options, lights: int, progress) -> None:
    """Tell what a bake will take before it starts. Raises SceneError where it certainly cannot work."""
    lightmap.check_memory(options, lights)
    remark = getattr(progress, "remark", None)
    for line in lightmap.announced(options, lights) if remark is not None else ():
        remark(line)


def shard_of(tasks: list[BatchTask], shard: tuple[int, int]) -> list[BatchTask]:
    """Every N-th of the tasks, from number I on: shard (I, N), I from 1 to N."""
    number, count = shard
    return tasks[number - 1 :: count]


def _facts(job, scene, progress) -> list[dict]:
    """Facts of the file per frame: camera, frame, objects and tiles. Empty dicts where none are needed."""
    from ..blender.process.bake import BakeFactsJob, scene_facts

    fields = fields_of(job.pattern)
    unknown = ("camera" in fields and not job.cameras) or ("frame" in fields and not job.frames)
    if job.command != "bake" and not unknown:
        return [{}] * max(len(job.frames), 1)
    frames, options = list(job.frames or (None,)), job.options
    if job.command != "bake":
        return scene_facts(BakeFactsJob(Path(scene), frames, scripts=options.scripts), progress=progress)
    return scene_facts(child_job(BakeFactsJob, options, scene=Path(scene), frames=frames), progress=progress)


def _tasks(job, unit, fields, facts) -> list[BatchTask]:
    """The tasks of one scene, camera and frame: one picture, or one per object or UDIM tile of a bake."""
    scene, camera, frame = unit
    options = replace(job.options, scene=Path(scene), camera=camera, frame=frame)
    if job.command != "bake":
        key = options_digest(job.command, options, contents_digest(options))
        return [BatchTask(str(scene), camera, frame, None, job.pattern.format(**fields), key)]
    is_atlas, digests = job.options.atlas is not None, facts["digests"]
    tasks, objects = [], [ATLAS] if is_atlas else list(dict.fromkeys(facts["objects"]))
    for name, stem in zip(objects, file_stems(objects), strict=True):
        stem = job.pattern.format(**fields, object=stem)
        tiles = () if is_atlas else facts["tiles"].get(name, ())
        surfaces = (
            " ".join(digests[member] for member in facts["objects"]) if is_atlas and digests else digests.get(name)
        )
        key = options_digest("bake", options, contents_digest(options, surfaces))
        tasks += [BatchTask(str(scene), camera, frame, name, f"{stem}.{tile}", key, tile) for tile in tiles]
        tasks += [] if tiles else [BatchTask(str(scene), camera, frame, name, stem, key)]
    return tasks


def _check_names(job, tasks) -> None:
    counts = Counter(task.name.casefold() for task in tasks)
    for task in tasks:
        if too_long := [name for name in task.name.split("/") if len(os.fsencode(name)) > LONGEST_NAME]:
            name = f"{shortened(too_long[0], 60)!r}, {len(os.fsencode(too_long[0]))} bytes long"
            raise NameClash(f"name {job.pattern!r} gives {name}, expected at most {LONGEST_NAME}: use a shorter one")
        if counts[task.name.casefold()] > 1:
            varying = [*job.varying, *(["object"] if job.command == "bake" else [])]
            missing = [f"{{{name}}}" for name in varying if name not in fields_of(job.pattern)]
            hint = f"; add {' or '.join(missing)}" if missing else ""
            raise NameClash(f"name {job.pattern!r} gives several tasks the same name {task.name!r}{hint}")


def file_stems(names: Iterable[str]) -> list[str]:
    """A file name for each of `names`: valid on every file system, and unique even if case is ignored."""
    stems, taken = [], set()
    for name in names:
        stem = "".join(letter if letter.isalnum() or letter in " -_" else "_" for letter in name).strip() or "object"
        stem = os.fsencode(stem)[:LONGEST_STEM].decode("utf-8", "ignore")
        candidate, number = stem, 1
        while candidate.casefold() in taken:
            number += 1
            candidate = f"{stem}_{number}"
        taken.add(candidate.casefold())
        stems.append(candidate)
    return stems


def fields_of(pattern: str) -> set[str]:
    """The names of the fields of a pattern."""
    return {name for _, name, _, _ in string.Formatter().parse(pattern) if name}


class Records:
    """Records of one kind ("tasks", "tiles") in the folder `output`; `shape` is the shape of "task" and "report"."""

    def __init__(self, output: Path, kind: str, shape: dict):
        self.output, self._folder = Path(output), Path(output) / FOLDER / kind
        self._shape = {**_RECORD, **shape}

    def write(self, name: str, key: str, task: dict, files: Iterable[str], **outcome) -> dict:
        """Write the record `name` of a task that has finished, and return it.

        `files` are the names of its files below the output folder, `outcome` its "report" or "problem".
        """
        digests = {}
        for file in sorted(files):
            path = self.output / file
            digests[file] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        record = {"format": FORMAT, "key": key, "task": task, "files": digests, **outcome}
        write_record(self._path(name), record)
        # Returned as it will be read: JSON may change the types of values.
        return json.loads(self._path(name).read_text(encoding="utf-8"))

    def whole(self, name: str, key: str | None) -> dict | None:
        """The record `name` if its key is `key` (None: any) and all of its files are as they were written."""
        record = self._read(self._path(name))
        if record is None or (key is not None and record["key"] != key) or not self.has_files(record):
            return None
        return record

    def has_files(self, record: dict) -> bool:
        """True where the files are there, with the sizes and digests of the record."""
        try:
            # `is_file` first: reading a pipe or a device may never end.
            return all(
                (path := self.output / file).is_file()
                and path.stat().st_size == facts["bytes"]
                and file_digest(path) == facts["sha256"]
                for file, facts in record["files"].items()
            )
        except OSError:
            return False

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"

    def _read(self, path: Path) -> dict | None:
        try:
            record = read_document(path, self._shape)
        except (OSError, ValueError):
            return None  # absent, or not ours: the task is done again
        return record if {"report", "problem"} & record.keys() else None


def write_record(path: Path, document: dict) -> None:
    """Write `document` as JSON; creates the folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, document)


def read_document(path: Path, shape: dict) -> dict:
    """The record or job in a file, of this version. Raises OSError, Malformed."""
    document = read_json(path, {"format": int})
    if document["format"] != FORMAT:
        raise Malformed(f"was written by another version of LTSH, expected format {FORMAT}")
    check(document, shape)
    return document


def options_digest(command: str, options, contents: str) -> str:
    """Digest of all that the results of a task depend on: version, command, options that matter, `contents`."""
    matters = [VERSION, command, what_matters(options), contents]
    return hashlib.sha256(json.dumps(matters, sort_keys=True, default=str).encode()).hexdigest()


def contents_digest(options, surfaces: str | None = None) -> str:
    """Digest of what a task reads: tables, and `surfaces`, the digest of what an object depends on.

    None: the file of the scene. Its libraries and textures do not count then.
    """
    tables = [_known_digest(Path(name)) for name in options.techniques if name.endswith(".npz")]
    return " ".join([surfaces or _known_digest(Path(options.scene)), *tables])


def _known_digest(path: Path) -> str:
    """`file_digest`, cached until the file changes, because every object of a bake asks for it."""
    status = path.stat()
    key = str(path.absolute()), status.st_mtime_ns, status.st_size, status.st_ino
    if key not in _digests:
        _digests[key] = file_digest(path)
    return _digests[key]


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
