"""Where the edge of a shadow crosses a pixel, a sample that stands for three points has the mean of their shadows."""

from dataclasses import replace

import numpy as np
import pytest
from known_tracers import Tracer, floor, panel
from occluder_scenes import samples_on

from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.scene import PASSES, Film, light_of
from ltsh_addon.visibility import OccluderMesh, Occluders, ShadowSampling, open_tracer, trace_visibility

SUN = light_of(
    {"name": "Sun", "shape": "DISK", "center": np.array([0.0, 0.0, 1e4]), "direction": np.array([0.0, 0.0, -1.0]),
     "half_u": np.array([10.0, 0.0, 0.0]), "half_v": np.array([0.0, 10.0, 0.0]), "radiance": np.ones(3)}
)  # fmt: skip
PLACES = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [-0.1, 0.08, 0.0]])


def edge(origins, directions, distances):
    """A half-plane 1 m above the floor hides what is left of x = 0.05 there."""
    return (origins + directions / directions[:, 2:])[:, 0] > 0.05


def test_a_sample_has_the_mean_shadow_of_the_places_for_which_it_stands():
    samples, film = floor(16)
    extent = np.broadcast_to(PLACES[1:], (len(samples), 2, 3)).astype(np.float32)
    for light, rays, error in ((SUN, 64, 0.01), (panel(), 1024, 0.02)):
        sampling = ShadowSampling(rays=rays, film=replace(film, extent=extent))
        found = trace_visibility(samples, [light], Tracer(edge), sampling)
        moved = [replace(samples, position=samples.position + place) for place in PLACES]
        alone = [trace_visibility(one, [light], Tracer(edge), ShadowSampling(rays=1024)) for one in moved]
        for name in PASSES:
            share = getattr(found, name)[0]
            expected = np.mean([getattr(one, name)[0] for one in alone], axis=0)
            # A third of 8 rays is 2 or 3; lobes weigh the rays of a large light differently.
            assert np.abs(share - expected).max() < (0.1 if light is SUN else 0.15), (light.name, name)
            assert np.abs(share - expected).mean() < error
        crossed = (expected > 0.2) & (expected < 0.8)
        assert crossed.any()
    # Without the places there is no sun in part.
    own = trace_visibility(samples, [SUN], Tracer(edge), ShadowSampling(rays=64, film=film))
    assert set(np.unique(own.diffuse.round(1))) == {0.0, 1.0}


def test_no_place_lies_below_a_hollow_surface():
    """Samples in strips of a trough, 2 cm wide each and 5e-4 rad apart, stand for points on the strips beside."""
    if not embree_libraries():
        pytest.skip("this Python has no bpy, which brings Embree")
    x = 0.02 * np.arange(-50, 51)
    y, z = np.meshgrid([-1.0, 1.0], 0.0125 * x * x, indexing="ij")
    vertices = np.stack([np.tile(x, 2), y.ravel(), z.ravel()], axis=1)
    first = np.arange(100)
    quads = np.stack([first, first + 1, first + 102, first + 101], axis=1)
    mesh = OccluderMesh(vertices.astype(np.float32), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
    samples = samples_on(mesh, np.eye(3, 4), np.random.default_rng(0), 400)
    low, high = samples.geometric_normal, samples.position.copy()
    samples = replace(samples, **dict.fromkeys(("geometric_normal", "smooth_normal"), low * np.sign(low[:, 2:])))
    strip = np.floor(samples.position[:, 0] / 0.02)
    on_next = 0.02 * (strip + 1.5)
    high[:, 0] = on_next
    high[:, 2] = np.interp(on_next, x, 0.0125 * x * x)
    extent = (high - samples.position).astype(np.float32)[:, None]
    film = Film(20, 20, np.arange(400), extent=extent)
    with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)]), embree_libraries()) as tracer:
        for off in (0.0, 2e-6):  # as Cycles has it, and as graphics cards do
            near = replace(samples, position=samples.position + np.float32(off) * samples.geometric_normal)
            found = trace_visibility(near, [SUN], tracer, ShadowSampling(rays=8, film=film))
            assert (found.diffuse == 1.0).all()
