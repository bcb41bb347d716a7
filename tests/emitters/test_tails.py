"""Limits of integrals in the tails of lobes, with the reference quadrature and a second formula for them as oracles."""

from dataclasses import replace

import numpy as np
import pytest
import textbook
from surface_scenes import area_light, single_sample, unit

from ltsh_addon import shading
from ltsh_addon.scene import PolygonLight, light_of


def random_case(generator):
    """(view, roughness, light) of a light that shines on the origin."""
    mu, roughness = generator.uniform(0.02, 1.0), generator.uniform(0.1, 1.0)
    center = unit(generator.normal(size=3) + np.array([0.0, 0.0, 0.5]))
    direction = unit(generator.normal(size=3))
    direction *= -np.sign(direction @ center)
    half_u = unit(np.cross(direction, generator.normal(size=3)))
    half_v = np.cross(half_u, direction)
    half_u, half_v = (vector * 10.0 ** generator.uniform(-1.5, -0.3) for vector in (half_u, half_v))
    light = area_light(center=center, direction=direction, half_u=half_u, half_v=half_v, radiance=(1, 1, 1))
    return textbook.view_direction(mu), roughness, light


def shaded(sample, light, technique, dtype=np.float64):
    return shading.shade(sample, [light], technique, passes=["specular"], workers=1, dtype=dtype).specular[0, 0, 0]


WHITE = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1)}


def cases(count):
    """`count` of the random cases with bounds, and the bounds."""
    generator = np.random.default_rng(5)
    while count:
        view, roughness, light = random_case(generator)
        limits = textbook.tail_bounds(view, roughness, light)
        if limits is not None:
            count -= 1
            yield view, roughness, light, limits


def test_true_lobes_are_within_the_bounds():
    """So a limit never takes the right value away; lights in all directions, some cut by the horizon."""
    cut = 0
    for view, roughness, light, (least, most) in cases(200):
        sample = single_sample(view=view, roughness=roughness, **WHITE)
        exact = shaded(sample, light, shading.REFERENCE)
        # The quadrature stops at 1e-4 of the value plus 1e-6.
        assert 0.9998 * least - 2e-6 <= exact <= 1.0002 * most + 2e-6, (view, roughness, light)
        cut += least == 0.0 < most
    assert cut > 10


@pytest.mark.parametrize("technique", ["ltsh2", "ltsh4"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_integrals_are_within_the_bounds(technique, dtype):
    """And those of a dielectric between its reflectance head on and its largest one on the light."""
    changed = 0
    for view, roughness, light, (least, most) in cases(60):
        found = shaded(single_sample(view=view, roughness=roughness, **WHITE), light, technique, dtype)
        margin = 1e-4 * most + 1e-9
        assert least - margin <= found <= most + margin, (view, roughness, light)
        changed += min(abs(found - least), abs(found - most)) < margin
        coat = shaded(single_sample(view=view, roughness=roughness, dielectric=1.0), light, technique, dtype)
        cosine = min(np.sqrt(0.5 + 0.5 * view @ unit(corner)) for corner in light.polygon())
        s, p = textbook.fresnel_amplitudes(min(cosine, np.sqrt(0.5 + 0.5 * view @ unit(light.center))), 1.5)
        assert 0.04 * found - margin <= coat <= 0.5 * (s + p) * found + margin, (view, roughness, light)
    assert changed > 10


@pytest.mark.parametrize("technique", ["ltsh2", "ltsh4c"])
@pytest.mark.parametrize("shape", ["RECTANGLE", "ELLIPSE"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_in_tails_where_the_lobe_changes_little_the_light_is_right(technique, shape, dtype):
    """Within 4 %, half of them within .4 %, where the integrand changes by less than a factor of three over the light.
    Fitted lobes are off by up to several times their value there."""
    errors = []
    for view, roughness, light, (least, most) in cases(150):
        if least <= 0.0 or 3.0 * least < most:
            continue
        sample, light = (
            single_sample(view=view, roughness=roughness, **WHITE),
            light_of(light.record() | {"shape": shape}),
        )
        errors.append(shaded(sample, light, technique, dtype) / shaded(sample, light, shading.REFERENCE) - 1.0)
    assert len(errors) > 40 and np.abs(errors).max() < 0.04 and np.median(np.abs(errors)) < 0.004


def test_lights_that_the_geometric_horizon_cuts_have_no_lower_bound():
    """True lobes are half as bright as the bounds say where the horizon goes through the center of the light."""
    darker = 0
    for view, roughness, light, (least, _) in cases(60):
        toward = unit(light.center)
        geometric = unit(np.array([0.0, 0.0, 1.0]) - toward[2] * toward)
        sample = single_sample(view=view, roughness=roughness, geometric_normal=geometric, **WHITE)
        darker += shaded(sample, light, "ltsh4") < 0.8 * least
    assert darker > 10


FACTORS = {"linear": {"falloff": 1}, "constant": {"falloff": 2}, "smooth": {"smooth": 0.5}, "spread": {"spread": 2.5}}


def profile_range(light):
    """(least, greatest) factor of a light's profile at the origin: of its spread, and of its falloff, each over the
    circle around the light."""
    distance = -light.direction @ light.center
    beside = np.sqrt(max(light.center @ light.center - distance**2, 0.0))
    radius = max(np.linalg.norm(light.half_u + light.half_v), np.linalg.norm(light.half_u - light.half_v))
    radii = np.array([max(beside - radius, 0.0), beside + radius])
    squared = distance**2 + radii**2
    falloff = squared ** (0.5 * light.falloff) * squared / (light.smooth + squared)
    half = 0.5 * light.spread
    spread = np.maximum((np.tan(half) - radii[::-1] / distance) / (np.tan(half) - half), 0.0) if half < 1.5 else 1.0
    return spread * falloff


@pytest.mark.parametrize("name", FACTORS)
def test_profiled_lights_are_within_the_bounds_times_the_range_of_their_profile(name):
    """The fitted lobe by the limits, the true one by itself; in single precision, and in double precision too."""
    changed = 0
    for view, roughness, light, (least, most) in cases(25):
        sample = single_sample(view=view, roughness=roughness, **WHITE)
        light = replace(light, **FACTORS[name])
        low, high = profile_range(light) * (least, most)
        exact = shaded(sample, light, shading.REFERENCE)
        # The quadrature stops at 1e-4 of the value plus 1e-6.
        assert 0.9998 * low - 2e-6 <= exact <= 1.0002 * high + 2e-6, (view, roughness, light)
        for dtype in (np.float32, np.float64):
            found = shaded(sample, light, "ltsh2", dtype)
            margin = 1e-4 * high + 1e-9
            assert low - margin <= found <= high + margin, (view, roughness, light)
        changed += min(abs(found - low), abs(found - high)) < margin
    assert changed > 0


def test_a_profiled_polygon_in_several_pieces_is_limited_as_a_whole():
    """The light is a dart, of two convex pieces."""
    for view, roughness, light, _ in cases(25):
        u, v = light.half_u, light.half_v
        corners = light.center + np.stack([-u - v, u - v, u + v, 0.3 * u - 0.3 * v])
        dart = PolygonLight.like(light, corners=corners, falloff=2)
        # Its share of the area of the rectangle
        share = np.linalg.norm(dart.area_vector) / np.linalg.norm(light.area_vector)
        low, high = profile_range(dart) * textbook.tail_bounds(view, roughness, light) * share
        found = shaded(single_sample(view=view, roughness=roughness, **WHITE), dart, "ltsh2")
        assert low - 1e-4 * high - 1e-9 <= found <= 1.0001 * high + 1e-9, (view, roughness, light)


def test_a_profiled_light_is_not_limited_by_its_area():
    """A falloff leaves a millionth of the light."""
    for view, roughness, light, _ in cases(10):
        sample = single_sample(view=view, roughness=roughness, **WHITE)
        fading = replace(light, smooth=1e6 * float(light.center @ light.center))
        plain, faded = (shaded(sample, one, "ltsh4") for one in (light, fading))
        assert faded <= 1e-4 * plain
