"""Rays to a sky that samples of a picture share with like ones around: beside closed forms; where they may not."""

from dataclasses import replace

import numpy as np
import pytest
from known_tracers import Tracer, floor, panel, past_spheres
from random_surfaces import unit

from ltsh_addon.cycles.environment import CUBE, SkyPicture, sky_lights
from ltsh_addon.scene import PASSES, Film, SkyLight, SurfaceSamples
from ltsh_addon.visibility import ratio
from ltsh_addon.visibility.emitter import Sky
from ltsh_addon.visibility.estimator import MOST_RAYS, RatioEstimator
from ltsh_addon.visibility.light_selection import LightSelection
from ltsh_addon.visibility.ray_sampler import JoinedLobes, SampleRows

SKY = sky_lights(
    SkyLight("Sky", [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], np.ones(3)),
    [SkyPicture(*axes, np.full((8, 8, 3), 2.0)) for axes in CUBE],
)[0]


def traced(samples, film, tracer, rays=256):
    return ratio.trace_visibility(samples, SKY, tracer, ratio.ShadowSampling(rays=rays, film=film), workers=1)


def test_a_ball_hides_its_form_factor_of_the_sky():
    """What a ball of radius r at height h hides of a cosine-weighted sky is r^2 h / d^3, d the distance of its center;
    a third of the rays that the samples take alone tells it better than a third of those rays alone would."""
    samples, film = floor(64)
    center, radius = np.array([0.2, -0.1, 0.9]), 0.6
    distance = np.linalg.norm(samples.position - center, axis=1)
    expected = 1.0 - radius**2 * center[2] / distance**3
    shared, alone = (traced(samples, one, past_spheres((center, radius))) for one in (film, None))
    errors = [found.diffuse[0] - expected for found in (shared, alone)]
    assert shared.rays < 0.35 * alone.rays
    # 256 stratified rays: 256^-0.75 is 1.6 %, of a half less.
    fewer = (alone.rays / shared.rays) ** 0.75
    assert np.sqrt(np.square(errors[0]).mean()) < min(0.01, fewer * np.sqrt(np.square(errors[1]).mean()))
    assert abs(errors[0].mean()) < 0.001
    assert 0.4 < shared.noise("diffuse") / np.sqrt(np.square(errors[0]).mean() / np.square(expected).mean()) < 2.5


@pytest.mark.parametrize(("size", "rays", "tolerance"), [(48, 1024, 0.03), (80, 256, 0.03), (80, 64, 0.06)])
def test_a_window_lets_its_form_factor_of_the_sky_through(size, rays, tolerance):
    """Some 1 to 9 % of a cosine-weighted sky: what is little everywhere is not negligible anywhere, and samples whose
    few rays all miss the window count as well."""
    samples, film = floor(size)
    far, (left, right), (low, high) = 3.0, (-0.8, 0.9), (0.9, 2.0)

    def passed(origins, directions, distances):
        along = (far - origins[:, 0]) / np.where(directions[:, 0] > 1e-6, directions[:, 0], np.inf)
        y, z = (origins[:, axis] + along * directions[:, axis] for axis in (1, 2))
        return (along > 0.0) & (y > left) & (y < right) & (z > low) & (z < high)

    # The share by quadrature over the window: cos cos / (pi r^2) dA.
    y, z = (first + (np.arange(40) + 0.5) / 40 * (last - first) for first, last in ((left, right), (low, high)))
    offset = np.stack(np.broadcast_arrays(far, y[:, None], z[None]), axis=-1).reshape(-1, 3) - samples.position[:, None]
    area = (right - left) * (high - low) / len(offset[0])
    expected = (offset[..., 0] * offset[..., 2] / np.square(offset).sum(axis=-1) ** 2).sum(axis=1) * area / np.pi
    assert 0.002 < expected.min() and expected.max() < 0.1
    found = traced(samples, film, Tracer(passed), rays=rays).diffuse[0]
    for part in (expected < np.median(expected), expected >= np.median(expected)):
        # 1,024 rays, of which some ten to twenty pass, shared by twelve pixels: no noise in the mean of a thousand. Of
        # 64 some 3,000 pass in the darker half, 2 % of noise.
        assert found[part].mean() / expected[part].mean() == pytest.approx(1.0, abs=tolerance)


def test_an_edge_of_the_shadow_stays_where_it_is():
    """Samples beside each other see all and nothing of the sky: sharing would blur that."""
    samples, film = floor(40)
    tracer = Tracer(lambda origins, directions, distances: origins[:, 0] > 0.05)
    found = traced(samples, film, tracer)
    for name in PASSES:
        np.testing.assert_array_equal(getattr(found, name)[0], samples.position[:, 0] > 0.05)


@pytest.mark.parametrize("lobe", ["normals", "roughness", "depth"])
def test_unlike_samples_share_nothing(lobe):
    """In a picture whose columns alternate between two surfaces, each sees what it sees by itself."""
    samples, film = floor(40)
    odd = np.arange(len(samples)) % 2 == 1
    tilted = np.where(odd[:, None], unit(np.array([0.8, 0.0, 1.0])), [0.0, 0.0, 1.0])
    if lobe == "normals":
        samples = replace(samples, **{name: tilted for name in ("normal", "diffuse_normal")},
                          geometric_normal=tilted, smooth_normal=tilted)  # fmt: skip
    elif lobe == "roughness":
        samples = replace(samples, roughness=np.where(odd, 0.1, 0.6))
    else:
        samples = replace(samples, position=samples.position - [0.0, 0.0, 3.0] * odd[:, None])
    tracer = Tracer(lambda origins, directions, distances: (directions[:, 0] > 0.1) | (origins[:, 2] < -1.0))
    mixed, found = traced(samples, film, tracer), {}
    for kind in (odd, ~odd):
        found[bool(kind[1])] = traced(samples.take(kind), None, tracer)
    for kind in (odd, ~odd):
        for name in PASSES:
            difference = getattr(mixed, name)[0, kind] - getattr(found[bool(kind[1])], name)[0]
            # Few samples of 256 rays each: 256^-0.75 = 1.6 %, twice, times 2 for the narrow lobe.
            assert np.sqrt(np.square(difference).mean()) < 0.05 and abs(difference.mean()) < 0.005, (name, kind[1])


def test_a_lobe_with_two_horizons_shares_its_rays():
    """Cycles' horizons make two samples of a lobe. Both together reflect what each reflects by itself."""
    whole, _ = floor(24)
    facet = unit(np.array([0.5, 0.3, 1.0]))
    weights, parts = (0.3, 0.7), []
    for number, weight in enumerate(weights):
        normal = np.broadcast_to(facet if number else np.array([0.0, 0.0, 1.0]), whole.position.shape)
        colors = {name: getattr(whole, name) * weight for name in ("specular_f0", "specular_f90")}
        diffuse = whole.diffuse_albedo * (number == 0)
        parts.append(replace(whole, geometric_normal=normal, diffuse_albedo=diffuse, **colors))
    order = np.argsort(np.tile(np.arange(len(whole)), 2), kind="stable")
    samples = SurfaceSamples.joined(parts).take(order)
    tracer = past_spheres(((0.3, 0.2, 0.5), 0.4), ((-1.0, -0.7, 0.3), 0.3))
    joined = JoinedLobes(samples)
    assert len(joined.samples) == len(whole) and (joined.index == np.repeat(np.arange(len(whole)), 2)).all()
    sums = []
    for some, lobes in ((parts[0], None), (parts[1], None), (joined.samples, joined)):
        selection = LightSelection(some, SKY, is_baked=False)
        pairs = RatioEstimator(SampleRows(some, PASSES, tracer, None, lobes), Sky(SKY), 0, selection)
        pairs._add_rays(np.arange(len(pairs.index)), 0, MOST_RAYS, 0)
        for name in PASSES:
            light = np.zeros((2, len(whole)))
            light[:, pairs.index] = pairs.unshadowed(name)
            light[1, pairs.index] *= pairs.visibility_ratio(name)[0]
            sums.append(light)
    for first, second, both in (sums[::2], sums[1::2]):
        # 1024^-0.75 is half a percent, on both sides.
        np.testing.assert_allclose(both, first + second, atol=0.03 * both.max())
        np.testing.assert_allclose(both.mean(axis=1), (first + second).mean(axis=1), rtol=0.002)
    shares = traced(samples, Film(24, 24, np.repeat(np.arange(len(whole)), 2)), tracer).specular[0]
    np.testing.assert_array_equal(shares[::2], shares[1::2])


def test_blocks_are_squares_of_the_picture_and_hold_each_sample_once(monkeypatch):
    monkeypatch.setattr(ratio, "BLOCK_SAMPLES", 200)
    film = Film(50, 40, np.repeat(np.arange(300, 1800), 2))
    blocks = ratio._blocks(3000, film)
    np.testing.assert_array_equal(np.sort(np.concatenate(blocks)), np.arange(3000))
    sides = [np.ptp(np.divmod(film.pixel[block], 50), axis=1) for block in blocks]
    assert len(blocks) < 24 and max(map(max, sides)) < 10 and max(map(len, blocks)) <= 200


def test_texels_have_the_mean_of_shadows_that_differ_by_noise_alone():
    """A screen at y = 1 hides what is left of x = 0.05: its shadow is sharp beside it and two metres wide far away.
    Beside the share by quadrature over the light."""
    samples, film = floor(64)
    samples = samples.take(samples.position[:, 1] < 0.95)
    film, light = replace(film, pixel=film.pixel[: len(samples)]), panel()

    def passed(origins, directions, distances):
        along = (1.0 - origins[:, 1]) / np.maximum(directions[:, 1], 1e-6)
        return (along > distances) | (origins[:, 0] + along * directions[:, 0] > 0.05)

    s, t = np.meshgrid(*2 * [(np.arange(64) + 0.5) / 32 - 1.0])
    offset = light.center + s.reshape(-1, 1) * light.half_u + t.reshape(-1, 1) * light.half_v
    offset = offset[None] - samples.position[:, None]
    squared = np.square(offset).sum(axis=-1)
    weight = np.maximum(-(offset @ light.direction), 0.0) * np.maximum(offset[..., 2], 0.0) / np.square(squared)
    x = samples.position[:, :1] + (1.0 - samples.position[:, 1:2]) / offset[..., 1] * offset[..., 0]
    expected = (weight * (x > 0.05)).sum(axis=1) / weight.sum(axis=1)
    errors = []
    for one in (film, None):
        sampling = ratio.ShadowSampling(("diffuse",), rays=128, film=one, is_baked=True)
        found = ratio.trace_visibility(samples, [light], Tracer(passed), sampling, workers=1)
        errors.append(found.diffuse[0] - expected)
    wide = (expected > 0.02) & (expected < 0.98) & (samples.position[:, 1] < 0.0)
    # Twelve texels: 3.5 times less noise. The quadrature errs, too, by a step of 1/64 at most.
    shared, alone = (np.sqrt(np.square(one[wide]).mean()) for one in errors)
    assert shared < 0.5 * alone and wide.sum() > 500
    assert np.abs(errors[0]).max() < 1.5 * np.abs(errors[1]).max()
