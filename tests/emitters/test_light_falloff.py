"""Lights with a falloff: every technique gives what many small lights give, each as bright as its distance makes it."""

from dataclasses import replace

import numpy as np
import pytest
import quadrature
from random_surfaces import unit

from ltsh_addon.emitters import tails
from ltsh_addon.scene import SurfaceSamples, light_of
from ltsh_addon.shading import shade

COUNT = 16  # small lights along each side


def surface(roughness, count=40):
    """Points on an uneven plane below the lights, seen from the side; all lobes are white."""
    random = np.random.default_rng(5)
    position = np.concatenate([random.uniform(-1.5, 1.5, (count, 2)), np.zeros((count, 1))], axis=1)
    normal = unit(np.array([0.0, 0.0, 1.0]) + 0.2 * random.normal(size=(count, 3)))
    view, white = unit(np.array([0.3, -3.0, 2.0]) - position), np.ones((count, 3))
    none = np.zeros(count)
    return SurfaceSamples(
        position, view, normal, normal, np.full(count, roughness), white, white, none, none + 1.5, white
    )


def light(height, **settings):
    """A tilted rectangle of 2 x 1.2 m over the plane, changed by `settings`."""
    u, toward = np.array([0.98, 0.0, 0.199]), np.array([0.199, 0.0, -0.98])
    center, radiance = np.array([0.2, 0.3, height]), np.array([1.0, 2.0, 3.0])
    values = {"name": "Light", "shape": "RECTANGLE", "center": center, "half_u": u, "half_v": np.array([0.0, 0.6, 0.0])}
    return light_of({**values, "direction": toward / np.linalg.norm(toward), "radiance": radiance, **settings})


def of_small_lights(samples, whole, technique):
    """Specular and diffuse radiance (P, 3) by COUNT x COUNT lights without a falloff, weighted by their distances."""
    centers, _ = quadrature.patches_of(whole, COUNT)
    plain = replace(whole, falloff=0, smooth=0.0, half_u=whole.half_u / COUNT, half_v=whole.half_v / COUNT)
    parts = [replace(plain, center=center) for center in centers]
    found = shade(samples, parts, technique, workers=1, dtype=np.float64, rows=range(len(parts)))
    squared = np.square(samples.position - centers[:, None]).sum(axis=-1)  # (R, P)
    factor = squared ** (0.5 * whole.falloff) * squared / (whole.smooth + squared)
    return [np.einsum("gp,gpc->pc", factor, values) for values in (found.specular, found.diffuse)]


FALLOFFS = {"linear": (1, 0.0), "constant": (2, 0.0), "smooth": (0, 2.0), "smooth and constant": (2, 0.5)}


@pytest.mark.parametrize("name", FALLOFFS)
@pytest.mark.parametrize(("height", "roughness"), [(1.5, 0.3), (0.8, 0.6), (4.0, 0.2)])
def test_a_falloff_is_that_of_many_small_lights(monkeypatch, name, height, roughness):
    """`light_profile` promises 0.3 %; the small lights, an eighth of a meter wide, are off by their size over the
    distance squared, over 24: less than 1e-3. The limits in the tails, which each light has as a whole, do not add
    up."""
    monkeypatch.setattr(tails, "NEAR_RADII", np.inf)
    falloff, smooth = FALLOFFS[name]
    samples, whole = surface(roughness), light(height, falloff=falloff, smooth=smooth)
    expected = of_small_lights(samples, whole, "ltsh4")
    found = shade(samples, [whole], "ltsh4", workers=1)
    for values, wanted in zip((found.specular[0], found.diffuse[0]), expected, strict=True):
        assert np.linalg.norm(values - wanted) < 4e-3 * np.linalg.norm(wanted)


CORNERS = light(1.5).polygon()
# The last corner moves inside, over the diagonal.
DART = [*CORNERS[:3], 0.7 * CORNERS[1] + 0.3 * CORNERS[3]]
SHAPES = {
    "rectangle": {"falloff": 1},
    "disk": {"shape": "DISK", "falloff": 2},
    "smooth ellipse": {"shape": "ELLIPSE", "smooth": 1.0},
    "triangle": {"shape": "POLYGON", "falloff": 2, "corners": CORNERS[:3]},
    "dart": {"shape": "POLYGON", "falloff": 1, "corners": DART},
    "rectangle with a spread": {"falloff": 2, "smooth": 0.5, "spread": 1.2},
    "disk with a spread": {"shape": "DISK", "falloff": 1, "spread": 2.0},
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_reference_is_the_quadrature_with_the_falloff(name):
    samples = surface(0.45)
    whole = light(1.5, **SHAPES[name])
    found = shade(samples, [whole], "reference", workers=1)
    # Both cut the light of a spread's cone, the oracle without knowing its edge.
    for values, brdf in ((found.specular[0], quadrature.ggx), (found.diffuse[0], quadrature.lambert)):
        expected = quadrature.radiance(samples, [whole], brdf, 96)
        assert np.linalg.norm(values - expected) < 2e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("settings", [{}, {"shape": "POLYGON", "corners": DART}], ids=["near", "dart"])
def test_single_precision_is_as_good_as_double(settings):
    samples, whole = surface(0.3), light(1.5 if settings else 0.5, falloff=2, **settings)
    single, double = (shade(samples, [whole], "ltsh4", workers=1, dtype=dtype) for dtype in (np.float32, np.float64))
    for name in ("specular", "diffuse"):
        expected = getattr(double, name)
        # Per unit of radiance, times the falloff at the light's far corner, 4 m away; and few points of the light.
        error = np.abs(getattr(single, name) - expected)
        assert error.max() < 2e-5 * 3.0 * 4.0**2 + 0.003 * expected.max()


def test_a_quadratic_falloff_is_none():
    assert not light(1.0).has_falloff and light(1.0, falloff=1).has_falloff and light(1.0, smooth=0.1).has_falloff
    with pytest.raises(ValueError, match="falloff is 3"):
        light(1.0, falloff=3)
    with pytest.raises(ValueError, match="smooth is -1"):
        light(1.0, smooth=-1.0)
