"""Texels of UV maps: against point-in-triangle tests and polygon clipping."""

import numpy as np
import pytest

from ltsh_addon.cycles.texels import light_bend
from ltsh_addon.cycles.uv import LATTICE, NUDGE, PointWeights, Texels, UvTriangles, barycentric_of_nearest, tiles_of

WIDTH, HEIGHT = 61, 47


def cross(u, v):
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def random_triangles(count=200, size=0.08, seed=0):
    """Triangles in and around the unit square, in either winding."""
    generator = np.random.default_rng(seed)
    return generator.uniform(-0.3, 1.3, (count, 1, 2)) + size * generator.normal(size=(count, 3, 2))


def inside(corners, points):
    """Whether points (Q, 2) are inside triangles (T, 3, 2): (Q, T)."""
    sides = [
        cross(corners[:, (k + 1) % 3] - corners[:, k], points[:, None] - corners[:, k])
        for k in range(3)
    ]  # fmt: skip
    return np.all(np.array(sides) > 0, axis=0) | np.all(np.array(sides) < 0, axis=0)


def centers():
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def test_covered_are_the_texels_whose_center_is_inside_and_the_last_triangle_wins():
    triangles = UvTriangles.in_tile(random_triangles(), WIDTH, HEIGHT)
    found = triangles.texels(0, HEIGHT)
    expected = inside(triangles.corners, centers() + NUDGE)
    assert np.array_equal(found.index, np.flatnonzero(expected.any(axis=1)))
    last = expected.shape[1] - 1 - np.argmax(expected[:, ::-1], axis=1)
    assert np.array_equal(found.triangle, last[found.index])
    assert found.covers == expected.sum() and found.overlaps == (expected.sum(axis=1) > 1).sum() > 0


def test_barycentric_weights_give_the_center_back():
    triangles = UvTriangles.in_tile(random_triangles(seed=1), WIDTH, HEIGHT)
    found = triangles.texels(0, HEIGHT)
    point = np.einsum("qk,qkc->qc", found.barycentric, triangles.corners[found.triangle])
    # The center is inside, or outside by what Blender moves its sampling points.
    assert np.abs(point - centers()[found.index]).max() < 2.3e-3
    assert found.barycentric.min() >= 0.0 and np.abs(found.barycentric.sum(axis=1) - 1.0).max() < 1e-12


@pytest.mark.parametrize("conservative", [False, True])
def test_blocks_of_rows_join_to_the_whole(conservative):
    triangles = UvTriangles.in_tile(random_triangles(seed=2), WIDTH, HEIGHT)
    whole = triangles.texels(0, HEIGHT, conservative)
    rows = (0, 1, 2, 20, HEIGHT)
    parts = [triangles.texels(a, b - a, conservative) for a, b in zip(rows[:-1], rows[1:], strict=True)]
    index = np.concatenate([part.index + first * WIDTH for part, first in zip(parts, rows[:-1], strict=True)])
    assert np.array_equal(index, whole.index)
    assert np.array_equal(np.concatenate([part.triangle for part in parts]), whole.triangle)
    assert np.array_equal(np.concatenate([part.barycentric for part in parts]), whole.barycentric)


def clipped_area(triangle, x, y):
    """Area of a triangle (3, 2) inside the unit square at (x, y), by clipping it at four lines."""
    polygon = [tuple(corner) for corner in triangle]
    for axis, sign, limit in ((0, 1, x), (0, -1, x + 1), (1, 1, y), (1, -1, y + 1)):
        result = []
        for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            da, db = sign * (a[axis] - limit), sign * (b[axis] - limit)
            if da >= 0:
                result.append(a)
            if (da > 0 > db) or (da < 0 < db):
                result.append(tuple(a[k] + da / (da - db) * (b[k] - a[k]) for k in (0, 1)))
        polygon = result
        if not polygon:
            return 0.0
    return 0.5 * abs(sum(cross(np.array(a), np.array(b)) for a, b in zip(polygon, polygon[1:] + polygon[:1])))  # noqa: B905


def test_conservative_texels_are_those_a_triangle_touches():
    # Slivers thinner than a texel, most of which cover no center.
    generator = np.random.default_rng(4)
    start, along = generator.uniform(0.1, 0.9, (60, 1, 2)), generator.normal(size=(60, 1, 2)) * 0.15
    thin = generator.normal(size=(60, 1, 2)) * 0.002
    triangles = UvTriangles.in_tile(np.concatenate([start, start + along, start + thin], axis=1), WIDTH, HEIGHT)
    touched = {
        y * WIDTH + x
        for triangle in triangles.corners
        for x in range(max(0, int(triangle[:, 0].min())), min(WIDTH, int(triangle[:, 0].max()) + 1))
        for y in range(max(0, int(triangle[:, 1].min())), min(HEIGHT, int(triangle[:, 1].max()) + 1))
        if clipped_area(triangle, x, y) > 1e-12
    }
    found = triangles.texels(0, HEIGHT, conservative=True)
    assert set(found.index.tolist()) == touched
    assert len(touched) > 3 * len(triangles.texels(0, HEIGHT).index)


def test_the_nearest_point_of_a_triangle_is_the_nearest_of_many_points_of_it():
    generator = np.random.default_rng(5)
    corners, points = generator.normal(size=(40, 3, 2)), 2.0 * generator.normal(size=(40, 2))
    corners[:4, 2] = corners[:4, 1]  # without area
    weights = barycentric_of_nearest(corners, points)
    distance = np.linalg.norm(np.einsum("qk,qkc->qc", weights, corners) - points, axis=1)
    grid = np.array([(i, j, 60 - i - j) for i in range(61) for j in range(61 - i)]) / 60.0
    others = np.linalg.norm(np.einsum("gk,qkc->qgc", grid, corners) - points[:, None], axis=2).min(axis=1)
    assert weights.min() >= 0.0 and np.allclose(weights.sum(axis=1), 1.0)
    # No point of the grid is nearer, and the nearest of the grid is at most one step of it away.
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    assert (distance <= others + 1e-12).all() and (others - distance <= longest / 60.0).all()


def test_triangles_without_area_or_number_cover_nothing():
    uv = np.array([[(0.1, 0.1), (0.9, 0.9), (0.5, 0.5)], [(0.2, 0.2)] * 3, [(np.nan, 0.0), (1.0, 0.0), (0.0, 1.0)]])
    triangles = UvTriangles.in_tile(uv, 16, 16)
    assert len(triangles.texels(0, 16).index) == 0
    assert len(triangles.texels(0, 16, conservative=True).index) == 0


def triangles_at_points(count):
    """Triangles around points on them, from much smaller to much larger than a texel."""
    generator = np.random.default_rng(5)
    weights = generator.dirichlet((1.0, 1.0, 1.0), count)
    corners = generator.normal(size=(count, 3, 2)) * 10.0 ** generator.uniform(-1.0, 1.0, (count, 1, 1))
    corners += 7.0 - np.einsum("qcx,qc->qx", corners, weights)[:, None]
    index = np.arange(count)
    return UvTriangles(corners, 64, 64), Texels(index, index, weights, count, 0)


@pytest.mark.parametrize("width", [0.5, 1.0])
def test_spread_points_are_distributed_like_random_ones_that_are_tried_ten_times(width):
    count, tried = 24, 4000
    triangles, texels = triangles_at_points(count)
    generator = np.random.default_rng(6)
    spread = np.array([triangles.places(triangles.spread(texels, number, 256, width)) for number in range(256)])
    for number in range(count):
        random = 7.0 + width * (generator.random((tried, 10, 2)) - 0.5)
        hit = inside(triangles.corners[[number]], random.reshape(-1, 2)).reshape(tried, 10)
        found = np.where(hit.any(axis=1)[:, None], random[np.arange(tried), hit.argmax(axis=1)], 7.0)
        for exponents in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2)):
            moments = [np.prod((points - 7.0) ** exponents, axis=1) for points in (spread[:, number], found)]
            # Five standard deviations of the random ones, and what 256 points leave: a hundredth of the range.
            tolerance = 5.0 * moments[1].std() / tried**0.5 + 0.01 * (0.5 * width) ** sum(exponents)
            assert abs(moments[0].mean() - moments[1].mean()) < tolerance, (number, exponents)


def test_spread_points_lie_on_their_triangles_and_one_is_the_center():
    triangles, texels = triangles_at_points(40)
    assert triangles.spread(texels, 0, 1, 1.0) is texels
    for number in range(9):
        found = triangles.spread(texels, number, 9, 1.0)
        assert found.barycentric.min() >= 0.0 and np.abs(triangles.places(found) - 7.0).max() <= 0.5 + 1e-9
        assert np.abs(found.barycentric.sum(axis=1) - 1.0).max() < 1e-9


def test_weights_of_random_points_give_the_mean_of_the_spread_ones():
    """Of what changes quadratically over a texel."""
    triangles, texels = triangles_at_points(60)
    generator = np.random.default_rng(7)
    spread = [triangles.places(triangles.spread(texels, number, LATTICE, 1.0)) for number in range(LATTICE)]
    points = []
    for _ in range(16):
        numbers = generator.integers(LATTICE, size=60)
        points.append(np.array([spread[number][q] for q, number in enumerate(numbers)]))
    weights = PointWeights.of(triangles, texels, points, 1.0)

    def curve(at):
        x, y = (at - 7.0).T
        return 1.0 + 2.0 * x - y + 3.0 * x * x - x * y + 0.5 * y * y

    wanted = np.mean([curve(at) for at in spread], axis=0)
    plain = np.mean([curve(at) for at in points], axis=0)
    found = np.mean([weights.at(at) * curve(at) for at in points], axis=0)
    assert np.abs(np.mean([weights.at(at) for at in points], axis=0) - 1.0).max() < 1e-12
    # The stiffness leaves some of it.
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.1 * np.sqrt(np.mean((plain - wanted) ** 2))


@pytest.mark.parametrize("tile", [(0, 0), (1, 0), (9, 0), (0, 1), (3, 2)])
@pytest.mark.parametrize("steps", [1, 3])
def test_slivers_a_float_step_beyond_a_border_make_no_tile(tile, steps):
    """Rounding of unwraps: on every side, in single precision, and at both ends of the row of tiles."""
    low = np.float32(tile)
    corners = low + np.float32([[0, 0], [1, 0], [1, 1], [0, 1]])
    whole = [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    for axis in (0, 1):
        for border, beyond in ((low[axis], -np.inf), (low[axis] + np.float32(1.0), np.inf)):
            sliver = low + np.float32([[0.2, 0.2], [0.5, 0.5], [0.7, 0.7]])
            sliver[:, axis] = border
            for _ in range(steps):
                sliver[1, axis] = np.nextafter(sliver[1, axis], np.float32(beyond))
            whole.append(sliver)
    assert tiles_of(np.array(whole)) == ([1001 + tile[0] + 10 * tile[1]], 0.0)


def test_tiles_that_hold_a_face_stay_however_small_it_is():
    small = np.float32([[0.5, 0.5], [0.502, 0.5], [0.5, 0.502]])
    assert tiles_of(np.array([small, small + np.float32([1.0, 0.0])])) == ([1001, 1002], 0.0)
    on_the_border = np.float32([[1.0, 0.2], [1.0 + 1e-6, 0.3], [1.0, 0.4]])
    assert tiles_of(on_the_border[None]) == ([1002], 0.0)
    across = small + np.float32([0.499, 0.0])
    assert tiles_of(across[None])[0] == [1001] and tiles_of(across[None])[1] > 0.0


def test_light_bends_at_borders_too():
    """A 3 x 3 island without light in one corner, and a texel by itself; the light of all others is 1."""
    width, index = 8, np.array([0, 1, 2, 8, 9, 10, 16, 17, 18, 31])
    light = np.where(index == 18, 0.0, 1.0)[:, None].repeat(3, axis=1)
    size = np.sqrt(np.square(light).mean())
    bend = light_bend(light.astype(np.float32), index, width) * size
    expected = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, np.inf]
    np.testing.assert_allclose(bend, expected, rtol=1e-6)
