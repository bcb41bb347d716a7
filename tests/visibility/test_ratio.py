"""Shares of lights, by tracers whose answers are known: nothing in the way, a wall, a half-plane, a sphere."""

import dataclasses

import numpy as np
import pytest
import random_surfaces

from ltsh_addon import shading
from ltsh_addon.scene import PASSES, AreaLight, Film, SurfaceSamples
from ltsh_addon.visibility import ratio

KINDS = [*((surface, "plain") for surface in random_surfaces.SURFACES)] + [
    ("plain", light) for light in (*random_surfaces.LIGHTS[1:], *random_surfaces.PROFILED_LIGHTS)
]


class Tracer:
    """Rays with a function of origins, directions (R, 3) and distances (R,) for the light that they let through."""

    def __init__(self, passed=lambda origins, directions, distances: np.ones(len(origins))):
        self.passed, self.rays = passed, 0

    library = None

    def mask_of(self, name):
        return 0xFFFFFFFF

    def starts(self, samples):
        self.position = samples.position
        return self

    def aimed(self, index, directions, distances):
        origins = np.broadcast_to(self.position[index].T[:, None], directions.shape)
        return origins.astype(np.float32), directions, distances

    def transmittance(self, origins, directions, distances, masks):
        self.rays += len(origins)
        assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-5)
        return self.passed(origins, directions, distances).astype(np.float32)


OPEN, WALL = Tracer(), Tracer(lambda origins, directions, distances: np.zeros(len(origins)))


def past_spheres(*spheres):
    """A tracer for opaque spheres (center, radius)."""

    def passed(origins, directions, distances):
        free = np.ones(len(origins), bool)
        for center, radius in spheres:
            offset = origins - np.asarray(center)
            along = (offset * directions).sum(axis=1)
            root = along**2 - (offset**2).sum(axis=1) + radius**2
            near = -along - np.sqrt(np.maximum(root, 0.0))
            free &= (root <= 0.0) | (near <= 0.0) | (near >= distances)
        return free

    return Tracer(passed)


def floor(side, roughness=0.3):
    """side^2 samples of the floor from -2 to 2 m, with a diffuse and a specular lobe, and their film."""
    y, x = (np.mgrid[0:side, 0:side].reshape(2, -1) + 0.5) / side * 4.0 - 2.0
    position = np.stack([x, y, np.zeros_like(x)], axis=1)
    view = random_surfaces.unit(np.array([0.0, -6.0, 3.0]) - position)
    count = len(position)
    gray = np.full((count, 3), 0.5)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (count, 3))
    samples = SurfaceSamples(
        position, view, up, up, np.full(count, roughness), gray, gray, np.zeros(count), np.full(count, 1.5), gray
    )
    return samples, Film(side, side, np.arange(count))


def panel(**changes):
    """A light of 2 x 1.4 m that stands at the end of the floor."""
    direction = np.array([0.0, -np.cos(0.3), -np.sin(0.3)])
    half_u = np.array([1.0, 0.0, 0.0])
    values = {
        "name": "Panel", "shape": "RECTANGLE", "center": np.array([0.0, 3.0, 1.5]), "half_u": half_u,
        "half_v": 0.7 * np.cross(direction, half_u), "direction": direction, "radiance": np.ones(3),
    }  # fmt: skip
    return AreaLight(**{**values, **changes})


@pytest.mark.parametrize(("surface", "kind"), KINDS)
def test_weights_are_the_light_that_is_reflected(surface, kind):
    """Without occluders the mean of the weights is what the quadrature integrates, whatever the surface and light."""
    random = np.random.default_rng(5)
    samples = random_surfaces.samples(surface, 24, random)
    lights = [random_surfaces.light(kind, number, random) for number in range(4)]
    found = ratio.visible_shares(samples, lights, OPEN, rays=8)
    for name in PASSES:
        assert (getattr(found, name) == 1.0).all()
    for light in lights:
        expected = shading.shade(samples, [light], "reference", dtype=np.float64, workers=1)
        pairs = with_all_rays(samples, light, OPEN)
        # `shade` takes the shadowing of bump maps at one direction.
        for name in PASSES if surface != "tilted" else ("specular",):
            radiance = pairs.unshadowed(name)
            # The rays weigh by the mean color, as far as the light's own color is the same for all of a light.
            color = light.radiance.mean() / light.radiance
            whole = (getattr(expected, name)[0] * color).mean(axis=1)
            lit = whole[pairs.index]
            outside = np.setdiff1d(np.arange(len(samples)), pairs.index)
            assert np.abs(whole[outside]).max(initial=0.0) <= 1e-9 * max(whole.max(), 1e-30)
            # 1024 points in two or three strata each; a tenth of the pairs see a sliver of the light.
            error = np.abs(radiance - lit) / np.maximum(lit, 1e-3 * max(whole.max(), 1e-30))
            bad = np.count_nonzero(error > 0.03)
            assert bad <= 0.1 * len(error) + 1, (light.name, name, np.sort(error)[-5:])


def test_behind_a_wall_nothing_is_left():
    random = np.random.default_rng(6)
    for surface, kind in KINDS:
        samples = random_surfaces.samples(surface, 50, random)
        lights = [random_surfaces.light(kind, number, random) for number in range(2)]
        found = ratio.visible_shares(samples, lights, WALL)
        for name in PASSES:
            light = np.stack(
                [getattr(shading.shade(samples, [light], "ltsh4", workers=1), name)[0] for light in lights]
            )
            share = getattr(found, name)
            assert ((share == 0.0) | (share == 1.0)).all()
            assert (light[share == 1.0] <= 1e-6 * light.max()).all(), (surface, kind, name)


def brute_force(samples, light, passed, side):
    """Shares (P,) by pass: midpoints of side^2 cells of a rectangle, formulas in double precision."""
    place = (np.arange(side) + 0.5) / side * 2.0 - 1.0
    s, t = (grid.ravel()[:, None] for grid in np.meshgrid(place, place))
    points = light.center + s * light.half_u + t * light.half_v
    shares = {name: [] for name in PASSES}
    for number in range(len(samples)):
        one = samples.take(slice(number, number + 1))
        offset = points - one.position
        distance = np.linalg.norm(offset, axis=1)
        towards = offset / distance[:, None]
        measure = np.maximum(-(towards @ light.direction), 0.0) / distance**2
        if light.is_round:
            measure *= (s * s + t * t <= 1.0)[:, 0]
        seen = passed(np.broadcast_to(one.position, towards.shape), towards, distance)
        normal, view = one.normal[0], one.view[0]
        half = random_surfaces.unit(towards + view)
        alpha, cosine, cosine_o = one.roughness[0] ** 2, np.maximum(towards @ normal, 1e-9), view @ normal
        lobe = textbook_ggx(half @ normal, cosine, cosine_o, alpha) * cosine
        f0, f90 = one.specular_f0.mean(), one.specular_f90.mean()
        lobe *= f0 + (f90 - f0) * (1.0 - (half * view).sum(axis=1)) ** 5
        lobe *= (towards @ normal > 0.0) & (towards @ one.geometric_normal[0] > 0.0)
        above = np.maximum(towards @ one.smooth_normal[0], 0.0)
        tangent2 = 1.0 / np.maximum(above, 1e-9) ** 2 - 1.0
        open_lobe = np.maximum(towards @ one.diffuse_normal[0], 0.0) * (above > 0.0)
        open_lobe *= 2.0 / (1.0 + np.sqrt(1.0 + one.bump_alpha2 * tangent2))
        for name, values in (("specular", lobe), ("diffuse", open_lobe)):
            whole = (values * measure).sum()
            shares[name].append((values * measure * seen).sum() / whole if whole > 0.0 else 1.0)
    return {name: np.array(values) for name, values in shares.items()}


def textbook_ggx(cosine_h, cosine_i, cosine_o, alpha):
    """The BRDF with F = 1 in sr^-1 (Walter et al. 2007, eq. 33; Heitz 2014, eq. 99)."""
    tangents = [1.0 / cosine**2 - 1.0 for cosine in (cosine_h, cosine_i, cosine_o)]
    distribution = alpha**2 / (np.pi * cosine_h**4 * (alpha**2 + tangents[0]) ** 2)
    masking = 1.0 / (1.0 + sum(0.5 * (np.sqrt(1.0 + alpha**2 * tangent) - 1.0) for tangent in tangents[1:]))
    return distribution * masking / (4.0 * cosine_i * cosine_o)


def with_all_rays(samples, light, tracer):
    """The pairs of a light after as many rays as there can be, for each."""
    pairs = ratio.Pairs(ratio.Surface(samples, PASSES, tracer), light)
    pairs._add_rays(np.arange(len(pairs.index)), 0, ratio.MOST_RAYS, 0)
    return pairs


@pytest.mark.parametrize("roughness", (0.15, 0.5))
@pytest.mark.parametrize("shape", ("RECTANGLE", "ELLIPSE"))
def test_shares_are_those_of_a_quadrature_over_the_light(shape, roughness):
    samples, _ = floor(12, roughness)
    light, tracer = panel(shape=shape), past_spheres(((0.0, 1.0, 0.5), 0.5), ((-1.2, -0.5, 0.3), 0.3))
    expected = brute_force(samples, light, tracer.passed, 150)
    pairs = with_all_rays(samples, light, tracer)
    for name, limit in (("specular", 0.012), ("diffuse", 0.006)):
        error = pairs.found(name)[0] - expected[name][pairs.index]
        # Stratified, 1024 rays are off by about 1024^-0.75 = 0.6 % of one; half as many for a sharp lobe.
        assert np.sqrt(np.square(error).mean()) < limit, name
        assert abs(error.mean()) < 0.25 * limit, name


def test_bump_mapped_lobes_have_the_shares_of_a_quadrature():
    random = np.random.default_rng(8)
    samples = random_surfaces.samples("tilted", 150, random)
    light, tracer = panel(center=np.array([0.5, 1.0, 1.5])), past_spheres(((0.0, 0.0, 0.8), 0.4))
    gray = np.full((150, 3), 0.5)
    values = {"specular_f0": gray, "specular_f90": gray, "dielectric": 0.0 * gray, "specular_dip": 0.0 * gray}
    samples = dataclasses.replace(samples, **values)
    expected = brute_force(samples, light, tracer.passed, 150)
    pairs = with_all_rays(samples, light, tracer)
    for name in PASSES:
        error = np.abs(pairs.found(name)[0] - expected[name][pairs.index])[pairs.visible & pairs.blocked]
        assert len(error) > 30 and np.median(error) < 0.01 and np.quantile(error, 0.9) < 0.04, name
