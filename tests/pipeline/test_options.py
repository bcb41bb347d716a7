"""Options are declared once: the command line, job files, digests and the second Blender's job follow."""

from dataclasses import fields, replace
from pathlib import Path

import pytest

from ltsh_addon.blender.process.pixels import PixelJob
from ltsh_addon.cli import arguments, commands
from ltsh_addon.pipeline import BakeOptions, CompareOptions, PictureOptions
from ltsh_addon.pipeline.options import arguments_of, child_job, command_line, what_matters

SCENE, OUT = Path("room.blend"), Path("out")
# A value that is not the default, for every option but scene and output.
PICTURE = {
    "techniques": ("ltc", "mine.npz"), "passes": ("diffuse",), "resolution": (640, 360), "sub_samples": 4,
    "reference_samples": 7, "cycles_samples": 32, "scripts": True,
    "shadows": "off", "shadow_rays": 16, "keep_visibility": True,
}  # fmt: skip
BAKE = {
    "objects": ("Floor", "-Wall"), "uv": "-Map", "size": (128, 64), "sub_samples": 4, "margin": 3,
    "conservative": True, "view": (-1.0, 2.5, 0.0),
    "techniques": ("reference",), "passes": ("diffuse_light",),
    "error": True, "cycles_samples": 32, "apply": True, "export": "glb", "scripts": True,
    "bounces": "on", "rest_samples": 16, "per_light": True,
    "shadows": "off", "shadow_rays": 16,
}  # fmt: skip
# Options that go together.
ATLAS = {"atlas": 2048, "texels_per_metre": 20.0, "unwrap": "faces"}
OF_A_TASK = {"scene", "output", "frame", "camera", "name"}
KINDS = pytest.mark.parametrize(
    ("command", "kind", "values"), [("compare", CompareOptions, PICTURE), ("bake", BakeOptions, BAKE)]
)


def parsed(command, words):
    parser = commands.job_parsers()[command]
    return commands.job_of(parser.parse_args(words), (SCENE,)).options


@KINDS
def test_the_command_line_gives_every_option_back(command, kind, values):
    assert set(values) == set(arguments_of(kind)) - OF_A_TASK - set(ATLAS)
    plain = kind(SCENE, OUT)
    assert parsed(command, command_line(plain)) == plain and len(command_line(plain)) == 3
    given = [*({name: value} for name, value in values.items()), values]
    given += [{"objects": "selected"}, {"objects": "all"}, {"atlas": 512}, ATLAS] if kind is BakeOptions else []
    for wanted in (kind(SCENE, OUT, **options) for options in given):
        assert parsed(command, command_line(wanted)) == wanted


@KINDS
def test_job_files_have_the_options_of_the_command_line(command, kind, values):
    declared = {flag.lstrip("-") for _, arguments in arguments_of(kind).values() for item in arguments
                for flag in item.flags} - {"scenes", "o", "enable-autoexec"}  # fmt: skip
    baseline = {"baseline", "tolerance"} if command == "compare" else set()
    assert set(arguments._options(commands.job_parsers()[command])) == declared | baseline


@KINDS
def test_a_digest_holds_what_results_depend_on(command, kind, values):
    plain = kind(SCENE, OUT)
    for name, value in values.items():
        changed = what_matters(replace(plain, **{name: value})) != what_matters(plain)
        # Each object is a task of its own, and an export comes after all.
        assert changed is (name not in ("objects", "export")), name
    for name, value in ATLAS.items() if kind is BakeOptions else ():
        assert what_matters(replace(plain, **{name: value})) != what_matters(plain)
    for name in ("scene", "output"):
        assert what_matters(replace(plain, **{name: Path("other")})) == what_matters(plain)


def test_the_second_blender_gets_the_options_that_it_knows():
    options = PictureOptions(SCENE, OUT, camera="Side", frame=3, **PICTURE)
    job = child_job(PixelJob, options, width=1, cycles_samples=0)
    assert (job.scene, job.camera, job.frame, job.sub_samples, job.scripts) == (SCENE, "Side", 3, 4, True)
    assert (job.width, job.cycles_samples) == (1, 0)
    shared = {item.name for item in fields(PictureOptions)} & {item.name for item in fields(PixelJob)}
    assert shared == {"scene", "camera", "frame", "sub_samples", "cycles_samples", "scripts", "shadows"}
