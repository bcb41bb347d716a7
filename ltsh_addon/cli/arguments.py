"""Arguments of the command line, and job files (TOML), in which each job is like a command line.

All mistakes in a job file are reported before anything starts.
"""

import argparse
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from ..pipeline import batch
from ..pipeline.lighting import load_tables
from ..pipeline.options import arguments_of, real_number
from ..pipeline.picture import Tolerance
from ..pipeline.tasks import BatchJob
from ..reading import Malformed, read_toml
from ..scene import SceneError, shortened
from ..shading import TableError

# Options of the run as a whole, which only `ltsh run` itself takes. Running scripts is among them, because a job file,
# like a .blend, may come from anyone.
_OF_THE_RUN = ("overwrite", "resume", "skip-existing", "shard", "json", "quiet", "log", "help", "enable-autoexec")
_OF_EVERY_JOB = ("command", "scene", "scenes", "output")

MOST_LINES = 50  # of mistakes that are printed about one file

JobOf = Callable[[argparse.Namespace, tuple[Path, ...]], BatchJob]


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
    index, separator, count = text.partition("/")
    if separator and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
        return int(index), int(count)
    raise ValueError(f"shard is {text!r}, expected I/N with I from 1 to N, such as 1/4 to 4/4")


def tolerance(text: str) -> Tolerance:
    """The tolerance of a number, or of a percentage of the baseline's error."""
    relative = text.endswith("%")
    value = real_number(text.removesuffix("%")) / (100.0 if relative else 1.0)
    if not 0.0 <= value < math.inf:
        raise ValueError(f"tolerance is {text!r}, expected a number such as 0.002, or 10%")
    return Tolerance(value, relative)


def add_batch(parser) -> None:
    """Add the arguments about finished tasks and shards."""
    chosen = parser.add_mutually_exclusive_group()
    for flag, existing, meaning in (
        ("--overwrite", batch.OVERWRITE, "do all again (default)"),
        (
            "--resume",
            batch.RESUME,
            "keep what the same options and files have made in OUT; do objects of bakes that changed",
        ),
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


def add_talk(parser) -> None:
    """Add the arguments about what is printed."""
    parser.add_argument("--json", action="store_true", help="print the report on stdout as one JSON document")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.add_argument("--log", type=Path, metavar="FILE", help="append to FILE what was done when")


def with_examples(parser, description: str, examples: str) -> None:
    """Show `description` above the options and `examples` below, as they are."""
    parser.description, parser.epilog = description, examples
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


@dataclass(frozen=True)
class FileJob:
    """One job of a file."""

    job: BatchJob
    arguments: argparse.Namespace  # as parsed from a command line


class Mistakes(Misuse):
    """The mistakes in a job file, one of the `lines` for each.

    `of_the_world` is True if the job file is right, and only files that it names are missing or damaged.
    """

    def __init__(self, lines: list[str], of_the_world: bool = False):
        super().__init__("\n".join(lines))
        self.lines, self.of_the_world = lines, of_the_world


def read_jobs(path: Path, parsers: dict[str, argparse.ArgumentParser], job_of: JobOf) -> list[FileJob]:
    """The jobs of a file. `parsers` are those of the commands; `job_of` makes a job of parsed arguments and scenes.

    Raises Mistakes with all mistakes in the file, OSError if it cannot be read.
    """
    try:
        document = read_toml(path)
    except OSError as error:
        raise OSError(f"{path}: cannot be read ({error.strerror}), expected a job file (TOML)") from error
    except Malformed as error:
        raise Mistakes([f"{path}: {error}"]) from None
    reader = _JobFileReader(path, parsers, job_of)
    wanted = reader.read(document)
    if reader.mistakes:
        # Mistakes in the defaults are found again with every job.
        lines = list(dict.fromkeys(reader.mistakes))
        more = [f"{path}: {len(lines) - MOST_LINES} more mistakes"] if len(lines) > MOST_LINES else []
        raise Mistakes(lines[:MOST_LINES] + more, reader.of_the_world)
    return wanted


class _JobFileReader:
    """Reads one file and collects all mistakes, each a line that names the job and the key."""

    def __init__(self, path, parsers, job_of):
        self.path, self.parsers, self.job_of = path, parsers, job_of
        self.mistakes: list[str] = []
        self.of_the_world = True

    def read(self, document) -> list[FileJob]:
        """The jobs without mistakes."""
        for key in document:
            if key not in ("defaults", "job"):
                self._complain("", f"table {key!r} is unknown here; expected defaults and job")
        defaults, jobs = document.get("defaults", {}), document.get("job", [])
        if not isinstance(defaults, dict):
            self._complain("", "defaults: expected a table, [defaults]")
            defaults = {}
        if not isinstance(jobs, list) or not jobs or not all(isinstance(job, dict) for job in jobs):
            self._complain("", "no job is there, expected at least one [[job]]")
            return []
        known = {name for parser in self.parsers.values() for name in _options(parser)}
        for key in defaults.keys() - known:
            self._unknown("defaults", key, known)
        wanted = [self._job(f"job {number}", job, defaults) for number, job in enumerate(jobs, 1)]
        self._check_outputs(jobs)
        return [job for job in wanted if job is not None]

    def _job(self, where, job, defaults) -> FileJob | None:
        before = len(self.mistakes)
        command = job.get("command")
        parser = self.parsers.get(command) if isinstance(command, str) else None
        if parser is None:
            self._complain(where, f"command is {command!r}, expected one of {', '.join(self.parsers)}")
            return None
        options, scenes = _options(parser), self._scenes(where, job)
        words = [f"-o{self.path.parent / self._output(where, job)}"]
        for key, value in job.items():
            if key in options:
                words += self._words(where, key, value, options[key])
            elif key not in _OF_EVERY_JOB:
                self._unknown(where, key, {*options, *_OF_EVERY_JOB})
        for key in defaults.keys() & options.keys() - job.keys():
            words += self._words("defaults", key, defaults[key], options[key])
        return self._checked(where, parser, words, scenes) if len(self.mistakes) == before else None

    def _checked(self, where, parser, words, scenes) -> FileJob | None:
        """The job, if its options make sense together and its files are there; else None."""
        from ..blender.process.blender_process import check_readable

        try:
            arguments = _parse(parser, words)
            job = self.job_of(arguments, scenes)
            for scene in scenes:
                check_readable(scene)
            load_tables(arguments.techniques)
            return FileJob(job, arguments)
        except Misuse as error:
            self._complain(where, str(error))
        except (SceneError, TableError) as error:
            self._complain(where, str(error), of_the_world=True)
        return None

    def _scenes(self, where, job) -> tuple[Path, ...]:
        given = job.get("scenes", job.get("scene"))
        given = [given] if isinstance(given, str) else given
        if "scene" in job and "scenes" in job:
            self._complain(where, "scene and scenes are both there, expected one of them")
        elif not isinstance(given, list) or not given or not all(isinstance(item, str) and item for item in given):
            self._complain(where, f"scene is {given!r}, expected the name of a .blend (scenes: a list of them)")
        else:
            return tuple(dict.fromkeys(self.path.parent / item for item in given))
        return ()

    def _output(self, where, job) -> str:
        output = job.get("output")
        if isinstance(output, str) and output.strip() and "\0" not in output:
            return output
        self._complain(where, f"output is {output!r}, expected a folder" if "output" in job else "output is missing")
        return ""

    def _unknown(self, where, key, known) -> None:
        hint = "give it to `ltsh run` on the command line"
        hint = hint if key in _OF_THE_RUN else f"expected some of {', '.join(sorted(known))}"
        self._complain(where, f"option {key!r} is unknown here; {hint}")

    def _words(self, where, key, value, action) -> list[str]:
        """The option as words of a command line; [] and a mistake if its value is wrong."""
        if action.nargs == 0:
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
            try:
                if action.choices is not None and item not in action.choices:
                    raise ValueError(f"{key} is {item!r}, expected {' or '.join(action.choices)}")
                if action.type is not None:
                    action.type(item)
            except (argparse.ArgumentTypeError, ValueError) as error:
                text = str(error)
                self._complain(where, text if text.startswith(f"{key} ") else f"{key}: {text}")
                return []
        return [f"--{key}={item}" for item in items]

    def _path(self, key, item):
        if key == "baseline" or (key == "techniques" and str(item).endswith(".npz")):
            return self.path.parent / str(item)
        return item

    def _check_outputs(self, jobs) -> None:
        """Check that every output folder belongs to one job."""
        first: dict[Path, int] = {}
        for number, output in enumerate((job.get("output") for job in jobs), 1):
            if isinstance(output, str) and "\0" not in output:
                same = first.setdefault((self.path.parent / output).resolve(), number)
                if same != number:
                    text = f"output is {output!r}, as of job {same}; expected a folder for each job"
                    self._complain(f"job {number}", text)

    def _complain(self, where: str, text: str, of_the_world: bool = False) -> None:
        """Note a mistake; `where` is "job 2", "defaults", or "" for the file as a whole."""
        self.of_the_world &= of_the_world
        subject = f"{self.path}, {where}" if where else str(self.path)
        self.mistakes.append(f"{subject}: {shortened(' '.join(text.split()), 500)}")


def _options(parser) -> dict[str, argparse.Action]:
    """Actions by the names of options without dashes, except those of the run as a whole."""
    actions = {name[2:]: action for action in parser._actions for name in action.option_strings}
    return {name: action for name, action in actions.items() if name and name not in _OF_THE_RUN}


def _parse(parser, words) -> argparse.Namespace:
    """The arguments parsed from `words`. Raises Misuse where the parser would end the program."""

    def refuse(message):
        raise Misuse(message)

    parser.error = refuse
    return parser.parse_args(words)
