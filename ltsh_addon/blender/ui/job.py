"""A job in a second Blender: its arguments, its plan, the process, its stages."""

from __future__ import annotations

import importlib.util
import json
import math
import queue
import shutil
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_iface as translated

from ...pipeline.options import BakeOptions, PictureOptions, command_line
from ...scene import REFERENCE, TECHNIQUES
from ..process import blender_process
from . import preflight
from .settings import preferences

STARTING = "Starting"
# Before, nobody knows how long a job will take, and no time left is told that is not sure.
SURE_SECONDS, ROUGH_SECONDS = 3.0, 10.0
# Of the time left at least so much must be measured: it is then right within a factor of two, though a guess for the
# rest may be three times too short.
KNOWN_SHARE = 0.5
SCRIPT = Path(__file__).resolve().parents[2] / "panel_job.py"
ENDING_SECONDS = 10.0
NO_CYCLES = "Not complete: without Cycles"
# What stages of the command line are called there and here; others keep their names.
STAGE_TITLES = {
    "open scene": "Open Scene",
    "samples": "Sample Surfaces",
    "Cycles A": "Cycles, First Half",
    "Cycles B": "Cycles, Second Half",
    "shadows": "Trace Shadows",
    "denoise": "Denoise",
    **{technique.title: technique.label for technique in TECHNIQUES.values()},
    "write": "Write Files",
    "images": "Make Pictures",
    "lights": "Light Mixer",
}
# Costs count as if so many seconds had been measured.
PRIOR_SECONDS, LITTLE_SECONDS = 5.0, 1.0
# Below, what a stage reports says too little about its length.
LEAST_FRACTION, LEAST_SECONDS = 0.02, 1.0
# An end that is not reported is not shown.
MOST = 0.99
# Seconds on two cores: once, and for each million points, or points and samples. Plans learn the machine's own pace.
START_SECONDS, OPEN_SECONDS, RENDER_SECONDS = 1.5, 2.0, 0.5
SAMPLE_SECONDS, FILE_SECONDS = 16.0, 3.0
DIRECT_SECONDS = 3.0  # of a sample of Cycles' direct light
SHADING_SECONDS = {"ltc": 6.5, "ltsh2": 8.0, "ltsh4": 10.0, "ltsh4c": 11.5, REFERENCE: 160.0}
SHADOW_SECONDS, DENOISE_SECONDS = 30.0, 4.0  # of shadows with `USUAL_RAYS`
USUAL_RAYS = 256
PATHS = 2.0  # a sample of all light costs so many of direct light
REFERENCE_POINTS = 0.15


@dataclass(frozen=True)
class Run:
    """One command of a job; `partial` says what its pictures lack, where a later one of the job has more."""

    command: str
    options: PictureOptions | BakeOptions
    partial: str = ""

    def to_dict(self) -> dict:
        """As `panel_job.perform` takes it."""
        arguments = [self.command, *command_line(self.options)]
        return {"arguments": arguments, "output": str(self.options.output), "partial": self.partial}


def runs_of(context, command: str, scene_file: Path) -> list[Run]:
    """The commands of a job."""
    if command == "bake":
        return [Run(command, bake_options(context, scene_file))]
    wanted = picture_options(context.scene, command, scene_file)
    first = tuple(name for name in wanted.techniques if name != REFERENCE)
    if command == "shade" or not first:
        return [Run(command, wanted)]
    # The techniques are there long before Cycles is: they are shown, and stay where the rest is stopped.
    early = replace(picture_options(context.scene, "shade", scene_file), techniques=first, keep_visibility=False)
    return [Run("shade", early, NO_CYCLES), Run(command, wanted)]


def picture_options(scene, command: str, scene_file: Path) -> PictureOptions:
    """What "shade" or "compare" is asked for."""
    settings = scene.ltsh
    samples = {"cycles_samples": settings.cycles_samples} if command == "compare" else {}
    return PictureOptions(
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
    """What "bake" is asked for: the selected objects that can be baked."""
    settings = context.scene.ltsh
    side = int(settings.bake_size)
    return BakeOptions(
        scene=scene_file,
        output=output_folder(context.scene, "bake"),
        objects=tuple(ob.name for ob in preflight.bake_objects(context)[0]),
        uv=settings.bake_uv_map or None,
        size=(side, side),
        sub_samples=settings.anti_aliasing,
        margin=settings.bake_margin,
        view=settings.bake_view,
        techniques=(context.scene.ltsh_view.technique,),
        passes=chosen(settings, "bake_passes"),
        error=settings.bake_error,
        cycles_samples=settings.cycles_samples,
        shadows="on" if settings.shadows else "off",
        shadow_rays=settings.shadow_rays,
    )


def chosen(settings, key: str) -> tuple[str, ...]:
    """The members of a set of choices, in the order in which they are offered."""
    items = settings.bl_rna.properties[key].enum_items.keys()
    return tuple(name for name in items if name in getattr(settings, key))


def output_folder(scene, command: str) -> Path:
    """Where `command` writes: the folder of the settings, or that of the preferences where it is empty or where the
    .blend that it is relative to is not saved."""
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
    """A stage of a job; of its `cost`, about seconds, only the proportion to that of the others matters."""

    stage: str
    cost: float


def steps(runs: list[Run]) -> list[Step]:
    """What a job goes through, in order."""
    found = [Step(STARTING, START_SECONDS)]
    for run in runs:
        found += _bake(run.options) if run.command == "bake" else _picture(run.options, run.command == "compare")
    return found


def _picture(options: PictureOptions, with_cycles: bool) -> list[Step]:
    pixels = 1e-6 * math.prod(options.resolution)
    points, rendered = pixels * options.sub_samples, RENDER_SECONDS * options.sub_samples
    half = rendered + DIRECT_SECONDS * pixels * max(options.cycles_samples // 2, options.sub_samples)
    sampling, shading = shading_steps(points, options.sub_samples, _rays(options), options.techniques)
    return [
        *sampling,
        *(Step(f"Cycles {name}", half) for name in ("A", "B") if with_cycles),
        *shading,
        Step("write", FILE_SECONDS * pixels),
        Step("images", FILE_SECONDS * pixels),
        *([Step("lights", _shading("ltsh4", points))] if options.keep_visibility else []),
    ]


def shading_steps(points: float, sub_samples: int, shadow_rays: int, techniques) -> tuple[list[Step], list[Step]]:
    """How so many million points are sampled, and how they are shaded; without shadows there are 0 rays."""
    sampling = [
        Step("open scene", OPEN_SECONDS),
        Step("samples", RENDER_SECONDS * sub_samples + SAMPLE_SECONDS * points),
    ]
    shading = [Step(TECHNIQUES[name].title, _shading(name, points)) for name in techniques]
    # Rays go where a light is neither seen whole nor not at all, and elsewhere a few ask for that.
    shadows = SHADOW_SECONDS * points * math.sqrt(shadow_rays / USUAL_RAYS)
    return sampling, [*([Step("shadows", shadows)] if shadow_rays else []), *shading]


def finished_steps(pixels: float, cycles_samples: int) -> list[Step]:
    """How Cycles adds the rest to a picture of so many million pixels."""
    return [
        Step("open scene", OPEN_SECONDS),
        Step("Cycles", RENDER_SECONDS + PATHS * SAMPLE_SECONDS * pixels * cycles_samples),
        Step("denoise", DENOISE_SECONDS * pixels),
    ]


def _rays(options) -> int:
    return options.shadow_rays if options.shadows == "on" else 0


def _bake(options: BakeOptions) -> list[Step]:
    texels = 1e-6 * math.prod(options.size)
    samples = options.cycles_samples * len(options.passes) if options.error else options.sub_samples
    shading = sum(_shading(name, texels) for name in options.techniques) * options.sub_samples
    found = [Step("open scene", OPEN_SECONDS)]
    for name in options.objects:
        found.append(Step(f"bake {name}", RENDER_SECONDS + SAMPLE_SECONDS * texels * samples))
        found.append(Step(f"shade {name}", shading + FILE_SECONDS * texels))
    return [*found, Step("images", FILE_SECONDS * texels * len(found))]


def _shading(technique: str, points: float) -> float:
    return SHADING_SECONDS[technique] * (min(points, REFERENCE_POINTS) if technique == REFERENCE else points)


# Seconds and costs of the stages of the jobs that have ended in this session, by kind.
Seen = dict[str, tuple[float, float]]
seen: Seen = {}


def _kind(stage: str) -> str:
    """What stages have in common that take as long for their cost: those of all objects of a bake are alike, and
    the halves of Cycles."""
    first = stage.partition(" ")[0]
    return first if first in ("bake", "shade", "Cycles") else stage


def paces(seen: Seen) -> dict[str, float]:
    """Seconds for a cost of 1 by kind of stage, and by "" that of all others."""
    # Small stages say little about large ones.
    found = {kind: (seconds + LITTLE_SECONDS) / (cost + LITTLE_SECONDS) for kind, (seconds, cost) in seen.items()}
    seconds, cost = (sum(values) for values in zip(*seen.values(), strict=True)) if seen else (0.0, 0.0)
    return {**found, "": (seconds + PRIOR_SECONDS) / (cost + PRIOR_SECONDS)}


class Plan:
    """Follows a job through its `steps`; the first begins at once, some may never be reported. For their cost they are
    expected to take as long as in the jobs `seen` before."""

    def __init__(self, steps: Sequence[Step], now: Callable[[], float] = time.monotonic, seen: Seen | None = None):
        pace, self._asked, self._before = paces(seen or {}), tuple(steps), dict(seen or {})
        self._steps = tuple(replace(step, cost=step.cost * pace.get(_kind(step.stage), pace[""])) for step in steps)
        self._now = now
        self._at, self._share = 0, 0.0
        self._measured: dict[str, float] = {}
        self._seen: Seen = {}
        self._done_cost = self._done_seconds = 0.0
        self._started = self._stage_started = self._reported = now()
        self._fraction = 0.0

    @property
    def number(self) -> int:
        """Of the step that runs, from 1."""
        return self._at + 1

    @property
    def count(self) -> int:
        """Of all steps."""
        return len(self._steps)

    def report(self, stage: str, fraction: float) -> None:
        """`stage` has done `fraction` of its work."""
        later = range(self._at, self.count)
        at = next((index for index in later if self._steps[index].stage == stage), self._at)
        self._reported = self._now()
        if at != self._at:
            self._end_step()
            self._at, self._stage_started = at, self._reported
        self._fraction = min(max(fraction, 0.0), 1.0) if self._steps[self._at].stage == stage else 0.0

    def _end_step(self) -> None:
        step, seconds = self._steps[self._at], self._reported - self._stage_started
        self._measured[step.stage] = seconds
        kind, cost = _kind(step.stage), self._asked[self._at].cost
        before = self._seen.get(kind, (0.0, 0.0))
        self._seen[kind] = before[0] + seconds, before[1] + cost
        self._done_cost += step.cost
        self._done_seconds += seconds

    def end(self, seen: Seen) -> None:
        """The job has ended well; `seen` gets what its stages took."""
        self._reported = self._now()
        if self._at == self.count - 1:
            self._end_step()
        seen.update(self._seen)

    def share(self) -> float:
        """Of the whole job that is done, in [0, `MOST`]."""
        elapsed = self._now() - self._started
        whole = elapsed + self.seconds_left()
        self._share = max(self._share, min(elapsed / whole, MOST) if whole > 0.0 else 0.0)
        return self._share

    def seconds_left(self) -> float:
        """Until the job will have ended, as far as can be told."""
        return sum(self._parts_left())

    @property
    def is_sure(self) -> bool:
        """Is enough of the time left measured?"""
        known, guessed = self._parts_left()
        return known >= KNOWN_SHARE * (known + guessed)

    def _parts_left(self) -> tuple[float, float]:
        """Seconds that are known by what was measured, and those that are guessed by costs."""
        measured = self._measured_costs()
        kind = _kind(self._steps[self._at].stage)
        parts = {True: 0.0, False: 0.0}
        parts[self._is_followed or kind in measured or kind in self._before] += self._rest_of_step(measured)
        for step in self._steps[self._at + 1 :]:
            kind = _kind(step.stage)
            parts[kind in measured or kind in self._before] += self._expected(step, measured)
        return parts[True], parts[False]

    def _expected(self, step: Step, measured: dict[str, tuple[float, float]]) -> float:
        """Seconds: as long as the same stage took before, or by its cost as those of its kind, or as all."""
        seconds, cost = measured.get(_kind(step.stage), (0.0, 0.0))
        pace = seconds / cost if seconds > 0.0 and cost > 0.0 else self._pace()
        return self._measured.get(step.stage, step.cost * pace)

    def _measured_costs(self) -> dict[str, tuple[float, float]]:
        """Seconds and costs by kind of the steps of this job, that which runs included as far as it tells."""
        found: dict[str, tuple[float, float]] = {}
        for step in self._steps[: self._at + 1]:
            seconds = self._measured.get(step.stage)
            if step is self._steps[self._at]:
                seconds = (self._reported - self._stage_started) / self._fraction if self._is_followed else None
            if seconds is not None:
                before = found.get(_kind(step.stage), (0.0, 0.0))
                found[_kind(step.stage)] = before[0] + seconds, before[1] + step.cost
        return found

    @property
    def _is_followed(self) -> bool:
        """Has the step that runs told enough to say how long it will take?"""
        return self._fraction >= LEAST_FRACTION and self._reported - self._stage_started >= LEAST_SECONDS

    def _pace(self) -> float:
        """Seconds for a cost of 1; a step that takes longer than expected tells that all will."""
        seconds, cost = self._done_seconds + PRIOR_SECONDS, self._done_cost + PRIOR_SECONDS
        so_far = seconds + self._now() - self._stage_started
        return max(seconds / cost, so_far / (cost + self._steps[self._at].cost))

    def _rest_of_step(self, measured: dict[str, tuple[float, float]]) -> float:
        """Seconds; between reports the rest melts away and never becomes nothing."""
        if self._is_followed:
            done = self._reported - self._stage_started
            rest, since = done / self._fraction - done, self._reported
        else:
            rest, since = self._expected(self._steps[self._at], measured), self._stage_started
        return rest * math.exp(-(self._now() - since) / rest) if rest > 0.0 else 0.0


@dataclass
class Job:
    """A job that runs, has ended (`finished`), or was `cancelled`.

    `results` are the folders of pictures so far, `error` is "" or one line that says why there are no more. Of the
    results the window has `shown` so many; they belong to the scene with the session uid `scene`.
    """

    title: str
    plan: Plan
    folder: Path  # temporary, removed at the end
    command: str  # shade, compare or bake
    scene: int
    shown: int = 0
    output: Path | None = None  # where files for the user go
    stage: str = STARTING
    results: list[Path] = field(default_factory=list)
    error: str = ""
    finished: bool = False
    cancelled: bool = False
    started: float = field(default_factory=time.monotonic)

    def start(self, runs: list[dict], *, background: bool) -> None:
        """Start the process on `Run`s as dictionaries; in the `background` this process comes first.

        Raises SceneError and OSError.
        """
        job = self.folder / "job.json"
        document = {"runs": runs, "path": _library_folders(), "temporary": str(self.folder)}
        job.write_text(json.dumps(document), encoding="utf-8")
        self._messages: queue.SimpleQueue = queue.SimpleQueue()
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
        """Take in what the process has said since; True where that is anything."""
        changed = False
        while not self.finished:
            try:
                message = self._messages.get_nowait()
            except queue.Empty:
                break
            changed = True
            self._take(message)
        return changed

    def _take(self, message: dict) -> None:
        if "stage" in message:
            self.stage = message["stage"]
            self.plan.report(self.stage, float(message["fraction"]))
        elif "result" in message:
            self.results.append(Path(message["result"]))
        elif "error" in message:
            self.error = self.error or message["error"]
        elif "end" in message:
            self.finished = True
            if not self.error:
                self.plan.end(seen)
            self.remove_folder()

    def wait(self, seconds: float = 0.05) -> None:
        """Poll until the job has ended."""
        while not self.finished:
            if not self.poll():
                time.sleep(seconds)

    def cancel(self) -> None:
        """Stop at once; the process ends, and its folder goes, in the background."""
        if self.finished:
            return
        self.finished = self.cancelled = True
        # No daemon: a Blender that quits now waits for it.
        threading.Thread(target=self._end, name="ltsh-job-end").start()

    def _end(self) -> None:
        # What the process has started itself ends with it: each of them reads the other end of a pipe.
        self._process.stdin.close()
        try:
            self._process.wait(ENDING_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.remove_folder()

    def end_now(self) -> None:
        """As `cancel`, for a Blender that is about to quit: everything is gone on return."""
        if not self.finished:
            self.finished = self.cancelled = True
            self._end()

    def remove_folder(self) -> None:
        """Remove what the job wrote for itself."""
        shutil.rmtree(self.folder, ignore_errors=True)

    # What is shown:

    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self.started


def new_folder() -> Path:
    """A temporary folder for a job."""
    return Path(tempfile.mkdtemp(prefix="ltsh-"))


def _library_folders() -> list[str]:
    """Where the process finds what this Blender got with the extension."""
    spec = importlib.util.find_spec("OpenEXR")
    return [str(Path(spec.origin).parent)] if spec is not None and spec.origin else []


def clock(seconds: float) -> str:
    """`seconds` as 0:07 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def stage_title(stage: str) -> str:
    """What a job does in that stage."""
    return translated(STAGE_TITLES.get(stage, stage))


def progress_text(plan: Plan, seconds: float) -> str:
    """Percent and time left of a whole job that began so many seconds ago."""
    text, left, is_sure = f"{100.0 * plan.share():.0f} %", plan.seconds_left(), plan.is_sure
    if seconds < (SURE_SECONDS if is_sure else ROUGH_SECONDS):
        return text
    shown = clock(left) if is_sure else f"{translated('about')} {clock(rounded(left))}"
    return f"{text}, {shown} {translated('left')}"


def rounded(seconds: float) -> float:
    """`seconds` to ten of them, or from two minutes on to minutes."""
    step = 10.0 if seconds < 115.0 else 60.0
    return step * max(1, round(seconds / step))
