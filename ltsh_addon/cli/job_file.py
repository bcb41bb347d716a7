"""On which line of a TOML text each key stands: tomllib tells it for syntax errors only."""

from __future__ import annotations

import argparse
import difflib
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..pipeline import picture
from ..pipeline.tasks import Job
from ..scene import SceneError
from ..shading import TableError
from .arguments import Misuse

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


_PATHS = ("baseline",)
_OF_THE_RUN = ("overwrite", "resume", "skip-existing", "shard", "json", "quiet", "log", "help")


@dataclass(frozen=True)
class Command:
    """How a command reads its options: its parser, and what makes the job of them and of the scenes."""

    parser: argparse.ArgumentParser
    job_of: Callable[[argparse.Namespace, tuple[Path, ...]], Job]

    def options(self) -> dict[str, argparse.Action]:
        """Actions by the names of options without dashes, but for those of the run as a whole."""
        actions = {name[2:]: action for action in self.parser._actions for name in action.option_strings}
        return {name: action for name, action in actions.items() if name and name not in _OF_THE_RUN}


@dataclass(frozen=True)
class Wanted:
    """One job of a file: the job, and its options as of a command line."""

    job: Job
    arguments: argparse.Namespace


class Mistakes(Misuse):
    """What is wrong in a job file; `lines` holds a line for each mistake.

    `of_the_world` is True where the file is right and only what it names is missing or damaged.
    """

    def __init__(self, lines: list[str], of_the_world: bool = False):
        super().__init__("\n".join(lines))
        self.lines, self.of_the_world = lines, of_the_world


def read_jobs(path: Path, commands: dict[str, Command]) -> list[Wanted]:
    """The jobs of a file. Raises Mistakes with all that is wrong in it, OSError where it cannot be read."""
    try:
        text = path.read_bytes().decode("utf-8")
        document = tomllib.loads(text)
    except OSError as error:
        raise OSError(f"{path}: cannot be read ({error.strerror}), expected a job file (TOML)") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise Mistakes([f"{path}: is no TOML: {error}"]) from None
    except RecursionError:
        raise Mistakes([f"{path}: is no TOML that can be read: too many brackets within one another"]) from None
    reader = _Reader(path, commands, key_lines(text))
    wanted = reader.read(document)
    if reader.mistakes:
        raise Mistakes([line for _, line in sorted(reader.mistakes)], reader.of_the_world)
    return wanted


class _Reader:
    """Reads one file and collects (line, text) of all mistakes."""

    def __init__(self, path, commands, lines):
        self.path, self.commands, self.lines = path, commands, lines
        self.mistakes: list[tuple[int, str]] = []
        self.of_the_world = True

    def read(self, document) -> list[Wanted]:
        """The jobs that are right."""
        for key in document:
            if key not in ("defaults", "job"):
                self._unknown((key,), key, ["defaults", "job"], "table")
        defaults, jobs = document.get("defaults", {}), document.get("job", [])
        if not isinstance(defaults, dict):
            self._complain(("defaults",), "defaults: expected a table, [defaults]")
            defaults = {}
        if not isinstance(jobs, list) or not jobs or not all(isinstance(job, dict) for job in jobs):
            self._complain(("job",), "no job is there, expected at least one [[job]]")
            return []
        known = {name for command in self.commands.values() for name in command.options()} - {"output"}
        for key in defaults:
            if key not in known:
                self._unknown(("defaults", key), key, known, "option")
        found = [self._job(number, job, defaults) for number, job in enumerate(jobs)]
        self._check_outputs([job.get("output") for job in jobs])
        return [wanted for wanted in found if wanted is not None]

    def _job(self, number, job, defaults) -> Wanted | None:
        before = len(self.mistakes)
        command = self.commands.get(job.get("command")) if isinstance(job.get("command"), str) else None
        if command is None:
            where = ("job", number, "command") if "command" in job else ("job", number)
            self._complain(where, f"command is {job.get('command')!r}, expected one of {', '.join(self.commands)}")
            return None
        options = command.options()
        scenes = self._scenes(number, job)
        output = self._text(("job", number, "output"), job, "output", "a folder")
        words = [f"-o{self.path.parent / output}"] if output is not None else ["-o."]
        given = {key: (("defaults", key), value) for key, value in defaults.items() if key in options}
        given |= {key: (("job", number, key), value) for key, value in job.items()}
        for key in ("command", "scene", "scenes", "output"):
            given.pop(key, None)
        for key, (where, value) in given.items():
            if key in options:
                words += self._words(where, key, options[key], value)
            else:
                self._unknown(where, key, [*options, "command", "scene", "scenes", "output"], "option")
        if len(self.mistakes) > before:
            return None
        return self._checked(("job", number), command, words, scenes)

    def _checked(self, where, command, words, scenes) -> Wanted | None:
        """The job, if its options make sense together and its files are there."""
        from ..blender.process.client import check_readable

        try:
            arguments = _parse(command.parser, words)
            job = command.job_of(arguments, scenes)
            for scene in scenes:
                check_readable(scene)
            picture.load_tables(arguments.techniques)
            return Wanted(job, arguments)
        except Misuse as error:
            self._complain(where, str(error))
        except (SceneError, TableError) as error:
            self._complain(where, str(error), of_the_world=True)
        return None

    def _scenes(self, number, job) -> tuple[Path, ...]:
        where = ("job", number, "scenes" if "scenes" in job else "scene")
        given = job.get("scenes", job.get("scene"))
        given = [given] if isinstance(given, str) else given
        if "scene" in job and "scenes" in job:
            self._complain(where, "scene and scenes are both there, expected one of them")
        elif not isinstance(given, list) or not given or not all(isinstance(item, str) and item for item in given):
            self._complain(where, f"scene is {given!r}, expected the name of a .blend (scenes: a list of them)")
        else:
            return tuple(dict.fromkeys(self.path.parent / item for item in given))
        return ()

    def _words(self, where, key, action, value) -> list[str]:
        """The option as on a command line; complains where its value is wrong."""
        if isinstance(action, argparse._StoreTrueAction):
            if not isinstance(value, bool):
                self._complain(where, f"{key} is {value!r}, expected true or false")
            return [f"--{key}"] if value is True else []
        items = value if isinstance(value, list) else [value]
        if not items or not all(isinstance(item, str | int | float) and not isinstance(item, bool) for item in items):
            self._complain(where, f"{key} is {value!r}, expected text, a number or a list of them")
            return []
        if not isinstance(action, argparse._AppendAction):
            items = [",".join(str(self._path(key, item)) for item in items)]
        for item in map(str, items):
            if action.choices is not None and item not in action.choices:
                self._complain(where, f"{key} is {item!r}, expected {' or '.join(action.choices)}")
                return []
            try:
                if action.type is not None:
                    action.type(item)
            except (argparse.ArgumentTypeError, ValueError) as error:
                text = str(error)
                self._complain(where, text if text.startswith(f"{key} ") else f"{key}: {text}")
                return []
        return [f"--{key}={item}" for item in items]

    def _path(self, key, item):
        if key in _PATHS or (key == "techniques" and str(item).endswith(".npz")):
            return self.path.parent / str(item)
        return item

    def _text(self, where, job, key, meaning) -> str | None:
        value = job.get(key)
        if isinstance(value, str) and value.strip() and "\0" not in value:
            return value
        self._complain(where, f"{key} is {value!r}, expected {meaning}" if key in job else f"{key} is missing")
        return None

    def _check_outputs(self, outputs) -> None:
        """Every folder holds the results of one job."""
        first: dict[str, int] = {}
        for number, output in enumerate(outputs):
            if isinstance(output, str) and "\0" not in output:
                same = first.setdefault(str((self.path.parent / output).resolve()), number)
                if same != number:
                    line = self._line(("job", same, "output"))
                    text = f"output is {output!r}, as on line {line}; expected a folder for each job"
                    self._complain(("job", number, "output"), text)

    def _unknown(self, where, key, known, what) -> None:
        near = difflib.get_close_matches(str(key), sorted(known), 1)
        hint = f"did you mean {near[0]!r}?" if near else f"expected some of {', '.join(sorted(known))}"
        if key in _OF_THE_RUN:
            hint = "give it to `ltsh run` on the command line"
        self._complain(where, f"{what} {key!r} is unknown here; {hint}")

    def _complain(self, where, text, of_the_world=False) -> None:
        line = self._line(where)
        self.of_the_world &= of_the_world
        self.mistakes.append((line, f"{self.path}, line {line}: {' '.join(text.split())}"))

    def _line(self, where) -> int:
        while where and where not in self.lines:
            where = where[:-1]
        return self.lines.get(where, 1)


def _parse(parser, words) -> argparse.Namespace:
    """What the parser makes of `words`; it raises instead of ending the program."""

    def refuse(message):
        raise Misuse(message)

    parser.error = refuse
    return parser.parse_args(words)
