"""Sheen in the pack: its splines beside the table of Cycles, and its code beside quadratures."""

import header_harness
import numpy as np
import polygon_quadrature
import pytest
from header_harness import points, random_polygons

from ltsh_addon.cycles.closures import sheen_lobe
from tables import export, pack, sheen

CALLS = """
void integrate(int n, const float *cosine, const float *roughness, int corners, const float *vertices, float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_polygon light = ltsh_empty_polygon();
        for (int k = 0; k < corners; ++k) {
            const float *v = vertices + 3 * (corners * i + k);
            light = ltsh_with_corner(light, ltsh_make_vec3(v[0], v[1], v[2]));
        }
        out[i] = pack_sheen_integrate_polygon(cosine[i], roughness[i], light);
    }
}

void lobe(int n, const float *cosine, const float *roughness, const float *w, float *out)
{
    for (int i = 0; i < n; ++i) {
        pack_sheen_lobe lobe = pack_sheen_lookup(pack_sheen_cell(cosine[i], roughness[i]));
        out[i] = pack_sheen_evaluate_lobe(lobe, ltsh_make_vec3(w[3 * i], w[3 * i + 1], w[3 * i + 2]));
    }
}

int coefficient_count(void) { return 0; }
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    if header_harness.C_COMPILER is None:
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("sheen")
    export.export_pack(folder)
    return header_harness.compiled_calls(folder / "pack_sheen.h", folder, CALLS)


def test_derivatives_are_finite_differences():
    directions, _ = sheen.hemisphere()
    values = sheen_lobe(np.array([0.2, 0.5, 0.9]), np.array([0.9, 0.5, 0.3]))
    found = sheen.lobe_derivatives(values, directions)
    for index in range(3):
        step = 1e-6 * (np.arange(3) == index)[:, None]
        expected = (sheen.lobe(values + step, directions) - sheen.lobe(values - step, directions)) / 2e-6
        assert found[index] == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


def test_the_lobe_has_its_albedo():
    """The integral over the hemisphere is the albedo, as sheen is a cosine of that mass, transformed."""
    directions, weights = sheen.hemisphere()
    values = sheen_lobe(np.linspace(0.2, 1.0, 9), np.full(9, 0.7))
    assert sheen.lobe(values, directions) @ weights == pytest.approx(values[0], rel=1e-4)


def test_the_shipped_layer_is_the_fit():
    """Beside half floats: 2^-11 of numbers up to 3, and what a linear solver may differ by."""
    assert sheen.load_sheen() == pytest.approx(sheen.fit(), abs=2e-3)


def test_errors_beside_cycles_are_small():
    """As docs/engines.md has them: mean and median, and the largest from roughness 0.4 on. Below roughness 0.2 they are
    larger: sheen is a thin line at grazing angles there, and Cycles' own table has kinks."""
    error, albedo = sheen.errors(sheen.load_sheen(), 28)
    assert np.median(error) < 1e-3 and error.mean() < 1e-2 and albedo.mean() < 1.5e-3
    cosine, roughness = (values[sheen.sheen_points(28)[1] > 0.4] for values in sheen.sheen_points(28))
    found, expected = sheen.lookup(sheen.load_sheen(), cosine, roughness), sheen_lobe(cosine, roughness)
    directions, weights = sheen.hemisphere()
    difference = (sheen.lobe(found, directions) - sheen.lobe(expected, directions)) ** 2 @ weights
    squared = sheen.lobe(expected, directions) ** 2 @ weights
    assert np.sqrt(difference / squared.mean()).max() < 0.012


def test_c_looks_up_what_numpy_does(compiled):
    """float32: positions have an error of a few eps of 13."""
    cosine, roughness = points(2000, 5)
    directions = np.random.default_rng(6).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2])
    values = sheen.lookup(sheen.load_sheen(), cosine.astype(float), roughness.astype(float))
    expected = np.concatenate([sheen.lobe(values[:, [p]], directions[p, :, None])[0] for p in range(2000)])
    found = compiled.call("lobe", cosine, roughness, directions)
    assert expected.max() > 0.5 and np.abs(found - expected).max() < 1e-4 * expected.max()


def test_c_integrates_as_a_quadrature_of_the_lobe(compiled):
    """24 polygons, most of them cut by the horizon; adaptive quadrature to 1e-6."""
    cosine, roughness = points(24, 7, 0.15)
    polygons = random_polygons(24, 4, 8)
    found = compiled.call("integrate", cosine, roughness, 4, polygons)
    values = sheen.lookup(sheen.load_sheen(), cosine.astype(float), roughness.astype(float))
    for index, polygon in enumerate(polygons.astype(float)):
        corners = polygon_quadrature.above_horizon(polygon)

        def lobe(directions, index=index):
            return sheen.lobe(values[:, [index]], np.moveaxis(directions, -1, 0).reshape(3, -1)).reshape(
                directions.shape[:-1]
            )

        total = 0.0
        if len(corners) > 2:
            apex = corners.mean(axis=0)
            total, _ = polygon_quadrature.adaptive_integral(corners, lobe, apex / np.linalg.norm(apex), 1e-7)
        assert found[index] == pytest.approx(abs(total), abs=2e-5)


def test_the_layer_stands_between_those_of_ltsh2_and_ltsh4():
    texture = pack.layers()[pack.FIRST_LAYERS["sheen"]]
    assert np.array_equal(texture[..., :3].astype(np.float32), sheen.load_sheen()) and not texture[..., 3].any()
