"""Which faces lie in one plane, against areas known in closed form."""

import numpy as np
import pytest

from ltsh_addon.visibility import OccluderMesh, Occluders
from ltsh_addon.visibility.occluders import PLANE_POINTS, overlaps_within

# Each of two objects gets half of the points, which are evenly spread: few of them, here 8, are in an area too many.
SLACK = 8.0 / (PLANE_POINTS / 2)
TURN = np.array([[0.6, -0.48, 0.64], [0.8, 0.36, -0.48], [0.0, 0.8, 0.6]])


def grid(side, cells=1, turn=None):
    """A square mesh around the origin, which faces up."""
    x = np.linspace(-side / 2, side / 2, cells + 1)
    vertices = np.stack([*np.meshgrid(x, x), np.zeros((cells + 1, cells + 1))], axis=-1).reshape(-1, 3)
    corner = np.add.outer(np.arange(cells) * (cells + 1), np.arange(cells)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 1, cells + 2], corner + [0, cells + 2, cells + 1]])
    return OccluderMesh(vertices if turn is None else vertices @ turn.T, faces)


def box(side=1.0):
    """A cube whose top faces up, at the origin."""
    square = grid(side).vertices
    vertices = np.concatenate([square, square - [0, 0, side]])
    sides = [(0, 1, 5), (0, 5, 4), (1, 3, 7), (1, 7, 5), (3, 2, 6), (3, 6, 7), (2, 0, 4), (2, 4, 6)]
    return OccluderMesh(vertices, [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), *np.array(sides)[:, ::-1]])


def placed(*meshes, at):
    """Each mesh once, at the points `at`, all turned by `TURN`."""
    matrices = [np.column_stack([TURN, TURN @ point]) for point in np.asarray(at, float)]
    return Occluders(meshes, np.arange(len(meshes)), matrices)


FLIP = np.diag([1.0, -1.0, -1.0])
# Two meshes, where they are, and the shares of the faces of each in the plane that lie in the other's.
CASES = {
    "a rug on a floor": ((grid(4.0), grid(1.0)), [(0, 0, 2), (0.3, 0.2, 2)], (1 / 16, 1.0)),
    "a rug with its face down": ((grid(4.0), grid(1.0, turn=FLIP)), [(0, 0, 2), (0.3, 0.2, 2)], (1 / 16, 1.0)),
    "a rug half over an edge": ((grid(4.0), grid(1.0)), [(0, 0, 2), (2.0, 0.2, 2)], (1 / 32, 0.5)),
    "a rug a hundredth of a millimeter above": ((grid(4.0), grid(1.0)), [(0, 0, 2), (0.3, 0.2, 2.00001)], None),
    "a fine floor and many triangles elsewhere": (
        (grid(4.0, 100), grid(1.0), *[grid(9.0, 120)] * 9),
        [(0, 0, 2), (0.3, 0.2, 2), *[(0, 0, -k) for k in range(9)]],
        (1 / 16, 1.0),
    ),
    "a box stands on a floor": ((grid(4.0), box()), [(0, 0, 1), (0, 0, 2)], None),
    "a box is let into a floor": ((grid(4.0), box()), [(0, 0, 2), (0, 0, 2)], (1 / 16, 1.0)),
    "a box beside a box": ((box(), box()), [(0, 0, 2), (1.0, 0, 2)], None),
}


@pytest.mark.parametrize("case", CASES)
def test_faces_of_two_objects_in_one_plane_are_told_with_their_shares(case):
    meshes, at, shares = CASES[case]
    overlaps = placed(*meshes, at=at).overlaps(np.arange(len(meshes)))
    if shares is None:
        assert not overlaps
    else:
        assert set(overlaps) == {(0, 1), (1, 0)}
        assert [overlaps[0, 1], overlaps[1, 0]] == pytest.approx(shares, abs=SLACK)


def test_an_owner_does_not_overlap_itself_and_one_without_a_number_counts_not():
    occluders = placed(*[grid(1.0)] * 3, at=[(0, 0, 2), (0.5, 0, 2), (0.25, 0, 2)])
    assert not occluders.overlaps(np.zeros(3, int))
    assert set(occluders.overlaps(np.array([0, -1, 1]))) == {(0, 1), (1, 0)}


def test_many_triangles_of_one_object_in_a_plane():
    """A fine grid overlaps nothing; two, of which one is moved by half a side, share half of each."""
    mesh = grid(2.0, 60)
    assert overlaps_within([mesh]) == (0.0, 0.0)
    moved = OccluderMesh(mesh.vertices + [1.0, 0.0, 0.0], mesh.triangles)
    assert overlaps_within([mesh, moved]) == pytest.approx((0.5, 0.5), abs=SLACK)
    back = OccluderMesh(mesh.vertices, mesh.triangles[:, ::-1])
    assert overlaps_within([mesh, back]) == pytest.approx((0.0, 1.0), abs=SLACK)


@pytest.mark.parametrize(("height", "held"), [(0.0, True), (1e-5, False), (-1e-5, False)])
def test_a_face_holds_points_of_its_plane(height, held):
    """Of a light without area the plane is not known: a point is in any face there. Slivers hold none."""
    sliver = OccluderMesh(np.array([[-4, 0, 0], [4, 0, 0], [0, 0, 0]], np.float32), np.array([[0, 1, 2]]))
    occluders = placed(grid(4.0, 5), box(), sliver, at=[(0, 0, 2), (0, 0, -3), (0, 0.2, 2)])
    inside = [(0.1, 0.2, 2 + height), (0.4, 0.2, 2 + height)]
    for points, expected in ((inside, [0] if held else []), ([(3.0, 0.2, 2), (2.2, 0.2, 2)], [])):
        points = np.array(points) @ TURN.T
        assert occluders.holding(points, TURN[:, 2]).tolist() == expected
        assert occluders.holding(points[:1], None).tolist() == expected
