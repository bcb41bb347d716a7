"""The stages of a job, what they are called in the panels, and about how long they take beside each other."""

from __future__ import annotations

from bpy.app.translations import pgettext_iface as translated

from . import preflight
from .job import STARTING, Job, clock
from .job_arguments import REFERENCE, chosen
from .job_plan import Step

# What stages of the command line are called there and here; others keep their names.
TECHNIQUES = {"ltc": "LTC", "ltsh2": "LTSH N=2", "ltsh4": "LTSH N=4", REFERENCE: "Reference quadrature"}
TITLES = {
    "open scene": "Open Scene",
    "samples": "Sample Surfaces",
    "Cycles A": "Cycles, First Half",
    "Cycles B": "Cycles, Second Half",
    "LTSH N=2": "LTSH 2",
    "LTSH N=4": "LTSH 4",
    "Reference quadrature": "Reference",
    "write": "Write Files",
    "images": "Make Pictures",
}
# Seconds on two cores: once, and for each million points, or points and samples. Plans learn the machine's own pace.
START_SECONDS, OPEN_SECONDS, RENDER_SECONDS = 1.5, 2.0, 0.5
SAMPLE_SECONDS, FILE_SECONDS = 12.0, 3.0
SHADING_SECONDS = {"ltc": 4.0, "ltsh2": 5.0, "ltsh4": 6.0, REFERENCE: 100.0}
REFERENCE_POINTS = 0.15


def steps(context, command: str) -> list[Step]:
    """What a job goes through, in order."""
    starting = Step(STARTING, START_SECONDS)
    if command == "bake":
        return [starting, *_bake(context)]
    names = chosen(context.scene.ltsh, "techniques")
    if command == "shade":
        return [starting, *_picture(context.scene, names, False)]
    first = [name for name in names if name != REFERENCE]
    early = _picture(context.scene, first, False) if first else []
    return [starting, *early, *_picture(context.scene, names, True)]


def _picture(scene, techniques: list[str], with_cycles: bool) -> list[Step]:
    settings, (width, height) = scene.ltsh, preflight.picture_of(scene)
    pixels, points = 1e-6 * width * height, 1e-6 * width * height * settings.anti_aliasing
    rendered = RENDER_SECONDS * settings.anti_aliasing
    half = Step("", rendered + SAMPLE_SECONDS * pixels * max(settings.cycles_samples // 2, settings.anti_aliasing))
    return [
        Step("open scene", OPEN_SECONDS),
        Step("samples", rendered + SAMPLE_SECONDS * points),
        *(Step(f"Cycles {name}", half.cost) for name in ("A", "B") if with_cycles),
        *(Step(TECHNIQUES[name], _shading(name, points)) for name in techniques),
        Step("write", FILE_SECONDS * pixels),
        Step("images", FILE_SECONDS * pixels),
    ]


def _bake(context) -> list[Step]:
    settings = context.scene.ltsh
    texels = 1e-6 * int(settings.bake_size) ** 2
    samples = settings.cycles_samples * len(settings.bake_passes) if settings.bake_error else 1
    shading = sum(_shading(name, texels) for name in chosen(settings, "techniques"))
    found = [Step("open scene", OPEN_SECONDS)]
    for ob in preflight.bake_objects(context)[0]:
        found.append(Step(f"bake {ob.name}", RENDER_SECONDS + SAMPLE_SECONDS * texels * samples))
        found.append(Step(f"shade {ob.name}", shading + FILE_SECONDS * texels))
    return [*found, Step("images", FILE_SECONDS * texels * len(found))]


def _shading(technique: str, points: float) -> float:
    return SHADING_SECONDS[technique] * (min(points, REFERENCE_POINTS) if technique == REFERENCE else points)


def stage_title(job: Job) -> str:
    """What the job does now."""
    return translated(TITLES.get(job.stage, job.stage))


def progress_text(job: Job) -> str:
    """Percent and time left of the whole job."""
    text = f"{100.0 * job.plan.share():.0f} %"
    left = job.seconds_left()
    return text if left is None else f"{text}, {clock(left)} {translated('left')}"
