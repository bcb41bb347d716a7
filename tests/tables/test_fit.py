"""Coarse fits run, keep the albedo, interpolate well, go on where they were stopped, and write the same bytes again."""

import zipfile

import numpy as np
import pytest

from ltsh_addon.lobes import brdf, spherical_harmonics
from ltsh_addon.lobes.lookup_table import roughness_nodes, theta_nodes
from ltsh_addon.shading import load_table
from tables import fit, refine
from tables.families import BECKMANN, GGX, family_named, polar_samples
from tables.projection import FLAT, Cells, Points, project, relative_error, warped_basis
from tables.validate import hemisphere_samples, validate

SIZE = 8


@pytest.fixture(scope="module")
def coarse():
    """(Fitted, calls of the progress function) of a coarse fit of degree 2."""
    calls = []
    return fit.fit(family_named("ltsh2"), SIZE, progress=calls.append), calls


def test_the_directional_albedo_of_every_node_is_exact(coarse):
    """For F = 1 and for (1 - c)^5, by the quadrature of the validation, which has an error of 2e-3."""
    roughness, theta = roughness_nodes(SIZE)[1:], theta_nodes(SIZE)[:-1]
    albedo = coarse[0].arrays["coefficients"] @ spherical_harmonics.hemisphere_integrals(2)
    for i, alpha in enumerate(roughness**2, start=1):
        cosine = np.cos(theta)
        directions, weights = hemisphere_samples(cosine, np.full(SIZE - 1, alpha))
        lobe = brdf.ggx_brdf_cosine(cosine, np.full(SIZE - 1, alpha), directions) * weights
        half = brdf.half_angle_cosine(cosine, directions)
        assert albedo[i, :-1, 0] == pytest.approx(lobe.sum(axis=1), rel=3e-3)
        schlick = (lobe * brdf.schlick_curve(half)).sum(axis=1)
        assert albedo[i, :-1, 1] == pytest.approx(schlick, rel=6e-3, abs=1e-6)


def test_the_average_albedo_is_the_integral_of_the_directional_one(coarse):
    """The white furnace of a Lambertian sphere of views; trapezoidal rule in mu, good to 1e-3."""
    average = coarse[0].arrays["average_albedo"]
    for i in (2, 5, SIZE - 1):
        cosine = (np.arange(200) + 0.5) / 200
        alpha = np.full(200, roughness_nodes(SIZE)[i] ** 2)
        directions, weights = hemisphere_samples(cosine, alpha)
        lobe = brdf.ggx_brdf_cosine(cosine, alpha, directions) * weights
        assert average[i, 0] == pytest.approx((2.0 * cosine * lobe.sum(axis=1)).mean(), rel=2e-3)
        f82 = brdf.half_angle_cosine(cosine, directions)
        f82 = f82 * (1.0 - f82) ** 6
        assert average[i, 2] == pytest.approx((2.0 * cosine * (lobe * f82).sum(axis=1)).mean(), rel=4e-3)


def test_progress_rises_to_one(coarse):
    calls = coarse[1]
    assert calls == sorted(calls) and calls[-1] == 1.0 and len(calls) == 2 * SIZE - 1 + refine.ITERATIONS + 1


def test_the_written_table_is_readable_and_its_bytes_are_reproducible(coarse, tmp_path):
    fitted, _ = coarse
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    for path in (first, second):
        fit.write_table(path, fitted)
    names = [path.read_bytes().replace(path.stem.encode(), b"") for path in (first, second)]
    assert len(names[0]) > 1000
    fit.write_table(second, fitted)
    assert second.read_bytes().replace(b"second", b"") == names[1]
    with zipfile.ZipFile(first) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.npz", "second.npz"]
    table = load_table(first)
    assert (table.family, table.degree, table.name) == ("ltsh", 2, "first")
    assert np.array_equal(table.coefficients, fitted.arrays["coefficients"])
    assert table.metadata["node_error_mean"] == pytest.approx(fitted.node_errors.mean())


def test_even_a_coarse_fit_is_a_usable_table(coarse, tmp_path):
    """8 x 8 nodes are far apart; 64 x 64 nodes reach 0.037."""
    fit.write_table(tmp_path / "coarse.npz", coarse[0])
    statistics = validate(load_table(tmp_path / "coarse.npz"), count=5)
    assert statistics.mean < 0.06
    # The refinement looks between the nodes: the lookup loses little against coefficients solved at the point.
    assert statistics.mean < 1.35 * statistics.solved_mean


def test_refinement_lowers_the_error_between_the_nodes(coarse):
    """The walk alone, with coefficients solved at the nodes, against the whole fit: quadrature of the validation."""
    family, (roughness, cosine) = family_named("ltsh2"), fit._nodes(SIZE)
    warp = refine.stored_warp(refine.walk(family, GGX, roughness, cosine), roughness, cosine)
    walked = fit.project_nodes(family, GGX, roughness, cosine, warp, FLAT)[0]
    cells = Cells.of(GGX, (SIZE, SIZE), fit.GRAZING_COSINE, FLAT)
    arrays = coarse[0].arrays
    refined = np.concatenate([arrays["warp"], arrays["coefficients"][:, :, 0]], axis=2).astype(float)
    means = []
    for nodes in (np.concatenate([warp, walked[:, :, 0]], axis=2), refined):
        values = cells.interpolate(nodes)
        points = Points.at(GGX, cells.cosine, cells.roughness**2, FLAT, counts=(20, 24))
        entries, tilt = fit._row(family, points, values[:, :3])
        lobes = np.einsum("psk,pk->ps", warped_basis(family, points.directions, entries, tilt), values[:, 3:])
        means.append(np.mean(relative_error(points, lobes)))
    assert means[1] < 0.8 * means[0], means


def test_mirrors_get_the_known_warp_and_no_number_runs_away(coarse):
    """A = B = C = 1 at roughness 0; the targets allow 1e4."""
    arrays = coarse[0].arrays
    assert np.abs(arrays["warp"][0] - 1.0).max() < 1e-3
    assert np.abs(arrays["coefficients"]).max() < 20.0
    assert np.abs(arrays["warp"]).max() < 100.0


def test_at_normal_incidence_lobes_are_round(coarse):
    """A = C, no harmonics with m > 0."""
    arrays = coarse[0].arrays
    warp = arrays["warp"][:, 0].astype(float)
    assert warp[:, 0] == pytest.approx(warp[:, 2], rel=1e-6)
    uneven = [spherical_harmonics.coefficient_index(degree, m) for degree in (1, 2) for m in range(1, degree + 1)]
    assert np.abs(arrays["coefficients"][1:, 0][..., uneven]).max() == 0.0


class Memory:
    """A checkpoint in memory; `stop_after` saves an interruption strikes."""

    def __init__(self, stop_after=None):
        self.arrays, self.left = {}, stop_after

    def load(self):
        return self.arrays

    def save(self, arrays):
        self.arrays = {key: np.array(value) for key, value in arrays.items()}
        if self.left is not None:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt


@pytest.mark.soak
@pytest.mark.parametrize("stop_after", [3, 9])
def test_a_fit_that_was_stopped_goes_on_and_gives_the_same_numbers(stop_after):
    """Stopped during the walk, and during the refinement (5 x 5 nodes: 9 anti-diagonals)."""
    family, memory = family_named("ltsh1"), Memory(stop_after)
    with pytest.raises(KeyboardInterrupt):
        fit.fit(family, 5, checkpoint=memory)
    memory.left = None
    resumed, whole = fit.fit(family, 5, checkpoint=memory), fit.fit(family, 5)
    for key, value in whole.arrays.items():
        assert np.array_equal(resumed.arrays[key], value), key


def test_a_checkpoint_of_other_settings_or_a_broken_one_is_ignored(tmp_path):
    path = tmp_path / "fit.progress"
    fit.Checkpoint(path, {"size": 5}).save({"nodes": np.arange(3.0)})
    assert fit.Checkpoint(path, {"size": 5}).load()["nodes"].tolist() == [0.0, 1.0, 2.0]
    assert fit.Checkpoint(path, {"size": 6}).load() == {}
    path.write_bytes(path.read_bytes()[:40])
    assert fit.Checkpoint(path, {"size": 5}).load() == {}
    assert fit.Checkpoint(tmp_path / "none", {}).load() == {}


@pytest.mark.soak
def test_rounding_to_float32_changes_no_figure(coarse, tmp_path):
    """The stored numbers are of order 1 to 100: their rounding moves errors by no more than 1e-5."""
    fitted, _ = coarse
    fit.write_table(tmp_path / "rounded.npz", fitted)
    table = load_table(tmp_path / "rounded.npz")
    nudged = {key: getattr(table, key).astype(np.float64) * (1.0 + 2.0**-24) for key in ("warp", "coefficients")}
    other = type(table)(**{**{k: getattr(table, k) for k in table.__dataclass_fields__}, **nudged})
    first, second = validate(table, count=4), validate(other, count=4)
    for key, value in first.to_dict().items():
        assert getattr(second, key) == pytest.approx(value, abs=1e-5), key


@pytest.mark.soak
def test_other_brdfs_can_be_fitted(tmp_path):
    """Beckmann, in two functions: its coarse table approximates Beckmann, and not GGX."""
    fitted = fit.fit(family_named("ltsh2"), 6, model=BECKMANN)
    fit.write_table(tmp_path / "beckmann.npz", fitted)
    table = load_table(tmp_path / "beckmann.npz")
    assert "Beckmann" in table.metadata["brdf"]
    cosine, roughness = np.array([0.9, 0.7, 0.5]), np.array([0.5, 0.7, 0.9])
    directions, weights = hemisphere_samples(cosine, roughness**2)
    from ltsh_addon.shading import evaluate_lobe

    lobe = evaluate_lobe(table, cosine, roughness, directions)
    errors = []
    for model in (BECKMANN, GGX):
        exact = model.value(cosine, roughness**2, directions)
        errors.append(np.sqrt((weights * (lobe - exact) ** 2).sum(axis=1) / (weights * exact**2).sum(axis=1)))
    assert (errors[0] < 0.12).all() and (errors[1] > 2.0 * errors[0]).all(), errors


def test_the_beckmann_brdf_is_reciprocal_and_conserves_energy():
    """f cos_i / cos_i is symmetric; its albedo is below 1, and close to 1 where the surface is smooth."""
    generator = np.random.default_rng(5)
    first, second = np.abs(generator.normal(size=(2, 200, 3)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    alpha = generator.uniform(0.05, 1.0, 200)

    def value(view, light):
        # Rotate about z so that the view has y = 0.
        azimuth = np.arctan2(view[:, 1], view[:, 0])
        x = np.cos(azimuth) * light[:, 0] + np.sin(azimuth) * light[:, 1]
        y = np.cos(azimuth) * light[:, 1] - np.sin(azimuth) * light[:, 0]
        turned = np.stack([x, y, light[:, 2]], axis=-1)[:, None]
        return BECKMANN.value(view[:, 2], alpha, turned)[:, 0] / light[:, 2]

    assert value(first, second) == pytest.approx(value(second, first), rel=1e-9)
    cosine = np.array([1.0, 0.6, 0.3])
    directions, weights = hemisphere_samples(cosine, np.full(3, 0.04))
    albedo = (weights * BECKMANN.value(cosine, np.full(3, 0.04), directions)).sum(axis=1)
    assert (albedo < 1.003).all() and (albedo > 0.99).all()


@pytest.mark.parametrize("name", ["ltc", "ltsh2", "ltsh4", "ltsh4c", "ltsh2+ltsh1", "ridges4", "zonal3", "odd4"])
def test_basis_albedo_is_the_integral_of_the_basis(name):
    """By the validation's quadrature on the original domain; a clamped cosine may be tilted, a second lobe warped."""
    family = family_named(name)
    tilt = np.array([0.0, 0.4, -0.9]) if family.kind == "ltc" else np.zeros(3)
    if family.second is not None:
        tilt = np.array([[0.0, 0.0, 0.0], [0.4, -0.5, -0.3], [-0.5, 0.8, 0.3]])
    directions, weights = hemisphere_samples(np.full(3, 0.6), np.full(3, 0.8))
    integrals = np.einsum("psk,ps->pk", family.basis(directions, tilt), weights)
    mirrored = directions * np.array([1.0, -1.0, 1.0])
    integrals = 0.5 * (integrals + np.einsum("psk,ps->pk", family.basis(mirrored, tilt), weights))
    assert np.abs(integrals - family.basis_albedo(tilt)).max() < 3e-3


@pytest.mark.parametrize("name, powers", [("ridges3", 7), ("zonal4", 5), ("odd4", 6)])
def test_restricted_families_are_monomials_in_the_stored_basis(name, powers):
    """x^p z^q itself, at points that the construction did not use."""
    family = family_named(name)
    assert family.size == powers
    directions = hemisphere_samples(np.array([0.4]), np.array([0.5]))[0][0][::50]
    expected = np.stack([directions[:, 0] ** p * directions[:, 2] ** q for p, q in family.powers], axis=-1)
    assert np.abs(family.basis(directions[None], np.zeros(1))[0] - expected).max() < 1e-12


@pytest.mark.parametrize("name", ["ltsh9", "ltsh0", "lts", "ridges", "LTC", ""])
def test_an_unknown_family_is_named(name):
    with pytest.raises(ValueError, match=f"table '{name}' is unknown, expected ltc"):
        family_named(name)


def test_coefficients_at_a_point_are_the_constrained_optimum():
    """No other coefficients with the same albedo have a smaller error: perturbations along the constraint."""
    family = family_named("ltsh3")
    points = Points.at(GGX, np.array([0.5]), np.array([0.3]), FLAT)
    entries = tuple(np.array([value]) for value in (0.6, 0.4, 1.1, 0.6))
    found = project(family, points, entries, np.zeros(1))[0][:, 0]
    basis = warped_basis(family, points.directions, entries, np.zeros(1))
    row = family.basis_albedo(np.zeros(1))
    assert (row * found).sum() == pytest.approx(points.albedo[0, 0], rel=1e-9)
    least = relative_error(points, np.einsum("psk,pk->ps", basis, found))[0]
    generator = np.random.default_rng(6)
    for _ in range(20):
        step = generator.normal(size=found.shape) * 1e-2
        step -= row * (row * step).sum() / (row * row).sum()
        assert relative_error(points, np.einsum("psk,pk->ps", basis, found + step))[0] > least


COSINE = np.array([1.0, 0.7, 0.4, 0.2, 0.05])
ALPHA = np.array([0.3, 0.04, 1.0, 0.36, 0.1])
# Relative errors: the fit's rule is Gauss-Legendre along rays; the other one mixes two sets, midpoint in azimuth.
RULES = [(polar_samples, 3e-4), (hemisphere_samples, 3e-3)]

rules = pytest.mark.parametrize("rule, tolerance", RULES, ids=["fit", "validation"])


@rules
def test_moments_of_the_hemisphere(rule, tolerance):
    directions, weights = rule(COSINE, ALPHA)
    x, y, z = np.moveaxis(directions, -1, 0)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1.0, abs=1e-12)
    assert (weights >= 0.0).all() and y.min() >= 0.0 and z[weights > 0.0].min() >= 0.0
    for values, exact in [(1.0, 2.0 * np.pi), (z, np.pi), (z * z, 2.0 * np.pi / 3.0), (x * x, 2.0 * np.pi / 3.0)]:
        assert (weights * values).sum(axis=1) == pytest.approx(exact, rel=tolerance)


@rules
def test_directional_albedo_of_ggx(rule, tolerance):
    """Against a tensor rule that knows nothing of the lobe, on surfaces rough enough for it."""
    nodes, node_weights = np.polynomial.legendre.leggauss(300)
    z, phi = (grid.ravel() for grid in np.meshgrid(0.5 * (nodes + 1.0), 0.5 * np.pi * (nodes + 1.0), indexing="ij"))
    radius = np.sqrt(1.0 - z * z)
    tensor = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    tensor_weights = np.outer(node_weights, node_weights).ravel() * 0.5 * np.pi
    cosine, alpha = np.array([1.0, 0.7, 0.4, 0.2]), np.array([0.3, 0.2, 1.0, 0.36])
    directions, weights = rule(cosine, alpha)
    found = (weights * brdf.ggx_brdf_cosine(cosine, alpha, directions)).sum(axis=1)
    expected = [brdf.ggx_brdf_cosine(mu, a, tensor) @ tensor_weights for mu, a in zip(cosine, alpha, strict=True)]
    assert found == pytest.approx(expected, rel=tolerance)


def test_the_fit_sees_needles_under_the_view():
    """A lobe that wraps around to a needle at the horizon below the view direction: against ten times the points."""
    cosine, alpha = np.array([np.cos(np.radians(86.4))]), np.array([0.06])
    norms = []
    for counts in [(28, 28), (90, 120)]:
        directions, weights = polar_samples(cosine, alpha, *counts)
        x, y, z = np.moveaxis(directions, -1, 0)
        needle = np.exp(-((y / 0.05) ** 2) - (z / 0.03) ** 2) * (x > 0.0)
        norms.append((weights * needle**2).sum())
    assert norms[0] == pytest.approx(norms[1], rel=0.02)


def test_sharp_lobes_are_integrated_too():
    """Both rules, from roughness 0.03 on; smooth surfaces seen from above reflect nearly everything."""
    cosine, alpha = np.array([0.9, 0.5, 0.3]), np.array([1e-3, 1e-3, 3e-3])
    albedos = []
    for rule, _ in RULES:
        directions, weights = rule(cosine, alpha)
        albedos.append((weights * brdf.ggx_brdf_cosine(cosine, alpha, directions)).sum(axis=1))
    assert albedos[0] == pytest.approx(albedos[1], rel=3e-3)
    assert albedos[0] == pytest.approx(1.0, abs=3e-3)
