"""The tasks of a job: which scene, camera, frame and object makes which files, in an order that is always the same."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from . import output_names
from .task_records import contents_digest, options_digest


@dataclass(frozen=True)
class Job:
    """What is to be done: one command for every combination of scene, camera, frame (and object of a bake).

    `options` are compare.Options or bake.BakeOptions; of them scene, camera and frame are set for each task. No
    cameras or frames means those of the file. `name` is a pattern of output_names, None the default one.
    """

    command: str  # "shade", "compare" or "bake"
    options: Any
    scenes: tuple[Path, ...]
    cameras: tuple[str, ...] = ()
    frames: tuple[int, ...] = ()
    name: str | None = None

    @property
    def single(self) -> bool:
        """True where all is one picture or one bake of some objects."""
        return len(self.scenes) * max(len(self.cameras), 1) * max(len(self.frames), 1) == 1

    @property
    def pattern(self) -> str:
        """The pattern of the names of files."""
        counts = {"scene": self.scenes, "camera": self.cameras, "frame": self.frames}
        varying = [name for name, values in counts.items() if len(values) > 1]
        first = "{object}" if self.command == "bake" else self.command
        return self.name or output_names.default_pattern(first, varying)


@dataclass(frozen=True)
class Task:
    """One picture, or one object of a bake, or of that one of several UDIM tiles.

    `name` is the stem of its files, below the output folder.
    """

    scene: str
    camera: str | None
    frame: int | None
    object: str | None
    name: str
    key: str
    tile: int | None = None

    @property
    def stem(self) -> str:
        """`name` without the tile."""
        return self.name if self.tile is None else self.name.removesuffix(f".{self.tile}")

    @property
    def unit(self) -> tuple:
        """What the objects of a bake have in common."""
        return self.scene, self.camera, self.frame

    def to_dict(self) -> dict:
        """As JSON has it."""
        return asdict(self)

    def options(self, job: Job) -> Any:
        """The job's options for this task."""
        options = replace(job.options, scene=Path(self.scene), camera=self.camera, frame=self.frame)
        if self.object is not None:
            return replace(options, objects=(self.object,))
        return replace(options, name=self.name, page="report.html" if job.single else f"{self.name}.html")


def tasks_of(job: Job, progress=None) -> list[Task]:
    """All tasks of `job`. Opens the files in Blender where tasks or names depend on what is in them.

    Raises NameClash where two tasks would write the same file, SceneError, OSError.
    """
    from ..blender.processes.child import check_readable

    for scene in job.scenes:
        check_readable(Path(scene))
    tasks = []
    camera_stems = output_names.file_stems(job.cameras) or [None]
    for scene, stem in zip(job.scenes, output_names.file_stems(Path(scene).stem for scene in job.scenes), strict=True):
        facts = _facts(job, scene, progress)
        contents = contents_digest(replace(job.options, scene=Path(scene)))
        for camera, camera_stem in zip(job.cameras or (None,), camera_stems, strict=True):
            for frame, found in zip(job.frames or (None,), facts, strict=True):
                fields = {
                    "scene": stem,
                    "camera": camera_stem or output_names.file_stems([found.get("camera") or "camera"])[0],
                    "frame": found.get("frame", 0) if frame is None else frame,
                }
                tasks += _tasks(job, (scene, camera, frame), fields, found, contents)
    _check_names(job, tasks)
    return tasks


def shard_of(tasks: list[Task], shard: tuple[int, int]) -> list[Task]:
    """The tasks of shard (I, N), I from 1 to N: every N-th."""
    number, count = shard
    return tasks[number - 1 :: count]


def _facts(job, scene, progress) -> list[dict]:
    """What the file says, per frame: camera, frame and objects; empty where nothing of it is needed."""
    from ..blender.processes import scene_facts

    fields = output_names.fields_of(job.pattern)
    unknown = ("camera" in fields and not job.cameras) or ("frame" in fields and not job.frames)
    if job.command != "bake" and not unknown:
        return [{}] * max(len(job.frames), 1)
    objects, uv = (job.options.objects, job.options.uv) if job.command == "bake" else (None, None)
    frames, scripts = job.frames or (None,), job.options.scripts
    return scene_facts.ask(Path(scene), frames, objects, uv, scripts=scripts, progress=progress)


def _tasks(job, unit, fields, facts, contents) -> list[Task]:
    """The tasks of one scene, camera and frame: one for each of the objects of a bake, or of their UDIM tiles."""
    scene, camera, frame = unit
    key = options_digest(job.command, replace(job.options, scene=Path(scene), camera=camera, frame=frame), contents)
    if job.command != "bake":
        return [Task(str(scene), camera, frame, None, job.pattern.format(**fields), key)]
    tasks, objects = [], list(dict.fromkeys(facts["objects"]))
    for name, stem in zip(objects, output_names.file_stems(objects), strict=True):
        stem = job.pattern.format(**fields, object=stem)
        tiles = facts["tiles"].get(name, ())
        tasks += [Task(str(scene), camera, frame, name, f"{stem}.{tile}", key, tile) for tile in tiles]
        tasks += [] if tiles else [Task(str(scene), camera, frame, name, stem, key)]
    return tasks


def _check_names(job, tasks) -> None:
    counts = Counter(task.name.casefold() for task in tasks)
    for task in tasks:
        if counts[task.name.casefold()] > 1:
            counts = {"scene": job.scenes, "camera": job.cameras, "frame": job.frames}
            missing = [name for name, values in counts.items() if len(values) > 1]
            missing += ["object"] if job.command == "bake" else []
            missing = [f"{{{name}}}" for name in missing if name not in output_names.fields_of(job.pattern)]
            hint = f"; add {' or '.join(missing)}" if missing else ""
            raise output_names.NameClash(f"name {job.pattern!r} gives several tasks the same name {task.name!r}{hint}")
