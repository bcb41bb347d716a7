"""Where the edge of a shadow crosses a pixel, a sample that stands for three places has the mean of their shadows."""

from dataclasses import replace

import numpy as np
from known_tracers import Tracer, floor, panel

from ltsh_addon.scene import PASSES, light_of
from ltsh_addon.visibility import ShadowSampling, trace_visibility

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
