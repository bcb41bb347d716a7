"""Doing a job from the command line: its tasks, or a shard of them, and what is printed at the end."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from ..imaging.report import json_text
from ..pipeline.baseline import Baseline
from ..pipeline.batch import Merged, merge, run_tasks
from ..pipeline.tasks import Job
from .progress import print_out


def do_job(job: Job, arguments, bar, baseline: Baseline | None = None) -> tuple[dict, int]:
    """Do the job, or its shard; the document for --json, and the exit code: 1 where something is wrong."""
    shard = arguments.shard or (1, 1)

    def tell(state):
        if state.seconds is None:
            bar.begin_task(state.number, state.tasks)
        else:
            bar.end_task(state.name, state.seconds, state.problem is not None)

    done = run_tasks(job, shard=shard, existing=arguments.existing, progress=bar, tell=tell)
    if shard[1] == 1:
        if done.kept:
            bar.remark(f"{done.kept} of {done.tasks} tasks were there already")
        return merge_job(job.options.output, arguments, bar, baseline)
    bar.finish()
    text = f"{shard[0]}/{shard[1]}"
    kept = f" ({done.kept} were there already)" if done.kept else ""
    tasks = "1 task" if done.tasks == 1 else f"{done.tasks} tasks"
    _complain(bar, "problem", done.problems)
    _print(f"shard {text}: {tasks} done{kept}; when all are: merge {job.options.output}", arguments, bar)
    return {"shard": text, **vars(done)}, 1 if done.problems else 0


def merge_job(output: Path, arguments, bar, baseline: Baseline | None = None) -> tuple[dict, int]:
    """Assemble and print what a whole job has made; the document for --json, and the exit code as of `do_job`."""
    merged = merge(output, bar)
    bar.finish()
    _complain(bar, "not baked" if merged.command == "bake" else "failed", merged.problems)
    if not arguments.json:
        _complain(bar, "warning", _warnings(merged))
    _print(_summary(merged, output), arguments, bar)
    _complain(bar, "missing", merged.missing)
    worse = []
    if baseline is not None:
        if merged.command != "compare":
            raise ValueError(f"{output}: holds what {merged.command} has made, expected comparisons beside a baseline")
        worse = baseline.worse(merged.report, arguments.tolerance)
        _complain(bar, "worse", worse)
    document = merged.report if baseline is None else {**merged.report, "worse": worse}
    if merged.command == "view":
        from ..pipeline import view

        document = view.with_times(document, merged.seconds)
    return document, 1 if merged.missing or merged.problems or worse else 0


def print_json(document) -> None:
    """One document on stdout, in ASCII: a redirected stdout may lack the letters of a light's name."""
    print_out(json.dumps(json.loads(json_text(document)), indent=2))


def baseline_of(arguments) -> Baseline | None:
    """What --baseline names, read before anything is done."""
    path = getattr(arguments, "baseline", None)
    return None if path is None else Baseline.read(path)


def _print(text, arguments, bar) -> None:
    bar.log.line(text.splitlines()[-1])
    if not arguments.json:
        print_out(text)


def _complain(bar, what: str, lines) -> None:
    for line in dict.fromkeys(lines):
        bar.note(f"{what}: {line}")


def _warnings(merged) -> list[str]:
    reports = [merged.report] if merged.single else merged.report["reports"]
    return list(dict.fromkeys(line for report in reports for line in report.get("warnings", ())))


def _summary(merged: Merged, output) -> str:
    from ..pipeline import bake, picture, view

    tables = {"bake": bake, "view": view}.get(merged.command, picture)
    if merged.single and "reports" not in merged.report:
        lines = tables.summary(merged.report, merged.seconds)
    else:
        lines = [line for report in merged.report["reports"] for line in tables.brief(report)]
    return "\n".join([*(line.rstrip() for line in lines), f"written to {output}"])


def reserve_stdout() -> None:
    """Keep stdout for what sys.stdout prints: from now on, Blender's own lines (from C) go to stderr."""
    if sys.stdout is None:
        return
    sys.stdout.flush()
    ours = os.dup(1)
    os.dup2(2, 1)
    sys.stdout = open(ours, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors, buffering=1)
