"""The command line, the same for `python -m ltsh_addon` and `blender --command ltsh`.

Exit codes: 0 done; 1 the world is wrong (a file, a scene, a folder); 2 the arguments are; 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import shlex
import sys

from . import __version__, cli_bake, cli_merge, cli_pictures, cli_run, cli_tables
from . import argument_values as values
from .job_file import Mistakes
from .output_names import NameClash
from .progress_bar import ProgressBar
from .run_log import RunLog
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
        options = _parser(program).parse_args(arguments)
    except SystemExit as stop:  # argparse has printed help (0) or the mistake (2)
        return int(stop.code or 0)
    try:
        log = RunLog(options.log)
    except OSError as error:
        return _fail(program, ProgressBar(sys.stderr), error, 1)
    with log:
        log.line(f"{program} {shlex.join(arguments)}")
        bar = bar or ProgressBar(sys.stderr, quiet=options.quiet, log=log)
        code = _run(options, program, bar, open_file)
        log.line(f"exit code {code}")
    return code


def _run(options, program: str, bar: ProgressBar, open_file: str | None) -> int:
    try:
        return options.run(options, bar, open_file)
    except Mistakes as error:
        for line in error.lines:
            _fail(program, bar, line, 2)
        return 1 if error.of_the_world else 2
    except (values.Misuse, NameClash) as error:
        return _fail(program, bar, error, 2)
    except (TableError, OSError, ValueError, ImportError, Cancelled, MemoryError) as error:
        return _fail(program, bar, error, 1)
    except KeyboardInterrupt:
        return _fail(program, bar, "interrupted", 130)
    except Exception as error:
        from .blender import child

        if isinstance(error, child.SceneError):
            return _fail(program, bar, error, 1)
        bar.finish()
        logging.getLogger(__name__).exception("unexpected error")
        return 1


def _fail(program, bar, error, code) -> int:
    bar.note(f"{program}: {' '.join(str(error).split()) or type(error).__name__}")
    return code


def _parser(program: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=program,
        description="Shade scenes under area lights with linearly transformed lobes and compare with Cycles.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    cli_pictures.add_demo(commands.add_parser("demo", help="build the example scene and run compare on it"))
    cli_pictures.add_compare(commands.add_parser("compare", help="techniques beside Cycles: EXR, sheet, report"))
    cli_pictures.add_shade(commands.add_parser("shade", help="shade per pixel of the camera"))
    cli_bake.add(commands.add_parser("bake", help="bake lighting and errors into the texels of UV maps"))
    cli_run.add(commands.add_parser("run", help="do the jobs of a file"))
    cli_merge.add(commands.add_parser("merge", help="assemble the report of what shards have done"))
    cli_tables.add(commands.add_parser("tables", help="fit, validate or export the lookup tables"))
    return parser
