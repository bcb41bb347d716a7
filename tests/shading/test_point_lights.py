"""Lights that are infinitely far away, and lights that face every sample."""

from dataclasses import replace

import numpy as np
import pytest
from surface_scenes import area_light, random_samples

from ltsh_addon import shading
from ltsh_addon.scene import AreaLight

CORNERS = np.array([(-1.0, -0.4, 0.0), (0.8, -0.6, 0.0), (1.0, 0.7, 0.0), (-0.6, 0.5, 0.0)])


def distant_lights():
    """One of each shape, in all directions."""
    return [
        area_light("R", "RECTANGLE", (0.3, 0.2, 3.0), is_distant=True),
        area_light("D", "DISK", (2.6, 1.0, 1.0), (0.0, 0.5, 0.0), (0.0, 0.0, -0.5), is_distant=True),
        area_light("P", "POLYGON", (0.0, 0.0, 3.0), corners=CORNERS + (0.0, 0.0, 3.0), is_distant=True),
        area_light("F", "SQUARE", (-3.0, 0.5, 0.4), (0.0, 0.7, 0.0), (0.0, 0.0, 0.7), is_distant=True),
    ]


@pytest.mark.parametrize(
    ("technique", "dtype"), [("ltsh4", np.float32), ("ltsh4", np.float64), ("ltc", np.float32), ("reference", None)]
)
def test_every_point_sees_a_distant_light_as_the_origin_does(technique, dtype):
    """Exactly what a light nearby gives to samples that all lie at the origin."""
    samples, options = random_samples(40, lowest_roughness=0.02), {} if dtype is None else {"dtype": dtype}
    here = replace(samples, position=np.zeros_like(samples.position))
    for light in distant_lights():
        found = shading.shade(samples, [light], technique, workers=1, **options)
        expected = shading.shade(here, [replace(light, is_distant=False)], technique, workers=1, **options)
        assert np.array_equal(found.specular, expected.specular) and found.specular.any()
        assert np.array_equal(found.diffuse, expected.diffuse) and found.diffuse.any()


def test_distant_lights_stay_where_they_are():
    """Whatever is moved, and as JSON."""
    light = distant_lights()[2]
    assert np.array_equal(light.moved(np.array([1.0, 2.0, 3.0])).corners, light.corners)
    assert AreaLight(**light.record()).is_distant


@pytest.mark.parametrize("options", [{"spread": 1.0}, {"falloff": 1}])
def test_distant_lights_have_no_profile(options):
    with pytest.raises(ValueError, match="distant"):
        area_light("D", "RECTANGLE", (0.0, 0.0, 3.0), is_distant=True, **options)
