"""`ltsh demo`, `ltsh compare` and `ltsh shade`: their arguments, and the jobs that they describe."""

from __future__ import annotations

from pathlib import Path

from ..comparison.compare import DEFAULT_TECHNIQUES, Options, prepare
from ..jobs.tasks import Job
from ..shading import PASSES
from . import argument_values as values
from . import common_options as options
from .job_runs import run_job

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
    options.with_examples(parser, DEMO, DEMO_EXAMPLES)
    options.add_moments(parser, values.name_of_picture)
    _add_picture(parser, cycles=True, resolution="{}x{}".format(*DEMO_RESOLUTION))
    parser.set_defaults(run=_demo, scenes=[])


def add_compare(parser) -> None:
    """Add the arguments and the function that runs."""
    options.with_examples(parser, COMPARE, COMPARE_EXAMPLES)
    options.add_scenes(parser)
    _add_picture(parser, cycles=True)
    options.add_baseline(parser)
    parser.set_defaults(run=_run)


def add_shade(parser) -> None:
    """Add the arguments and the function that runs."""
    options.with_examples(parser, SHADE, SHADE_EXAMPLES)
    options.add_scenes(parser)
    _add_picture(parser, cycles=False)
    parser.set_defaults(run=_run)


def _add_picture(parser, *, cycles, resolution="as in the file"):
    options.add_output(parser)
    names = ",".join(DEFAULT_TECHNIQUES)
    parser.add_argument("--techniques", type=values.techniques, default=DEFAULT_TECHNIQUES, metavar="T",
                        help=f"{values.TECHNIQUES_HELP} (default: {names})")  # fmt: skip
    parser.add_argument("--passes", type=values.passes, default=PASSES, metavar="P",
                        help=f"some of {','.join(PASSES)} (default: both)")  # fmt: skip
    parser.add_argument("--resolution", type=values.resolution, metavar="WxH", help=f"default: {resolution}")
    parser.add_argument("--aa", type=values.positive, default=1, metavar="N",
                        help="points per pixel, drawn from its filter; 1: pixel centers")  # fmt: skip
    parser.add_argument(
        "--reference-samples", type=values.positive, default=Options.reference_samples, metavar="N",
        help="'reference' takes a random subset of this size where there are more samples (default: %(default)s)",
    )  # fmt: skip
    if cycles:
        parser.add_argument(
            "--cycles-samples", type=values.cycles_samples, default=Options.cycles_samples, metavar="N",
            help="of both halves of the Cycles reference together (default: %(default)s)",
        )  # fmt: skip
    options.add_batch(parser)
    options.add_trust(parser)
    options.add_memory(parser, "picture")
    options.add_talk(parser)


def job_of(arguments, scenes: tuple[Path, ...], resolution=None) -> Job:
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
    return Job(command, wanted, scenes, options.cameras(arguments), arguments.frames, arguments.name)


def _run(arguments, bar, open_file) -> int:
    if getattr(arguments, "baseline", None) and arguments.shard and arguments.shard[1] > 1:
        raise values.Misuse("--baseline is for the whole job, not for a shard of it: give it to `merge`")
    return run_job(job_of(arguments, values.scenes(arguments, open_file)), arguments, bar)


def _demo(arguments, bar, open_file) -> int:
    from ..blender.processes import child

    job = job_of(arguments, (arguments.output / "demo.blend",), DEMO_RESOLUTION)
    prepare(job.options)
    child.build_demo(job.scenes[0], progress=bar)
    return run_job(job, arguments, bar)
