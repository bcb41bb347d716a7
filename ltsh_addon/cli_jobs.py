"""Doing a job from the command line: its tasks, or a shard of them, and what is printed at the end."""

from __future__ import annotations

import json
import sys

from .batch import run_tasks
from .imaging.report import json_text
from .merge import Merged, merge
from .progress_bar import say
from .tasks import Job


def run_job(job: Job, arguments, bar) -> int:
    """Do the job, or its shard; 0, or 1 where something of it is wrong."""
    shard = arguments.shard or (1, 1)
    done = run_tasks(job, shard=shard, existing=arguments.existing, progress=bar)
    if shard[1] == 1:
        return finish(merge(job.options.output, bar), arguments, bar)
    bar.finish()
    text = f"{shard[0]}/{shard[1]}"
    if arguments.json:
        print_json({"shard": text, **vars(done)})
    else:
        kept = f" ({done.kept} were there already)" if done.kept else ""
        say(f"shard {text}: {done.tasks} tasks done{kept}; when all are: merge {job.options.output}", sys.stdout)
    _complain("problem", done.problems)
    return 1 if done.problems else 0


def finish(merged: Merged, arguments, bar) -> int:
    """Print what a whole job has made; 0, or 1 where something of it is missing or wrong."""
    bar.finish()
    if arguments.json:
        print_json(merged.report)
    else:
        _complain("warning", _warnings(merged))
        say(_summary(merged, arguments.output), sys.stdout)
    _complain("not baked" if merged.command == "bake" else "failed", merged.problems)
    _complain("missing", merged.missing)
    return 1 if merged.missing or merged.problems else 0


def print_json(document) -> None:
    """One document on stdout, in ASCII: a redirected stdout may lack the letters of a light's name."""
    say(json.dumps(json.loads(json_text(document)), indent=2), sys.stdout)


def _complain(what: str, lines) -> None:
    for line in dict.fromkeys(lines):
        say(f"{what}: {line}", sys.stderr)


def _warnings(merged) -> list[str]:
    reports = [merged.report] if merged.single else merged.report["reports"]
    return list(dict.fromkeys(line for report in reports for line in report.get("warnings", ())))


def _summary(merged: Merged, output) -> str:
    from . import bake_summary, comparison_summary

    tables = bake_summary if merged.command == "bake" else comparison_summary
    if merged.single and "reports" not in merged.report:
        lines = tables.lines(merged.report, merged.seconds)
    else:
        lines = [line for report in merged.report["reports"] for line in tables.short_lines(report)]
    return "\n".join([*lines, f"written to {output}"])
