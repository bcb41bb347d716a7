"""`ltsh tables`: fit, validate, plot and export the lookup tables."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from ..shading import SHIPPED_TABLES
from . import argument_values as values
from .common_options import add_talk, with_examples
from .job_runs import print_json
from .progress_bar import say

DESCRIPTION = "Fit, measure and export the lookup tables. All but export need the source checkout and scipy."
EXAMPLES = """examples:
  %(prog)s export -o out/tables
  %(prog)s validate ltsh4 --json
  %(prog)s fit ltsh6 -o out/tables
"""
EXPORT = "Write each table as an EXR and as a header for C, C++ and GLSL; see tables/EXPORT.md."
EXPORT_EXAMPLES = """examples:
  %(prog)s -o out/tables
  %(prog)s ltsh4 my_table.npz -o out/tables --json
"""
SCRIPTS = {
    "fit": "fit tables to a BRDF, which takes hours",
    "validate": "errors of tables between their nodes",
    "optimum": "how good any table of a family could be",
    "plot": "the figures of tables/README.md",
}


def add(parser) -> None:
    """Add the arguments and the functions that run."""
    with_examples(parser, DESCRIPTION, EXAMPLES)
    actions = parser.add_subparsers(dest="action", required=True)
    for action, meaning in SCRIPTS.items():
        # The script parses its own options: nothing starts with this prefix, so that all of them are taken as they are.
        script = actions.add_parser(action, help=meaning, add_help=False, prefix_chars="\0")
        script.add_argument("arguments", nargs="*")
        script.set_defaults(run=_run_table_script, quiet=False, log=None)
    export = actions.add_parser("export", help="for other engines: an EXR, a header for C, C++ and GLSL")
    with_examples(export, EXPORT, EXPORT_EXAMPLES)
    export.add_argument("names", nargs="*", type=values.table, metavar="TABLE",
                        help="or a path (.npz); default: all shipped")  # fmt: skip
    export.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="folder for the files")
    add_talk(export, "name the files on stdout in one JSON document")
    export.set_defaults(run=_export_tables)


def _run_table_script(arguments, bar, open_file) -> int:
    root = Path(__file__).resolve().parents[2]
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
    from .. import table_export

    try:
        prefixes = table_export.export_prefixes(arguments.names or SHIPPED_TABLES)
    except ValueError as error:
        raise values.Misuse(str(error)) from error
    files = table_export.export_tables(prefixes, arguments.output, bar)
    bar.finish()
    paths = {name: [str(path) for path in written] for name, written in files.items()}
    if arguments.json:
        print_json({"tables": paths})
    else:
        say("\n".join(path for written in paths.values() for path in written), sys.stdout)
    return 0
