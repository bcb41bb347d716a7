"""Lights that reach nothing, beside points spread over them."""

from dataclasses import replace

import numpy as np
import pytest
import random_surfaces
from surface_scenes import area_light

from ltsh_addon.emitters.light_polygons import lights_that_reach_nothing


def is_seen(light, samples, random, count=400):
    """Does some point of the light stand above both horizons of a lobe, which is in front of the light?"""
    corners = light.polygon()
    shares = random.dirichlet(np.full(len(corners), 0.3), count)
    points = np.concatenate([corners, shares @ corners])[:, None]  # all of them in the hull of the light
    towards = points - samples.position
    seen = (towards * light.direction).sum(axis=-1) < 0.0
    if light.receivers is not None:
        seen &= np.isin(samples.receiver, light.receivers)
    above = [
        ((towards * first).sum(axis=-1) > 0.0) & ((towards * second).sum(axis=-1) > 0.0)
        for first, second in (
            (samples.diffuse_normal, samples.smooth_normal),
            (samples.normal, samples.geometric_normal),
        )
    ]
    return bool((seen & (above[0] | above[1])).any())


@pytest.mark.parametrize("surface", ["plain", "tilted"])
def test_a_light_is_named_where_none_of_its_points_is_seen(surface):
    random, found, expected = np.random.default_rng(3), [], []
    for trial in range(90):
        samples = random_surfaces.samples(surface, 3, random)
        kind = random_surfaces.LIGHTS[trial % len(random_surfaces.LIGHTS)]
        light = random_surfaces.light(kind, trial, random)
        # A third each: as they are, the surfaces above the light, the light turned round.
        samples = replace(samples, position=samples.position + (0.0, 0.0, 3.0 * (trial % 3 == 1)))
        light = replace(light, direction=-light.direction) if trial % 3 == 2 else light
        found.append(lights_that_reach_nothing(samples, (light,)) == [])
        expected.append(is_seen(light, samples, random))
    # What is seen is never named. Two horizons that each see some of a light may have none of it in common.
    assert not any(seen and not reached for reached, seen in zip(found, expected, strict=True))
    assert sum(found) - sum(expected) <= (0 if surface == "plain" else 6) and 20 < sum(expected) < 70


def test_lights_of_one_name_are_one_light_and_a_lobe_that_they_do_not_light_does_not_count():
    samples = random_surfaces.samples("plain", 50, np.random.default_rng(1))
    light = area_light(center=(0.0, 0.0, 5.0))
    assert lights_that_reach_nothing(samples, (light,)) == []
    behind = replace(light, direction=-light.direction)
    assert lights_that_reach_nothing(samples, (behind, light)) == []
    assert lights_that_reach_nothing(samples, (replace(behind, name="Lost"), light)) == ["Lost"]
    black = replace(samples, diffuse_albedo=np.zeros((50, 3)))
    assert lights_that_reach_nothing(black, (replace(light, affects_specular=False),)) == [light.name]
    assert lights_that_reach_nothing(black, (replace(light, affects_diffuse=False),)) == []
