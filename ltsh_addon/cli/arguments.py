"""Arguments of the command line: their values, and those that commands share."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

from ..pipeline import batch, tasks
from ..pipeline.baseline import Tolerance
from ..pipeline.picture import DEFAULT_TECHNIQUES, known_technique
from ..shading import PASSES, SHIPPED_TABLES

# Blender's own limits: of a side of the picture in pixels, and of frames.
SMALLEST_SIDE, LARGEST_SIDE = 4, 65536
LAST_FRAME = 1048574
# Of both halves of a Cycles reference: Cycles takes so many for each.
MOST_CYCLES_SAMPLES = 2 << 24
MOST_FRAMES = 100_000
TECHNIQUES_HELP = "ltc, ltsh2, ltsh4, reference or paths of tables (.npz), separated by commas"
_FRAMES = re.compile(r"(-?\d+)(?:-(-?\d+)(?::(\d+))?)?", re.ASCII)


class Misuse(Exception):
    """The arguments do not make sense together."""


def techniques(text: str) -> tuple[str, ...]:
    """Names of techniques, or paths of tables, separated by commas."""
    names = tuple(dict.fromkeys(name for name in text.split(",") if name))
    unknown = [name for name in names if not known_technique(name)]
    if unknown or not names:
        raise argparse.ArgumentTypeError(
            f"technique {(unknown or [text])[0]!r} is unknown, expected some of {', '.join(DEFAULT_TECHNIQUES)} "
            "or the path of a table (.npz)"
        )
    return names


def table(text: str) -> str:
    """A shipped table or a path."""
    if text in SHIPPED_TABLES or text.endswith(".npz"):
        return text
    raise argparse.ArgumentTypeError(
        f"table {text!r} is unknown, expected some of {', '.join(SHIPPED_TABLES)} or the path of a table (.npz)"
    )


def passes(text: str) -> tuple[str, ...]:
    """Passes separated by commas."""
    names = tuple(dict.fromkeys(name for name in text.split(",") if name))
    if not names or any(name not in PASSES for name in names):
        raise argparse.ArgumentTypeError(f"passes are {text!r}, expected some of {', '.join(PASSES)}")
    return names


def resolution(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels."""
    width, separator, height = text.partition("x")
    if separator and width.isdecimal() and height.isdecimal():
        size = int(width), int(height)
        if SMALLEST_SIDE <= min(size) and max(size) <= LARGEST_SIDE:
            return size
    raise argparse.ArgumentTypeError(
        f"resolution is {text!r}, expected WIDTHxHEIGHT such as 960x540, each from {SMALLEST_SIDE} to {LARGEST_SIDE}"
    )


def frames(text: str) -> tuple[int, ...]:
    """Frame numbers: single ones and ranges FIRST-LAST or FIRST-LAST:STEP, separated by commas; each once."""
    found: dict[int, None] = {}
    for part in text.split(","):
        match = _FRAMES.fullmatch(part.strip())
        first, last, step = (None if group is None else int(group) for group in match.groups()) if match else [None] * 3
        if first is None or max(abs(first), abs(last or 0)) > LAST_FRAME:
            raise argparse.ArgumentTypeError(
                f"frame is {part!r}, expected a whole number from -{LAST_FRAME} to {LAST_FRAME}, or a range such as "
                "1-240 or 1-240:2"
            )
        if last is not None and (last < first or step == 0):
            raise argparse.ArgumentTypeError(f"frames are {part!r}, expected FIRST-LAST:STEP, upwards, STEP above 0")
        if len(found) + ((first if last is None else last) - first) // (step or 1) >= MOST_FRAMES:
            raise argparse.ArgumentTypeError(f"frames are {text[:80]!r}, expected at most {MOST_FRAMES} of them")
        found.update(dict.fromkeys(range(first, (first if last is None else last) + 1, step or 1)))
    return tuple(found)


def shard(text: str) -> tuple[int, int]:
    """I/N with 1 <= I <= N."""
    number, separator, count = text.partition("/")
    if separator and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count):
        return int(number), int(count)
    raise argparse.ArgumentTypeError(f"shard is {text!r}, expected I/N with I from 1 to N, such as 1/4 to 4/4")


def tolerance(text: str) -> Tolerance:
    """A number, or a percentage of what it is compared with."""
    number, relative = text.removesuffix("%"), text.endswith("%")
    try:
        value = float(number) / (100.0 if relative else 1.0)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"tolerance is {text!r}, expected a number such as 0.002, or 10%")
    return Tolerance(value, relative)


def memory(text: str) -> int:
    """MiB of a size such as 8G, 500M or 2048 (MiB)."""
    number, unit = (text[:-1], text[-1:].upper()) if text[-1:].isalpha() else (text, "M")
    if number.isascii() and number.isdecimal() and unit in ("M", "G") and int(number) > 0:
        return int(number) * (1024 if unit == "G" else 1)
    raise argparse.ArgumentTypeError(f"size is {text!r}, expected a size such as 8G or 500M")


def folder(text: str) -> Path:
    """The name of a folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name of the folder is empty (a shell variable that is not set?)")
    return Path(text)


def name_of_picture(text: str) -> str:
    """A pattern for the names of pictures."""
    return _pattern(text, tuple(name for name in tasks.FIELDS if name != "object"))


def name_of_bake(text: str) -> str:
    """A pattern for the names of baked objects."""
    return _pattern(text, tasks.FIELDS)


def _pattern(text, fields):
    try:
        return tasks.check_pattern(text, fields)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def positive(text: str) -> int:
    """A whole number above 0."""
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} was given, expected a whole number above 0")


def cycles_samples(text: str) -> int:
    """Samples of both halves of a Cycles reference together."""
    value = positive(text)
    if value < 2:
        raise argparse.ArgumentTypeError("1 was given, expected at least 2: one for each half")
    if value > MOST_CYCLES_SAMPLES:
        raise argparse.ArgumentTypeError(f"{value} was given, expected at most {MOST_CYCLES_SAMPLES}")
    return value


def scenes(arguments, open_file: str | None) -> tuple[Path, ...]:
    """The files to work on: those named, or the one that Blender has open. Raises Misuse."""
    if arguments.scenes and open_file:
        raise Misuse(f"SCENE is {arguments.scenes[0]!r}, but Blender has {open_file!r} open already; give one of them")
    if not (arguments.scenes or open_file):
        raise Misuse("SCENE.blend is missing: name a file (or open one in Blender first)")
    return tuple(Path(scene) for scene in dict.fromkeys(arguments.scenes or [open_file]))


SCENES = "SCENE.blend"


def add_output(parser) -> None:
    """-o."""
    parser.add_argument("-o", dest="output", type=folder, required=True, metavar="OUT", help="folder for the results")


def add_scenes(parser) -> None:
    """The files, cameras and frames, and names for what they make."""
    parser.add_argument("scenes", nargs="*", metavar=SCENES, help="one or more; left out when Blender has a file open")
    add_moments(parser, name_of_picture)


def add_moments(parser, name_pattern) -> None:
    """Frames, cameras, names of files."""
    parser.add_argument(
        "--frames", "--frame", dest="frames", type=frames, default=(), metavar="F",
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
    parser.add_argument("--shard", type=shard, metavar="I/N",
                        help="do every N-th task from the I-th (1 to N) on; `merge` assembles")  # fmt: skip
    parser.set_defaults(existing=batch.OVERWRITE)


def add_trust(parser) -> None:
    """What may be done with files."""
    text = "run the scripts and Python drivers in the .blend, which is not done otherwise"
    parser.add_argument("--enable-autoexec", action="store_true", help=text)


def add_memory(parser, what: str) -> None:
    """How much memory there may be."""
    parser.add_argument(
        "--memory-limit", type=memory, default=0, metavar="SIZE",
        help=f"such as 8G or 500M; a {what} that needs more is refused (default: what is free)",
    )  # fmt: skip


def add_baseline(parser) -> None:
    """Regression of a comparison."""
    parser.add_argument("--baseline", type=Path, metavar="REPORT",
                        help="report.json of an earlier comparison: exit code 1 where an error got worse")  # fmt: skip
    parser.add_argument(
        "--tolerance", type=tolerance, default=Tolerance(), metavar="X",
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
