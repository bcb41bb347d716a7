"""Many lights that share their rays: beside each by itself, and beside closed forms."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import textbook
from known_tracers import OPEN, WALL, Tracer, floor, past_spheres
from random_surfaces import unit

from ltsh_addon import shading
from ltsh_addon.pipeline import lighting, relight
from ltsh_addon.pipeline.relight import RelightData
from ltsh_addon.scene import PASSES, PolygonLight, light_of
from ltsh_addon.visibility import estimator, light_cluster, ratio, shared_numbers
from ltsh_addon.visibility.light_cluster import LightCluster
from ltsh_addon.visibility.light_selection import LightSelection
from ltsh_addon.visibility.ray_sampler import SampleRows

THREE_SPHERES = past_spheres(((0.0, 0.3, 0.6), 0.35), ((-1.0, -0.5, 0.3), 0.3), ((1.0, 1.2, 1.0), 0.3))


def ceiling(count=100, color=(1.0, 0.5, 0.25), **changes):
    """Lamps of all shapes and of brightness 1 to 4, 2 to 3 m over the floor, most of which face it."""
    generator, lights = np.random.default_rng(count), []
    for number in range(count):
        direction = unit(np.array([0.0, 0.0, -1.0]) + 0.5 * generator.normal(size=3))
        half_u = generator.uniform(0.03, 0.1) * unit(np.cross(direction, [0.3, 1.0, 0.0]))
        center = np.append(generator.uniform(-3.0, 3.0, 2), generator.uniform(2.0, 3.0))
        half_v, corners = 0.6 * np.cross(direction, half_u), None
        shape = ("RECTANGLE", "ELLIPSE", "POLYGON")[number % 3]
        if shape == "POLYGON":
            # From a triangle to an arrow that is not convex.
            places = np.array([[-1, -1], [1, -1], [0, 1], [-0.5, 0], [-0.9, 0.4]])[: 3 + number % 9 // 3]
            corners = center + places @ np.stack([half_u, half_v])
        radiance = generator.uniform(1.0, 4.0) * np.array(color)
        values = {"name": "Lamp", "shape": shape, "center": center, "half_u": half_u, "half_v": half_v}
        values |= {"direction": direction, "radiance": radiance, "corners": corners}
        lights.append(light_of(values | changes))
    return lights


def shadows_of(samples, lights, tracer, film=None, **options):
    found = ratio.trace_visibility(samples, lights, tracer, ratio.ShadowSampling(film=film, **options), workers=1)
    shares = {name: getattr(found, name) for name in PASSES}
    return lighting.Shadows(shares, found.numbers, {}, found.rays, "")


def test_lights_of_one_color_group_and_kind_share_their_rays():
    red, blue = ceiling(70, (1.0, 0.0, 0.0)), ceiling(70, (0.0, 0.0, 1.0))
    few, grouped = ceiling(9, group="Few"), ceiling(64, group="Many")
    odd = [replace(red[0], spread=1.0), replace(red[0], radiance=-np.ones(3)), replace(red[0], receivers=(1,))]
    lights = [*red[:35], *odd, *blue, *few, *red[35:], *grouped]
    numbers = shared_numbers(lights)
    assert sorted(sum(numbers, ())) == list(range(len(lights)))
    assert sorted(map(len, numbers)) == [1] * 12 + [64, 70, 70]
    shared = [{(lights[number].group, *np.sign(lights[number].radiance)) for number in own} for own in numbers]
    assert all(len(kinds) == 1 for kinds in shared)


@pytest.mark.parametrize("roughness, count", ((0.1, 99), (0.4, 99), (0.4, 500)))
def test_rays_bring_the_light_of_all_lamps(roughness, count):
    """The weights of 1024 rays beside midpoints of all lamps: at 2 m cells of 2 cm, errors of 1e-4."""
    samples, _ = floor(5, roughness)
    lights = [light for light in ceiling(count) if not isinstance(light, PolygonLight)]
    cluster = LightCluster(lights)
    assert (len(cluster.cut) < len(cluster.brightness)) == (len(lights) > light_cluster.CUT)
    surface = SampleRows(samples, PASSES, OPEN.ray_origins(samples) and OPEN)
    pairs = estimator.RatioEstimator(surface, cluster, 0, LightSelection(samples, cluster.selected_as, False))
    pairs._add_rays(np.arange(len(pairs.index)), 0, estimator.MOST_RAYS, 0)
    expected = {name: np.zeros(len(samples)) for name in PASSES}
    place = (np.arange(10) + 0.5) / 5.0 - 1.0
    s, t = (axis.ravel() for axis in np.meshgrid(place, place))
    for light in lights:
        inside = (s * s + t * t <= 1.0) if light.is_round else np.ones(s.shape, bool)
        points = light.center + s[inside, None] * light.half_u + t[inside, None] * light.half_v
        toward = points - samples.position[:, None]
        distance = np.linalg.norm(toward, axis=2)
        toward /= distance[..., None]
        area = np.linalg.norm(light.area_vector) / inside.sum()
        light_cosine = np.maximum(-toward @ light.direction, 0.0)
        power = light.radiance.mean() * area * light_cosine / distance**2
        expected["diffuse"] += (power * np.maximum(toward[..., 2], 0.0)).sum(axis=1) * 0.5 / np.pi
        half = unit(toward + samples.view[:, None])
        lobe = textbook.ggx_of_cosines(half[..., 2], toward[..., 2], samples.view[:, None, 2], roughness**2)
        expected["specular"] += (power * np.maximum(toward[..., 2], 0.0) * lobe).sum(axis=1) * 0.5
    for name in PASSES:
        found = pairs.unshadowed(name)
        assert np.linalg.norm(found - expected[name]) < 0.02 * np.linalg.norm(expected[name]), name


def test_shares_are_0_in_the_dark_and_1_in_the_open():
    samples, film = floor(16)
    for light in (ceiling(99), ceiling(99, affects_specular=False)):
        for tracer, share in ((OPEN, 1.0), (WALL, 0.0)):
            found = ratio.trace_visibility(samples, light, tracer, ratio.ShadowSampling(film=film))
            assert found.diffuse.shape == (1, 256) and found.of_lights("diffuse").shape == (99, 256)
            assert (found.diffuse == share).all()
            assert (found.specular == (share if light[0].affects_specular else 1.0)).all()


@pytest.mark.parametrize("roughness", (0.1, 0.3))
def test_shadows_are_those_of_each_lamp_by_itself(roughness, monkeypatch):
    samples, film = floor(20, roughness)
    lights = ceiling(80, (1.0, 0.2, 0.1)) + ceiling(70, (0.1, 0.2, 1.0))
    shared = shadows_of(samples, lights, THREE_SPHERES, film, rays=256)
    assert len(shared.numbers) == 2
    monkeypatch.setattr(light_cluster.light_tree, "FEWEST", len(lights))
    alone = shadows_of(samples, lights, THREE_SPHERES, film, rays=64)
    assert len(alone.numbers) == 150 and shared.rays < 0.5 * alone.rays
    monkeypatch.undo()
    for name in PASSES:
        found, expected = (
            getattr(lighting.shade_lights(samples, lights, "ltsh4", (name,), (one,), workers=1)[0], name)
            for one in (shared, alone)
        )
        # Noise of each sample; none of it in the mean of all.
        assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)
        np.testing.assert_allclose(found.sum(axis=(0, 1)), expected.sum(axis=(0, 1)), rtol=1e-2)


def test_a_point_beside_a_glowing_pebble_is_not_dark_because_its_first_rays_meet_nothing(monkeypatch):
    """Of a ball of radius 5 cm, 1 cm is above the floor, and what is higher than 4 mm is hidden: most of the lamps
    that rays choose are below the horizon, and the ray to the highest corner is blocked. Beside each lamp by itself no
    sample has lost half: 256 rays of which one in twelve meets light have 20 % of noise."""
    samples, film = floor(16)
    turn, z = np.arange(400) * np.pi * (3.0 - np.sqrt(5.0)), (np.arange(400) + 0.5) / 200.0 - 1.0
    normals = np.column_stack([np.cos(turn) * np.sqrt(1.0 - z * z), np.sin(turn) * np.sqrt(1.0 - z * z), z])
    lights = []
    for normal in normals:
        half_u = 0.004 * unit(np.cross(normal, [0.3, 1.0, 0.2]))
        shape = {"center": 0.05 * normal - [0.0, 0.0, 0.04], "half_u": half_u, "half_v": np.cross(normal, half_u)}
        lights.append(
            light_of({"name": "", "shape": "RECTANGLE", **shape, "direction": normal, "radiance": np.ones(3)})
        )
    angle = np.linspace(0.0, 2.0 * np.pi, len(samples), endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    view, diffuse_albedo = unit(ring + [0.0, 0.0, 0.15]), np.zeros((len(samples), 3))
    samples = replace(samples, position=0.034 * ring, view=view, diffuse_albedo=diffuse_albedo)
    plate = Tracer(lambda origins, directions, distances: (origins + directions * distances[:, None])[:, 2] < 0.004)
    shared = shadows_of(samples, lights, plate, film, rays=256)
    monkeypatch.setattr(light_cluster.light_tree, "FEWEST", 500)
    alone = shadows_of(samples, lights, plate, film, rays=64)
    found, expected = (
        lighting.shade_lights(samples, lights, "ltsh4", ("specular",), (one,), workers=1)[0].specular.sum(axis=(0, 2))
        for one in (shared, alone)
    )
    assert (found > 0.5 * expected).all()


def test_lamps_that_nothing_hides_shade_as_without_shadows_bit_by_bit():
    samples, film = floor(8)
    lights = ceiling(70, group="A") + ceiling(5, group="B")
    shadows = shadows_of(samples, lights, OPEN, film)
    with_shadows, without = lighting.shade_lights(samples, lights, "ltsh4", ("diffuse",), (shadows, None), workers=1)
    only = lighting.shade_lights(samples, lights, "ltsh4", ("diffuse",), workers=1)[0]
    assert np.array_equal(with_shadows.diffuse, without.diffuse)
    np.testing.assert_allclose(only.diffuse, without.diffuse, rtol=0.01)
    plain = shading.shade(
        samples, lights, "ltsh4", passes=("diffuse",), workers=1, dtype=np.float64, rows=[0] * 70 + [1] * 5
    )
    np.testing.assert_allclose(only.diffuse, plain.diffuse, rtol=0.02)


def test_lights_that_share_rays_are_relit_together():
    lights = [replace(light, name=f"Lamp {number}") for number, light in enumerate(ceiling(70))]
    shadows = lighting.Shadows({}, shared_numbers(lights), {}, 0, "")
    kept = RelightData(SimpleNamespace(lights=lights), shadows, {}, False)
    relight._check_shared(kept, [replace(light, radiance=[2.0, 3.0, 4.0] * light.radiance) for light in lights])
    with pytest.raises(ValueError, match="'Lamp 0' and 'Lamp 3' are two of 70 that share their shadow rays"):
        relight._check_shared(kept, [*lights[:3], replace(lights[3], radiance=np.zeros(3)), *lights[4:]])


def test_lights_become_convex_quadrilaterals_of_their_area():
    arrow = np.array([[0.0, 0.0], [1.0, 0.3], [2.0, 0.0], [1.0, 2.0]])
    outlines = [
        arrow,
        arrow[::-1],
        arrow[[0, 2, 3]],
        [[0, 0], [2, 0], [2, 1], [0, 1]],
        [[0, 0], [2, 0], [3, 1], [1, 2], [0, 1]],
    ]
    lights = [replace(ceiling(1)[0], half_u=np.array([0.3, 0.1, 0.0]))]
    for outline in outlines:
        corners = np.column_stack([outline, np.full(len(outline), 2.0)])
        lights.append(PolygonLight.like(lights[0], corners=corners, direction=np.array([0.0, 0.0, -1.0])))
    quads, owner = light_cluster._quads_of(lights)
    before, after = quads - np.roll(quads, 1, axis=1), np.roll(quads, -1, axis=1) - quads
    turns = np.cross(before, after)[:, :, 2] * np.sign(np.cross(before, after).sum(axis=1)[:, 2:])
    assert (turns > -1e-12).all() and owner.tolist() == [0, 1, 1, 2, 2, 3, 4, 5, 5]
    across = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    areas = np.bincount(owner, 0.5 * np.linalg.norm(across, axis=1))
    assert np.allclose(areas[1:], [np.linalg.norm(light.area_vector) for light in lights[1:]])
