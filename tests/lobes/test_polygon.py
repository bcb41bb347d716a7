"""Clipping at the horizon and solid angles of polygons, convex and not."""

import numpy as np
import polygon_quadrature
import pytest
import textbook

from ltsh_addon.lobes.polygon import clip_to_horizon, project_to_sphere, solid_angle

ARROW = np.array([[-1.0, -1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [-0.4, 0.0, 0.0]])
COMB = np.array(
    [[-3.0, -1.0], [3.0, -1.0], [3.0, 1.0], [2.0, 1.0], [2.0, -0.5], [1.0, -0.5], [1.0, 1.0], [0.0, 1.0]]
    + [[0.0, -0.5], [-2.0, -0.5], [-2.0, 1.0], [-3.0, 1.0]]
)


def batch(*polygons):
    """Kernel layout (3, V, P) of polygons (V, 3) with equally many corners."""
    return np.ascontiguousarray(np.stack(polygons).transpose(2, 1, 0))


def random_rectangles(count, seed, height=0.5):
    """Rectangles (P, 4, 3) of random placement and orientation, many crossing z = 0."""
    generator = np.random.default_rng(seed)
    center = generator.normal(size=(count, 1, 3)) + np.array([0.0, 0.0, height])
    u = generator.normal(size=(count, 3))
    v = np.cross(u, generator.normal(size=(count, 3)))
    v *= (0.2 + generator.random((count, 1))) / np.linalg.norm(v, axis=1, keepdims=True)
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return center + signs[:, :1] * u[:, None] + signs[:, 1:] * v[:, None]


def vector_area(polygon):
    """Half the sum of cross products (3,) of a planar polygon (V, 3): its length is the area."""
    return 0.5 * np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0)


def clipped(polygon):
    """The part above the horizon of one polygon (V, 3), as (W, 3)."""
    return clip_to_horizon(batch(polygon))[:, :, 0].T


def turned(polygon, angle):
    """Polygon (V, 3) rotated about z."""
    c, s = np.cos(angle), np.sin(angle)
    return polygon @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def stood_up(flat, tilt=1.1, lift=0.15):
    """A polygon (V, 2) or (V, 3) of the plane z = 0, stood up in front of the point and sunk into the horizon."""
    c, s = np.cos(tilt), np.sin(tilt)
    x, y = flat[:, 0], flat[:, 1]
    return np.stack([x, 2.0 - c * y, lift + s * y], axis=1)


def test_clipped_corners_lie_above_the_horizon():
    polygons = random_rectangles(400, seed=1)
    polygons = polygons[(polygons[..., 2] > 0.0).any(axis=1)]
    result = clip_to_horizon(batch(*polygons))
    assert result.shape[1] <= 5
    assert result[2].min() >= 0.0
    plane_normal = np.cross(polygons[:, 1] - polygons[:, 0], polygons[:, 2] - polygons[:, 0])
    offset = ((result - polygons[:, 0].T[:, None]) * plane_normal.T[:, None]).sum(axis=0)
    assert np.abs(offset).max() < 1e-13 * np.abs(plane_normal).max()


@pytest.mark.parametrize("shape", [ARROW, COMB, COMB[::-1]], ids=["arrow", "comb", "reversed comb"])
def test_the_two_sides_of_the_horizon_add_up_to_a_non_convex_polygon(shape):
    polygon = stood_up(shape)
    flipped = polygon * np.array([1.0, 1.0, -1.0])
    above, below = vector_area(clipped(polygon)), vector_area(clipped(flipped))
    # Mirroring in z turns the vector area's x and y components around.
    total = above + below * np.array([-1.0, -1.0, 1.0])
    assert total == pytest.approx(vector_area(polygon), abs=1e-13)


def test_solid_angle_of_triangles_is_lhuilier():
    generator = np.random.default_rng(4)
    corners = generator.normal(size=(500, 3, 3))
    corners[..., 2] = np.abs(corners[..., 2])
    unit = project_to_sphere(batch(*corners))
    sign = np.sign(np.linalg.det(corners))
    expected = sign * textbook.lhuilier(*unit.transpose(1, 2, 0))
    # L'Huilier's product loses half the digits of slivers.
    assert np.abs(solid_angle(unit) - expected).max() < 1e-7
    assert np.median(np.abs(solid_angle(unit) - expected)) < 1e-15 * 10


def test_solid_angle_matches_quadrature_for_all_shapes():
    shapes = [clipped(p) for p in random_rectangles(60, seed=5) if (p[:, 2] > 0.0).any()]
    shapes += [clipped(stood_up(shape, tilt)) for shape in (ARROW, COMB) for tilt in (0.4, 1.1, 1.5)]
    for polygon in shapes:
        expected = polygon_quadrature.integral(polygon, lambda directions: np.ones(directions.shape[:-1]), pieces=10)
        found = solid_angle(project_to_sphere(batch(polygon)))[0]
        assert found == pytest.approx(expected, abs=1e-9), polygon


def test_the_upper_hemisphere_and_a_half_of_it():
    angle = 2.0 * np.pi * np.arange(8) / 8
    low = np.stack([np.cos(angle), np.sin(angle), np.full(8, 1e-9)], axis=1)
    # 1e-9 of height leaves a band of 2 pi 1e-9 sr at most
    assert solid_angle(project_to_sphere(batch(low)))[0] == pytest.approx(2.0 * np.pi, abs=1e-8)
    half = np.concatenate([np.stack([np.cos(angle[:5]), np.sin(angle[:5]), np.zeros(5)], axis=1), [[0.0, 0.0, 1.0]]])
    assert solid_angle(batch(half))[0] == pytest.approx(np.pi, rel=1e-14)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_light_that_almost_touches_the_surface_covers_the_hemisphere(dtype):
    """Rounding must not turn 2 pi into -2 pi, whatever the rotation; it may cost some units in the last place."""
    generator = np.random.default_rng(6)
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    for exponent in range(3, 19):
        angles = generator.random(300) * 2.0 * np.pi
        shift = generator.uniform(-0.9, 0.9, size=(300, 1, 3)) * np.array([1.0, 1.0, 0.0])
        height = np.array([0.0, 0.0, 10.0**-exponent])
        polygons = np.stack([turned(square + s, a) + height for s, a in zip(shift, angles, strict=True)])
        found = solid_angle(project_to_sphere(batch(*polygons).astype(dtype)))
        # The uncovered band is as high as the light and at most ten times as wide as its distance to the nearest edge.
        limit = 100.0 * 10.0**-exponent + 40.0 * np.finfo(dtype).eps
        assert np.abs(found - 2.0 * np.pi).max() < limit, exponent


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("height", [2.0, 0.5, 0.05])
def test_every_turn_around_a_polygon_counts(height, dtype):
    """Up to four times 2 pi; a pentagram is a pentagon once more: its tips lie between the two."""
    square = np.array([[-1.0, -1.0, height], [1.0, -1.0, height], [1.0, 1.0, height], [-1.0, 1.0, height]])
    once = 4.0 * np.arctan(1.0 / (height * np.sqrt(height**2 + 2.0)))
    # Sixteen arc tangents, each with an error of some units in the last place.
    limit = 100.0 * float(np.finfo(dtype).eps)
    for turns in (1, 2, 3, 4):
        several = batch(np.tile(square, (turns, 1))).astype(dtype)
        for polygon, sign in ((several, 1.0), (several[:, ::-1], -1.0)):
            found = solid_angle(project_to_sphere(polygon))[0]
            assert found == pytest.approx(sign * turns * once, abs=limit)
    angle = 2.0 * np.pi * np.arange(5) / 5
    tips = np.stack([np.cos(angle), np.sin(angle), np.full(5, height)], axis=1)
    inner = tips * np.array([-1.0, -1.0, 0.0]) * (np.cos(0.4 * np.pi) / np.cos(0.2 * np.pi)) + [0.0, 0.0, height]
    outline = np.stack([tips, np.roll(inner, -3, axis=0)], axis=1).reshape(-1, 3)
    star, outside, inside = (
        solid_angle(project_to_sphere(batch(polygon).astype(dtype)))[0]
        for polygon in (tips[[0, 2, 4, 1, 3]], outline, inner)
    )
    assert star == pytest.approx(outside + inside, abs=limit)


def test_a_corner_at_the_point_is_finite():
    polygon = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    unit = project_to_sphere(batch(polygon))
    assert np.array_equal(unit[:, 0, 0], np.zeros(3))
    assert np.isfinite(solid_angle(unit)).all()
