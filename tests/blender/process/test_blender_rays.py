"""Rays that the second Blender casts, beside those of Embree."""

import numpy as np
import pytest
from occluder_scenes import answers, random_occluders, random_rays, samples_on, sphere

from ltsh_addon.blender.process import blender_rays
from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.blender.process.blender_rays import open_rays
from ltsh_addon.visibility import OccluderMesh, Occluders, open_tracer, rays


@pytest.fixture
def no_embree(monkeypatch):
    monkeypatch.setattr(blender_rays, "embree_libraries", list)
    monkeypatch.setattr(rays, "SYSTEM_LIBRARIES", ("libembree-that-is-not-there.so",))


def test_without_embree_blender_casts_the_rays(tmp_path, no_embree):
    warnings = []
    rng = np.random.default_rng(9)
    occluders, cast = random_occluders(rng), random_rays(rng, 2000)
    expected, is_sure = answers(occluders, *(values.astype(np.float64) for values in cast[:3]), cast[3])
    with open_rays(occluders, tmp_path, warnings.append) as tracer:
        found = tracer.transmittance(*cast)
        assert np.array_equal(tracer.transmittance(*(values[5:9] for values in cast)), found[5:9])
        assert "mathutils" in tracer.description
    assert len(warnings) == 1 and "libembree-that-is-not-there.so" in warnings[0] and "slower" in warnings[0]
    wrong = (np.abs(found - expected) > 1e-4) & is_sure
    assert wrong.mean() < 2e-3 and 0.05 < (found == 0.0).mean() < 0.9 and ((found > 0.0) & (found < 1.0)).sum() > 20


def test_rays_of_blender_start_where_those_of_embree_do(tmp_path, no_embree):
    rng = np.random.default_rng(2)
    vertices, triangles = sphere(8)
    mesh, place = OccluderMesh(vertices, triangles, normals=vertices), np.eye(3, 4)
    occluders, samples = Occluders((mesh,), [0], [place]), samples_on(mesh, place, rng, 300)
    with open_tracer(occluders, embree_libraries()) as tracer:
        expected = tracer.starts(samples)
    with open_rays(occluders, tmp_path, lambda text: None) as tracer:
        found = tracer.starts(samples)
        directions = samples.geometric_normal
        origins = found.origins(np.arange(300), directions)
        assert tracer.transmittance(origins, directions, np.full(300, np.inf)).all()
        assert not tracer.transmittance(origins, -directions, np.full(300, np.inf)).any()
    np.testing.assert_allclose(found.lift, expected.lift, atol=1e-6)
    np.testing.assert_allclose(found.clearance, expected.clearance, rtol=1e-5)
