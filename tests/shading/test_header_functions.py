"""What the functions of exported headers compute, in C and in their GLSL branch (see header_harness)."""

import header_harness
import numpy as np
import pytest
from header_harness import points, random_polygons

from ltsh_addon import shading
from ltsh_addon.lobes.polygon import clip_to_horizon, edge_sums, project_to_sphere, split_at_horizon
from ltsh_addon.scene import QuadLight, SurfaceSamples
from tables.header import data_blocks

pytestmark = pytest.mark.skipif(header_harness.C_COMPILER is None, reason="needs a C compiler")

EPS = float(np.finfo(np.float32).eps)
ROOM = 8


@pytest.fixture(scope="module", params=header_harness.NAMES)
def name(request):
    return request.param


@pytest.fixture(scope="module", params=["c", "glsl"])
def compiled(request, name, folder, tables):
    """(table, header) of every table in both branches."""
    branch, table = request.param, tables[name]
    if branch == "c":
        return table, header_harness.compiled(folder / f"{name}.h", folder, name)
    if header_harness.CXX_COMPILER is None:
        pytest.skip("needs a C++ compiler")
    data = np.concatenate(list(data_blocks(table).values()))
    return table, header_harness.compiled_glsl_branch(folder / f"{name}.h", folder, name, data)


def test_the_numbers_come_back_bit_for_bit(folder, tables, name):
    table = tables[name]
    rows, columns = table.warp.shape[:2]
    header = header_harness.compiled(folder / f"{name}.h", folder, name)
    nodes = np.concatenate([table.warp, table.coefficients.reshape(rows, columns, -1)], axis=2)
    others = (table.fresnel_ior, table.fresnel_weights, table.fresnel_curves, table.average_albedo)
    expected = np.concatenate([np.ravel(part).astype(np.float32) for part in (nodes, *others)])
    assert np.array_equal(header.data(len(expected)).view(np.uint32), expected.view(np.uint32))


def test_lookups_agree(compiled):
    """The position in the table, up to 63, has an error of a few eps, hence 1e-5 of what a channel spans."""
    table, header = compiled
    cosine, roughness = points(4000, seed=1)
    for curve in range(len(table.fresnel_curves)):
        found = header.call("lookup", cosine, roughness, curve, shape=(5 + header.coefficients,))
        lobe = table.lookup(cosine.astype(float), roughness.astype(float))
        tilt = np.zeros(len(cosine)) if lobe.tilt is None else lobe.tilt
        expected = np.stack([lobe.xx, lobe.xz, lobe.yy, lobe.zz, tilt, *lobe.coefficients[curve]], axis=1)
        assert (np.abs(found - expected) <= 1e-5 * np.abs(expected).max(axis=0)).all()


def test_values_out_of_range_are_clamped(compiled):
    _, header = compiled
    outside, inside = ([-1.0, 2.0, np.nan, 0.5, 0.5], [0.0, 1.0, 0.0, 0.5, 0.5])
    roughness, clamped = ([0.5, 0.5, 0.5, -3.0, np.inf], [0.5, 0.5, 0.5, 0.0, 1.0])
    shape = (5 + header.coefficients,)
    found = header.call("lookup", outside, roughness, 0, shape=shape)
    assert np.array_equal(found, header.call("lookup", inside, clamped, 0, shape=shape))


def test_dielectrics_agree(compiled):
    """Weights and coefficients of size up to S add up with rounding errors of eps S each; the position among the
    indices of refraction, up to 240, has an error of 240 eps of the step between neighbors."""
    table, header = compiled
    cosine, roughness = points(2000, seed=2)
    low, high = table.fresnel_ior[[0, -1]]
    ior = np.random.default_rng(3).uniform(low - 0.2, high + 0.2, 2000)
    ior[: len(table.fresnel_ior)] = table.fresnel_ior
    ior = ior.astype(np.float32)
    found = header.call("dielectric", cosine, roughness, ior, shape=(header.coefficients,))
    coefficients = table.lookup(cosine.astype(float), roughness.astype(float)).coefficients
    weights = table.dielectric_weights(ior.astype(float))
    expected = np.einsum("fp,fkp->pk", weights, coefficients)
    scale = (np.abs(weights)[:, None] * np.abs(coefficients)).sum(axis=0).max()
    assert np.abs(found - expected).max() <= 2e-5 * scale


def test_fresnel_curves_and_average_albedos_agree(compiled):
    """Linear interpolation at a position up to 256: errors of some 256 eps of the step between neighbors."""
    table, header = compiled
    share = np.random.default_rng(4).random(500).astype(np.float32)
    share[:2] = 0.0, 1.0
    for curve, values in enumerate(table.fresnel_curves):
        expected = np.interp(share, np.linspace(0.0, 1.0, len(values)), values)
        assert header.call("fresnel", share, curve) == pytest.approx(expected, abs=1e-5)
        expected = np.interp(share, np.linspace(0.0, 1.0, len(table.warp)), table.average_albedo[:, curve])
        assert header.call("average_albedo", share, curve) == pytest.approx(expected, abs=1e-5)


def test_albedos_agree(compiled):
    table, header = compiled
    cosine, roughness = points(1000, seed=5)
    albedo = table.lookup(cosine.astype(float), roughness.astype(float)).albedo()
    for curve, expected in enumerate(albedo):
        assert header.call("albedo", cosine, roughness, curve) == pytest.approx(expected, abs=2e-5)


def test_lobes_agree(compiled):
    """A lobe is 1 / alpha times narrower than a hemisphere, so that a rounding error of eps in the direction is a
    relative error of eps / alpha of its value, or of eps / alpha of its size where the terms of the expansion cancel.
    """
    table, header = compiled
    cosine, roughness = points(20000, seed=6, lowest_roughness=0.1)
    directions = np.random.default_rng(7).normal(size=(20000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    found = header.call("lobe", cosine, roughness, directions)
    exact = [array.astype(float) for array in (cosine, roughness, directions[:, None])]
    expected = shading.evaluate_lobe(table, *exact)[:, 0]
    size = largest_sum(table, *exact[:2])
    tolerance = 500.0 * EPS / roughness**2 * (np.abs(expected) + 0.01 * size)
    assert (np.abs(found - expected) <= tolerance).all()
    assert (found[directions[:, 2] <= 0.0] == 0.0).all() and np.abs(expected).max() > 0.1


def test_what_shading_takes_of_an_integral_agrees(compiled):
    """With `shade` in double precision, for F = 1 and for dielectrics: small and large lights in all directions, with
    the tails where the integral alone would be negative. The header has errors of a few eps / alpha of a lobe's size.
    """
    table, header = compiled
    if len(table.fresnel_curves) < 3:
        pytest.skip("`shade` takes tables with the F82 curve")
    cosine, roughness = points(1500, seed=8, lowest_roughness=0.3)
    generator = np.random.default_rng(9)
    ior = generator.uniform(1.05, 2.5, len(cosine)).astype(np.float32)
    normal = np.broadcast_to([0.0, 0.0, 1.0], (len(cosine), 3))
    view = np.stack([np.sqrt(1.0 - cosine.astype(float) ** 2), 0.0 * cosine, cosine], axis=1)
    fields = dict.fromkeys(("position", "diffuse_albedo", "specular_f0", "specular_f90"), 0.0 * normal)
    fields |= {"view": view, "normal": normal, "diffuse_normal": normal, "roughness": roughness, "ior": ior}
    white = SurfaceSamples(**{**fields, "specular_f0": 0.0 * normal + 1.0, "specular_f90": 0.0 * normal + 1.0},
                           dielectric=0.0 * cosine)  # fmt: skip
    coat = SurfaceSamples(**fields, dielectric=0.0 * cosine + 1.0)
    raised = 0
    for center, size in (((-1.5, 0.2, 0.5), 0.3), ((1.0, -0.8, 1.0), 0.5), ((1.5, 0.3, 0.15), 0.1)):
        center = np.array(center)
        half_u = size * np.cross(center, [0.0, 0.0, 1.0]) / np.linalg.norm(center[:2])
        half_v = 0.5 * size * np.cross(half_u, center) / np.linalg.norm(np.cross(half_u, center))
        light = QuadLight("", center, half_u, half_v, -center / np.linalg.norm(center), np.ones(3))
        vertices = np.broadcast_to(light.polygon(), (len(cosine), 4, 3)).astype(np.float32)
        found = header.call("shaded", cosine, roughness, ior, 4, vertices, shape=(2,))
        signed = header.call("integral", cosine, roughness, 0, 4, vertices)
        raised += np.count_nonzero(np.abs(signed) < 0.99 * found[:, 0])
        for column, samples in enumerate((white, coat)):
            expected = shading.shade(samples, [light], table, passes=("specular",), dtype=np.float64).specular[0, :, 0]
            lit = cosine > 0.0
            assert np.abs(found[:, column] - expected)[lit].max() < 2e-4 * max(1.0, expected.max()), column
    assert table.family == "ltc" or raised > 0


def test_clipped_polygons_agree(compiled):
    """Corner by corner; a new corner carries the rounding of one quotient and one product."""
    _, header = compiled
    for corners in (3, 6):
        vertices = random_polygons(300, corners, seed=40 + corners)
        for polygon, found in zip(vertices, header.clip(vertices, ROOM), strict=True):
            if not (polygon[:, 2] > 0.0).any():
                assert len(found) == 0
                continue
            expected = clip_to_horizon(polygon.astype(float).T[:, :, None])[:, :, 0].T
            assert found == pytest.approx(expected, abs=1e-6 * float(np.abs(polygon).max()))
            assert (found[:, 2] >= 0.0).all()


def test_corners_without_room_are_left_out(compiled):
    _, header = compiled
    vertices = np.random.default_rng(50).random((2, ROOM + 3, 3)).astype(np.float32)
    assert all(
        np.array_equal(found, given[:ROOM]) for found, given in zip(header.clip(vertices, ROOM), vertices, strict=True)
    )


def test_form_factors_agree(compiled):
    """Errors of a few eps, or eps / gap where an edge ends `gap` > 0.01 short of a half circle."""
    _, header = compiled
    vertices = random_polygons(3000, 4, seed=51)
    error = np.abs(header.call("form_factor", 4, vertices) - shading.clamped_form_factor(vertices.astype(float)))
    assert error.max() < 5e-6 and np.quantile(error, 0.98) < 1e-6


def test_local_frames_are_rotations_that_lay_the_view_direction_flat(compiled):
    """Where view and normal are `angle` apart the tangent has an error of eps / angle, at most 1e-3."""
    _, header = compiled
    generator = np.random.default_rng(52)
    normal, view = generator.normal(size=(2, 400, 3))
    view[:100] = normal[:100] + np.geomspace(1e-8, 1.0, 100)[:, None] * view[:100]
    view[100:103], normal[100:103] = np.eye(3), np.eye(3)
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, view))
    vectors = np.stack([generator.normal(size=(400, 3)) for _ in range(3)])
    local = [header.call("local", normal, view, v, shape=(3,)) for v in (normal, view, *vectors)]
    assert local[0] == pytest.approx(np.tile([0.0, 0.0, 1.0], (400, 1)), abs=1e-3)
    assert np.abs(local[1][:, 1]).max() < 1e-3 and local[1][:, 0].min() > -1e-3
    assert local[1][:, 2] == pytest.approx((normal * view).sum(axis=1), abs=1e-6)
    after, before = np.linalg.det(np.stack(local[2:], axis=1)), np.linalg.det(vectors.transpose(1, 0, 2))
    assert after == pytest.approx(before, abs=1e-2)


def largest_sum(table, cosine, roughness, curve=0):
    """Largest sum of the magnitudes of a lobe's coefficients."""
    return float(np.abs(table.lookup(cosine, roughness).coefficients[curve]).sum(axis=0).max())


def half_circle_gaps(table, cosine, roughness, vertices):
    """How far (P,) from a half circle the edges are, in rad, that the closed form meets after clipping and warping."""
    lobe, gap = table.lookup(cosine, roughness), np.full(len(cosine), 2.0)
    for index, polygon in split_at_horizon(vertices.transpose(2, 1, 0)):
        part = lobe.take(index)
        warped = part.to_original_domain(polygon)
        pieces = [(np.arange(len(index)), warped)]
        if part.tilt is not None:
            sine, cosine_tilt = np.sin(part.tilt), np.cos(part.tilt)
            x, y, z = warped
            turned = np.stack([cosine_tilt * x - sine * z, y, sine * x + cosine_tilt * z])
            pieces = split_at_horizon(turned)
        for inner, piece in pieces:
            shortest = np.linalg.norm(edge_sums(project_to_sphere(piece)), axis=0).min(axis=0)
            gap[index[inner]] = np.minimum(gap[index[inner]], shortest)
    return gap


@pytest.mark.parametrize("corners", [3, 4, 5])
def test_polygon_integrals_agree_with_the_add_on(compiled, corners):
    """Against float64 on the same float32 input: the direction of an edge that ends `gap` short of a half circle has an
    error of some eps / gap, which is the error of what the edge adds."""
    table, header = compiled
    cosine, roughness = points(2000, seed=8)
    vertices = random_polygons(2000, corners, seed=9 + corners)
    exact = [array.astype(float) for array in (cosine, roughness, vertices)]
    tolerance = 20.0 * EPS / half_circle_gaps(table, *exact) * largest_sum(table, *exact[:2])
    found = header.call("integrate", cosine, roughness, corners, vertices)
    assert (np.abs(found - shading.integrate_polygon(table, *exact)) <= tolerance).all()
    signed = header.call("integral", cosine, roughness, 0, corners, vertices)
    assert (np.abs(signed - shading.integrate_polygon(table, *exact, signed=True)) <= tolerance).all()
    clipped = (vertices[..., 2] > 0.0).any(axis=1) & (vertices[..., 2] < 0.0).any(axis=1)
    assert 0.2 < clipped.mean() < 0.8 and np.quantile(tolerance, 0.9) < 1e-3 * np.abs(signed).max()
    assert (signed > 0.01).any() and (signed < -0.01).any() and (found >= 0.0).all()


def test_a_triangle_traced_twice_has_twice_the_integral(compiled):
    """The tolerance is as above, of both."""
    table, header = compiled
    cosine, roughness = points(300, seed=22, lowest_roughness=0.3)
    angle = np.array([0.0, 1.0, 2.0]) * 2.0 * np.pi / 3.0 + 0.1
    once = np.zeros((300, 3, 3))
    once[..., 0], once[..., 1] = np.cos(angle), np.sin(angle)
    once[..., 2] = np.random.default_rng(23).uniform(0.02, 0.5, (300, 1))
    once = once.astype(np.float32)
    exact = [array.astype(float) for array in (cosine, roughness, once)]
    expected = 2.0 * shading.integrate_polygon(table, *exact)
    tolerance = 40.0 * EPS / half_circle_gaps(table, *exact) * largest_sum(table, *exact[:2])
    twice = np.tile(once, (1, 2, 1))
    for vertices in (twice, twice[:, ::-1]):
        found = header.call("integrate", cosine, roughness, 6, vertices)
        assert (np.abs(found - expected) <= tolerance).all()
    assert expected.max() > 1.0


def test_a_polygon_over_the_whole_hemisphere_gives_the_albedo(compiled):
    """Of every curve and with the sign of its winding, also where rounding takes the solid angle beyond 2 pi. The gap
    at the horizon is at most 2e-3 rad wide: that share of the sphere is what is missing. LTC clips a second time, which
    leaves an edge that ends about twice the height short of a half circle, with an error of some eps / height."""
    table, header = compiled
    generator = np.random.default_rng(31)
    cosine, roughness = points(300, seed=30, lowest_roughness=0.5)
    lowest = 1e-4 if table.family == "ltc" else 1e-9
    angle = 0.5 * np.pi * np.arange(4) + generator.random((300, 1)) * 2.0 * np.pi
    height = np.broadcast_to(np.geomspace(lowest, 1e-3, 300)[:, None], angle.shape)
    vertices = np.stack([np.cos(angle), np.sin(angle), height], axis=-1).astype(np.float32)
    for curve in range(len(table.fresnel_curves)):
        expected = header.call("albedo", cosine, roughness, curve)
        tolerance = 0.02 * largest_sum(table, cosine.astype(float), roughness.astype(float), curve)
        found = header.call("integral", cosine, roughness, curve, 4, vertices)
        assert found == pytest.approx(expected, abs=tolerance)
        found = header.call("integral", cosine, roughness, curve, 4, vertices[:, ::-1])
        assert found == pytest.approx(-expected, abs=tolerance)
