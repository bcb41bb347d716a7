"""Rays through occluders, against a test of every triangle in double precision."""

import numpy as np
import pytest

from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.scene import SceneError
from ltsh_addon.visibility import OccluderMesh, Occluders, Transparency, open_tracer, rays

# Near the edge of a triangle, or where a ray ends on it, single precision may decide otherwise: in units of the scene,
# whose coordinates are below 8.
DOUBTFUL = 8 * 2.0**-20


def crossings(occluders, origins, directions, distances):
    """For each instance the masks (R, T) of its triangles that rays surely cross, and surely or perhaps cross, and the
    place (R, T, 2) on them; Moeller and Trumbore 1997."""
    for number, matrix in zip(occluders.mesh, occluders.matrices, strict=True):
        mesh = occluders.meshes[number]
        corners = (mesh.vertices.astype(np.float64) @ matrix[:, :3].T + matrix[:, 3])[mesh.triangles]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        p = np.cross(directions[:, None], second)
        determinant = (first * p).sum(axis=-1)
        start = origins[:, None] - corners[:, 0]
        q = np.cross(start, first)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (start * p).sum(axis=-1) / determinant
            v = (directions[:, None] * q).sum(axis=-1) / determinant
            t = (second * q).sum(axis=-1) / determinant
        size = np.linalg.norm(first, axis=-1) + np.linalg.norm(second, axis=-1)
        normal = np.linalg.norm(np.cross(first, second), axis=-1)
        # How far the place on the plane moves by rounding, in units of u and v, and of t.
        slope = np.abs(determinant) / np.maximum(normal, 1e-30)
        off = DOUBTFUL * size / np.maximum(normal * slope, 1e-30)
        inside = np.minimum(np.minimum(u, v), 1.0 - u - v)
        along = np.minimum(t, distances[:, None] - t)
        yield (inside > off) & (along > DOUBTFUL / slope), (inside > -off) & (along > -DOUBTFUL / slope), u, v


def answers(occluders, origins, directions, distances, masks):
    """Shares of light (R,) and a mask of the rays for which they are sure."""
    shares, is_sure, met = np.ones(len(origins)), np.ones(len(origins), bool), np.zeros(len(origins), int)
    for number, (surely, perhaps, u, v) in enumerate(crossings(occluders, origins, directions, distances)):
        clear = occluders.meshes[occluders.mesh[number]].transparency
        counts = (masks & occluders.masks[number]) != 0
        surely, perhaps = surely & counts[:, None], perhaps & counts[:, None]
        is_sure &= (surely == perhaps).all(axis=1)
        if clear is None:
            shares[surely.any(axis=1)] = 0.0
            continue
        for ray, triangle in zip(*np.nonzero(surely), strict=True):
            here = np.array([triangle]), u[ray, [triangle]], v[ray, [triangle]]
            shares[ray] *= clear.shares(*here)[0]
            met[ray] += 1
    shares[met > occluders.transparent_surfaces] = 0.0
    return shares, is_sure


def random_occluders(rng):
    """Meshes, some transparent, some with several instances that are moved, turned, sheared and mirrored."""
    meshes = []
    for kind in range(4):
        count = int(rng.integers(1, 12))
        vertices = rng.uniform(-1, 1, (3 * count, 3))
        triangles = rng.permutation(3 * count).reshape(count, 3)
        clear = None
        if kind == 2:
            clear = Transparency(rng.uniform(0, 1))
        if kind == 3:
            image = rng.uniform(-0.2, 1.2, (5, 7)).astype(np.float32)
            clear = Transparency(0.9, image, rng.uniform(-1, 2, (count, 3, 2)), "REPEAT", "Closest")
        meshes.append(OccluderMesh(vertices, triangles, clear))
    mesh = rng.integers(0, 4, 6)
    matrices = np.concatenate([rng.normal(size=(6, 3, 3)), rng.uniform(-3, 3, (6, 3, 1))], axis=2)
    masks = rng.choice([1, 2, 3, rays.ALL_RAYS], 6)
    return Occluders(tuple(meshes), mesh, matrices, masks)


def random_rays(rng, count):
    origins, targets = rng.uniform(-4, 4, (2, count, 3)).astype(np.float32)
    directions = targets - origins
    distances = np.linalg.norm(directions, axis=1)
    directions = (directions / distances[:, None]).astype(np.float32)
    distances[rng.random(count) < 0.3] = np.inf
    return origins, directions, distances, rng.choice([1, 2, 4], count).astype(np.uint32)


@pytest.fixture(scope="module")
def libraries():
    found = embree_libraries()
    if not found:
        pytest.skip("this Python has no bpy, which brings Embree")
    return found


def test_random_scenes_are_as_each_triangle_says(libraries):
    sure, partly = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        occluders, cast = random_occluders(rng), random_rays(rng, 300)
        expected, is_sure = answers(occluders, *(values.astype(np.float64) for values in cast[:3]), cast[3])
        with open_tracer(occluders, libraries) as tracer:
            found = tracer.transmittance(*cast)
        # Single precision moves the place in an image by some 1e-6 of its size.
        wrong = np.flatnonzero((np.abs(found - expected) > 1e-5) & is_sure)
        is_partly = (expected > 0.0) & (expected < 1.0)
        assert len(wrong) <= 0.002 * len(found), (seed, found[wrong], expected[wrong])
        assert not len(wrong) or is_partly[wrong].all(), f"seed {seed}: rays {wrong} blocked otherwise"
        sure += is_sure.sum()
        partly += (is_partly & is_sure).sum()
    assert sure > 0.98 * 40 * 300 and partly > 300


def test_chunks_and_their_ends_change_nothing(libraries):
    rng = np.random.default_rng(7)
    occluders, cast = random_occluders(rng), random_rays(rng, 2 * rays.CHUNK + 5)
    with open_tracer(occluders, libraries) as tracer:
        whole = tracer.transmittance(*cast)
        for part in (slice(0, 1), slice(0, 7), slice(3, 20), slice(rays.CHUNK - 3, rays.CHUNK + 9), slice(0, 0)):
            assert np.array_equal(tracer.transmittance(*(values[part] for values in cast)), whole[part])


def test_no_ray_slips_between_the_triangles_of_a_closed_mesh(libraries):
    rng = np.random.default_rng(3)
    vertices, triangles = sphere(24)
    with open_tracer(Occluders((OccluderMesh(vertices, triangles),), [0], [np.eye(3, 4)]), libraries) as tracer:
        # Towards vertices and along edges, where a ray is on the border of its triangles.
        targets = np.concatenate([vertices, vertices[triangles].mean(axis=1), vertices[triangles[:, :2]].mean(axis=1)])
        origins = rng.uniform(-0.3, 0.3, targets.shape)
        directions = (targets - origins) / np.linalg.norm(targets - origins, axis=1)[:, None]
        assert not tracer.transmittance(origins, directions, np.full(len(targets), np.inf)).any()


def sphere(rows):
    """A closed unit sphere: vertices (V, 3) and triangles (T, 3)."""
    polar, around = np.pi * np.arange(1, rows) / rows, 2.0 * np.pi * np.arange(2 * rows) / (2 * rows)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], axis=-1)
    vertices = [[[0, 0, 1.0]], *(np.sin(p) * ring + [0, 0, np.cos(p)] for p in polar), [[0, 0, -1.0]]]
    n, triangles = 2 * rows, []
    for j in range(n):
        k = (j + 1) % n
        triangles += [(0, 1 + j, 1 + k)]
        for i in range(rows - 2):
            a, b, c, d = 1 + i * n + j, 1 + i * n + k, 1 + (i + 1) * n + j, 1 + (i + 1) * n + k
            triangles += [(a, c, b), (b, c, d)]
        triangles += [(1 + (rows - 1) * n, 1 + (rows - 2) * n + k, 1 + (rows - 2) * n + j)]
    return np.concatenate(vertices), np.array(triangles)


def test_instances_are_as_copies_of_the_mesh(libraries):
    rng = np.random.default_rng(5)
    vertices, triangles = sphere(8)
    mesh = OccluderMesh(vertices, triangles)
    matrices = np.concatenate([0.5 * rng.normal(size=(20, 3, 3)), rng.uniform(-3, 3, (20, 3, 1))], axis=2)
    copies = tuple(OccluderMesh(vertices @ m[:, :3].T + m[:, 3], triangles) for m in matrices)
    cast = random_rays(rng, 20_000)[:3]
    with open_tracer(Occluders((mesh,), np.zeros(20, int), matrices), libraries) as tracer:
        found = tracer.transmittance(*cast)
    with open_tracer(Occluders(copies, np.arange(20), [np.eye(3, 4)] * 20), libraries) as tracer:
        expected = tracer.transmittance(*cast)
    assert 0.3 < found.mean() < 0.7
    # Rays at silhouettes, where the rounding of the matrix decides.
    assert (found != expected).mean() < 1e-3


def test_a_ray_ends_after_as_many_transparent_surfaces_as_cycles_allows(libraries):
    pane = OccluderMesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]], Transparency(0.9))
    for most in (0, 1, 7, 8, 9):
        stack = np.tile(np.eye(3, 4), (8, 1, 1))
        stack[:, 2, 3] = np.arange(1, 9)
        with open_tracer(Occluders((pane,), [0] * 8, stack, transparent_surfaces=most), libraries) as tracer:
            found = tracer.transmittance([[0, 0, 0]], [[0, 0, 1]], [np.inf])
        assert found == pytest.approx(0.9**8 if most >= 8 else 0.0, abs=1e-6)


def test_occluders_come_back_from_their_file(tmp_path):
    rng = np.random.default_rng(11)
    occluders = random_occluders(rng)
    occluders.save(tmp_path / "occluders.npz")
    back = Occluders.load(tmp_path / "occluders.npz")
    for name in ("mesh", "matrices", "masks", "terminators", "transparent_surfaces", "warnings"):
        assert np.array_equal(getattr(back, name), getattr(occluders, name))
    for mesh, other in zip(occluders.meshes, back.meshes, strict=True):
        assert np.array_equal(mesh.vertices, other.vertices) and np.array_equal(mesh.triangles, other.triangles)
        if mesh.transparency is None:
            assert other.transparency is None
            continue
        point = np.arange(len(mesh.triangles)), *rng.uniform(0, 0.5, (2, len(mesh.triangles)))
        assert np.array_equal(mesh.transparency.shares(*point), other.transparency.shares(*point))


def test_an_unfit_library_is_not_trusted(libraries, tmp_path, monkeypatch):
    monkeypatch.setattr(rays, "_trusted", {})
    occluders = Occluders((), [], np.zeros((0, 3, 4)))
    no_library = tmp_path / "libembree4.so.4"
    no_library.write_bytes(b"no library")
    monkeypatch.setattr(rays, "SYSTEM_LIBRARIES", ())
    with pytest.raises(SceneError, match=r"libembree4\.so\.4: "):
        open_tracer(occluders, [no_library])
    # Another one is taken.
    with open_tracer(occluders, [no_library, *libraries]) as tracer:
        assert tracer.description.startswith("Embree 4.")
        assert tracer.transmittance([[0, 0, 0]], [[0, 0, 1]], [1.0]) == 1.0
    # One that answers wrongly is not.
    monkeypatch.setattr(rays, "_trusted", {})
    monkeypatch.setattr(rays, "_FLOAT3X4", 0x9234)  # column by column
    with pytest.raises(SceneError, match="rays of known answer"):
        open_tracer(occluders, libraries)


def test_what_is_no_mesh_is_refused():
    with pytest.raises(ValueError, match="vertex 3"):
        OccluderMesh(np.zeros((3, 3)), [[0, 1, 3]])
    with pytest.raises(ValueError, match="share"):
        Transparency(1.5)
    with pytest.raises(ValueError, match="mesh 1"):
        Occluders((OccluderMesh(np.zeros((3, 3)), [[0, 1, 2]]),), [1], np.zeros((1, 3, 4)))
