"""The command line, the same for `python -m ltsh_addon` and `blender --command ltsh`.

Exit codes: 0 done; 1 the world is wrong (a file, a scene, a folder); 2 the arguments are; 130 interrupted by Ctrl-C;
143 ended by SIGTERM.
"""

from __future__ import annotations

import argparse
import logging
import shlex
import sys

from . import __version__, interruption
from .commands import argument_values as values
from .commands import bake_command, merge_command, picture_commands, run_command, tables_command
from .commands.job_runs import print_json
from .commands.progress_bar import ProgressBar
from .commands.run_log import RunLog
from .jobs.job_file import Mistakes
from .jobs.output_names import NameClash
from .scene import Cancelled
from .shading import TableError

EXAMPLES = """examples:
  %(prog)s demo -o out/demo
  %(prog)s compare room.blend -o out/room --resolution 960x540 --cycles-samples 1024
  %(prog)s shade room.blend -o out/room --techniques ltsh4 --aa 16
  %(prog)s bake room.blend -o out/room --object Floor --size 2048 --error
  %(prog)s compare room.blend -o out/room --frames 1-240 --shard 1/4 --resume
  %(prog)s merge out/room
  %(prog)s run night.toml
"""


def main(arguments: list[str], program: str = "ltsh", open_file: str | None = None, bar=None) -> int:
    """Run the command line; `open_file` is the .blend that the running Blender has open. Returns the exit code.

    `bar` shows progress in place of a ProgressBar on stderr.
    """
    try:
        with interruption.raised(program):
            return _main(arguments, program, open_file, bar)
    except KeyboardInterrupt as error:
        lines = [f"{program}: {interruption.message(error)}"]
        return _fail("--json" in arguments, bar or ProgressBar(sys.stderr), lines, interruption.exit_code(error))


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with arguments in one line."""

    def error(self, message):
        raise values.Misuse(f"{self.prog}: {message}; see {self.prog} --help")


def _main(arguments, program, open_file, bar) -> int:
    try:
        options = _parser(program).parse_args(arguments)
    except SystemExit as stop:  # argparse has printed help
        return int(stop.code or 0)
    except values.Misuse as error:
        return _fail("--json" in arguments, bar or ProgressBar(sys.stderr), [str(error)], 2)
    try:
        log = RunLog(options.log)
    except OSError as error:
        return _fail(getattr(options, "json", False), bar or ProgressBar(sys.stderr), [f"{program}: {error}"], 1)
    with log:
        log.line(f"{program} {shlex.join(arguments)}")
        bar = bar or ProgressBar(sys.stderr, quiet=options.quiet, log=log)
        code = _run(options, program, bar, open_file)
        log.line(f"exit code {code}")
    return code


def _run(options, program: str, bar: ProgressBar, open_file: str | None) -> int:
    try:
        return options.run(options, bar, open_file)
    except (Exception, KeyboardInterrupt) as error:
        lines, code = _explained(error)
        return _fail(getattr(options, "json", False), bar, [f"{program}: {line}" for line in lines], code)


def _explained(error) -> tuple[list[str], int]:
    """What is to be said about an error, and the exit code."""
    from .blender.processes import child

    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, Mistakes):
        return error.lines, 1 if error.of_the_world else 2
    if isinstance(error, values.Misuse | NameClash):
        return [text], 2
    if isinstance(error, KeyboardInterrupt):
        return [interruption.message(error)], interruption.exit_code(error)
    if not isinstance(
        error, TableError | OSError | ValueError | ImportError | Cancelled | MemoryError | child.SceneError
    ):
        logging.getLogger(__name__).error("unexpected error", exc_info=error)
        text = f"unexpected error: {type(error).__name__}: {text}"
    return [text], 1


def _fail(as_json: bool, bar, lines: list[str], code: int) -> int:
    """Say what is wrong on stderr, and on stdout where a document is expected there; the exit code."""
    for line in lines:
        bar.note(line)
    if as_json:
        print_json({"errors": lines})
    return code


def _parser(program: str) -> argparse.ArgumentParser:
    parser = _Parser(
        prog=program,
        description="Shade scenes under area lights with linearly transformed lobes and compare with Cycles.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    picture_commands.add_demo(commands.add_parser("demo", help="build the example scene and run compare on it"))
    picture_commands.add_compare(commands.add_parser("compare", help="techniques beside Cycles: EXR, sheet, report"))
    picture_commands.add_shade(commands.add_parser("shade", help="shade per pixel of the camera"))
    bake_command.add(commands.add_parser("bake", help="bake lighting and errors into the texels of UV maps"))
    run_command.add(commands.add_parser("run", help="do the jobs of a file"))
    merge_command.add(commands.add_parser("merge", help="assemble the report of what shards have done"))
    tables_command.add(commands.add_parser("tables", help="fit, validate or export the lookup tables"))
    return parser
