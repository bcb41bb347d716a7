"""A job in a second Blender: its arguments, its process, and the plan that estimates the time left."""

import json
import math
import shutil
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue

import bpy
import numpy as np
from bpy.app.translations import pgettext_iface as translated

from ...imaging.exr import write_channels
from ...pipeline.match import PIXELS, ROUNDS
from ...pipeline.options import BakeOptions, CompareOptions, MatchOptions, PictureOptions, command_line
from ...scene import ATLAS, DEFAULT_TECHNIQUE, REFERENCE, TECHNIQUES
from ..extract.match import is_telling, light_of_image
from ..process import blender_process
from . import preflight
from .settings import preferences

STARTING = "Starting"
# The time left is shown after SURE_SECONDS if it is sure, else after ROUGH_SECONDS.
SURE_SECONDS, ROUGH_SECONDS = 3.0, 10.0
# KNOWN_SHARE: the time left is sure if at least this share of it rests on measurements. Then it is right within a
# factor of two, even if the guess for the rest is three times too short.
KNOWN_SHARE = 0.5
SCRIPT = Path(__file__).resolve().parents[2] / "panel_job.py"
ENDING_SECONDS = 10.0
NO_CYCLES = "Not complete: without Cycles"
# Titles of the command line's stages; others are shown by their names.
STAGE_TITLES = {
    "open scene": "Open Scene",
    "samples": "Sample Surfaces",
    "horizons": "Horizons of Bumps",
    "Cycles A": "Cycles, First Half",
    "Cycles B": "Cycles, Second Half",
    "shadows": "Trace Shadows",
    "denoise": "Denoise",
    "target": "Read the Target",
    "search": "Place Lights",
    **{technique.title: technique.label for technique in TECHNIQUES.values()},
    "write": "Write Files",
    "images": "Make Pictures",
    "lights": "Light Mixer",
}
# Estimated costs enter paces with the weight of so many measured seconds: PRIOR_SECONDS for all stages together,
# LITTLE_SECONDS for each kind.
PRIOR_SECONDS, LITTLE_SECONDS = 5.0, 1.0
# A stage's progress tells its length only from LEAST_FRACTION and LEAST_SECONDS on.
LEAST_FRACTION, LEAST_SECONDS = 0.02, 1.0
OBJECT_STAGES = "bake", "bounces", "denoise", "shade"  # of a bake, followed by the object's name
MOST = 0.99  # the largest share that is shown before the end is reported
# Costs in seconds on two cores: once, or per million points, or per million points times samples. Plans learn the pace
# of the machine.
START_SECONDS, OPEN_SECONDS, RENDER_SECONDS = 1.5, 2.0, 0.5
SAMPLE_SECONDS, FILE_SECONDS, HORIZON_SECONDS = 16.0, 3.0, 5.0
CYCLES_SECONDS = 3.0  # per sample of Cycles, of direct light or of all
SHADING_SECONDS = {"ltc": 6.5, "ltsh2": 8.0, "ltsh4": 10.0, "ltsh4c": 11.5, REFERENCE: 160.0}
SHADOW_SECONDS, DENOISE_SECONDS = 30.0, 4.0  # shadows: with USUAL_RAYS rays
USUAL_RAYS = 256
DIFFUSE_SHARE, DIFFUSE_SHADOWS = 0.1, 0.6  # of shading and of shadows, without the specular lobe
EDGE_POINTS = 1.2  # a texel, with bounces, for the edges of shadows: 16 with few rays for an eighth of the texels
REFERENCE_POINTS = 0.15
SEARCH_SECONDS = 8.0  # of a round in which lights are placed
# The files of `write_target`.
TARGET, MASK = "ltsh-target.exr", "ltsh-mask.exr"


@dataclass(frozen=True)
class Run:
    """One command of a job."""

    command: str
    options: PictureOptions | BakeOptions | MatchOptions
    partial: str = ""  # what its pictures lack, if a later command of the job adds it
    resumes: bool = False  # do only what has changed

    def to_dict(self) -> dict:
        """The dictionary that `panel_job.perform` takes."""
        arguments = [self.command, *command_line(self.options), *(["--resume"] if self.resumes else [])]
        return {"arguments": arguments, "output": str(self.options.output), "partial": self.partial}


def runs_of(context, command: str, scene_file: Path) -> list[Run]:
    """The commands of a job."""
    if command == "bake":
        return [Run(command, bake_options(context, scene_file), resumes=context.scene.ltsh.bake_changed)]
    if command == "match":
        return [Run(command, match_options(context.scene, scene_file))]
    wanted = picture_options(context.scene, command, scene_file)
    first = tuple(name for name in wanted.techniques if name != REFERENCE)
    if command == "shade" or not first:
        return [Run(command, wanted)]
    # The techniques are ready long before Cycles. A first run shows them, and they stay if the second is stopped.
    early = replace(picture_options(context.scene, "shade", scene_file), techniques=first, keep_visibility=False)
    return [Run("shade", early, NO_CYCLES), Run(command, wanted)]


def picture_options(scene, command: str, scene_file: Path) -> PictureOptions:
    """The options of "shade" or "compare" by the settings of `scene`."""
    settings = scene.ltsh
    samples = {"cycles_samples": settings.cycles_samples} if command == "compare" else {}
    kind = CompareOptions if command == "compare" else PictureOptions
    return kind(
        scene=scene_file,
        output=output_folder(scene, command),
        techniques=chosen(settings, "techniques") if command == "compare" else (scene.ltsh_view.technique,),
        resolution=preflight.picture_of(scene),
        sub_samples=settings.anti_aliasing,
        shadows="on" if settings.shadows else "off",
        shadow_rays=settings.shadow_rays,
        keep_visibility=settings.keep_lights,
        **samples,
    )


def bake_options(context, scene_file: Path) -> BakeOptions:
    """The options of "bake" by the settings of the scene, for the selected objects that can be baked."""
    settings = context.scene.ltsh
    side = int(settings.bake_size)
    return BakeOptions(
        scene=scene_file,
        output=output_folder(context.scene, "bake"),
        objects=tuple(ob.name for ob in preflight.bake_objects(context)[0]),
        uv=ATLAS if settings.bake_atlas else settings.bake_uv_map or None,
        atlas=side if settings.bake_atlas else None,
        size=(side, side),
        sub_samples=settings.anti_aliasing,
        margin=settings.bake_margin,
        view=settings.bake_view,
        techniques=(context.scene.ltsh_view.technique,),
        passes=chosen(settings, "bake_passes"),
        error=settings.bake_error,
        cycles_samples=settings.cycles_samples,
        shadows="on" if settings.shadows or settings.bake_bounces else "off",
        shadow_rays=settings.shadow_rays,
        bounces="on" if settings.bake_bounces else "off",
        rest_samples=settings.bake_rest_samples,
        per_light=settings.bake_per_light,
    )


def match_options(scene, scene_file: Path) -> MatchOptions:
    """The options of "match" by the settings of `scene`, with the files of `write_target` beside `scene_file`."""
    return MatchOptions(
        scene=scene_file,
        output=output_folder(scene, "match"),
        target=scene_file.with_name(TARGET),
        mask=scene_file.with_name(MASK),
        colors=scene.ltsh.match_colors,
        move=True,
        shadow_rays=scene.ltsh.shadow_rays,
    )


def write_target(scene, folder: Path) -> None:
    """Write the light of the target of `scene`, and the mask of what of it is not clipped. Raises SceneError."""
    light, encoded = light_of_image(scene.ltsh.match_target, scene, None, folder)
    is_known = is_telling(light, encoded)
    planes = np.moveaxis(np.where(is_known[..., None], light, 0.0).astype(np.float32), -1, 0)
    write_channels(folder / TARGET, dict(zip("RGB", planes, strict=True)))
    write_channels(folder / MASK, dict.fromkeys("RGB", is_known.astype(np.float32)))


def chosen(settings, key: str) -> tuple[str, ...]:
    """The chosen members of a set property, in the order in which they are offered."""
    items = settings.bl_rna.properties[key].enum_items.keys()
    return tuple(name for name in items if name in getattr(settings, key))


def output_folder(scene, command: str) -> Path:
    """The folder for the results of `command`, below that of the settings.

    The folder of the preferences takes its place if it is empty, or relative to a .blend that is not saved.
    """
    folder = scene.ltsh.output_folder.strip()
    if folder and (bpy.data.filepath or not folder.startswith("//")):
        root = Path(bpy.path.abspath(folder))
    else:
        root = preferences(bpy.context).output_folder / (Path(bpy.data.filepath).stem or "untitled")
    if len(bpy.data.scenes) > 1:
        root /= bpy.path.clean_name(scene.name)
    return root / command


@dataclass(frozen=True)
class Step:
    """A stage of a job."""

    stage: str
    cost: float  # about seconds; only its proportion to the other costs matters


def steps(runs: list[Run]) -> list[Step]:
    """The stages of a job, in order."""
    stages = [Step(STARTING, START_SECONDS)]
    for run in runs:
        if run.command == "match":
            stages += _match(run.options)
        else:
            stages += _bake(run.options) if run.command == "bake" else _picture(run.options, run.command == "compare")
    return stages


def _picture(options: PictureOptions, with_cycles: bool) -> list[Step]:
    pixels = 1e-6 * math.prod(options.resolution)
    points, rendered = pixels * options.sub_samples, RENDER_SECONDS * options.sub_samples
    half = rendered + CYCLES_SECONDS * pixels * max(options.cycles_samples // 2, options.sub_samples)
    sampling, shading = shading_steps(points, options.sub_samples, _rays(options), options.techniques)
    return [
        *sampling,
        *(Step(f"Cycles {name}", half) for name in ("A", "B") if with_cycles),
        *shading,
        Step("write", FILE_SECONDS * pixels),
        Step("images", FILE_SECONDS * pixels),
        *([Step("lights", _shading(DEFAULT_TECHNIQUE, points))] if options.keep_visibility else []),
    ]


def shading_steps(points: float, sub_samples: int, shadow_rays: int, techniques) -> tuple[list[Step], list[Step]]:
    """The stages that sample `points` million points, and those that shade them; 0 rays: without shadows."""
    sampling = [
        Step("open scene", OPEN_SECONDS),
        Step("samples", RENDER_SECONDS * sub_samples + SAMPLE_SECONDS * points),
        Step("horizons", HORIZON_SECONDS * points),
    ]
    shading = [Step(TECHNIQUES[name].title, _shading(name, points)) for name in techniques]
    # Most rays go to points that see a part of a light; elsewhere a few suffice.
    shadows = SHADOW_SECONDS * points * math.sqrt(shadow_rays / USUAL_RAYS)
    return sampling, [*([Step("shadows", shadows)] if shadow_rays else []), *shading]


def finished_steps(pixels: float, cycles_samples: int) -> list[Step]:
    """The stages in which Cycles adds the rest to a picture of `pixels` million pixels."""
    return [
        Step("open scene", OPEN_SECONDS),
        Step("Cycles", RENDER_SECONDS + CYCLES_SECONDS * pixels * cycles_samples),
        Step("denoise", DENOISE_SECONDS * pixels),
    ]


def _match(options: MatchOptions) -> list[Step]:
    """A picture, and a search and another picture in each round."""
    pixels = 1e-6 * PIXELS
    sampling, shading = shading_steps(pixels, 1, options.shadow_rays, options.techniques)
    picture = [*sampling, *shading, *finished_steps(pixels, options.cycles_samples)]
    search = [Step("search", SEARCH_SECONDS), Step("write", OPEN_SECONDS), *picture]
    return [Step("target", OPEN_SECONDS), *picture, *(ROUNDS * search), Step("write", OPEN_SECONDS)]


def _rays(options) -> int:
    return options.shadow_rays if options.shadows == "on" else 0


def _bake(options: BakeOptions) -> list[Step]:
    texels, bounces = 1e-6 * math.prod(options.size), options.bounces == "on"
    samples = options.cycles_samples * len(options.passes) if options.error else options.sub_samples
    has_lobes = bool({"specular", "combined"} & set(options.passes))
    shading = (1.0 if has_lobes else DIFFUSE_SHARE) * sum(_shading(name, texels) for name in options.techniques)
    shadows = SHADOW_SECONDS * texels * math.sqrt(_rays(options) / USUAL_RAYS)
    shading += (1.0 if has_lobes else DIFFUSE_SHADOWS) * shadows
    points = options.sub_samples + (EDGE_POINTS if bounces else 0.0)
    stages = [Step("open scene", OPEN_SECONDS)]
    for name in (ATLAS,) if options.atlas else options.objects:
        stages.append(Step(f"bake {name}", RENDER_SECONDS + SAMPLE_SECONDS * texels * samples))
        if bounces:
            stages.append(Step(f"bounces {name}", RENDER_SECONDS + CYCLES_SECONDS * texels * options.rest_samples))
            stages.append(Step(f"denoise {name}", RENDER_SECONDS + DENOISE_SECONDS * texels))
        stages.append(Step(f"shade {name}", shading * points + FILE_SECONDS * texels))
    return [*stages, Step("images", FILE_SECONDS * texels * len(options.objects))]


def _shading(technique: str, points: float) -> float:
    return SHADING_SECONDS[technique] * (min(points, REFERENCE_POINTS) if technique == REFERENCE else points)


# Seconds and costs of the stages of jobs that have ended in this session, by kind of stage.
StageTimes = dict[str, tuple[float, float]]
session_times: StageTimes = {}


def _kind(stage: str) -> str:
    """The kind of a stage; stages of one kind have one pace: those of all objects of a bake, both halves of Cycles."""
    first = stage.partition(" ")[0]
    return first if first in (*OBJECT_STAGES, "Cycles") else stage


def paces(measured: StageTimes) -> dict[str, float]:
    """Seconds per cost by kind of stage, and by "" for all others."""
    # Short stages say little about long ones.
    by_kind = {kind: (seconds + LITTLE_SECONDS) / (cost + LITTLE_SECONDS) for kind, (seconds, cost) in measured.items()}
    seconds, cost = (sum(values) for values in zip(*measured.values(), strict=True)) if measured else (0.0, 0.0)
    return {**by_kind, "": (seconds + PRIOR_SECONDS) / (cost + PRIOR_SECONDS)}


def _with_step(times: StageTimes, step: Step, seconds: float) -> StageTimes:
    """`times` and those of a step that took `seconds`."""
    before = times.get(_kind(step.stage), (0.0, 0.0))
    return {**times, _kind(step.stage): (before[0] + seconds, before[1] + step.cost)}


class Plan:
    """Follows a job through its `steps` and estimates the time left, with the paces of the jobs `measured` before.

    The first step begins at once. Some steps may never be reported.
    """

    def __init__(
        self, steps: Sequence[Step], now: Callable[[], float] = time.monotonic, measured: StageTimes | None = None
    ):
        self._steps, self._now, self._paces = tuple(steps), now, paces(measured or {})
        self._at, self._share, self._fraction = 0, 0.0, 0.0
        self._measured: dict[str, float] = {}
        self._ended: StageTimes = {}
        self._started = self._stage_started = self._reported = now()

    @property
    def number(self) -> int:
        """Number of the step that runs, counted from 1."""
        return self._at + 1

    @property
    def count(self) -> int:
        """Number of all steps."""
        return len(self._steps)

    def report(self, stage: str, fraction: float) -> None:
        """Note that `stage` has done `fraction` of its work."""
        later = range(self._at, self.count)
        at = next((index for index in later if self._steps[index].stage == stage), self._at)
        self._reported = self._now()
        if at != self._at:
            self._end_step()
            self._at, self._stage_started = at, self._reported
        self._fraction = min(max(fraction, 0.0), 1.0) if self._steps[self._at].stage == stage else 0.0

    def expect(self, seconds: dict[str, float]) -> None:
        """Note the seconds that stages will take, as somebody has measured who knows what they do."""
        self._measured.update(seconds)

    def _end_step(self) -> None:
        step, seconds = self._steps[self._at], self._reported - self._stage_started
        self._measured[step.stage] = seconds
        self._ended = _with_step(self._ended, step, seconds)

    def end(self, measured: StageTimes) -> None:
        """Note that the job has succeeded, and add the times of its stages to `measured`."""
        self._reported = self._now()
        if self._at == self.count - 1:
            self._end_step()
        measured.update(self._ended)

    def share(self) -> float:
        """The share of the whole job that is done, in [0, `MOST`]; it never falls."""
        elapsed = self._now() - self._started
        whole = elapsed + self.seconds_left()
        self._share = max(self._share, min(elapsed / whole, MOST) if whole > 0.0 else 0.0)
        return self._share

    def seconds_left(self) -> float:
        """Estimated seconds until the end of the job."""
        return sum(self._known_and_guessed())

    @property
    def is_sure(self) -> bool:
        """True if enough of the time left rests on measurements."""
        known, guessed = self._known_and_guessed()
        return known >= KNOWN_SHARE * (known + guessed)

    def _known_and_guessed(self) -> tuple[float, float]:
        """Seconds left that rest on measurements, and those that are guessed by costs."""
        running, *later = self._steps[self._at :]
        done, since, times = self._reported - self._stage_started, self._stage_started, self._ended
        is_followed = self._fraction >= LEAST_FRACTION and done >= LEAST_SECONDS
        rest = self._expected(running, times)
        if is_followed:
            # What was expected counts less and less.
            times, since = _with_step(times, running, done / self._fraction), self._reported
            expected = self._measured.get(running.stage, done / self._fraction)
            rest = (1.0 - self._fraction) * (done + (1.0 - self._fraction) * expected)
        seconds = {True: 0.0, False: 0.0}
        # Between reports it decays exponentially and never reaches 0.
        rest *= math.exp(-(self._now() - since) / rest) if rest > 0.0 else 0.0
        seconds[is_followed or self._is_known(running, times)] += rest
        for step in later:
            seconds[self._is_known(step, times)] += self._expected(step, times)
        return seconds[True], seconds[False]

    def _is_known(self, step: Step, times: StageTimes) -> bool:
        return step.stage in self._measured or _kind(step.stage) in {**times, **self._paces}

    def _expected(self, step: Step, times: StageTimes) -> float:
        """Expected seconds of a step: as the same stage took, else by its cost and the pace of its kind, or of all."""
        seconds, cost = times.get(_kind(step.stage), (0.0, 0.0))
        guess = step.cost * seconds / cost if seconds > 0.0 and cost > 0.0 else self._prior(step) * self._pace()
        return self._measured.get(step.stage, guess)

    def _prior(self, step: Step) -> float:
        """Seconds that a step would take by the jobs before."""
        return step.cost * self._paces.get(_kind(step.stage), self._paces[""])

    def _pace(self) -> float:
        """By how much steps take longer than by the jobs before; one that is late raises it at once."""
        seconds = PRIOR_SECONDS + sum(seconds for seconds, _ in self._ended.values())
        cost = PRIOR_SECONDS + sum(self._prior(Step(kind, cost)) for kind, (_, cost) in self._ended.items())
        so_far = seconds + self._now() - self._stage_started
        return max(seconds / cost, so_far / (cost + self._prior(self._steps[self._at])))


@dataclass
class Job:
    """A job that runs, has ended (`finished`), or was `cancelled`."""

    title: str
    plan: Plan
    folder: Path  # temporary, removed at the end
    command: str  # shade, compare, bake or match
    scene: int  # session uid of its scene
    shown: int = 0  # how many of the results the window shows
    output: Path | None = None  # folder of files for the user
    stage: str = STARTING
    results: list[Path] = field(default_factory=list)  # folders of pictures so far
    objects: dict[str, str] = field(default_factory=dict)  # of a bake: baking, done, unchanged or failed, by name
    error: str = ""  # one line that says why the job failed; "" if it did not
    finished: bool = False
    cancelled: bool = False
    started: float = field(default_factory=time.monotonic)

    def start(self, runs: list[dict], *, background: bool) -> None:
        """Start the process with `runs` (see `Run.to_dict`); in the `background` it has a lower priority.

        Raises SceneError and OSError.
        """
        job = self.folder / "job.json"
        document = {"runs": runs, "path": blender_process.packages(), "temporary": str(self.folder)}
        job.write_text(json.dumps(document), encoding="utf-8")
        self._messages: SimpleQueue = SimpleQueue()
        command = blender_process.child_command(job, SCRIPT)
        self._process = blender_process.start(command, self.folder, background=background)
        threading.Thread(target=self._listen, name="ltsh-job", daemon=True).start()

    def _listen(self) -> None:
        others: deque[str] = deque(maxlen=blender_process.OUTPUT_LINES_KEPT)
        with self._process.stdout:
            for message in blender_process.messages(self._process.stdout, others):
                self._messages.put(message)
        code = self._process.wait()
        self._process.stdin.close()
        if code != 0:
            self._messages.put({"error": blender_process.ended(code, others)})
        self._messages.put({"end": True})

    def poll(self) -> bool:
        """Handle all new messages of the process; True if there were any."""
        changed = False
        while not self.finished:
            try:
                message = self._messages.get_nowait()
            except Empty:
                break
            changed = True
            self._take(message)
        return changed

    def _take(self, message: dict) -> None:
        if "stage" in message:
            self.stage = message["stage"]
            self.plan.report(self.stage, float(message["fraction"]))
        elif "expected" in message:
            self.plan.expect(message["expected"])
        elif "object" in message:
            name = message["object"]
            self.objects[name] = message["state"]
            if message["state"] == "unchanged":
                self.plan.expect({f"{kind} {name}": 0.0 for kind in OBJECT_STAGES})
        elif "result" in message:
            self.results.append(Path(message["result"]))
        elif "error" in message:
            self.error = self.error or message["error"]
        elif "end" in message:
            self.finished = True
            if not self.error:
                self.plan.end(session_times)
            self.remove_folder()

    def wait(self, seconds: float = 0.05) -> None:
        """Poll until the job has ended."""
        while not self.finished:
            if not self.poll():
                time.sleep(seconds)

    def cancel(self) -> None:
        """Stop at once. A thread ends the process and removes its folder."""
        if self.finished:
            return
        self.finished = self.cancelled = True
        # Not a daemon thread: a Blender that quits now waits for it.
        threading.Thread(target=self._end, name="ltsh-job-end").start()

    def _end(self) -> None:
        # The processes that it has started end with it, as each of them reads the other end of a pipe.
        self._process.stdin.close()
        try:
            self._process.wait(ENDING_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.remove_folder()

    def end_now(self) -> None:
        """As `cancel`, but waits for the end: for a Blender that is about to quit."""
        if not self.finished:
            self.finished = self.cancelled = True
            self._end()

    def remove_folder(self) -> None:
        """Remove the temporary folder of the job."""
        shutil.rmtree(self.folder, ignore_errors=True)

    # What is shown:

    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.started


def clock(seconds: float) -> str:
    """`seconds` as 0:07 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def stage_title(stage: str) -> str:
    """The translated title of a stage."""
    return translated(STAGE_TITLES.get(stage, stage))


def progress_text(plan: Plan, seconds: float) -> str:
    """Percent and time left of a job that began `seconds` ago."""
    text, remaining, is_sure = f"{100.0 * plan.share():.0f} %", plan.seconds_left(), plan.is_sure
    if seconds < (SURE_SECONDS if is_sure else ROUGH_SECONDS):
        return text
    shown = clock(remaining) if is_sure else f"{translated('about')} {clock(rounded(remaining))}"
    return f"{text}, {shown} {translated('left')}"


def rounded(seconds: float) -> float:
    """`seconds` rounded to tens, or to minutes from about two minutes on."""
    step = 10.0 if seconds < 115.0 else 60.0
    return step * max(1, round(seconds / step))
