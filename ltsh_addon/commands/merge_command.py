"""`ltsh merge`: the report of a job whose tasks shards have done."""

from __future__ import annotations

from pathlib import Path

from . import common_options as options
from .argument_values import Misuse
from .job_runs import merge_folder
from .run_command import merge_jobs

DESCRIPTION = "Write report.json and timing.json of all that the shards of a job have done in OUT."
EXAMPLES = """examples:
  %(prog)s out/room
  %(prog)s out/room --json > room.json
  %(prog)s night.toml

What is missing is named, and the exit code is 1; the command with --resume and the same --shard does it.
"""


def add(parser) -> None:
    """Add the arguments and the function that runs."""
    options.with_examples(parser, DESCRIPTION, EXAMPLES)
    parser.add_argument("output", type=Path, metavar="OUT", help="the folder that -o named, or JOB.toml of `run`")
    options.add_baseline(parser)
    options.add_talk(parser)
    parser.set_defaults(run=_run)


def _run(arguments, bar, open_file) -> int:
    if arguments.output.suffix == ".toml" and not arguments.output.is_dir():
        if arguments.baseline is not None:
            raise Misuse("--baseline belongs into the job file, to the job that it is for")
        return merge_jobs(arguments.output, arguments, bar)
    return merge_folder(arguments, bar)
