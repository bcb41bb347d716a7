"""Flat polygons of triangle meshes, without Blender: area, outline, sides."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ltsh_addon.emitters import mesh_polygons
from ltsh_addon.emitters.mesh_polygons import flat_polygons, is_closed, is_inside, signed_volume

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE_TRIANGLES = np.array([triangle for a, b, c, d in CUBE_QUADS for triangle in ((a, b, c), (a, c, d))])


def grid(columns, rows, missing=()):
    """A grid of squares in the xy plane, each two triangles; (vertices, triangles)."""
    vertices = np.array([[x, y, 0.0] for y in range(rows + 1) for x in range(columns + 1)], dtype=float)
    triangles = []
    for y in range(rows):
        for x in range(columns):
            if (x, y) not in missing:
                a = y * (columns + 1) + x
                b, c, d = a + 1, a + columns + 2, a + columns + 1
                triangles += [(a, b, c), (a, c, d)]
    return vertices, np.array(triangles)


def area(polygon):
    corners = polygon.corners - polygon.corners[0]
    return 0.5 * np.dot(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0), polygon.normal)


def labels(triangles):
    return np.zeros(len(triangles), dtype=int)


def rotation(generator):
    return np.linalg.qr(generator.normal(size=(3, 3)))[0]


@pytest.mark.parametrize(
    ("size", "missing", "pieces", "corners", "expected"),
    [
        ((40, 30), (), 1, 4, 1200.0),
        ((2, 2), {(1, 1)}, 1, 6, 3.0),
        ((3, 3), {(1, 1)}, 16, 3, 8.0),  # a hole
        ((2, 2), {(0, 1), (1, 0)}, 2, 4, 2.0),  # corners that touch
    ],
)
def test_grids_are_simple_outlines_where_they_have_one(size, missing, pieces, corners, expected):
    vertices, triangles = grid(*size, missing)
    polygons = flat_polygons(vertices, triangles, labels(triangles))
    assert [len(polygon.corners) for polygon in polygons] == pieces * [corners]
    assert sum(area(polygon) for polygon in polygons) == pytest.approx(expected)
    assert all(np.allclose(polygon.normal, (0.0, 0.0, 1.0)) for polygon in polygons)


def test_single_precision_in_any_pose_does_not_break_the_plane():
    generator = np.random.default_rng(6)
    for _ in range(20):
        vertices, triangles = grid(9, 7)
        moved = 0.1 * vertices @ rotation(generator).T + generator.normal(size=3)
        polygons = flat_polygons(moved.astype(np.float32).astype(float), triangles, labels(triangles))
        assert len(polygons) == 1 and len(polygons[0].corners) == 4


def test_bent_and_cut_quads_are_what_they_are_one_by_one(monkeypatch):
    """Pairs of triangles at once, and one by one: flat quads, a triangle with a straight corner, bent ones, kites."""
    generator = np.random.default_rng(4)
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    shapes = [square + generator.normal(0.0, 0.2, (4, 3)) * [1, 1, 0] for _ in range(20)]
    shapes += [square * [1, 1, 0] + [[0, 0, 0], [0, 0, 0], [0, 0, 0.3], [0, 0, 0]]]
    shapes += [np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])]
    vertices = np.concatenate([shape + [3.0 * number, 0, 0] for number, shape in enumerate(shapes)])
    first = 4 * np.arange(len(shapes))[:, None]
    triangles = np.stack([first + [0, 1, 2], first + [2, 3, 0]], axis=1).reshape(-1, 3)
    found = flat_polygons(vertices, triangles, labels(triangles))
    monkeypatch.setattr(mesh_polygons, "_quads", none_at_once)
    expected = flat_polygons(vertices, triangles, labels(triangles))
    assert len(found) == len(expected) == len(shapes) + 1
    for polygon, other in zip(found, expected, strict=True):
        assert {tuple(corner) for corner in polygon.corners} == {tuple(corner) for corner in other.corners}
        assert np.allclose(polygon.normal, other.normal) and np.isclose(area(polygon), area(other))


def none_at_once(vertices, first, second):
    return np.zeros((len(first), 4, 3)), np.zeros((len(first), 3)), np.zeros(len(first), bool)


def test_labels_are_not_mixed():
    vertices, triangles = grid(4, 1)
    colors = np.repeat([0, 1, 1, 0], 2)
    polygons = flat_polygons(vertices, triangles, colors)
    assert sorted((polygon.label, round(area(polygon))) for polygon in polygons) == [(0, 1), (0, 1), (1, 2)]


def test_a_cube_has_six_faces_that_look_outward():
    polygons = flat_polygons(CUBE, CUBE_TRIANGLES, labels(CUBE_TRIANGLES))
    assert len(polygons) == 6 and all(len(polygon.corners) == 4 for polygon in polygons)
    for polygon in polygons:
        assert np.dot(polygon.corners.mean(axis=0) - 0.5, polygon.normal) == pytest.approx(0.5)


@given(st.integers(0, 10_000))
def test_the_area_is_that_of_the_triangles(seed):
    """Random height fields over a random subset of a grid: flat, bent and degenerate parts."""
    generator = np.random.default_rng(seed)
    missing = {(x, y) for x in range(4) for y in range(3) if generator.random() < 0.3}
    vertices, triangles = grid(4, 3, missing)
    if len(triangles) == 0:
        return
    vertices[:, 2] = generator.choice([0.0, 0.0, 0.0, 0.5], len(vertices))
    pieces = flat_polygons(vertices, triangles, labels(triangles))
    a, b, c = (vertices[triangles[:, side]] for side in range(3))
    expected = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()
    assert sum(area(piece) for piece in pieces) == pytest.approx(expected, rel=1e-9)
    assert min(area(piece) for piece in pieces) > 0.0
    assert all(np.abs((piece.corners - piece.corners[0]) @ piece.normal).max() < 1e-9 for piece in pieces)


def test_triangles_without_area_are_left_out():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], dtype=float)
    (polygon,) = flat_polygons(vertices, np.array([(0, 1, 2), (0, 2, 3)]), np.zeros(2, dtype=int))
    assert area(polygon) == pytest.approx(1.0)
    assert flat_polygons(vertices, np.array([(0, 1, 2)]), np.zeros(1, dtype=int)) == []


def test_closed_means_that_every_edge_has_two_sides():
    assert is_closed(CUBE_TRIANGLES) and not is_closed(CUBE_TRIANGLES[1:])
    turned = CUBE_TRIANGLES.copy()
    turned[0] = turned[0][::-1]
    assert not is_closed(turned) and not is_closed(grid(2, 2)[1])


def test_volume_tells_the_side_and_the_solid_angle_the_inside():
    assert signed_volume(CUBE, CUBE_TRIANGLES) == pytest.approx(1.0)
    assert signed_volume(CUBE + 5.0, CUBE_TRIANGLES[:, ::-1]) == pytest.approx(-1.0)
    for point, inside in (((0.9, 0.1, 0.5), True), ((1.1, 0.1, 0.5), False), ((-4.0, 9.0, 2.0), False)):
        assert is_inside(np.array(point), CUBE, CUBE_TRIANGLES) == inside
        assert is_inside(np.array(point), CUBE, CUBE_TRIANGLES[:, ::-1]) == inside
