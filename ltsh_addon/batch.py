"""Doing the tasks of a job, or of one shard of it: each finished task leaves its files and a record, whatever becomes
of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from . import bake, compare
from .imaging import write_json
from .scene import Cancelled
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


def run_tasks(
    job: Job, *, shard: tuple[int, int] = (1, 1), existing: str = OVERWRITE, progress: Progress | None = None
) -> Done:
    """Do the tasks of shard (I, N) of `job`, I from 1 to N.

    `existing` says what becomes of tasks that are done already: "overwrite" does them again, "resume" keeps what the
    same options, version, scene and tables have made, "skip" all that is whole. A scene that fails is a problem and
    the others are done all the same, unless it is the only task: then SceneError is raised. Raises TableError,
    OSError, ValueError, Cancelled at once.
    """
    from .blender.blender_process import kept_blender
    from .blender.child import temporary_folder

    compare.prepare(job.options)
    with temporary_folder() as folder, kept_blender(folder):
        tasks = tasks_of(job, progress)
        return _run(job, tasks, shard_of(tasks, shard), existing, progress)


def _run(job, tasks, mine, existing, progress) -> Done:
    from .blender.child import SceneError

    output = Path(job.options.output)
    records, kept, problems = Records(output, "tasks"), 0, []
    for number, task in enumerate(mine):
        if existing != OVERWRITE and _is_done(records, task, existing):
            kept += 1
            continue
        found, seconds, files = {}, {}, ()
        try:
            made = _perform(job, task, existing, _of_task(progress, task, number, mine))
            found, seconds, files = {"report": made.report}, made.seconds, made.files
            problems += made.report.get("problems", ())
        except SceneError as error:
            if len(tasks) == 1:
                raise
            found = {"problem": f"{task.name}: {' '.join(str(error).split())}"}
            problems.append(found["problem"])
        _write_job(output, job, tasks, existing)
        _write_timing(output, task, seconds)
        records.write(task.name, task.key, task.to_dict(), files, **found)
    return Done(len(mine), len(mine) - kept, kept, tuple(problems))


def _is_done(records, task, existing) -> bool:
    record = records.whole(task.name, task.key if existing == RESUME else None)
    # What was wrong may be put right by now.
    return record is not None and "problem" not in record and not record["report"].get("problems")


def _perform(job: Job, task: Task, existing: str, progress) -> compare.Made:
    options = task.options(job)
    if job.command == "bake":
        options = replace(options, resume=existing == RESUME)
        return bake.bake_objects(options, progress, stems={task.object: task.name})
    return compare.make_picture(options, job.command == "compare", progress)


def _of_task(progress, task, number, tasks):
    """`progress` that says which of several tasks it is about."""
    if progress is None or len(tasks) == 1:
        return progress
    if progress(f"{number + 1} of {len(tasks)} {task.name}", 0.0) is False:
        raise Cancelled(f"stopped before {task.name}")
    return lambda stage, fraction: progress(f"{number + 1} of {len(tasks)} {stage}", fraction)


def _write_job(output, job, tasks, existing) -> None:
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
    path = output / FOLDER / "job.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, document)


def _write_timing(output, task, seconds) -> None:
    path = output / FOLDER / "timing" / f"{task.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, seconds)
