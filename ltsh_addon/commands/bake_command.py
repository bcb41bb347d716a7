"""`ltsh bake`: its arguments, and the job that they describe."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..baking.bake import BAKE_PASSES, MARGIN_TYPES, SIZES, BakeOptions
from ..jobs.tasks import Job
from . import argument_values as values
from . import common_options as options
from .job_runs import run_job

DESCRIPTION = """Shade the texels of UV maps. OUT gets an EXR for each object, with a layer for each
technique and pass, and report.json; UDIM tiles get files of their own."""
EXAMPLES = """examples:
  %(prog)s room.blend -o out/room
  %(prog)s room.blend -o out/room --object Floor --object Wall --size 2048 --uv Lightmap --view above
  %(prog)s room.blend -o out/room --passes diffuse_light --size 512
  %(prog)s room.blend -o out/room --object Floor --techniques ltc,ltsh4 --error --cycles-samples 1024
  %(prog)s room.blend -o out/room --frames 1-240:2 --shard 1/4 --resume

An object that cannot be baked is named at the end, and the exit code is 1; the others are baked all the same.
"""
ERROR_SAMPLES = 256


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments and the function that runs."""
    options.with_examples(parser, DESCRIPTION, EXAMPLES)
    parser.add_argument("scenes", nargs="*", metavar=options.SCENES, help="left out when Blender has a file open")
    options.add_output(parser)
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
    parser.add_argument("--techniques", type=values.techniques, default=BakeOptions.techniques, metavar="T",
                        help=f"{values.TECHNIQUES_HELP} (default: ltsh4)")  # fmt: skip
    parser.add_argument(
        "--passes", type=_passes, default=BakeOptions.passes, metavar="P",
        help=f"some of {','.join(BAKE_PASSES)} (default: {','.join(BakeOptions.passes)})",
    )  # fmt: skip
    options.add_moments(parser, values.name_of_bake)
    parser.add_argument("--error", action="store_true", help="beside Cycles' bake: signed errors, also as pictures")
    parser.add_argument(
        "--cycles-samples", type=values.cycles_samples, default=ERROR_SAMPLES, metavar="N",
        help="of both halves of Cycles' bake together (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--apply", action="store_true",
        help="also a texture of each object, and a copy of the .blend whose materials show it",
    )  # fmt: skip
    options.add_batch(parser)
    options.add_trust(parser)
    options.add_memory(parser, "bake")
    options.add_talk(parser)
    parser.set_defaults(run=run)


def run(arguments, bar, open_file) -> int:
    """Bake; 0, or 1 where some object could not be baked."""
    return run_job(job_of(arguments, values.scenes(arguments, open_file)), arguments, bar)


def job_of(arguments, scenes: tuple[Path, ...]) -> Job:
    """The job that the arguments describe. Raises Misuse."""
    cameras = options.cameras(arguments)
    if arguments.apply and (len(cameras) > 1 or len(arguments.frames) > 1):
        raise values.Misuse("--apply makes materials show one texture: give one frame and one camera with it")
    width, height = arguments.size
    wanted = BakeOptions(
        scene=scenes[0],
        output=arguments.output,
        objects=tuple(dict.fromkeys(arguments.object or ())) or ("selected" if arguments.selected else "all"),
        uv=arguments.uv,
        width=width,
        height=height,
        margin=arguments.margin,
        margin_type=arguments.margin_type,
        conservative=arguments.conservative,
        view=arguments.view,
        techniques=arguments.techniques,
        passes=arguments.passes,
        cycles_samples=arguments.cycles_samples if arguments.error else 0,
        apply=arguments.apply,
        scripts=arguments.enable_autoexec,
        memory_mib=arguments.memory_limit,
    )
    return Job("bake", wanted, scenes, cameras, arguments.frames, arguments.name)


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
