"""The commands. `add_<command>` declares the arguments of a command and the function that runs it.

That function takes the arguments, the progress bar and the file that Blender has open, and returns the exit code.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from ..files import write_bytes
from ..imaging import on_screen
from ..pipeline.batch import RESUME, Merged, merge, run_tasks
from ..pipeline.lighting import prepare
from ..pipeline.options import (
    BakeOptions,
    CompareOptions,
    DemoOptions,
    MatchOptions,
    PictureOptions,
    RenderOptions,
    ViewOptions,
    options_from,
    real_number,
)
from ..pipeline.picture import Baseline
from ..pipeline.tasks import BatchJob
from ..scene import SceneError, error_line, listed
from ..shading import TableError
from .arguments import (
    FileJob,
    Misuse,
    add_baseline,
    add_batch,
    add_option,
    add_options,
    add_talk,
    from_text,
    read_jobs,
    scenes_of,
    with_examples,
)
from .progress import print_json, print_out

DEMO_SCENE = Path(__file__).parents[1] / "blender" / "demo.blend"  # docs/demo_scene.py made it
DEMO_RESOLUTION = (480, 270)
UNSHADOWED = "unshadowed"
DEMO = """Write the example scene, OUT/demo.blend, and do with it what compare does; then the
same without shadows, in OUT/unshadowed, which compares the lobes alone."""
COMPARE = """Shade what the camera sees with several techniques, render the same direct light
with Cycles, and measure how far apart they are. OUT gets compare.exr (all layers
in float), compare.png (side by side, signed errors below), report.html and
report.json."""
SHADE = """Shade what the camera sees. OUT gets shade.exr, with a layer for each technique and
pass, shade.png, which also shows what glows and the world behind, and report.json."""
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
  %(prog)s room.blend -o out/room --resolution 960x540 --aa 16
  %(prog)s room.blend -o out/room --frames 1-240 --resume
"""
BAKE = """Shade the texels of UV maps. OUT gets an EXR for each object, with a layer for each
technique and pass, and report.json; UDIM tiles get files of their own."""
BAKE_EXAMPLES = """examples:
  %(prog)s room.blend -o out/room
  %(prog)s room.blend -o out/room --object Floor --object Wall --size 2048 --uv Lightmap --view above
  %(prog)s room.blend -o out/room --passes diffuse_light --size 512
  %(prog)s room.blend -o out/room --object Floor --techniques ltc,ltsh4c --error --cycles-samples 1024
  %(prog)s room.blend -o out/room --frames 1-240:2 --shard 1/4 --resume

An object that cannot be baked is named at the end, and the exit code is 1; the others are baked all the same.
"""
VIEW = """Draw what the camera sees as the viewport does, in a fraction of the time that shade
takes. Needs OpenGL or Vulkan, with a graphics card or without. OUT gets view.exr, with
a layer for each technique, combined and by pass, view.png, which shows the first
technique through the scene's view transform, and report.json."""
VIEW_EXAMPLES = """examples:
  %(prog)s room.blend -o out/draft --resolution 480x270 --refine 1
  %(prog)s room.blend -o out/playblast --frames 1-240 --resume
"""


RENDER = """Finish what the camera sees: direct light by LTSH, everything else by Cycles, which is
denoised. OUT gets render.exr (combined, both parts of the direct light, and Cycles'
passes), render.png, which shows it through the scene's view transform, and
report.json, which tells what came from where."""
RENDER_EXAMPLES = """examples:
  %(prog)s room.blend -o out/room --cycles-samples 64
  %(prog)s room.blend -o out/room --budget 30
  %(prog)s room.blend -o out/room --frames 1-240 --cycles-samples 64 --resume
"""


# JOBS: the options of the commands that make a job, their description and examples, and the options they leave out.
JOBS = {
    "demo": (DemoOptions, DEMO, DEMO_EXAMPLES, ("scene",)),
    "compare": (CompareOptions, COMPARE, COMPARE_EXAMPLES, ()),
    "shade": (PictureOptions, SHADE, SHADE_EXAMPLES, ("cycles_samples",)),
    "bake": (BakeOptions, BAKE, BAKE_EXAMPLES, ()),
    "view": (ViewOptions, VIEW, VIEW_EXAMPLES, ()),
    "render": (RenderOptions, RENDER, RENDER_EXAMPLES, ()),
}


def add_job(parser, command: str, **changes) -> None:
    """`ltsh demo`, `compare`, `shade`, `bake`, `view` and `render`; `changes` are keywords of arguments by option."""
    kind, description, examples, left_out = JOBS[command]
    with_examples(parser, description, examples)
    add_options(parser, kind, but=(*left_out, "scripts"), **changes)
    add_batch(parser)
    add_option(parser, kind, "scripts")
    add_talk(parser)
    parser.set_defaults(run=_run_scenes)
    if command == "compare":
        add_baseline(parser)
    elif command == "shade":
        parser.set_defaults(cycles_samples=0)


def add_demo(parser) -> None:
    """`ltsh demo`."""
    size = {"help": "default: {}x{}".format(*DEMO_RESOLUTION), "default": DEMO_RESOLUTION}
    add_job(parser, "demo", resolution=size)
    parser.set_defaults(run=_demo, scenes=[])


def _run_scenes(arguments, bar, open_file) -> int:
    if getattr(arguments, "baseline", None) and arguments.shard and arguments.shard[1] > 1:
        raise Misuse("--baseline is for the whole job, not for a shard of it: give it to `merge`")
    job = job_of(arguments, scenes_of(arguments, open_file))
    return _printed(arguments, *do_job(job, arguments, bar, baseline_of(arguments)))


def _demo(arguments, bar, open_file) -> int:
    job = job_of(arguments, (arguments.output / "demo.blend",))
    prepare(job.options)
    write_bytes(job.scenes[0], DEMO_SCENE.read_bytes())
    document, code = do_job(job, arguments, bar)
    if job.options.shadows == "on":
        alone = replace(job.options, shadows="off", output=arguments.output / UNSHADOWED)
        if not arguments.json:
            print_out("\nwithout shadows, which compares the lobes alone:")
        document[UNSHADOWED], other = do_job(replace(job, options=alone), arguments, bar)
        code = max(code, other)
    return _printed(arguments, document, code)


def job_of(arguments, scenes: tuple[Path, ...]) -> BatchJob:
    """The job of the arguments of demo, compare, shade, bake, view or render. Raises Misuse."""
    kind, *_ = JOBS[arguments.command]
    command = "compare" if arguments.command == "demo" else arguments.command
    cameras, frames = tuple(dict.fromkeys(arguments.cameras or ())), arguments.frames or ()
    if command == "bake" and (arguments.apply or arguments.export) and (len(cameras) > 1 or len(frames) > 1):
        raise Misuse("--apply and --export show one texture of an object: give one frame and one camera with them")
    if command == "bake":
        side, size = arguments.atlas, arguments.size
        if (side is None or arguments.uv) and (arguments.texels_per_metre or arguments.unwrap != "smart"):
            raise Misuse("--texels-per-metre and --unwrap are for the UV map of --atlas N: give it, without --uv")
        if side is not None and size not in (BakeOptions.size, (side, side)):
            raise Misuse("--atlas N is the size of the texture that all objects share: leave out --size")
    if command == "render" and arguments.budget is not None and arguments.cycles_samples is not None:
        raise Misuse("--budget chooses the samples of Cycles: give it or --cycles-samples, not both")
    options = options_from(kind, vars(arguments), scene=scenes[0])
    return BatchJob(command, options, scenes, cameras, frames, arguments.pattern)


def _printed(arguments, document: dict, code: int) -> int:
    """Print the document if --json is given; returns `code`."""
    if arguments.json:
        print_json(document)
    return code


MERGE = "Write report.json and timing.json of all that the shards of a job have done in OUT."
MERGE_EXAMPLES = """examples:
  %(prog)s out/room
  %(prog)s out/room --json > room.json
  %(prog)s night.toml

What is missing is named, and the exit code is 1; the command with --resume and the same --shard does it.
"""


def add_merge(parser) -> None:
    """`ltsh merge`."""
    with_examples(parser, MERGE, MERGE_EXAMPLES)
    parser.add_argument("output", type=Path, metavar="OUT", help="the folder that -o named, or JOB.toml of `run`")
    add_baseline(parser)
    add_talk(parser)
    parser.set_defaults(run=_merge)


def _merge(arguments, bar, open_file) -> int:
    if arguments.output.suffix != ".toml" or arguments.output.is_dir():
        return _printed(arguments, *merge_job(arguments.output, arguments, bar, baseline_of(arguments)))
    if arguments.baseline is not None:
        raise Misuse("--baseline belongs into the job file, to the job that it is for")

    def merge(job, settings, bar, baseline):
        return merge_job(job.options.output, settings, bar, baseline)

    return _for_each(read_jobs(arguments.output, job_parsers(), job_of), merge, arguments, bar)


RELIGHT = """Write pictures anew with other powers and colors of their lights, without Blender and
without a ray. OUT is what shade, compare or render wrote with --keep-visibility.
Lights have the names that report.json tells."""
RELIGHT_EXAMPLES = """examples:
  %(prog)s out/room --light Key --power x2 --color 1,.8,.6
  %(prog)s out/room --light Fill --exposure -1.5 --mute Rim --mute Lamp
  %(prog)s out/room --solo Key -o out/key_alone

--power, --exposure and --color are for the --light before them. A color stands in place of the light's
own, whose brightest channel counts as 1; each step of exposure doubles the power.
"""


def add_relight(parser) -> None:
    """`ltsh relight`."""
    with_examples(parser, RELIGHT, RELIGHT_EXAMPLES)
    parser.add_argument("folder", type=Path, metavar="OUT", help="the folder that -o of shade, compare or render named")
    parser.add_argument(
        "-o", dest="output", type=Path, metavar="OUT2", help="folder for the results; default: OUT/relit"
    )
    parser.add_argument("--light", dest="changes", action="append", type=lambda name: {"name": name}, default=[],
                        metavar="NAME", help="the light to change; may be given several times")  # fmt: skip
    parser.add_argument("--power", action=_OfLight, type=from_text(_factor), metavar="xF", help="such as x2 or x.5")
    parser.add_argument("--exposure", action=_OfLight, type=from_text(_steps), metavar="E", help="such as +1 or -.5")
    parser.add_argument("--color", action=_OfLight, type=from_text(_color), metavar="R,G,B", help="such as 1,.8,.6")
    for flag, what in (("--mute", "this light is dark"), ("--solo", "all lights but this one are dark")):
        parser.add_argument(flag, action="append", default=[], metavar="NAME",
                            help=f"{what}; may be given several times")  # fmt: skip
    add_talk(parser)
    parser.set_defaults(run=_relight)


class _OfLight(argparse.Action):
    """Stores a value for the light that was named last."""

    def __call__(self, parser, namespace, value, option_string=None):
        if not namespace.changes:
            parser.error(f"{option_string}: expected --light NAME before it")
        if self.dest in namespace.changes[-1]:
            parser.error(f"{option_string}: given twice for light {namespace.changes[-1]['name']!r}")
        namespace.changes[-1][self.dest] = value


def _factor(text: str) -> float:
    """x and a number."""
    value = real_number(text.removeprefix("x"))
    if not text.startswith("x") or not 0.0 <= value < 1e12:
        raise ValueError(f"power is {text!r}, expected x and a factor, such as x2 or x.5")
    return value


def _steps(text: str) -> float:
    """A number of doublings."""
    value = real_number(text)
    if not abs(value) <= 32.0:
        raise ValueError(f"exposure is {text!r}, expected a number from -32 to 32, such as +1 or -.5")
    return value


def _color(text: str) -> tuple[float, ...]:
    """Three numbers."""
    values = tuple(map(real_number, text.split(",")))
    if len(values) != 3 or not all(0.0 <= value < 1e12 for value in values):
        raise ValueError(f"color is {text!r}, expected red, green and blue such as 1,.8,.6")
    return values


def _relight(arguments, bar, open_file) -> int:
    from ..pipeline.relight import LightChange, relight

    if not (arguments.changes or arguments.mute or arguments.solo):
        raise Misuse("nothing to change: expected --light NAME with --power, --exposure or --color, --mute or --solo")
    output = arguments.output or arguments.folder / "relit"
    changes = [LightChange(**change) for change in arguments.changes]
    changes += [LightChange(name, muted=True) for name in arguments.mute]
    report = relight(arguments.folder, changes, output, bar, solo=arguments.solo)
    bar.finish()
    if not arguments.json:
        print_out("\n".join(str(output / name) for one in report.get("reports", [report]) for name in one["files"]))
    return _printed(arguments, report, 0)


MATCH = """Find powers of lights for which the scene looks like a picture of the same camera, with --colors
their colors too, with --move their places and directions; --add makes new lights. OUT gets
matched.blend, a copy of the scene with these lights, match.png (before, after, target) and report.json
with each light's old and new values."""
MATCH_EXAMPLES = """examples:
  %(prog)s room.blend --target graded.exr -o out/match
  %(prog)s room.blend --target painted.png --mask window.png --light Key --light Fill --colors -o out/match
  %(prog)s room.blend --target photo.exr --light Key --move -o out/match

A picture of 8 or 16 bits goes back through the view transform of the scene; pixels that are clipped do
not count. Bounces follow their lights.

--move is surest from within a tenth of the distance between a light and what it lights. The report says
by how much the picture is still off the target. Lights with constraints, locks, keyframes, drivers,
textures or shared data keep their places.
"""


def add_match(parser) -> None:
    """`ltsh match`."""
    with_examples(parser, MATCH, MATCH_EXAMPLES)
    add_options(parser, MatchOptions, but=("name",))
    add_talk(parser)
    parser.set_defaults(run=_match)


def _match(arguments, bar, open_file) -> int:
    from ..pipeline.match import match_scene, summary

    (scene, *more) = scenes_of(arguments, open_file)
    if more:
        raise Misuse(f"{more[0]}: expected one SCENE.blend, because one picture shows one scene")
    if arguments.sizes and not (arguments.move or arguments.add):
        raise Misuse("--sizes: expected --move or --add with it; lights that keep their places keep their sizes")
    report = match_scene(options_from(MatchOptions, vars(arguments), scene=scene), bar)
    bar.finish()
    _complain(bar, "warning", on_screen(report["warnings"], f"{arguments.output}/report.json"))
    if not arguments.json:
        print_out("\n".join(summary(report)))
    return _printed(arguments, report, 0)


RUN = "Do the jobs of a file, each a shade, compare, bake, view or render, one after another."
RUN_EXAMPLES = """examples:
  %(prog)s night.toml
  %(prog)s night.toml --shard 1/4 --resume --log night.log

night.toml:
  [defaults]                       # for all jobs whose command has that option
  techniques = ["ltc", "ltsh4c"]

  [[job]]
  command = "compare"              # or "bake", "shade", "view" or "render"
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

All mistakes in the file are named, before anything starts. A job that fails is named, and the others
are done all the same.
"""


def add_run(parser) -> None:
    """`ltsh run`."""
    with_examples(parser, RUN, RUN_EXAMPLES)
    parser.add_argument("file", type=Path, metavar="JOB.toml", help="the jobs")
    add_batch(parser)
    add_option(parser, PictureOptions, "scripts")
    add_talk(parser)
    parser.set_defaults(run=_run_jobs)


def _run_jobs(arguments, bar, open_file) -> int:
    def job_with_scripts(of_job, scenes):
        return job_of(argparse.Namespace(**{**vars(of_job), "scripts": arguments.scripts}), scenes)

    return _for_each(read_jobs(arguments.file, job_parsers(), job_with_scripts), do_job, arguments, bar)


def job_parsers() -> dict[str, argparse.ArgumentParser]:
    """Parsers of the commands that a job file may have."""
    parsers = {}
    for name in ("shade", "compare", "bake", "view", "render"):
        parsers[name] = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        add_job(parsers[name], name)
        parsers[name].set_defaults(command=name)
    return parsers


def _for_each(jobs: list[FileJob], do, arguments, bar) -> int:
    """Call do(job, settings, bar, baseline) for every job; the others go on if one fails; returns the worst exit
    code."""
    baselines = [baseline_of(wanted.arguments) for wanted in jobs]
    documents, worst = [], 0
    for number, (wanted, baseline) in enumerate(zip(jobs, baselines, strict=True), 1):
        settings = argparse.Namespace(**{**vars(arguments), "tolerance": getattr(wanted.arguments, "tolerance", None)})
        output = wanted.job.options.output
        label = f"job {number} of {len(jobs)} ({wanted.job.command}, {output})"
        bar.begin_job(label)
        try:
            document, code = do(wanted.job, settings, bar, baseline)
        except (SceneError, TableError, OSError, ValueError, ImportError, MemoryError) as error:
            bar.note(f"failed: {label}: {error_line(error)}")
            document, code = {"error": error_line(error)}, 1
        documents.append({"command": wanted.job.command, "output": str(output), **document})
        worst = max(worst, code)
    return _printed(arguments, {"jobs": documents}, worst)


def do_job(job: BatchJob, arguments, bar, baseline: Baseline | None = None) -> tuple[dict, int]:
    """Do the job, or its shard. Returns the document for --json and the exit code, 1 if something is wrong."""
    shard = arguments.shard or (1, 1)

    def tell(state):
        bar.watch(state)
        if state.number and state.seconds is None:
            bar.begin_task(state.number, state.tasks)
        elif state.number:
            bar.end_task(state.name, state.seconds, state.problem is not None)

    done = run_tasks(job, shard=shard, existing=arguments.existing, progress=bar, tell=tell)
    if shard[1] == 1:
        if done.kept and job.command == "bake" and arguments.existing == RESUME:
            bar.remark(f"unchanged, not baked again: {listed(done.kept)}; without --resume all are")
        elif done.kept:
            bar.remark(f"{done.finished_before} of {done.tasks} tasks were there already")
        return merge_job(job.options.output, arguments, bar, baseline)
    bar.finish()
    text = f"{shard[0]}/{shard[1]}"
    before = f" ({done.finished_before} were there already)" if done.finished_before else ""
    tasks = "1 task" if done.tasks == 1 else f"{done.tasks} tasks"
    _complain(bar, "problem", done.problems)
    _print(f"shard {text}: {tasks} done{before}; when all are: merge {job.options.output}", arguments, bar)
    facts = {"tasks": done.tasks, "done": done.done, "kept": done.finished_before, "problems": done.problems}
    return {"shard": text, **facts}, 1 if done.problems else 0


def merge_job(output: Path, arguments, bar, baseline: Baseline | None = None) -> tuple[dict, int]:
    """Assemble and print the results of a whole job. Returns the document for --json and the exit code, as `do_job`."""
    merged = merge(output, bar)
    bar.finish()
    _complain(bar, "not baked" if merged.command == "bake" else "failed", merged.problems)
    if not arguments.json:
        reports = [merged.report] if merged.single else merged.report["reports"]
        lines = (line for report in reports for line in report.get("warnings", ()))
        _complain(bar, "warning", on_screen(lines, f"{output}/report.json"))
    _print(_summary(merged, output), arguments, bar)
    _complain(bar, "missing", merged.missing)
    worse = []
    if baseline is not None:
        if merged.command != "compare":
            raise ValueError(f"{output}: holds what {merged.command} has made, expected comparisons beside a baseline")
        worse = baseline.worse(merged.report, arguments.tolerance)
        _complain(bar, "worse", worse)
    document = merged.report if baseline is None else {**merged.report, "worse": worse}
    return document, 1 if merged.missing or merged.problems or worse else 0


def baseline_of(arguments) -> Baseline | None:
    """The baseline of --baseline, or None. Call it before anything is done, since it may raise."""
    path = getattr(arguments, "baseline", None)
    return None if path is None else Baseline.read(path)


def _print(text, arguments, bar) -> None:
    bar.log.line(text.splitlines()[-1])
    if not arguments.json:
        print_out(text)


def _complain(bar, what: str, lines) -> None:
    for line in dict.fromkeys(lines):
        bar.note(f"{what}: {line}")


def _summary(merged: Merged, output) -> str:
    from ..pipeline import bake_files, picture, render

    summary, brief = {
        "bake": (bake_files.summary, bake_files.brief),
        "view": (picture.view_summary, render.brief),
        "render": (render.summary, render.brief),
    }.get(merged.command, (picture.summary, picture.brief))
    if merged.single and "reports" not in merged.report:
        lines = summary(merged.report, merged.seconds)
    else:
        lines = [line for report in merged.report["reports"] for line in brief(report)]
    return "\n".join([*(line.rstrip() for line in lines), f"written to {output}"])
