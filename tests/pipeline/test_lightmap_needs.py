"""What a bake takes is told before it starts."""

from pathlib import Path

import pytest

from ltsh_addon.pipeline import BakeOptions, lightmap, tasks
from ltsh_addon.scene import SceneError

# Peaks of both processes in MiB, as the kernel counts them (ru_maxrss), two cores, a plane and three boxes under a sky:
# side, options, rows of lights.
MEASURED = [
    (1024, {"shadows": "off"}, 1, 493 + 303),
    (1024, {"shadows": "off", "per_light": True}, 4, 549 + 303),
    (1024, {"bounces": "on"}, 1, 1108 + 526),
    (1024, {"bounces": "on", "per_light": True}, 4, 1326 + 525),
    (2048, {"bounces": "on"}, 1, 3989 + 1142),
]


def bake(side, **options):
    return BakeOptions(Path("room.blend"), Path("out"), size=(side, side), **options)


@pytest.mark.parametrize(("side", "options", "lights", "peak"), MEASURED)
def test_memory_is_right_within_a_factor_of_one_and_a_half(monkeypatch, side, options, lights, peak):
    monkeypatch.setattr(lightmap, "cores", lambda: 2)
    assert peak / 1.5 < lightmap.memory_needed(bake(side, **options), lights) / 2**20 < 1.5 * peak


def test_large_bakes_and_lights_by_themselves_are_told(monkeypatch):
    monkeypatch.setattr(lightmap, "machine_memory", lambda: 16.0 * 2**30)
    monkeypatch.setattr(lightmap, "cores", lambda: 2)
    assert lightmap.announced(bake(1024, bounces="on"), 3) == []
    (memory,) = lightmap.announced(bake(4096), 3)
    assert memory == "The bake takes about 0.8 GiB of memory"
    memory, lights = lightmap.announced(bake(4096, bounces="on", per_light=True), 6)
    assert lights == "6 lights: bounces take 3 times as long as those of all at once"
    assert "GiB of memory, and this machine has 16.0: fewer texels take less" in memory
    assert lightmap.announced(bake(64, bounces="on", per_light=True), 1)[-1].startswith("1 light: bounces take 1 times")


def test_only_a_bake_that_cannot_work_is_refused(monkeypatch):
    remarks = []

    class Told:
        remark = remarks.append

    options = bake(8192, bounces="on")
    # What three pictures, faces and guides take, however little of the texture islands cover.
    least = 8192**2 * (3 * 37 + 32)
    monkeypatch.setattr(lightmap, "machine_memory", lambda: 1.2 * least)
    tasks._announce(options, 1, Told)
    assert len(remarks) == 1
    monkeypatch.setattr(lightmap, "machine_memory", lambda: least)
    with pytest.raises(SceneError, match="8192 x 8192 texels takes at least .* GiB, .*: lower --size$"):
        tasks._announce(options, 1, None)
    monkeypatch.setattr(lightmap, "machine_memory", lambda: None)
    tasks._announce(options, 1, None)
