"""Bakes that are killed at random moments and gone on with: byte for byte what one run gives."""

import sys

import kills
import programs
import pytest
from bake_scenes import save, textured_scene

OPTIONS = ["--size", "64", "--error", "--cycles-samples", "4", "--quiet", "--margin", "3"]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes as Linux tells of them")


@pytest.fixture
def trial(tmp_path):
    textured_scene()
    path = save(tmp_path)

    def command(output, *more):
        return programs.command_line("bake", path, "-o", output, *OPTIONS, *more)

    return kills.Trial(command, tmp_path)


def test_after_kills_at_random_moments_resume_gives_the_same_bytes(trial):
    assert {"Plane.exr", "Sphere.exr", "report.json"} < set(trial.expected)
    for moment in kills.moments(seed=7, count=2, seconds=trial.seconds):
        trial.end_after("random", moment)
    trial.check("random")
    # Files are written in a small part of the time, which is where a kill could do most harm.
    assert trial.end_while_writing("writing")
    trial.check("writing")
