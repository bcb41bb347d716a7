"""What a picture and a bake can be asked for. Each option is declared once, as a field of a dataclass here.

The command line makes an argument of every such field, job files have the same names without the dashes, the second
Blender's job takes the fields that it has too, and records of finished tasks hold a digest of all that matter.
"""

from __future__ import annotations

import re
import string
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ..scene import BAKE_PASSES, PASSES, REFERENCE, SHIPPED_TABLES, TECHNIQUES

# Blender's own limits: of a side of the picture in pixels, and of frames.
PICTURE_SIDES = (4, 65536)
LAST_FRAME = 1048574
MOST_FRAMES = 100_000
# Of both halves of a Cycles reference: Cycles takes so many for each.
MOST_CYCLES_SAMPLES = 2 << 24
TEXTURE_SIDES = (64, 8192)
MOST_MARGIN = 512
# Texels beside what is baked show the nearest texel, or the adjacent face of the mesh.
MARGIN_TYPES = ("extend", "adjacent")
# Fields of the names of files.
NAME_FIELDS = ("scene", "camera", "frame", "object")
LONGEST_NAME = 200
# Letters that some file system refuses or takes for something else: separators, wildcards, quotes.
_REFUSED = '\\:*?"<>|'
_FRAMES = re.compile(r"(-?\d+)(?:-(-?\d+)(?::(\d+))?)?", re.ASCII)


# -- from text to values: each raises ValueError with what was found and what was expected --------------------------


def techniques(text: str) -> tuple[str, ...]:
    """Names of techniques, or paths of tables, separated by commas."""
    names = _parts(text)
    unknown = [name for name in names if name not in TECHNIQUES and not name.endswith(".npz")]
    if unknown or not names:
        raise ValueError(
            f"technique {(unknown or [text])[0]!r} is unknown, expected some of {', '.join(TECHNIQUES)} "
            "or the path of a table (.npz)"
        )
    return names


def table(text: str) -> str:
    """A shipped table or a path."""
    if text in SHIPPED_TABLES or text.endswith(".npz"):
        return text
    raise ValueError(
        f"table {text!r} is unknown, expected some of {', '.join(SHIPPED_TABLES)} or the path of a table (.npz)"
    )


def passes(text: str) -> tuple[str, ...]:
    """Passes of a picture, separated by commas."""
    return _passes(text, PASSES)


def bake_passes(text: str) -> tuple[str, ...]:
    """Passes of a bake, separated by commas."""
    return _passes(text, BAKE_PASSES)


def _passes(text, known):
    names = _parts(text)
    if not names or not set(names) <= set(known):
        raise ValueError(f"passes are {text!r}, expected some of {', '.join(known)}")
    return names


def _parts(text) -> tuple[str, ...]:
    return tuple(dict.fromkeys(part for part in text.split(",") if part))


def resolution(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels."""
    sides = _sides(text, PICTURE_SIDES)
    if len(sides) == 2:
        return sides
    smallest, largest = PICTURE_SIDES
    raise ValueError(
        f"resolution is {text!r}, expected WIDTHxHEIGHT such as 960x540, each from {smallest} to {largest}"
    )


def size(text: str) -> tuple[int, int]:
    """N or WIDTHxHEIGHT in texels."""
    sides = _sides(text, TEXTURE_SIDES)
    if len(sides) in (1, 2):
        return sides[0], sides[-1]
    smallest, largest = TEXTURE_SIDES
    raise ValueError(f"size is {text!r}, expected N or WIDTHxHEIGHT such as 2048, each from {smallest} to {largest}")


def _sides(text, limits) -> tuple[int, ...]:
    """Whole numbers separated by x; () where one is none or beyond the limits."""
    sides = text.split("x")
    numbers = tuple(int(side) for side in sides if side.isdecimal())
    return numbers if len(numbers) == len(sides) and all(limits[0] <= n <= limits[1] for n in numbers) else ()


def frames(text: str) -> tuple[int, ...]:
    """Frame numbers: single ones and ranges FIRST-LAST or FIRST-LAST:STEP, separated by commas; each once."""
    found: dict[int, None] = {}
    for part in text.split(","):
        match = _FRAMES.fullmatch(part.strip())
        first, last, step = (None if group is None else int(group) for group in match.groups()) if match else [None] * 3
        if first is None or max(abs(first), abs(last or 0)) > LAST_FRAME:
            raise ValueError(
                f"frame is {part!r}, expected a whole number from -{LAST_FRAME} to {LAST_FRAME}, or a range such as "
                "1-240 or 1-240:2"
            )
        if last is not None and (last < first or step == 0):
            raise ValueError(f"frames are {part!r}, expected FIRST-LAST:STEP, upwards, STEP above 0")
        if len(found) + ((first if last is None else last) - first) // (step or 1) >= MOST_FRAMES:
            raise ValueError(f"frames are {text[:80]!r}, expected at most {MOST_FRAMES} of them")
        found.update(dict.fromkeys(range(first, (first if last is None else last) + 1, step or 1)))
    return tuple(found)


def positive(text: str) -> int:
    """A whole number above 0."""
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise ValueError(f"{text!r} was given, expected a whole number above 0")


def cycles_samples(text: str) -> int:
    """Samples of both halves of a Cycles reference together."""
    value = positive(text)
    if value < 2:
        raise ValueError("1 was given, expected at least 2: one for each half")
    if value > MOST_CYCLES_SAMPLES:
        raise ValueError(f"{value} was given, expected at most {MOST_CYCLES_SAMPLES}")
    return value


def margin(text: str) -> int:
    """Texels around islands."""
    if text.isdecimal() and int(text) <= MOST_MARGIN:
        return int(text)
    raise ValueError(f"margin is {text!r}, expected a whole number from 0 to {MOST_MARGIN}")


def view(text: str) -> tuple[float, ...] | str:
    """camera, above or a position."""
    if text in ("camera", "above"):
        return text
    try:
        position = tuple(float(part) for part in text.split(","))
    except ValueError:
        position = ()
    if len(position) == 3 and all(abs(value) < 1e12 for value in position):
        return position
    raise ValueError(f"view is {text!r}, expected camera, above or a position such as 0,-4,1.5")


def folder(text: str) -> Path:
    """The name of a folder."""
    if not text.strip():
        raise ValueError("the name of the folder is empty (a shell variable that is not set?)")
    return Path(text)


def picture_name(text: str) -> str:
    """A pattern for the names of pictures."""
    return _name(text, tuple(name for name in NAME_FIELDS if name != "object"))


def bake_name(text: str) -> str:
    """A pattern for the names of baked objects."""
    return _name(text, NAME_FIELDS)


def _name(pattern: str, known: tuple[str, ...]) -> str:
    """`pattern` itself, where it has only `known` fields and names files below the output folder."""
    expected = f"expected fields {', '.join('{' + name + '}' for name in known)}, such as {{scene}}_{{frame:04d}}"
    if not pattern or len(pattern) > LONGEST_NAME:
        raise ValueError(f"name has {len(pattern)} letters, expected 1 to {LONGEST_NAME}")
    try:
        for _, name, _, conversion in string.Formatter().parse(pattern):
            if name is not None and (name not in known or conversion):
                raise ValueError(f"name {pattern!r}: {{{name}}} is unknown, {expected}")
        example = pattern.format(**{name: 1 if name == "frame" else "x" for name in known})
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


# -- declaring options ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Argument:
    """An argument of the command line: its flags, and what argparse's `add_argument` takes by keyword."""

    flags: tuple[str, ...]
    keywords: dict[str, Any]


def option(*arguments: Argument, matters: bool = True, **settings) -> Any:
    """A field with arguments, of which one may be given; `matters` is False where results do not depend on it."""
    return field(kw_only="default" in settings, metadata={"arguments": arguments, "matters": matters}, **settings)


def argument(*flags: str, parse: Callable[[str], Any] | None = None, **keywords) -> Argument:
    """An argument whose text `parse` turns into a value."""
    return Argument(flags, keywords if parse is None else {"type": parse, **keywords})


def _scene(text: str) -> Any:
    return option(argument("scenes", nargs="*", metavar="SCENE.blend", help=text), matters=False)


def _output() -> Any:
    named = argument("-o", dest="output", parse=folder, required=True, metavar="OUT", help="folder for the results")
    return option(named, matters=False)


def _techniques(default: tuple[str, ...]) -> Any:
    known = ", ".join(SHIPPED_TABLES)
    text = f"{known}, {REFERENCE} or paths of tables (.npz), separated by commas (default: {','.join(default)})"
    return option(argument("--techniques", parse=techniques, metavar="T", help=text), default=default)


def _passes_field(known: tuple[str, ...], parse, default: str) -> Any:
    text = f"some of {','.join(known)} (default: {default})"
    return option(argument("--passes", parse=parse, metavar="P", help=text), default=PASSES)


def _frame() -> Any:
    text = "such as 12 or 1-240:2,300 (--frames=-10--1 where the first is negative); default: the file's current one"
    named = argument("--frames", "--frame", dest="frames", parse=frames, default=(), metavar="F", help=text)
    return option(named, default=None)


def _camera() -> Any:
    text = "may be given several times; default: the scene's camera"
    return option(argument("--camera", dest="cameras", action="append", metavar="NAME", help=text), default=None)


def _stem(parse) -> Any:
    text = (
        "of files, such as {scene}_{camera}_{frame:04d}; default: the command, or {object} of a bake, followed by "
        "those of scene, camera and frame of which there are several"
    )
    return option(
        argument("--name", dest="pattern", parse=parse, metavar="PATTERN", help=text), default=None, matters=False
    )


def _cycles_samples(what: str, default: int) -> Any:
    text = f"of both halves of {what} together (default: %(default)s)"
    return option(argument("--cycles-samples", parse=cycles_samples, metavar="N", help=text), default=default)


def _scripts() -> Any:
    text = "run the scripts and Python drivers in the .blend, which is not done otherwise"
    return option(argument("--enable-autoexec", action="store_true", help=text), default=False)


@dataclass(frozen=True)
class PictureOptions:
    """What to shade and how; None means as in the file."""

    scene: Path = _scene("one or more; left out when Blender has a file open")
    frame: int | None = _frame()
    camera: str | None = _camera()
    name: str | None = _stem(picture_name)  # of the files, without suffix, below `output`; None: the command
    output: Path = _output()
    techniques: tuple[str, ...] = _techniques(tuple(TECHNIQUES))
    passes: tuple[str, ...] = _passes_field(PASSES, passes, "both")
    resolution: tuple[int, int] | None = option(
        argument("--resolution", parse=resolution, metavar="WxH", help="default: as in the file"), default=None
    )
    sub_samples: int = option(
        argument("--aa", parse=positive, metavar="N", help="points per pixel, drawn from its filter; 1: pixel centers"),
        default=1,
    )
    reference_samples: int = option(
        argument(
            "--reference-samples",
            parse=positive,
            metavar="N",
            help="'reference' takes a random subset of this size where there are more samples (default: %(default)s)",
        ),
        default=150_000,
    )
    cycles_samples: int = _cycles_samples("the Cycles reference", 512)
    scripts: bool = _scripts()
    page: str = option(default="report.html", matters=False)  # of a comparison

    @property
    def width(self) -> int | None:
        """In pixels."""
        return None if self.resolution is None else self.resolution[0]

    @property
    def height(self) -> int | None:
        """In pixels."""
        return None if self.resolution is None else self.resolution[1]


@dataclass(frozen=True)
class BakeOptions:
    """What to bake and how; None means as in the file."""

    scene: Path = _scene("left out when Blender has a file open")
    output: Path = _output()
    objects: tuple[str, ...] | str = option(  # names, "selected" or "all"
        argument("--object", action="append", metavar="NAME", help="may be given several times; default: --all"),
        argument(
            "--selected", action="store_const", const="selected", help="the objects that are selected in the file"
        ),
        argument("--all", action="store_const", const="all", help="all meshes that render"),
        default="all",
        matters=False,
    )
    uv: str | None = option(argument("--uv", metavar="NAME", help="UV map; default: the active one"), default=None)
    size: tuple[int, int] = option(
        argument("--size", parse=size, metavar="N", help="N or WxH in texels (default: 1024)"), default=(1024, 1024)
    )
    margin: int = option(
        argument("--margin", parse=margin, metavar="PX", help="in texels (default: %(default)s)"), default=16
    )
    margin_type: str = option(
        argument(
            "--margin-type",
            choices=MARGIN_TYPES,
            help="the margin repeats the nearest texel, or shows the adjacent face (default: %(default)s)",
        ),
        default="extend",
    )
    conservative: bool = option(
        argument("--conservative", action="store_true", help="bake every texel that a face touches"), default=False
    )
    view: tuple[float, float, float] | str = option(
        argument(
            "--view",
            parse=view,
            metavar="V",
            help="camera, above (along the normals) or a position X,Y,Z in m (default: %(default)s)",
        ),
        default="camera",
    )
    techniques: tuple[str, ...] = _techniques(("ltsh4",))
    passes: tuple[str, ...] = _passes_field(BAKE_PASSES, bake_passes, ",".join(PASSES))
    frame: int | None = _frame()
    camera: str | None = _camera()
    name: str | None = _stem(bake_name)  # of the file of the only object, without suffix, below `output`
    error: bool = option(
        argument("--error", action="store_true", help="beside Cycles' bake: signed errors, also as pictures"),
        default=False,
    )
    cycles_samples: int = _cycles_samples("Cycles' bake", 256)  # with `error`
    apply: bool = option(
        argument(
            "--apply",
            action="store_true",
            help="also a texture of each object, and a copy of the .blend whose materials show it",
        ),
        default=False,
    )
    scripts: bool = _scripts()
    resume: bool = option(default=False, matters=False)  # keep what the same job has finished

    @property
    def width(self) -> int:
        """In texels."""
        return self.size[0]

    @property
    def height(self) -> int:
        """In texels."""
        return self.size[1]


# -- what follows from the declarations -----------------------------------------------------------------------------


def arguments_of(kind: type) -> dict[str, tuple[Any, tuple[Argument, ...]]]:
    """Default and arguments by the names of the fields that have any, in the order of --help."""
    declared = {item.name: (item.default, item.metadata["arguments"]) for item in fields(kind)}
    return {name: (default, arguments) for name, (default, arguments) in declared.items() if arguments}


def options_from(kind: type, values: dict[str, Any], **settings) -> Any:
    """The options `kind` with `values` (of a parsed command line, None: the default) and `settings`."""
    found = {item.name: values[item.name] for item in fields(kind) if values.get(item.name) is not None}
    found = {name: tuple(dict.fromkeys(value)) if isinstance(value, list) else value for name, value in found.items()}
    return kind(**{**found, **settings})


def command_line(options: Any) -> list[str]:
    """The arguments that give `options` back, but for those that have their defaults; scene and output come first."""
    words = [str(options.scene), "-o", str(options.output)]
    for name, (default, arguments) in arguments_of(type(options)).items():
        value, first = getattr(options, name), arguments[0]
        if name in ("scene", "output") or value == default:
            continue
        if first.keywords.get("action") == "append" and not isinstance(value, str):
            words += [f"{first.flags[0]}={item}" for item in value]
        elif len(arguments) > 1:
            words.append(f"--{value}")
        else:
            words.append(first.flags[0] if value is True else f"{first.flags[0]}={_text(name, value)}")
    return words


def _text(name, value) -> str:
    """A value as the command line takes it."""
    if not isinstance(value, tuple):
        return str(value)
    return ("x" if name in ("size", "resolution") else ",").join(map(str, value))


def what_matters(options: Any) -> dict[str, Any]:
    """The options on which the result depends."""
    values = asdict(options)
    return {item.name: values[item.name] for item in fields(options) if item.metadata["matters"]}


def child_job(kind: type, options: Any, **settings) -> Any:
    """The second Blender's job `kind`: the options that it has too, and `settings`."""
    shared = {item.name: getattr(options, item.name) for item in fields(kind) if hasattr(options, item.name)}
    return kind(**{**shared, **settings})
