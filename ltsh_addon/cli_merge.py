"""`ltsh merge`: the report of a job whose tasks shards have done."""

from __future__ import annotations

from pathlib import Path

from . import cli_options as options
from .cli_jobs import finish
from .merge import merge

EXAMPLES = """examples:
  %(prog)s out/room
  %(prog)s out/room --json > room.json

Writes report.json and timing.json. What is missing is named, and the exit code is 1; the same command with --resume
and the same --shard does what is missing.
"""


def add(parser) -> None:
    """Add the arguments and the function that runs."""
    options.with_examples(parser, EXAMPLES)
    parser.add_argument("output", type=Path, metavar="OUT", help="the folder that -o named")
    options.add_talk(parser)
    parser.set_defaults(run=_run)


def _run(arguments, bar, open_file) -> int:
    return finish(merge(arguments.output, bar), arguments, bar)
