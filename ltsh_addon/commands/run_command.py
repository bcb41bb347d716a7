"""`ltsh run JOB.toml`: the jobs of a file, one after another; `ltsh merge JOB.toml` for shards of them."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..comparison.baseline import Baseline
from ..jobs.job_file import Command, Wanted, read_jobs
from ..jobs.merge import merge
from ..shading import TableError
from . import bake_command, picture_commands
from . import common_options as options
from .job_runs import do_job, finish, print_json

DESCRIPTION = "Do the jobs of a file, each a shade, compare or bake, one after another."
EXAMPLES = """examples:
  %(prog)s night.toml
  %(prog)s night.toml --shard 1/4 --resume --log night.log

night.toml:
  [defaults]                       # for all jobs whose command has that option
  techniques = ["ltc", "ltsh4"]

  [[job]]
  command = "compare"              # or "bake" or "shade"
  scene = "room.blend"             # or scenes = [...]; paths are relative to the job file
  output = "out/room"              # a folder for each job
  frames = "1-240:10"              # options are named as on the command line, without the dashes
  camera = ["Left", "Right"]

  [[job]]
  command = "bake"
  scene = "room.blend"
  output = "out/textures"
  object = ["Floor", "Wall"]
  size = 2048
  error = true

All mistakes in the file are named with their lines, before anything starts. A job that fails is named, and the others
are done all the same.
"""


def add(parser) -> None:
    """Add the arguments and the function that runs."""
    options.with_examples(parser, DESCRIPTION, EXAMPLES)
    parser.add_argument("file", type=Path, metavar="JOB.toml", help="the jobs")
    options.add_batch(parser)
    options.add_talk(parser)
    parser.set_defaults(run=_run)


def commands() -> dict[str, Command]:
    """The commands that a job file may have."""
    found = {}
    for name, add_arguments, job_of in (
        ("shade", picture_commands.add_shade, picture_commands.job_of),
        ("compare", picture_commands.add_compare, picture_commands.job_of),
        ("bake", bake_command.add, bake_command.job_of),
    ):
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        add_arguments(parser)
        parser.set_defaults(command=name)
        found[name] = Command(parser, job_of)
    return found


def merge_jobs(path: Path, arguments, bar) -> int:
    """`ltsh merge` of every job of a file; 0, or 1 where something is missing or wrong."""
    return _each(
        read_jobs(path, commands()),
        lambda wanted, settings, baseline: finish(
            merge(wanted.job.options.output, bar), wanted.job.options.output, settings, bar, baseline
        ),
        arguments,
        bar,
    )


def _run(arguments, bar, open_file) -> int:
    return _each(
        read_jobs(arguments.file, commands()),
        lambda wanted, settings, baseline: do_job(wanted.job, settings, bar, baseline),
        arguments,
        bar,
    )


def _each(jobs: list[Wanted], do, arguments, bar) -> int:
    """Do something with every job; the world's faults in one do not keep the others from being done."""
    from ..blender.processes.child import SceneError

    baselines = [_baseline(wanted) for wanted in jobs]
    documents, worst = [], 0
    for number, (wanted, baseline) in enumerate(zip(jobs, baselines, strict=True), 1):
        settings = argparse.Namespace(**{**vars(arguments), "tolerance": getattr(wanted.arguments, "tolerance", None)})
        output = wanted.job.options.output
        label = f"job {number} of {len(jobs)} ({wanted.job.command}, {output})"
        bar.begin_job(label)
        try:
            document, code = do(wanted, settings, baseline)
        except (SceneError, TableError, OSError, ValueError, ImportError, MemoryError) as error:
            text = " ".join(str(error).split()) or type(error).__name__
            bar.note(f"failed: {label}: {text}")
            document, code = {"error": text}, 1
        documents.append({"command": wanted.job.command, "output": str(output), **document})
        worst = max(worst, code)
    if arguments.json:
        print_json({"jobs": documents})
    return worst


def _baseline(wanted) -> Baseline | None:
    path = getattr(wanted.arguments, "baseline", None)
    return None if path is None else Baseline.read(path)
