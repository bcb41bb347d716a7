"""On which line of a TOML text each key stands: tomllib tells it for syntax errors only."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"""\s*(?:"([^"\\]*)"|'([^']*)'|([A-Za-z0-9_-]+))\s*=""")


def key_lines(text: str) -> dict[tuple, int]:
    """Lines, from 1, by path: ("defaults", "frames"), ("job", 0, "scene"), and of headers ("job", 0).

    Of keys in inline tables and of dotted ones nothing is said.
    """
    lines: dict[tuple, int] = {}
    table: tuple = ()
    counts: Counter[str] = Counter()
    for number, line in _logical_lines(text):
        if header := _HEADER.match(line):
            name = header[2].strip("\"'")
            table = (name,)
            if header[1] == "[[":
                table = (name, counts[name])
                counts[name] += 1
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault((*table, next(group for group in key.groups() if group is not None)), number)
    return lines


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """First line number and text of every statement: arrays and strings may go over several lines."""
    statement, first, depth, quote = "", 1, 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        if not statement:
            first = number
        depth, quote = _after(line, depth, quote)
        statement += line + "\n"
        # A header is no open array, whatever its brackets.
        if quote or (depth > 0 and not _HEADER.match(statement)):
            continue
        yield first, statement.rstrip("\n")
        statement, depth = "", 0


def _after(line: str, depth: int, quote: str) -> tuple[int, str]:
    """Depth of brackets and the triple quote that is open after `line`."""
    position = 0
    while position < len(line):
        rest = line[position:]
        if quote:
            if rest.startswith("\\") and quote[0] == '"':
                position += 2
                continue
            if rest.startswith(quote):
                position += len(quote)
                quote = ""
                continue
        elif rest.startswith(('"""', "'''")):
            quote = rest[:3]
            position += 3
            continue
        elif rest[0] in "\"'":
            quote = rest[0]
        elif rest[0] == "#":
            break
        else:
            depth += (rest[0] in "[{") - (rest[0] in "]}")
        position += 1
    # A quote of one letter ends with its line; that it should have ended before is tomllib's to say.
    return depth, quote if len(quote) == 3 else ""
