"""Doing the tasks of a job, or of one shard of it: each finished task leaves its files and a record, whatever becomes
of the others.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from ..baking import bake
from ..comparison import compare
from ..imaging import write_json
from .task_records import FOLDER, FORMAT, Records
from .tasks import Job, Task, shard_of, tasks_of

OVERWRITE, RESUME, SKIP = "overwrite", "resume", "skip"

Progress = Callable[[str, float], "bool | None"]


@dataclass(frozen=True)
class Done:
    """How many tasks of the shard were done now, how many were there already, and what was wrong with others."""

    tasks: int
    done: int
    kept: int
    problems: tuple[str, ...]


@dataclass(frozen=True)
class TaskState:
    """Task `number` of `tasks`, from 1, begins, or, where there are `seconds`, has ended."""

    number: int
    tasks: int
    name: str
    seconds: float | None = None
    problem: str | None = None


def run_tasks(
    job: Job,
    *,
    shard: tuple[int, int] = (1, 1),
    existing: str = OVERWRITE,
    progress: Progress | None = None,
    tell: Callable[[TaskState], None] | None = None,
) -> Done:
    """Do the tasks of shard (I, N) of `job`, I from 1 to N.

    `existing` says what becomes of tasks that are done already: "overwrite" does them again, "resume" keeps what the
    same options, version, scene and tables have made, "skip" all that is whole. A task whose scene fails, or whose
    files cannot be written, is a problem and the others are done all the same, unless it is the only one: then
    SceneError or OSError is raised. Raises TableError, ValueError, Cancelled at once, and OSError where not even a
    record can be written.
    """
    from ..blender.processes.blender_process import kept_blender
    from ..blender.processes.child import temporary_folder

    compare.prepare(job.options)
    if job.command == "bake":
        bake.check_memory(job.options)
    with temporary_folder() as folder, kept_blender(folder):
        tasks = tasks_of(job, progress)
        mine = shard_of(tasks, shard)
        records = Records(job.options.output, "tasks")
        wanted = [task for task in mine if existing == OVERWRITE or not _is_done(records, task, existing)]
        problems = []
        told = len(wanted) < len(mine)
        if told:
            _write_job(job, tasks, existing)
        for number, task in enumerate(wanted, 1):
            if tell is not None:
                tell(TaskState(number, len(wanted), task.name))
            following = tuple(other.object for other in wanted[number:] if other.unit == task.unit)
            found, seconds, files = _attempt(job, task, following, existing, progress, alone=len(tasks) == 1)
            try:
                # Once: it holds all tasks, which may be thousands.
                if not told:
                    _write_job(job, tasks, existing)
                    told = True
                _write_timing(job.options.output, task, seconds)
                records.write(task.name, task.key, task.to_dict(), files, **found)
            except OSError as error:
                raise OSError(found.get("problem", str(error))) from error
            wrong = [found["problem"]] if "problem" in found else found["report"].get("problems", [])
            problems += wrong
            if tell is not None:
                tell(TaskState(number, len(wanted), task.name, seconds["total"], "; ".join(wrong) or None))
    return Done(len(mine), len(wanted), len(mine) - len(wanted), tuple(problems))


def _attempt(job, task, following, existing, progress, alone) -> tuple[dict, dict, tuple[str, ...]]:
    """What is to be recorded of a task, its seconds and files; a failure is a "problem", unless `alone`."""
    from ..blender.processes.child import SceneError

    start = time.perf_counter()
    try:
        made = _perform(job, task, following, existing, progress)
        return {"report": made.report}, made.seconds, made.files
    except (SceneError, OSError) as error:
        if alone:
            raise
        problem = f"{task.name}: {' '.join(str(error).split())}"
        return {"problem": problem}, {"total": time.perf_counter() - start}, ()


def _is_done(records, task, existing) -> bool:
    record = records.whole(task.name, task.key if existing == RESUME else None)
    # What was wrong may be put right by now.
    return record is not None and "problem" not in record and not record["report"].get("problems")


def _perform(job: Job, task: Task, following: tuple, existing: str, progress) -> compare.Made:
    options = task.options(job)
    if job.command == "bake":
        options = replace(options, resume=existing == RESUME)
        stems = {task.object: task.stem}
        return bake.bake_objects(options, progress, stems=stems, tile=task.tile, following=following)
    return compare.make_picture(options, job.command == "compare", progress)


def _write_job(job, tasks, existing) -> None:
    """Say what the whole job is: the same from every shard, so that `merge` knows what to wait for."""
    applied = job.command == "bake" and job.options.apply
    document = {
        "format": FORMAT,
        "command": job.command,
        "single": job.single,
        "any_key": existing == SKIP,
        "applied_layer": bake.applied_layer(job.options) if applied else None,
        "tasks": [task.to_dict() for task in tasks],
    }
    path = Path(job.options.output) / FOLDER / "job.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, document)


def _write_timing(output, task, seconds) -> None:
    path = Path(output) / FOLDER / "timing" / f"{task.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, seconds)
