"""Lights that light some samples only."""

from dataclasses import replace

import numpy as np
import pytest
from kills import all_ended
from precisions import techniques, techniques_and_types
from surface_scenes import STAR, area_light, four_lights, polygon_light, random_samples

from ltsh_addon import shading

pytestmark = pytest.mark.usefixtures("short_tasks_for_children")


def numbered_samples(count, seed=0):
    """Samples with receivers 0, 1, 2, 7."""
    samples = random_samples(count, seed)
    return replace(samples, receiver=np.array([0, 1, 2, 7])[np.arange(count) % 4])


def every_light():
    """The four lights, one with a spread, one that is a polygon, one so narrow that it is shaded in double."""
    lights = [*four_lights(), polygon_light(STAR, group="Key")]
    lights[1] = replace(lights[1], spread=1.2)
    lights[2] = replace(lights[2], spread=2.0)
    return [*lights, area_light(spread=0.2, group="Fill")]


@techniques_and_types
def test_only_receivers_are_lit(technique, dtype):
    samples = numbered_samples(24, seed=1)
    lights = every_light()
    free = shading.shade(samples, lights, technique, dtype=dtype, workers=1)
    bound = [replace(light, receivers=(1, 7)) for light in lights]
    found = shading.shade(samples, bound, technique, dtype=dtype, workers=1)
    lit = np.isin(samples.receiver, (1, 7))
    for part in shading.PASSES:
        expected = getattr(free, part) * lit[:, None]
        # Samples are batched in another way: rounding, amplified by sharp lobes
        limit = 1e-9 if dtype == np.float64 else 2e-6
        assert np.abs(getattr(found, part) - expected).max() < limit * free.combined.max()
    assert found.combined[lit].max() > 0.1 and not found.combined[~lit].any()
    nobody = [replace(light, receivers=()) for light in lights]
    assert not shading.shade(samples, nobody, technique, dtype=dtype, workers=1).combined.any()


@techniques
def test_a_partition_of_the_receivers_adds_up(technique):
    samples, lights = numbered_samples(24, seed=2), every_light()
    parts = [replace(light, receivers=numbers) for light in lights for numbers in ((0, 2), (1,), (7, 99))]
    expected = shading.shade(samples, lights, technique, dtype=np.float64, workers=1)
    found = shading.shade(samples, parts, technique, dtype=np.float64, workers=1)
    assert np.abs(found.combined - expected.combined).max() < 1e-9 * expected.combined.max()


@pytest.mark.parametrize(
    ("technique", "part", "dtype"), [("ltsh4", "specular", np.float32), ("ltc", "diffuse", np.float64)]
)
def test_workers_do_not_change_one_bit(technique, part, dtype, started, children_only):
    """The numbers travel with either pass; spread and corners with the lights."""
    samples = numbered_samples(60, seed=3)
    lights = [replace(light, receivers=(n, 7)) for n, light in enumerate(every_light())]
    one, two = (
        getattr(shading.shade(samples, lights, technique, passes=[part], workers=count, dtype=dtype), part)
        for count in (1, 2)
    )
    assert len(started) == 1 and all_ended(started)
    assert one.any() and np.array_equal(one, two)
