"""Arguments of the command line: those of the declared options, and those about how a job is run."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from pathlib import Path

from ..pipeline import batch
from ..pipeline.options import arguments_of
from ..pipeline.picture import Tolerance


class Misuse(Exception):
    """The arguments are wrong, or do not make sense together."""


def from_text(parse: Callable[[str], object]) -> Callable[[str], object]:
    """`parse` for argparse, which then shows the message of its ValueError."""

    def value(text):
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return value


def add_options(parser, kind: type, *, but: Iterable[str] = (), **changes) -> None:
    """Add the arguments of the options class `kind`, except `but`; `changes` are keywords for `add_option` by name."""
    for name in arguments_of(kind):
        if name not in but:
            add_option(parser, kind, name, **changes.get(name, {}))


def add_option(parser, kind: type, name: str, **changes) -> None:
    """Add the arguments of one option, with `changes` of argparse's keywords."""
    default, arguments = arguments_of(kind)[name]
    group = parser.add_mutually_exclusive_group() if len(arguments) > 1 else parser
    for argument in arguments:
        keywords = {**argument.keywords, **changes}
        if "type" in keywords:
            keywords["type"] = from_text(keywords["type"])
        if argument.flags[0].startswith("-"):
            keywords = {"dest": name, **keywords}
            # Several arguments of one option have no default; `options_from` fills it in.
            keywords.setdefault("default", None if len(arguments) > 1 or "append" in keywords.values() else default)
        group.add_argument(*argument.flags, **keywords)


def scenes_of(arguments, open_file: str | None) -> tuple[Path, ...]:
    """The files to work on: those on the command line, or the one that Blender has open. Raises Misuse."""
    if arguments.scenes and open_file:
        raise Misuse(f"SCENE is {arguments.scenes[0]!r}, but Blender has {open_file!r} open already; give one of them")
    if not (arguments.scenes or open_file):
        raise Misuse("SCENE.blend is missing: name a file (or open one in Blender first)")
    return tuple(Path(scene) for scene in dict.fromkeys(arguments.scenes or [open_file]))


def shard(text: str) -> tuple[int, int]:
    """The shard (I, N) of the text I/N with 1 <= I <= N."""
    number, separator, count = text.partition("/")
    if separator and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count):
        return int(number), int(count)
    raise ValueError(f"shard is {text!r}, expected I/N with I from 1 to N, such as 1/4 to 4/4")


def tolerance(text: str) -> Tolerance:
    """The tolerance of a number, or of a percentage of the baseline's error."""
    number, relative = text.removesuffix("%"), text.endswith("%")
    try:
        value = float(number) / (100.0 if relative else 1.0)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise ValueError(f"tolerance is {text!r}, expected a number such as 0.002, or 10%")
    return Tolerance(value, relative)


def add_batch(parser) -> None:
    """Add the arguments about finished tasks and shards."""
    chosen = parser.add_mutually_exclusive_group()
    for flag, existing, meaning in (
        ("--overwrite", batch.OVERWRITE, "do all again (default)"),
        ("--resume", batch.RESUME, "keep what the same options and files have made in OUT"),
        ("--skip-existing", batch.SKIP, "keep what is finished in OUT, whatever made it"),
    ):
        chosen.add_argument(flag, dest="existing", action="store_const", const=existing, help=meaning)
    meaning = "do every N-th task from the I-th (1 to N) on; `merge` assembles"
    parser.add_argument("--shard", type=from_text(shard), metavar="I/N", help=meaning)
    parser.set_defaults(existing=batch.OVERWRITE)


def add_baseline(parser) -> None:
    """Add the arguments about the baseline of a comparison."""
    meaning = "report.json of an earlier comparison: exit code 1 where an error got worse"
    parser.add_argument("--baseline", type=Path, metavar="REPORT", help=meaning)
    meaning = "how much worse is let pass: 0.002 (a fifth of a percent) or 10%% of the baseline's error "
    meaning += "(default: 0.001)"
    parser.add_argument("--tolerance", type=from_text(tolerance), default=Tolerance(), metavar="X", help=meaning)


def add_talk(parser, json_meaning: str = "print the report on stdout as one JSON document") -> None:
    """Add the arguments about what is printed."""
    parser.add_argument("--json", action="store_true", help=json_meaning)
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.add_argument("--log", type=Path, metavar="FILE", help="append to FILE what was done when")


def with_examples(parser, description: str, examples: str) -> None:
    """Show `description` above the options and `examples` below, as they are."""
    parser.description, parser.epilog = description, examples
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
