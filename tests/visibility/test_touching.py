"""Faces that touch samples, as where a box stands on a floor: what they block, known in closed form."""

import numpy as np
import pytest
from occluder_scenes import surface_samples
from test_planes import grid
from test_rays import libraries as libraries

from ltsh_addon.scene import light_of
from ltsh_addon.visibility import OccluderMesh, Occluders, ShadowSampling, Transparency, open_tracer, trace_visibility


def body(side=1.0, clear=None):
    """A box whose bottom is at the height 0, faces outward."""
    x = side / 2.0
    vertices = [(sx * x, sy * x, z) for z in (0.0, side) for sy in (-1, 1) for sx in (-1, 1)]
    faces = [(0, 3, 1), (0, 2, 3), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (1, 3, 7), (1, 7, 5), (3, 2, 6)]
    faces += [(3, 6, 7), (2, 0, 4), (2, 4, 6)]
    return OccluderMesh(vertices, faces, None if clear is None else Transparency(clear))


HERE, MIRROR = np.eye(3, 4), np.diag([-1.0, 1.0, 1.0, 1.0])[:3]
FLOOR, LAMP = grid(4.0), np.array([0.0, 0.0, 0.5])


def moved(height):
    """The matrix of a box that much, in m, above the floor."""
    return np.column_stack([np.eye(3), [0.0, 0.0, height]])


def shares(libraries, occluders, at=LAMP):
    """Shares (200,) of a lamp `at` a place that points of the floor below the box see, from the lamp's side."""
    points = np.append(np.random.default_rng(3).uniform(-0.45, 0.45, (200, 2)), np.zeros((200, 1)), axis=1)
    normal = np.tile([0.0, 0.0, np.sign(at[2])], (200, 1))
    values = {"half_u": [0.05, 0.0, 0.0], "half_v": [0.0, 0.05, 0.0], "direction": [0.0, 0.0, -1.0]}
    lamp = light_of({"name": "Lamp", "shape": "BALL", "center": at, "radiance": np.ones(3), **values})
    with open_tracer(occluders, libraries) as tracer:
        samples = surface_samples(points, normal, normal)
        return trace_visibility(samples, [lamp], tracer, ShadowSampling(("diffuse",)), workers=1).diffuse[0]


def fine(mesh):
    """`mesh`, its triangles cut in four, three times."""
    corners = mesh.vertices[mesh.triangles]
    for _ in range(3):
        a, b, c = np.moveaxis(corners, 1, 0)
        ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
        corners = np.concatenate(
            [np.stack(one, axis=1) for one in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return OccluderMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), mesh.transparency)


# The meshes of a scene with a lamp in the box, their matrices, and the share of its light below the box.
CASES = {
    "a box on a floor": ((FLOOR, body()), (HERE, HERE), 0.0),
    "a mirrored box": ((FLOOR, body()), (HERE, MIRROR), 0.0),
    "fine triangles": ((fine(FLOOR), fine(body())), (HERE, HERE), 0.0),
    "lets light through": ((FLOOR, body(clear=0.3)), (HERE, HERE), 0.3),
    "a few float steps above": ((FLOOR, body()), (HERE, moved(5e-7)), 0.0),
    "two thousandths of a millimeter above": ((FLOOR, body()), (HERE, moved(2e-6)), 0.0),
    "let into the floor": ((FLOOR, body()), (HERE, moved(-2e-6)), 1.0),
    "its bottom is missing": ((FLOOR, OccluderMesh(body().vertices, body().triangles[2:])), (HERE, HERE), 1.0),
}


@pytest.mark.parametrize("case", CASES)
def test_a_face_that_touches_another_one_blocks_its_light(libraries, case):
    meshes, matrices, expected = CASES[case]
    found = shares(libraries, Occluders(meshes, [0, 1], matrices))
    assert np.allclose(found, expected, atol=1e-6)


def test_a_floor_blocks_light_from_below_to_the_bottom_of_a_box(libraries):
    occluders = Occluders((FLOOR, body()), [0, 1], (HERE, HERE))
    assert not shares(libraries, occluders, at=-LAMP).any()


def test_one_mesh_touches_itself_and_instances_touch_a_floor(libraries):
    box = body()
    triangles = np.concatenate([FLOOR.triangles, box.triangles + len(FLOOR.vertices)])
    joined = OccluderMesh(np.concatenate([FLOOR.vertices, box.vertices]), triangles)
    beside = np.column_stack([np.eye(3), [1.4, 0.0, 0.0]])
    assert not shares(libraries, Occluders((joined,), [0], (HERE,))).any()
    assert not shares(libraries, Occluders((FLOOR, box), [0, 1, 1], (HERE, HERE, beside))).any()


def test_what_casts_no_shadow_blocks_nothing_where_it_touches(libraries):
    occluders = Occluders((FLOOR, body()), [0, 1], (HERE, HERE), masks=[1, 2], light_masks={"Lamp": 1})
    assert shares(libraries, occluders).all()
    occluders = Occluders((FLOOR, body()), [0, 1], (HERE, HERE), masks=[1, 2], light_masks={"Lamp": 3})
    assert not shares(libraries, occluders).any()


def turned(mesh):
    """`mesh`, its faces turned around."""
    return OccluderMesh(mesh.vertices, mesh.triangles[:, ::-1], mesh.transparency)


ASIDE = np.column_stack([np.eye(3), [1.9, 0.0, 0.0]])
# The meshes of a scene, and their matrices: of its first face, points that nothing is near see all of a lamp.
BEHIND = {
    "a box and its floor, both turned": ((turned(FLOOR), turned(body())), (HERE, ASIDE)),
    "a turned sheet beside another": ((turned(FLOOR), grid(0.1)), (HERE, ASIDE)),
    "a mirrored floor": ((FLOOR, turned(body())), (MIRROR, ASIDE)),
}


@pytest.mark.parametrize("case", BEHIND)
def test_a_face_seen_from_behind_is_not_in_its_own_way(libraries, case):
    """Where another face in its plane faced the other way, all of a floor was black."""
    assert np.array_equal(shares(libraries, Occluders(BEHIND[case][0], [0, 1], BEHIND[case][1])), np.ones(200))
