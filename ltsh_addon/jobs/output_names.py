"""Names of output files: patterns such as "{scene}_{camera}_{frame:04d}", and stems that every file system takes."""

from __future__ import annotations

import string
from collections.abc import Iterable

FIELDS = ("scene", "camera", "frame", "object")
LONGEST_STEM = 100
LONGEST_PATTERN = 200
# Neither names of files anywhere nor harmless: separators of folders and drives, wildcards, quotes.
_REFUSED = '\\:*?"<>|'


class NameClash(ValueError):
    """Two tasks would write the same file."""


def file_stems(names: Iterable[str]) -> list[str]:
    """A file name for each of `names`: only letters that every file system takes, each once, in any case."""
    stems, taken = [], set()
    for name in names:
        stem = "".join(letter if letter.isalnum() or letter in " -_" else "_" for letter in name).strip() or "object"
        candidate, number = stem[:LONGEST_STEM], 1
        while candidate.casefold() in taken:
            number += 1
            candidate = f"{stem[:LONGEST_STEM]}_{number}"
        taken.add(candidate.casefold())
        stems.append(candidate)
    return stems


def check_pattern(pattern: str, fields: tuple[str, ...]) -> str:
    """`pattern` itself; raises ValueError where it is no pattern of `fields` or names a file outside of the folder."""
    expected = f"expected fields {', '.join('{' + name + '}' for name in fields)}, such as {{scene}}_{{frame:04d}}"
    if not pattern or len(pattern) > LONGEST_PATTERN:
        raise ValueError(f"name has {len(pattern)} letters, expected 1 to {LONGEST_PATTERN}")
    try:
        parsed = list(string.Formatter().parse(pattern))
        for _, name, _, conversion in parsed:
            if name is not None and (name not in fields or conversion):
                raise ValueError(f"name {pattern!r}: {{{name}}} is unknown, {expected}")
        example = pattern.format(**{name: 1 if name == "frame" else "x" for name in fields})
    except (KeyError, IndexError, ValueError) as error:
        text = str(error)
        raise ValueError(text if text.startswith("name ") else f"name {pattern!r}: {text}; {expected}") from None
    for part in example.split("/"):
        if not part.strip(" ") or part.startswith(".") or part.endswith((".", " ")):
            raise ValueError(
                f"name {pattern!r} gives {example!r}, expected names below the output folder that do not begin or end "
                "with a dot: folders are separated by single /"
            )
    if bad := [letter for letter in example if letter in _REFUSED or not letter.isprintable()]:
        raise ValueError(f"name {pattern!r} has the letter {bad[0]!r}, which not every file system takes: leave it out")
    return pattern


def fields_of(pattern: str) -> set[str]:
    """The fields that a pattern has."""
    return {name for _, name, _, _ in string.Formatter().parse(pattern) if name}


def default_pattern(first: str, varying: Iterable[str]) -> str:
    """`first` alone, or followed by the fields of which there are several: compare, compare_{frame:04d}."""
    parts = {"scene": "{scene}", "camera": "{camera}", "frame": "{frame:04d}"}
    return "_".join([first, *(text for name, text in parts.items() if name in set(varying))])
