"""The seconds that stages to come are expected to take, with a clock that the tests turn, and no Blender."""

from pathlib import Path
from types import SimpleNamespace

import fake_scene
import pytest

from ltsh_addon.blender.process import pixels
from ltsh_addon.pipeline import lighting


def test_what_grows_with_the_samples_is_foretold_and_what_does_not_is_counted_once(monkeypatch):
    clock, told = SimpleNamespace(now=0.0), {}

    def stage(start, each, result=lambda *arguments: None):
        def work(*arguments, **options):
            clock.now += start + each * len(getattr(arguments[0], "samples", arguments[0]))
            return result(*arguments)

        return work

    monkeypatch.setattr(lighting.time, "perf_counter", lambda: clock.now)
    monkeypatch.setattr(pixels, "ended_at_horizons", stage(0.5, 2.0, lambda extraction: extraction))
    monkeypatch.setattr(lighting, "trace_shadows", stage(1.0, 3.0))
    monkeypatch.setattr(lighting, "shade_lights", stage(0.0, 7.0))
    monkeypatch.setattr(lighting, "cores", lambda: 2)
    monkeypatch.setattr(lighting, "FEWEST_SAMPLES", 1)
    monkeypatch.setattr(lighting, "LOOKS", (0.3, 0.6))
    job = pixels.PixelJob(Path("room.blend"), shadows="on")
    extraction = fake_scene.FakeChild(wall=fake_scene.wall(9.0)).extract(job)
    arguments = extraction, {"ltc": "ltc", "reference": "reference"}, ("diffuse",), 16
    lighting.tell_expected(*arguments, SimpleNamespace(expect=told.update))
    count = len(extraction.samples)
    # Shadows and shading are shared by two processes; how long the reference takes is not known.
    title = lighting.title("ltc")
    wanted = {"horizons": 0.5 + 2.0 * count, "shadows": (1.0 + 3.0 * count) / 2.0, title: 7.0 * count / 2.0}
    assert told == pytest.approx(wanted)


def test_nothing_is_measured_for_progress_that_does_not_ask():
    lighting.tell_expected(SimpleNamespace(samples=range(10**6)), {}, (), 0, lambda stage, fraction: True)
