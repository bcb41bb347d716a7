"""The weights of lobes against independent numerics; no Blender is needed here."""

import numpy as np
import pytest
import textbook

from ltsh_addon.cycles import closures, lobes
from ltsh_addon.cycles.closures import glass_albedos
from ltsh_addon.cycles.lobes import LOBE_KINDS, SurfaceHits

NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)
COSINES, COSINE_WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS
COLOR = np.array([[0.9, 0.5, 0.1]])
TINT = np.array([[0.8, 0.3, 1.0]])


def hemisphere(count=200):
    """Directions (N, 3) of the upper hemisphere and their solid angle (N,): midpoints in angle, so dense at grazing."""
    theta = (np.arange(count) + 0.5) / count * np.pi / 2.0
    phi = (np.arange(2 * count) + 0.5) / count * np.pi
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi))
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return directions, np.sin(theta) * (np.pi / 2.0 / count) * (np.pi / count)


def reflected_share(cosine, alpha, fresnel):
    """Albedo of GGX seen under `cosine`, `fresnel(c)` its reflectance over the cosine of the half angle."""
    directions, area = hemisphere()
    view = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
    half = directions + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    values = textbook.ggx_of_cosines(half[:, 2], directions[:, 2], cosine, alpha) * directions[:, 2]
    return float(np.sum(values * fresnel(half @ view) * area))


def transmitted_share(cosine, alpha, ior):
    """Refracted albedo (Walter et al. 2007, eq. 21), with height-correlated masking."""
    directions, area = hemisphere()
    directions = directions * (1.0, 1.0, -1.0)
    view = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
    half = -(view + ior * directions)
    length2 = np.sum(half**2, axis=-1)
    half /= np.sqrt(length2)[:, None]
    entering, leaving = half @ view, -np.sum(half * directions, axis=-1)
    valid = (half[:, 2] > 0.0) & (entering > 0.0) & (leaving > 0.0)
    masking = 1.0 / (1.0 + textbook.smith_lambda(cosine, alpha) + textbook.smith_lambda(directions[:, 2], alpha))
    values = ior**2 * entering * leaving / length2 * textbook.ggx_distribution(half[:, 2], alpha) * masking / cosine
    passed = 1.0 - textbook.dielectric_fresnel(np.where(valid, entering, 1.0), ior)
    return float(np.sum(np.where(valid, values * passed, 0.0) * area))


def test_a_tinted_metal_has_its_tint_where_the_model_says():
    dip = closures.f82_term(COLOR, TINT)
    cosine = 1.0 / 7.0
    schlick = COLOR + (1.0 - COLOR) * (1.0 - cosine) ** 5
    assert np.allclose(schlick - dip * cosine * (1.0 - cosine) ** 6, schlick * TINT, rtol=1e-12)
    c = COSINES[:, None]
    curve = COLOR + (1.0 - COLOR) * (1.0 - c) ** 5 - dip * c * (1.0 - c) ** 6
    mean = np.sum(2.0 * c * curve * COSINE_WEIGHTS[:, None], axis=0)
    assert np.allclose(closures.metal_average(COLOR, dip), mean, rtol=1e-12)


@pytest.mark.parametrize("ior", [0.7, 1.05, 1.5, 2.5])
def test_a_tinted_dielectric_is_a_sum_of_the_curves_of_samples(ior):
    f0 = 0.5 * closures.f0_of_ior(np.array([ior]))[:, None] * TINT
    low, high, dip, dielectric = closures.dielectric_terms(f0, np.array([ior]))
    fresnel = textbook.dielectric_fresnel(COSINES[:, None], ior)
    plain = ((ior - 1.0) / (ior + 1.0)) ** 2
    share = (fresnel - plain) / (1.0 - plain)
    assert np.array_equal(low, high) and not dip.any()
    assert np.allclose(low + dielectric * fresnel, f0 * (1.0 - share) + share, atol=1e-14)


def test_the_specular_level_scales_the_reflectance_at_normal_incidence():
    ior, f0 = closures.specular_level_applied(np.array([1.5, 1.5, 0.7, 1.5]), np.array([0.5, 1.0, 1.0, 0.0]))
    base = np.square([0.2, 0.2, 0.3 / 1.7, 0.2])
    assert np.allclose(f0, base * [1.0, 2.0, 2.0, 0.0], rtol=1e-12)
    assert np.allclose(closures.f0_of_ior(ior), f0, rtol=1e-12) and ior[2] < 1.0 and ior[3] == 1.0


@pytest.mark.parametrize("ior", [1.1, 1.5, 2.0, 3.0])
def test_the_fit_of_the_mean_reflectance_is_near_the_integral(ior):
    mean = np.sum(2.0 * COSINES * textbook.dielectric_fresnel(COSINES, ior) * COSINE_WEIGHTS)
    # What Kulla and Conty's fit, which Cycles uses, is good for.
    assert abs(closures.dielectric_average(np.array([ior]))[0] - mean) < 7e-3


@pytest.mark.parametrize("mean", [0.0, 0.8, 1.0])
def test_multiple_scattering_sums_its_bounces(mean):
    """What leaves after 2, 3, ... bounces, each reflecting F and keeping 1 - Ea of the light inside: white loses
    nothing, black gains nothing."""
    albedo, average = 0.6, 0.7
    inside, leaving = (1.0 - albedo) * mean, 0.0
    for _ in range(200):
        leaving += inside * average
        inside *= (1.0 - average) * mean
    factor = closures.multiple_scattering(np.full((1, 3), mean), np.array([albedo]), np.array([average]))
    assert np.allclose(factor, 1.0 + leaving / albedo, rtol=1e-12)


@pytest.mark.parametrize("row, column", [(31, 31), (31, 8), (20, 10), (12, 25)])
def test_albedos_are_right_at_the_nodes_of_the_table(row, column):
    roughness, cosine = row / 31.0, column / 31.0
    albedo, average = closures.albedos(np.array([roughness]), np.array([cosine]))
    # The shipped lookup table is fitted to 0.1 %.
    assert abs(albedo[0] - reflected_share(cosine, roughness**2, np.ones_like)) < 2e-3
    views = [reflected_share(c, roughness**2, np.ones_like) for c in COSINES[::8]]
    mean = np.average(views, weights=COSINES[::8] * COSINE_WEIGHTS[::8])
    assert abs(average[0] - mean) < 1e-2  # 8 of 64 nodes


def test_a_dielectric_layer_takes_its_albedo_away():
    roughness, cosine, coordinate = 9.0 / 15.0, 6.0 / 15.0, 7.0 / 15.0
    ior = (1.0 + coordinate**2) / (1.0 - coordinate**2)
    f0 = np.full((1, 3), closures.f0_of_ior(ior))
    found = closures.dielectric_albedo(f0, np.array([ior]), np.array([roughness]), np.array([cosine]))
    whole = reflected_share(cosine, roughness**2, np.ones_like)
    reflected = reflected_share(cosine, roughness**2, lambda c: textbook.dielectric_fresnel(c, ior))
    assert np.allclose(found, reflected / whole, atol=2e-3)  # as the lookup table


def test_a_conductor_without_extinction_is_a_dielectric():
    index, c = np.array([1.5, 2.0, 3.0]), COSINES[:, None]
    found = closures.conductor_reflectance(c, index, np.zeros(3))
    assert np.allclose(found, textbook.dielectric_fresnel(c, index), atol=1e-9)


METALS = {
    "gold": ((0.18, 0.42, 1.37), (3.42, 2.35, 1.77)),
    "silver": ((0.05, 0.06, 0.05), (4.0, 3.0, 2.3)),
    "titanium": ((2.76, 2.51, 2.23), (3.87, 3.40, 3.01)),
    "aluminum": ((1.5, 0.98, 0.6), (7.8, 6.6, 5.4)),
}


@pytest.mark.parametrize("metal", METALS)
def test_metals_are_fitted_where_they_are_seen(metal):
    index, extinction = (np.array([value]) for value in METALS[metal])
    low, high, dip, dielectric = closures.conductor_fit(index, extinction, exact=True)
    c = COSINES[:, None]
    curve = low + (high - low) * (1.0 - c) ** 5 - dip * c * (1.0 - c) ** 6
    curve = curve + dielectric * textbook.dielectric_fresnel(c, closures.CONDUCTOR_FIT_IOR)
    error = np.abs(curve - closures.conductor_reflectance(c, index, extinction))
    # Measured: 0.004 for half angles below 72 degrees; the rest of the curve is steep.
    assert error[COSINES > 0.3].max() < 6e-3 and error.max() < 0.08


@pytest.mark.parametrize("inside", [False, True])
def test_glass_scatters_what_it_reflects_and_refracts(inside):
    node, view, column = 9, 8, 7
    coordinate = column / 15.0
    ior = (1.0 + coordinate**2) / (1.0 - coordinate**2)
    ior = 1.0 / ior if inside else ior
    alpha, cosine = (node / 15.0) ** 2, view / 15.0

    def fresnel(c):
        if not inside:
            return textbook.dielectric_fresnel(c, ior)
        critical = np.sqrt(1.0 - ior**2)
        return np.where(c > critical, textbook.dielectric_fresnel(np.maximum(c, critical), ior), 1.0)

    reflected = reflected_share(cosine, alpha, fresnel)
    expected = reflected + (0.0 if inside else transmitted_share(cosine, alpha, ior))
    albedo = glass_albedos(inside)[0]
    found = albedo[node, view, column]
    if inside:
        assert reflected < found <= 1.0
    else:
        # 576 normals per node leave a few thousandths.
        assert abs(found - expected) < 4e-3
    smooth = albedo[0, 1:, :8]
    assert np.all(smooth > 0.99) and np.all(smooth < 1.0 + 1e-9)


def test_the_diffuse_albedo_of_a_hit_is_split_and_kept():
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    albedo = np.array([[0.6, 0.3, 0.1], [0.2, 0.2, 0.2], [0.5, 0.0, 0.1]])
    hits = SurfaceHits(np.zeros((3, 3)), up, up, up, np.ones(3, bool), np.zeros(3, int), albedo)
    slots = [
        {"kind": np.full(3, LOBE_KINDS["diffuse"]), "color": np.full((3, 3), 0.5), "weight": np.array([0.2, 0.2, 0.0])},
        {"kind": np.full(3, LOBE_KINDS["glossy"]), "color": np.ones((3, 3)), "roughness": np.full(3, 0.3)},
        {"kind": np.full(3, LOBE_KINDS["diffuse"]), "color": np.full((3, 3), 0.5), "weight": np.array([0.6, 0.0, 0.0])},
    ]
    samples, index = lobes.samples_of_lobes(hits, slots)
    assert np.array_equal(index, [0, 0, 0, 1, 1, 2])
    assert np.allclose(samples.diffuse_albedo[[0, 2]], albedo[0] * [[0.25], [0.75]])
    assert np.allclose(samples.diffuse_albedo[3], albedo[1]) and not samples.diffuse_albedo[[1, 4]].any()
    # Nobody expects diffuse light at the last hit: its first sample takes what Cycles says.
    assert np.allclose(samples.diffuse_albedo[5], albedo[2]) and np.allclose(samples.specular_f0[5], 1.0)
