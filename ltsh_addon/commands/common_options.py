"""Arguments that several commands have, and the job that they describe."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..comparison.baseline import Tolerance
from ..jobs import batch
from . import argument_values as values

SCENES = "SCENE.blend"


def add_output(parser) -> None:
    """-o."""
    parser.add_argument(
        "-o", dest="output", type=values.folder, required=True, metavar="OUT", help="folder for the results"
    )


def add_scenes(parser) -> None:
    """The files, cameras and frames, and names for what they make."""
    parser.add_argument("scenes", nargs="*", metavar=SCENES, help="one or more; left out when Blender has a file open")
    add_moments(parser, values.name_of_picture)


def add_moments(parser, name_pattern) -> None:
    """Frames, cameras, names of files."""
    parser.add_argument(
        "--frames", "--frame", dest="frames", type=values.frames, default=(), metavar="F",
        help="such as 12 or 1-240:2,300 (--frames=-10--1 where the first is negative); default: the file's current one",
    )  # fmt: skip
    parser.add_argument("--camera", action="append", metavar="NAME",
                        help="may be given several times; default: the scene's camera")  # fmt: skip
    parser.add_argument(
        "--name", type=name_pattern, metavar="PATTERN",
        help="of files, such as {scene}_{camera}_{frame:04d}; default: the command, or {object} of a bake, followed by "
        "those of scene, camera and frame of which there are several",
    )  # fmt: skip


def add_batch(parser) -> None:
    """What becomes of finished tasks, and which tasks are done."""
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--overwrite", dest="existing", action="store_const", const=batch.OVERWRITE,
                        help="do all again (default)")  # fmt: skip
    chosen.add_argument("--resume", dest="existing", action="store_const", const=batch.RESUME,
                        help="keep what the same options and files have made in OUT")  # fmt: skip
    chosen.add_argument("--skip-existing", dest="existing", action="store_const", const=batch.SKIP,
                        help="keep what is finished in OUT, whatever made it")  # fmt: skip
    parser.add_argument("--shard", type=values.shard, metavar="I/N",
                        help="do every N-th task from the I-th (1 to N) on; `merge` assembles")  # fmt: skip
    parser.set_defaults(existing=batch.OVERWRITE)


def add_trust(parser) -> None:
    """What may be done with files."""
    text = "run the scripts and Python drivers in the .blend, which is not done otherwise"
    parser.add_argument("--enable-autoexec", action="store_true", help=text)


def add_memory(parser, what: str) -> None:
    """How much memory there may be."""
    parser.add_argument(
        "--memory-limit", type=values.memory, default=0, metavar="SIZE",
        help=f"such as 8G or 500M; a {what} that needs more is refused (default: what is free)",
    )  # fmt: skip


def add_baseline(parser) -> None:
    """Regression of a comparison."""
    parser.add_argument("--baseline", type=Path, metavar="REPORT",
                        help="report.json of an earlier comparison: exit code 1 where an error got worse")  # fmt: skip
    parser.add_argument(
        "--tolerance", type=values.tolerance, default=Tolerance(), metavar="X",
        help="how much worse is let pass: 0.002 (a fifth of a percent) or 10%% of the baseline's error "
        "(default: 0.001)",
    )  # fmt: skip


def add_talk(parser, json_meaning: str = "print the report on stdout as one JSON document") -> None:
    """What is printed."""
    parser.add_argument("--json", action="store_true", help=json_meaning)
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.add_argument("--log", type=Path, metavar="FILE", help="append to FILE what was done when")


def with_examples(parser, description: str, examples: str) -> None:
    """Show `description` above the options and `examples` below, as they are."""
    parser.description, parser.epilog = description, examples
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def cameras(arguments) -> tuple[str, ...]:
    """The cameras that were named, each once."""
    return tuple(dict.fromkeys(arguments.camera or ()))
