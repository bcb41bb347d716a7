"""Values of command line arguments: what they may be, and what is said where they are not."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

from ..comparison.baseline import Tolerance
from ..comparison.compare import DEFAULT_TECHNIQUES, known_technique
from ..jobs import output_names
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
    return _pattern(text, tuple(name for name in output_names.FIELDS if name != "object"))


def name_of_bake(text: str) -> str:
    """A pattern for the names of baked objects."""
    return _pattern(text, output_names.FIELDS)


def _pattern(text, fields):
    try:
        return output_names.check_pattern(text, fields)
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
