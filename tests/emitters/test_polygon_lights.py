"""Lights of shape POLYGON, convex or not, and their convex pieces."""

import numpy as np
import pytest
from precisions import assert_close as assert_promise
from precisions import techniques
from surface_scenes import STAR, all_kinds_of_samples, area_light, polygon_light, random_samples

from ltsh_addon import shading
from ltsh_addon.lobes.polygon import convex_pieces

# An L, clockwise and counterclockwise arms, and a star, in the plane z = 0
ELL = np.array([[-1, -1], [1, -1], [1, -0.2], [-0.3, -0.2], [-0.3, 1], [-1, 1]], dtype=float)
ELL_PARTS = (((0.0, -0.6), (1.0, 0.4)), ((-0.65, 0.4), (0.35, 0.6)))  # centers and half sizes of its two rectangles
REPEATED = np.array(
    [[-1, -1], [-1, -1], [0, -1], [1, -1], [1, -0.2], [1, -0.2], [1, -0.2], [-0.3, -0.2], [-0.3, 0.5], [-0.3, 1]]
    + [[-1, 1]]
)


def rectangle(light, center, half):
    """The rectangle of half sizes (2,) around center (2,) in the plane of a light of `polygon_light`."""
    center = light.center + center[0] * light.half_u + center[1] * light.half_v
    options = {"half_u": half[0] * light.half_u, "half_v": half[1] * light.half_v, "direction": light.direction}
    return area_light(center=center, radiance=(1, 1, 1), **options)


def shaded(samples, lights, technique, **options):
    return shading.shade(samples, lights, technique, **{"dtype": np.float64, "workers": 1, **options}).combined


def assert_same(found, parts, technique):
    """`found` (P, 3) is the sum of the parts. The quadrature stops at 1e-4 of each value, the others are exact, but for
    lobes that ring: what is clamped in a part may be missing in the whole."""
    expected = sum(parts)
    limit = 3e-4 if technique == shading.REFERENCE else 1e-3 if len(parts) > 1 and technique != "ltc" else 1e-10
    error = np.abs(found - expected)
    assert error.max() < limit * expected.max()
    assert np.median(error[expected > 0.0]) < 1e-10 * expected.max() or technique == shading.REFERENCE


@techniques
def test_a_concave_polygon_is_the_sum_of_its_parts(technique):
    samples = random_samples(80, seed=3)
    for flat in (ELL, ELL[::-1], REPEATED):
        light = polygon_light(flat)
        parts = [shaded(samples, [rectangle(light, *part)], technique) for part in ELL_PARTS]
        assert_same(shaded(samples, [light], technique), parts, technique)


@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
@pytest.mark.parametrize("flat", [ELL, STAR, REPEATED, STAR[:3]], ids=["ell", "star", "repeated", "triangle"])
def test_single_precision_keeps_its_promise(name, flat):
    samples = all_kinds_of_samples(300, seed=6)
    across = polygon_light(flat, center=(0.3, 0.2, 0.1), direction=(0.8, 0.1, -0.3))
    assert_promise(samples, [polygon_light(flat), across], name)


@pytest.mark.parametrize("corners", [3, 5, 9, 33, 65, 200, 500])
def test_many_corners_keep_the_promise(corners):
    """Regular, with every other corner pulled in: concave, up to more corners than a product of angles can hold."""
    angle = 2.0 * np.pi * np.arange(corners) / corners
    radius = np.where(np.arange(corners) % 2 == 0, 1.0, 0.9)
    light = polygon_light((radius * np.array([np.cos(angle), np.sin(angle)])).T)
    double = assert_promise(all_kinds_of_samples(150, seed=7), [light], "ltsh4")
    assert double.combined.max() > 0.1


def area_of(flat):
    following = np.roll(flat, -1, axis=0)
    return 0.5 * (flat[:, 0] * following[:, 1] - flat[:, 1] * following[:, 0]).sum()


def inside(flat, points):
    """Winding numbers (Q,) of polygons (V, 2) around points (Q, 2), by angles."""
    offset = flat[:, None] - points
    following = np.roll(offset, -1, axis=0)
    cross = offset[..., 0] * following[..., 1] - offset[..., 1] * following[..., 0]
    return np.rint(np.arctan2(cross, (offset * following).sum(axis=2)).sum(axis=0) / (2.0 * np.pi))


@pytest.mark.parametrize("seed", range(12))
def test_convex_pieces_cover_every_point_once(seed):
    """Random polygons around a point, some with repeated corners and corners on edges, tilted in space."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(3, 40))
    angle = np.sort(generator.uniform(0.0, 2.0 * np.pi, count))
    flat = generator.uniform(0.1, 1.0, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if seed % 2:
        middle = 0.5 * (flat + np.roll(flat, -1, axis=0))
        flat = np.stack([flat, flat, middle], axis=1).reshape(-1, 2)
    if seed % 3 == 0:
        flat = flat[::-1]
    frame = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    pieces = [piece @ frame[:, :2] for piece in convex_pieces(flat @ frame[:, :2].T + 5.0 * frame[:, 2])]
    assert sum(area_of(piece) for piece in pieces) == pytest.approx(area_of(flat), rel=1e-9)
    points = generator.uniform(-1.0, 1.0, size=(400, 2))
    assert np.array_equal(sum(inside(piece, points) for piece in pieces), inside(flat, points))
    for piece in pieces:
        along = np.roll(piece, -1, axis=0) - piece
        turns = along[:, 0] * np.roll(along, -1, axis=0)[:, 1] - along[:, 1] * np.roll(along, -1, axis=0)[:, 0]
        assert (turns * np.sign(area_of(flat)) > -1e-9).all()


def test_a_convex_polygon_is_one_piece():
    assert [len(piece) for piece in convex_pieces(polygon_light(STAR[::2]).corners)] == [7]
    assert [len(piece) for piece in convex_pieces(polygon_light(ELL).corners)] == [3] * 4
    assert convex_pieces(np.zeros((5, 3))) == []
