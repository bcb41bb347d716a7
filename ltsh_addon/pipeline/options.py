"""The options of pictures, bakes, views and renders. Each option is declared once, as a field of a dataclass here.

The command line has an argument for every such field, and job files have the same names without the dashes. The job of
the second Blender takes the fields that it shares. Records of finished tasks hold a digest of the fields that matter.
"""

import math
import re
import string
from collections.abc import Callable, Iterable
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from ..scene import BAKE_PASSES, COMPARED_TECHNIQUES, DEFAULT_TECHNIQUE, PASSES, SHIPPED_TABLES, TECHNIQUES

# Blender's own limits. PICTURE_SIDES: the smallest and largest side of a picture in pixels. LAST_FRAME: of frames.
PICTURE_SIDES = (4, 65536)
LAST_FRAME = 1048574
MOST_FRAMES = 100_000
# MOST_CYCLES_SAMPLES: of both halves of a Cycles reference; Cycles itself allows half as many for each.
MOST_CYCLES_SAMPLES = 2 << 24
TEXTURE_SIDES = (64, 8192)
SHADOW_RAYS = 8, 1024
MOST_REFINEMENTS = 4096
MOST_MARGIN = 512
# NAME_FIELDS: the fields of patterns of file names.
NAME_FIELDS = ("scene", "camera", "frame", "object")
LONGEST_NAME = 200
# Characters that some file system refuses or treats specially: separators, wildcards, quotes.
_REFUSED = '\\:*?"<>|'
_FRAME_DIGITS = re.compile(r"0?(?:[1-9]\d?)?d?", re.ASCII)
_FRAMES = re.compile(r"(-?\d+)(?:-(-?\d+)(?::(\d+))?)?", re.ASCII)


# From text to values. Each function raises ValueError that says what was found and what was expected.


def real_number(text: str) -> float:
    """The number that a text is; NaN, which no limit allows, where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def names_or_tables(what: str, known: Iterable[str], *, is_one: bool = False) -> Callable[[str], tuple[str, ...]]:
    """The parser of `known` names and paths of tables, separated by commas; errors begin with `what`."""

    def parse(text: str) -> tuple[str, ...]:
        names = (text,) if is_one else _names(text)
        unknown = [name for name in names if name not in known and not name.endswith(".npz")]
        if unknown or not names:
            wanted = f"expected some of {', '.join(known)} or the path of a table (.npz)"
            raise ValueError(f"{what} {(unknown or [text])[0]!r} is unknown, {wanted}")
        return names

    return parse


techniques = names_or_tables("technique", TECHNIQUES)
tables = names_or_tables("table", SHIPPED_TABLES)
one_table = names_or_tables("table", SHIPPED_TABLES, is_one=True)


def amount(what: str, expected: str) -> Callable[[str], float]:
    """The parser of numbers above 0; errors begin with `what`, such as "budget is"."""

    def parse(text: str) -> float:
        value = real_number(text)
        if not 0.0 < value < 1e9:
            raise ValueError(f"{what} {text!r}, expected {expected}, more than 0")
        return value

    return parse


seconds = amount("budget is", "seconds of processor time")
texels_per_metre = amount("texels per metre are", "a number")


def passes(known: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    """The parser of some of the `known` passes, separated by commas."""

    def parse(text: str) -> tuple[str, ...]:
        names = _names(text)
        if not names or not set(names) <= set(known):
            raise ValueError(f"passes are {text!r}, expected some of {', '.join(known)}")
        return names

    return parse


def _names(text) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for name in text.split(",") if name))


def sides(what: str, expected: str, limits: tuple[int, int], counts: tuple[int, ...]) -> Callable:
    """The parser of the sides of a rectangle, as many as `counts` allows; errors begin with `what`."""

    def parse(text: str) -> tuple[int, int]:
        numbers = [int(side) if side.isdecimal() else -1 for side in text.split("x")]
        if len(numbers) in counts and all(limits[0] <= number <= limits[1] for number in numbers):
            return numbers[0], numbers[-1]
        raise ValueError(f"{what} {text!r}, expected {expected}, each from {limits[0]} to {limits[1]}")

    return parse


resolution = sides("resolution is", "WIDTHxHEIGHT such as 960x540", PICTURE_SIDES, (2,))  # in pixels
size = sides("size is", "N or WIDTHxHEIGHT such as 2048", TEXTURE_SIDES, (1, 2))  # in texels


def frames(text: str) -> tuple[int, ...]:
    """Frame numbers: single ones and ranges FIRST-LAST or FIRST-LAST:STEP, separated by commas; each once."""
    numbers: dict[int, None] = {}
    for item in text.split(","):
        match = _FRAMES.fullmatch(item.strip())
        first, last, step = (None if group is None else int(group) for group in match.groups()) if match else [None] * 3
        if first is None or max(abs(first), abs(last or 0)) > LAST_FRAME:
            raise ValueError(
                f"frame is {item!r}, expected a whole number from -{LAST_FRAME} to {LAST_FRAME}, or a range such as "
                "1-240 or 1-240:2"
            )
        if last is not None and (last < first or step == 0):
            raise ValueError(f"frames are {item!r}, expected FIRST-LAST:STEP, upwards, STEP above 0")
        if len(numbers) + ((first if last is None else last) - first) // (step or 1) >= MOST_FRAMES:
            raise ValueError(f"frames are {text[:80]!r}, expected at most {MOST_FRAMES} of them")
        numbers.update(dict.fromkeys(range(first, (first if last is None else last) + 1, step or 1)))
    return tuple(numbers)


def positive(text: str) -> int:
    """A whole number above 0."""
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise ValueError(f"{text!r} was given, expected a whole number above 0")


def whole_number(what: str, least: int, most: int) -> Callable[[str], int]:
    """The parser of whole numbers from `least` to `most`; errors begin with `what`, such as "margin is"."""

    def parse(text: str) -> int:
        if text.isdecimal() and least <= int(text) <= most:
            return int(text)
        raise ValueError(f"{what} {text!r}, expected a whole number from {least} to {most}")

    return parse


refinements = whole_number("refine is", 1, MOST_REFINEMENTS)  # number of pictures whose mean is a view
shadow_rays = whole_number("shadow rays are", *SHADOW_RAYS)  # number of rays per light and point
margin = whole_number("margin is", 0, MOST_MARGIN)  # width of the margin around islands in texels
atlas = whole_number("atlas is", *TEXTURE_SIDES)  # texels on each side of the texture that all objects share


def cycles_samples(text: str) -> int:
    """Number of samples of both halves of a Cycles reference together."""
    value = positive(text)
    if value < 2:
        raise ValueError("1 was given, expected at least 2: one for each half")
    if value > MOST_CYCLES_SAMPLES:
        raise ValueError(f"{value} was given, expected at most {MOST_CYCLES_SAMPLES}")
    return value


def view(text: str) -> tuple[float, ...] | str:
    """camera, above or a position."""
    if text in ("camera", "above"):
        return text
    position = tuple(map(real_number, text.split(",")))
    if len(position) == 3 and all(abs(value) < 1e12 for value in position):
        return position
    raise ValueError(f"view is {text!r}, expected camera, above or a position such as 0,-4,1.5")


def frame_number(text: str) -> int:
    """One frame."""
    numbers = frames(text)
    if len(numbers) != 1:
        raise ValueError(f"frame is {text!r}, expected one number")
    return numbers[0]


def picture_file(text: str) -> Path:
    """The name of a file that exists."""
    if not Path(text).is_file():
        raise ValueError(f"picture {text!r}: no such file")
    return Path(text)


def folder(text: str) -> Path:
    """The name of a folder."""
    if not text.strip():
        raise ValueError("the name of the folder is empty (a shell variable that is not set?)")
    return Path(text)


def file_pattern(pattern: str, known: tuple[str, ...] = NAME_FIELDS) -> str:
    """`pattern`, checked: it has only `known` fields and names files below the output folder. Raises ValueError."""
    expected = f"expected fields {', '.join('{' + name + '}' for name in known)}, such as {{scene}}_{{frame:04d}}"
    if not pattern or len(pattern) > LONGEST_NAME:
        raise ValueError(f"name has {len(pattern)} letters, expected 1 to {LONGEST_NAME}")
    try:
        for _, name, digits, conversion in string.Formatter().parse(pattern):
            if name is not None and (name not in known or conversion):
                raise ValueError(f"name {pattern!r}: {{{name}}} is unknown, {expected}")
            if digits and not (name == "frame" and _FRAME_DIGITS.fullmatch(digits)):
                raise ValueError(f"name {pattern!r}: {{{name}:{digits}}} is no way to write it, {expected}")
        example = pattern.format(**{name: 1 if name == "frame" else "x" for name in known})
    except (KeyError, IndexError, ValueError) as error:
        text = str(error)
        raise ValueError(text if text.startswith("name ") else f"name {pattern!r}: {text}; {expected}") from None
    for name in example.split("/"):
        if not name.strip(" ") or name.startswith(".") or name.endswith((".", " ")):
            raise ValueError(
                f"name {pattern!r} gives {example!r}, expected names below the output folder that do not begin or end "
                "with a dot: folders are separated by single /"
            )
    if bad := [letter for letter in example if letter in _REFUSED or not letter.isprintable()]:
        raise ValueError(f"name {pattern!r} has the letter {bad[0]!r}, which not every file system takes: leave it out")
    return pattern


# Declaring options:


@dataclass(frozen=True)
class Argument:
    """An argument of the command line: its flags, and what argparse's `add_argument` takes by keyword."""

    flags: tuple[str, ...]
    keywords: dict[str, Any]


def argument(*flags: str, **keywords) -> Argument:
    """An argument; `type` turns its text into a value."""
    return Argument(flags, keywords)


def option(
    *flags: str, either: tuple[Argument, ...] = (), matters: bool = True, default: Any = MISSING, **keywords
) -> Any:
    """A dataclass field with one argument, with none, or with several of which one may be given (`either`).

    `matters` is False where results do not depend on the field. Only a field without a `default` is positional.
    """
    arguments = (argument(*flags, **keywords),) if flags else either
    metadata = {"arguments": arguments, "matters": matters}
    return field(default=default, kw_only=default is not MISSING, metadata=metadata)


def flag(name: str, meaning: str) -> Any:
    """A field that is True if the flag is given."""
    return option(name, default=False, action="store_true", help=meaning)


def _techniques(known: Iterable[str] = TECHNIQUES, default=(DEFAULT_TECHNIQUE,), parse: Callable = techniques) -> Any:
    one = "the path of a table (.npz)" if parse is one_table else "paths of tables (.npz), separated by commas"
    meaning = f"{', '.join(known)} or {one} (default: {','.join(default)})"
    return option("--techniques", default=default, type=parse, metavar="T", help=meaning)


def _passes_of(known: tuple[str, ...], default: str) -> Any:
    meaning = f"some of {','.join(known)} (default: {default})"
    return option("--passes", default=PASSES, type=passes(known), metavar="P", help=meaning)


def _stem(parse: Callable) -> Any:
    meaning = (
        "of files, such as {scene}_{camera}_{frame:04d}; default: the command, or {object} of a bake, followed by "
        "those of scene, camera and frame of which there are several"
    )
    return option("--name", matters=False, default=None, dest="pattern", type=parse, metavar="PATTERN", help=meaning)


def _cycles_samples(what: str, default: int) -> Any:
    meaning = f"of both halves of {what} together (default: %(default)s)"
    return option("--cycles-samples", default=default, type=cycles_samples, metavar="N", help=meaning)


def _shadows() -> Any:
    meaning = (
        "whether surfaces stand in each other's light, in the Cycles reference too; off compares the lobes alone "
        "(default: %(default)s)"
    )
    return option("--shadows", default="on", choices=("on", "off"), help=meaning)


def _bounces(what: str) -> Any:
    meaning = f"also {what}, by Cycles and denoised (default: %(default)s)"
    return option("--bounces", default="off", choices=("on", "off"), help=meaning)


def _rest_samples() -> Any:
    meaning = "of Cycles for the bounces (default: %(default)s)"
    return option("--rest-samples", default=64, type=cycles_samples, metavar="N", help=meaning)


@dataclass(frozen=True)
class TaskOptions:
    """What all commands share; None means as in the file."""

    scene: Path = option(
        "scenes", matters=False, nargs="*", metavar="SCENE.blend",
        help="one or more; left out when Blender has a file open",
    )  # fmt: skip
    # The command line takes several frames. Each is a task of its own, with one frame in this field.
    frame: int | None = option(
        "--frames", "--frame", default=None, dest="frames", type=frames, metavar="F",
        help="such as 12 or 1-240:2,300 (--frames=-10--1 where the first is negative); default: the file's current one",
    )  # fmt: skip
    camera: str | None = option(
        "--camera", default=None, dest="cameras", action="append", metavar="NAME",
        help="may be given several times; default: the scene's camera",
    )  # fmt: skip
    name: str | None = _stem(partial(file_pattern, known=NAME_FIELDS[:-1]))  # without suffix; None: the command
    output: Path = option(
        "-o", matters=False, dest="output", type=folder, required=True, metavar="OUT", help="folder for the results"
    )
    shadow_rays: int = option(
        "--shadow-rays", default=256, type=shadow_rays, metavar="N",
        help="at most so many per light and point where some are blocked and some are not; shared by the points of a "
        "pixel or texel (default: %(default)s)",
    )  # fmt: skip
    scripts: bool = flag("--enable-autoexec", "run the scripts and Python drivers in the .blend, else they do not run")


@dataclass(frozen=True)
class CameraOptions(TaskOptions):
    """What pictures share."""

    resolution: tuple[int, int] | None = option(
        "--resolution", default=None, type=resolution, metavar="WxH", help="default: as in the file"
    )


@dataclass(frozen=True)
class PictureOptions(CameraOptions):
    """What to shade and how; None means as in the file."""

    # Names, paths of tables, or (only from Python) a `shading.OwnTechnique`.
    techniques: tuple[Any, ...] = _techniques()
    passes: tuple[str, ...] = _passes_of(PASSES, "both")
    sub_samples: int = option(
        "--aa", default=1, type=positive, metavar="N", help="points per pixel, drawn from its filter; 1: pixel centers"
    )
    reference_samples: int = option(
        "--reference-samples", default=150_000, type=positive, metavar="N",
        help="'reference' takes a random subset of this size where there are more samples (default: %(default)s)",
    )  # fmt: skip
    cycles_samples: int = _cycles_samples("the Cycles reference", 512)
    shadows: str = _shadows()
    keep_visibility: bool = flag("--keep-visibility", "also keep what `relight` needs, beside the EXR as two .npz")
    page: str = option(default="report.html", matters=False)  # file name of a comparison's HTML page


@dataclass(frozen=True)
class CompareOptions(PictureOptions):
    """What to put beside Cycles and how; None means as in the file."""

    techniques: tuple[Any, ...] = _techniques(default=COMPARED_TECHNIQUES)


@dataclass(frozen=True)
class DemoOptions(CompareOptions):
    """How to show all techniques."""

    techniques: tuple[Any, ...] = _techniques(default=tuple(TECHNIQUES))


@dataclass(frozen=True)
class BakeOptions(TaskOptions):
    """What to bake and how; None means as in the file."""

    name: str | None = _stem(file_pattern)  # of the file of the only object
    objects: tuple[str, ...] | str = option(  # names, "selected" or "all"
        default="all",
        matters=False,
        either=(
            argument("--object", action="append", metavar="NAME", help="may be given several times; default: --all"),
            argument(
                "--selected", action="store_const", const="selected", help="the objects that are selected in the file"
            ),
            argument("--all", action="store_const", const="all", help="all meshes that render"),
        ),
    )
    uv: str | None = option("--uv", default=None, metavar="NAME", help="UV map; default: the active one")
    size: tuple[int, int] = option(
        "--size", default=(1024, 1024), type=size, metavar="N", help="N or WxH in texels (default: 1024)"
    )
    atlas: int | None = option(
        "--atlas", default=None, type=atlas, metavar="N",
        help="one texture of N x N texels for all objects, on a UV map Lightmap that is made for it, or on --uv",
    )  # fmt: skip
    texels_per_metre: float | None = option(
        "--texels-per-metre",
        default=None,
        type=texels_per_metre,
        metavar="D",
        help="of the atlas (default: all that fit)",
    )
    unwrap: str = option(
        "--unwrap", default="smart", choices=("smart", "faces"), help="atlas: by direction, or each face"
    )
    sub_samples: int = option(
        "--aa", default=1, type=positive, metavar="N", help="points per texel, spread as in Cycles' bake; 1: centers"
    )
    margin: int = option("--margin", default=16, type=margin, metavar="PX", help="in texels (default: %(default)s)")
    conservative: bool = flag("--conservative", "bake every texel that a face touches")
    view: tuple[float, float, float] | str = option(
        "--view", default="camera", type=view, metavar="V",
        help="camera, above (along the normals) or a position X,Y,Z in m (default: %(default)s)",
    )  # fmt: skip
    techniques: tuple[str, ...] = _techniques()
    passes: tuple[str, ...] = _passes_of(BAKE_PASSES, ",".join(PASSES))
    error: bool = flag("--error", "beside Cycles' bake: signed errors, also as pictures")
    cycles_samples: int = _cycles_samples("Cycles' bake", 256)  # with `error`
    shadows: str = _shadows()
    bounces: str = _bounces("bounced light")
    rest_samples: int = _rest_samples()
    per_light: bool = flag("--per-light", "a layer for each light, with its bounced light, so that powers can change")
    apply: bool = flag("--apply", "also a texture of each object, and a copy of the .blend whose materials show it")
    export: str | None = option(
        "--export", default=None, choices=("glb",), matters=False,
        help="also the objects as glTF, with lightmaps (pass diffuse_light), with unlit colors (other passes)",
    )  # fmt: skip

    def __post_init__(self):
        if self.atlas is not None:
            object.__setattr__(self, "size", (self.atlas, self.atlas))
        if set(self.passes) == {"diffuse_light"}:
            # The same from everywhere, but for lobes that turn away from a camera.
            object.__setattr__(self, "view", "above")


@dataclass(frozen=True)
class ViewOptions(CameraOptions):
    """What to draw as the viewport does; None means as in the file."""

    techniques: tuple[str, ...] = _techniques(SHIPPED_TABLES, parse=tables)
    refine: int = option(
        "--refine", default=16, type=refinements, metavar="N",
        help="mean of N pictures, each of other points of the pixels; 1: pixel centers (default: %(default)s)",
    )  # fmt: skip
    shadows: str = _shadows()
    bounces: str = _bounces("bounces, reflections, refraction, materials by nodes")
    rest_samples: int = _rest_samples()


@dataclass(frozen=True)
class RenderOptions(CameraOptions):
    """What finished picture to render and how; None means as in the file."""

    techniques: tuple[str, ...] = _techniques(SHIPPED_TABLES, parse=one_table)
    sub_samples: int | None = option(
        "--aa", default=None, type=positive, metavar="N",
        help="points per pixel of the direct light, shared by the pixel filter (default: by the samples of "
        "Cycles, none below 64, or by the budget)",
    )  # fmt: skip
    cycles_samples: int | None = option(
        "--cycles-samples", default=None, type=cycles_samples, metavar="N", help="of Cycles; default: as in the file"
    )
    budget: float | None = option(
        "--budget", default=None, type=seconds, metavar="SECONDS",
        help="of processor time for the whole picture, in place of --cycles-samples",
    )  # fmt: skip
    denoise: str = option(
        "--denoise", default="on", choices=("on", "off"), help="what Cycles renders (default: %(default)s)"
    )
    keep_visibility: bool = flag("--keep-visibility", "also keep what `relight` needs, beside the EXR as .npz")
    own_groups: tuple[str, ...] | None = option(default=None)  # lights, () for all, that get light groups of their own

    @property
    def needs_each_light(self) -> bool:
        """Whether the light of each lamp is wanted by itself, on all of the picture."""
        return self.keep_visibility or self.own_groups is not None


@dataclass(frozen=True)
class MatchOptions(TaskOptions):
    """Which lights should make the scene look like a picture; None means as in the file."""

    frame: int | None = option("--frame", default=None, type=frame_number, metavar="F", help="default: the file's")
    camera: str | None = option("--camera", default=None, metavar="NAME", help="default: the scene's camera")
    target: Path = option(
        "--target", default=Path(), type=picture_file, required=True, metavar="IMAGE",
        help="the picture that the scene should look like, of the same camera",
    )  # fmt: skip
    target_view: str | None = option(
        "--target-view", default=None, metavar="VIEW",
        help="view transform of a target of 8 or 16 bits, such as Standard or AgX (default: the scene's)",
    )  # fmt: skip
    mask: Path | None = option(
        "--mask", default=None, type=picture_file, metavar="IMAGE", help="white where the target counts, else black"
    )
    lights: tuple[str, ...] = option(
        "--light", default=(), action="append", metavar="NAME", help="may be given several times; default: all"
    )
    colors: bool = flag("--colors", "also change the colors of lights, not only their powers")
    move: bool = flag("--move", "also change the places and directions of lights")
    add: int = option("--add", default=0, type=positive, metavar="N", help="new area lights (default: none)")
    sizes: bool = flag("--sizes", "with --move, also change the sizes of lights")
    techniques: tuple[str, ...] = _techniques(SHIPPED_TABLES, parse=one_table)
    cycles_samples: int = option(
        "--cycles-samples", default=256, type=cycles_samples, metavar="N", help="of Cycles (default: %(default)s)"
    )


# Derived from the declarations:


def arguments_of(kind: type) -> dict[str, tuple[Any, tuple[Argument, ...]]]:
    """Default and arguments of the fields that have arguments, by field name, in the order of --help."""
    declared = {item.name: (item.default, item.metadata["arguments"]) for item in fields(kind)}
    return {name: (default, arguments) for name, (default, arguments) in declared.items() if arguments}


def options_from(kind: type, values: dict[str, Any], **settings) -> Any:
    """Options of the class `kind` with `values` of a parsed command line (None: the default) and `settings`."""
    given = {item.name: values[item.name] for item in fields(kind) if values.get(item.name) is not None}
    given = {name: tuple(dict.fromkeys(value)) if isinstance(value, list) else value for name, value in given.items()}
    return kind(**{**given, **settings})


def command_line(options: Any) -> list[str]:
    """The command line that gives `options`: scene, output, then all options that differ from their defaults."""
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
    matters = {item.name for item in fields(options) if item.metadata["matters"]}
    if values.get("atlas") is not None:
        matters.add("objects")
    return {name: value for name, value in values.items() if name in matters}


def child_job(kind: type, options: Any, **settings) -> Any:
    """The second Blender's job of the class `kind`, with the `options` that it shares, and `settings`."""
    shared = {item.name: getattr(options, item.name) for item in fields(kind) if hasattr(options, item.name)}
    return kind(**{**shared, **settings})
