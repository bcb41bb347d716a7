"""Reading files that others may have written (jobs, records, reports, tables), and the limits of their sizes.

Each reader refuses malformed files within about a second, with an error of one line, whatever they claim to hold.
OSError means that the file cannot be read, Malformed that its contents are wrong; the caller adds the file's name.
"""

import errno
import io
import json
import math
import os
import re
import stat
import tomllib
import zipfile
from collections.abc import Callable, Iterable
from pathlib import PurePosixPath
from types import UnionType
from typing import Any

import numpy as np

from .scene import error_line, shortened

# Limits of files in bytes. For comparison: a report of 5,000 comparisons has 25 MiB, a job of 300,000 tasks 100 MiB, a
# job file 150 bytes per job, the largest shipped table 1.2 MiB packed and 2.5 MiB unpacked.
MOST_JSON, MOST_TOML, MOST_PACKED, MOST_UNPACKED = 128 << 20, 1 << 20, 8 << 20, 64 << 20
# MOST_COMMAS: limit of the values of a document, whose parsing takes longer than reading its bytes. A job of 300,000
# tasks has 2.4 million.
MOST_COMMAS = 4_000_000
# MOST_LEVELS: nested lists and tables, or parts of a TOML key, with whose square the time of the parser grows.
MOST_LEVELS = 32
INTEGERS = -(2**63), 2**63 - 1

NUMBER = int | float
_KEY = r"""[ \t]*+(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?:^|[{{,\[]){_KEY}(?:\.{_KEY}){{{MOST_LEVELS}}}", re.MULTILINE)
_NAMES = {dict: "a table", list: "a list", str: "text", int: "a whole number", float: "a number", bool: "true or false"}
_NAMES |= {type(None): "nothing", NUMBER: "a number", NUMBER | None: "a number or nothing"}


class Malformed(ValueError):
    """The contents of a file are wrong; the message says how, without the file's name."""


def read_json(path: str | os.PathLike, shape: Any = dict) -> Any:
    """The document of a JSON file, checked for its `shape` (see `check`). Raises OSError, Malformed."""
    return parse_json(_text(path, MOST_JSON), shape)


def parse_json(text: str, shape: Any = dict) -> Any:
    """The document of a JSON text, checked for its `shape`. Raises Malformed."""

    def refuse(constant):
        raise ValueError(f"{constant} is no number")

    try:
        document = json.loads(text, parse_constant=refuse)
    except RecursionError:
        raise Malformed(_too_deep()) from None
    except ValueError as error:
        raise Malformed(f"is no JSON: {error_line(error)}") from None
    _check_contents(document)
    if "\\u" in text:
        try:
            json.dumps(document, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise Malformed("holds text that is no Unicode") from None
    check(document, shape)
    return document


def read_toml(path: str | os.PathLike) -> dict:
    """The document of a TOML file. Raises OSError, Malformed."""
    text = _text(path, MOST_TOML)
    if _LONG_KEY.search(text):
        raise Malformed(f"is no TOML that can be read: a key has more than {MOST_LEVELS} parts")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise Malformed(_too_deep()) from None
    except ValueError as error:
        raise Malformed(f"is no TOML: {error_line(error)}") from None
    _check_contents(document)
    return document


def read_arrays(path: str | os.PathLike, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The arrays `names` of a .npz file. Raises OSError, Malformed.

    The sizes of all arrays are checked before anything is unpacked.
    """
    content = _content(path, MOST_PACKED)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = {name: _entry(archive, name) for name in names}
            total = sum(entry.file_size for entry in entries.values())
            if total > MOST_UNPACKED:
                raise Malformed(f"holds {total >> 20} MiB of arrays, expected at most {MOST_UNPACKED >> 20} MiB")
            return {name: _array(archive, entry) for name, entry in entries.items()}
    except (Malformed, OSError):
        raise
    # zipfile and numpy raise almost anything: BadZipFile, zlib.error, struct.error, NotImplementedError ...
    except Exception as error:
        raise Malformed(f"is no .npz: {error_line(error)}") from None


# The shape of a document:


def check(value: Any, shape: Any, entry: str = "") -> None:
    """Raise Malformed, naming the entry, if `value` does not have the `shape`, which is one of

    - a type or several (`int | None`): a value of this type; True is not an int,
    - [shape]: a list of values of this shape,
    - {"key": shape, "other?": shape, str: shape}: a table with "key" and optionally "other"; all other values have the
      shape of `str`, or any shape without it,
    - a tuple: one of its values,
    - a function check(value, entry), which raises Malformed itself.
    """
    if isinstance(shape, dict):
        _expect(value, dict, entry)
        missing = [key for key in shape if key is not str and not key.endswith("?") and key not in value]
        if missing:
            raise Malformed(f"{entry or 'the document'} has no {_shown(missing[0])}")
        for key, item in value.items():
            inner = shape.get(key, shape.get(f"{key}?", shape.get(str)))
            if inner is not None:
                name = shortened(key, 60)
                check(item, inner, f"{entry}.{name}" if entry else name)
    elif isinstance(shape, list):
        _expect(value, list, entry)
        for number, item in enumerate(value):
            check(item, shape[0], f"{entry}[{number}]")
    elif isinstance(shape, tuple):
        if value not in shape:
            raise Malformed(f"{entry} is {_shown(value)}, expected {' or '.join(map(repr, shape))}")
    elif isinstance(shape, type | UnionType):
        _expect(value, shape, entry)
    else:
        shape(value, entry)


def some(shape: Any) -> Callable[[Any, str], None]:
    """The shape of a non-empty list or table of this `shape`."""

    def check_some(value, entry):
        check(value, shape, entry)
        if not value:
            raise Malformed(f"{entry} is empty")

    return check_some


def file_name(value: Any, entry: str) -> None:
    """The shape of the name of a file below a folder, without `..`."""
    _expect(value, str, entry)
    path = PurePosixPath(value)
    if not path.parts or path.is_absolute() or ".." in path.parts or "\0" in value:
        raise Malformed(f"{entry} is {_shown(value)}, expected a name below the folder")


def _expect(value, kind, entry) -> None:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        expected = _NAMES.get(kind) or " or ".join(_NAMES[one] for one in kind.__args__)
        raise Malformed(f"{entry or 'the document'} is {_shown(value)}, expected {expected}")


def _shown(value) -> str:
    return shortened(repr(value), 60)


# The limits of all files:


def is_text(name: str | os.PathLike) -> bool:
    """True if a name is UTF-8 on disk; Blender, EXR files and reports need that."""
    try:
        return os.fsencode(name) == os.fspath(name).encode()
    except UnicodeError:
        return False


def check_name(path: str | os.PathLike) -> None:
    """Raise OSError if the whole path of a file is not `is_text`: OpenEXR would end the process."""
    if not is_text(os.path.realpath(path)):
        raise OSError(errno.EILSEQ, "its path has bytes that are not UTF-8; rename it")


def _content(path, most_bytes) -> bytes:
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode):  # reading a pipe or a device might never end
        raise Malformed(f"is {'a folder' if stat.S_ISDIR(mode) else 'a device or a pipe'}, expected a file")
    with open(path, "rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise Malformed(f"has more than {most_bytes >> 20} MiB")
    return content


def _text(path, most_bytes) -> str:
    content = _content(path, most_bytes)
    if content.count(b",") > MOST_COMMAS:
        raise Malformed(f"has more than {MOST_COMMAS} values")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Malformed(f"is no text in UTF-8: {error_line(error)}") from None


def _check_contents(document) -> None:
    """Raise Malformed for integers beyond 64 bits, and for more than MOST_LEVELS levels, against RecursionErrors."""
    level = [[document]]
    for _ in range(MOST_LEVELS + 1):
        below = []
        for parent in level:
            for item in parent.values() if isinstance(parent, dict) else parent:
                if isinstance(item, dict | list):
                    below.append(item)
                elif isinstance(item, int) and not INTEGERS[0] <= item <= INTEGERS[1]:
                    raise Malformed("holds a whole number that does not fit into 64 bits")
        if not below:
            return
        level = below
    raise Malformed(_too_deep())


def _too_deep() -> str:
    return f"has more than {MOST_LEVELS} lists or tables within one another"


def _entry(archive, name) -> zipfile.ZipInfo:
    try:
        entry = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise Malformed(f"has no {name!r}") from None
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise Malformed(f"{name} is packed in a way that is not read here")
    return entry


def _array(archive, entry) -> np.ndarray:
    """The array of an entry; raises Malformed if the entry's size does not match the array's shape."""
    name = entry.filename.removesuffix(".npy")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = header(file)
        if dtype.hasobject:
            raise Malformed(f"{name} holds Python objects, expected numbers")
        count, size = math.prod(shape), entry.file_size - file.tell()
        if min(shape, default=0) < 0 or count * dtype.itemsize != size:
            raise Malformed(f"{name} has shape {shape} of {dtype}, but {size} bytes")
        array = np.frombuffer(file.read(), dtype, count)
    return array.reshape(shape, order="F" if fortran else "C")
