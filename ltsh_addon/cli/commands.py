"""The commands: shade, compare, demo, bake, merge, run, tables."""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from ..pipeline.bake import BAKE_PASSES, MARGIN_TYPES, SIZES, BakeOptions
from ..pipeline.baseline import Baseline
from ..pipeline.batch import merge
from ..pipeline.picture import DEFAULT_TECHNIQUES, Options, prepare
from ..pipeline.tasks import Job
from ..scene import SceneError, error_line
from ..shading import PASSES, SHIPPED_TABLES, TableError
from . import arguments as arguments_module
from .arguments import (
    SCENES,
    TECHNIQUES_HELP,
    Misuse,
    add_baseline,
    add_batch,
    add_memory,
    add_moments,
    add_output,
    add_scenes,
    add_talk,
    add_trust,
    cameras,
    cycles_samples,
    name_of_bake,
    name_of_picture,
    passes,
    positive,
    table,
    techniques,
    with_examples,
)
from .job_file import Command, Wanted, read_jobs
from .output import do_job, finish, merge_folder, print_json, run_job
from .progress import say

DEMO_RESOLUTION = (480, 270)
DEMO = "Build the example scene, OUT/demo.blend, and do with it what compare does."
COMPARE = """Shade what the camera sees with several techniques, render the same direct light
with Cycles, and measure how far apart they are. OUT gets compare.exr (all layers
in float), compare.png (side by side, signed errors below), report.html and
report.json."""
SHADE = """Shade what the camera sees. OUT gets shade.exr, with a layer for each technique and
pass, and report.json."""
DEMO_EXAMPLES = """examples:
  %(prog)s -o out/demo
  %(prog)s -o out/demo --resolution 960x540 --cycles-samples 4096
"""
COMPARE_EXAMPLES = """examples:
  %(prog)s room.blend -o out/room --resolution 960x540 --cycles-samples 1024
  %(prog)s room.blend -o out/room --frames 1-240:2 --camera Left --camera Right
  %(prog)s room.blend hall.blend -o out/both --name "{scene}/{scene}_{frame:04d}"
  %(prog)s room.blend -o out/room --frames 1-240 --shard 1/4 --resume
  %(prog)s room.blend -o out/today --baseline out/yesterday/report.json --tolerance 0.002
"""
SHADE_EXAMPLES = """examples:
  %(prog)s room.blend -o out/room --techniques ltsh4 --aa 16
  %(prog)s room.blend -o out/room --frames 1-240 --resume
"""


def add_demo(parser) -> None:
    """Add the arguments and the function that runs."""
    with_examples(parser, DEMO, DEMO_EXAMPLES)
    add_moments(parser, name_of_picture)
    _add_picture(parser, cycles=True, resolution="{}x{}".format(*DEMO_RESOLUTION))
    parser.set_defaults(run=_demo, scenes=[])


def add_compare(parser) -> None:
    """Add the arguments and the function that runs."""
    with_examples(parser, COMPARE, COMPARE_EXAMPLES)
    add_scenes(parser)
    _add_picture(parser, cycles=True)
    add_baseline(parser)
    parser.set_defaults(run=_run_picture)


def add_shade(parser) -> None:
    """Add the arguments and the function that runs."""
    with_examples(parser, SHADE, SHADE_EXAMPLES)
    add_scenes(parser)
    _add_picture(parser, cycles=False)
    parser.set_defaults(run=_run_picture)


def _add_picture(parser, *, cycles, resolution="as in the file"):
    add_output(parser)
    names = ",".join(DEFAULT_TECHNIQUES)
    parser.add_argument("--techniques", type=techniques, default=DEFAULT_TECHNIQUES, metavar="T",
                        help=f"{TECHNIQUES_HELP} (default: {names})")  # fmt: skip
    parser.add_argument("--passes", type=passes, default=PASSES, metavar="P",
                        help=f"some of {','.join(PASSES)} (default: both)")  # fmt: skip
    parser.add_argument("--resolution", type=arguments_module.resolution, metavar="WxH", help=f"default: {resolution}")
    parser.add_argument("--aa", type=positive, default=1, metavar="N",
                        help="points per pixel, drawn from its filter; 1: pixel centers")  # fmt: skip
    parser.add_argument(
        "--reference-samples", type=positive, default=Options.reference_samples, metavar="N",
        help="'reference' takes a random subset of this size where there are more samples (default: %(default)s)",
    )  # fmt: skip
    if cycles:
        parser.add_argument(
            "--cycles-samples", type=cycles_samples, default=Options.cycles_samples, metavar="N",
            help="of both halves of the Cycles reference together (default: %(default)s)",
        )  # fmt: skip
    add_batch(parser)
    add_trust(parser)
    add_memory(parser, "picture")
    add_talk(parser)


def picture_job(arguments, scenes: tuple[Path, ...], resolution=None) -> Job:
    """The job that the arguments describe; `resolution` where they say nothing about it."""
    width, height = arguments.resolution or resolution or (None, None)
    command = "shade" if arguments.command == "shade" else "compare"
    wanted = Options(
        scene=scenes[0],
        output=arguments.output,
        techniques=arguments.techniques,
        passes=arguments.passes,
        width=width,
        height=height,
        sub_samples=arguments.aa,
        cycles_samples=getattr(arguments, "cycles_samples", 0),
        reference_samples=arguments.reference_samples,
        scripts=arguments.enable_autoexec,
        memory_mib=arguments.memory_limit,
    )
    return Job(command, wanted, scenes, cameras(arguments), arguments.frames, arguments.name)


def _run_picture(arguments, bar, open_file) -> int:
    if getattr(arguments, "baseline", None) and arguments.shard and arguments.shard[1] > 1:
        raise Misuse("--baseline is for the whole job, not for a shard of it: give it to `merge`")
    return run_job(picture_job(arguments, arguments_module.scenes(arguments, open_file)), arguments, bar)


def _demo(arguments, bar, open_file) -> int:
    from ..blender.process import client

    job = picture_job(arguments, (arguments.output / "demo.blend",), DEMO_RESOLUTION)
    prepare(job.options)
    client.build_demo(job.scenes[0], progress=bar)
    return run_job(job, arguments, bar)


BAKE = """Shade the texels of UV maps. OUT gets an EXR for each object, with a layer for each
technique and pass, and report.json; UDIM tiles get files of their own."""
BAKE_EXAMPLES = """examples:
  %(prog)s room.blend -o out/room
  %(prog)s room.blend -o out/room --object Floor --object Wall --size 2048 --uv Lightmap --view above
  %(prog)s room.blend -o out/room --passes diffuse_light --size 512
  %(prog)s room.blend -o out/room --object Floor --techniques ltc,ltsh4 --error --cycles-samples 1024
  %(prog)s room.blend -o out/room --frames 1-240:2 --shard 1/4 --resume

An object that cannot be baked is named at the end, and the exit code is 1; the others are baked all the same.
"""
ERROR_SAMPLES = 256


def add_bake(parser: argparse.ArgumentParser) -> None:
    """Add the arguments and the function that runs."""
    with_examples(parser, BAKE, BAKE_EXAMPLES)
    parser.add_argument("scenes", nargs="*", metavar=SCENES, help="left out when Blender has a file open")
    add_output(parser)
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
    parser.add_argument("--techniques", type=techniques, default=BakeOptions.techniques, metavar="T",
                        help=f"{TECHNIQUES_HELP} (default: ltsh4)")  # fmt: skip
    parser.add_argument(
        "--passes", type=_passes, default=BakeOptions.passes, metavar="P",
        help=f"some of {','.join(BAKE_PASSES)} (default: {','.join(BakeOptions.passes)})",
    )  # fmt: skip
    add_moments(parser, name_of_bake)
    parser.add_argument("--error", action="store_true", help="beside Cycles' bake: signed errors, also as pictures")
    parser.add_argument(
        "--cycles-samples", type=cycles_samples, default=ERROR_SAMPLES, metavar="N",
        help="of both halves of Cycles' bake together (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--apply", action="store_true",
        help="also a texture of each object, and a copy of the .blend whose materials show it",
    )  # fmt: skip
    add_batch(parser)
    add_trust(parser)
    add_memory(parser, "bake")
    add_talk(parser)
    parser.set_defaults(run=_run_bake)


def _run_bake(arguments, bar, open_file) -> int:
    """Bake; 0, or 1 where some object could not be baked."""
    return run_job(bake_job(arguments, arguments_module.scenes(arguments, open_file)), arguments, bar)


def bake_job(arguments, scenes: tuple[Path, ...]) -> Job:
    """The job that the arguments describe. Raises Misuse."""
    cameras = arguments_module.cameras(arguments)
    if arguments.apply and (len(cameras) > 1 or len(arguments.frames) > 1):
        raise Misuse("--apply makes materials show one texture: give one frame and one camera with it")
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


MERGE = "Write report.json and timing.json of all that the shards of a job have done in OUT."
MERGE_EXAMPLES = """examples:
  %(prog)s out/room
  %(prog)s out/room --json > room.json
  %(prog)s night.toml

What is missing is named, and the exit code is 1; the command with --resume and the same --shard does it.
"""


def add_merge(parser) -> None:
    """Add the arguments and the function that runs."""
    with_examples(parser, MERGE, MERGE_EXAMPLES)
    parser.add_argument("output", type=Path, metavar="OUT", help="the folder that -o named, or JOB.toml of `run`")
    add_baseline(parser)
    add_talk(parser)
    parser.set_defaults(run=_merge)


def _merge(arguments, bar, open_file) -> int:
    if arguments.output.suffix == ".toml" and not arguments.output.is_dir():
        if arguments.baseline is not None:
            raise Misuse("--baseline belongs into the job file, to the job that it is for")
        return merge_jobs(arguments.output, arguments, bar)
    return merge_folder(arguments, bar)


RUN = "Do the jobs of a file, each a shade, compare or bake, one after another."
RUN_EXAMPLES = """examples:
  %(prog)s night.toml
  %(prog)s night.toml --shard 1/4 --resume --log night.log

night.toml:
  [defaults]                       # for all jobs whose command has that option
  techniques = ["ltc", "ltsh4"]

  [[job]]
  command = "compare"              # or "bake" or "shade"
  scene = "room.blend"             # or scenes = [...]; paths are relative to the job file
  output = "out/room"              # a folder for each job
  frames = "1-240:10"              # options are named as on the command line, without the dashes
  camera = ["Left", "Right"]

  [[job]]
  command = "bake"
  scene = "room.blend"
  output = "out/textures"
  object = ["Floor", "Wall"]
  size = 2048
  error = true

All mistakes in the file are named with their lines, before anything starts. A job that fails is named, and the others
are done all the same.
"""


def add_run(parser) -> None:
    """Add the arguments and the function that runs."""
    with_examples(parser, RUN, RUN_EXAMPLES)
    parser.add_argument("file", type=Path, metavar="JOB.toml", help="the jobs")
    add_batch(parser)
    add_talk(parser)
    parser.set_defaults(run=_run_jobs)


def commands() -> dict[str, Command]:
    """The commands that a job file may have."""
    found = {}
    for name, add_arguments, job_of in (
        ("shade", add_shade, picture_job),
        ("compare", add_compare, picture_job),
        ("bake", add_bake, bake_job),
    ):
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        add_arguments(parser)
        parser.set_defaults(command=name)
        found[name] = Command(parser, job_of)
    return found


def merge_jobs(path: Path, arguments, bar) -> int:
    """`ltsh merge` of every job of a file; 0, or 1 where something is missing or wrong."""
    return _each(
        read_jobs(path, commands()),
        lambda wanted, settings, baseline: finish(
            merge(wanted.job.options.output, bar), wanted.job.options.output, settings, bar, baseline
        ),
        arguments,
        bar,
    )


def _run_jobs(arguments, bar, open_file) -> int:
    return _each(
        read_jobs(arguments.file, commands()),
        lambda wanted, settings, baseline: do_job(wanted.job, settings, bar, baseline),
        arguments,
        bar,
    )


def _each(jobs: list[Wanted], do, arguments, bar) -> int:
    """Do something with every job; the world's faults in one do not keep the others from being done."""
    baselines = [_baseline(wanted) for wanted in jobs]
    documents, worst = [], 0
    for number, (wanted, baseline) in enumerate(zip(jobs, baselines, strict=True), 1):
        settings = argparse.Namespace(**{**vars(arguments), "tolerance": getattr(wanted.arguments, "tolerance", None)})
        output = wanted.job.options.output
        label = f"job {number} of {len(jobs)} ({wanted.job.command}, {output})"
        bar.begin_job(label)
        try:
            document, code = do(wanted, settings, baseline)
        except (SceneError, TableError, OSError, ValueError, ImportError, MemoryError) as error:
            text = error_line(error)
            bar.note(f"failed: {label}: {text}")
            document, code = {"error": text}, 1
        documents.append({"command": wanted.job.command, "output": str(output), **document})
        worst = max(worst, code)
    if arguments.json:
        print_json({"jobs": documents})
    return worst


def _baseline(wanted) -> Baseline | None:
    path = getattr(wanted.arguments, "baseline", None)
    return None if path is None else Baseline.read(path)


TABLES = "Fit, measure and export the lookup tables. All but export need the source checkout and scipy."
TABLES_EXAMPLES = """examples:
  %(prog)s export -o out/tables
  %(prog)s validate ltsh4 --json
  %(prog)s fit ltsh6 -o out/tables
"""
EXPORT = "Write each table as an EXR and as a header for C, C++ and GLSL; see tables/EXPORT.md."
EXPORT_EXAMPLES = """examples:
  %(prog)s -o out/tables
  %(prog)s ltsh4 my_table.npz -o out/tables --json
"""
SCRIPTS = {
    "fit": "fit tables to a BRDF, which takes hours",
    "validate": "errors of tables between their nodes",
    "optimum": "how good any table of a family could be",
    "plot": "the figures of tables/README.md",
}


def add_tables(parser) -> None:
    """Add the arguments and the functions that run."""
    with_examples(parser, TABLES, TABLES_EXAMPLES)
    actions = parser.add_subparsers(dest="action", required=True)
    for action, meaning in SCRIPTS.items():
        # The script parses its own options: nothing starts with this prefix, so that all of them are taken as they are.
        script = actions.add_parser(action, help=meaning, add_help=False, prefix_chars="\0")
        script.add_argument("arguments", nargs="*")
        script.set_defaults(run=_run_table_script, quiet=False, log=None)
    export = actions.add_parser("export", help="for other engines: an EXR, a header for C, C++ and GLSL")
    with_examples(export, EXPORT, EXPORT_EXAMPLES)
    export.add_argument("names", nargs="*", type=table, metavar="TABLE",
                        help="or a path (.npz); default: all shipped")  # fmt: skip
    export.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="folder for the files")
    add_talk(export, "name the files on stdout in one JSON document")
    export.set_defaults(run=_export_tables)


def _run_table_script(arguments, bar, open_file) -> int:
    root = Path(__file__).resolve().parents[2]
    if not (root / "tables" / "fit.py").is_file():
        needed = "the source checkout with tables/fit.py"
        raise Misuse(f"tables {arguments.action} needs {needed}, which is not here")
    for library in ("scipy", *(["matplotlib"] if arguments.action == "plot" else [])):
        if importlib.util.find_spec(library) is None:
            fix = f"install it with `pip install {library}`"
            raise Misuse(f"tables {arguments.action} needs {library}, which is not here; {fix}")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "tables", arguments.action, *arguments.arguments]
    return subprocess.run(command, env=environment, check=False).returncode


def _export_tables(arguments, bar, open_file) -> int:
    from ..pipeline.export import export_prefixes, export_tables

    try:
        prefixes = export_prefixes(arguments.names or SHIPPED_TABLES)
    except ValueError as error:
        raise Misuse(str(error)) from error
    files = export_tables(prefixes, arguments.output, bar)
    bar.finish()
    paths = {name: [str(path) for path in written] for name, written in files.items()}
    if arguments.json:
        print_json({"tables": paths})
    else:
        say("\n".join(path for written in paths.values() for path in written), sys.stdout)
    return 0
