"""Rays through occluders, against a test of every triangle in double precision."""

from dataclasses import replace

import numpy as np
import pytest
from occluder_scenes import answers, random_occluders, random_rays, samples_on, sphere, surface_samples

from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.cycles.texels import EXTENSIONS, INTERPOLATIONS
from ltsh_addon.scene import PASSES, PolygonLight, SceneError
from ltsh_addon.visibility import (
    OccluderMesh,
    Occluders,
    ShadowSampling,
    Transparency,
    open_tracer,
    rays,
    trace_visibility,
)


@pytest.fixture(scope="module")
def libraries():
    found = embree_libraries()
    if not found:
        pytest.skip("this Python has no bpy, which brings Embree")
    return found


@pytest.mark.parametrize("seeds", [range(40), pytest.param(range(1000, 2000), marks=pytest.mark.soak)])
def test_random_scenes_are_as_each_triangle_says(libraries, seeds):
    sure, partly = 0, 0
    for seed in seeds:
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
    assert sure > 0.98 * len(seeds) * 300 and partly > 7 * len(seeds)


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


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e30, 0.0])
def test_rays_that_are_none_disturb_no_other(libraries, number):
    rng = np.random.default_rng(6)
    occluders, (origins, directions, distances, masks) = random_occluders(rng), random_rays(rng, 4000)
    wrong = rng.random(4000) < 0.3
    with open_tracer(occluders, libraries) as tracer:
        expected = tracer.transmittance(origins, directions, distances, masks)
        for values in (origins, directions, distances):
            kept = values[wrong]
            values[wrong] = number
            found = tracer.transmittance(origins, directions, distances, masks)
            assert np.array_equal(found[~wrong], expected[~wrong])
            assert ((found >= 0.0) & (found <= 1.0)).all()
            values[wrong] = kept


def test_meshes_that_are_none_disturb_no_other(libraries):
    rng = np.random.default_rng(6)
    occluders, cast = random_occluders(rng), random_rays(rng, 4000)
    with open_tracer(occluders, libraries) as tracer:
        expected = tracer.transmittance(*cast)
    nowhere = OccluderMesh(np.full((3, 3), np.nan), [[0, 1, 2]])
    far = OccluderMesh(np.full((3, 3), 1e30), [[0, 1, 2]])
    point, empty = OccluderMesh(np.zeros((3, 3)), [[0, 1, 2]]), OccluderMesh(np.zeros((0, 3)), np.zeros((0, 3)))
    flat = np.zeros((8, 3, 4))
    flat[:, 0, 0] = 1.0  # onto a line
    mesh = np.concatenate([occluders.mesh, 4 + np.arange(8) % 4])
    more = Occluders(
        (*occluders.meshes, nowhere, far, point, empty),
        mesh,
        np.concatenate([occluders.matrices, flat]),
        np.concatenate([occluders.masks, np.full(8, rays.ALL_RAYS)]),
    )
    with open_tracer(more, libraries) as tracer:
        assert np.array_equal(tracer.transmittance(*cast), expected)


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


def blocky_image(rng, size):
    """Blocks of 8 pixels that let nothing, something or everything through."""
    return np.kron(rng.choice([0.0, 0.3, 1.0], (size // 8, size // 8)), np.ones((8, 8))).astype(np.float32)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_what_an_image_cuts_out_lets_through_what_its_pixels_say(libraries, extension, interpolation):
    rng = np.random.default_rng(8)
    for outside in (0.0, 1.0):
        image = Transparency(
            1.0, blocky_image(rng, 32), rng.uniform(-1, 2, (4, 3, 2)), extension, interpolation, outside
        )
        mesh = OccluderMesh(rng.uniform(-2, 2, (12, 3)), np.arange(12).reshape(4, 3), image)
        for most in (8, 1024):
            walls = Occluders((mesh,), [0, 0], [np.eye(3, 4), 1.2 * np.eye(3, 4)], transparent_surfaces=most)
            cast = random_rays(rng, 3000)
            expected, is_sure = answers(walls, *(values.astype(np.float64) for values in cast[:3]), cast[3])
            with open_tracer(walls, libraries) as tracer:
                found = tracer.transmittance(*cast)
            # Single precision moves the place in an image by some 1e-5 pixels: with no interpolation that decides for
            # as large a share of the rays times the number of borders on their way.
            assert ((np.abs(found - expected) > 1e-4) & is_sure).mean() < 1e-3
            assert {0.0, 1.0} < set(np.round(expected, 3))


@pytest.mark.parametrize(
    "extension, outside, blocks", [("REPEAT", 1.0, True), ("CLIP", 1.0, False), ("CLIP", 0.0, True)]
)
def test_a_surface_blocks_where_neither_its_image_nor_what_is_beside_it_is_clear(extension, outside, blocks):
    """As of a picture with an alpha channel that is full: no ray then has to look at its pixels."""
    uv = np.array([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]])
    image = Transparency(1.0, np.zeros((4, 4), np.float32), uv, extension, outside=outside)
    wall = Occluders((OccluderMesh(np.eye(3), [[0, 1, 2]], image),), [0], [np.eye(3, 4)])
    assert [len(index) for index in wall.split()] == [blocks, not blocks]
    clear = replace(image, image=np.eye(4, dtype=np.float32))
    assert not clear.is_opaque and replace(clear, share=0.0).is_opaque


def test_occluders_come_back_from_their_file(tmp_path):
    rng = np.random.default_rng(11)
    occluders = random_occluders(rng)
    hair = OccluderMesh(np.eye(3), [[0, 1, 2]], normals=rng.normal(size=(1, 3, 3)), thickness=[0.5])
    occluders = replace(occluders, meshes=(*occluders.meshes, hair))
    occluders.save(tmp_path / "occluders.npz")
    back = Occluders.load(tmp_path / "occluders.npz")
    for name in ("mesh", "matrices", "masks", "terminators", "transparent_surfaces", "light_masks"):
        assert np.array_equal(getattr(back, name), getattr(occluders, name))
    for mesh, other in zip(occluders.meshes, back.meshes, strict=True):
        assert np.array_equal(mesh.vertices, other.vertices) and np.array_equal(mesh.triangles, other.triangles)
        assert np.array_equal(mesh.normals, other.normals) and np.array_equal(mesh.thickness, other.thickness)
        if mesh.transparency is None:
            assert other.transparency is None
            continue
        point = np.arange(len(mesh.triangles)), *rng.uniform(0, 0.5, (2, len(mesh.triangles)))
        assert np.array_equal(mesh.transparency.transmittance(*point), other.transparency.transmittance(*point))


def test_an_unfit_library_is_not_trusted(libraries, tmp_path, monkeypatch):
    monkeypatch.setattr(rays, "_trusted", {})
    occluders = Occluders((), [], np.zeros((0, 3, 4)))
    no_library = tmp_path / "libembree4.so.4"
    no_library.write_bytes(b"no library")
    monkeypatch.setattr(rays, "SYSTEM_LIBRARIES", ())
    with pytest.raises(SceneError, match=r"shadows need Embree 4.*libembree4\.so\.4: .*--shadows off"):
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


# Where rays start:


def directions_around(normals, rng, per_sample):
    """For each normal (P, 3) directions of its hemisphere (P * per_sample, 3), and the number of their sample."""
    index = np.repeat(np.arange(len(normals)), per_sample)
    directions = rng.normal(size=(len(index), 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    facing = np.einsum("rk,rk->r", directions, normals[index])
    return index, (directions * np.sign(facing)[:, None]).astype(np.float32)


def seen(tracer, samples, index, directions, distance=np.inf):
    starts = tracer.ray_origins(samples)
    origins = starts.origins(index, directions)
    return starts, tracer.transmittance(origins, directions, np.full(len(index), distance))


@pytest.mark.parametrize("place", [0.0, 3.0, 100.0, 2000.0])
@pytest.mark.parametrize("instances", [1, 2])
def test_a_convex_surface_does_not_hide_itself(libraries, place, instances):
    rng = np.random.default_rng(int(place) + instances)
    vertices, triangles = sphere(16)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    matrix = np.concatenate([1.3 * turn, [[place], [-place], [0.3 * place]]], axis=1)
    for normals in (None, vertices):
        mesh = OccluderMesh(vertices, triangles, normals=normals)
        matrices = [matrix, np.concatenate([np.eye(3), [[0], [0], [50.0 + place]]], axis=1)][:instances]
        with open_tracer(Occluders((mesh,), [0] * instances, matrices), libraries) as tracer:
            samples = samples_on(mesh, matrix, rng, 3000)
            index, directions = directions_around(samples.smooth_normal, rng, 8)
            facing = np.einsum("rk,rk->r", directions, samples.geometric_normal[index])
            index, directions = index[facing > 1e-6], directions[facing > 1e-6]
            starts, found = seen(tracer, samples, index, directions, 20.0)
        assert (starts.terminator > 0.0).mean() == (0.0 if normals is None else 1.0)
        assert found.all(), f"{(found == 0).sum()} of {found.size} rays are blocked"


def test_samples_that_are_rounded_to_below_their_triangle_are_not_hidden_by_it(libraries):
    """As graphics cards round them: by several times what a ray keeps off."""
    rng = np.random.default_rng(8)
    vertices, triangles = sphere(16)
    mesh, matrix = OccluderMesh(vertices, triangles, normals=vertices), np.eye(3, 4)
    matrix[:, 3] = 3.0, -3.0, 1.0
    with open_tracer(Occluders((mesh,), [0], [matrix]), libraries) as tracer:
        samples = samples_on(mesh, matrix, rng, 2000)
        index, directions = directions_around(samples.geometric_normal, rng, 8)
        facing = np.einsum("rk,rk->r", directions, np.minimum(samples.geometric_normal, samples.smooth_normal)[index])
        index, directions = index[facing > 0.2], directions[facing > 0.2]
        below = replace(samples, position=samples.position - 1e-5 * samples.geometric_normal)
        starts, found = seen(tracer, below, index, directions, 20.0)
    assert found.all(), f"{(found == 0).sum()} of {found.size} rays are blocked"
    np.testing.assert_allclose(starts.position, samples.position, atol=2e-6)


def test_a_large_plane_of_many_triangles_does_not_hide_itself(libraries):
    rng = np.random.default_rng(2)
    # Triangles of all sizes side by side, in a plane that no axis is parallel to.
    corners = np.sort(np.concatenate([rng.uniform(-40, 40, 30), rng.normal(0, 0.1, 30), [-40, 40]]))
    x, y = np.meshgrid(corners, corners, indexing="ij")
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) @ turn.T + [1, 2, 3]
    n = len(corners)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    mesh = OccluderMesh(vertices, triangles)
    with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)]), libraries) as tracer:
        samples = samples_on(mesh, np.eye(3, 4), rng, 20_000)
        index, directions = directions_around(samples.geometric_normal, rng, 8)
        _, found = seen(tracer, samples, index, directions)
    facing = np.einsum("rk,rk->r", directions, samples.geometric_normal[index])
    assert found[facing > 1e-4].all(), f"{(found == 0).sum()} of {found.size} rays are blocked"


def test_nothing_leaks_through_a_wall_of_a_millimetre(libraries):
    rng = np.random.default_rng(4)
    for place in (0.0, 30.0, 300.0):
        low, high = np.array([-2, -0.0005, -2]), np.array([2, 0.0005, 2])
        vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
        quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        triangles = np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])
        matrix = np.concatenate([np.linalg.qr(rng.normal(size=(3, 3)))[0], np.full((3, 1), place)], axis=1)
        matrix[:, 0] *= np.sign(np.linalg.det(matrix[:, :3]))
        mesh = OccluderMesh(vertices, triangles)
        with open_tracer(Occluders((mesh,), [0], [matrix]), libraries) as tracer:
            samples = samples_on(mesh, matrix, rng, 5000, [4, 5, 6, 7])  # on its wide sides
            index, directions = directions_around(samples.geometric_normal, rng, 4)
            _, found = seen(tracer, samples, index, directions)
            assert found.all()
            _, found = seen(tracer, samples, index, -directions)
            assert not found.any(), f"{found.sum()} of {found.size} rays leak {place} m away"


def test_a_smooth_sphere_is_lit_up_to_its_horizon_as_cycles_lifts_it(libraries):
    """Light that falls on the smooth surface from behind a flat triangle passes it, but for what Cycles cuts."""
    rng = np.random.default_rng(8)
    vertices, triangles = sphere(12)
    mesh = OccluderMesh(vertices, triangles, normals=vertices)
    blocked = {}
    for terminator in (0.0, 0.1, 1.0):
        with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)], terminators=[terminator]), libraries) as tracer:
            samples = samples_on(mesh, np.eye(3, 4), rng, 4000)
            index, directions = directions_around(samples.smooth_normal, rng, 8)
            starts, found = seen(tracer, samples, index, directions)
            facing = np.einsum("rk,rk->r", directions, samples.geometric_normal[index])
            assert found[facing > 1e-3].all()
            blocked[terminator] = 1.0 - found[facing < -1e-3].mean()
        # At the corners of a triangle the smooth surface is the triangle, in the middle it is above.
        height = np.linalg.norm(starts.position + starts.lift[0], axis=1) - np.linalg.norm(starts.position, axis=1)
        assert 0.0 <= height.min() < 1e-3 and height.max() < 2.0 * (1.0 - np.cos(np.pi / 12))
    assert blocked[0.0] == 1.0 and blocked[0.1] < 0.01 and blocked[1.0] < 0.01, blocked


@pytest.mark.parametrize("instances", [1, 2])
@pytest.mark.parametrize("tilt", [0.3, 2.0])
def test_triangles_have_the_sides_that_their_smooth_normals_have_in_the_mesh(libraries, instances, tilt):
    """Smooth normals are `tilt` rad off those of the triangles, on the other side where a quad is bent. Samples whose
    specular lobe ends at the smooth horizon have the smooth normal as geometric one."""
    rng = np.random.default_rng(10)
    vertices, triangles = sphere(6)
    edges = vertices[triangles[:, 1:]] - vertices[triangles[:, :1]]
    flat = np.cross(edges[:, 0], edges[:, 1])
    along = edges[:, 0] / np.linalg.norm(edges[:, 0], axis=1)[:, None]
    tilted = np.cos(tilt) * flat / np.linalg.norm(flat, axis=1)[:, None] + np.sin(tilt) * along
    mesh = OccluderMesh(vertices, triangles, normals=np.repeat(tilted[:, None], 3, axis=1))
    for mirror in (1.0, -1.0):
        matrix = np.diag([1.5, 0.7, mirror]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        matrix = np.concatenate([matrix, [[1], [2], [3]]], 1)
        matrices = [matrix, np.eye(3, 4) + 20.0 * np.eye(3, 4, k=3)][:instances]
        with open_tracer(Occluders((mesh,), [0] * instances, matrices), libraries) as tracer:
            samples = samples_on(mesh, matrix, rng, 2000)
            ended = replace(samples, geometric_normal=samples.smooth_normal)
            index, directions = directions_around(samples.smooth_normal, rng, 8)
            expected, seen_from_face = seen(tracer, samples, index, directions)
            found, seen_from_smooth = seen(tracer, ended, index, directions)
        for starts in (expected, found):
            np.testing.assert_allclose(starts.geometric_normal, samples.geometric_normal, atol=1e-5)
        # Rays within rounding of a triangle's plane may take its other side.
        assert np.mean(seen_from_face != seen_from_smooth) < 1e-3


def test_lifted_rays_go_to_the_same_points(libraries):
    rng = np.random.default_rng(9)
    vertices, triangles = sphere(6)
    mesh = OccluderMesh(vertices, triangles, normals=vertices)
    with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)]), libraries) as tracer:
        samples = samples_on(mesh, np.eye(3, 4), rng, 50)
        starts = tracer.ray_origins(samples)
    index = rng.integers(0, 50, 40)
    directions = rng.normal(size=(3, 7, 40)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=0)
    distances = rng.uniform(0.5, 5.0, (7, 40)).astype(np.float32)
    origins, aimed, lengths, _ = starts.aimed(index, directions, distances)
    for ray in range(7):
        np.testing.assert_array_equal(origins[:, ray].T, starts.origins(index, directions[:, ray].T))
    position = samples.position[index].T[:, None]
    off = np.linalg.norm(origins + aimed * lengths - position - directions * distances, axis=0)
    lifted = np.linalg.norm(origins - position, axis=0) > 1e-3
    assert 0.05 < lifted.mean() < 0.9
    # By rounding of coordinates up to 6, and for rays that are not lifted by the clearance.
    assert off[lifted].max() < 2e-6 and off.max() < 2e-6 + starts.clearance.max()
    np.testing.assert_allclose(np.linalg.norm(aimed, axis=0), 1.0, rtol=1e-6)


@pytest.mark.parametrize("place", [0.0, 2e4])
def test_a_sample_below_a_near_surface_starts_on_its_own(libraries, place):
    """Below a shelf: its light comes in sideways. 20 km away, positions are rounded to 2 mm."""
    square = np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    vertices = np.concatenate([square, 0.5 * square + (0.0, 0.0, 0.08)]) + (place, 0.0, 0.0)
    mesh = OccluderMesh(vertices.astype(np.float32), np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]))
    rng = np.random.default_rng(3)
    position = np.concatenate([rng.uniform(-0.4, 0.4, (50, 2)), np.zeros((50, 1))], axis=1) + (place, 0.0, 0.0)
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)]), libraries) as tracer:
        starts, share = seen(tracer, surface_samples(position, up, up), np.arange(50), up.astype(np.float32))
    assert np.abs(starts.position[:, 2]).max() < 0.01 and not share.any()


def test_a_sample_off_all_triangles_starts_beside_its_surface(libraries):
    mesh = OccluderMesh(*sphere(8))
    with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)]), libraries) as tracer:
        up = np.array([[0.0, 0, 1]])
        starts = tracer.ray_origins(surface_samples(np.array([[0.0, 0, 4]]), up, up))
    assert starts.terminator == 0 and 0 < starts.clearance[0] < 1e-4
    above, below = starts.origins(np.array([0, 0]), np.array([[0, 0, 1], [0, 0, -1]], np.float32))
    assert below[2] < 4.0 < above[2]


def glowing_faces(mesh):
    """A light for each triangle of a mesh whose front is outside."""
    lights = []
    for corners in mesh.vertices.astype(np.float64)[mesh.triangles]:
        normal, u = np.cross(corners[1] - corners[0], corners[2] - corners[0]), corners[1] - corners[0]
        if np.linalg.norm(normal) > 1e-9:
            normal /= np.linalg.norm(normal)
            axes = np.stack([u, np.cross(normal, u)]) / np.linalg.norm(u)
            place = (corners - corners[0]) @ axes.T
            middle, half = 0.5 * (place.min(axis=0) + place.max(axis=0)), 0.5 * np.ptp(place, axis=0)
            lights.append(
                PolygonLight("Lamp", center=corners[0] + middle @ axes, half_u=half[0] * axes[0],
                    half_v=half[1] * axes[1], direction=normal, radiance=np.ones(3), corners=corners,
                )
            )  # fmt: skip
    return lights


@pytest.mark.parametrize("rows", [4, 8], ids=["each face by itself", "faces that share their rays"])
def test_a_convex_lamp_does_not_stand_in_its_own_light(libraries, rows):
    """Nothing is between a point and a face of a convex body that it sees, however close the body comes to a floor so
    large that rays start well above it."""
    vertices, triangles = sphere(rows)
    lamp = OccluderMesh((vertices + [0.0, 0.0, 1.001]).astype(np.float32), triangles)
    corners = 1000.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    floor = OccluderMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    rng, up = np.random.default_rng(4), np.tile([0.0, 0.0, 1.0], (300, 1))
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, 300), rng.uniform(0.05, 2.0, 300)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * radius], axis=1)
    lights = glowing_faces(lamp)
    with open_tracer(Occluders((floor, lamp), [0, 1], [np.eye(3, 4)] * 2), libraries) as tracer:
        found = trace_visibility(surface_samples(position, up, up), lights, tracer, ShadowSampling(rays=64), workers=1)
    assert len(found.numbers) == (1 if rows == 8 else len(lights))
    # Of faces that are seen nearly edge-on, rounding decides, and they give next to no light.
    offsets = np.array([[light.corners - place for place in position] for light in lights])
    height = -np.einsum("epck,ek->epc", offsets, [light.direction for light in lights])
    is_sure = (height > 0.01 * np.linalg.norm(offsets, axis=-1)).all(axis=-1)
    for name in PASSES:
        share = getattr(found, name)
        if rows == 4:
            np.testing.assert_array_equal(share[is_sure], 1.0)
        else:
            assert share.min() > 0.99 and share.mean() > 0.9999


def test_a_tracer_that_is_dropped_frees_what_embree_holds(libraries, monkeypatch):
    """Views drop theirs after each change of a surface, unclosed: a thread may still use it."""
    tracer, released = open_tracer(random_occluders(np.random.default_rng(1)), libraries), []
    embree, scenes = tracer._caster._embree, [one for scene in tracer._caster._scenes for one in scene._scenes]
    release = embree.ReleaseScene
    monkeypatch.setattr(embree, "ReleaseScene", lambda scene: (released.append(scene), release(scene)))
    del tracer
    assert len(scenes) >= 2 and sorted(released) == sorted(scenes)


@pytest.mark.parametrize("corners", [3, 4, 9])
@pytest.mark.parametrize("count", [1, 80])
def test_a_face_that_glows_is_not_in_its_own_light_far_from_the_origin(libraries, corners, count):
    """At 3 km positions are rounded to .24 mm, which was more than rays end before a light at grazing angles: up to a
    fifth of its light was missing. 80 faces share their rays."""
    center, tilt = np.array([3000.0, -1500.0, 750.0]), 0.7
    right, away = np.array([np.cos(tilt), np.sin(tilt), 0.0]), np.array([-np.sin(tilt), np.cos(tilt), 0.1])
    away /= np.linalg.norm(away)
    up = np.cross(away, right)
    angle = 2.0 * np.pi * np.arange(corners) / corners + 0.3
    ring = 0.5 * (np.cos(angle)[:, None] * right + np.sin(angle)[:, None] * up) / np.sqrt(count)
    lights, vertices = [], []
    for number in range(count):
        middle = center + (number - 0.5 * count + 0.5) * right / np.sqrt(count)
        vertices.append(middle + ring)
        shape = {
            "half_u": 0.5 * right,
            "half_v": 0.5 * np.cross(away, right),
            "direction": away,
            "radiance": np.ones(3),
        }
        lights.append(PolygonLight("Lamp", center=middle, corners=middle + ring, **shape))
    fan = np.array([[0, place, place + 1] for place in range(1, corners - 1)])
    triangles = np.concatenate([fan + number * corners for number in range(count)])
    # A wall beside the light, seen from the light at all angles down to a thousandth.
    height = np.geomspace(3e-3, 0.6, 40)[:, None]
    across = np.linspace(-1.0, 1.0, 20)[None]
    position = center + height[..., None] * away + across[..., None] * right - 1.2 * up
    position = position.reshape(-1, 3).astype(np.float32).astype(float)
    samples = surface_samples(position, *2 * [np.broadcast_to(up, position.shape)])
    faces = OccluderMesh(np.concatenate(vertices), triangles)
    with open_tracer(Occluders((faces,), [0], [np.eye(3, 4)]), libraries) as tracer:
        found = trace_visibility(samples, lights, tracer, ShadowSampling(passes=("diffuse",)))
    assert (found.diffuse == 1.0).all(), np.sort(found.diffuse, axis=None)[:9]
