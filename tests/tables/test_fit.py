"""A coarse fit runs, keeps the albedo, and writes the same bytes again."""

import zipfile

import numpy as np
import pytest

from ltsh_addon.shading import brdf, load_table, spherical_harmonics
from ltsh_addon.shading.lookup_table import roughness_nodes, theta_nodes
from tables import fit
from tables.validate import hemisphere_samples, validate

SIZE = 8


@pytest.fixture(scope="module")
def coarse():
    """(arrays, node errors, calls of the progress function) of a coarse fit of degree 2."""
    calls = []
    arrays, errors = fit.fit(fit.FAMILIES["ltsh2"], SIZE, progress=calls.append)
    return arrays, errors, calls


def test_the_directional_albedo_of_every_node_is_exact(coarse):
    """For F = 1 and for (1 - c)^5, by the quadrature of the validation, which has an error of 2e-3."""
    arrays, _, _ = coarse
    roughness, theta = roughness_nodes(SIZE)[1:], theta_nodes(SIZE)[:-1]
    albedo = arrays["coefficients"] @ spherical_harmonics.hemisphere_integrals(2)
    for i, alpha in enumerate(roughness**2, start=1):
        cosine = np.cos(theta)
        directions, weights = hemisphere_samples(cosine, np.full(SIZE - 1, alpha))
        lobe = brdf.ggx_brdf_cosine(cosine, np.full(SIZE - 1, alpha), directions) * weights
        half = brdf.half_angle_cosine(cosine, directions)
        assert albedo[i, :-1, 0] == pytest.approx(lobe.sum(axis=1), rel=3e-3)
        schlick = (lobe * brdf.schlick_curve(half)).sum(axis=1)
        assert albedo[i, :-1, 1] == pytest.approx(schlick, rel=6e-3, abs=1e-6)


def test_progress_rises_to_one(coarse):
    _, _, calls = coarse
    assert calls == sorted(calls) and calls[-1] == 1.0 and len(calls) == 2 * SIZE - 1


def test_the_written_table_is_readable_and_its_bytes_are_reproducible(coarse, tmp_path):
    arrays, errors, _ = coarse
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    for path in (first, second):
        fit.write_table(path, fit.FAMILIES["ltsh2"], arrays, errors)
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.npz", "second.npz"]
    table = load_table(first)
    assert (table.family, table.degree, table.name) == ("ltsh", 2, "ltsh2")
    assert np.array_equal(table.coefficients, arrays["coefficients"])
    assert table.metadata["node_error_mean"] == pytest.approx(errors.mean())


def test_even_a_coarse_fit_is_a_usable_table(coarse, tmp_path):
    """8 x 8 nodes are far apart: twice the error of 64 x 64 nodes (0.036), no more than a tenth of the lobe."""
    arrays, errors, _ = coarse
    fit.write_table(tmp_path / "coarse.npz", fit.FAMILIES["ltsh2"], arrays, errors)
    assert validate(load_table(tmp_path / "coarse.npz"), count=5).mean < 0.1


def test_mirrors_get_the_known_warp_and_no_coefficient_runs_away(coarse):
    """A = B = C = 1 at roughness 0; lobes of albedo 1 need no coefficients above a few units."""
    arrays, _, _ = coarse
    assert np.abs(arrays["warp"][0] - 1.0).max() < 1e-3
    assert np.abs(arrays["coefficients"]).max() < 10.0


def test_at_normal_incidence_lobes_are_round(coarse):
    """Isotropic: A = C up to the regularization, no harmonics with m > 0."""
    arrays, _, _ = coarse
    roughness = roughness_nodes(SIZE)
    warp = arrays["warp"][1:, 0].astype(float)
    g_squared = 1.0 + roughness[1:] ** 4 / 4.0
    assert warp[:, 0] * g_squared == pytest.approx(warp[:, 2], rel=1e-6)
    coefficients = arrays["coefficients"][1:, 0, 0]
    uneven = [spherical_harmonics.coefficient_index(degree, m) for degree in (1, 2) for m in range(1, degree + 1)]
    assert np.abs(coefficients[:, uneven]).max() < 1e-3 * np.abs(coefficients).max()


@pytest.mark.parametrize("name", fit.FAMILIES)
def test_basis_albedo_is_the_integral_of_the_basis(name):
    """By the validation's quadrature on the original domain; a clamped cosine may be tilted."""
    family = fit.FAMILIES[name]
    tilt = np.array([0.0, 0.4, -0.9]) if family.kind == "ltc" else np.zeros(3)
    directions, weights = hemisphere_samples(np.full(3, 0.6), np.full(3, 0.8))
    integrals = np.einsum("kps,ps->pk", family.basis(directions, tilt), weights)
    mirrored = directions * np.array([1.0, -1.0, 1.0])
    integrals = 0.5 * (integrals + np.einsum("kps,ps->pk", family.basis(mirrored, tilt), weights))
    assert np.abs(integrals - family.basis_albedo(tilt)).max() < 3e-3
