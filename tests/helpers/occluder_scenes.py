"""Random meshes in the way of random rays, what these meet by a test of each triangle, and samples on meshes."""

from __future__ import annotations

import numpy as np

from ltsh_addon.scene import SurfaceSamples
from ltsh_addon.visibility import OccluderMesh, Occluders, Transparency
from ltsh_addon.visibility.occluders import ALL_RAYS

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
            shares[ray] *= clear.transmittance(*here)[0]
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
    # Transforms that hardly have an inverse would lose the digits of the rays.
    one, other = np.linalg.qr(rng.normal(size=(2, 6, 3, 3)))[0]
    scales = rng.uniform(0.2, 2.0, (6, 1, 3)) * rng.choice([-1, 1], (6, 1, 3))
    matrices = np.concatenate([(one * scales) @ other, rng.uniform(-3, 3, (6, 3, 1))], axis=2)
    masks = rng.choice([1, 2, 3, ALL_RAYS], 6)
    return Occluders(tuple(meshes), mesh, matrices, masks, light_masks={"Key": 1, "Fill": 6})


def random_rays(rng, count):
    origins, targets = rng.uniform(-4, 4, (2, count, 3)).astype(np.float32)
    directions = targets - origins
    distances = np.linalg.norm(directions, axis=1)
    directions = (directions / distances[:, None]).astype(np.float32)
    distances[rng.random(count) < 0.3] = np.inf
    return origins, directions, distances, rng.choice([1, 2, 4], count).astype(np.uint32)


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


def samples_on(mesh, matrix, rng, count, facets=None):
    """Samples anywhere on the triangles of a mesh, or on some, as Cycles would see them from outside."""
    triangle = rng.choice(len(mesh.triangles) if facets is None else facets, count)
    shares = rng.dirichlet((1.0, 1.0, 1.0), count)
    named = mesh.triangles[triangle]
    corners = mesh.vertices[named] @ matrix[:, :3].T + matrix[:, 3]
    position = np.einsum("pc,pck->pk", shares, corners)
    geometric = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    geometric *= np.sign(np.linalg.det(matrix[:, :3])) / np.linalg.norm(geometric, axis=1)[:, None]
    smooth = geometric
    if mesh.normals is not None:
        normals = mesh.normals[named] if mesh.normals.ndim == 2 else mesh.normals[triangle]
        smooth = np.einsum("pc,pck->pk", shares, normals) @ np.linalg.inv(matrix[:, :3])
        smooth /= np.linalg.norm(smooth, axis=1)[:, None]
    return surface_samples(*(values.astype(np.float32) for values in (position, geometric, smooth)))


def surface_samples(position, geometric, smooth):
    ones = np.ones(len(position))
    colors = np.ones((len(position), 3))
    return SurfaceSamples(
        position=position, view=geometric, normal=smooth, diffuse_normal=smooth, roughness=ones, specular_f0=colors,
        specular_f90=colors, dielectric=ones, ior=ones, diffuse_albedo=colors, geometric_normal=geometric,
        smooth_normal=smooth,
    )  # fmt: skip
