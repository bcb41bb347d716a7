"""The reference quadrature against brute force, and its own error estimate."""

from dataclasses import replace

import numpy as np
import polygon_quadrature
import pytest
import surface_scenes
import textbook
from surface_scenes import area_light, single_sample

from ltsh_addon import shading
from ltsh_addon.lobes import brdf
from ltsh_addon.shading.reference import EXACT, EllipseBoundary, PolygonBoundary, lobe_integrals

GAUSS = np.polynomial.legendre.leggauss(160)


def ggx_color(cosine, roughness, light_directions, ior):
    """Textbook GGX times cosine at unit directions (S, 3) for the Fresnel factors 1, (1 - c)^5, c (1 - c)^6,
    dielectric: (4, S)."""
    view = textbook.view_direction(cosine)
    lobe = textbook.ggx_brdf(view, light_directions, roughness**2) * light_directions[:, 2]
    half = view + light_directions
    half_cosine = np.clip((half @ view) / np.linalg.norm(half, axis=1), 0.0, 1.0)
    dielectric = textbook.dielectric_fresnel(half_cosine, ior)
    missing = 1.0 - half_cosine
    return lobe * np.stack([np.ones_like(lobe), missing**5, half_cosine * missing**6, dielectric])


def over_area(cosine, roughness, ior, center, half_u, half_v, round_light):
    """Integrals (3,) over the light's area: f cos cos_l / r^2 dA, Gauss-Legendre, polar for a round light."""
    nodes, weights = GAUSS
    if round_light:
        radius, angle = 0.5 * (nodes + 1.0), 2.0 * np.pi * np.arange(160) / 160
        s, t = np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()
        weight = np.repeat(0.5 * weights * radius, 160) * 2.0 * np.pi / 160
    else:
        s, t = (grid.ravel() for grid in np.meshgrid(nodes, nodes, indexing="ij"))
        weight = np.outer(weights, weights).ravel()
    points = center + s[:, None] * half_u + t[:, None] * half_v
    distance = np.linalg.norm(points, axis=1)
    area = np.cross(half_u, half_v)
    measure = np.abs(points @ area) / distance**3 * weight
    return ggx_color(cosine, roughness, points / distance[:, None], ior) @ measure


def random_lights(seed, count, lowest=0.2):
    """(cos_theta_o, roughness, ior, center, half_u, half_v) of lights that lie above the horizon as a whole."""
    generator = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        center, half_u = generator.normal(size=(2, 3)) + np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        half_v = np.cross(half_u, generator.normal(size=3))
        half_u, half_v = 0.5 * half_u, 0.3 * half_v
        gap = abs(center @ np.cross(half_u, half_v)) / np.linalg.norm(np.cross(half_u, half_v))
        if center[2] > abs(half_u[2]) + abs(half_v[2]) + 0.05 and gap > 0.2:
            cosine, roughness = 0.05 + 0.95 * generator.random(), lowest + (1.0 - lowest) * generator.random()
            found.append((cosine, roughness, 1.1 + 1.5 * generator.random(), center, half_u, half_v))
    return found


def corners(center, half_u, half_v):
    return center + np.array([-half_u - half_v, half_u - half_v, half_u + half_v, half_v - half_u])


def quadrature(light, round_light, **options):
    """`lobe_integrals` of one light: (values (3,), estimate)."""
    cosine, roughness, ior, center, half_u, half_v = light

    def boundary(warp):
        if round_light:
            return EllipseBoundary.warped(warp, center[:, None], half_u[:, None], half_v[:, None])
        return PolygonBoundary.warped(warp, corners(center, half_u, half_v).T[:, :, None])

    setting = np.array([cosine]), np.array([roughness**2]), np.array([ior])
    values, error = lobe_integrals(boundary, setting, **options)
    return values[:, 0], error[0]


@pytest.mark.parametrize(("round_light", "tolerance"), [(False, 1e-4), (True, 1e-4), (False, 1e-7)])
def test_rough_surfaces_match_quadrature_over_the_area(round_light, tolerance):
    for light in random_lights(1, 40):
        expected = over_area(*light, round_light)
        found, estimate = quadrature(light, round_light, effort=replace(EXACT, tolerance=tolerance))
        error = np.abs(found - expected).max()
        assert max(error, estimate) < tolerance * expected[0] + 1e-6, light
        # 1e-9: what 160 Gauss-Legendre nodes leave of the sharpest of these lobes
        assert error <= estimate + 1e-9, light


@pytest.mark.parametrize("lowest, roughness", [(0.02, 0.05), (0.05, 0.2)])
def test_smooth_surfaces_match_adaptive_quadrature(lowest, roughness):
    """Lights around the mirror direction and beside it; the oracle quarters triangles until two orders agree."""
    generator = np.random.default_rng(2)
    for light in random_lights(3, 16):
        cosine, _, ior, center, half_u, half_v = light
        alpha = (lowest + (roughness - lowest) * generator.random()) ** 2
        mirror = textbook.mirror_direction(cosine)
        if generator.random() < 0.6:
            center = 1.5 * mirror + 0.2 * generator.normal(size=3)
            center[2] = abs(center[2]) + 0.05
            half_u, half_v = half_u * np.array([1, 1, 0]), half_v * np.array([1, 1, 0])
        polygon = corners(center, half_u, half_v)
        lobe = brdf_of(cosine, np.sqrt(alpha))
        expected, bound = polygon_quadrature.adaptive_integral(polygon, lobe, mirror, tolerance=1e-10)
        found, estimate = quadrature((cosine, np.sqrt(alpha), ior, center, half_u, half_v), False)
        error = abs(found[0] - abs(expected))
        assert bound < 1e-6
        assert error < 1e-4 * abs(expected) + 1e-6 + bound
        # The difference of two orders is an estimate: for sharp lobes it may fall short, most where it is below 1e-6.
        assert error <= 2.0 * estimate + bound + 1e-6


def test_a_light_over_the_whole_hemisphere_gives_the_directional_albedo():
    """By Gauss-Legendre in height and azimuth, on roughness where that converges."""
    nodes, weights = GAUSS
    z, phi = (grid.ravel() for grid in np.meshgrid(0.5 * (nodes + 1.0), np.pi * (nodes + 1.0), indexing="ij"))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    weight = np.outer(weights, weights).ravel() * 0.5 * np.pi
    for cosine, roughness in [(0.9, 0.6), (0.5, 0.8), (0.25, 1.0)]:
        expected = ggx_color(cosine, roughness, directions, 1.5) @ weight
        light = (cosine, roughness, 1.5, np.array([0, 0, 1e-6]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
        for round_light in (False, True):
            found, _ = quadrature(light, round_light)
            assert found == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("shape", ["RECTANGLE", "ELLIPSE"])
def test_mirrors_see_the_whole_light_or_nothing(shape):
    """Without roughness the reflection is the radiance in the mirror direction times the Fresnel factor."""
    cosine = 0.8
    view, mirror = textbook.view_direction(cosine), textbook.mirror_direction(cosine)
    s, p = textbook.fresnel_amplitudes(cosine, 1.5)
    sample = single_sample(view=view, roughness=0.0, dielectric=1.0, ior=1.5, diffuse_albedo=(0, 0, 0))
    hit = area_light(shape=shape, center=2.0 * mirror)
    missed = area_light(shape=shape, center=2.0 * mirror + np.array([2.0, 0.0, 0.0]))
    reflected = shading.shade(sample, [hit], shading.REFERENCE).specular[0, 0]
    assert reflected == pytest.approx(0.5 * (s + p) * hit.radiance, rel=1e-3)
    assert shading.shade(sample, [missed], shading.REFERENCE).specular.max() < 1e-6


def test_lights_cut_by_the_horizon_match_adaptive_quadrature():
    """Polygons through `shade`, which clips them; ellipses against a fine polygon of the same area."""
    generator = np.random.default_rng(5)
    for cosine in (0.2, 0.5, 0.9):
        view = textbook.view_direction(cosine)
        roughness = 0.15 + 0.8 * generator.random()
        fields = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1), "diffuse_albedo": (0, 0, 0)}
        sample = single_sample(view=view, roughness=roughness, **fields)
        for shape in ("RECTANGLE", "ELLIPSE"):
            light = area_light(
                shape=shape, center=(-1.2, 0.1, 0.2), half_u=(0.0, 0.8, 0.1), half_v=(0.1, 0, 0.5), radiance=(1, 1, 1)
            )
            polygon = light.polygon(2048)
            kept = polygon_quadrature.above_horizon(polygon)
            lobe = brdf_of(cosine, roughness)
            if shape == "ELLIPSE":
                expected = abs(polygon_quadrature.integral(kept, lobe, kept.mean(axis=0), order=24, pieces=1))
            else:
                mirror = textbook.mirror_direction(cosine)
                expected = abs(polygon_quadrature.adaptive_integral(kept, lobe, mirror, tolerance=1e-7)[0])
            shaded = shading.shade(sample, [light], shading.REFERENCE)
            # 2048 corners leave an error of about 1e-6 of the ellipse.
            assert shaded.specular[0, 0, 0] == pytest.approx(expected, rel=1e-4, abs=1e-5), (shape, cosine, roughness)
            assert shaded.quadrature_error[0] < 1e-4 * expected + 1e-6


@pytest.mark.parametrize("center", [(-1.2, 0.1, 0.2), (-1.2, 0.1, -0.2), (0.5, 0.9, 0.0)])
def test_ellipses_cut_by_the_shading_horizon_alone_are_exact(center):
    """The geometric horizon lies lower, so that an ellipse stays an ellipse; the oracle is a fine polygon."""
    view = textbook.view_direction(0.5)
    light = area_light(shape="ELLIPSE", center=center, half_u=(0.0, 0.8, 0.1), half_v=(0.1, 0, 0.5), radiance=(1, 1, 1))
    light = replace(light, direction=-light.direction) if light.direction @ light.center > 0.0 else light
    normal = surface_scenes.unit(np.array([center[0], center[1], 0.3]))
    white = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1), "geometric_normal": normal}
    polygon = light.polygon(2048)
    assert (polygon @ normal).min() > 0.0 > polygon[:, 2].min()
    kept = polygon_quadrature.above_horizon(polygon)
    for roughness in (0.3, 0.7):
        sample = single_sample(view=view, roughness=roughness, **white)
        found = shading.shade(sample, [light], shading.REFERENCE, passes=["specular"]).specular[0, 0, 0]
        lobe = brdf_of(0.5, roughness)
        expected = abs(polygon_quadrature.integral(kept, lobe, kept.mean(axis=0), order=24, pieces=1))
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
        assert found > 1e-4


def brdf_of(cosine, roughness):
    return lambda directions: brdf.ggx_brdf_cosine(cosine, roughness**2, directions)


def test_error_estimates_are_reported_only_by_the_reference():
    samples, lights = surface_scenes.random_samples(20), surface_scenes.four_lights()
    assert shading.shade(samples, lights, "ltc").quadrature_error is None
    assert shading.shade(samples, lights, shading.REFERENCE, passes=["diffuse"]).quadrature_error is None
    error = shading.shade(samples, lights, shading.REFERENCE).quadrature_error
    assert error.shape == (20,) and (error >= 0.0).all() and np.isfinite(error).all()
