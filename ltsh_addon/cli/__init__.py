"""The command line, the same for `python -m ltsh_addon` and `blender --command ltsh`.

Exit codes: 0 done; 1 a file, scene or folder is wrong; 2 the arguments are wrong; 130 interrupted by Ctrl-C; 143 ended
by SIGTERM.
"""

import argparse
import contextlib
import errno
import re
import shlex
import sys

from .. import interruption
from ..pipeline.tasks import NameClash
from ..reading import is_text
from ..scene import VERSION, Cancelled, SceneError, error_line, unexpected_error_line
from ..shading import TableError
from .arguments import Mistakes, Misuse
from .commands import add_demo, add_job, add_match, add_merge, add_relight, add_run
from .progress import ProgressBar, RunLog, print_json, print_out

EXAMPLES = """examples:
  %(prog)s demo -o out/demo
  %(prog)s compare room.blend -o out/room --resolution 960x540 --cycles-samples 1024
  %(prog)s shade room.blend -o out/room --resolution 960x540 --aa 16
  %(prog)s render room.blend -o out/room --budget 30
  %(prog)s bake room.blend -o out/room --object Floor --size 2048 --error
  %(prog)s compare room.blend -o out/room --frames 1-240 --shard 1/4 --resume
  %(prog)s merge out/room
  %(prog)s run night.toml

exit codes: 0 done; 1 a file, scene or folder is wrong; 2 the arguments are; 130 Ctrl-C; 143 SIGTERM
"""


def main(arguments: list[str], program: str = "ltsh", open_file: str | None = None, bar=None) -> int:
    """Run the command line and return the exit code.

    `open_file` is the .blend that the running Blender has open. `bar` shows progress in place of a ProgressBar on
    stderr.
    """
    try:
        with interruption.raised(program):
            return _main(arguments, program, open_file, bar)
    except KeyboardInterrupt as error:
        lines = [f"{program}: {interruption.message(error)}"]
        return _fail("--json" in arguments, bar or ProgressBar(sys.stderr), lines, interruption.exit_code(error))


class _Parser(argparse.ArgumentParser):
    """A parser that reports wrong arguments in one line (Misuse), and prints help on stdout like results."""

    def _print_message(self, message, file=None):
        print_out(message.rstrip("\n"))

    def error(self, message):
        raise Misuse(f"{self.prog}: {message}; see {self.prog} --help")


def _main(arguments, program, open_file, bar) -> int:
    try:
        options = _parsed(program, arguments)
    except SystemExit as stop:  # argparse has printed help
        return int(stop.code or 0)
    except Misuse as error:
        return _fail("--json" in arguments, bar or ProgressBar(sys.stderr), [error_line(error)], 2)
    except OSError as error:  # printing help
        return _fail(False, ProgressBar(sys.stderr), [f"{program}: {error}"], 1)
    with RunLog(options.log) as log:
        log.line(f"{program} {shlex.join(arguments)}")
        bar = bar or ProgressBar(sys.stderr, quiet=options.quiet, log=log)
        if log.problem:
            return _fail(getattr(options, "json", False), bar, [f"{program}: {log.problem}"], 1)
        code = _run(options, program, bar, open_file)
        log.line(f"exit code {code}")
        if log.problem:
            bar.note(f"{program}: {log.problem}")
    return code or (1 if log.problem else 0)


def _run(options, program: str, bar: ProgressBar, open_file: str | None) -> int:
    try:
        return options.run(options, bar, open_file)
    except (Exception, KeyboardInterrupt) as error:
        lines, code = _explained(error)
        return _fail(getattr(options, "json", False), bar, [f"{program}: {line}" for line in lines], code)


def _explained(error) -> tuple[list[str], int]:
    """The lines to print about an error, and the exit code."""
    text = error_line(error)
    if isinstance(error, OSError) and error.errno == errno.EMFILE:
        text = "this process may not open as many files as it needs; raise the limit (ulimit -n)"
    if isinstance(error, Mistakes):
        return error.lines, 1 if error.of_the_world else 2
    if isinstance(error, Misuse | NameClash):
        return [text], 2
    if isinstance(error, KeyboardInterrupt):
        return [interruption.message(error)], interruption.exit_code(error)
    if not isinstance(error, TableError | OSError | ValueError | ImportError | Cancelled | MemoryError | SceneError):
        text = unexpected_error_line(error)
    return [text], 1


def _fail(as_json: bool, bar, lines: list[str], code: int) -> int:
    """Print errors on stderr, and with --json as a document on stdout; returns the exit code."""
    for line in lines:
        bar.note(line)
    if as_json:
        with contextlib.suppress(OSError):
            print_json({"errors": lines})
    return code


def _parsed(program: str, arguments: list[str]) -> argparse.Namespace:
    """The parsed arguments. Raises Misuse."""
    if wrong := [word for word in arguments if not is_text(word)]:
        raise Misuse(f"{program}: argument {wrong[0]!r} has bytes that are not UTF-8; rename what it names")
    parser, commands = _parser(program)
    if arguments and not arguments[0].startswith("-") and arguments[0] not in commands:
        known = f"expected one of {', '.join(commands)}"
        raise Misuse(f"{program}: command {arguments[0]!r} is unknown ({known}); see {program} --help")
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        raise Misuse(_unknown_argument(options, unknown, commands))
    return options


def _unknown_argument(options, unknown: list[str], commands: dict) -> str:
    """Error text for arguments that the command does not have."""
    program = commands[options.command].prog
    name = next((word.partition("=")[0] for word in unknown if word.startswith("-")), None)
    if name is None:
        hint = " (name all files one after another)" if getattr(options, "scenes", None) else ""
        return f"{program}: {unknown[0]!r} is not expected here{hint}; see {program} --help"
    known = {command: re.findall(r"--[\w-]+", parser.format_help()) for command, parser in commands.items()}
    owners = [command for command, names in known.items() if name in names]
    hint = f" (an option of {', '.join(owners)})" if owners else ""
    return f"{program}: option {name} is unknown here{hint}; see {program} --help"


def _parser(program: str) -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser, and the parsers of the commands by name."""
    parser = _Parser(
        prog=program,
        description="Shade scenes under area lights with linearly transformed lobes and compare with Cycles.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {VERSION}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, add, meaning in (
        ("demo", add_demo, "write the example scene and run compare on it"),
        ("compare", add_job, "techniques beside Cycles: EXR, sheet, report"),
        ("shade", add_job, "shade per pixel of the camera"),
        ("bake", add_job, "bake lighting and errors into the texels of UV maps"),
        ("view", add_job, "the viewport's own picture, without a window"),
        ("render", add_job, "the finished picture: direct light by LTSH, the rest by Cycles, denoised"),
        ("relight", add_relight, "other powers and colors of lights in pictures that are there"),
        ("match", add_match, "powers and colors of lights for which the scene looks like a picture"),
        ("run", add_run, "do the jobs of a file"),
        ("merge", add_merge, "assemble the report of what shards have done"),
    ):
        add(commands.add_parser(name, help=meaning), *([name] if add is add_job else []))
    return parser, commands.choices
