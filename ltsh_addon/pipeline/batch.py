"""Many tasks one after another, and their reports merged."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby
from pathlib import Path

from ..files import no_empty_folder, temporary_folder
from ..imaging import grouped, write_json, write_overview
from ..reading import NUMBER, Malformed, read_json
from ..scene import Cancelled, Progress, SceneError, error_line, unexpected_error_line
from . import bake, bake_files, picture, render
from . import tasks as batch_tasks
from .lighting import prepare

OVERWRITE, RESUME, SKIP = "overwrite", "resume", "skip"


@dataclass(frozen=True)
class RunResult:
    """The numbers of tasks of a shard, and the problems of those that failed."""

    tasks: int  # all
    done: int  # attempted now
    kept: tuple[str, ...]  # names, or objects of bakes, of those that an earlier run has finished
    problems: tuple[str, ...]

    @property
    def finished_before(self) -> int:
        """The number of tasks that an earlier run has finished."""
        return len(self.kept)


@dataclass(frozen=True)
class TaskState:
    """Task `number` of `tasks`, counted from 1: it has ended if there are `seconds`, else it begins.

    Number 0 is a task that an earlier run has finished.
    """

    number: int
    tasks: int
    name: str
    object: str | None = None  # of a bake
    seconds: float | None = None
    problem: str | None = None
    report: dict | None = None  # of a task that has succeeded


def run_tasks(
    job: batch_tasks.BatchJob,
    *,
    shard: tuple[int, int] = (1, 1),
    existing: str = OVERWRITE,
    progress: Progress | None = None,
    tell: Callable[[TaskState], None] | None = None,
) -> RunResult:
    """Do the tasks of shard (I, N) of `job`, I from 1 to N.

    `existing` decides about tasks that are done already: "overwrite" does them again, "resume" keeps those of the same
    options, version, scene and tables, "skip" keeps all whose files are whole. A task whose scene fails, or whose files
    cannot be written, becomes a problem and the others go on; if it is the only task, SceneError or OSError is raised.
    Raises TableError, ValueError and Cancelled at once, and OSError where not even a record can be written.
    """
    from ..blender.process.blender_process import shared_blender

    output = job.options.output
    with no_empty_folder(output), temporary_folder() as folder, shared_blender(folder):
        prepare(job.options)
        tell = tell or (lambda state: None)
        tasks = batch_tasks.tasks_of(job, progress, resumed=existing == RESUME)
        mine = batch_tasks.shard_of(tasks, shard)
        records = _task_records(output, job.command)
        kept = {} if existing == OVERWRITE else {task: _finished(records, task, existing) for task in mine}
        kept = {task: report for task, report in kept.items() if report is not None}
        wanted, problems = [task for task in mine if task not in kept], []
        told = bool(kept)
        if told:
            _write_job(job, tasks, existing)
        for task, report in kept.items():
            tell(TaskState(0, len(wanted), task.name, task.object, report=report))
        for number, task in enumerate(wanted, 1):
            tell(TaskState(number, len(wanted), task.name, task.object))
            following = tuple(other.object for other in wanted[number:] if other.unit == task.unit)
            outcome, seconds, files = _attempt(job, task, following, progress, alone=len(tasks) == 1)
            try:
                # Only once: the document holds all tasks, perhaps thousands.
                if not told:
                    _write_job(job, tasks, existing)
                    told = True
                batch_tasks.write_record(_timing_path(output, task), seconds)
                records.write(task.name, task.key, asdict(task), files, **outcome)
            except OSError as error:
                raise OSError(outcome.get("problem", str(error))) from error
            wrong = [outcome["problem"]] if "problem" in outcome else outcome["report"].get("problems", [])
            problems += wrong
            state = TaskState(number, len(wanted), task.name, task.object, seconds["total"], "; ".join(wrong) or None)
            tell(replace(state, report=outcome.get("report")))
    names = tuple(dict.fromkeys(task.object or task.name for task in kept))
    return RunResult(len(mine), len(wanted), names, tuple(problems))


def _attempt(job, task, following, progress, alone) -> tuple[dict, dict, tuple[str, ...]]:
    """Do a task; returns its "report" or "problem" for the record, its seconds and files. `alone`: failures raise."""
    if task.problem is not None:
        return {"problem": f"{task.name}: {task.problem}"}, {"total": 0.0}, ()
    start = time.perf_counter()
    try:
        made = _perform(job, task, following, progress)
        return {"report": made.report}, made.seconds, made.files
    except Exception as error:
        if alone or isinstance(error, Cancelled):
            raise
        line = error_line if isinstance(error, SceneError | OSError) else unexpected_error_line
        return {"problem": f"{task.name}: {line(error)}"}, {"total": time.perf_counter() - start}, ()


def _finished(records, task, existing) -> dict | None:
    """The report of a task that need not be done again; None for the others."""
    record = records.whole(task.name, task.key if existing == RESUME else None)
    report = None if record is None else record.get("report")
    # Tasks with problems are done again: their cause may be gone.
    return None if report is None or report.get("problems") else report


def _perform(
    job: batch_tasks.BatchJob, task: batch_tasks.BatchTask, following: tuple, progress
) -> batch_tasks.TaskResult:
    options = task.options(job)
    if job.command == "bake":
        return bake.bake_objects(options, progress, tile=task.tile, following=following)
    if job.command == "render":
        return render.make_finished(options, progress)
    if job.command == "view":
        return picture.draw_view(options, progress, len(job.frames) > 1)
    return picture.make_picture(options, job.command == "compare", progress)


def _write_job(job, tasks, existing) -> None:
    """Write job.json, the description of the whole job for `merge`; every shard writes the same."""
    applied = job.command == "bake" and job.options.apply
    document = {
        "format": batch_tasks.FORMAT,
        "command": job.command,
        "single": job.single,
        "any_key": existing == SKIP,
        "applied_layer": bake_files.applied_layer(job.options) if applied else None,
        "exported_layers": bake_files.exported_layers(job.options)
        if job.command == "bake" and job.options.export
        else {},
        "tasks": [asdict(task) for task in tasks],
    }
    batch_tasks.write_record(Path(job.options.output) / batch_tasks.FOLDER / "job.json", document)


@dataclass(frozen=True)
class Merged:
    """The results of a whole job."""

    report: dict
    seconds: dict
    missing: tuple[str, ...]  # names of the tasks that are not done
    problems: tuple[str, ...]  # of its tasks, and of results of different versions
    command: str
    single: bool


def merge(output: Path, progress=None) -> Merged:
    """Write report.json and timing.json of the job in the folder `output`, from the records of its tasks.

    Comparisons of several pictures also get report.html, a bake with `apply` its .blend. An incomplete report lists
    the tasks that are not done under "missing". Raises OSError, and ValueError where the folder has no job or no task
    is done.
    """
    output = Path(output)
    job = _read_job(output)
    tasks = [
        batch_tasks.BatchTask(**{item.name: task.get(item.name) for item in fields(batch_tasks.BatchTask)})
        for task in job["tasks"]
    ]
    records = _task_records(output, job["command"])
    finished = {task.name: records.whole(task.name, None if job["any_key"] else task.key) for task in tasks}
    missing = tuple(task.name for task in tasks if finished[task.name] is None)
    if len(missing) == len(tasks):
        raise ValueError(f"{output}: no task of its job is done, expected {', '.join(missing[:5])}; run it first")
    by_unit = (list(members) for _, members in groupby(tasks, key=lambda task: task.unit))
    units = [unit for members in by_unit if (unit := _unit(job, output, members, finished, progress)) is not None]
    # The problems of a bake name its objects already.
    is_plain = job["single"] or job["command"] == "bake"
    problems = [
        problem if is_plain else f"{name}: {problem}"
        for name, report in units
        for problem in report.get("problems", ())
    ]
    problems += [record["problem"] for record in finished.values() if record and "problem" in record]
    problems += _different_versions(finished)
    seconds = {task.name: _read_seconds(output, task) for task in tasks if finished[task.name] is not None}
    if job["single"] and units:
        report, seconds = units[0][1], _sum_of(seconds.values())
    else:
        reports = [{"name": name, **report} for name, report in units]
        report = {"command": job["command"], "reports": reports, "problems": problems}
    if missing:
        report = {**report, "missing": list(missing)}
    write_json(output / "report.json", report)
    write_json(output / "timing.json", {"seconds": seconds})
    if job["command"] == "compare" and "reports" in report:
        write_overview(output, "report.html", report)
    return Merged(report, seconds, missing, tuple(problems), job["command"], job["single"])


def _read_job(output: Path) -> dict:
    path = output / batch_tasks.FOLDER / "job.json"
    try:
        return batch_tasks.read_document(path, batch_tasks.JOB)
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(
            f"{output}: no task has finished there; expected the folder that was given to -o of shade, compare or bake"
        ) from None
    except OSError as error:
        raise OSError(f"{path}: cannot be read ({error.strerror})") from error
    except Malformed as error:
        raise ValueError(f"{path}: {error}; run the job again with --resume") from None


def _task_records(output, command) -> batch_tasks.Records:
    """The records of the tasks: with the report of a bake or, for all other commands, of a picture; or a problem."""
    report = bake.REPORT if command == "bake" else picture.REPORT
    return batch_tasks.Records(output, "tasks", {**batch_tasks.TASK_RECORD, "report?": report})


def _unit(job, output, tasks, finished, progress) -> tuple[str, dict] | None:
    """Name and report of one picture, or of all objects of one bake; None where none of its tasks is done."""
    records = [record for task in tasks if (record := finished[task.name]) and "report" in record]
    if not records:
        return None
    files = sorted(file for record in records for file in record["files"])
    reports = [record["report"] for record in records]
    if job["command"] != "bake":
        return tasks[0].name, reports[0] if job["single"] else {"files": files, **reports[0]}
    report = joined_bakes(reports)
    if job["applied_layer"] and report["objects"]:
        report["applied"] = bake_files.apply_textures(
            Path(tasks[0].scene), output, report, job["applied_layer"], progress
        )
    if job.get("exported_layers") and report["objects"]:
        exported = Path(tasks[0].scene), output, report, job["exported_layers"], progress
        report["exported"] = bake_files.export_glb(*exported)
    name = " ".join(str(word) for word in (Path(tasks[0].scene).stem, *tasks[0].unit[1:]) if word is not None)
    return name, report if job["single"] else {"files": files, **report}


def joined_bakes(reports: list[dict]) -> dict:
    """The report of a bake from those of its tasks, in which each object comes once with all of its tiles."""
    objects: dict[str, dict] = {}
    for item in (item for one in reports for item in one["objects"]):
        known = objects.setdefault(item["name"], {**item, "tiles": {}})
        known["tiles"] |= item["tiles"]
    return {
        **reports[0],
        "objects": list(objects.values()),
        "problems": list(dict.fromkeys(line for one in reports for line in one["problems"])),
        "warnings": grouped(line for one in reports for line in one["warnings"]),
    }


def _different_versions(records) -> list[str]:
    """The problem where shards ran on different versions, whose results must not be mixed; empty if they agree."""
    names = {}
    for name, record in records.items():
        if record and "report" in record:
            names.setdefault(json.dumps(record["report"]["versions"], sort_keys=True), name)
    if len(names) < 2:
        return []
    (first, a), (second, b) = list(names.items())[:2]
    return [f"{a} and {b} were made by different versions, {first} and {second}: do one of them again"]


def _timing_path(output, task) -> Path:
    return Path(output) / batch_tasks.FOLDER / "timing" / f"{task.name}.json"


def _read_seconds(output, task) -> dict:
    try:
        return read_json(_timing_path(output, task), picture.SECONDS)
    except (OSError, ValueError):
        return {}


def _sum_of(seconds) -> dict:
    """The sums of the seconds of several tasks, name by name."""
    total: dict = {}
    for one in seconds:
        for name, value in one.items():
            before = total.get(name)
            if isinstance(value, dict):
                total[name] = _sum_of([before if isinstance(before, dict) else {}, value])
            else:
                total[name] = value + (before if isinstance(before, NUMBER) else 0.0)
    return total
