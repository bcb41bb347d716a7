"""`ltsh bake`: arguments and what is printed at the end."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from . import argument_values as values
from .bake import BAKE_PASSES, MARGIN_TYPES, SIZES, BakeOptions, bake_scene
from .progress_bar import say

EXAMPLES = """examples:
  %(prog)s room.blend -o out/room
  %(prog)s room.blend -o out/room --object Floor --object Wall --size 2048 --uv Lightmap --view above
  %(prog)s room.blend -o out/room --passes diffuse_light --size 512
  %(prog)s room.blend -o out/room --object Floor --techniques ltc,ltsh4 --error --cycles-samples 1024

An object that cannot be baked is named at the end, and the exit code is 1; the others are baked all the same.
"""
ERROR_SAMPLES = 256


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments and the function that runs."""
    parser.epilog, parser.formatter_class = EXAMPLES, argparse.RawDescriptionHelpFormatter
    parser.add_argument("scene", nargs="?", metavar="SCENE.blend", help="left out when Blender has a file open")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="folder for the results")
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--object", action="append", metavar="NAME", help="may be given several times; default: --all")
    chosen.add_argument("--selected", action="store_true", help="the objects that are selected in the file")
    chosen.add_argument("--all", action="store_true", help="all meshes that render")
    parser.add_argument("--uv", metavar="NAME", help="UV map; default: the active one")
    parser.add_argument(
        "--size", type=_size, default=(1024, 1024), metavar="N", help="N or WxH in texels (default: 1024)"
    )
    parser.add_argument("--margin", type=_margin, default=16, metavar="PX", help="in texels (default: 16)")
    parser.add_argument(
        "--margin-type", choices=MARGIN_TYPES, default=BakeOptions.margin_type,
        help="the margin repeats the nearest texel, or shows the adjacent face (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--conservative", action="store_true", help="bake every texel that a face touches")
    parser.add_argument(
        "--view", type=_view, default="camera", metavar="V",
        help="camera, above (along the normals) or a position X,Y,Z in m (default: camera)",
    )  # fmt: skip
    parser.add_argument("--techniques", type=values.techniques, default=BakeOptions.techniques, help="default: ltsh4")
    parser.add_argument(
        "--passes", type=_passes, default=BakeOptions.passes,
        help=f"some of {','.join(BAKE_PASSES)} (default: {','.join(BakeOptions.passes)})",
    )  # fmt: skip
    frame = "default: the file's current frame"
    parser.add_argument("--frames", "--frame", dest="frame", type=values.frame, metavar="F", help=frame)
    parser.add_argument("--camera", metavar="NAME", help="default: the scene's camera")
    parser.add_argument("--error", action="store_true", help="beside Cycles' bake: signed errors, also as pictures")
    parser.add_argument(
        "--cycles-samples", type=values.cycles_samples, default=ERROR_SAMPLES, metavar="N",
        help="of both halves of Cycles' bake together (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--apply", action="store_true",
        help="also a texture of each object, and a copy of the .blend whose materials show it",
    )  # fmt: skip
    parser.add_argument("--resume", action="store_true", help="keep the files that the same job has finished in OUT")
    parser.add_argument("--json", action="store_true", help="print the report on stdout as one JSON document")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run)


def run(arguments, bar, open_file) -> int:
    """Bake; 0, or 1 where some object could not be baked."""
    objects = tuple(dict.fromkeys(arguments.object or ())) or ("selected" if arguments.selected else "all")
    width, height = arguments.size
    options = BakeOptions(
        scene=values.scene(arguments, open_file),
        output=arguments.output,
        objects=objects,
        uv=arguments.uv,
        width=width,
        height=height,
        margin=arguments.margin,
        margin_type=arguments.margin_type,
        conservative=arguments.conservative,
        view=arguments.view,
        techniques=arguments.techniques,
        passes=arguments.passes,
        frame=arguments.frame,
        camera=arguments.camera,
        cycles_samples=arguments.cycles_samples if arguments.error else 0,
        resume=arguments.resume,
        apply=arguments.apply,
    )
    report = bake_scene(options, bar)
    bar.finish()
    if arguments.json:
        from .imaging import report as report_files

        say(json.dumps(json.loads(report_files.json_text(report)), indent=2), sys.stdout)
    else:
        for warning in report["warnings"]:
            say(f"warning: {warning}", sys.stderr)
        say(summary(report, arguments.output), sys.stdout)
    for problem in report["problems"]:
        say(f"not baked: {problem}", sys.stderr)
    return 1 if report["problems"] else 0


def summary(report: dict, output: Path) -> str:
    """A table for the terminal: one line per file, errors where there are any."""
    lines = []
    for record in report["objects"]:
        for tile in record["tiles"].values():
            seconds = report["seconds"].get(tile["file"], 0.0)
            lines.append(f"{tile['file']:<40}{tile['texels']:>10} texels{seconds:>8.2f} s")
            for pass_name, figures in tile.get("errors", {}).items():
                for name, error in figures["techniques"].items():
                    found = "in noise" if error["unbiased_squared_error"] < 0.0 else _percent(error["unbiased_error"])
                    noise = f"(noise {_percent(figures['noise'])})"
                    lines.append(f"  {name + '.' + pass_name:<30}{found:>10} beside Cycles {noise}")
    lines.append(f"written to {output}")
    return "\n".join(lines)


def _percent(value) -> str:
    return "-" if value is None else f"{100.0 * value:.2f} %"


def _size(text: str) -> tuple[int, int]:
    sides = text.split("x")
    if len(sides) in (1, 2) and all(side.isdecimal() for side in sides):
        width, height = int(sides[0]), int(sides[-1])
        if SIZES[0] <= min(width, height) and max(width, height) <= SIZES[1]:
            return width, height
    raise argparse.ArgumentTypeError(
        f"size is {text!r}, expected N or WIDTHxHEIGHT such as 2048, each from {SIZES[0]} to {SIZES[1]}"
    )


def _margin(text: str) -> int:
    if text.isdecimal() and int(text) <= 512:
        return int(text)
    raise argparse.ArgumentTypeError(f"margin is {text!r}, expected a whole number from 0 to 512")


def _view(text: str):
    if text in ("camera", "above"):
        return text
    try:
        position = tuple(float(part) for part in text.split(","))
    except ValueError:
        position = ()
    if len(position) == 3 and all(abs(value) < 1e12 for value in position):
        return position
    raise argparse.ArgumentTypeError(f"view is {text!r}, expected camera, above or a position such as 0,-4,1.5")


def _passes(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name for name in text.split(",") if name))
    if not names or any(name not in BAKE_PASSES for name in names):
        raise argparse.ArgumentTypeError(f"passes are {text!r}, expected some of {', '.join(BAKE_PASSES)}")
    return names
