"""Glowing convex meshes as outlines: against all of their lights one by one in double precision, and closed forms."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from surface_scenes import random_samples, unit

from ltsh_addon import shading
from ltsh_addon.emitters.light_tree import FEWEST
from ltsh_addon.emitters.mesh_polygons import balls, convex_bodies, fewer_corners
from ltsh_addon.scene import PointLight, PolygonLight
from ltsh_addon.shading import float32

# What an outline of 32 corners and the points of a light tree may be off; the closed form of a ball besides what its
# mesh of 24 rings lacks.
OFF = 3e-3


def lathe(profile, count=32):
    """Quadrilaterals and triangles (V, 3) around the z axis, outward; `profile` is (radius, z) from the lower pole."""
    turn = 2.0 * np.pi * np.arange(count) / count
    rings = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(count, z)], axis=1) for r, z in profile]
    faces = []
    for (low, high), (below, above) in zip(pairwise(rings), pairwise(profile), strict=True):
        for first, second in zip(range(count), np.roll(range(count), -1), strict=True):
            corners = [low[first], low[second], high[second], high[first]]
            if below[0] == 0.0:
                corners.pop(0)
            elif above[0] == 0.0:
                corners.pop(2)
            faces.append(np.array(corners))
    return faces


def ball(count=24):
    angle = np.linspace(0.0, np.pi, count + 1)
    return lathe([(np.sin(a) if 0 < k < count else 0.0, -np.cos(a)) for k, a in enumerate(angle)], 2 * count)


def capsule():
    angle = np.linspace(0.0, 0.5 * np.pi, 9)
    lower = [(0.3 * np.sin(a), -0.7 - 0.3 * np.cos(a)) for a in angle]
    return lathe([*lower, *((r, -z) for r, z in lower[::-1])])


def egg():
    """A ball with sides of unlike lengths, turned."""
    axes = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    axes[0] *= np.sign(np.linalg.det(axes))
    return [(face * (0.3, 0.9, 0.5)) @ axes for face in ball(16)]


def cut_gem():
    """A body of few corners, of which some lights meet others at sharp edges."""
    return lathe([(0.0, -1.0), (0.9, -0.1), (1.0, 0.0), (0.95, 0.05), (0.5, 0.4), (0.0, 0.45)], 16)


def lights_of(faces, center=(0.0, 0.0, 0.0), way=1, radiance=(3.0, 2.0, 1.0)):
    """A light for each face that shines outward; inward if `way` is -1."""
    lights = []
    for corners in faces:
        corners = corners + center
        crossed = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal = way * crossed / np.linalg.norm(crossed)
        half = corners.max(axis=0) - corners.min(axis=0)
        u = unit(corners[1] - corners[0]) * np.linalg.norm(half)
        place = {"center": corners.mean(axis=0), "half_u": u, "half_v": np.cross(normal, u), "direction": normal}
        lights.append(PolygonLight(name="Lamp", radiance=radiance, corners=corners, **place))
    return lights


def samples_around(count, lowest_roughness=0.3, nearest=1.3, seed=1):
    """Random lobes around a body at the origin, most of which face it."""
    generator = np.random.default_rng(seed)
    samples = random_samples(count, seed, lowest_roughness)
    position = unit(generator.normal(size=(count, 3))) * generator.uniform(nearest, 5.0, size=(count, 1))
    normal = unit(unit(-position) + 0.5 * generator.normal(size=(count, 3)))
    view = unit(normal + 0.9 * unit(generator.normal(size=(count, 3))))
    normals = dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), normal)
    return replace(samples, position=position, view=view, **normals)


def bodies(lights):
    return convex_bodies(lights, [light.polygon() for light in lights])


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("make", [ball, capsule, egg, cut_gem])
@pytest.mark.parametrize("way", [1, -1])
def test_outlines_reflect_what_all_lights_do(make, way, monkeypatch):
    """Outward and inward, near and far, in all passes; lobes of roughness .02 on are taken in double precision."""
    lights, samples = lights_of(make(), way=way), samples_around(120, 0.02)
    assert len(lights) >= FEWEST and [len(body.numbers) for body in bodies(lights)] == [len(lights)]
    used, add = [], float32._Lighting._add_outlines
    monkeypatch.setattr(
        float32._Lighting, "_add_outlines", lambda self, *some: used.append(len(some[2][0])) or add(self, *some)
    )
    single = shading.shade(samples, lights, "ltsh4", workers=1, rows=[0] * len(lights))
    double = shading.shade(samples, lights, "ltsh4", workers=1, rows=[0] * len(lights), dtype=np.float64)
    assert sum(used) > 0
    assert relative_error(single.diffuse, double.diffuse) < OFF
    truth = shading.shade(samples, lights, shading.REFERENCE, passes=["specular"], workers=1).specular.sum(axis=0)
    # The tails of lobes are nearer to the truth where a body is one light.
    off = relative_error(double.specular[0], truth)
    assert relative_error(single.specular[0], truth) < off + OFF


def test_a_ball_lights_as_its_closed_form():
    """A diffuse surface that faces a ball: the squared sine of its radius. The mesh lacks .4 % of its section."""
    lights, samples = lights_of(ball(24), radiance=(1.0, 1.0, 1.0)), samples_around(50, nearest=1.5)
    normal = unit(-samples.position)
    samples = replace(samples, diffuse_normal=normal, smooth_normal=normal, diffuse_albedo=np.ones((50, 3)),
                      diffuse_roughness=np.zeros(50), sheen_a=np.zeros(50))  # fmt: skip
    found = shading.shade(samples, lights, "ltsh4", passes=["diffuse"], workers=1).diffuse.sum(axis=0)[:, 0]
    np.testing.assert_allclose(found, 1.0 / (samples.position**2).sum(axis=1), rtol=7e-3)


def test_the_area_of_an_outline_is_that_of_the_lights_that_face_a_far_point():
    for make in (ball, capsule, egg, cut_gem):
        lights = lights_of(make())
        toward = unit(np.random.default_rng(1).normal(size=(40, 3)))
        expected = np.maximum(toward @ np.array([light.area_vector for light in lights]).T, 0.0).sum(axis=1)
        area = np.zeros(40)
        for outlines in bodies(lights)[0].outlines(1e4 * toward.T, 1.0):
            area[outlines.points] = outlines.area
        np.testing.assert_allclose(area, expected, rtol=1e-3)


def test_what_is_inside_or_close_to_a_flat_side_is_left_to_the_lights():
    body = bodies(lights_of(ball()))[0]
    position = np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 1.001], [0.0, 0.0, 3.0]])
    seen = [outlines.points.tolist() for outlines in body.outlines(position.T, 1.0)]
    assert seen == [[2]]
    lights = lights_of(ball(), way=-1)
    samples = samples_around(30, nearest=0.1)
    samples = replace(samples, position=0.15 * samples.position)
    single, double = (
        shading.shade(samples, lights, "ltsh4", passes=["diffuse"], workers=1, dtype=dtype).diffuse.sum(axis=0)
        for dtype in (np.float32, np.float64)
    )
    assert relative_error(single, double) < OFF


def test_dents_holes_and_other_colors_are_no_bodies():
    faces = ball(12)
    assert bodies(lights_of(faces[:-1])) == []
    dented = [
        np.where(np.linalg.norm(face - [0, 0, 1], axis=1, keepdims=True) < 0.3, face * 0.8, face) for face in faces
    ]
    assert bodies(lights_of(dented)) == []
    ring = [(1.0 + 0.3 * np.cos(a), 0.3 * np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 13)]
    assert bodies(lights_of(lathe(ring))) == []
    lights = lights_of(faces)
    lights[7] = replace(lights[7], radiance=np.ones(3))
    assert bodies(lights) == []


def test_each_of_several_balls_is_a_body_and_mirrored_ones_are_too():
    faces = ball(8)
    mirrored = [(face * (-1.0, 1.0, 1.0))[::-1] for face in faces]
    lights = lights_of(faces) + lights_of(mirrored, (4.0, 0.0, 0.0)) + lights_of(faces, (0.0, 4.0, 0.0), -1)
    assert [len(body.numbers) for body in bodies(lights)] == [len(faces)] * 3
    samples = samples_around(100, nearest=1.6)
    single, double = (
        shading.shade(samples, lights, "ltsh4", passes=["diffuse"], workers=1, dtype=dtype).diffuse.sum(axis=0)
        for dtype in (np.float32, np.float64)
    )
    assert relative_error(single, double) < OFF


def test_fewer_corners_keep_area_and_centroid_and_stay_where_outlines_turn():
    """A square with rounded corners keeps its straight sides."""
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    x, y = np.sign(np.cos(angle)) * 5.0 + np.cos(angle), np.sign(np.sin(angle)) * 3.0 + np.sin(angle)
    flat = np.stack([x, y])[:, :, None]
    coarse = fewer_corners(flat, np.array([200]), 32)
    areas = []
    for x, y in (flat[..., 0], coarse[..., 0]):
        areas.append(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    np.testing.assert_allclose(areas[1], areas[0], rtol=1e-6)
    assert np.abs(coarse[0]).max() == pytest.approx(6.0, rel=3e-3)


def mesh_of(*bodies):
    """Vertices, triangles and labels, by body, of the faces of several bodies; no vertex is shared."""
    faces = [(number, face) for number, body in enumerate(bodies) for face in body]
    triangles, labels = [], []
    for number, face in faces:
        triangles += [face[[0, side, side + 1]] for side in range(1, len(face) - 1)]
        labels += [number] * (len(face) - 2)
    vertices = np.concatenate(triangles)
    return vertices, np.arange(len(vertices)).reshape(-1, 3), np.array(labels)


def moved(faces, scale, offset):
    return [scale * face + offset for face in faces]


def test_parts_of_meshes_that_are_nearly_spheres_are_known():
    apart = np.array([5.0, 0.0, 0.0])
    parts = ball(8), moved(ball(12), 0.5, apart), egg(), moved(capsule(), 1.0, 2.0 * apart), cut_gem()
    parts = [moved(part, 1.0, number * apart[[1, 0, 2]]) for number, part in enumerate(parts)]
    vertices, triangles, labels = mesh_of(*parts)
    found = sorted(balls(vertices, triangles, labels), key=lambda one: one.label)
    assert [one.label for one in found] == [0, 1] and [one.radius for one in found] == pytest.approx([1.0, 0.5])
    np.testing.assert_allclose([one.center for one in found], [[0.0, 0.0, 0.0], [5.0, 5.0, 0.0]], atol=1e-9)
    for one in found:
        assert (labels[one.triangles] == one.label).all() and len(one.triangles) == (labels == one.label).sum()
    # One sphere of two materials, and two in one place.
    half = np.where(vertices[triangles].mean(axis=1)[:, 0] > 0.0, 1, 0)
    assert not [one for one in balls(vertices, triangles, half) if one.radius > 0.9]
    vertices, triangles, labels = mesh_of(ball(8), ball(8))
    assert not balls(vertices, triangles, 0 * labels)
    # A shell: its inside shines inward.
    vertices, triangles, labels = mesh_of(ball(8), [face[::-1] for face in moved(ball(8), 0.9, 0.0)])
    for side, radius in ((1, 1.0), (-1, 0.9)):
        assert [one.radius for one in balls(vertices, triangles, labels, side)] == pytest.approx([radius])


@pytest.mark.parametrize(("count", "off"), [(8, 0.02), (16, 0.005)])
def test_a_sphere_with_the_power_of_a_ball_s_faces_lights_as_they_do(count, off):
    """Faces of a ball of 8 rings lie up to 4 % nearer to its center than its corners, of 16 rings 1 %."""
    (one,) = balls(*mesh_of(ball(count)))
    radiance = np.array([3.0, 2.0, 1.0])
    axes = {"half_u": one.radius * np.eye(3)[0], "half_v": one.radius * np.eye(3)[1], "direction": np.eye(3)[2]}
    share = one.area / (4.0 * np.pi * one.radius**2)
    light = PointLight(name="Lamp", center=one.center, radiance=share * radiance, **axes)
    faces, samples = lights_of(ball(count), radiance=radiance), samples_around(200, 0.3)
    expected = shading.shade(samples, faces, "ltsh4", workers=1, rows=[0] * len(faces), dtype=np.float64)
    found = shading.shade(samples, [light], "ltsh4", workers=1)
    for name in ("diffuse", "specular"):
        assert relative_error(getattr(found, name)[0], getattr(expected, name)[0]) < off, name
