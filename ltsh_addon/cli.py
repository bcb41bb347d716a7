"""The command line, the same for `python -m ltsh_addon` and `blender --command ltsh`.

Exit codes: 0 done; 1 the world is wrong (a file, a scene, a folder); 2 the arguments are; 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import os
import subprocess
import sys
from pathlib import Path

from . import __version__, cli_bake
from . import argument_values as values
from .compare import DEFAULT_TECHNIQUES, Options, compare_scene, prepare, shade_scene
from .progress_bar import ProgressBar, say
from .scene import Cancelled
from .shading import PASSES, SHIPPED_TABLES, TableError

EXAMPLES = """examples:
  %(prog)s demo -o out/demo
  %(prog)s compare room.blend -o out/room --resolution 960x540 --cycles-samples 1024
  %(prog)s shade room.blend -o out/room --techniques ltsh4 --aa 16
  %(prog)s bake room.blend -o out/room --object Floor --size 2048 --error
"""
DEMO_RESOLUTION = (480, 270)


def main(arguments: list[str], program: str = "ltsh", open_file: str | None = None, bar=None) -> int:
    """Run the command line; `open_file` is the .blend that the running Blender has open. Returns the exit code.

    `bar` shows progress in place of a ProgressBar on stderr.
    """
    try:
        options = _parser(program).parse_args(arguments)
    except SystemExit as stop:  # argparse has printed help (0) or the mistake (2)
        return int(stop.code or 0)
    bar = bar or ProgressBar(sys.stderr, quiet=options.quiet)
    try:
        return options.run(options, bar, open_file)
    except values.Misuse as error:
        return _fail(program, bar, error, 2)
    except (TableError, OSError, ValueError, ImportError, Cancelled, MemoryError) as error:
        return _fail(program, bar, error, 1)
    except KeyboardInterrupt:
        return _fail(program, bar, "interrupted", 130)
    except Exception as error:
        from .blender import child

        if isinstance(error, child.SceneError | child.Cancelled):
            return _fail(program, bar, error, 1)
        bar.finish()
        logging.getLogger(__name__).exception("unexpected error")
        return 1


def _fail(program, bar, error, code) -> int:
    bar.finish()
    say(f"{program}: {' '.join(str(error).split()) or type(error).__name__}", sys.stderr)
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
    demo = commands.add_parser("demo", help="build the example scene and run compare on it")
    _add_common(demo, cycles=True, resolution="{}x{}".format(*DEMO_RESOLUTION))
    demo.set_defaults(run=_demo)
    compare = commands.add_parser("compare", help="techniques beside Cycles: EXR layers, sheet, report")
    _add_scene(compare)
    _add_common(compare, cycles=True)
    compare.set_defaults(run=_compare)
    shade = commands.add_parser("shade", help="shade per pixel of the camera")
    _add_scene(shade)
    _add_common(shade, cycles=False)
    shade.set_defaults(run=_shade)
    cli_bake.add(commands.add_parser("bake", help="bake lighting and errors into the texels of UV maps"))
    _add_tables(commands.add_parser("tables", help="fit, validate or export the lookup tables"))
    return parser


def _add_tables(parser):
    actions = parser.add_subparsers(dest="action", required=True)
    for action in ("fit", "validate", "optimum", "plot"):
        # The script parses its own options: nothing starts with this prefix, so that all of them are taken as they are.
        script = actions.add_parser(action, help="in the source checkout", add_help=False, prefix_chars="\0")
        script.add_argument("arguments", nargs="*")
        script.set_defaults(run=_run_table_script, quiet=False)
    export = actions.add_parser("export", help="an EXR and a C, C++ and GLSL header of each, for other engines")
    export.add_argument("names", nargs="*", type=values.table, metavar="TABLE",
                        help="or a path (.npz); default: all shipped")  # fmt: skip
    export.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="folder for the files")
    export.add_argument("--json", action="store_true", help="name the files on stdout in one JSON document")
    export.add_argument("--quiet", action="store_true", help="no progress on stderr")
    export.set_defaults(run=_export_tables)


def _add_scene(parser):
    parser.add_argument("scene", nargs="?", metavar="SCENE.blend", help="left out when Blender has a file open")


def _add_common(parser, *, cycles, resolution="as in the file"):
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="folder for the results")
    names = ",".join(DEFAULT_TECHNIQUES)
    parser.add_argument("--techniques", type=values.techniques, default=DEFAULT_TECHNIQUES, help=f"default: {names}")
    parser.add_argument("--passes", type=values.passes, default=PASSES, help=f"default: {','.join(PASSES)}")
    parser.add_argument("--resolution", type=values.resolution, metavar="WxH", help=f"default: {resolution}")
    parser.add_argument("--aa", type=values.positive, default=1, metavar="N",
                        help="points per pixel, drawn from its filter; 1: pixel centers")  # fmt: skip
    parser.add_argument("--frame", type=values.frame, metavar="F", help="default: the file's current frame")
    parser.add_argument("--camera", metavar="NAME", help="default: the scene's camera")
    parser.add_argument(
        "--reference-samples",
        type=values.positive,
        default=Options.reference_samples,
        metavar="N",
        help="'reference' takes a random subset of this size where there are more samples (default: %(default)s)",
    )
    if cycles:
        parser.add_argument(
            "--cycles-samples", type=values.cycles_samples, default=Options.cycles_samples, metavar="N",
            help="of both halves of the Cycles reference together (default: %(default)s)",
        )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report on stdout as one JSON document")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")


def _options(arguments, scene: Path, output: Path, resolution=None) -> Options:
    width, height = arguments.resolution or resolution or (None, None)
    return Options(
        scene=scene,
        output=output,
        techniques=arguments.techniques,
        passes=arguments.passes,
        width=width,
        height=height,
        sub_samples=arguments.aa,
        frame=arguments.frame,
        camera=arguments.camera,
        cycles_samples=getattr(arguments, "cycles_samples", 0),
        reference_samples=arguments.reference_samples,
    )


def _demo(arguments, bar, open_file) -> int:
    from .blender import child

    scene = arguments.output / "demo.blend"
    options = _options(arguments, scene, arguments.output, DEMO_RESOLUTION)
    prepare(options)
    child.build_demo(scene, progress=bar)
    return _finish(arguments, bar, compare_scene(options, bar))


def _compare(arguments, bar, open_file) -> int:
    options = _options(arguments, values.scene(arguments, open_file), arguments.output)
    return _finish(arguments, bar, compare_scene(options, bar))


def _shade(arguments, bar, open_file) -> int:
    options = _options(arguments, values.scene(arguments, open_file), arguments.output)
    return _finish(arguments, bar, shade_scene(options, bar))


def _finish(arguments, bar, report) -> int:
    from .comparison_output import summary
    from .imaging import report as report_files

    bar.finish()
    if arguments.json:
        # ASCII only: a redirected stdout may have an encoding that lacks the letters of a light's name.
        say(json.dumps(json.loads(report_files.json_text(report)), indent=2), sys.stdout)
        return 0
    for warning in report["warnings"]:
        say(f"warning: {warning}", sys.stderr)
    say(summary(report, arguments.output), sys.stdout)
    return 0


def _run_table_script(arguments, bar, open_file) -> int:
    root = Path(__file__).resolve().parents[1]
    if not (root / "tables" / "fit.py").is_file():
        needed = "the source checkout with tables/fit.py"
        raise values.Misuse(f"tables {arguments.action} needs {needed}, which is not here")
    for library in ("scipy", *(["matplotlib"] if arguments.action == "plot" else [])):
        if importlib.util.find_spec(library) is None:
            fix = f"install it with `pip install {library}`"
            raise values.Misuse(f"tables {arguments.action} needs {library}, which is not here; {fix}")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "tables", arguments.action, *arguments.arguments]
    return subprocess.run(command, env=environment, check=False).returncode


def _export_tables(arguments, bar, open_file) -> int:
    from . import table_export

    try:
        prefixes = table_export.export_prefixes(arguments.names or SHIPPED_TABLES)
    except ValueError as error:
        raise values.Misuse(str(error)) from error
    files = table_export.export_tables(prefixes, arguments.output, bar)
    bar.finish()
    paths = {name: [str(path) for path in written] for name, written in files.items()}
    if arguments.json:
        say(json.dumps({"tables": paths}, indent=2), sys.stdout)
    else:
        say("\n".join(path for written in paths.values() for path in written), sys.stdout)
    return 0
