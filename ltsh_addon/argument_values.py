"""Values of command line arguments: what they may be, and what is said where they are not."""

from __future__ import annotations

import argparse
from pathlib import Path

from .compare import DEFAULT_TECHNIQUES, known_technique
from .shading import PASSES, SHIPPED_TABLES

# Blender's own limits: of a side of the picture in pixels, and of frames.
SMALLEST_SIDE, LARGEST_SIDE = 4, 65536
LAST_FRAME = 1048574


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


def frame(text: str) -> int:
    """A frame number."""
    if text.removeprefix("-").isdecimal() and abs(int(text)) <= LAST_FRAME:
        return int(text)
    raise argparse.ArgumentTypeError(f"frame is {text!r}, expected a whole number from -{LAST_FRAME} to {LAST_FRAME}")


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
    return value


def scene(arguments, open_file: str | None) -> Path:
    """The .blend to work on: the one named, or the one that Blender has open. Raises Misuse."""
    if arguments.scene and open_file:
        raise Misuse(f"SCENE is {arguments.scene!r}, but Blender has {open_file!r} open already; give one of them")
    if not (arguments.scene or open_file):
        raise Misuse("SCENE.blend is missing: name a file (or open one in Blender first)")
    return Path(arguments.scene or open_file)
